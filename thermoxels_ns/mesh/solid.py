"""Which voxels are solid: the densest share, one connected body, cavities filled on request."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from thermoxels_ns.checks import check_positive
from thermoxels_ns.errors import MeshError, explain
from thermoxels_ns.snapshot import GridSnapshot


@dataclass(frozen=True)
class SolidSelection:
    """How solid voxels are told from empty ones."""

    voxel_optical_depth: float = 0.5
    """Voxels in which density times edge length is at least this are solid: at 0.5, light that crosses loses 39 %."""
    density_percentile: float | None = None
    """Percentile p of the density over all voxels of the box, 0 to 100: the (100 - p) % densest voxels are solid, as in
    the Thermoxels paper. Overrides the optical depth. Raise it if empty space turns solid, lower it if walls have
    holes."""
    density_threshold: float | None = None
    """Voxels at least this dense are solid, [1 / world unit of the trained scene]. Overrides both."""
    close_gaps: int = 1
    """Fill gaps and pinholes up to twice this many voxels wide (a morphological closing); thin walls are not
    continuous without it. 0: none."""
    smallest_body: float = 0.01
    """Drop bodies (voxels that touch, if only by corners) of less than this share of the largest; mostly floaters."""
    largest_component: bool = False
    """Keep only the largest body of voxels that touch by faces."""
    fill_cavities: bool = False
    """Make empty space solid where it has no way out through voxel faces. Off by default: a room is a cavity too."""

    def __post_init__(self) -> None:
        check_positive("voxel_optical_depth", self.voxel_optical_depth, "Pass --voxel-optical-depth 0.5.", MeshError)
        if not (isinstance(self.close_gaps, int) and 0 <= self.close_gaps <= 100):
            raise MeshError(
                explain(
                    "close_gaps",
                    expected="a whole number from 0 to 100",
                    got=self.close_gaps,
                    remedy="Pass --close-gaps 1.",
                )
            )
        if not 0.0 <= self.smallest_body <= 1.0:
            raise MeshError(
                explain(
                    "smallest_body",
                    expected="a share from 0 to 1",
                    got=self.smallest_body,
                    remedy="Pass --smallest-body 0.01.",
                )
            )
        if self.density_percentile is not None and not (
            np.isfinite(self.density_percentile) and 0.0 <= self.density_percentile <= 100.0
        ):
            raise MeshError(
                explain(
                    "density_percentile",
                    expected="a number from 0 to 100",
                    got=self.density_percentile,
                    remedy="Pass --density-percentile 90 to keep the densest tenth of the voxels.",
                )
            )
        if self.density_threshold is not None and not (
            np.isfinite(self.density_threshold) and self.density_threshold >= 0.0
        ):
            raise MeshError(
                explain(
                    "density_threshold",
                    expected="a finite number of at least 0, [1 / world unit]",
                    got=self.density_threshold,
                    remedy="Leave it out to select by --voxel-optical-depth.",
                )
            )


@dataclass(frozen=True)
class SolidCells:
    """The solid voxels and how they were found."""

    cells: npt.NDArray[np.bool_]
    """True where a voxel is solid, shape (nx-1, ny-1, nz-1); at least one is."""
    threshold: float
    """Density at voxel centres from which on a voxel counted as solid, [1 / world unit]."""
    num_closed: int
    """Voxels of gaps that were filled."""
    component_sizes: npt.NDArray[np.int64]
    """Voxels in each body after that, largest first; they touch by nothing, or (`largest_component`) by no face."""
    num_removed: int
    """Voxels dropped because their body is too small."""
    num_added: int
    """Voxels of enclosed cavities that were made solid."""


def select_solid(snapshot: GridSnapshot, selection: SolidSelection) -> SolidCells:
    """Choose the solid voxels of a trained field.

    A voxel's density is that at its centre. The percentile is taken over all voxels of the box. A voxel
    without density is never solid. Where more voxels tie at the threshold than were asked for (space that training
    never touched keeps its starting value), only the denser ones are taken, if there are any.

    Args:
        snapshot: The trained field on its corner lattice.
        selection: Threshold and what to do with floaters and cavities.

    Returns:
        The solid voxels, the threshold used and what was removed and added.

    Raises:
        MeshError: No voxel is solid, or density does not tell solid from empty.
    """
    density = snapshot.centre_density()
    if selection.density_threshold is not None:
        threshold = float(selection.density_threshold)
        cells = (density >= threshold) & (density > 0.0)
    elif selection.density_percentile is None:
        threshold = selection.voxel_optical_depth / snapshot.lattice.voxel_size
        cells = density >= threshold
    else:
        threshold = float(np.percentile(density, selection.density_percentile))
        cells = _densest(density, threshold, selection.density_percentile)
    if not cells.any():
        raise MeshError(
            explain(
                "solid voxels",
                expected=f"at least one voxel with density above 0 and at least the threshold {threshold:.6g}",
                got=f"none of {cells.size}; the highest density at a voxel centre is {density.max():.6g}",
                remedy="Train longer, or lower --voxel-optical-depth, --density-threshold or --density-percentile.",
            )
        )

    thresholded = int(cells.sum())
    cells = close_gaps(cells, selection.close_gaps)
    labels = face_connected(cells) if selection.largest_component else connected(cells)
    sizes = np.bincount(labels.ravel())[1:]
    before = int(cells.sum())
    if selection.largest_component and len(sizes) > 1:
        cells = labels == 1 + int(np.argmax(sizes))
    elif len(sizes) > 1:
        cells = np.concatenate(([False], sizes >= selection.smallest_body * sizes.max()))[labels]
    kept = int(cells.sum())
    if selection.fill_cavities:
        cells = fill_enclosed(cells)
    return SolidCells(
        cells=cells,
        threshold=threshold,
        num_closed=before - thresholded,
        component_sizes=np.sort(sizes)[::-1].astype(np.int64),
        num_removed=before - kept,
        num_added=int(cells.sum()) - kept,
    )


def face_connected(cells: npt.NDArray[np.bool_]) -> npt.NDArray[np.int32]:
    """Number the bodies whose voxels touch by faces: 1, 2, ... in C order of their first voxel, 0 elsewhere."""
    labels = np.zeros(cells.shape, dtype=np.int32)
    ndimage.label(cells, output=labels)
    return labels


def connected(cells: npt.NDArray[np.bool_]) -> npt.NDArray[np.int32]:
    """Number the bodies whose voxels touch by faces, edges or corners, as `face_connected` does."""
    labels = np.zeros(cells.shape, dtype=np.int32)
    ndimage.label(cells, structure=np.ones((3, 3, 3)), output=labels)
    return labels


def close_gaps(cells: npt.NDArray[np.bool_], by: int) -> npt.NDArray[np.bool_]:
    """Fill what a cube of 2 `by` + 1 voxels, made of empty voxels, cannot reach; nothing solid goes.

    >>> close_gaps(np.array([[[True, False, True]]]), 1)[0, 0].tolist()
    [True, True, True]
    """
    if by == 0:
        return cells
    # Where the box cuts the scene, what is solid goes on behind it.
    touching = np.ones((3, 3, 3), dtype=bool)
    grown = ndimage.binary_dilation(np.pad(cells, by, mode="edge"), touching, iterations=by)
    closed = ndimage.binary_erosion(grown, touching, iterations=by, border_value=1)
    return np.logical_or(closed[by:-by, by:-by, by:-by], cells)


def fill_enclosed(cells: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Make solid all empty voxels that have no way to the outside of the box through voxel faces.

    >>> cells = np.ones((3, 3, 3), dtype=bool)
    >>> cells[1, 1, 1] = False
    >>> bool(fill_enclosed(cells).all())
    True
    """
    empty = np.pad(~np.asarray(cells, dtype=bool), 1, constant_values=True)
    labels = face_connected(empty)
    return (labels != labels[0, 0, 0])[1:-1, 1:-1, 1:-1]


def _densest(density: npt.NDArray[np.float64], threshold: float, percentile: float) -> npt.NDArray[np.bool_]:
    """Voxels that make up the densest (100 - percentile) %, ties resolved as `select_solid` says."""
    if percentile > 0.0 and 0.0 < density.min() == density.max():
        raise MeshError(
            explain(
                "density",
                expected="some voxels denser than others",
                got=f"the same density {threshold:.6g} in all {density.size} voxels",
                remedy="Train longer, or pass --density-threshold to say from which density on a voxel is solid.",
            )
        )
    positive = density > 0.0
    reached = positive & (density >= threshold)
    denser = positive & (density > threshold)
    asked = np.ceil((1.0 - percentile / 100.0) * density.size) + 1
    too_many = np.count_nonzero(reached) > asked
    return denser if too_many and denser.any() else reached
