import numpy as np
import torch

from thermoxels_ns.field.surroundings import Surroundings

BOX = torch.tensor([[-1.0, -0.8, 0.1], [1.0, 0.7, 0.6]])
ACROSS, DEEP = 16, 8


def surroundings() -> Surroundings:
    return Surroundings(BOX, ACROSS, DEEP, 0.01, "exp", True)


def rays(count: int = 400) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    origins = 1.5 * torch.randn(count, 3, generator=generator)
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    origins[:3], directions[:3] = torch.tensor([0.0, 0.0, 0.3]), torch.eye(3)  # along the axes, from within
    origins[3], directions[3] = torch.tensor([5.0, 0.0, 0.3]), torch.tensor([1.0, 0.0, 0.0])  # away from the box
    return origins, directions


def in_lattice(point: np.ndarray) -> np.ndarray:
    """Where a point outside the box stands in the lattice: written again, point by point."""
    lo, hi = BOX.double().numpy()
    scaled = (point - 0.5 * (lo + hi)) / (0.5 * (hi - lo))
    axis = int(np.abs(scaled).argmax())
    q = abs(scaled[axis])
    face = 2 * axis + int(scaled[axis] < 0)
    sides = [0.5 * (scaled[(axis + step) % 3] / q + 1.0) * ACROSS for step in (1, 2)]
    return np.array([face * (DEEP + 1) + (1.0 - 1.0 / q) * DEEP, *sides])


def outside(point: np.ndarray) -> bool:
    lo, hi = BOX.double().numpy()
    return bool(((point < lo - 1e-6) | (point > hi + 1e-6)).any())


def test_pieces_cover_each_ray_from_where_it_leaves_the_box_to_infinity():
    origins, directions = rays()
    cut = surroundings().segments(origins, directions)
    for number in range(len(origins)):
        own = cut.ray == number
        starts, ways, lengths = (v[own].double().numpy() for v in (cut.origins, cut.directions, cut.lengths))
        assert cut.rank[own].tolist() == list(range(len(starts)))
        covered = []
        for distance in np.geomspace(0.01, 1e4, 60):
            point = origins[number].double().numpy() + distance * directions[number].double().numpy()
            if not outside(point):
                continue
            place = in_lattice(point)
            along = np.clip(((place - starts) * ways).sum(1), 0.0, lengths)
            covered.append(np.linalg.norm(starts + along[:, None] * ways - place, axis=1).min() < 1e-3)
        # Once a point lies on a piece, all farther ones do.
        first = covered.index(True)
        assert all(covered[first:])
        end = starts[-1] + lengths[-1] * ways[-1]
        assert abs(end[0] % (DEEP + 1) - DEEP) < 1e-4, "the last piece ends at infinity"


def test_a_ray_through_the_box_begins_at_its_far_side():
    origins, directions = torch.tensor([[0.0, 0.0, -5.0]]), torch.tensor([[0.0, 0.0, 1.0]])
    cut = surroundings().segments(origins, directions)
    assert len(cut.ray) == 1
    np.testing.assert_allclose(cut.origins[0], in_lattice(np.array([0.0, 0.0, 0.6 + 1e-12])), atol=1e-4)


def test_the_lattices_of_two_faces_share_no_corner():
    voxels = surroundings().grid.voxels
    layer = voxels.corner_index()[:, 0] // (DEEP + 1)
    of_voxel = voxels.cells // (ACROSS * ACROSS) // (DEEP + 1)
    for corner in range(4):
        np.testing.assert_array_equal(layer[voxels.voxel_rows[:, corner]], of_voxel)
    assert len(voxels) == 6 * DEEP * ACROSS * ACROSS
