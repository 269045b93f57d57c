"""The command ``ns-export thermoxels-mesh``: make a mesh from a trained model and let heat flow through the mesh."""

from __future__ import annotations

# Only light imports at the top: nerfstudio's exporter reads this module for ``--help`` of every subcommand.
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from threadpoolctl import threadpool_limits

from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.core.checks import check_direction, remove_file, result_folder
from thermoxels_ns.core.config_loader import check_run
from thermoxels_ns.core.errors import CheckpointError, HeatError, MeshError, SceneError, ThermoxelsError, exit_status
from thermoxels_ns.core.json_values import plain_values, read_json_object, write_json
from thermoxels_ns.core.lattice import Lattice, input_from_world
from thermoxels_ns.data.scene_scale import (
    SceneScale,
    choose_scale,
    scale_from_known_distance,
    up_from_scene_file,
)

if TYPE_CHECKING:
    from nerfstudio.engine.trainer import TrainerConfig

    from thermoxels_ns.core.feature_rays import FeatureRays
    from thermoxels_ns.core.snapshot import GridSnapshot
    from thermoxels_ns.fem.problem import TimeSteps
    from thermoxels_ns.heat.materials import Material
    from thermoxels_ns.heat.scene import HeatScene
    from thermoxels_ns.mesh.boundary.patches import PatchRules
    from thermoxels_ns.mesh.build import BuiltMesh
    from thermoxels_ns.mesh.solid.voxels import SolidCells, SolidSelection
    from thermoxels_ns.mesh.tetrahedra import TetMesh
    from thermoxels_ns.multiview.stereo import Depths

Say = Callable[[str], None]
Compare = Callable[["SolidCells", "TetMesh", float], "dict[str, Any] | None"]
"""Compares solid voxels and a mesh with the exact scene, given the metres per unit; None if no exact scene is known."""

_SUMMARY, _HEAT, _QUALITY, _HEAT_PICTURE = "summary.json", "heat.pvd", "quality.json", "heat.png"
_MESH_PICTURES = ("mesh.png", "mesh-measured.png", "region.png", "support.png")
HEAT_SKIPPED = (
    "Heat step skipped: the size of the scene is not known. Pass --metres-per-unit, the length in metres of one unit "
    "of the input poses (1 if they are in metres), or --known-distance."
)
NO_START = (
    "Heat step skipped: photographs alone tell no temperature to start from. Pass --heat-preset a yaml file of a scene "
    "with initial: {temperature_c: 15}, for example, or run thermoxels heat with such a scene on the mesh."
)
INNER_SIDE = (
    "The exact scene is filled, so the inner side of a shell or a wall counts as wrong surface in precision, fscore "
    "and mean distance; precision_seen and fscore_seen are those of the side that photographs show."
)
"""Note on the comparison with the truth for meshes that are hollow or have a given wall thickness."""


@dataclass
class ExportOptions:
    """All options of an export that do not name files or folders of its input and output."""

    boundary: Literal["conforming", "voxel"] = "conforming"
    """conforming: the boundary follows the level set of the density. voxel: the boundary follows voxel faces, as in the
    Thermoxels paper, with up to 1.7 times the area of a slanted surface."""
    density_threshold: float | None = None
    """Voxels at least this dense are solid, [1 / world unit]; summary.json says which density was used. Lower it if
    walls have holes, raise it if empty space turns solid. Left out, it is automatic: the highest that 95 % of the
    training rays that end on a surface meet within half a voxel of their end."""
    density_percentile: float | None = None
    """Voxels are solid if they are denser than this share of all voxels of the scene box, [%], 0 to 100; in the
    Thermoxels paper 90 keeps the densest tenth."""
    close_gaps: int = 1
    """Fill gaps and pinholes up to twice this many voxels wide, which thin walls need to be continuous. 0: none."""
    region: Literal["auto", "all"] = "auto"
    """Part of the reconstruction to export. auto: all that photographs show about as well as their main subject, such
    as an object with its table, a house with the ground around, a room with its walls; bodies below 1 % of the largest,
    mostly floaters, are left out. all: everything that was reconstructed."""
    region_box: tuple[float, float, float, float, float, float] | None = None
    """In place of auto: export the inside of a box, xmin ymin zmin xmax ymax zmax in coordinates of the input poses."""
    region_near: tuple[float, float, float, float] | None = None
    """In place of auto: export the inside of a ball, x y z radius in the coordinates of the input poses."""
    interior: Literal["solid", "hollow"] = "solid"
    """Treatment of the inside of a body if photographs show only its shell. solid: the inside is filled, but a cavity
    that holds a camera is a room and stays empty. hollow: only the shell is exported, with the thickness that training
    happened to give the shell; with --wall-thickness it is closed, as by a floor, where no camera looks."""
    wall_thickness: float | None = None
    """For facades seen from one side: make the seen surface this thick, [m], growing away from the cameras; the
    interior is then not filled."""
    patches: Path | None = None
    """A yaml file that names parts of the surface and regions of the volume by box, plane or colour; see
    configs/patches-example.yaml."""
    metres_per_unit: float | None = None
    """Length of one unit of the input poses, [m]; 1 if the poses are in metres. Needed for heat, unless the scene's
    json has metres_per_unit. Without a scale the mesh is written in units of the input, and no heat is computed."""
    up: tuple[float, float, float] | None = None
    """Direction that points up, in the coordinates of the input poses; decides which patches face up, down or sideways.
    Left out: the direction in the scene's json, or else a direction computed from the cameras, taken as held level."""
    known_distance: tuple[float, float, float, float, float, float, float] | None = None
    """In place of metres per unit: two points in the coordinates of the input poses and the distance between the two,
    x y z x y z metres."""
    known_distance_error: float | None = None
    """Standard error of the known distance, including the position errors of the two points, [m]; the summary then
    states the standard errors of area and volume."""
    formats: tuple[Literal["vtu", "xdmf", "msh", "inp", "stl", "ply", "glb"], ...] = ("vtu", "glb")
    """Files to write the mesh to: vtu (ParaView), xdmf (FEniCSx), msh (Gmsh), inp (CalculiX, Abaqus), stl, ply
    (surface), glb (browsers, phones)."""
    heat_preset: str = "concrete"
    """Heat scene with one material and equal time steps: the NAME of a configs/scene-NAME.yaml, or the path of a yaml
    file. concrete: a body of concrete on which nothing acts. The file for CalculiX and Abaqus takes material and time
    steps from the heat scene, but none of its effects."""
    steps: int | None = None
    """Number of time steps. Left out: as in the heat scene (10 for concrete)."""
    step_seconds: float | None = None
    """Length of a time step, [s]. Left out: as in the heat scene (60 for concrete)."""
    vtk_times: Literal["all"] | tuple[float, ...] = ()
    """Times whose temperatures are written for ParaView beside those of the start and of the end, [s]: for each the
    nearest time that the scene keeps. all: every kept time; each takes as much space as the mesh."""
    pictures: bool = True
    """Write PNG pictures of the mesh coloured by temperature, and of how photographs support its surface."""


@dataclass(frozen=True)
class Viewpoint:
    """Direction from which pictures show the mesh, in the coordinates of the input poses."""

    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Direction that points up."""
    up_source: str = "Up is assumed to be z."
    """Sentence that says how `up` was found."""
    view_direction: tuple[float, float, float] | None = None
    """Direction from the picture's camera to the mesh; None: obliquely from above."""


class CheckedOptions(NamedTuple):
    """Settings made from `ExportOptions` whose values are in range; result of `check_options`."""

    selection: SolidSelection
    rules: PatchRules
    distance: SceneScale | None  # Scale that follows from the known distance; None without a known distance
    scene: HeatScene  # Heat scene of the preset, with the changes that options make
    material: Material  # Material of `scene`
    time: TimeSteps  # Time steps of `scene`


@dataclass(frozen=True)
class TrainedScene:
    """A trained field, and what else an export needs from the training run."""

    snapshot: GridSnapshot
    world_to_input: FloatArray
    """Matrix from homogeneous coordinates of the trained scene to coordinates of the input poses, shape (4, 4)."""
    viewpoint: Viewpoint  # View for pictures, chosen by `viewpoint_of_cameras`
    scene_folder: Path  # Path that training took as its scene: a folder, or a json file in a folder
    dataset: Any  # Training photographs, a `ThermalDataset`
    tracks: FeatureRays | None  # Lines from photographs to points that the photographs show, in the trained scene
    corrections: dict[str, Any]  # Result of `ThermoxelsPipeline.corrections`


@dataclass(kw_only=True)
class ExportThermoxelsMesh(ExportOptions):
    """Export a tetrahedral mesh with temperatures from a trained Thermoxels model, and let heat flow through it."""

    load_config: Path
    """The config.yml that ns-train wrote."""
    output_dir: Path
    """Folder for the results; made if it does not exist."""

    def main(self) -> None:
        """Run the export; a `ThermoxelsError` is printed as one sentence, and ends with `errors.exit_status`."""
        from nerfstudio.utils.rich_utils import CONSOLE
        from rich.markup import escape

        try:
            # With more BLAS threads, the last bits of results would depend on the number of threads.
            with threadpool_limits(1, "blas"):
                self.run(lambda line: CONSOLE.print(escape(line)))
        except ThermoxelsError as problem:
            CONSOLE.print(f"[bold red]Error:[/bold red] {escape(str(problem))}")
            raise SystemExit(exit_status(problem)) from None

    def run(self, say: Say) -> dict[str, Any]:
        """Run the export and return the summary that summary.json holds, or raise `ThermoxelsError`."""
        checked = check_options(self)
        prepare_folder(self.output_dir)
        say(f"Loading {self.load_config}")

        def check_scale(scene_folder: Path) -> None:
            """Raise `ThermoxelsError` early for a wrong scale or up, or for an option that lacks a scale."""
            try:
                content = scene_json(scene_folder)
            except SceneError:
                return  # the reader of the scene reports the error
            if content or scene_folder.is_dir():
                scale_of(self, checked, content)
                up_of(self, content, Viewpoint())

        scene = load_trained_scene(self.load_config, check_scale)
        from thermoxels_ns.multiview.evidence import depths_of_dataset

        def compare(solid: SolidCells, mesh: TetMesh, scale: float) -> dict[str, Any] | None:
            from thermoxels_ns.evaluation.truth_comparison import compare_with_truth

            truth = scene.world_to_input, scene.scene_folder
            return compare_with_truth(solid.cells, lattice, *truth, mesh, scale, within=solid.within)

        lattice = scene.snapshot.lattice
        depths = depths_of_dataset(scene.dataset, 0.0, lattice.lo, lattice.hi)
        return export_snapshot(
            *(scene.snapshot, scene.world_to_input, self, self.output_dir, say, scene.viewpoint, compare),
            *(scene_json(scene.scene_folder), depths, scene.tracks, scene.corrections),
        )


def check_options(options: ExportOptions) -> CheckedOptions:
    """Return the checked options; raises `ThermoxelsError` for a wrong option before anything slow runs."""
    from thermoxels_ns.mesh.boundary.patches import PatchRules, load_patch_rules
    from thermoxels_ns.mesh.solid.voxels import SolidSelection

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
    try:
        selection = SolidSelection(**{field.name: getattr(options, field.name) for field in fields(SolidSelection)})
    except MeshError as problem:
        option = re.split(r"[: ]", str(problem), maxsplit=1)[0].replace("_", "-")
        said = str(problem).removesuffix("Correct it.")
        if said == str(problem):
            raise
        raise MeshError(f"{said}Correct --{option}, or leave it out.") from problem
    rules = PatchRules() if options.patches is None else load_patch_rules(options.patches)
    return CheckedOptions(selection, rules, distance, *_heat_settings(options))


def _heat_settings(options: ExportOptions) -> tuple[HeatScene, Material, TimeSteps]:
    """Return the heat scene, its material, and its time steps with the changes that options make."""
    from thermoxels_ns.fem.problem import TimeSteps
    from thermoxels_ns.heat.scene import load_heat_scene

    scene = load_heat_scene(options.heat_preset)
    material, *others = set(scene.materials.values())
    if others or not isinstance(scene.time, TimeSteps):
        expected = "a scene of one material, with time: {steps: 10, step_seconds: 60}"
        remedy = "Export without it, then run thermoxels heat with that scene on the mesh."
        raise HeatError("heat_preset", expected=expected, got=options.heat_preset, remedy=remedy)
    given = {"steps": options.steps, "step_seconds": options.step_seconds}
    time = replace(scene.time, **{name: value for name, value in given.items() if value is not None})
    return replace(scene, time=time), material, time


def scale_of(options: ExportOptions, checked: CheckedOptions, scene_file: Mapping | None) -> SceneScale | None:
    """Return the scale of an export: from the options, or else from the scene's json; None if neither has a scale.

    Raises `ThermoxelsError` for a scale out of range, or if a format or an option needs a scale and there is none.
    """
    scale = choose_scale(options.metres_per_unit, checked.distance, scene_file)
    asked = {
        "--formats inp": "inp" in options.formats,
        "--wall-thickness": options.wall_thickness is not None,
        "--patches": options.patches is not None,
    }
    needs = [option for option, given in asked.items() if given]
    if scale is None and needs:
        remedy = "Pass --metres-per-unit, or --known-distance."
        got = "none in the options or in the scene's json"
        raise MeshError("scale", expected=f"a scene whose scale is known, for {needs[0]}", got=got, remedy=remedy)
    return scale


def up_of(
    options: ExportOptions, scene_file: Mapping[str, Any] | None, viewpoint: Viewpoint
) -> tuple[tuple[float, float, float], str]:
    """Return the unit vector up and a sentence on its source: --up, else the scene's json, else `viewpoint`."""
    if options.up is not None:
        x, y, z = check_direction("up", options.up, "Pass --up 0 0 1, for example.", MeshError).tolist()
        return (x, y, z), "Given with --up."
    in_file = up_from_scene_file(scene_file or {})
    if in_file is not None:
        return in_file, "From the scene's json."
    return viewpoint.up, viewpoint.up_source


def prepare_folder(output_dir: Path | str) -> Path:
    """Make an export's folder, without half-written files; raises `OutputError` if it holds another command's files."""
    from thermoxels_ns.heat.vtk_series import STEP_PATTERN
    from thermoxels_ns.mesh.files.formats import MESH_FORMATS

    names = (*_mesh_files(MESH_FORMATS), *_MESH_PICTURES, _HEAT, _HEAT_PICTURE, _QUALITY, _SUMMARY)
    others = ("answers.json", "series.csv")
    return result_folder(output_dir, names, (_QUALITY, _SUMMARY), others, f"{Path(_HEAT).stem}/{STEP_PATTERN}")


def export_snapshot(
    snapshot: GridSnapshot,
    world_to_input: FloatArray,
    options: ExportOptions,
    output_dir: Path | str,
    say: Say = lambda _: None,
    viewpoint: Viewpoint = Viewpoint(),
    compare: Compare | None = None,
    scene_file: Mapping[str, Any] | None = None,
    depths: Depths | None = None,
    tracks: FeatureRays | None = None,
    corrections: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Write mesh files, quality.json, summary.json, pictures and the heat series; return the content of summary.json.

    Everything is computed before anything is written. An old summary.json is removed first and the new summary.json is
    written last, so files beside a summary.json belong together. Files of earlier exports that are not rewritten go.

    Args:
        snapshot: The trained field.
        world_to_input: Matrix from the trained scene to the input poses, shape (4, 4).
        options: Options of the export.
        output_dir: Folder for the files.
        say: Called with each line of progress.
        viewpoint: View of the pictures; gives the mesh's up unless an option or the scene's json has an up.
        compare: Compares with a known truth if the scale is known; its `ThermoxelsError` goes into the summary.
        scene_file: Content of the scene's json, for scale and up.
        depths: Depths of photographs that support the position of boundary triangles.
        tracks: Lines from photographs to points that the photographs show, which support boundary triangles too.
        corrections: Corrections that training made to photographs, for the summary.

    Raises:
        ThermoxelsError: An option is wrong, nothing is solid, the heat solver failed, or a file cannot be written.
    """
    from thermoxels_ns.commands import export_summary
    from thermoxels_ns.fem.solution import HeatSolution
    from thermoxels_ns.heat.solving import Goals, solve_problem
    from thermoxels_ns.heat.vtk_series import heat_series_paths, remove_heat_series, shown_states, write_heat_series
    from thermoxels_ns.mesh.build import apply_transform, build_mesh
    from thermoxels_ns.mesh.files.formats import MESH_FORMATS, write_mesh
    from thermoxels_ns.mesh.files.solvers import HeatStep, check_start
    from thermoxels_ns.mesh.files.surface import check_single_precision
    from thermoxels_ns.mesh.quality.report import check_mesh
    from thermoxels_ns.mesh.tetrahedra import support_of_facets
    from thermoxels_ns.reports import mesh_pictures

    checked = check_options(options)
    scale = scale_of(options, checked, scene_file)
    metres, unit = (1.0, "input unit") if scale is None else (scale.metres_per_unit, "m")
    up, up_source = up_of(options, scene_file, viewpoint)
    folder = prepare_folder(output_dir)
    to_mesh = np.diag([metres, metres, metres, 1.0]) @ world_to_input
    built = build_mesh(
        snapshot, checked.selection, to_mesh, options.boundary, up=up, rules=checked.rules, metres_per_unit=metres
    )
    if depths is not None:
        built = with_support(built, depths, tracks, snapshot.lattice, to_mesh)
    mesh = built.mesh
    suffixes = [f".{name}" for name in options.formats]
    if {".stl", ".ply"} & {*suffixes}:
        check_single_precision(mesh)
    begin_c, starting = checked.scene.initial_c, mesh
    if not mesh.has_temperatures and begin_c is not None:
        starting = replace(mesh, temperature_c=np.full(len(mesh.points_m), begin_c))
    if ".inp" in suffixes:
        check_start(starting)
    voxel_size = snapshot.lattice.voxel_size * float(np.cbrt(abs(np.linalg.det(to_mesh[:3, :3]))))
    report = check_mesh(mesh, options.boundary, built.observed_range_c, length_unit=unit)
    say(f"Up: {', '.join(f'{value:.3g}' for value in up)}. {up_source}")
    region = export_summary.region_summary(built, checked.selection)
    for line in export_summary.lines_on_mesh(built, region, report.volume_m3, unit, voxel_size):
        say(line)
    if options.boundary == "voxel":
        say(
            f"Area {report.area_m2:.6g} {unit}^2, that of a staircase: convection, radiation and fluxes act on up to "
            "1.7 times the area of a slanted surface. For heat flows export with --boundary conforming."
        )

    scene, material, time = checked.scene, checked.material, checked.time
    solution: HeatSolution | None = None
    truth, skipped, states = None, HEAT_SKIPPED if scale is None else None, list[int]()
    if not starting.has_temperatures:
        skipped = skipped or NO_START
    if skipped is None:
        say(f"Heat: {time.steps} steps of {time.step_seconds:g} s through {material.name}")
        everything = Goals(leave_out_below=0.0, memory_gb=None)
        found = solve_problem(scene.problem(mesh, up=up), time, everything, say).solution
        assert isinstance(found, HeatSolution), "the scene has time steps"
        solution = found
        say(f"Heat: {solution.status} Energy conserved to {solution.energy_residual:.1e}.")
    else:
        say(skipped)
    if scale is not None and compare is not None:
        inner_side = options.interior == "hollow" or options.wall_thickness is not None
        truth = _compared(compare, built, metres, inner_side, say)

    files = [*_mesh_files(suffixes), _QUALITY]
    if solution is not None:
        states = shown_states(solution.times_s, options.vtk_times)
        files += [p.relative_to(folder).as_posix() for p in heat_series_paths(folder / _HEAT, len(states))]
    if options.pictures:
        files += _MESH_PICTURES[: 3 if support_of_facets(mesh) is None else 4]
        files += [] if solution is None else [_HEAT_PICTURE]
    summary = {
        "options": {field.name: getattr(options, field.name) for field in fields(options)},
        "versions": export_summary.versions(),
        "length_unit": unit,
        "scale": None if scale is None else asdict(scale),
        "up": up,
        "up_source": up_source,
        "region": region,
        "mesh": export_summary.mesh_summary(built, report, scale, voxel_size),
        "heat": {"computed": False, "reason": skipped}
        if solution is None
        else export_summary.heat_summary(material, time, solution),
        "corrections": dict(corrections or {}),
        **({} if truth is None else {"truth": truth}),
        "files": [*files, _SUMMARY],
    }
    plain_values(summary, "summary", MeshError)  # raises if json cannot hold the summary

    remove_file(folder / _SUMMARY)
    write_json(folder / _QUALITY, report.as_mapping())  # first: marks the folder as an export's for `prepare_folder`
    for name in {*_mesh_files(MESH_FORMATS), *_MESH_PICTURES, _HEAT_PICTURE} - set(files):
        remove_file(folder / name)
    if solution is None:
        remove_heat_series(folder / _HEAT)
    heat_step = HeatStep(
        material.conductivity_w_mk, material.density_kg_m3, material.specific_heat_j_kgk, time.steps, time.step_seconds
    )
    for suffix in suffixes:
        write_mesh(folder / f"mesh{suffix}", starting if suffix == ".inp" else mesh, heat_step=heat_step, up=up)
    if solution is not None:
        write_heat_series(folder / _HEAT, mesh, solution, states)
    if options.pictures:
        look = {"up": up, "view_direction": viewpoint.view_direction}
        mesh_pictures.draw_mesh([folder / name for name in _MESH_PICTURES[:2]], mesh, look, unit)
        if support_of_facets(mesh) is not None:
            mesh_pictures.draw_support(folder / _MESH_PICTURES[3], mesh, look)
        # Faces of the voxels that are not exported are drawn in grey.
        corners, faces = mesh_pictures.voxel_surface(built.solid.left_out)
        ghost = apply_transform(to_mesh, snapshot.lattice.index_to_world(corners)), faces
        note = "grey: left out of the region" if len(ghost[0]) else "nothing is left out"
        beside: Any = {"title": "Region", "length_unit": unit, "ghost": ghost, "note": note, **look}
        mesh_pictures.write_picture(folder / _MESH_PICTURES[2], mesh_pictures.image_of_mesh(mesh, **beside))
        if solution is not None:
            mesh_pictures.draw_heat(folder / _HEAT_PICTURE, mesh, solution, look)
    write_json(folder / _SUMMARY, summary)
    say(f"Written to {folder}: {', '.join(name for name in summary['files'] if '/' not in name)}")
    return summary


def _mesh_files(suffixes: Iterable[str]) -> list[str]:
    """Return the names of the files that the mesh is written to, by suffixes such as ".vtu"."""
    from thermoxels_ns.mesh.files.formats import mesh_file_paths

    return [path.name for suffix in suffixes for path in mesh_file_paths(f"mesh{suffix}")]


def with_support(
    built: BuiltMesh,
    depths: Depths,
    tracks: FeatureRays | None,
    lattice: Lattice,
    to_mesh: FloatArray,
) -> BuiltMesh:
    """Return `built` with the numbers of photographs that see and that support each boundary triangle.

    See `facet_views` and `supporting_photographs`. Matrix `to_mesh`, (4, 4), leads from the trained scene to the mesh.
    """
    from thermoxels_ns.mesh.boundary.visibility import facet_views
    from thermoxels_ns.mesh.build import apply_transform
    from thermoxels_ns.mesh.tetrahedra import facet_normals
    from thermoxels_ns.multiview.votes import supporting_photographs

    mesh = built.mesh
    assert mesh.boundary is not None
    middle = apply_transform(np.linalg.inv(to_mesh), mesh.points_m[mesh.facets].mean(axis=1))
    normal = facet_normals(mesh.points_m, mesh.facets) @ to_mesh[:3, :3] / np.cbrt(abs(np.linalg.det(to_mesh[:3, :3])))
    photographs = depths.photographs
    cameras = photographs.matrices, photographs.centres, photographs.sizes
    views = facet_views(built.solid.cells, lattice, *cameras, middle, normal)
    found = supporting_photographs(depths, views.middle, views.seen, lattice.voxel_size, tracks)
    count = np.stack((views.seen.sum(axis=1), found.sum(axis=1)), axis=1)[views.group]
    return replace(built, mesh=replace(mesh, boundary=replace(mesh.boundary, photographs=count)))


def _compared(compare: Compare, built: BuiltMesh, metres: float, inner_side: bool, say: Say) -> dict[str, Any] | None:
    """Return the figures of the comparison with the truth; if the comparison fails, return its error instead.

    With `inner_side`, for a mesh with the inner side of a shell or wall, the note `INNER_SIDE` is added.
    """
    try:
        truth = compare(built.solid, built.mesh, metres)
    except ThermoxelsError as problem:
        say(f"Not compared with the truth: {problem}")
        return {"error": str(problem)}
    if truth is None:
        return None
    told = (f"{name} {value:.4g}" if isinstance(value, float) else f"{name} {value}" for name, value in truth.items())
    say(f"Against the truth: {', '.join(told)}")
    if not inner_side:
        return truth
    say(INNER_SIDE)
    return {**truth, "note": INNER_SIDE}


def scene_json(scene_folder: Path) -> dict[str, Any]:
    """Return the content of the scene's json, unchecked; empty if the scene has no json, as with COLMAP."""
    from thermoxels_ns.data.layouts import JSON_NAMES

    folder = scene_folder if scene_folder.is_dir() else scene_folder.parent
    names = [scene_folder] if scene_folder.is_file() else [folder / name for name in JSON_NAMES]
    for path in names:
        if path.is_file():
            return read_json_object(path, "Write the file again.", SceneError)
    return {}


def load_trained_scene(load_config: Path, check_scene: Callable[[Path], object] = lambda _: None) -> TrainedScene:
    """Load a trained Thermoxels model through nerfstudio; raises `CheckpointError` for anything else.

    `check_scene` is called with the path of the scene before anything slow; an error that it raises is passed on.
    """
    check_run(load_config)
    import yaml
    from nerfstudio.utils.eval_utils import eval_setup

    from thermoxels_ns.training.trainer import ThermoxelsTrainerConfig

    def check(config: TrainerConfig) -> TrainerConfig:
        if isinstance(config, ThermoxelsTrainerConfig):
            config.moved_to(load_config.parent)
        pipeline: Any = config.pipeline
        if not callable(getattr(pipeline._target, "grid_snapshot", None)):
            expected = "a model trained with a Thermoxels method"
            got = f"the checkpoint of another method ({config.method_name})"
            remedy = "Train with ns-train thermoxels, or choose another subcommand of ns-export."
            raise CheckpointError("load_config", expected=expected, got=got, remedy=remedy)
        manager: Any = pipeline.datamanager
        told = getattr(manager, "data", None)  # with --data of ns-train, else with the dataparser's own --data
        check_scene(Path(manager.dataparser.data if told is None else told))
        return config

    try:
        _, pipeline, _, _ = eval_setup(load_config, test_mode="test", update_config_callback=check)
    except ThermoxelsError:
        raise
    except (yaml.YAMLError, AssertionError, KeyError, UnicodeDecodeError) as problem:
        expected = "a config.yml that ns-train of this installation wrote"
        # errors of nerfstudio's own checks have no message
        reason = f"{type(problem).__name__}: {problem}" if str(problem) else "it holds no TrainerConfig of nerfstudio"
        got = f"{load_config}, which cannot be read ({reason})"
        remedy = "Pass the config.yml of the training run."
        raise CheckpointError("load_config", expected=expected, got=got, remedy=remedy) from problem
    except RuntimeError as problem:
        expected = "the parameters of the model that config.yml describes"
        got = f"{type(problem).__name__}: {problem}"
        remedy = "Use the config.yml and the checkpoint of one and the same training run."
        raise CheckpointError("checkpoint", expected=expected, got=got, remedy=remedy) from problem
    pipeline_of_ours: Any = pipeline
    outputs = pipeline_of_ours.datamanager.train_dataparser_outputs
    world_to_input = input_from_world(outputs.dataparser_transform.numpy(), float(outputs.dataparser_scale))
    return TrainedScene(
        pipeline_of_ours.grid_snapshot(),
        world_to_input,
        viewpoint_of_cameras(outputs.cameras.camera_to_worlds.numpy(), world_to_input),
        Path(pipeline_of_ours.datamanager.get_datapath()),
        pipeline_of_ours.datamanager.train_dataset,
        outputs.metadata["feature_rays"],
        pipeline_of_ours.corrections(),
    )


def viewpoint_of_cameras(camera_to_worlds: npt.ArrayLike, world_to_input: npt.ArrayLike) -> Viewpoint:
    """Choose a view for pictures: up as the photographer held the camera, seen from the side where the cameras stood.

    Poses are in the trained scene (x right, y up, z back), shape (n, 3, 4) or (n, 4, 4). If the cameras stood all
    around, `view_direction` is None, which means obliquely from above.
    """
    from thermoxels_ns.capture.sfm.scale_and_up import find_up

    rotation = np.asarray(world_to_input, np.float64)[:3, :3]
    axes = np.einsum("ij,njk->nik", rotation / np.cbrt(np.linalg.det(rotation)), np.asarray(camera_to_worlds)[:, :, :3])
    if np.linalg.norm(axes[:, :, 1].mean(axis=0)) < 0.1:  # the cameras' up directions cancel out
        return Viewpoint()
    found = find_up(axes, [None] * len(axes), [1] * len(axes))
    up, source = found.direction, found.source
    forward = -axes[:, :, 2].mean(axis=0)
    level = forward - (forward @ up) * up
    direction = None
    if np.linalg.norm(level) > 0.3:
        level /= np.linalg.norm(level)
        direction = tuple(float(v) for v in level + 0.35 * np.cross(up, level) - 0.35 * up)
    return Viewpoint(tuple(float(v) for v in up), source, direction)  # type: ignore[arg-type]
