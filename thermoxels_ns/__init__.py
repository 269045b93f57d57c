"""RGB and thermal photographs to a 3D model that a finite-element solver can run on.

Photographs become a trained run by ``ns-train thermoxels --data FOLDER``. In Python, the rest is five lines::

    import thermoxels_ns

    scene = thermoxels_ns.load("outputs/house/thermoxels/run")          # temperature_c, density, points: arrays
    mesh = scene.mesh(interior="hollow")                                # a pyvista object
    heat = thermoxels_ns.solve(mesh, "winter-night")                    # heat flows, U-value, temperatures
    found = thermoxels_ns.audit(mesh, "conditions.yaml")                # losses and U-values as intervals

`load` returns a `Scene`, whose arrays lie on the corners of voxels. `Scene.mesh` and `to_pyvista` return a mesh as a
pyvista MultiBlock of "body" and "boundary"; `solve` and `audit` also take any pyvista grid of tetrahedra with a point
array `temperature_c`, in metres, and the path of an export's mesh.vtu. What `solve` and `audit` return are dataclasses
with `to_frame()` (pandas) and `to_pyvista()`; all of it can be pickled. No function writes a file or prints. A mistake
of the input is raised as a `ThermoxelsError` that says what was expected, what was got, and what to do.

Temperatures are degrees Celsius, lengths metres, heat flows watts, positive into the body (in an audit: positive from
inside to outside). The command line has the same steps: ``ns-export thermoxels-mesh``, ``thermoxels heat``,
``thermoxels audit``. More: docs/python.md and docs/notebook.ipynb.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from thermoxels_ns.core.version import __version__

if TYPE_CHECKING:
    from thermoxels_ns.api import Scene, ThermoxelsError, load, solve, to_pyvista
    from thermoxels_ns.audit.run import audit_mesh as audit

__all__ = ["Scene", "ThermoxelsError", "__version__", "audit", "load", "solve", "to_pyvista"]


if not TYPE_CHECKING:  # a type checker that saw it would take every name for one of ours

    def __getattr__(name: str) -> Any:
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        if name == "audit":
            return import_module("thermoxels_ns.audit")  # a package that can be called
        return getattr(import_module("thermoxels_ns.api"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
