"""The forms of a problem's effects: what acts on a body, ready to become numbers on its nodes."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace

from thermoxels_ns.fem.forms import FixedForm, FluxForm, Form, RadiationForm, RobinForm, SourceForm
from thermoxels_ns.fem.linear_space import LinearSpace
from thermoxels_ns.fem.problem import HeatProblem
from thermoxels_ns.fem.selection import Selection
from thermoxels_ns.fem.solver_statistics import Assembled
from thermoxels_ns.fem.terms import FluxTerm, RadiationTerm, RobinTerm, SourceTerm


@dataclass(frozen=True)
class EffectForms:
    """Forms by what they do to the heat equation, each in the order of the effects."""

    robin: tuple[RobinForm, ...]
    """A matrix and a load."""
    loads: tuple[FluxForm | SourceForm, ...]
    """Loads that do not depend on the temperature."""
    radiation: tuple[RadiationForm, ...]
    """What depends on the temperature's fourth power."""
    fixed: tuple[FixedForm, ...]
    """Temperatures of nodes."""

    @property
    def exchanging(self) -> tuple[Form, ...]:
        """Forms that heat flows through other than by fixed nodes: convection, loads, radiation."""
        return (*self.robin, *self.loads, *self.radiation)


def effect_forms(
    problem: HeatProblem,
    space: LinearSpace,
    reference_c: float,
    bill: Assembled | None = None,
    *,
    where: Selection | None = None,
) -> EffectForms:
    """Turn effects into terms and terms into forms; what acts nowhere has none.

    Args:
        problem: The effects.
        space: The nodes.
        reference_c: What temperatures are relative to, [degrees Celsius].
        bill: Where fixed temperatures are counted, which are ready at once; None: nowhere.
        where: Patches and regions that effects are looked for in, if others than those that `space` adds up heat by.

    Raises:
        HeatError: An effect names what the mesh does not have.
    """
    robin: list[RobinForm] = []
    loads: list[FluxForm | SourceForm] = []
    radiation: list[RadiationForm] = []
    fixed: list[FixedForm] = []
    for label, effect in zip(effect_labels(problem), problem.effects):
        for bare in effect.terms(space.selection if where is None else where):
            if not len(bare.tets if isinstance(bare, SourceTerm) else bare.facets):
                continue
            term = replace(bare, effect=label)
            if isinstance(term, RobinTerm):
                robin.append(RobinForm(term, space, reference_c))
            elif isinstance(term, FluxTerm):
                loads.append(FluxForm(term, space))
            elif isinstance(term, SourceTerm):
                loads.append(SourceForm(term, space))
            elif isinstance(term, RadiationTerm):
                radiation.append(RadiationForm(term, space, reference_c))
            else:
                counted: AbstractContextManager[None] = nullcontext() if bill is None else bill.form("fixed")
                with counted:
                    fixed.append(FixedForm(term, space, reference_c))
    return EffectForms(tuple(robin), tuple(loads), tuple(radiation), tuple(fixed))


def effect_labels(problem: HeatProblem) -> tuple[str, ...]:
    """Names of a problem's effects for reports, all different: a second one of the same kind and place is numbered."""
    labels: list[str] = []
    for effect in problem.effects:
        label, number = effect.label, 1
        while label in labels:
            number += 1
            label = f"{effect.label} ({number})"
        labels.append(label)
    return tuple(labels)
