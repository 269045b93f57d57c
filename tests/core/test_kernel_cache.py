from pathlib import Path

from thermoxels_ns.core.kernel_cache import forget_stale_kernels


def test_what_was_compiled_from_other_sources_goes_and_nothing_else(tmp_path: Path):
    one, two, cache = tmp_path / "one.py", tmp_path / "two.py", tmp_path / "cache"
    one.write_text("a = 1")
    two.write_text("b = 1")
    assert forget_stale_kernels(cache, (one, two))
    kept = [cache / "one.f-3.py311.nbi", cache / "two.g-7.py311.1.nbc", cache / "other.h-1.py311.nbi"]
    for path in kept:
        path.write_text("x")
    assert not forget_stale_kernels(cache, (two, one)) and all(path.exists() for path in kept)
    one.write_text("a = 2")  # as long as before: a time stamp may be equal too
    assert forget_stale_kernels(cache, (one, two))
    assert [path.exists() for path in kept] == [False, False, True]
    assert not forget_stale_kernels(cache, (one, two))


def test_the_kernels_in_use_are_watched():
    from thermoxels_ns.render import fused, kernels

    cache = Path(kernels.march_forward.stats.cache_path)
    assert (cache / "thermoxels-kernels.sha256").is_file() and fused.kernels is kernels
