import json

import numpy as np
import pytest

from thermoxels_ns.capture.rig.start import read_rig
from thermoxels_ns.core.errors import SceneError

CAMERA = {"w": 64, "h": 48, "fl_x": 70.0, "fl_y": 70.0, "cx": 32.0, "cy": 24.0}


def rig_file(folder, **changed):
    rig = np.eye(4)
    rig[:3, 3] = 0.1, 0.0, 0.02
    content = {"thermal_camera": CAMERA, "rig": rig.tolist(), "metres_per_unit": 0.5, **changed}
    path = folder / "transforms.json"
    path.write_text(json.dumps(content))
    return path


@pytest.mark.parametrize(("ours", "shift"), [(0.5, 0.1), (0.25, 0.2), (None, 0.1)])
def test_lengths_follow_the_scales(tmp_path, ours, shift):
    rig = read_rig(rig_file(tmp_path), (64, 48), ours)
    assert rig.visible_to_thermal[0, 3] == pytest.approx(shift)
    assert ("converted" in rig.explanation) == (ours is not None)


@pytest.mark.parametrize("rig", [np.diag([1.0, 1.0, -1.0, 1.0]), np.eye(3)])
def test_mirrors_and_other_matrices_are_refused(tmp_path, rig):
    with pytest.raises(SceneError, match="rig: expected"):
        read_rig(rig_file(tmp_path, rig=rig.tolist()), (64, 48))


@pytest.mark.parametrize("width", [float("inf"), float("nan"), 64.5, 1e400, -float("inf")])
def test_sizes_are_whole_numbers_of_pixels(tmp_path, width):
    file = rig_file(tmp_path, thermal_camera={**CAMERA, "w": width})
    with pytest.raises(SceneError, match=r"transforms.json: thermal_camera"):
        read_rig(file, (64, 48))
    rig = read_rig(rig_file(tmp_path, thermal_camera={**CAMERA, "w": 64.0}), (64, 48))
    assert rig.thermal_camera.width == 64
