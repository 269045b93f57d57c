"""Everything that ``thermoxels heat`` can be told."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro


@dataclass
class HeatOptions:
    """Everything that a heat run can be told."""

    mesh: tyro.conf.Positional[Path]
    """The mesh.vtu of an export with a known scale; mesh-boundary.vtp lies beside it."""
    scene: str
    """Heat scene: the path of a yaml file, or the name of one of configs/scene-NAME.yaml, such as winter-night."""
    output_dir: Path = Path("heat")
    """Folder for the results; made if it does not exist. Those of an earlier run in it are replaced."""
    probes: tuple[tuple[float, float, float], ...] = ()
    """Points whose temperature is followed, x y z in the coordinates of the mesh, one after the other, [m]."""
    tolerance: float | None = None
    """Largest error that any temperature may have, [K], such as 0.05. Linear or quadratic tetrahedra, the mesh size and
    the time steps are then chosen so that the estimated error meets it; of the scene's time settings only
    the duration and the times at which temperatures are kept remain. The error is that of the heat equation in the
    body as the mesh describes it. Left out: the mesh as it is, with the scene's own steps; of a steady state the error
    is estimated all the same."""
    flow_tolerance: float | None = None
    """Largest error that the mean heat flow of any effect may have, as a share of all heat that flows through the body,
    such as 0.01; alone or beside --tolerance, without which a scene with a duration cannot do."""
    memory_gb: float = 4.0
    """Most memory that solving may take, [GiB]. What needs more is refused before any of it is taken."""
    allow_unmet: bool = False
    """If a tolerance cannot be met within the memory, write the best that fits and say so, instead of an error.
    Through time the first estimate needs room for a mesh of half the size."""
    leave_out_below_k: float | None = None
    """Effects that together can change no temperature by more than this are left out, [K]; the report lists each with
    its bound. 0 builds all that brings heat; so do meshes with obtuse angles, as exports are, and --flow-tolerance.
    Left out: a fifth of --tolerance, which counts against it, or 0.01 without one (a fifth of the default tolerance of
    the time steps), and what may change a mean heat flow by more than 1 % of all heat that flows is built, too."""
    up: tuple[float, float, float] | None = None
    """Direction that points up in the coordinates of the mesh, if the scene does not say. Default: that of the
    export's summary.json beside the mesh, or else z."""
    pictures: bool = True
    """Draw pictures of the surface."""
