"""Scenes from a seed: the same everywhere, nothing thinner than three voxels; what a plan is made of."""

import itertools

import numpy as np
import pytest
import tyro

from thermoxels_ns.synthetic.catalogue import SceneWord, make_scene
from thermoxels_ns.synthetic.random_plan import SMALLEST, Plan
from thermoxels_ns.synthetic.random_scene import FAMILIES
from thermoxels_ns.synthetic.scene_truth import SyntheticScene
from thermoxels_ns.synthetic.solids import BoxSolid, SolidUnion, distance_to_box

# Things that rest on something are this close to it, found by the nearest of random points [voxels of the plan].
_CONTACT = 0.06


def laid_out(number: int, seed: int) -> Plan:
    plan = Plan(np.random.default_rng([99, seed]))
    FAMILIES[number].lay_out(plan)
    return plan


def boxes_of(scene: SyntheticScene) -> BoxSolid:
    return scene.solid.parts[0] if isinstance(scene.solid, SolidUnion) else scene.solid


def test_the_command_line_takes_names_and_seeds_and_refuses_others(capsys: pytest.CaptureFixture[str]) -> None:
    assert tyro.cli(SceneWord, args=["random-3"]) == "random-3"  # type: ignore[call-overload]
    assert tyro.cli(SceneWord, args=["sphere"]) == "sphere"  # type: ignore[call-overload]
    with pytest.raises(SystemExit) as stop:
        tyro.cli(SceneWord, args=["random-03"])  # type: ignore[call-overload]
    assert stop.value.code == 2
    assert "random-N" in capsys.readouterr().err


@pytest.mark.parametrize("seed", range(10))
def test_nothing_is_thinner_or_closer_than_three_voxels_of_128(seed: int) -> None:
    scene = make_scene(f"random-{seed}")
    boxes, voxel = boxes_of(scene), scene.size / 127
    points, normals = boxes.surface_points(2500, seed=2)
    for voxels in np.linspace(0.02, 2.99, 12):
        assert boxes.contains(points - voxels * voxel * normals).all()
        assert not boxes.contains(points + voxels * voxel * normals).any()


@pytest.mark.parametrize(("number", "seed"), list(itertools.product((1, 2), range(4))))
def test_round_things_keep_their_distance_or_rest_on_something(number: int, seed: int) -> None:
    plan = laid_out(number, seed)
    boxes = [piece.shape for piece in plan.pieces if isinstance(piece.shape, tuple)]
    things = [piece.shape for piece in plan.pieces if not isinstance(piece.shape, tuple)]
    assert len(things) >= 3
    assert all(2.0 * thing.radius > SMALLEST for thing in things)
    for thing in things:
        points = thing.surface_points(20_000, seed=1)[0]
        gaps = np.array([distance_to_box(points, *box).min() for box in boxes])
        resting = gaps < _CONTACT
        assert resting.any() and (gaps[~resting] > SMALLEST - _CONTACT).all()
        assert all(other.signed_distance(points).min() > SMALLEST for other in things if other is not thing)


def test_a_pane_has_its_own_paint_and_its_warmth() -> None:
    plan = Plan(np.random.default_rng(0))
    wall, glass = plan.paint("wall"), plan.paint("glass")
    plan.put(((0.0, 0.0, 0.0), (40.0, 20.0, 30.0)), wall, 0.2)
    plan.recess((1, -1, 0.0), (10.0, 18.0), (8.0, 20.0), 4.0, glass, 0.9)
    solid = plan.solid()
    assert solid.volume == pytest.approx(40 * 20 * 30 - 8 * 12 * 4)
    on_pane, beside = [[14.0, 4.0, 14.0]], [[4.0, 0.0, 4.0]]
    towards = [[0.0, -1.0, 0.0]]
    assert solid.signed_distance(on_pane)[0] == 0.0
    assert plan.part(on_pane, towards)[0] == glass and plan.part(beside, towards)[0] == wall
    assert plan.warmth(on_pane)[0] == pytest.approx(0.9) and plan.warmth(beside)[0] < 0.4
