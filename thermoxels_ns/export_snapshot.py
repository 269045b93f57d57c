"""From a trained field to the files of an export: mesh, heat series, pictures and summary.

Knows nothing of nerfstudio. Imports at the top are light; the mesher, the solver and pyvista load when they run.
"""

from __future__ import annotations

import platform
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import numpy.typing as npt

from thermoxels_ns import __version__
from thermoxels_ns.checks import check_positive, replace_when_done, writable_folder
from thermoxels_ns.errors import MeshError

if TYPE_CHECKING:
    from thermoxels_ns.fem.materials import Material
    from thermoxels_ns.fem.presets import HeatPreset
    from thermoxels_ns.fem.problem import TimeSteps
    from thermoxels_ns.fem.solution import HeatSolution
    from thermoxels_ns.mesh.quality import MeshQuality
    from thermoxels_ns.mesh.solid import SolidCells, SolidSelection
    from thermoxels_ns.mesh.tetrahedra import TetMesh
    from thermoxels_ns.snapshot import GridSnapshot

Say = Callable[[str], None]
Settings = TypeVar("Settings", "Material", "TimeSteps")

HEAT_SKIPPED = (
    "Heat step skipped: the size of the scene is not known. Pass --metres-per-unit, the length in metres of one unit "
    "of the input poses (1 if they are in metres)."
)
"""What an export without a scale says."""


@dataclass
class ExportOptions:
    """Everything an export can be told."""

    voxel_optical_depth: float = 0.5
    """Voxels in which density times edge length is at least this are solid: at 0.5, light that crosses one loses 39 %.
    Lower it if walls have holes, raise it if empty space turns solid."""
    density_percentile: float | None = None
    """Voxels denser than this share of all voxels of the scene box are solid, [%], 0 to 100; the Thermoxels paper's
    way, where 90 keeps the densest tenth. Takes the place of the optical depth."""
    density_threshold: float | None = None
    """Voxels at least this dense are solid, [1 / world unit]. Takes the place of both."""
    largest_component: bool = True
    """Keep only the largest body of voxels that touch by faces; the others are mostly floaters."""
    fill_cavities: bool = False
    """Make empty space solid where it has no way out through voxel faces. Off by default: a room is a cavity too."""
    metres_per_unit: float | None = None
    """Length of one unit of the input poses, [m]; 1 if the poses are in metres. Needed for heat: without it the mesh
    is written in units of the input and the heat step is skipped."""
    heat_preset: str = "concrete"
    """Material and time steps: the name of a preset, or the path of a yaml file like it."""
    steps: int | None = None
    """Number of time steps; the preset's by default (10 for concrete)."""
    step_seconds: float | None = None
    """Length of a time step, [s]; the preset's by default (60 for concrete)."""
    conductivity_w_mk: float | None = None
    """Thermal conductivity, [W / (m K)]; the preset's by default."""
    density_kg_m3: float | None = None
    """Mass density of the material, [kg / m3]; the preset's by default."""
    specific_heat_j_kgk: float | None = None
    """Specific heat capacity, [J / (kg K)]; the preset's by default."""
    pictures: bool = True
    """Write PNG pictures of the mesh coloured by temperature."""


@dataclass(frozen=True)
class Viewpoint:
    """How pictures look at the mesh, in the coordinates of the input poses."""

    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Direction that points up."""
    view_direction: tuple[float, float, float] | None = None
    """Direction from the camera to the mesh; None: obliquely from above."""


def check_options(options: ExportOptions) -> tuple[SolidSelection, HeatPreset]:
    """Check every option, so that a wrong one is refused before anything slow runs.

    Returns:
        Which voxels are solid, and the heat settings with the options' changes applied.

    Raises:
        ThermoxelsError: An option is out of range.
    """
    from thermoxels_ns.fem.presets import load_heat_preset
    from thermoxels_ns.mesh.solid import SolidSelection

    if options.metres_per_unit is not None:
        remedy = "Pass --metres-per-unit 1 if the input poses are in metres, or leave it out to skip heat."
        check_positive("metres_per_unit", options.metres_per_unit, remedy, MeshError)
    selection = SolidSelection(**{field.name: getattr(options, field.name) for field in fields(SolidSelection)})
    preset = load_heat_preset(options.heat_preset)
    material = _with_options(preset.material, options)
    if material != preset.material:
        material = replace(material, name=f"{material.name} (changed)")
    return selection, replace(preset, material=material, time=_with_options(preset.time, options))


def export_snapshot(
    snapshot: GridSnapshot,
    world_to_input: npt.NDArray[np.float64],
    options: ExportOptions,
    output_dir: Path | str,
    say: Say = lambda _: None,
    viewpoint: Viewpoint = Viewpoint(),
    compare: Callable[[SolidCells, TetMesh], dict[str, Any] | None] | None = None,
) -> dict[str, Any]:
    """Write mesh.vtu, summary.json, and as asked mesh.png, heat.pvd, heat/*.vtu and heat.png.

    Args:
        snapshot: The trained field.
        world_to_input: Takes homogeneous column vectors of the trained scene to the coordinates of the input poses,
            shape (4, 4). `options.metres_per_unit` takes those to metres.
        options: What to make.
        output_dir: Folder for the results; made if it does not exist.
        say: Called with one line of progress at a time.
        viewpoint: How pictures look at the mesh.
        compare: Compares solid voxels and mesh (in metres) with the truth of a scene that knows it; its answer goes
            into the summary under "truth". Asked only if the scale is known.

    Returns:
        The summary that summary.json holds.

    Raises:
        ThermoxelsError: An option is out of range, nothing is solid, the folder cannot be written to, or heat fails.
    """
    from thermoxels_ns.fem.files import remove_heat_series, write_heat_series
    from thermoxels_ns.fem.problem import HeatProblem
    from thermoxels_ns.fem.stepping import solve_heat
    from thermoxels_ns.mesh.build import build_voxel_mesh
    from thermoxels_ns.mesh.files import write_summary, write_vtu
    from thermoxels_ns.mesh.quality import check_mesh

    selection, preset = check_options(options)
    folder = writable_folder(output_dir)
    scale = np.diag([*[options.metres_per_unit or 1.0] * 3, 1.0])
    mesh, solid = build_voxel_mesh(snapshot, selection, scale @ world_to_input)
    quality = check_mesh(mesh)
    write_vtu(folder / "mesh.vtu", mesh)
    written = ["mesh.vtu"]
    unit = "input unit" if options.metres_per_unit is None else "m"
    say(f"Mesh: {quality.num_tets} tetrahedra, {quality.num_nodes} nodes, volume {quality.volume_m3:.6g} {unit}^3")
    if options.pictures:
        written += _mesh_pictures(folder, mesh, viewpoint, unit)

    if options.metres_per_unit is None:
        say(HEAT_SKIPPED)
        remove_heat_series(folder / "heat.pvd")
        (folder / "heat.png").unlink(missing_ok=True)
        heat: dict[str, Any] = {"computed": False, "reason": HEAT_SKIPPED}
    else:
        time = preset.time
        say(f"Heat: {time.steps} steps of {time.step_seconds:g} s through {preset.material.name}")
        solution = solve_heat(HeatProblem(mesh, preset.material), time)
        paths = write_heat_series(folder / "heat.pvd", mesh, solution)
        written += [path.relative_to(folder).as_posix() for path in paths]
        heat = _heat_summary(preset, solution)
        say(f"Heat: {solution.status} Energy conserved to {solution.energy_residual:.1e}.")
        if options.pictures:
            written += _heat_picture(folder, mesh, solution, viewpoint)

    truth = compare(solid, mesh) if compare is not None and options.metres_per_unit is not None else None
    if truth is not None:
        say("Against the truth: " + ", ".join(f"{name} {_short(value)}" for name, value in truth.items()))
    summary = {
        "options": {field.name: getattr(options, field.name) for field in fields(options)},
        "versions": _versions(),
        "length_unit": unit,
        "mesh": _mesh_summary(mesh, solid, quality),
        "heat": heat,
        **({} if truth is None else {"truth": truth}),
        "files": [*written, "summary.json"],
    }
    write_summary(folder / "summary.json", summary)
    say(f"Written to {folder}: {', '.join(name for name in summary['files'] if '/' not in name)}")
    return summary


def _with_options(preset: Settings, options: ExportOptions) -> Settings:
    """Replace a preset's values by the options of the same name that were given."""
    given = {field.name: getattr(options, field.name, None) for field in fields(preset)}
    return replace(preset, **{name: value for name, value in given.items() if value is not None})


def _mesh_pictures(folder: Path, mesh: TetMesh, viewpoint: Viewpoint, unit: str) -> list[str]:
    """Draw the mesh twice: all temperatures, and with grey where no thermal ray measured one."""
    from thermoxels_ns.mesh.pictures import picture_of_mesh

    look: Any = {"up": viewpoint.up, "view_direction": viewpoint.view_direction, "length_unit": unit}
    picture_of_mesh(folder / "mesh.png", mesh, title="Surface temperature", **look)
    picture_of_mesh(
        folder / "mesh-measured.png", mesh, title="Measured surface temperature", grey_unobserved=True, **look
    )
    return ["mesh.png", "mesh-measured.png"]


def _heat_picture(folder: Path, mesh: TetMesh, solution: HeatSolution, viewpoint: Viewpoint) -> list[str]:
    """Draw the temperatures before and after side by side, in one range of colours."""
    import tempfile

    from PIL import Image

    from thermoxels_ns.mesh.pictures import picture_of_mesh

    shown = np.unique(mesh.facets)
    before, after = solution.temperature_c[0], solution.temperature_c[-1]
    values = np.concatenate([before[shown], after[shown]])
    clim = (float(values.min()), float(values.max()))
    panels = []
    with tempfile.TemporaryDirectory() as scratch:
        for name, temperature_c, time_s in (
            ("before", before, solution.times_s[0]),
            ("after", after, solution.times_s[-1]),
        ):
            path = Path(scratch) / f"{name}.png"
            title = f"Surface temperature at {time_s:g} s"
            look: Any = {"up": viewpoint.up, "view_direction": viewpoint.view_direction}
            picture_of_mesh(path, mesh, temperature_c, title=title, clim=clim, **look)
            with Image.open(path) as image:
                panels.append(image.convert("RGB"))
    both = Image.new("RGB", (sum(p.width for p in panels), max(p.height for p in panels)), "white")
    both.paste(panels[0], (0, 0))
    both.paste(panels[1], (panels[0].width, 0))
    with replace_when_done(folder / "heat.png") as temporary:
        both.save(temporary)
    return ["heat.png"]


def _mesh_summary(mesh: TetMesh, solid: SolidCells, quality: MeshQuality) -> dict[str, Any]:
    """Counts and sizes, lengths in the unit that the summary names."""
    temperature = mesh.temperature_c
    return {
        "nodes": quality.num_nodes,
        "tets": quality.num_tets,
        "voxels": int(np.count_nonzero(solid.cells)),
        "boundary_triangles": quality.num_facets,
        "boundary_triangles_on_box": quality.num_box_facets,
        "non_manifold_edges": quality.num_non_manifold_edges,
        "volume": quality.volume_m3,
        "area": quality.area_m2,
        "bounds": {"lower": mesh.points_m.min(axis=0), "upper": mesh.points_m.max(axis=0)},
        "dihedral_angles_deg": {"min": quality.min_dihedral_deg, "max": quality.max_dihedral_deg},
        "density_threshold_used": solid.threshold,
        "component_sizes_voxels": solid.component_sizes,
        "voxels_removed": solid.num_removed,
        "share_of_nodes_observed": float(np.mean(mesh.observed)),
        "temperature_c": {
            "min": float(temperature.min()),
            "max": float(temperature.max()),
            "mean_of_nodes": float(temperature.mean()),
        },
    }


def _heat_summary(preset: HeatPreset, solution: HeatSolution) -> dict[str, Any]:
    """The heat balance and how it was computed."""
    return {
        "computed": True,
        **preset.as_mapping(),
        "scheme": "P1 tetrahedra, lumped mass, backward Euler, conjugate gradients with Jacobi preconditioner",
        "energy_before_j": float(solution.heat_content_j[0]),
        "energy_after_j": float(solution.heat_content_j[-1]),
        "energy_residual": solution.energy_residual,
        "energy_residual_of_spread": solution.energy_residual_of_spread,
        "largest_net_heat_flow_w": float(np.abs(solution.heat_w).max()),
        "temperature_c": {
            name: {"min": float(state.min()), "max": float(state.max())}
            for name, state in (("before", solution.temperature_c[0]), ("after", solution.temperature_c[-1]))
        },
        "status": solution.status,
        "iterations": solution.iterations,
        "skipped_effects": solution.skipped_effects,
    }


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _versions() -> dict[str, str]:
    packages = ("numpy", "scipy", "torch", "nerfstudio", "pyvista", "scikit-fem")
    return {"thermoxels": __version__, "python": platform.python_version()} | {name: version(name) for name in packages}
