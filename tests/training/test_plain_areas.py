import numpy as np
import pytest
import torch

from thermoxels_ns.multiview.photographs import gathered
from thermoxels_ns.training.plain_areas import ALIKE, PlainAreas, bend_loss

WIDTH, HEIGHT, FOCAL = 40, 30, 30.0
INTRINSICS = np.array([[FOCAL, 0.0, WIDTH / 2], [0.0, FOCAL, HEIGHT / 2], [0.0, 0.0, 1.0]])
CPU = torch.device("cpu")


def areas_of(picture: np.ndarray, known=(), backdrop=()) -> PlainAreas:
    """Those of one photograph from (0, 0, -2) along z, x to the right and y down."""
    matrix = INTRINSICS @ np.column_stack((np.eye(3), (0.0, 0.0, 2.0)))
    pinhole = picture.astype(np.float32), np.full(picture.shape[:2], np.nan, np.float32), matrix
    marks = np.zeros((2, HEIGHT, WIDTH), bool)
    for mark, places in zip(marks, (known, backdrop)):
        for rows, columns in places:
            mark[rows, columns] = True
    return PlainAreas(gathered([pinhole], [(0.0, 0.0, -2.0)]), marks[0].ravel(), marks[1].ravel())


def pixels_of(areas: PlainAreas, count: int = 400) -> np.ndarray:
    """Columns and rows of threes of pixels, (3, n, 2)."""
    request, length = areas.request(count, 0.1, torch.Generator().manual_seed(0), CPU)
    along = request.directions.double().numpy() * length.numpy()[:, None]
    assert np.allclose(along[:, 2], 1.0, atol=1e-6), "lengths are those at depth 1"
    return (along @ INTRINSICS.T)[:, :2].reshape(3, -1, 2)


def wall_between_textures() -> np.ndarray:
    """A plain wall from column 10 to 29; what is beside it changes from pixel to pixel."""
    picture = np.random.default_rng(0).uniform(0.0, 1.0, (HEIGHT, WIDTH, 3))
    picture[:, 10:30] = 0.5
    return picture


def test_threes_of_pixels_stand_evenly_in_one_plain_area():
    left, middle, right = pixels_of(areas_of(wall_between_textures()))
    assert len(middle) > 300
    np.testing.assert_allclose(left + right, 2.0 * middle, atol=1e-3)
    apart = np.abs(right - left)
    assert (apart.min(axis=1) < 1e-3).all() and (apart.max(axis=1) > 1.9).all(), "in a row or in a column"
    assert {tuple(row) for row in (apart > 1.0).tolist()} == {(True, False), (False, True)}, "both occur"
    for pixel in (left, middle, right):
        assert ((pixel[:, 0] > 10) & (pixel[:, 0] < 30)).all()
    assert (middle[:, 0] > 11).all() and (middle[:, 0] < 29).all(), "a pixel beside another colour is none"
    assert (left[:, 0] < 11).any(), "the outer ones reach the rim, where depths are known"


@pytest.mark.parametrize("mark", ["known", "backdrop"])
def test_pixels_with_depths_or_of_a_backdrop_are_in_the_middle_of_no_three(mark):
    upper = (slice(0, 15), slice(None))
    left, middle, right = pixels_of(areas_of(wall_between_textures(), **{mark: [upper]}))
    assert len(middle) and (middle[:, 1] > 15).all()
    outer = np.concatenate((left, right))
    assert (outer[:, 1] < 15).any() is np.bool_(mark == "known"), "a known depth holds the surface, a sky does not"


def test_two_walls_of_different_colour_are_two_areas():
    picture = np.full((HEIGHT, WIDTH, 3), 0.5)
    picture += np.linspace(0.0, 3.0 * ALIKE, WIDTH)[:, None]  # so slowly that each pixel is like the one beside it
    for pixels in pixels_of(areas_of(picture))[[0, 2]]:
        apart = np.abs(pixels - pixels_of(areas_of(picture))[1])[:, 0]
        assert len(apart) and apart.max() < WIDTH / 3 + 1
    assert len(areas_of(np.random.default_rng(0).uniform(size=(HEIGHT, WIDTH, 3)))) == 0


def test_a_slanted_plane_costs_nothing_and_a_dent_its_depth_in_voxels():
    request, length = areas_of(np.full((HEIGHT, WIDTH, 3), 0.5)).request(200, 0.1, torch.Generator(), CPU)
    normal, opaque = torch.tensor([0.3, -0.4, 1.0]), torch.ones(len(length))
    distance = 2.0 / (request.directions @ normal)
    assert float(bend_loss(distance, opaque, length, 0.05)) < 1e-6
    dent = distance.clone().view(3, -1)
    dent[1] += 0.2  # four voxels behind the line between the outer ones
    assert float(bend_loss(dent.view(-1), opaque, length, 0.05)) == pytest.approx(np.sqrt(17.0) - 1.0, rel=1e-4)
    assert float(bend_loss(dent.view(-1), 0.4 * opaque, length, 0.05)) == 0.0, "what is transparent has no surface"
