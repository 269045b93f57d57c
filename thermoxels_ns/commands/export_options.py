"""Options of a mesh export, and how its pictures look at the mesh."""

from __future__ import annotations

# Imports at the top are light: nerfstudio's exporter reads the options for ``--help`` of every subcommand.
import math
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeVar

from thermoxels_ns.core.errors import HeatError, MeshError
from thermoxels_ns.data.scene_scale import (
    SceneScale,
    choose_scale,
    scale_from_known_distance,
    scale_from_option,
    up_from_scene_file,
)

if TYPE_CHECKING:
    from collections.abc import Mapping
    from typing import Any

    from thermoxels_ns.fem.problem import TimeSteps
    from thermoxels_ns.heat.materials import Material
    from thermoxels_ns.heat.scene import HeatScene
    from thermoxels_ns.mesh.boundary.patches import PatchRules
    from thermoxels_ns.mesh.solid.voxels import SolidSelection

Settings = TypeVar("Settings", "Material", "TimeSteps")
Vector = tuple[float, float, float]
FormatName = Literal["vtu", "xdmf", "msh", "inp", "stl", "ply", "glb"]


@dataclass
class ExportOptions:
    """Everything an export can be told."""

    boundary: Literal["conforming", "voxel"] = "conforming"
    """conforming: the boundary follows the level set of the density; voxel: it follows voxel faces, as in the
    Thermoxels paper, and every boundary triangle says how much true surface it stands for."""
    voxel_optical_depth: float | None = None
    """Voxels in which density times edge length is at least this are solid: at 0.5, light that crosses one loses 39 %.
    Lower it if walls have holes, raise it if empty space turns solid. Left out, the threshold is automatic: the
    highest that 95 % of the training rays that end on something meet within half a voxel of where they end."""
    density_percentile: float | None = None
    """Voxels denser than this share of all voxels of the scene box are solid, [%], 0 to 100; the Thermoxels paper's
    way, where 90 keeps the densest tenth. Takes the place of the optical depth."""
    density_threshold: float | None = None
    """Voxels at least this dense are solid, [1 / world unit]. Takes the place of both."""
    close_gaps: int = 1
    """Fill gaps and pinholes up to twice this many voxels wide; thin walls are not continuous without it. 0: none."""
    region: Literal["auto", "all"] = "auto"
    """Which part is exported. auto: what photographs show about as well as what they were taken of, an object with its
    table, a house with the ground around it, a room with its walls; without bodies below 1 % of the largest, which are
    mostly floaters. all: everything that was reconstructed."""
    region_box: tuple[float, float, float, float, float, float] | None = None
    """In place of auto, what lies in a box in the coordinates of the input poses, xmin ymin zmin xmax ymax zmax."""
    region_near: tuple[float, float, float, float] | None = None
    """In place of auto, what lies near a point in the coordinates of the input poses, x y z radius."""
    interior: Literal["solid", "hollow"] = "solid"
    """What becomes of the inside of a body of which photographs only show the shell. solid: it is filled; a cavity with
    a camera in it is a room and stays empty. hollow: the shell alone, as thick as the photographs happened to make
    it."""
    seal_openings: int = 2
    """While looking for the inside, openings in the shell up to twice this many voxels wide count as closed."""
    wall_thickness: float | None = None
    """For facades seen from one side: make the seen surface this thick, [m], growing away from the cameras. Takes the
    place of filling the interior."""
    coarsest_cell: int = 4
    """Edge of the largest cells deep inside a conforming mesh, a power of two, [voxels]; 1: as fine as the surface."""
    patches: Path | None = None
    """A yaml file that names parts of the surface and regions of the volume by box, plane or colour; see
    configs/patches-example.yaml."""
    metres_per_unit: float | None = None
    """Length of one unit of the input poses, [m]; 1 if the poses are in metres. Needed for heat, unless the scene's
    json has metres_per_unit: without a scale the mesh is written in units of the input, without heat."""
    up: tuple[float, float, float] | None = None
    """Direction that points up, in the coordinates of the input poses; it decides which patches face up, down or
    sideways. Left out: that of the scene's json, else from the cameras, whose pictures people hold level."""
    known_distance: tuple[float, float, float, float, float, float, float] | None = None
    """In place of metres per unit: two points in the coordinates of the input poses and the distance between them,
    x y z x y z metres."""
    known_distance_error: float | None = None
    """Standard error of that distance, with what the two points may be off, [m]; the summary then says how well areas
    and volumes are known."""
    formats: tuple[FormatName, ...] = ("vtu", "glb")
    """Files to write the mesh to: vtu (ParaView), xdmf (FEniCSx), msh (Gmsh), inp (CalculiX, Abaqus), stl, ply
    (surface), glb (browsers, phones)."""
    heat_preset: str = "concrete"
    """Heat scene of the heat step, of one material and with equal steps: the name of one of configs/scene-NAME.yaml, or
    the path of a yaml file. concrete: a body of concrete that is left to itself. The file for CalculiX and Abaqus takes
    material and steps from it, not what acts on the body."""
    steps: int | None = None
    """Number of time steps; the scene's by default (10 for concrete)."""
    step_seconds: float | None = None
    """Length of a time step, [s]; the scene's by default (60 for concrete)."""
    conductivity_w_mk: float | None = None
    """Thermal conductivity, [W / (m K)]; the scene's by default."""
    density_kg_m3: float | None = None
    """Mass density of the material, [kg / m3]; the scene's by default."""
    specific_heat_j_kgk: float | None = None
    """Specific heat capacity, [J / (kg K)]; the scene's by default."""
    pictures: bool = True
    """Write PNG pictures of the mesh coloured by temperature, and of its quality."""


@dataclass(frozen=True)
class Viewpoint:
    """How pictures look at the mesh, in the coordinates of the input poses."""

    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Direction that points up."""
    up_source: str = "Up is assumed to be z."
    """How it was found."""
    view_direction: tuple[float, float, float] | None = None
    """Direction from the camera to the mesh; None: obliquely from above."""


@dataclass(frozen=True)
class CheckedOptions:
    """What the options say, once they are known to be in range."""

    selection: SolidSelection
    scene: HeatScene
    """The scene of the heat step with the options' changes applied."""
    material: Material
    """What it says the body is made of."""
    time: TimeSteps
    """How long it says the body is followed."""
    rules: PatchRules
    distance: SceneScale | None
    """The scale that the known distance gives."""


def check_options(options: ExportOptions) -> CheckedOptions:
    """Check every option, so that a wrong one is refused (`ThermoxelsError`) before anything slow runs."""
    from thermoxels_ns.mesh.boundary.patches import PatchRules, load_patch_rules
    from thermoxels_ns.mesh.build import MeshOptions
    from thermoxels_ns.mesh.solid.voxels import SolidSelection

    if options.metres_per_unit is not None:
        scale_from_option(options.metres_per_unit)
    distance = None
    if options.known_distance is not None:
        first, second, length = options.known_distance[:3], options.known_distance[3:6], options.known_distance[6]
        distance = scale_from_known_distance(first, second, length, options.known_distance_error)
    elif options.known_distance_error is not None:
        remedy = "Pass --known-distance x y z x y z metres, or leave the error out."
        raise MeshError("known_distance_error", expected="--known-distance beside it", got="none", remedy=remedy)
    choose_scale(options.metres_per_unit, distance)
    if not options.formats or len(set(options.formats)) < len(options.formats):
        remedy = "Pass --formats vtu glb, for example."
        raise MeshError("formats", expected="at least one format, each once", got=options.formats, remedy=remedy)
    MeshOptions(options.boundary, options.coarsest_cell)  # refuses what is out of range
    selection = SolidSelection(**{field.name: getattr(options, field.name) for field in fields(SolidSelection)})
    rules = PatchRules() if options.patches is None else load_patch_rules(options.patches)
    return CheckedOptions(selection, *_heat_settings(options), rules, distance)


def scale_of(options: ExportOptions, checked: CheckedOptions, scene_file: Mapping | None) -> SceneScale | None:
    """The scale of an export: what the user gives, else what the scene's json says; None if nobody does.

    Raises `ThermoxelsError` for a scale out of range, or for a format or option that needs one where there is none.
    """
    scale = choose_scale(options.metres_per_unit, checked.distance, scene_file)
    needs = [f"--formats {name}" for name in ("inp",) if name in options.formats]
    needs += ["--wall-thickness"] if options.wall_thickness is not None else []
    needs += ["--patches"] if options.patches is not None else []
    if scale is None and needs:
        remedy = "Pass --metres-per-unit, or --known-distance."
        got = "none in the options or in the scene's json"
        raise MeshError("scale", expected=f"a scene whose scale is known, for {needs[0]}", got=got, remedy=remedy)
    return scale


def up_of(options: ExportOptions, scene_file: Mapping[str, Any] | None, viewpoint: Viewpoint) -> tuple[Vector, str]:
    """Up, a unit vector, and where it comes from: the user, else the scene's json, else the cameras."""
    if options.up is not None:
        length = math.sqrt(sum(value * value for value in options.up))
        if not (math.isfinite(length) and length > 0.0):
            raise MeshError("up", expected="a direction", got=options.up, remedy="Pass --up 0 0 1, for example.")
        x, y, z = (value / length for value in options.up)
        return (x, y, z), "Given with --up."
    in_file = up_from_scene_file(scene_file or {})
    if in_file is not None:
        return in_file, "From the scene's json."
    return viewpoint.up, viewpoint.up_source


def _heat_settings(options: ExportOptions) -> tuple[HeatScene, Material, TimeSteps]:
    """The scene of the heat step, its material and its steps, with the options' changes applied."""
    from thermoxels_ns.fem.problem import TimeSteps
    from thermoxels_ns.heat.scene import load_heat_scene

    scene = load_heat_scene(options.heat_preset)
    given, *others = set(scene.materials.values())
    if others or not isinstance(scene.time, TimeSteps):
        expected = "a scene of one material, with time: {steps: 10, step_seconds: 60}"
        remedy = "Export without it, then run thermoxels heat with that scene on the mesh."
        raise HeatError("heat_preset", expected=expected, got=options.heat_preset, remedy=remedy)
    material, time = _with_options(given, options), _with_options(scene.time, options)
    if material != given:
        material = replace(material, name=f"{material.name} (changed)")
    return replace(scene, materials=dict.fromkeys(scene.materials, material), time=time), material, time


def _with_options(settings: Settings, options: ExportOptions) -> Settings:
    """Replace values by the options of the same name that were given."""
    given = {field.name: getattr(options, field.name, None) for field in fields(settings)}
    return replace(settings, **{name: value for name, value in given.items() if value is not None})
