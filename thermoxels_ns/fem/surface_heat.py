"""Heat flow through parts of the surface, such as that of each material."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.checks import check_shape
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.forms import FixedNodes, SourceForm, effect_forms
from thermoxels_ns.fem.problem import HeatProblem, effect_labels
from thermoxels_ns.fem.selection import Selection
from thermoxels_ns.fem.solution import EffectHeat, heat_by_effect
from thermoxels_ns.fem.space import Space
from thermoxels_ns.fem.system import HeatSystem

Vector = npt.NDArray[np.float64]


def heat_by_part(
    problem: HeatProblem,
    temperature_c: Vector,
    time_s: float,
    part: npt.NDArray[np.int64],
    part_names: Sequence[str],
) -> tuple[EffectHeat, ...]:
    """Evaluate the heat flow of each effect through parts of the surface at one moment.

    Fixed temperatures are counted as if their nodes stored nothing at that moment, which holds for constant ones.
    Boundary exchange is evaluated as the solvers do by default: at the nodes of linear tetrahedra, and integrated over
    each triangle if they are quadratic.

    Args:
        problem: Body and effects.
        temperature_c: Temperatures at that moment, shape (n,), [degrees Celsius]: of the mesh's nodes, or of them and
            then the middles of its edges, in the order of `mesh_edges`, if tetrahedra are quadratic.
        time_s: The moment, [s].
        part: Index into `part_names` of each boundary triangle, shape (f,).
        part_names: Names of the parts.

    Returns:
        Heat into the body, one row, for each effect that acts on the surface; sources are left out.

    Raises:
        HeatError: `part` does not have one entry per boundary triangle, or the temperatures are not those of this mesh.
    """
    remedy = "Give every boundary triangle of the mesh a part."
    part = check_shape("part", np.asarray(part), (len(problem.mesh.facets),), remedy, HeatError)
    selection = Selection(problem.mesh, problem.up)
    parted = copy.copy(selection)
    parted.facet_patch, parted.patch_names = part, tuple(part_names)
    order = 1 if len(temperature_c) == len(problem.mesh.points_m) else 2
    space = Space(parted, order=order, lumped=order == 1)
    remedy = "Give the temperatures of the problem that was solved."
    check_shape("temperature_c", temperature_c, (space.num_nodes,), remedy, HeatError)
    reference_c = 0.5 * (float(temperature_c.min()) + float(temperature_c.max()))
    relative_k = temperature_c - reference_c
    acting = effect_forms(problem, space, reference_c, where=selection)
    forms = [form for form in acting.exchanging if not isinstance(form, SourceForm)]
    groups = [(form.effect, group) for form in forms for group in form.groups]
    flows = [form.group_heat_w(relative_k, time_s) for form in forms]
    if acting.fixed:
        held, system = FixedNodes(acting.fixed, space.num_nodes), HeatSystem(problem, lumped=order == 1, order=order)
        groups += held.groups
        kept_w = -system.net_heat_at_fixed(temperature_c - system.reference_c, time_s)
        flows.append(held.shares @ kept_w)
    named = [label for label in effect_labels(problem) if any(owner == label for owner, _ in groups)]
    return heat_by_effect(named, groups, np.concatenate([np.zeros(0), *flows])[None])


def heat_through_parts(effects: Sequence[EffectHeat], part_names: Sequence[str]) -> Vector:
    """Add up the effects' heat through each part, shape (s, p), [W].

    >>> heat = EffectHeat("sun", np.array([3.0]), ("roof", "wall"), np.array([[2.0, 1.0]]))
    >>> heat_through_parts([heat, heat], ["wall", "floor", "roof"]).tolist()
    [[2.0, 0.0, 4.0]]
    """
    rows = len(effects[0].heat_w) if effects else 1
    total = np.zeros((rows, len(part_names)))
    for effect in effects:
        for column, name in enumerate(effect.group_names):
            if name in part_names:
                total[:, list(part_names).index(name)] += effect.group_heat_w[:, column]
    return total
