"""Random plant: machinery on a slab, pipes and radiators at a wall."""

from __future__ import annotations

from collections.abc import Callable

from thermoxels_ns.synthetic.random_plan import HAIR, SMALLEST, WIDEST, Plan, Range
from thermoxels_ns.synthetic.solids import Box, Cylinder, Sphere

_AISLE = 4.0


def machinery(plan: Plan) -> None:
    """Tanks, drums, balls, blocks and frames on a floor slab, at least one of each."""
    u = plan.u
    size_x, size_y = u(102, WIDEST), u(84, 108)
    _floor(plan, size_x, size_y, 0.2)
    kinds: list[Callable[[Plan, Range, Range], None]] = [_tank, _drum, _ball, _block, _frame]
    kinds.append(kinds[int(plan.draw.integers(len(kinds)))])
    if plan.chance(0.3):
        kinds.pop()
    half = (size_x / 6.0 - _AISLE, size_y / 4.0 - _AISLE)
    places = plan.draw.permutation(6)[: len(kinds)].tolist()
    for kind, place in zip(kinds, places):
        middle = ((place % 3 - 1) * size_x / 3.0, (place // 3 - 0.5) * size_y / 2.0)
        kind(plan, middle, half)


def pipes_and_radiators(plan: Plan) -> None:
    """A wall on a floor, radiators and standing pipes close to both of its sides, lying pipes on posts before them."""
    u = plan.u
    size_x, size_y = u(102, WIDEST), u(86, 100)
    _floor(plan, size_x, size_y, 0.15)
    half, thick, high = 0.5 * u(84, size_x - 8.0), u(4, 8), u(56, 76)
    wall: Box = ((-half, -0.5 * thick, 0.0), (half, 0.5 * thick, high))
    plan.put(wall, plan.paint("wall"), u(0.1, 0.35))
    for _ in range(int(plan.draw.integers(1, 4))):
        plan.spot(wall, u(0.4, 0.9), u(10, 24))
    lying = (True, plan.chance(0.5)) if plan.chance(0.5) else (plan.chance(0.5), True)
    for sign, heated, crossed in ((-1, True, lying[0]), (1, plan.chance(0.4), lying[1])):
        plane, free, reach = 0.5 * thick, [-half + 6.0, half - 6.0], 8.0
        if heated:
            width = u(28, 40)
            at = free[0] if plan.chance(0.5) else free[1] - width
            free = [at + width + 4.0, free[1]] if at == free[0] else [free[0], at - 4.0]
            reach = _radiator(plan, sign, plane, (at, at + width))
        for number in range(count := int(plan.draw.integers(1, 3)) if heated else int(plan.draw.integers(2, 4))):
            cell = (free[1] - free[0]) / count
            radius, gap = u(2.2, min(6.0, 0.5 * cell - 2.5)), u(4, 7)
            x = free[0] + number * cell + u(radius + 2.0, cell - radius - 2.0)
            length = u(0.55, 0.9) * high
            centre = (x, sign * (plane + gap + radius), 0.5 * length + HAIR)
            plan.put(Cylinder(centre, radius, length, 2), plan.paint("metal"), u(0.3, 1.0))
            reach = max(reach, gap + 2.0 * radius)
        if crossed:
            _lying_pipe(plan, sign, plane + reach + 4.0, half, high)


def _floor(plan: Plan, size_x: float, size_y: float, warmest: float) -> None:
    """A slab whose top is at height 0."""
    lo, hi = (-0.5 * size_x, -0.5 * size_y, -plan.u(4, 6)), (0.5 * size_x, 0.5 * size_y, 0.0)
    plan.put((lo, hi), plan.paint("ground"), plan.u(0.0, warmest))


def _radiator(plan: Plan, sign: int, plane: float, along: Range) -> float:
    """A panel, or columns between two rails, on brackets; returns how far it reaches from the wall's plane."""
    u = plan.u
    gap, thick, low, tall = u(4, 6), u(4, 6), u(6, 12), u(20, 28)
    paint, warm = plan.paint("metal"), u(0.75, 1.0)
    near, far = sign * (plane + gap), sign * (plane + gap + thick)
    y0, y1 = min(near, far), max(near, far)
    if plan.chance(0.5):
        plan.put(((along[0], y0, low), (along[1], y1, low + tall)), paint, warm)
    else:
        rail, wide, space = u(3.5, 4.5), u(3.6, 4.8), u(3.3, 4.2)
        count = int((along[1] - along[0] + space) / (wide + space))
        end = along[0] + count * (wide + space) - space
        for z in (low, low + tall - rail):
            plan.put(((along[0], y0, z), (end, y1, z + rail)), paint, warm)
        for number in range(count):
            x = along[0] + number * (wide + space)
            plan.put(((x, y0, low), (x + wide, y1, low + tall)), paint, warm)
        along = (along[0], end)
    bracket = u(3.3, 3.6)
    y0, y1 = min(sign * plane, near), max(sign * plane, near)
    for x in (along[0], along[1] - bracket):
        plan.put(((x, y0, low + tall - bracket), (x + bracket, y1, low + tall)), paint, u(0.4, 0.6))
    return gap + thick


def _lying_pipe(plan: Plan, sign: int, near: float, half: float, high: float) -> None:
    """A level pipe along the wall, on two posts."""
    u = plan.u
    radius, length, z = u(2.2, 5), u(1.1, 1.8) * half, u(0.25, 0.8) * high
    x, y = u(-1, 1) * (half - 0.5 * length), sign * (near + radius)
    plan.put(Cylinder((x, y, z), radius, length, 0), plan.paint("metal"), u(0.3, 1.0))
    paint, thick = plan.paint("stone"), 0.5 * u(3.4, 4.6)
    for middle in (x - 0.4 * length, x + 0.4 * length):
        post: Box = ((middle - thick, y - thick, 0.0), (middle + thick, y + thick, z - radius - HAIR))
        plan.put(post, paint, u(0.1, 0.3))


def _tank(plan: Plan, middle: Range, half: Range) -> None:
    """An upright cylinder on a foot."""
    u = plan.u
    radius, length, foot = u(7, 0.95 * min(half)), u(22, 48), u(3.4, 6)
    plan.put(_pillar(middle, 0.55 * radius, foot), plan.paint("stone"), u(0.2, 0.4))
    centre = (*middle, foot + HAIR + 0.5 * length)
    plan.put(Cylinder(centre, radius, length, 2), plan.paint("metal"), u(0.4, 1.0))


def _drum(plan: Plan, middle: Range, half: Range) -> None:
    """A lying cylinder on two saddles."""
    u = plan.u
    axis = int(plan.draw.integers(2))
    radius, length, saddle = u(6, 9), u(1.6, 2.0) * half[axis], u(4, 8)
    centre = (*middle, saddle + HAIR + radius)
    plan.put(Cylinder(centre, radius, length, axis), plan.paint("metal"), u(0.4, 1.0))
    paint, thick = plan.paint("stone"), u(3.6, 5)
    for share in (-0.3, 0.3):
        at = list(middle)
        at[axis] += share * length
        sides = [0.5 * radius] * 2
        sides[axis] = 0.5 * thick
        lo, hi = (at[0] - sides[0], at[1] - sides[1], 0.0), (at[0] + sides[0], at[1] + sides[1], saddle)
        plan.put((lo, hi), paint, u(0.2, 0.5))


def _ball(plan: Plan, middle: Range, half: Range) -> None:
    """A sphere on a foot, or on the floor."""
    u = plan.u
    radius, foot = u(8, 0.95 * min(half)), 0.0
    if plan.chance(0.6):
        foot = u(4, 14)
        plan.put(_pillar(middle, 0.45 * radius, foot), plan.paint("stone"), u(0.2, 0.4))
    plan.put(Sphere((*middle, foot + radius), radius), plan.paint("metal"), u(0.4, 1.0))


def _block(plan: Plan, middle: Range, half: Range) -> None:
    """A housing with a smaller one on top and a hatch in one of its sides."""
    u = plan.u
    (x, y), sides, high = middle, (u(0.7, 1) * half[0], u(0.7, 1) * half[1]), u(14, 28)
    body: Box = ((x - sides[0], y - sides[1], 0.0), (x + sides[0], y + sides[1], high))
    plan.put(body, plan.paint("metal"), u(0.3, 0.7))
    smaller = tuple(u(0.4, 1.0 - 3.4 / side) * side for side in sides)
    dx, dy = (u(-1, 1) * (side - less - SMALLEST) for side, less in zip(sides, smaller))
    lo, hi = (x + dx - smaller[0], y + dy - smaller[1], high), (x + dx + smaller[0], y + dy + smaller[1], high)
    plan.put((lo, (hi[0], hi[1], high + u(6, 20))), plan.paint("metal"), u(0.4, 0.9))
    axis, sign = int(plan.draw.integers(2)), 1 if plan.chance(0.5) else -1
    across, wide = middle[axis] + sign * sides[axis], 0.5 * sides[1 - axis]
    along = (middle[1 - axis] - wide, middle[1 - axis] + wide)
    plan.recess((axis, sign, across), along, (3.6, high - 3.6), u(SMALLEST, 4.5), plan.paint("metal"), u(0.7, 1.0))
    plan.spot(body, u(0.8, 1.1), u(6, 14))


def _frame(plan: Plan, middle: Range, half: Range) -> None:
    """Two posts and a beam."""
    u = plan.u
    axis = int(plan.draw.integers(2))
    thick, high, beam, reach = u(4.5, 7), u(24, 44), u(4, 6), u(0.75, 1.0) * half[axis]
    paint = plan.paint("metal")
    ends = []
    for sign in (-1, 1):
        at = list(middle)
        at[axis] += sign * (reach - 0.5 * thick)
        ends.append(at)
        plan.put(_pillar((at[0], at[1]), 0.5 * thick, high), paint, u(0.2, 0.7))
    (x0, y0), (x1, y1) = ends
    side = 0.5 * thick
    plan.put(((x0 - side, y0 - side, high), (x1 + side, y1 + side, high + beam)), paint, u(0.3, 0.8))


def _pillar(middle: Range, half: float, high: float) -> Box:
    """A square box around a vertical axis."""
    x, y = middle
    return (x - half, y - half, 0.0), (x + half, y + half, high)
