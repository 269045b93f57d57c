import json

import pytest

from tests.support.short_training import train
from thermoxels_ns.nerfstudio_bridge import compare_with_truth
from thermoxels_ns.synthetic.scene_folder import make_scene, write_scene

COURSE = {"resolutions": [16, 32], "refine_at": [120], "prune_at": [220], "photo_depth": "on"}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene") / "house"
    write_scene(make_scene("house-corner+sky=0.55,0.57,0.60"), folder, 20, 1, width=128, height=96, progress=False)
    path = folder / "transforms.json"
    wide = {"scene_box": [[-6.7, -8.0, -5.3], [7.7, 6.4, 9.1]]}
    path.write_text(json.dumps(json.loads(path.read_text()) | wide))
    return folder


def fscore(scene, **options) -> float:
    return compare_with_truth(train(scene, 300, {**COURSE, **options}, rays=1024))["fscore"]


def test_a_grey_sky_does_not_become_a_grey_cloud(scene):
    """Without what photographs say about it, every image fits and most of the surface is cloud."""
    assert fscore(scene) > 0.95
    assert fscore(scene, photo_depth="off") < 0.6
