import cv2
import numpy as np
import pytest
from PIL import Image

from thermoxels_ns.capture.masks import PhotographMasks, find_overlay, mask_files, read_mask
from thermoxels_ns.core.errors import SceneError


def write(folder, number, pixels):
    path = folder / f"{number}.jpg"
    Image.fromarray(pixels).save(path, quality=90)
    return path


def scenes(count=10, seed=0):
    """Different smooth pictures, 320 x 240."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        yield cv2.resize(rng.integers(0, 255, (6, 8, 3), dtype=np.uint8), (320, 240), interpolation=cv2.INTER_CUBIC)


def test_text_and_a_scale_bar_are_masked(tmp_path):
    paths, drawn = [], np.zeros((240, 320), dtype=np.uint8)
    cv2.putText(drawn, "FLIR 21.5", (10, 30), cv2.FONT_HERSHEY_SIMPLEX, 0.8, 255, 2)
    cv2.rectangle(drawn, (300, 60), (312, 200), 255, -1)
    for number, pixels in enumerate(scenes()):
        pixels[drawn > 0] = 255
        paths.append(write(tmp_path, number, pixels))
    use = find_overlay(paths)
    assert use is not None
    assert (~use)[drawn > 0].mean() > 0.97
    far = cv2.dilate(drawn, np.ones((31, 31), np.uint8)) == 0
    assert use[far].all()


def test_what_the_scene_shows_is_no_overlay(tmp_path):
    """Nothing drawn; still cameras; few photographs; a still patch like its surroundings; stripes, as of a fence."""
    still = next(scenes(1))
    few, patch, fence = list(scenes(4)), list(scenes(16)), list(scenes())
    for pixels in few:
        pixels[20:40, 20:60] = 255
    for pixels in patch:
        pixels[100:130, 100:150] = 127
    for pixels in fence:
        pixels[:, np.arange(320) // 8 % 2 == 0] = 255
    for pictures in (scenes(), [still] * 8, few, patch, fence):
        assert find_overlay([write(tmp_path, n, pixels) for n, pixels in enumerate(pictures)]) is None


def test_the_users_mask_and_the_overlay_both_count(tmp_path):
    hand = np.full((24, 32), 255, dtype=np.uint8)
    hand[:, :4] = 0
    Image.fromarray(hand).save(tmp_path / "IMG_1.png")
    overlay = np.ones((24, 32), dtype=bool)
    overlay[:2] = False
    files = mask_files(tmp_path)
    masks = PhotographMasks((32, 24), overlay, {"a": files["img_1"]})
    assert (~masks.of("a")).sum() == 24 * 4 + 2 * 28
    assert (~masks.of("b")).sum() == 2 * 32
    assert masks.any and not PhotographMasks((32, 24)).any


def test_a_mask_of_another_size_is_refused(tmp_path):
    Image.new("L", (10, 10)).save(tmp_path / "m.png")
    with pytest.raises(SceneError, match="a mask of 32 x 24 pixels"):
        read_mask(tmp_path / "m.png", 32, 24)
    with pytest.raises(SceneError, match="no folder at"):
        mask_files(tmp_path / "nowhere")
