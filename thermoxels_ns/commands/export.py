"""The command ``ns-export thermoxels-mesh``: make a mesh from a trained model."""

from __future__ import annotations

# Only light imports at the top: nerfstudio's exporter reads this module for ``--help`` of every subcommand.
import platform
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from threadpoolctl import threadpool_limits

from thermoxels_ns.core.arrays import BoolArray, FloatArray, IntArray
from thermoxels_ns.core.checks import check_direction, remove_file, result_folder
from thermoxels_ns.core.config_loader import check_run
from thermoxels_ns.core.errors import CheckpointError, MeshError, ThermoxelsError
from thermoxels_ns.core.json_values import plain_values, write_json
from thermoxels_ns.core.lattice import input_from_world
from thermoxels_ns.core.version import __version__
from thermoxels_ns.data.layouts import scene_json
from thermoxels_ns.data.scene_scale import SceneScale, choose_scale, scale_from_known_distance, up_from_scene_file
from thermoxels_ns.mesh.quality.tet_shapes import signed_volumes
from thermoxels_ns.mesh.tetrahedra import SUPPORT, TetMesh, facet_areas, facet_normals, support_of_facets

if TYPE_CHECKING:
    from thermoxels_ns.core.feature_rays import FeatureRays
    from thermoxels_ns.core.snapshot import GridSnapshot
    from thermoxels_ns.mesh.boundary.patches import PatchRules
    from thermoxels_ns.mesh.build import BuiltMesh
    from thermoxels_ns.mesh.quality.checks import MeshFigures
    from thermoxels_ns.mesh.solid.voxels import SolidSelection

Say = Callable[[str], None]

_SUMMARY, _UNFINISHED = "summary.json", "summary-unfinished.json"
_PICTURES = ("mesh.png", "mesh-measured.png", "region.png", "support.png")


@dataclass
class ExportOptions:
    """All options of an export, except the files and folders of its input and output."""

    boundary: Literal["conforming", "voxel"] = "conforming"
    """conforming: the boundary follows the level set of the density. voxel: the boundary follows voxel faces, as in the
    Thermoxels paper, with up to 1.7 times the area of a slanted surface."""
    density_threshold: float | None = None
    """Voxels at least this dense are solid, [1 / world unit]; summary.json says which density was used. Lower it if
    walls have holes, raise it if empty space turns solid. Left out, it is automatic: the highest that 95 % of the
    training rays that end on a surface meet within half a voxel of their end."""
    density_percentile: float | None = None
    """Voxels are solid if they are denser than this share of all voxels of the scene box, [%], 0 to 100; in the
    Thermoxels paper 90 keeps the densest tenth. --density-threshold takes precedence over it."""
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
    """Length of one unit of the input poses, [m]; 1 if the poses are in metres. Needed for heat and audit, unless the
    scene's json has metres_per_unit. Without a scale the mesh is written in units of the input."""
    up: tuple[float, float, float] | None = None
    """Direction that points up, in the coordinates of the input poses; decides which patches face up, down or sideways.
    Left out: the direction in the scene's json, or else a direction computed from the cameras, taken as held level."""
    known_distance: tuple[float, float, float, float, float, float, float] | None = None
    """In place of metres per unit: two points in the coordinates of the input poses and the distance between the two,
    x y z x y z metres."""
    known_distance_error: float | None = None
    """Standard error of the known distance, including the position errors of the two points, [m]; the summary then
    states the standard errors of area and volume."""
    formats: tuple[Literal["vtu", "xdmf", "msh", "inp", "glb"], ...] = ("vtu", "glb")
    """Files to write the mesh to: vtu (ParaView), xdmf (FEniCSx), msh (Gmsh), inp (CalculiX, Abaqus: ten steps of 60 s
    in concrete, to be changed in the file), glb (surface: browsers, phones)."""
    pictures: bool = True
    """Write PNG pictures of the mesh coloured by temperature, and of how photographs support its surface."""


@dataclass(frozen=True)
class TrainedScene:
    """A trained field, and what else an export needs from the training run."""

    snapshot: GridSnapshot
    world_to_input: FloatArray
    """Matrix from homogeneous coordinates of the trained scene to coordinates of the input poses, shape (4, 4)."""
    up: tuple[float, float, float]  # Direction that points up, in the coordinates of the input poses
    up_source: str  # Sentence that says how `up` was found
    view_direction: tuple[float, float, float] | None
    """Direction from the camera of pictures to the mesh, in the same coordinates; None: obliquely from above."""
    scene_folder: Path  # Path that training took as its scene: a folder, or a json file in a folder
    dataset: Any  # Training photographs, a `ThermalDataset`; None: support of the surface is not counted
    tracks: FeatureRays | None  # Lines from photographs to points that the photographs show, in the trained scene
    corrections: dict[str, Any]  # Result of `ThermoxelsPipeline.corrections`
    blocks: tuple[Block, ...] = ()  # The trained scenes that this scene was joined of; empty: none


class Block(NamedTuple):
    """A trained scene that is a part of a larger one."""

    run: TrainedScene
    shift: FloatArray  # Where its origin lies in the larger scene, shape (3,), [world units]
    cells: BoolArray  # Voxels of the larger scene that are this block's, shape `lattice.cell_shape`


@dataclass(frozen=True)
class SceneMesh:
    """The mesh of a trained scene, checked, with its figures, its scale and its direction up."""

    built: BuiltMesh
    figures: MeshFigures
    scale: SceneScale | None
    unit: str  # Unit of length: m, or without a scale the input unit
    to_mesh: FloatArray  # Matrix from the trained scene to the mesh, shape (4, 4)
    up: tuple[float, float, float]
    up_source: str  # Sentence that says how `up` was found


@dataclass(kw_only=True)
class ExportThermoxelsMesh(ExportOptions):
    """Export a tetrahedral mesh with temperatures from a trained Thermoxels model."""

    load_config: Path
    """The config.yml that ns-train wrote."""
    output_dir: Path
    """Folder for the results; made if it does not exist."""
    beside: tuple[Path, ...] = ()
    """The config.yml of each further block of a scene that thermoxels split cut: all blocks become one mesh."""

    def main(self) -> None:
        """Run the export; raises `ThermoxelsError` for wrong options, an unusable run, or if nothing is solid."""
        # With more BLAS threads, the last bits of results would depend on the number of threads.
        with threadpool_limits(1, "blas"):
            check_options(self)
            prepare_folder(self.output_dir)
            runs = list[TrainedScene]()
            for config in (self.load_config, *self.beside):
                print(f"Loading {config}", flush=True)
                runs.append(load_trained_scene(config))
            export_scene(joined_scene(runs), self, self.output_dir, partial(print, flush=True))


def check_options(options: ExportOptions) -> tuple[SolidSelection, PatchRules, SceneScale | None]:
    """Return the rules for the solid, the rules for patches, and the scale from `known_distance`; None without one.

    Raises `ThermoxelsError` for a wrong option.
    """
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
    if options.up is not None:
        check_direction("up", options.up, "Pass --up 0 0 1, for example.", MeshError)
    if not options.formats or len(set(options.formats)) < len(options.formats):
        remedy = "Pass --formats vtu glb, for example."
        raise MeshError("formats", expected="at least one format, each once", got=options.formats, remedy=remedy)
    selection = SolidSelection(**{field.name: getattr(options, field.name) for field in fields(SolidSelection)})
    return selection, PatchRules() if options.patches is None else load_patch_rules(options.patches), distance


def prepare_folder(output_dir: Path | str) -> Path:
    """Make and return an export's folder; raises `OutputError` if files there that no export wrote are in the way."""
    from thermoxels_ns.mesh.files.formats import MESH_FORMATS

    mark = _SUMMARY if (Path(output_dir) / _SUMMARY).is_file() else _UNFINISHED
    return result_folder(output_dir, (*_mesh_files(MESH_FORMATS), *_PICTURES, _UNFINISHED, _SUMMARY), mark)


def mesh_of_scene(run: TrainedScene, options: ExportOptions) -> SceneMesh:
    """Return the mesh of what is solid in a trained scene, with the support of its surface if `run.dataset` is given.

    Raises `ThermoxelsError` if an option is wrong, a scale is needed and not known, or nothing is solid.
    """
    from thermoxels_ns.mesh.build import build_mesh
    from thermoxels_ns.mesh.quality.checks import check_mesh

    selection, rules, distance = check_options(options)
    scene_file = scene_json(run.scene_folder)[1]
    scale = choose_scale(options.metres_per_unit, distance, scene_file)
    needs = ["--formats inp"] * ("inp" in options.formats) + ["--wall-thickness"] * (options.wall_thickness is not None)
    needs += ["--patches"] * (options.patches is not None)
    if scale is None and needs:
        remedy = "Pass --metres-per-unit, or --known-distance."
        got = "none in the options or in the scene's json"
        raise MeshError("scale", expected=f"a scene whose scale is known, for {needs[0]}", got=got, remedy=remedy)
    metres = 1.0 if scale is None else scale.metres_per_unit
    up, up_source = run.up, run.up_source
    if options.up is not None:
        x, y, z = check_direction("up", options.up, "Pass --up 0 0 1, for example.", MeshError).tolist()
        up, up_source = (x, y, z), "Given with --up."
    elif (in_file := up_from_scene_file(scene_file)) is not None:
        up, up_source = in_file, "From the scene's json."
    to_mesh = np.diag([metres, metres, metres, 1.0]) @ run.world_to_input
    built = build_mesh(run.snapshot, selection, to_mesh, options.boundary, up=up, rules=rules, metres_per_unit=metres)
    if run.dataset is not None:
        built = with_support(built, run, to_mesh)
    unit = "input unit" if scale is None else "m"
    return SceneMesh(built, check_mesh(built.mesh), scale, unit, to_mesh, up, up_source)


def export_scene(
    run: TrainedScene, options: ExportOptions, output_dir: Path | str, say: Say = lambda _: None
) -> dict[str, Any]:
    """Write mesh files, summary.json and pictures; return the content of summary.json.

    Mesh and summary are computed before any file is written or deleted. Then files of an earlier export that this one
    does not write are deleted, the mesh files are written, and last the pictures are rendered. The summary is named
    summary-unfinished.json until then, so all files beside a summary.json belong to one export. `say` receives lines of
    progress. Raises `ThermoxelsError` if an option is wrong, nothing is solid, or a file cannot be written.
    """
    from thermoxels_ns.mesh.files.formats import MESH_FORMATS, check_start, write_mesh

    folder = prepare_folder(output_dir)
    made = mesh_of_scene(run, options)
    mesh, figures, unit = made.built.mesh, made.figures, made.unit
    suffixes = [f".{name}" for name in options.formats]
    if ".inp" in suffixes:
        check_start(mesh)
    voxel_size = run.snapshot.lattice.voxel_size * float(np.cbrt(abs(np.linalg.det(made.to_mesh[:3, :3]))))
    say(f"Up: {', '.join(f'{value:.3g}' for value in made.up)}. {made.up_source}")
    asked_for = "near a point" if options.region_near else "a box" if options.region_box else options.region
    region = region_summary(made.built, asked_for)
    for line in lines_on_mesh(made.built, region, figures.volume_m3, unit, voxel_size):
        say(line)
    if options.boundary == "voxel":
        say(
            f"Area {figures.area_m2:.6g} {unit}^2, that of a staircase: convection, radiation and fluxes act on up to "
            "1.7 times the area of a slanted surface. For heat flows export with --boundary conforming."
        )
    if made.scale is None:
        say("The size of the scene is not known. For heat or an audit pass --metres-per-unit or --known-distance.")
    truth = _against_truth(run, made, say)

    files = _mesh_files(suffixes)
    if options.pictures:
        files += _PICTURES[: 3 if support_of_facets(mesh) is None else 4]
    summary = {
        "options": {field.name: getattr(options, field.name) for field in fields(ExportOptions)},
        "versions": {
            **{"thermoxels": __version__, "python": platform.python_version()},
            **{name: version(name) for name in ("numpy", "scipy", "torch", "nerfstudio", "pyvista", "scikit-fem")},
        },
        "length_unit": unit,
        "scale": None if made.scale is None else asdict(made.scale),
        "up": made.up,
        "up_source": made.up_source,
        "region": region,
        "mesh": mesh_summary(made.built, figures, made.scale),
        "corrections": run.corrections,
        **({} if truth is None else {"truth": truth}),
        "files": [*files, _SUMMARY],
    }
    plain_values(summary, "summary", MeshError)  # raises if json cannot hold the summary

    write_json(folder / _UNFINISHED, summary)  # marks the folder as an export's for `prepare_folder`
    remove_file(folder / _SUMMARY)
    for name in {*_mesh_files(MESH_FORMATS), *_PICTURES} - set(files):
        remove_file(folder / name)
    for suffix in suffixes:
        write_mesh(folder / f"mesh{suffix}", mesh, up=made.up)
    if options.pictures:
        _draw(folder, run, made)
    (folder / _UNFINISHED).rename(folder / _SUMMARY)
    say(f"Written to {folder}: {', '.join(summary['files'])}")
    return summary


def _draw(folder: Path, run: TrainedScene, made: SceneMesh) -> None:
    """Write the pictures `_PICTURES` of a mesh into a folder; support.png only if support was computed."""
    from thermoxels_ns.mesh.build import apply_transform
    from thermoxels_ns.reports import mesh_pictures

    mesh, unit, (every, measured, region, support) = made.built.mesh, made.unit, [folder / name for name in _PICTURES]
    look = {"up": made.up, "view_direction": run.view_direction}
    no_ray: Any = {"painted": [("no thermal ray", "grey", ~mesh.observed[mesh.facets].all(axis=1))]}
    for path, title, grey in ((every, "Surface temperature", {}), (measured, "Measured surface temperature", no_ray)):
        image = mesh_pictures.image_of_mesh(mesh, title=title, length_unit=unit, **look, **grey)
        mesh_pictures.write_picture(path, image)
    if support_of_facets(mesh) is not None:
        mesh_pictures.draw_support(support, mesh, look)
    # Faces of the voxels that are not exported are drawn in grey.
    corners, faces = mesh_pictures.voxel_surface(made.built.solid.left_out)
    ghost = apply_transform(made.to_mesh, run.snapshot.lattice.index_to_world(corners)), faces
    note = "grey: left out of the region" if len(ghost[0]) else "nothing is left out"
    beside: Any = {"title": "Region", "length_unit": unit, "ghost": ghost, "note": note, **look}
    mesh_pictures.write_picture(region, mesh_pictures.image_of_mesh(mesh, **beside))


def _mesh_files(suffixes: Iterable[str]) -> list[str]:
    """Return the names of the files that the mesh is written to, by suffixes such as ".vtu"."""
    from thermoxels_ns.mesh.files.formats import mesh_file_paths

    return [path.name for suffix in suffixes for path in mesh_file_paths(f"mesh{suffix}")]


def with_support(built: BuiltMesh, run: TrainedScene, to_mesh: FloatArray) -> BuiltMesh:
    """Return `built` with the counts of photographs that see and that support each triangle, `Boundary.photographs`.

    `to_mesh`, (4, 4), transforms the trained scene to the mesh. In a block's voxels, the photographs of this block are
    counted. See `facet_views` and `supporting_photographs`.
    """
    from thermoxels_ns.mesh.build import apply_transform
    from thermoxels_ns.mesh.solid.free_space import facet_views
    from thermoxels_ns.multiview.photographs import read_photographs
    from thermoxels_ns.multiview.stereo import depths_of
    from thermoxels_ns.multiview.votes import supporting_photographs

    mesh, lattice = built.mesh, run.snapshot.lattice
    every = apply_transform(np.linalg.inv(to_mesh), mesh.points_m[mesh.facets].mean(axis=1))
    turned = to_mesh[:3, :3] / np.cbrt(abs(np.linalg.det(to_mesh[:3, :3])))
    normal, counts = facet_normals(mesh.points_m, mesh.facets) @ turned, np.zeros((len(every), 2), np.int64)
    cell = np.floor(lattice.world_to_index(every)).astype(np.int64)
    cell = tuple(np.clip(cell, 0, np.array(lattice.cell_shape) - 1).T)
    for block, shift, cells in run.blocks or [Block(run, np.zeros(3), np.ones(lattice.cell_shape, bool))]:
        depths = depths_of(read_photographs(block.dataset), block.snapshot.lattice.lo, block.snapshot.lattice.hi)
        seen = depths.photographs.moved(shift)
        own = np.flatnonzero(cells[cell])
        views = facet_views(
            built.solid.cells, lattice, seen.matrices, seen.centres, seen.sizes, every[own], normal[own]
        )
        tracks = None if block.tracks is None else block.tracks.moved(np.eye(3), shift, 1.0)
        found = supporting_photographs(
            replace(depths, photographs=seen), views.middle, views.seen, lattice.voxel_size, tracks
        )
        counts[own] = np.stack((views.seen.sum(axis=1), found.sum(axis=1)), axis=1)[views.group]
    return replace(built, mesh=replace(mesh, boundary=replace(mesh.boundary, photographs=counts)))


def joined_scene(runs: Sequence[TrainedScene]) -> TrainedScene:
    """Return one trained scene of blocks, in the world of the first; one alone is returned as it is.

    Raises `MeshError` unless the blocks overlap and their voxels coincide, see `joined_fields.joined`.
    """
    if len(runs) == 1:
        return runs[0]
    from thermoxels_ns.mesh.joined_fields import joined

    into = np.linalg.inv(runs[0].world_to_input)
    moves = [into @ run.world_to_input for run in runs]
    sizes = [float(np.cbrt(np.linalg.det(move[:3, :3]))) for move in moves]
    if not np.allclose(sizes, 1.0, rtol=0.0, atol=2e-5):
        expected, got = "blocks with boxes of one size", f"boxes up to {max(sizes):.4g} times as long as the first"
        raise MeshError("beside", expected=expected, got=got, remedy="Pass the blocks of one thermoxels split.")
    shifts = np.stack([move[:3, 3] for move in moves])
    snapshot, owner = joined([run.snapshot for run in runs], shifts)
    blocks = tuple(Block(run, shift, owner == number) for number, (run, shift) in enumerate(zip(runs, shifts)))
    corrections = {f"block {number + 1}": run.corrections for number, run in enumerate(runs)}
    return replace(runs[0], snapshot=snapshot, corrections=corrections, blocks=blocks)


def _against_truth(run: TrainedScene, made: SceneMesh, say: Say) -> dict[str, Any] | None:
    """Return figures of solid and mesh against the exact scene, or its "error"; None: scale or scene not known."""
    from thermoxels_ns.evaluation.truth_comparison import compare_with_truth

    if made.scale is None:
        return None
    solid, mesh = made.built.solid, (made.built.mesh, made.scale.metres_per_unit)
    exact = run.world_to_input, run.scene_folder
    try:
        truth = compare_with_truth(solid.cells, run.snapshot.lattice, *exact, *mesh, within=solid.within)
    except ThermoxelsError as problem:
        say(f"Not compared with the truth: {problem}")
        return {"error": str(problem)}
    if truth is not None:
        say(f"Against the truth: F-score {truth['fscore']:.3g}; more in {_SUMMARY}.")
    return truth


def load_trained_scene(load_config: Path) -> TrainedScene:
    """Load a trained Thermoxels model through nerfstudio; raises `CheckpointError` for anything else."""
    content = check_run(load_config)
    if "scene_from_run" not in content:
        got = f"one of another method ({content.get('method_name')})"
        remedy = "Train with ns-train thermoxels, or choose another subcommand of ns-export."
        raise CheckpointError("load_config", expected="a run of a Thermoxels method", got=got, remedy=remedy)
    from nerfstudio.utils.eval_utils import eval_setup

    pipeline: Any = eval_setup(load_config, test_mode="test")[1]
    outputs = pipeline.datamanager.train_dataparser_outputs
    world_to_input = input_from_world(outputs.dataparser_transform.numpy(), float(outputs.dataparser_scale))
    return TrainedScene(
        pipeline.grid_snapshot(),
        world_to_input,
        *viewpoint_of_cameras(outputs.cameras.camera_to_worlds.numpy(), world_to_input),
        Path(pipeline.datamanager.get_datapath()),
        pipeline.datamanager.train_dataset,
        outputs.metadata["feature_rays"],
        pipeline.corrections(),
    )


def viewpoint_of_cameras(
    camera_to_worlds: npt.ArrayLike, world_to_input: npt.ArrayLike
) -> tuple[tuple[float, float, float], str, tuple[float, float, float] | None]:
    """Return `up`, `up_source` and `view_direction` of a `TrainedScene`, computed from its cameras.

    Up assumes that the photographer held the camera level. Pictures are seen from the side where the cameras stood; if
    they stood all around, `view_direction` is None. `camera_to_worlds` are poses in the trained scene (camera axes: x
    right, y up, z back), (n, 3, 4) or (n, 4, 4); `world_to_input` is that of `TrainedScene`.
    """
    from thermoxels_ns.capture.sfm.scale_and_up import find_up

    rotation = np.asarray(world_to_input, np.float64)[:3, :3]
    axes = np.einsum("ij,njk->nik", rotation / np.cbrt(np.linalg.det(rotation)), np.asarray(camera_to_worlds)[:, :, :3])
    if np.linalg.norm(axes[:, :, 1].mean(axis=0)) < 0.1:  # the cameras' up directions cancel out
        return (0.0, 0.0, 1.0), "Up is assumed to be z.", None
    found = find_up(axes, [None] * len(axes), [1] * len(axes))
    up, source = found.direction, found.source
    forward = -axes[:, :, 2].mean(axis=0)
    level = forward - (forward @ up) * up
    direction = None
    if np.linalg.norm(level) > 0.3:
        level /= np.linalg.norm(level)
        direction = tuple(float(v) for v in level + 0.35 * np.cross(up, level) - 0.35 * up)
    return tuple(float(v) for v in up), source, direction  # type: ignore[return-value]


def lines_on_mesh(
    built: BuiltMesh, region: Mapping[str, Any], volume: float, unit: str, voxel_size: float
) -> Iterator[str]:
    """Yield lines on each step that made the solid, and on the mesh.

    `region` is a `region_summary`; `volume` (of the mesh) and `voxel_size` are in `unit`.
    """
    for step in built.solid.steps:
        amounts = []
        for sign, voxels in (("+", step.added), ("-", step.removed)):
            volume_m3 = voxels * voxel_size**3
            told = f"{1e3 * volume_m3:.3g} l" if volume_m3 < 1.0 else f"{volume_m3:.3g} m^3"
            size = f" ({told})" if unit == "m" else ""
            if voxels:
                amounts.append(f"{sign}{voxels} voxels{size}")
        changed = ", ".join(amounts) or "nothing changed"
        if step.name == "region":
            size = " x ".join(f"{side:.3g}" for side in region["size"])
            share, name = region["share_of_solid_taken"], region["asked_for"]
            yield f"Region, {name}: {size} {unit}, {share:.1%} of the solid; {changed}. {step.remark}"
        else:
            yield f"Solid, {step.name}: {changed}. {step.remark}"
    mesh = built.mesh
    yield f"Mesh: {len(mesh.tets)} tetrahedra, {len(mesh.points_m)} nodes, volume {volume:.6g} {unit}^3"
    if built.unobserved_parts:
        yield (
            f"Left out because no thermal ray saw them: {built.unobserved_parts} parts of the mesh, "
            f"{built.unobserved_voxels} voxels in all."
        )
    shares = support_shares(mesh)
    if shares is not None:
        supported, weak, smooth, filled = shares.values()
        yield (
            f"{supported:.0%} of the surface is supported by three photographs or more, {weak:.0%} by one or two; "
            f"{smooth:.0%} is seen, but placed by smoothness alone; {filled:.0%} is seen by no photograph."
        )
    for rule in built.idle_rules:
        yield (
            f"Rule without effect: {rule}. Nothing in the mesh meets its conditions, or later rules take all that does."
        )


def mesh_summary(built: BuiltMesh, figures: MeshFigures, scale: SceneScale | None) -> dict[str, Any]:
    """Return the entry "mesh" of summary.json: counts, sizes and steps; lengths are in the summary's length_unit."""
    mesh, solid = built.mesh, built.solid
    temperature = mesh.temperature_c
    of_triangles = facet_areas(mesh.points_m, mesh.facets)
    unobserved = of_triangles @ ~mesh.observed[mesh.facets].all(axis=1)
    return {
        "nodes": len(mesh.points_m),
        "tets": len(mesh.tets),
        "voxels": int(np.count_nonzero(solid.cells)),
        "boundary_triangles": len(mesh.facets),
        "non_manifold_edges": figures.num_non_manifold_edges,
        "volume": figures.volume_m3,
        "volume_standard_error": None if scale is None else scale.standard_error_of(figures.volume_m3, 3),
        "area": figures.area_m2,
        "area_standard_error": None if scale is None else scale.standard_error_of(figures.area_m2, 2),
        "bounds": {"lower": mesh.points_m.min(axis=0), "upper": mesh.points_m.max(axis=0)},
        "dihedral_angles_deg": {"min": figures.dihedral_range_deg[0], "max": figures.dihedral_range_deg[1]},
        "density_threshold_used": solid.threshold,
        "solid_steps": [
            {"step": step.name, "voxels_added": step.added, "voxels_removed": step.removed, "remark": step.remark}
            for step in solid.steps
        ],
        "parts_without_thermal_rays_left_out": built.unobserved_parts,
        "voxels_without_thermal_rays_left_out": built.unobserved_voxels,
        "share_of_nodes_observed": float(np.mean(mesh.observed)),
        "share_of_area_not_fully_observed": float(unobserved / of_triangles.sum()),
        "share_of_area_by_support": support_shares(mesh),
        "rules_without_effect": built.idle_rules,
        "patches": _sums(mesh.boundary.patch_names, mesh.boundary.patch, of_triangles),
        "regions": _sums(mesh.region_names, mesh.region, signed_volumes(mesh.points_m, mesh.tets)),
        "temperature_c": None
        if not mesh.has_temperatures
        else {
            "min": float(temperature.min()),
            "max": float(temperature.max()),
            "mean_of_nodes": float(temperature.mean()),
        },
    }


def region_summary(built: BuiltMesh, asked_for: str) -> dict[str, Any]:
    """Return the entry "region" of summary.json: extents of the mesh, voxels taken and left out, share of the solid."""
    points, left_out = built.mesh.points_m, int(built.solid.left_out.sum())
    # Solid voxels in the whole lattice, before regions are left out and interiors are filled.
    found = sum(step.added for step in built.solid.steps if step.name in ("threshold", "close gaps"))
    return {
        "asked_for": asked_for,
        "size": points.max(axis=0) - points.min(axis=0),
        "voxels_taken": found - left_out,
        "voxels_left_out": left_out,
        "share_of_solid_taken": 1.0 - left_out / found,
    }


def _sums(names: tuple[str, ...], number: IntArray, amount: FloatArray) -> dict[str, float]:
    """Return the sum of `amount`, (k,), by name; `number`, (k,), are places in `names`; unused names are left out."""
    total = np.bincount(number, weights=amount, minlength=len(names))
    return {names[n]: float(total[n]) for n in np.unique(number)}


def support_shares(mesh: TetMesh) -> dict[str, float] | None:
    """Return the share of the area in each class of `SUPPORT`, without cut triangles; None if support is unknown."""
    support = support_of_facets(mesh)
    if support is None or not (support >= 0).any():
        return None
    area = facet_areas(mesh.points_m, mesh.facets)
    total = np.bincount(support + 1, weights=area, minlength=len(SUPPORT) + 1)[1:]
    return dict(zip(SUPPORT, (total / total.sum()).tolist()))
