import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.support.scene_folders import look_at_origin
from thermoxels_ns.core.camera import Camera
from thermoxels_ns.data.dataparser import ThermalDataParserConfig
from thermoxels_ns.data.scene_box import box_of_points, exactness, find_scene_box
from thermoxels_ns.data.scene_file import Frame, read_scene_file
from thermoxels_ns.synthetic.scene_truth import look_at

WIDTH, HEIGHT, FOCAL = 96, 72, 90.0
BLOCK = np.array([0.5, 0.35, 0.25])
"""Half of the sides of a block around the origin."""


def waves(points: np.ndarray) -> np.ndarray:
    turns = [np.sin(points @ way + phase) for way, phase in (((1, 2, 3), 0), ((3, -1, 2), 1), ((-2, 3, 1), 2))]
    return 0.5 + 0.2 * np.stack(turns, -1)


def photograph(pose: np.ndarray, room: np.ndarray, block: bool) -> np.ndarray:
    """A textured room whose half sides are `room`, from within, and a textured block in its middle; (h, w, 3) uint8."""
    column, row = np.meshgrid(
        (np.arange(WIDTH) + 0.5 - WIDTH / 2) / FOCAL, (np.arange(HEIGHT) + 0.5 - HEIGHT / 2) / FOCAL
    )
    towards, eye = np.stack((column, -row, -np.ones_like(row)), -1) @ pose[:3, :3].T, pose[:3, 3]
    with np.errstate(divide="ignore"):
        wall = ((np.where(towards > 0.0, room, -room) - eye) / towards).min(-1)
        ends = np.stack([(side * BLOCK - eye) / towards for side in (-1.0, 1.0)])
    enter, leave = ends.min(0).max(-1), ends.max(0).min(-1)
    hit = block & (enter < leave) & (enter > 0.0)
    at = eye + np.where(hit, enter, wall)[..., None] * towards
    colours = np.where(hit[..., None], waves(at * 20.0), waves(at * 24.0 / room.max()))
    return (255.0 * colours).round().astype(np.uint8)


def outwards(number: int, of: int = 24) -> np.ndarray:
    """Cameras on a small circle in the middle of a room, all looking away from it."""
    pose = look_at_origin(2.0 * np.pi * number / of, radius=0.35, height=0.0)
    pose[:3, [0, 2]] *= -1.0
    pose[2, 3] = 0.1 * (-1) ** number
    return pose


def around(number: int, of: int = 24) -> np.ndarray:
    return look_at_origin(2.0 * np.pi * number / of, radius=2.2, height=1.0 + 0.2 * (number % 2))


def write(folder: Path, poses: list[np.ndarray], room: list[float], block: bool, **extra) -> None:
    """A scene of photographs of `photograph`, with a flat thermal image each."""
    (folder / "images").mkdir(parents=True)
    (folder / "thermal").mkdir()
    frames = []
    for number, pose in enumerate(poses):
        name = f"frame_{'eval' if number % 8 == 4 else 'train'}_{number:03d}.png"
        Image.fromarray(photograph(pose, np.array(room), block)).save(folder / "images" / name)
        Image.fromarray(np.full((HEIGHT, WIDTH), 900, np.uint16)).save(folder / "thermal" / name)
        frames.append({"file_path": f"images/{name}", "transform_matrix": pose.tolist()})
    lens = {"w": WIDTH, "h": HEIGHT, "fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2}
    (folder / "temperature_bounds.json").write_text(
        json.dumps({"absolute_min_temperature": 10.0, "absolute_max_temperature": 30.0})
    )
    (folder / "transforms.json").write_text(json.dumps({**lens, **extra, "frames": frames}))


def found(folder: Path) -> tuple[np.ndarray, str]:
    file = read_scene_file(folder)
    training = [n for n, frame in enumerate(file.frames) if "train" in frame.name]
    evidence = find_scene_box(file, None, training, None)
    return evidence.box, evidence.source


@pytest.mark.parametrize("across", [False, True])
def test_a_room_from_within(tmp_path, across):
    half = np.array([2.0, 1.5, 1.2])
    poses = [look_at_origin(np.pi * n / 12, radius=0.6, height=0.0) if across else outwards(n) for n in range(24)]
    write(tmp_path / "scene", poses, half.tolist(), block=False)
    box, source = found(tmp_path / "scene")
    assert source.endswith("depths on which 21 photographs agree")
    walls = box[:, :2]  # floor and ceiling are hardly in view
    assert (walls[0] < -half[:2]).all() and (walls[1] > half[:2]).all() and (np.abs(box) < 1.3 * half.max()).all(), box


def test_a_block_before_far_walls_and_without_held_out_photographs(tmp_path):
    write(tmp_path / "scene", [around(n) for n in range(24)], [16.0, 16.0, 16.0], block=True)
    box, source = found(tmp_path / "scene")
    assert "photographs agree" in source
    assert (box[0] < -BLOCK).all() and (box[1] > BLOCK).all() and (np.abs(box) < 1.3 * BLOCK.max()).all(), box
    for path in (tmp_path / "scene" / "images").glob("frame_eval_*"):
        Image.new("RGB", (WIDTH, HEIGHT)).save(path)
    assert np.array_equal(found(tmp_path / "scene")[0], box)


def test_the_log_says_from_what_and_how_large_in_metres(tmp_path, capsys):
    write(tmp_path / "scene", [around(n) for n in range(24)], [16.0, 16.0, 16.0], block=True, metres_per_unit=10.0)
    outputs = ThermalDataParserConfig(data=tmp_path / "scene").setup().get_dataparser_outputs()
    said = " ".join(capsys.readouterr().out.split())
    sides = (outputs.scene_box.aabb[1] - outputs.scene_box.aabb[0]) / outputs.dataparser_scale * 10.0
    assert f"photographs agree, {' x '.join(f'{side:.3g}' for side in sides.tolist())} m;" in said, said
    assert 10.0 < float(sides[0]) < 13.0


def frames_of(tmp_path: Path, poses: list[np.ndarray]) -> list[Frame]:
    write(tmp_path / "scene", poses, [1.0, 1.0, 1.0], block=False)
    return read_scene_file(tmp_path / "scene").frames


def test_strays_and_a_street_behind_do_not_count_but_a_chimney_does(tmp_path):
    """Of 2,000 points a fifth lie in a street six times as far from the middle, and 1 % anywhere."""
    rng, frames = np.random.default_rng(5), frames_of(tmp_path, [around(n) for n in range(24)])
    body, angle = rng.uniform(-BLOCK, BLOCK, (1500, 3)), rng.uniform(0.0, 2.0 * np.pi, 400)
    street = np.column_stack([3.0 * np.cos(angle), 3.0 * np.sin(angle), rng.uniform(-1.0, 0.0, 400)])
    chimney = rng.uniform([-0.05, -0.05, 0.25], [0.05, 0.05, 0.6], (80, 3))
    strays = rng.normal(0.0, 300.0, (20, 3))
    box = box_of_points(np.concatenate([body, street, chimney, strays]), frames)
    assert (box[0] < -0.98 * BLOCK).all() and (box[1] > [0.49, 0.34, 0.6]).all() and (np.abs(box) < 0.75).all(), box


def test_inexact_points_count_little_and_photographs_of_a_detail_not_more_than_others(tmp_path):
    """A tenth of a photograph's points are wrong and inexact, and most photographs show a detail from very near."""
    draw, frames = np.random.default_rng(6), frames_of(tmp_path, [around(n) for n in range(24)])
    block = BLOCK * draw.uniform(-1.0, 1.0, (1600, 3))
    wrong = draw.uniform([-1.0, -1.0, -0.2], [1.0, 1.0, 0.2], (160, 3))
    detail = draw.uniform(-0.02, 0.02, (2000, 3))
    points, counts = np.concatenate((block, wrong, detail)), (1600, 160, 2000)
    weight = exactness(np.repeat([0.01, 0.05, 0.0001], counts), np.repeat([0, 0, 1], counts))
    box, without = box_of_points(points, frames, weight), box_of_points(points, frames)
    assert (box[0] < -BLOCK).all() and (box[1] > BLOCK).all() and (np.abs(box) < 0.65).all(), box
    assert (np.abs(without) > 0.9).any()


@pytest.mark.parametrize("reach", [0.6, 0.82, 2.0])
def test_a_ground_that_runs_on_stays(tmp_path, reach):
    """A table or a yard is seen as well as what stands on it; what is exported is chosen later."""
    frames = frames_of(tmp_path, [look_at_origin(0.26 * number, radius=2.2, height=1.2) for number in range(24)])
    draw = np.random.default_rng(4)
    ground = np.column_stack((draw.uniform(-reach, reach, (4000, 2)), np.full(4000, -0.3)))
    block = BLOCK * draw.uniform(-1.0, 1.0, (1500, 3))
    box = box_of_points(np.concatenate((ground, block)), frames)
    assert (box[0] < -BLOCK).all() and (box[1] > BLOCK).all(), box
    assert 0.98 * reach < np.abs(box[:, :2]).min() and np.abs(box[:, :2]).max() < 1.3 * reach, box


def test_a_plain_wall_without_points_is_held_too(tmp_path):
    frames = frames_of(tmp_path, [outwards(n) for n in range(24)])
    walls = np.random.default_rng(6).uniform(-1.5, 1.5, (3, 600, 3))
    walls[0, :, 0], walls[1, :, 1], walls[2, :, 1] = -1.5, -1.5, 1.5
    walls[1:, :, 0] = np.minimum(walls[1:, :, 0], 0.4)
    box = box_of_points(walls.reshape(-1, 3), frames)
    assert 1.4 < box[1, 0] < 2.2 and -2.0 < box[0, 0] < -1.5, box


def test_points_near_the_edges_of_photographs_alone_and_a_blind_camera_give_a_box(tmp_path):
    of, lens = frames_of(tmp_path, [around(0)])[0], Camera(200, 150, 200.0, 200.0, 100.0, 75.0)
    looks = (((-3.0, 0.0, 0.0), 0.0), ((-3.0, 0.2, 0.0), 0.0), ((-3.0, 0.0, 0.0), -6.0))
    frames = [replace(of, pose=look_at(eye, (x, eye[1], 0.0)), intrinsics=lens) for eye, x in looks]
    draw = np.random.default_rng(1)
    rim = draw.uniform((-0.3, 1.15, -0.9), (0.0, 1.3, 0.9), (120, 3))
    rim[:, 1] *= draw.choice([-1.0, 1.0], 120)
    assert np.isfinite(box_of_points(rim, frames)).all()
