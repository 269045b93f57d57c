import math
from pathlib import Path

import numpy as np
import pytest
import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.scene_box import SceneBox

from thermoxels_ns.core.errors import MemoryBudgetError, SceneError, ThermoxelsError
from thermoxels_ns.core.feature_rays import RGB_STREAM, THERMAL_STREAM, FeatureRays
from thermoxels_ns.core.snapshot import Views
from thermoxels_ns.core.units import TemperatureRange
from thermoxels_ns.data.dataparser import ThermalDataParserConfig
from thermoxels_ns.field.refine import prune
from thermoxels_ns.multiview.photographs import gathered
from thermoxels_ns.synthetic.scene_folder import make_scene, write_scene
from thermoxels_ns.training import pipeline
from thermoxels_ns.training.image_metrics import fitted_gain
from thermoxels_ns.training.model import ThermoxelsModel
from thermoxels_ns.training.model_config import LOSS_RECIPES, MOST_VOXELS, ThermoxelsModelConfig
from thermoxels_ns.training.plain_areas import PlainAreas

BOX = SceneBox(aabb=torch.tensor([[-1.0, -1.0, -0.5], [1.0, 1.0, 0.5]]))


def plain_areas() -> PlainAreas:
    """The upper side of the box, grey all over, as a photograph from above shows it."""
    matrix = np.array([[8.0, 0.0, -8.0, 24.0], [0.0, -8.0, -8.0, 24.0], [0.0, 0.0, -1.0, 3.0]])
    pinhole = np.full((16, 16, 3), 0.5, np.float32), np.full((16, 16), np.nan, np.float32), matrix
    nothing = np.zeros(16 * 16, dtype=bool)
    return PlainAreas(gathered([pinhole], [(0.0, 0.0, 3.0)]), nothing, nothing)


LINES = FeatureRays(np.array([[0.0, 0.0, 3.0]]), np.array([0]), np.array([[0.1, 0.2, 0.0]]), np.array([0.01]))


def make(feature_rays: FeatureRays | None = None, size: float = 1.0, seen=(), **options) -> ThermoxelsModel:
    """A model of the box, so many times as large, with what else is known of the photographs."""
    config = ThermoxelsModelConfig(**{"resolutions": (8,), "refine_at": (), "prune_at": (), **options})
    metadata = {"temperature_range": TemperatureRange(10.0, 30.0), "feature_rays": feature_rays, **dict(seen)}
    return config.setup(scene_box=SceneBox(aabb=BOX.aabb * size), num_train_data=4, metadata=metadata)


def rays(n: int = 60, stream: int | None = RGB_STREAM | THERMAL_STREAM) -> RayBundle:
    generator = torch.Generator().manual_seed(0)
    origins = torch.tensor([0.0, 0.0, 3.0]) + 0.4 * torch.randn(n, 3, generator=generator)
    directions = torch.nn.functional.normalize(0.3 * torch.randn(n, 3, generator=generator) - origins, dim=-1)
    return RayBundle(
        origins,
        directions,
        torch.ones(n, 1),
        camera_indices=torch.arange(n)[:, None] % 4,
        metadata={} if stream is None else {"stream": torch.full((n, 1), stream, dtype=torch.uint8)},
    )


def targets(n: int = 60) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    return {"image": torch.rand(n, 3, generator=generator), "thermal": torch.rand(n, 1, generator=generator)}


def test_only_rays_that_meet_the_box_ahead_are_in_it():
    toward, away, beside, inside = ([0.0, 0.0, 3.0], [0.0, 0.0, -3.0], [1.2, 0.0, 3.0], [0.9, 0.9, 0.4])
    bundle = rays(4, stream=None)
    bundle.origins, bundle.directions = (
        torch.tensor([toward, away, beside, inside]),
        torch.tensor([[0.0, 0.0, -1.0]] * 4),
    )
    assert make().eval()(bundle)["in_box"][:, 0].tolist() == [1.0, 0.0, 0.0, 1.0]


def test_a_step_without_a_background_trains_surroundings_without_colour():
    terms = (model := make(background="off").train()).get_loss_dict(model(rays()), targets())
    assert all(bool(torch.isfinite(term)) for term in terms.values())


@pytest.mark.parametrize("recipe", list(LOSS_RECIPES))
def test_only_terms_of_non_zero_weight_are_computed(recipe):
    model = make(LINES, recipe=recipe, distortion_ramp=(0, 1)).train()
    model.update_to_step(10)
    model.backdrop_ray_sampler = model.feature_ray_sampler
    model.plain_areas = plain_areas()
    terms = set(model.get_loss_dict(model(rays()), targets()))
    weights = LOSS_RECIPES[recipe]
    assert terms == {f"{name}_loss" for name in vars(weights) if getattr(weights, name)}
    off = dict.fromkeys(vars(weights), 0.0) | {"rgb": 1.0}
    model = make(LINES, recipe=recipe, loss_overrides=off).train()
    assert set(model.get_loss_dict(model(rays()), targets())) == {"rgb_loss"}


def test_lines_of_sight_move_density_alone_and_weigh_as_asked():
    values = []
    for weight in (0.05, 0.1):
        model = make(LINES, loss_overrides={"tracks": weight}).train()
        term = model.get_loss_dict(model(rays()), targets())["tracks_loss"]
        term.backward()
        assert model.grid.density.grad is not None and bool(model.grid.density.grad.to_dense().any())
        assert model.grid.temperature.grad is None or not bool(model.grid.temperature.grad.to_dense().any())
        values.append(float(term.detach()))
    assert values[1] == pytest.approx(2.0 * values[0]) and values[0] > 0.0


def test_distortion_grows_over_its_ramp():
    model = make(distortion_ramp=(10, 20)).train()
    values = {}
    for step in (10, 12, 20, 30):
        model.update_to_step(step)
        values[step] = float(model.get_loss_dict(model(rays()), targets()).get("distortion_loss", torch.zeros(())))
    assert values[10] == 0.0 and values[12] == pytest.approx(0.2 * values[20]) and values[20] == values[30] > 0


@pytest.mark.parametrize("backend", ["fused", "reference"])
@pytest.mark.parametrize("stream, absent", [(RGB_STREAM, "temperature"), (THERMAL_STREAM, "sh")])
def test_a_stream_renders_only_what_it_needs(stream, absent, backend):
    """What a stream does not want is never read, has no loss and no gradient."""
    model = make(backend=backend, loss_overrides={f"tv_{absent}": 0.0}).train()
    model.grid.row_parameters()[absent].data.fill_(float("nan"))
    outputs = model(rays(stream=stream))
    other = "thermal" if absent == "temperature" else "rgb"
    assert float(outputs[other].abs().max()) == 0.0
    terms = model.get_loss_dict(outputs, targets())
    assert f"{other}_loss" not in terms and len(terms) >= 2
    sum(terms.values()).backward()
    gradient = model.grid.row_parameters()[absent].grad
    assert gradient is None or (backend == "reference" and float(gradient.to_dense().abs().max()) == 0.0)


@pytest.mark.parametrize(
    ("option", "parameter", "output"),
    [("per_image_offset", "thermal_offset", "thermal"), ("exposure", "log_gain", "rgb")],
)
def test_a_correction_has_a_fixed_gauge_and_changes_only_its_photograph(option, parameter, output):
    model = make(**{option: "on"}).train()
    plain = model(rays())[output].detach()
    values = getattr(model, parameter).data
    values[:] = 0.3  # the same for all: the gauge removes it
    torch.testing.assert_close(model(rays())[output].detach(), plain)
    values[:] = torch.tensor([0.4, 0.0, 0.0, 0.0]).view(-1, *[1] * (values.ndim - 1))
    seen = model(rays())[output].detach()
    change = seen - plain if output == "thermal" else torch.log(seen / plain)
    torch.testing.assert_close(change[::4], torch.full_like(change[::4], 0.3))
    torch.testing.assert_close(change[1::4], torch.full_like(change[1::4], -0.1))
    assert torch.equal(model.eval()(rays())[output], make().eval()(rays())[output])  # not in evaluation


def test_what_saturates_a_photograph_may_be_brighter():
    model = make(exposure="on").train()
    model.log_gain.data[:] = torch.tensor([1.5, -0.5, -0.5, -0.5])[:, None]  # 4.5 times brighter than the others
    outputs = model(rays())
    assert float(outputs["rgb"][::4].detach().min()) > 1.0
    measured = outputs["rgb"].detach().clamp(max=1.0)
    batch = {"image": measured, "thermal": outputs["thermal"].detach()}
    assert float(model.get_loss_dict(outputs, batch)["rgb_loss"].detach()) == 0.0
    darker = torch.where(measured == 1.0, measured - 0.1, measured)
    loss = model.get_loss_dict(outputs, {**batch, "image": darker})["rgb_loss"]
    loss.backward()
    assert float(loss.detach()) > 0.01 and float(model.log_gain.grad[0].abs().max()) > 0.0


def test_photographs_are_corrected_by_what_was_found_and_only_then():
    model = make().train()
    plain = model(rays())
    model.correct_photographs(np.array([1, 3]), None, None)
    for name in ("rgb", "thermal"):
        assert torch.equal(model(rays())[name], plain[name])
    model.correct_photographs(np.array([1, 3]), None, np.array([0.2, -0.2]))
    assert torch.equal(model(rays())["rgb"], plain["rgb"])
    shift = (model(rays())["thermal"] - plain["thermal"]).detach()[:, 0]
    torch.testing.assert_close(shift[1::4], torch.full((15,), 0.2))
    torch.testing.assert_close(shift[::4], torch.zeros(15))
    assert model.state_dict()["corrected"].tolist() == [False, True]


def test_gain_that_photographs_are_fitted_by():
    draw = torch.Generator().manual_seed(0)
    seen = torch.rand(2000, 3, generator=draw)
    gain = torch.tensor([1.3, 0.8, 1.0])
    target = (seen * gain).clamp(max=1.0)
    target[:100] = 0.0  # something stood before it
    torch.testing.assert_close(fitted_gain(seen, target), gain, atol=0.01, rtol=0.0)


def test_temperature_does_not_move_geometry_unless_asked():
    for moves in (False, True):
        model = make(thermal_density_gradient=moves, loss_overrides={"tv_density": 0.0, "distortion": 0.0}).train()
        terms = model.get_loss_dict(model(rays(stream=THERMAL_STREAM)), targets())
        terms["thermal_loss"].backward()
        gradient = model.grid.density.grad
        assert (gradient is not None and float(gradient.to_dense().abs().max()) > 0) is moves


def test_decisions_about_the_background_are_in_the_checkpoint():
    model = make()
    assert model.backdrop_on.tolist() == [True, True, True]
    model.backdrop_on[:] = torch.tensor([False, True, False])
    loaded = make()
    loaded.load_state_dict(model.state_dict())
    assert loaded.backdrop_on.tolist() == [False, True, False]
    model.eval(), loaded.eval()
    assert torch.equal(model(rays())["rgb"], loaded(rays())["rgb"])


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"resolutions": (8, 12), "refine_at": (5,)}, "resolutions and refine_at"),
        ({"resolutions": (8, 16)}, "resolutions and refine_at"),
        ({"refine_at": (5,)}, "resolutions and refine_at"),
        ({"loss_overrides": {"tv": 1.0}}, r"loss_overrides\.tv: expected one of rgb, thermal"),
        *(({"loss_overrides": {"rgb": value}}, "loss_overrides rgb") for value in (float("nan"), -1.0)),
        *(({"start_density": value}, "start_density") for value in (0.0, -1.0)),
        ({"near_plane": -5.0}, "near_plane"),
        ({"prune_threshold": float("nan")}, "prune_threshold"),
        ({"smallest_weight": 0.5}, "smallest_weight"),
        ({"prune_at": (0,)}, "prune_at"),
    ],
)
def test_values_that_cannot_work_are_refused(options, named):
    with pytest.raises(ThermoxelsError, match=f"^{named}"):
        make(**options)


def test_a_scene_without_a_temperature_range_is_refused():
    with pytest.raises(SceneError, match=r"^scene: "):
        ThermoxelsModelConfig(resolutions=(8,), refine_at=()).setup(scene_box=BOX, num_train_data=1, metadata={})


def test_snapshot_holds_what_rays_say_on_the_whole_lattice():
    """After pruning, no ray ends in voxels that are not kept, and their corners are grey."""
    model = make(start_density=5.0).eval()
    sh = model.grid.row_parameters()["sh"]
    sh.data = 3 * torch.randn(sh.shape, generator=torch.Generator().manual_seed(0))
    prune(model.grid, model.grid.voxels.cells // 32 >= 4)  # x > 0 of 8 x 8 x 4 voxels
    views = Views(np.eye(4)[None, :3], np.ones((1, 2)), np.ones((1, 2)), np.ones((1, 2), np.int64))
    snapshot = model.grid_snapshot([rays(), rays(stream=RGB_STREAM)], views)
    evidence, colour = snapshot.evidence, snapshot.colour
    assert snapshot.views is views and evidence is not None and colour is not None
    assert evidence.half_depth_density.dtype == evidence.ends.dtype == np.float32 and (evidence.ends[:, 0] >= 4).all()
    np.testing.assert_allclose(evidence.half_depth_density, 5.0, rtol=1e-5)
    # Degree 0 alone, as the field renders it at the corners from any side.
    corners = torch.as_tensor(model.grid.lattice.corner_positions(), dtype=torch.float32)[4:].reshape(-1, 3)
    seen = model.grid.rgb_at(model.grid.locate(corners), torch.eye(3)[torch.arange(len(corners)) % 3])
    np.testing.assert_allclose(colour[4:].reshape(-1, 3), seen.detach(), atol=1e-6)
    assert colour[4:].std() > 0.1 and (colour[:4] == 0.5).all()


def test_a_crop_is_kept():
    model = make(start_density=30.0, background="off").eval()
    bundle = rays(stream=None)
    whole = model(bundle)["accumulation"]
    bundle.nears, bundle.fars = torch.full((60, 1), 2.9), torch.full((60, 1), 2.95)
    cropped = model(bundle)["accumulation"]
    assert float(cropped.max()) < 0.9 * float(whole.max()) and float(cropped.max()) > 0.0


def test_depth_of_a_miss_does_not_depend_on_its_neighbours():
    model = make(start_density=1e-12).eval()
    bundle = rays(stream=None)
    bundle.directions = bundle.directions * torch.tensor([1.0, 1.0, -1.0])  # away from the box
    together, alone = model(bundle)["depth"], model(bundle[:1])["depth"]
    assert torch.equal(together[:1], alone) and torch.isfinite(together).all()


def test_other_sizes_of_the_world_are_converted():
    """The same scene ten times larger starts equally transparent and costs the same distortion."""
    results = []
    for size in (1.0, 10.0):
        model = make(size=size, distortion_ramp=(0, 1), near_plane=0.5).train()
        model.update_to_step(5)
        bundle = rays()
        bundle.origins = bundle.origins * size
        outputs = model(bundle)
        results.append((outputs["render"].box.accumulation, model.get_loss_dict(outputs, targets())["distortion_loss"]))
    torch.testing.assert_close(results[0][0], results[1][0], rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(results[0][1], results[1][1], rtol=1e-3, atol=1e-9)


def test_masked_pixels_do_not_count_in_evaluation():
    model = make().eval()
    generator = torch.Generator().manual_seed(2)
    outputs = {"rgb": torch.rand(24, 32, 3, generator=generator), "thermal": torch.rand(24, 32, 1, generator=generator)}
    outputs |= {name: torch.ones(24, 32, 1) for name in ("accumulation", "depth", "in_box")}
    mask = torch.zeros(24, 32, 1, dtype=torch.bool)
    mask[:, :16] = True
    batch = {"image": outputs["rgb"].clone(), "thermal": outputs["thermal"].clone(), "mask": mask}
    batch["thermal_valid"] = torch.ones_like(mask)
    batch["image"][:, 16:] = 0.0
    batch["thermal"][:, 16:] = 1.4  # above the range, and masked
    metrics, images = model.get_image_metrics_and_images(outputs, batch)
    assert metrics["psnr"] == pytest.approx(100.0) and metrics["thermal_mae_c"] == 0.0
    assert metrics["psnr_8"] == pytest.approx(100.0)
    assert metrics["psnr_box"] == pytest.approx(100.0) and metrics["thermal_mae_box_c"] == 0.0
    assert metrics["ssim"] == pytest.approx(1.0) and metrics["thermal_ssim"] == pytest.approx(1.0)
    assert float(images["thermal"].max()) <= 1.0
    batch["image"][:, :4], batch["thermal"][:, :4] = outputs["rgb"][:, :4] + 0.1, outputs["thermal"][:, :4] + 0.1
    outputs["in_box"][:, 8:] = 0.0  # wrong are half of the pixels that the box covers, a quarter of all
    metrics, _ = model.get_image_metrics_and_images(outputs, batch)
    assert metrics["psnr_box"] == pytest.approx(23.01, abs=0.01) and metrics["psnr"] == pytest.approx(26.02, abs=0.01)
    assert metrics["psnr_8"] == pytest.approx(29.03, abs=0.01)  # half of each of the blocks there is off by 0.1
    assert metrics["thermal_mae_box_c"] == pytest.approx(1.0) and metrics["thermal_mae_c"] == pytest.approx(0.5)


@pytest.mark.parametrize("environment, expected", [("5", None), (None, 4)])
def test_torch_leaves_room_for_other_programs(monkeypatch, environment, expected):
    """Half of eight processors, unless OMP_NUM_THREADS says otherwise; the kernels take all unless the option does."""
    torch_asked, kernels_asked = [], []
    monkeypatch.setattr(torch, "set_num_threads", torch_asked.append)
    monkeypatch.setattr(pipeline, "set_num_threads", kernels_asked.append)
    monkeypatch.setattr("os.cpu_count", lambda: 8)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    if environment is not None:
        monkeypatch.setenv("OMP_NUM_THREADS", environment)
    for given in (3, None):
        config = pipeline.ThermoxelsPipelineConfig(cpu_threads=given)
        with pytest.raises((AttributeError, TypeError)):  # no datamanager is configured: threads come first
            config.setup(device="cpu")
    assert torch_asked == ([] if expected is None else [expected, expected]) and kernels_asked == [3, None]


def test_a_lattice_beyond_the_budget_is_refused_before_it_is_built(monkeypatch):
    monkeypatch.setattr("thermoxels_ns.training.model.VoxelGrid", lambda *_: pytest.fail("the field was built"))
    with pytest.raises(MemoryBudgetError, match=r"4096 x 4096 x 2048 voxels .*--pipeline.model.memory-budget-gb"):
        make(resolutions=(4096,), memory_budget_gb=64.0)


@pytest.mark.parametrize(
    ("voxels", "expected"),
    [
        (113.0, (32, 64, 128)),
        (128.0, (32, 64, 128)),
        (160.0, (40, 80, 160)),
        (220.0, (56, 112, 224)),
        (230.0, (64, 128, 256)),
        (5000.0, (96, 192, 384)),
        (1.0, (8, 16, 32)),
        (math.inf, (32, 64, 128)),
    ],
)
def test_resolutions_follow_the_photographs_up_to_a_limit(voxels, expected):
    config = ThermoxelsModelConfig(voxel_pixels=2.0).suited_to(voxels)
    assert config.resolutions == expected and max(config.prune_at) < config.thin_at[0]
    own = ThermoxelsModelConfig(voxel_pixels=2.0, refine_at=(5, 9)).suited_to(voxels)
    assert own.refine_at == (5, 9) and own.resolutions[-1] <= 192, "steps of one's own stay"
    assert ThermoxelsModelConfig(voxel_pixels=0.0).suited_to(voxels).resolutions == (32, 64, 128), "nothing is asked"
    config.check()
    assert config.resolutions[-1] <= MOST_VOXELS * 128


@pytest.mark.parametrize(
    ("pixel_size", "expected"), [(2.0 / 160 / 1.6, (40, 80, 160)), (1e-6, (96, 192, 384)), (None, (32, 64, 128))]
)
def test_a_model_has_the_voxels_that_its_photographs_ask_for(pixel_size, expected):
    default = {name: getattr(ThermoxelsModelConfig(), name) for name in ("resolutions", "refine_at", "prune_at")}
    seen = {} if pixel_size is None else {"pixel_size": pixel_size}
    model = make(seen=seen, **default, voxel_pixels=1.6)
    assert isinstance(model, ThermoxelsModel) and model.config.resolutions == expected
    assert max(model.grid.lattice.cell_shape) == expected[0]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return write_scene(
        make_scene("sphere"), tmp_path_factory.mktemp("pixels"), 12, 2, width=160, height=120, progress=False
    )


@pytest.mark.parametrize("given", [False, True])
@pytest.mark.parametrize("factor", [None, 2])
def test_a_pixel_is_as_wide_as_it_is_where_the_body_stands(folder, factor, given):
    scene = make_scene("sphere")
    box = tuple(tuple(corner) for corner in np.asarray(scene.scene_box).tolist()) if given else None
    config = ThermalDataParserConfig(data=folder, scene_box=box, downscale_factor=factor)
    outputs = config.setup().get_dataparser_outputs()
    away = np.linalg.norm(np.concatenate(scene.poses(12, 2))[:, :3, 3], axis=1)
    focal = float(outputs.cameras.fx[0])
    size = outputs.metadata["pixel_size"] / outputs.dataparser_scale
    radius = 0.5 * np.ptp(np.asarray(scene.scene_box), axis=0).max()
    assert (away.mean() - radius) / focal < size < away.mean() / focal
