"""Compare two surveys of one building: align their meshes, and compute what changed, with intervals."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from thermoxels_ns.audit.conditions import Conditions
from thermoxels_ns.audit.defects import FoundDefect
from thermoxels_ns.audit.draws import FORMULA, SEED, Draws, Interval, draw, interval_of, uncertain
from thermoxels_ns.audit.exchange import Parts, with_references
from thermoxels_ns.audit.run import Audit
from thermoxels_ns.audit.surface import AuditedSurface
from thermoxels_ns.core.arrays import BoolArray, FloatArray, IntArray
from thermoxels_ns.core.errors import AuditError
from thermoxels_ns.core.yaml_records import as_record, raising

_DRAWS = 4000  # Ends of intervals scatter by about 1 % of the width
_NEAR_M = 0.3  # Largest distance of the same surface in both, [m]: more than insulation or errors of meshes move it
_FACES = 0.7  # Least cosine between normals of the same surface
_ONE_POSITION = "one position in which the meshes fit each other"
_POSE_TOGETHER = "Compare surveys of the same building in metres, or pose the photographs of both together."
_FITS_M, _UNMATCHED_M = 0.2, 1.0  # Largest median distance of meshes that fit; distance of points without a partner
_TURN_DEG = 15.0  # Step between the directions in which an alignment starts
_ALIGN_STEPS = 25  # Steps of each alignment
_LIKE_BEST = 1.3  # Alignment is ambiguous if another position has a mean distance below about this times the best one
_SEEN_SHARE = 0.2  # Least share of an element that the other survey must have seen, too
_OVERLAP = 0.5  # Two surveys found one bridge if both cores hold this share of the area of the smaller core

State = Literal["in both", "appeared", "went"]


@dataclass(frozen=True)
class Change:
    """How an element or a thermal bridge changed; numbers are those of the surface that both surveys saw."""

    name: str  # Of the element; of a bridge its kind and element
    state: State  # "appeared" or "went": a bridge that only the later or only the earlier survey found
    at_m: tuple[float, float, float]  # Centroid in the coordinates of the later mesh
    unit: str
    before: Interval  # U-value; of a line psi, [W/(m K)], of a point or an area extra loss per kelvin, [W/K]
    after: Interval
    change: Interval  # After minus before
    loss_change_w: Interval  # At `Comparison.difference_k`
    significant: bool  # True if the interval of `change` does not hold 0


@dataclass(frozen=True)
class Comparison:
    """What changed between two surveys of one building."""

    whole: Change  # All that both surveys saw
    elements: tuple[Change, ...]  # Significant ones first, then by falling change of the loss
    bridges: tuple[Change, ...]
    only_before: tuple[str, ...]  # Names, in the earlier survey, of elements that only the earlier survey saw
    only_after: tuple[str, ...]
    difference_k: float  # Inside minus outside air at which losses are compared, [K]
    common: tuple[str, ...]  # Causes of uncertainty that are drawn the same in both surveys
    moved: bool  # True if the earlier mesh was turned and shifted onto the later one
    residual_m: float  # Median distance between the two surfaces, [m]


class Pose(NamedTuple):
    """A rotation and a shift that take the earlier mesh's coordinates into those of the later one."""

    turn: FloatArray  # Shape (3, 3)
    shift_m: FloatArray  # Shape (3,)

    def __call__(self, points_m: FloatArray) -> FloatArray:
        """Return points of the earlier mesh, shape (n, 3), in the coordinates of the later mesh."""
        return points_m @ self.turn.T + self.shift_m


@raising(AuditError)
def earlier_conditions(name: str, content: Mapping[str, Any]) -> Conditions:
    """Return the conditions in the entry "conditions" of the answers.json `name`, without its keys in `unused`."""

    def known(value: Any) -> Any:
        if not isinstance(value, Mapping):
            return value
        # An air that was not known has the value null.
        pairs = value.items()
        return {key: known(one) for key, one in pairs if not (isinstance(one, dict) and one.get("value", 0) is None)}

    unused = {"limits", "energy", "calibrate", "weather", "storeys"}  # older audits have storeys
    return as_record(name, {key: known(one) for key, one in content.items() if key not in unused}, Conditions)


def compare(before: Audit, after: Audit, difference_k: float | None = None) -> Comparison:
    """Return what changed between two audits of one building.

    Elements are the patches of the later survey, on the surface that both saw: each triangle of the later mesh takes
    the earlier reading of the triangle nearest to it. Losses are those at `difference_k`, inside minus outside air, by
    default as in the later survey, [K]. Errors of emissivities, film factor and formula are the same in both surveys.
    Raises `AuditError` if sides or film models of the surveys differ, a temperature outside is not known, no position
    of the earlier mesh fits the later one, or the surveys saw no common surface.
    """
    sides = (before.conditions.side, after.conditions.side)
    for one in (before.conditions, after.conditions):
        if sides[0] != sides[1] or not one.outside_known:
            got = f"{sides[0]} before, {sides[1]} after" if sides[0] != sides[1] else "an air outside that is not known"
            remedy = "Compare surveys from the same side, both with the air outside."
            raise AuditError("compare", expected="two surveys whose U-values can be compared", got=got, remedy=remedy)
    films = tuple(one.conditions.film.model for one in (before, after))
    if films[0] != films[1]:
        remedy = "Audit the earlier mesh again with the film of the later conditions."
        got = " and ".join(films)
        raise AuditError("compare", expected="one film model in both surveys", got=got, remedy=remedy)
    difference_k = difference_k or after.conditions.difference_k
    first, second = before.surface, after.surface
    pose, residual_m, moved = aligned(first, second)
    at_first = _places(pose(first.centroid_m), first.selection.facet_normal @ pose.turn.T)
    at_second = _places(second.centroid_m, second.selection.facet_normal)
    partner, back = _partners(second, at_second, first, at_first), _partners(first, at_first, second, at_second)
    elements, only_after = _elements(second, partner >= 0)
    if not elements:
        got = "no surface that both surveys saw"
        raise AuditError("compare", expected=_ONE_POSITION, got=got, remedy=_POSE_TOGETHER)
    bridges, names, count = _bridges(before, after, partner), [*elements], len(elements)
    parts = [*elements.values(), *(part for _, one in bridges for part in (one.zone, one.reference))]
    earlier = draw(before.conditions, _DRAWS, SEED)
    later, common = _with_common(before.conditions, after.conditions, earlier)
    shared = replace(second, counted=partner >= 0)
    carried = replace(shared, reading_c=first.reading_c[partner], surface_entry=first.surface_entry[partner])
    flows = [_flows(before, earlier, carried, parts), _flows(after, later, shared, parts)]
    areas = np.array([second.area_m2[part].sum() for part in parts])

    def changed(name: str, at: IntArray, drawn: list[FloatArray], size: float, **more: Any) -> Change:
        """Return a change from draws before and after, (k,) each; draws times `size`, [m2] or [m], are in [W/K]."""
        x, y, z = np.average(second.centroid_m[at], axis=0, weights=second.area_m2[at]).tolist()
        change = interval_of(drawn[1] - drawn[0])
        loss = Interval(*(size * difference_k * one for one in (change.value, change.low, change.high)))
        sure = not change.low <= 0.0 <= change.high
        was, now = map(interval_of, drawn)
        about = {"state": "in both", "unit": "W/(m2 K)", "before": was, "after": now, **more}
        return Change(name, at_m=(x, y, z), change=change, loss_change_w=loss, significant=sure, **about)

    u = [(flow + own)[:count] / areas[:count, None] for flow, own in flows]
    changes = [changed(name, parts[n], [one[n] for one in u], areas[n]) for n, name in enumerate(names)]
    means = [areas[:count] @ one / areas[:count].sum() for one in u]
    found = list[Change]()
    for n, (state, one) in enumerate(bridges):
        zone, calm = count + 2 * n, count + 2 * n + 1
        length, unit = (one.length_m, "W/(m K)") if one.kind == "line" else (1.0, "W/K")
        drawn = [(flow[zone] + own[zone] - flow[calm] / areas[calm] * one.base_area_m2) / length for flow, own in flows]
        patch = (before if state == "went" else after).surface.selection.patch_names[one.patch]
        name = f"{'thermal bridge' if one.kind != 'area' else 'defect'} ({one.kind}) in {patch}"
        found.append(changed(name, one.zone, drawn, length, state=state, unit=unit))
    return Comparison(
        whole=changed("all that both saw", np.concatenate(parts[:count]), means, float(areas[:count].sum())),
        elements=_ranked(changes),
        bridges=_ranked(found),
        only_before=_elements(first, back >= 0)[1],
        only_after=only_after,
        difference_k=difference_k,
        common=common,
        moved=moved,
        residual_m=residual_m,
    )


def _elements(surface: AuditedSurface, shared: BoolArray) -> tuple[dict[str, IntArray], tuple[str, ...]]:
    """Return the triangles of each patch that both surveys saw (`shared`), and names of patches that one alone saw."""
    seen, alone, patch = dict[str, IntArray](), list[str](), surface.selection.facet_patch
    for number in np.unique(patch[surface.counted]):
        every, name = surface.counted & (patch == number), surface.selection.patch_names[number]
        part = every & shared
        if part.any() and surface.area_m2[part].sum() >= _SEEN_SHARE * surface.area_m2[every].sum():
            seen[name] = np.flatnonzero(part)
        else:
            alone.append(name)
    return seen, tuple(alone)


def _flows(audit: Audit, draws: Draws, surface: AuditedSurface, parts: list[IntArray]) -> tuple[FloatArray, FloatArray]:
    """Return draws of the flow per kelvin through each part, and of its error by a reading error of the part alone.

    Shapes are (p, k), [W/K]. `draws` are those of the survey before contact temperatures correct the camera offset.
    """
    conditions, draws = audit.conditions, with_references(audit.surface, audit.conditions, draws)
    found = Parts(conditions, surface, draws, parts)
    off_k = np.stack([draws.local(conditions.camera.repeatability.off_by, n) for n in range(len(parts))])
    return found.in_draws(draws)[1] / draws.difference_k, found.slope_w_k[:, None] * off_k / draws.difference_k


def _bridges(before: Audit, after: Audit, partner: IntArray) -> list[tuple[State, FoundDefect]]:
    """Return the bridges of both surveys, as triangles of the later mesh that both surveys saw.

    A bridge of both is listed once, as the later survey found it. A bridge of one survey is left out if the other saw
    less than half of its zone. `partner`, (f,), is the earlier mesh's triangle beside each of the later mesh, or -1.
    """
    area_m2 = after.surface.area_m2

    def carried(audit: Audit, to: Callable[[IntArray], IntArray]) -> Iterator[tuple[float, FoundDefect]]:
        """Yield the share of a zone that both saw, and the bridge, carried by `to` to triangles of the later mesh."""
        for defect, one in zip(audit.defects, audit.found):
            if not defect.not_counted:
                core, zone, calm = map(to, (one.core, one.zone, one.reference))
                share = float(area_m2[zone].sum() / audit.surface.area_m2[one.zone].sum())
                base_m2 = share * one.base_area_m2
                yield share, replace(one, core=core, zone=zone, reference=calm, base_area_m2=base_m2)

    def same(one: FoundDefect, other: FoundDefect) -> bool:
        smaller = min(area_m2[one.core].sum(), area_m2[other.core].sum())
        return bool(area_m2[np.intersect1d(one.core, other.core)].sum() >= _OVERLAP * smaller > 0.0)

    was = [*carried(before, lambda part: np.flatnonzero(np.isin(partner, part)))]
    now = [*carried(after, lambda part: part[partner[part] >= 0])]
    found = list[tuple[float, State, FoundDefect]]()
    for share, one in now:
        if any(same(one, other) for _, other in was):
            found.append((1.0, "in both", one))
        else:
            found.append((share, "appeared", one))
    found.extend((share, "went", one) for share, one in was if not any(same(one, other) for _, other in now))
    return [(state, one) for share, state, one in found if share >= 0.5 and len(one.zone) and len(one.reference)]


def _ranked(changes: Sequence[Change]) -> tuple[Change, ...]:
    return tuple(sorted(changes, key=lambda one: (not one.significant, -abs(one.loss_change_w.value))))


def _with_common(before: Conditions, after: Conditions, earlier: Draws) -> tuple[Draws, tuple[str, ...]]:
    """Return draws of the later survey, and the names of the quantities whose errors are the same as in `earlier`.

    They are emissivities, film factor and film formula, as far as both surveys state them as uncertain.
    """
    later = draw(after, _DRAWS, SEED + 1)
    values, common, stated, was = dict(later.values), list[str](), uncertain(after), uncertain(before)
    for name, what in stated.items():
        alike = name.startswith("emissivity of ") or name == "film factor"
        if alike and name in was and what.off_by > 0.0 and was[name].off_by > 0.0:
            off = (earlier[name] - was[name].value) / was[name].off_by
            values[name] = what.value + off * what.off_by
            common.append(name)
    if FORMULA in values and FORMULA in earlier.values and np.array_equal(before.film_shares, after.film_shares):
        values[FORMULA] = earlier[FORMULA]
        common.append(FORMULA)
    return replace(later, values=values), tuple(common)


def _places(points_m: FloatArray, normal: FloatArray) -> FloatArray:
    """Return points beside scaled unit normals, (n, 6): surfaces near by that face another way are far apart there."""
    return np.concatenate([points_m, _NEAR_M * normal], axis=1)


def _partners(surface: AuditedSurface, at: FloatArray, other: AuditedSurface, other_at: FloatArray) -> IntArray:
    """Return for each triangle of `surface` the nearest triangle of `other` within `_NEAR_M` that faces the same way.

    The shape is (f,); -1: there is none. Both triangles must count. `at` and `other_at` are the `_places` of all.
    """
    which, others, found = np.flatnonzero(surface.counted), np.flatnonzero(other.counted), np.full(len(at), -1)
    nearest = others[KDTree(other_at[others]).query(at[which])[1]]
    apart = np.linalg.norm(at[which, :3] - other_at[nearest, :3], axis=1)
    facing = np.einsum("ij,ij->i", at[which, 3:], other_at[nearest, 3:]) >= _FACES * _NEAR_M**2
    same = facing & (apart <= _NEAR_M)
    found[which[same]] = nearest[same]
    return found


def aligned(before: AuditedSurface, after: AuditedSurface) -> tuple[Pose, float, bool]:
    """Return the pose of the earlier mesh, the median distance of the surfaces, [m], and whether it had to be moved.

    Triangles that count and that photographs support are compared. If the meshes fit as they are, the pose is the
    identity. Else it is the best point-to-plane iterative closest point alignment (Chen and Medioni 1992) of starts
    `_TURN_DEG` apart around the vertical with equal centroids; each step ignores the worst third of the points.
    Raises `AuditError` if no position fits, or if two positions fit about equally well.
    """
    (points, normals), (target, facing) = (_samples(one) for one in (before, after))
    tree = KDTree(_places(target, facing))

    def distances(pose: Pose) -> tuple[FloatArray, FloatArray, IntArray]:
        moved, turned = pose(points), normals @ pose.turn.T
        nearest = np.asarray(tree.query(_places(moved, turned))[1], dtype=np.int64)
        along = np.einsum("ij,ij->i", target[nearest] - moved, facing[nearest])
        lost = np.linalg.norm(target[nearest] - moved, axis=1) > _UNMATCHED_M
        lost |= np.einsum("ij,ij->i", turned, facing[nearest]) < _FACES
        return np.where(lost, _UNMATCHED_M, along), moved, nearest

    def refined(pose: Pose) -> Pose:
        for _ in range(_ALIGN_STEPS):
            along, moved, nearest = distances(pose)
            kept = np.argsort(np.abs(along))[: (2 * len(along)) // 3]
            towards, middle = facing[nearest[kept]], moved[kept].mean(axis=0)
            matrix = np.concatenate([np.cross(moved[kept] - middle, towards), towards], axis=1)
            step = np.linalg.lstsq(matrix, along[kept], rcond=1e-3)[0]
            turn = Rotation.from_rotvec(step[:3]).as_matrix()
            pose = Pose(turn @ pose.turn, turn @ (pose.shift_m - middle) + middle + step[3:])
        return pose

    as_given = Pose(np.eye(3), np.zeros(3))
    edge = 2.0 * float(np.sqrt(2.0 * max(np.median(one.area_m2[one.counted]) for one in (before, after))))
    given = np.abs(distances(as_given)[0])
    back = KDTree(_places(points, normals)).query(_places(target, facing))[0]  # one survey may have seen less
    for off in (given, np.minimum(back, _UNMATCHED_M)):
        if off.mean() <= min(edge, _FITS_M):
            return as_given, float(np.median(off)), False
    up = [np.array(one.selection.up) for one in (before, after)]
    upright = Rotation.align_vectors(up[1][None], up[0][None])[0].as_matrix()
    tried = list[tuple[float, float, Pose]]()  # The mean tells what a notch or a balcony shows, the median not
    for degrees in np.arange(0.0, 360.0, _TURN_DEG):
        turn = Rotation.from_rotvec(np.radians(degrees) * up[1]).as_matrix() @ upright
        pose = refined(Pose(turn, target.mean(axis=0) - turn @ points.mean(axis=0)))
        off = np.abs(distances(pose)[0])
        tried.append((float(off.mean()), float(np.median(off)), pose))
    tried.sort(key=lambda one: one[0])
    best, median, pose = tried[0]
    if np.median(given) <= _FITS_M and given.mean() <= 1.5 * best:
        return as_given, float(np.median(given)), False
    others = [
        one for one in tried if _turned_deg(pose, one[2]) > _TURN_DEG and one[0] <= _LIKE_BEST * best + 0.1 * edge
    ]
    if median > _FITS_M or others:
        got = f"{median:.2f} m between them (median) where they fit best"
        if others:
            got = f"two positions, {_turned_deg(pose, others[0][2]):.0f} degrees apart"
        raise AuditError("compare", expected=_ONE_POSITION, got=got, remedy=_POSE_TOGETHER)
    return pose, median, True


def _turned_deg(one: Pose, other: Pose) -> float:
    return float(np.degrees(Rotation.from_matrix(one.turn @ other.turn.T).magnitude()))


def _samples(surface: AuditedSurface, most: int = 3000) -> tuple[FloatArray, FloatArray]:
    """Return centroids and normals of `most` random triangles that count and are supported, by area, (n, 3) each."""
    which = np.flatnonzero(surface.counted & ~surface.unsupported)
    which = which if len(which) else np.flatnonzero(surface.counted)
    share = surface.area_m2[which] / surface.area_m2[which].sum()
    chosen = np.random.default_rng(SEED).choice(which, most, p=share)
    return surface.centroid_m[chosen], surface.selection.facet_normal[chosen]
