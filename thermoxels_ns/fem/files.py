"""A heat computation as files: one .vtu per output time and a .pvd that lists them."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

from thermoxels_ns.checks import replace_when_done, writable_folder
from thermoxels_ns.fem.solution import HeatSolution
from thermoxels_ns.mesh.files import write_vtu
from thermoxels_ns.mesh.tetrahedra import TetMesh

_STEP_PATTERN = "step-*.vtu"


def write_heat_series(pvd: Path | str, mesh: TetMesh, solution: HeatSolution) -> list[Path]:
    """Write ``NAME.pvd`` and ``NAME/step-0000.vtu`` and so on, which ParaView and pyvista open as one series.

    The .pvd is written last, so it never lists a file that is not there. Steps left over from a longer earlier
    series are removed.

    Args:
        pvd: Path of the index file.
        mesh: The body.
        solution: Temperatures on its nodes.

    Returns:
        All paths written, the .pvd first.
    """
    pvd = Path(pvd)
    writable_folder(pvd.parent)
    folder = writable_folder(pvd.with_suffix(""))
    steps = [folder / f"step-{number:04d}.vtu" for number in range(len(solution.times_s))]
    for path, temperature_c in zip(steps, solution.temperature_c):
        write_vtu(path, mesh, temperature_c=temperature_c)
    root = ElementTree.Element("VTKFile", type="Collection", version="0.1", byte_order="LittleEndian")
    collection = ElementTree.SubElement(root, "Collection")
    for path, time_s in zip(steps, solution.times_s):
        name = path.relative_to(pvd.parent).as_posix()
        ElementTree.SubElement(collection, "DataSet", timestep=repr(float(time_s)), part="0", file=name)
    ElementTree.indent(root)
    with replace_when_done(pvd) as temporary:
        ElementTree.ElementTree(root).write(temporary, encoding="utf-8", xml_declaration=True)
    for path in set(folder.glob(_STEP_PATTERN)) - set(steps):
        path.unlink()
    return [pvd, *steps]


def remove_heat_series(pvd: Path | str) -> None:
    """Remove a series written by `write_heat_series`, if there is one."""
    pvd = Path(pvd)
    pvd.unlink(missing_ok=True)
    folder = pvd.with_suffix("")
    for path in folder.glob(_STEP_PATTERN):
        path.unlink()
    if folder.is_dir() and not any(folder.iterdir()):
        folder.rmdir()
