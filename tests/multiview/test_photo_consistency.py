"""The start from photographs, on a textured plane whose place is known, and where photographs say nothing."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType

from tests.support.short_training import train_with_optimizers
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.threads import set_num_threads
from thermoxels_ns.multiview.photo_consistency import (
    Photographs,
    _colours,
    _sample,
    _textured,
    density_from_photographs,
    deviations,
    exposures,
)
from thermoxels_ns.multiview.photo_kernels import _median
from thermoxels_ns.multiview.photographs import LONGEST_SIDE, read_photographs
from thermoxels_ns.synthetic.scene_folder import make_scene, write_scene

LATTICE = Lattice((-0.5, -0.5, -0.5), 1.0 / 16, (17, 17, 17))
PLANE = -0.125
"""Height of the plane: a layer of corners, with others above and below."""
SIZE, FOCAL = 96, 110.0
EYES = [(x, y, 1.6) for x in (-0.8, -0.2, 0.4, 0.9) for y in (-0.7, 0.0, 0.8)]


def texture(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Colours of the plane: waves that do not repeat within the box."""
    waves = [np.sin(17 * x + 5 * y), np.sin(23 * y - 11 * x + 1), np.sin(13 * x * y + 19 * x - 7 * y)]
    return 0.5 + 0.3 * np.stack(waves, -1)


def photographs(eyes=EYES, gains: np.ndarray | None = None) -> Photographs:
    """Photographs of the plane from above, all looking straight down."""
    turned = np.diag([1.0, -1.0, -1.0])  # x right, y down, z forward of a camera that looks along -z
    intrinsics = np.array([[FOCAL, 0.0, SIZE / 2], [0.0, FOCAL, SIZE / 2], [0.0, 0.0, 1.0]])
    column, row = np.meshgrid(*[(np.arange(SIZE) + 0.5 - SIZE / 2) / FOCAL] * 2)
    matrices, pictures = [], []
    for number, eye in enumerate(np.asarray(eyes, dtype=float)):
        height = eye[2] - PLANE
        picture = texture(eye[0] + column * height, eye[1] - row * height)
        pictures.append(picture * (1.0 if gains is None else gains[number]))
        matrices.append(intrinsics @ np.column_stack((turned, -turned @ eye)))
    return Photographs(
        np.stack(matrices),
        np.asarray(eyes, dtype=float),
        np.full((len(eyes), 2), SIZE),
        np.arange(len(eyes)) * SIZE * SIZE,
        np.concatenate(pictures).reshape(-1, 3).astype(np.float32),
    )


def layers(gain: np.ndarray | None) -> np.ndarray:
    """Mean over each layer of corners, away from the sides."""
    assert gain is not None
    return gain[3:-3, 3:-3].mean((0, 1))


def test_density_starts_highest_at_a_plane():
    found = density_from_photographs(LATTICE, photographs())
    mean, at = layers(found.log_gain), round((PLANE + 0.5) * 16)
    assert np.argmax(mean) == at and mean[at] > 5.0, mean
    assert np.delete(mean, at).max() < 1.0, mean
    assert found.log_gain is not None and found.log_gain.shape == LATTICE.shape
    assert found.report.startswith(f"{len(EYES)} photographs agree at ")


def test_exposures_are_found_and_do_not_move_the_plane():
    gains = np.exp(np.random.default_rng(3).normal(0.0, 0.12, len(EYES)))
    found = density_from_photographs(LATTICE, photographs(gains=gains))
    plain = density_from_photographs(LATTICE, photographs())
    assert np.argmax(layers(found.log_gain)) == np.argmax(layers(plain.log_gain))
    assert layers(found.log_gain).max() > 3.0
    assert "exposures within 0%" in plain.report and "exposures within 0%" not in found.report


def test_exposures_of_photographs_that_agree():
    rng = np.random.default_rng(0)
    gains = rng.normal(0.0, 0.2, 7)
    gains -= gains.mean()
    colours = rng.uniform(0.2, 0.6, (4000, 1, 3)) * np.exp(gains)[:, None]
    colours[rng.random((4000, 7)) < 0.2] = np.nan
    wrong = rng.random((4000, 7)) < 0.15
    colours[wrong] = rng.uniform(0.1, 0.9, (wrong.sum(), 3))
    assert exposures(colours.astype(np.float32)) == pytest.approx(gains, abs=0.01)
    alike = colours / np.exp(gains)[:, None]
    assert np.array_equal(exposures(alike.astype(np.float32)), np.zeros(7))


def test_plain_surroundings_are_not_taken_for_exposures():
    """Before a wall without texture, brighter the further a photograph was taken to one side, all air agrees."""
    rng = np.random.default_rng(4)
    gains = rng.normal(0.0, 0.2, len(EYES))
    gains -= gains.mean()
    whole = photographs(gains=np.exp(gains))
    column, _ = np.meshgrid(np.arange(SIZE), np.arange(SIZE))
    for k, first in enumerate(whole.firsts):
        x = EYES[k][0] + (column + 0.5 - SIZE / 2) / FOCAL * (EYES[k][2] - PLANE)
        surroundings = (np.abs(x) > 0.35).reshape(-1)
        seen = 0.45 * np.exp(gains[k] + 0.35 * EYES[k][0])
        whole.colours[first : first + SIZE * SIZE][surroundings] = seen
    points = _sample(LATTICE)
    seen, textured = _colours(points, whole), _colours(points, _textured(whole))
    wrong, found = exposures(seen), exposures(seen, textured)
    assert np.abs(found - gains).max() < 0.05, found - gains
    assert np.abs(wrong - gains).max() > 0.2, wrong - gains


def test_what_is_textured_does_not_depend_on_exposure():
    gains = np.exp(np.random.default_rng(3).normal(0.0, 0.12, len(EYES)))
    shown = [np.isfinite(_textured(photographs(gains=g)).colours).all(1) for g in (None, gains)]
    assert np.mean(shown[0]) == pytest.approx(0.3, abs=0.01) and np.mean(shown[0] == shown[1]) > 0.99


@pytest.mark.parametrize("count", [1, 2, 3, 8, 31, 32])
def test_median_of_the_kernels_is_that_of_numpy(count):
    rng = np.random.default_rng(count)
    for values in (rng.normal(size=count), rng.integers(0, 3, count), np.zeros(count)):
        row = np.append(values, -9.0).astype(np.float32)
        before = row.copy()
        assert _median(row, count) == np.median(row[:count]) and np.array_equal(row, before)


def test_photographs_that_are_left_out_are_not_read():
    frames = Frames(60, 40, None)
    some = read_photographs(frames, left_out=range(4, 40, 8))
    assert some is not None and len(some) == 32 and not {4.0, 12.0, 20.0, 28.0, 36.0} & set(some.centres[:, 0])
    assert read_photographs(frames, left_out=range(40)) is None


def test_deviation_is_that_of_numpy():
    """The compiled loop against plain numpy, with some photographs that do not show a corner and masked pixels."""
    some = photographs(EYES[:7])
    some.colours[np.random.default_rng(1).random(len(some.colours)) < 0.05] = np.nan
    found = deviations(LATTICE, some)
    points = np.concatenate((LATTICE.corner_positions().reshape(-1, 3), np.ones((LATTICE.num_corners, 1))), 1)
    seen = np.full((len(some), len(points), 3), np.nan)
    for k, matrix in enumerate(some.matrices):
        u, v, depth = (points @ matrix.T).T
        u, v = u / depth - 0.5, v / depth - 0.5
        picture = some.colours[some.firsts[k] :][: SIZE * SIZE].reshape(SIZE, SIZE, 3).astype(float)
        inside = (np.minimum(u, v) > -0.5) & (np.maximum(u, v) < SIZE - 0.5)
        u, v = np.clip(u, 0, SIZE - 1), np.clip(v, 0, SIZE - 1)
        i, j = np.minimum(v.astype(int), SIZE - 2), np.minimum(u.astype(int), SIZE - 2)
        a, b = (u - j)[:, None], (v - i)[:, None]
        upper = (1 - a) * picture[i, j] + a * picture[i, j + 1]
        lower = (1 - a) * picture[i + 1, j] + a * picture[i + 1, j + 1]
        seen[k] = np.where(inside[:, None], (1 - b) * upper + b * lower, np.nan)
    known = np.isfinite(seen[..., 0]).sum(0) >= 3
    assert 0.2 < known.mean() < 1.0
    seen = seen[:, known]
    expected = np.nanmedian(np.abs(seen - np.nanmedian(seen, 0)).sum(-1), 0)
    assert np.array_equal(np.isfinite(found.reshape(-1)), known)
    assert found.reshape(-1)[known] == pytest.approx(expected, abs=2e-5)


@pytest.mark.parametrize(
    ("eyes", "reason"),
    [
        (EYES[:1], "1 photographs, 3 are needed"),
        (EYES[:2], "2 photographs, 3 are needed"),
        ([(0.2, 0.1, 1.6)] * 5, "the photographs look from one place"),
        ([(0.001 * k, 0.0, 1.6) for k in range(9)], "the photographs look from one place"),
        ([(20.0 + k, 0.0, 1.6) for k in range(9)], "3 photographs together show 0.0% of the box"),
        ([(k / 4, 0.0, -1.6) for k in range(9)], "3 photographs together show 0.0% of the box"),
    ],
)
def test_photographs_that_say_nothing(eyes, reason):
    found = density_from_photographs(LATTICE, photographs(eyes))
    assert found.log_gain is None and reason in found.report


def test_grey_photographs_and_black_ones_say_nothing():
    for value in (0.5, 0.0):
        same = photographs()
        found = density_from_photographs(LATTICE, replace(same, colours=np.full_like(same.colours, value)))
        assert found.log_gain is None and found.report == "nowhere do photographs agree more than around"


def test_masked_pixels_are_not_seen():
    """Masks hide half of each photograph, which is painted over: nothing of the paint may be taken for the plane."""
    whole, hidden = photographs(), photographs()
    left = np.tile(np.arange(SIZE) < SIZE // 2, SIZE * len(EYES))
    hidden.colours[left] = np.nan
    found = density_from_photographs(LATTICE, hidden)
    assert found.log_gain is not None and np.isfinite(found.log_gain).all()
    assert np.argmax(layers(found.log_gain)) == np.argmax(layers(density_from_photographs(LATTICE, whole).log_gain))
    hidden.colours[:] = np.nan
    assert density_from_photographs(LATTICE, hidden).log_gain is None


def test_threads_do_not_change_a_bit():
    results = []
    for count in (1, 3):
        set_num_threads(count)
        found = density_from_photographs(LATTICE, photographs())
        assert found.log_gain is not None
        results.append(found.log_gain.tobytes())
    set_num_threads(1)
    assert results[0] == results[1]


def test_a_fine_lattice_takes_the_gain_of_a_coarse_one():
    """Beyond half of the finest comparison the gain is interpolated: equal where corners coincide."""
    coarse, fine = (Lattice((-0.5, -0.5, -0.5), 1.0 / n, (n + 1, n // 4 + 1, n + 1)) for n in (64, 128))
    gains = [density_from_photographs(lattice, photographs()).log_gain for lattice in (coarse, fine)]
    assert gains[0] is not None and gains[1] is not None and gains[1].shape == fine.shape
    assert gains[1][::2, ::2, ::2] == pytest.approx(gains[0], abs=1e-4)


class Frames:
    """A dataset of pictures whose red and green say where a pixel's ray goes: x and y on the plane at depth 1."""

    def __init__(self, width: int, height: int, distortion: list[float] | None, masked: bool = False):
        focal, kinds = 0.8 * width, CameraType.PERSPECTIVE
        poses = torch.eye(4)[None, :3].repeat(40, 1, 1)
        poses[:, 0, 3] = torch.arange(40.0)
        lens = None if distortion is None else torch.tensor([distortion])
        self.cameras = Cameras(
            poses, focal, focal, width / 2, height / 2, width, height, distortion_params=lens, camera_type=kinds
        )
        directions = self.cameras.generate_rays(camera_indices=0).directions
        x, y = directions[..., 0] / -directions[..., 2], directions[..., 1] / -directions[..., 2]
        picture = torch.stack((0.5 + 0.4 * x, 0.5 + 0.4 * y, torch.zeros_like(x)), -1)
        self.picture, self.masked = (255 * picture).round().to(torch.uint8), masked

    def get_image_uint8(self, index: int) -> torch.Tensor:
        return self.picture

    def get_mask(self, index: int) -> torch.Tensor | None:
        mask = torch.ones(*self.picture.shape[:2], 1, dtype=torch.bool)
        mask[: len(mask) // 4] = False
        return mask if self.masked else None


@pytest.mark.parametrize("distortion", [None, [-0.12, 0.03, 0.0, 0.0, 0.004, -0.006]])
@pytest.mark.parametrize(("width", "height"), [(120, 90), (1000, 750)])
def test_read_photographs_are_pinholes(distortion, width, height):
    read = read_photographs(Frames(width, height, distortion))
    assert read is not None and len(read) == 32
    assert read.centres[0, 0] == 0.0 and read.centres[-1, 0] == 39.0 and len(set(read.centres[:, 0])) == 32
    assert tuple(read.sizes[3]) == ((120, 90) if width == 120 else (LONGEST_SIDE, 300))
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 9), np.linspace(-0.35, 0.35, 7))
    for k in (0, 17):
        points = np.stack((read.centres[k, 0] + 2 * x, 2 * y, np.full_like(x, -2.0), np.ones_like(x)), -1)
        u, v, depth = np.moveaxis(points @ read.matrices[k].T, -1, 0)
        assert depth == pytest.approx(2.0)
        picture = read.colours[read.firsts[k] :][: np.prod(read.sizes[k])].reshape(*read.sizes[k][::-1], 3)
        shown = picture[np.floor(v / depth).astype(int), np.floor(u / depth).astype(int)]
        pixel = 0.4 * 1.25 / read.sizes[k, 0]
        assert shown[..., 0] == pytest.approx(0.5 + 0.4 * x, abs=0.6 * pixel + 0.004)
        assert shown[..., 1] == pytest.approx(0.5 + 0.4 * y, abs=0.6 * pixel + 0.004)


def test_masks_of_read_photographs():
    read = read_photographs(Frames(600, 450, None, masked=True))
    assert read is not None
    rows = np.isnan(read.colours[: np.prod(read.sizes[0])].reshape(*read.sizes[0][::-1], 3)).all((1, 2))
    assert rows[:75].all() and not rows[76:].any()


def test_other_lenses_are_left_out():
    frames = Frames(60, 40, None)
    kinds = torch.full((40, 1), CameraType.FISHEYE.value)
    frames.cameras.camera_type = kinds
    assert read_photographs(frames) is None
    kinds[3:9] = CameraType.PERSPECTIVE.value
    read = read_photographs(frames)
    assert read is not None and read.centres[:, 0].tolist() == [3.0, 4.0, 5.0, 6.0, 7.0, 8.0]


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("start") / "scene"
    return write_scene(make_scene("sphere"), folder, 8, 1, width=60, height=45, progress=False)


def density(scene, steps: int, **options: Any) -> torch.Tensor:
    pipeline, _ = train_with_optimizers(scene, steps, {"resolutions": [16], **options}, rays=64)
    return pipeline.model.grid.density.detach().clone()


@pytest.mark.parametrize("activation", ["exp", "softplus", "relu"])
def test_a_training_starts_from_photographs_and_holds_it(scene, activation):
    def start(kind: str, steps: int, hold: int) -> torch.Tensor:
        return density(scene, steps, start=kind, hold_density=hold, density_activation=activation)

    plain, held = start("plain", 1, 2), start("photographs", 1, 2)
    assert float(held.max()) > float(plain.max()) and torch.isfinite(held).all()
    assert torch.equal(start("photographs", 2, 2), held)
    assert not torch.equal(start("photographs", 3, 2), held)


def test_a_resumed_training_keeps_its_density(scene):
    """Callbacks at a later step alone, as after a resume: the start is not set again."""
    from nerfstudio.engine.callbacks import TrainingCallbackAttributes

    pipeline, optimizers = train_with_optimizers(scene, 1, {"resolutions": [16], "start": "photographs"}, rays=64)
    with torch.no_grad():
        pipeline.model.grid.density.fill_(-1.25)
    trainer: Any = SimpleNamespace(_start_step=7, config=SimpleNamespace(max_num_iterations=1))
    attributes: Any = TrainingCallbackAttributes(optimizers, None, pipeline, trainer)  # type: ignore[arg-type]
    for callback in pipeline.get_training_callbacks(attributes):
        callback.run_callback(7)
    assert bool((pipeline.model.grid.density == -1.25).all())


def test_a_training_without_colour_starts_plain(scene, capsys):
    options = {"sh_degree": None, "thermal_density_gradient": True, "hold_density": 0}
    plain = density(scene, 1, **options)
    assert torch.equal(density(scene, 1, start="photographs", **options), plain)
    assert "the same density everywhere, because no photographs train" in " ".join(capsys.readouterr().out.split())


def test_the_edge_of_a_mask_is_no_texture():
    """Two plain pictures, dark and bright, half of each hidden: nothing shows texture."""
    size = np.array([[16, 12]] * 2)
    picture = np.full((2, 12, 16, 3), 0.1, np.float32)
    picture[1] = 0.7
    picture[:, :, 8:] = np.nan
    hidden = Photographs(np.zeros((2, 3, 4)), np.zeros((2, 3)), size, np.array([0, 192]), picture.reshape(-1, 3), 0.0)
    assert not np.isfinite(_textured(hidden).colours).any()
    picture[0, 5, 3] = 0.9
    seen = np.isfinite(_textured(replace(hidden, colours=picture.reshape(-1, 3))).colours).all(1).reshape(2, 12, 16)
    assert seen[0, 5, 3] and not seen[1].any()
