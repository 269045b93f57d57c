from pathlib import Path

import numpy as np

from thermoxels_ns.core.kernel_cache import forget_stale_kernels, kernel


def test_what_was_compiled_from_other_sources_goes_and_nothing_else(tmp_path: Path):
    one, two, cached = tmp_path / "one.py", tmp_path / "two.py", tmp_path / "cache"
    one.write_text("a = 1")
    two.write_text("b = 1")
    assert forget_stale_kernels(cached, (one, two))
    kept = [cached / "one.f-3.py311.nbi", cached / "two.g-7.py311.1.nbc"]
    for path in (*kept, cached / "one.pyc"):
        path.write_text("x")
    assert not forget_stale_kernels(cached, (two, one)) and all(path.exists() for path in kept)
    one.write_text("a = 2")  # as long as before: a time stamp may be equal too
    assert forget_stale_kernels(cached, (one, two))
    assert not any(path.exists() for path in kept) and (cached / "one.pyc").exists()
    assert not forget_stale_kernels(cached, (one, two))


def test_the_kernels_in_use_are_watched():
    from thermoxels_ns.fem.p1_kernels import _add_couplings as in_fem
    from thermoxels_ns.render.kernels import march_rays as in_render

    for dispatcher in (in_fem, in_render):
        assert (Path(dispatcher.stats.cache_path) / "thermoxels-kernels.sha256").is_file()


def test_a_kernel_divides_like_numpy():
    @kernel(cache=False)
    def share(a, b):
        return a / b

    assert share(1.0, 0.0) == np.inf
