"""Everything that ``thermoxels audit`` can be told."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro


@dataclass
class AuditOptions:
    """Everything that an audit can be told."""

    mesh: tyro.conf.Positional[Path | None] = None
    """The mesh.vtu of an export with a known scale; mesh-boundary.vtp lies beside it."""
    conditions: Path | None = None
    """Conditions of the survey, a yaml file: air inside and outside, wind, sky, emissivities, camera, each with +-."""
    output_dir: Path = Path("audit")
    """Folder for the results; made if it does not exist. Those of an earlier audit in it are replaced."""
    write_conditions: Path | None = None
    """Write an example of conditions to this file, every key explained, and do nothing else."""
    up: tuple[float, float, float] | None = None
    """Direction that points up in the coordinates of the mesh. Default: that of the export's summary.json beside the
    mesh, or else z."""
    scene: Path | None = None
    """Folder of the photographs that the mesh was made from, the --data of the training: the page then shows each
    defect in the photograph and thermal image that show it best."""
    pictures: bool = True
    """Draw pictures for the page."""
