"""Propose patches of a mesh: a yaml file for ``--patches``, and a picture in which each patch has its name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.core.checks import writable_folder
from thermoxels_ns.core.errors import AuditError
from thermoxels_ns.mesh.boundary.patches import Vector, with_patches, write_patch_rules
from thermoxels_ns.mesh.boundary.planes import find_building, proposed_rules
from thermoxels_ns.mesh.tetrahedra import TetMesh
from thermoxels_ns.reports.mesh_pictures import image_of_surface, write_picture

_COLOURS = {"wall": "tan", "roof": "indianred", "window": "deepskyblue", "door": "saddlebrown", "ground": "yellowgreen"}


def propose_patches(path: Path, mesh: TetMesh, up: Vector, north: Vector, say: Callable[[str], None]) -> None:
    """Find the flat elements of a building, write them as rules to `path`, and draw them in a PNG file beside it.

    Raises `AuditError` if one of the files exists already, `MeshError` if no planes of the mesh enclose a body.
    """
    picture = path.with_suffix(".png")
    for one in (path, picture):
        if one.exists() or path == picture:
            remedy = "Choose another name with --write-patches, such as patches.yaml."
            got = f"{one}, which is there" if one.exists() else f"{one}, the name of the picture"
            raise AuditError("write_patches", expected="a name of a yaml file that is free", got=got, remedy=remedy)
    building = find_building(mesh, up, north)
    rules = proposed_rules(building)
    tagged, _ = with_patches(mesh, rules, up)
    assert tagged.boundary is not None
    patch, names = tagged.boundary.patch, tagged.boundary.patch_names
    areas = ", ".join(f"{one.name} {one.net_area_m2:.1f}" for one in building.every() if len(one.facets))
    say(f"Found, [m2]: {areas}. {100 * building.left_out:.0f} % of the volume stands out from walls or is not flat.")
    writable_folder(path.parent)
    at, views = tagged.points_m[tagged.facets].mean(axis=1), []
    normals = {one.name: one.normal for one in building.every()}
    kinds = np.array([name.split("-")[0] for name in names])[patch]
    painted = [(kind, colour, kinds == kind) for kind, colour in _COLOURS.items()]
    painted.append(("no patch", "lightgrey", ~np.isin(kinds, [*_COLOURS])))
    for title, towards in (("south and east", (-0.7, 0.9, -0.55)), ("north and west", (0.7, -0.9, -0.55))):
        direction, labels = building.axes @ towards, list[tuple[str, FloatArray]]()
        for number in np.unique(patch).tolist():
            on, normal = at[patch == number], normals.get(names[number])
            if normal is not None and normal @ towards < 0.0:
                labels.append((names[number], on.mean(axis=0)))
            elif names[number] == "ground":  # its middle may be under the house
                labels.append(("ground", on[np.argsort(on @ direction)[len(on) // 50]]))
        look = {"up": up, "view_direction": direction, "painted": painted, "labels": labels}
        shape = mesh.points_m, mesh.facets, mesh.temperature_c
        views.append(image_of_surface(*shape, title=f"Proposed patches, from {title}", **look))
    write_patch_rules(path, rules, "Proposed by thermoxels audit; see the picture beside, correct and rename.")
    write_picture(picture, np.concatenate(views, axis=1))
    say(f"Written to {path} and {picture}: look at the picture, correct the file, and pass it with --patches.")
