"""Units, checks and the rename-when-done rule."""

import os

import numpy as np
import pytest

from thermoxels_ns.core.checks import (
    check_finite,
    check_positive,
    check_shape,
    remove_file,
    remove_stale_temporaries,
    replace_when_done,
)
from thermoxels_ns.core.errors import MeshError, OutputError, ThermoxelsError
from thermoxels_ns.core.units import TemperatureRange


@pytest.mark.parametrize("bounds", [(20.0, 20.0), (30.0, 20.0), (float("nan"), 1.0), (0.0, float("inf"))])
def test_impossible_ranges_are_refused(bounds):
    with pytest.raises(ThermoxelsError, match=r"^temperature range: "):
        TemperatureRange(*bounds)


def test_checks_name_what_is_wrong():
    for call in (
        lambda: check_positive("it", -1.0, "Go forward.", MeshError),
        lambda: check_finite("it", np.array([1.0, np.nan, np.inf]), "Mend it.", MeshError),
        lambda: check_shape("it", np.zeros((4, 2)), (None, 3), "Transpose it.", MeshError),
    ):
        with pytest.raises(MeshError, match=r"^it: expected"):
            call()
    assert check_positive("x", 2, "") == 2.0


def test_interrupted_write_leaves_the_old_file_and_no_rubbish(tmp_path):
    target = tmp_path / "mesh.vtu"
    target.write_text("old")
    with pytest.raises(KeyboardInterrupt), replace_when_done(target) as temporary:
        assert temporary.suffix == ".vtu"
        temporary.write_text("half")
        raise KeyboardInterrupt
    assert target.read_text() == "old" and os.listdir(tmp_path) == ["mesh.vtu"]
    with replace_when_done(target) as temporary:
        temporary.write_text("new")
    assert target.read_text() == "new" and os.listdir(tmp_path) == ["mesh.vtu"]


def test_errors_of_the_disk_become_output_errors(tmp_path):
    (tmp_path / "mesh.vtu").mkdir()
    blocked = pytest.raises(OutputError, match=r"mesh\.vtu: expected a file that can be written.*Move away")
    with blocked, replace_when_done(tmp_path / "mesh.vtu") as temporary:
        temporary.write_text("new")
    full = pytest.raises(OutputError, match=r"a\.txt: expected a file that can be written.*No space left")
    with full, replace_when_done(tmp_path / "a.txt"):
        raise OSError(28, "No space left on device")
    with pytest.raises(OutputError, match=r"mesh\.vtu: expected a file that can be removed"):
        remove_file(tmp_path / "mesh.vtu")
    with pytest.raises(MeshError, match="own words"), replace_when_done(tmp_path / "a.txt"):
        raise MeshError("own words")
    assert os.listdir(tmp_path) == ["mesh.vtu"]
    remove_file(tmp_path / "absent")


def test_only_temporaries_of_the_given_names_are_stale(tmp_path):
    kept = {".mesh.12x.part.vtu", ".mesh.12.part.png", "mesh.12.part.vtu", ".other.12.part.vtu"}
    for name in {*kept, ".mesh.12.part.vtu", ".step-0001.9.part.vtu"}:
        (tmp_path / name).touch()
    remove_stale_temporaries(tmp_path, ["mesh.vtu", "step-*.vtu"])
    assert set(os.listdir(tmp_path)) == kept
    remove_stale_temporaries(tmp_path / "absent", ["mesh.vtu"])
