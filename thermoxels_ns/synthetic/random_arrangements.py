"""Arrangements of random scenes: a detached house, wings in L or U, a facade, machinery, pipes and radiators."""

from __future__ import annotations

from collections.abc import Callable

from thermoxels_ns.synthetic.random_plan import HAIR, SMALLEST, WIDEST, Plan, Range, Wall
from thermoxels_ns.synthetic.solids import Box, Cylinder, Sphere, box_beside

_CORNER = 8.5  # least wall between the corner of a house and an opening; all lengths here are in voxels of the plan
_PIER = 3.6  # least length of wall beside an opening
_OPENING = 6.0  # least side of an opening
_LEDGE = 3.2  # least width of roof beside a chimney
_RIDGE = 13.0  # least width of a roof's last step
_AISLE = 4.0  # half of the least gap between machines


def detached_house(plan: Plan) -> None:
    """Add a house to a plan: on a plinth, with a stepped roof, windows, and an annex on one of its sides."""
    u = plan.u
    ground, wall, roof, stone, glass = (plan.paint(m) for m in ("ground", "wall", "roof", "stone", "glass"))
    size_x, size_y = u(104, WIDEST), u(94, 112)
    _put_ground(plan, size_x, size_y, 7, ground, 0.15)
    width, depth, high = u(56, 68), u(40, 50), u(36, 48)
    side, out = int(plan.draw.integers(4)), u(14, 20)
    axis, sign = side // 2, 1 if side % 2 else -1
    shift = [0.0, 0.0]
    shift[axis] = -0.5 * sign * out
    body = _upright((shift[0], shift[1]), (0.5 * width, 0.5 * depth), 0.0, high)
    lo, hi = body[0][:2], body[1][:2]
    plan.put(body, wall, u(0.25, 0.45))
    plinth = u(6, 9)
    plan.put(_grown((*lo, 0.0), (*hi, plinth), u(SMALLEST, 4.5)), stone, u(0.15, 0.5))
    (ridge_x0, ridge_y0, _), (ridge_x1, ridge_y1, top) = _stepped_roof(plan, body, roof)
    if plan.chance(0.6):
        thick = u(4, min(7.0, ridge_y1 - ridge_y0 - 2.0 * _LEDGE))
        x, y = u(ridge_x0 + _LEDGE, ridge_x1 - _LEDGE - thick), 0.5 * (ridge_y0 + ridge_y1 - thick)
        plan.put(((x, y, high), (x + thick, y + thick, top + u(5, 12))), plan.paint("wall"), u(0.5, 0.9))

    length = (depth, width)[axis]
    along = u(16, length - 18)
    middle = shift[1 - axis] + u(-1, 1) * max(0.5 * (length - along) - 9.5, 0.0)
    plane, annex_high = (lo, hi)[sign > 0][axis], u(0.45, 0.62) * high
    stretch = (middle - 0.5 * along, middle + 0.5 * along)
    annex = _against((axis, sign, plane), out, stretch, (0.0, annex_high))
    plan.put(annex, plan.paint("wall"), u(0.15, 0.6))
    eaves = u(SMALLEST, 4.5)
    beside = (stretch[0] - eaves, stretch[1] + eaves)
    cover = _against((axis, sign, plane), out + eaves, beside, (annex_high, annex_high + u(3.4, 5)))
    plan.put(cover, roof if plan.chance(0.5) else plan.paint("roof"), u(0.05, 0.3))
    _windows(plan, (axis, sign, plane + sign * out), stretch, (4.0, annex_high - 4.0), glass)
    for other in range(4):
        if other != side:
            a, s = other // 2, 1 if other % 2 else -1
            _windows(plan, (a, s, (lo, hi)[s > 0][a]), (lo[1 - a], hi[1 - a]), (plinth + 4.0, high - 4.0), glass)
    _spots(plan, (body, annex), high)


def wings(plan: Plan) -> None:
    """Add an L or a U of flat-roofed wings, with a balcony, a jutting storey and a thin garden wall, to a plan."""
    u = plan.u
    ground, wall, roof, stone, glass = (plan.paint(m) for m in ("ground", "wall", "roof", "stone", "glass"))
    size_x, size_y = u(106, WIDEST), u(102, WIDEST)
    _put_ground(plan, size_x, size_y, 6, ground, 0.15)
    width, depth, high = u(64, 78), u(20, 26), u(34, 46)
    reach, wing = u(26, 38), u(19, 25)
    left, right, back = -0.5 * width, 0.5 * width, 0.5 * (depth + reach)
    inner, front = back - depth, back - depth - reach
    low = high if plan.chance(0.4) else u(0.5, 0.7) * high
    main: Box = ((left, inner, 0.0), (right, back, high))
    blocks: list[tuple[Box, tuple[int, ...]]] = [(main, (0, 1, 2, 3))]
    blocks.append((((left, front, 0.0), (left + wing, inner, low)), (0, 1, 2)))
    yard = (left + wing, right)
    if plan.chance(0.5):
        other_wing, other_low = u(18, 24), u(0.5, 0.7) * high
        blocks.append((((right - other_wing, inner - u(20, reach), 0.0), (right, inner, other_low)), (0, 1, 2)))
        yard = (left + wing, right - other_wing)
    eaves = 0.0 if plan.chance(0.5) else u(3.3, 5)
    thick, rise = (u(SMALLEST, 4.0), u(4, 6)) if eaves == 0.0 else (0.0, u(3.4, 5))
    for number, (block, sides) in enumerate(blocks):
        plan.put(block, wall if number == 0 or plan.chance(0.5) else plan.paint("wall"), u(0.2, 0.45))
        (x0, y0, _), (x1, y1, z) = block
        if eaves > 0.0:
            rear = y1 + eaves if number == 0 else y1
            plan.put(((x0 - eaves, y0 - eaves, z), (x1 + eaves, rear, z + rise)), roof, u(0.05, 0.25))
        else:
            edges: tuple[Box, ...] = (
                ((x0, y0, z), (x0 + thick, y1, z + rise)),
                ((x1 - thick, y0, z), (x1, y1, z + rise)),
                ((x0, y0, z), (x1, y0 + thick, z + rise)),
                ((x0, y1 - thick, z), (x1, y1, z + rise)),
            )
            for edge in sides:
                plan.put(edges[edge], roof, u(0.05, 0.25))

    middle, half, out, floor = u(-0.2, 0.2) * width, 0.5 * u(20, 32), u(9, 13), u(0.45, 0.55) * high
    thick, rise, warm, far = u(SMALLEST, 4.2), u(4, 6), u(0.1, 0.4), back + out
    plan.put(((middle - half, back, floor), (middle + half, far, floor + thick)), stone, warm)
    for x0, x1, y0 in (
        (middle - half, middle + half, far - SMALLEST),
        (middle - half, middle - half + SMALLEST, back),
        (middle + half - SMALLEST, middle + half, back),
    ):
        plan.put(((x0, y0, floor), (x1, far, floor + thick + rise)), stone, warm)
    behind: Wall = (1, 1, back)
    door = u(4, 6)
    plan.recess(behind, (middle - door, middle + door), (floor + thick, high - 5.0), u(SMALLEST, 4.2), glass, u(0.7, 1))
    _windows(plan, behind, (left, right), (4.0, floor - 3.6), glass)

    jut, from_z = u(8, 13), max(0.5 * low, 9.0)
    span = (front + 5.0, front + 5.0 + u(16, reach - 6))
    storey = _against((0, -1, left), jut, span, (from_z, low - 4.0))
    plan.put(storey, plan.paint("wall"), u(0.25, 0.6))
    if plan.chance(0.5):
        post = u(3.3, 5)
        for y in (span[0], span[1] - post):
            plan.put(((left - jut, y, 0.0), (left - jut + post, y + post, from_z)), stone, u(0.1, 0.3))
    _windows(plan, (1, -1, inner), (yard[0] - 3.0, yard[1] + 3.0), (4.0, high - 4.0), glass)
    _windows(plan, (0, 1, left + wing), (front, inner + 3.0), (4.0, low - 4.0), glass)
    _windows(plan, (1, -1, front), (left, left + wing), (4.0, low - 4.0), glass)

    y, x = front - u(9, 13), u(-0.42, -0.1) * size_x
    garden: Box = ((x, y, 0.0), (x + u(34, 0.46 * size_x - x), y + u(SMALLEST, 4.0), u(12, 22)))
    plan.put(garden, plan.paint("stone"), u(0.1, 0.5))
    _spots(plan, (main, storey, garden), high)


def facade(plan: Plan) -> None:
    """Add a facade with window recesses, sills and a cornice, a post before it, and perhaps steps, to a plan."""
    u = plan.u
    ground, wall, stone, glass = (plan.paint(m) for m in ("ground", "wall", "stone", "glass"))
    half_x, ground_half = 0.5 * u(84, 104), 0.5 * u(108, WIDEST)
    depth, before, high = u(14, 20), u(34, 46), u(60, 80)
    plan.put(((-ground_half, -before, -u(4, 6)), (ground_half, depth, 0.0)), ground, u(0.0, 0.2))
    body: Box = ((-half_x, 0.0, 0.0), (half_x, depth, high))
    plan.put(body, wall, u(0.25, 0.45))
    crown, plinth = u(4, 6), u(6, 9)
    jut = u(3.4, 6)
    plan.put(((-half_x, -jut, high - crown), (half_x, 0.0, high)), stone, u(0.05, 0.3))
    if plan.chance(0.5):
        plan.put(((-half_x, -u(SMALLEST, 4), 0.0), (half_x, 0.0, plinth)), stone, u(0.2, 0.5))
    columns, rows = int(plan.draw.integers(3, 5)), int(plan.draw.integers(2, 4))
    sill, tall = u(SMALLEST, 4.5), u(SMALLEST, 4.0)
    stretch, rise = (-half_x + 3.0, half_x - 3.0), (plinth + 6.0, high - crown - 1.0)
    for (x0, x1), (z0, _) in _windows(plan, (1, -1, 0.0), stretch, rise, glass, columns, rows, 5.2):
        plan.put(((x0 - 3.2, -sill, z0 - tall), (x1 + 3.2, 0.0, z0)), stone, u(0.15, 0.5))
    if plan.chance(0.5):
        x, broad, tread, step = u(-0.6, 0.3) * half_x, u(14, 22), u(4, 5.5), u(SMALLEST, 3.9)
        for number in range(2):
            plan.put(((x, -(2 - number) * tread, 0.0), (x + broad, 0.0, (number + 1) * step)), stone, u(0.1, 0.3))
    thick, tip = u(6, 10), u(0.4, 1.15) * high
    x, y = u(-0.8, 0.6) * half_x, -u(24, before - 6)
    post: Box = ((x, y, 0.0), (x + thick, y + thick, tip))
    plan.put(post, plan.paint("wall"), u(0.3, 0.9))
    if plan.chance(0.5):
        plan.put(_grown((x, y, tip), (x + thick, y + thick, tip + u(3.4, 5)), u(3.2, 4)), stone, u(0.2, 0.9))
    _spots(plan, (body, post), high)


def railing(plan: Plan) -> None:
    """Add thin bars under a rail along the front edge of the ground. The ground must be `plan.pieces[0]`, a box."""
    u = plan.u
    ground = plan.pieces[0].shape
    assert isinstance(ground, tuple)
    (x0, y0, _), (x1, _, _) = ground
    thick, apart, high, paint = u(0.2, 0.45), u(2.2, 3.2), u(8, 12), plan.paint("metal")
    count = int(u(0.4, 0.65) * (x1 - x0) / apart)
    x, y = u(x0 + 1.0, x1 - count * apart - 2.0), y0 + u(1.0, 2.0)
    for number in range(count + 1):
        at = x + number * apart
        plan.put(((at, y, 0.0), (at + thick, y + thick, high)), paint, u(0.1, 0.2))
    plan.put(((x, y, high), (x + count * apart + thick, y + thick, high + thick)), paint, u(0.1, 0.2))


def _stepped_roof(plan: Plan, body: Box, paint: int) -> Box:
    """Add eaves and a stepped roof, whose steps shrink to a ridge along x, on top of `body`; return the last step."""
    u = plan.u
    (x0, y0, _), (x1, y1, z) = body
    over, steps, warm = u(3.3, 5.5), int(plan.draw.integers(2, 5)), u(0.0, 0.25)
    deep = y1 - y0 + 2.0 * over
    along, across = u(3.3, 5), u(3.4, min(6.5, (deep - _RIDGE) / (2 * steps)))
    step = body
    for number in range(steps + 1):
        dx, dy, rise = over - number * along, over - number * across, u(3.5, 5.5)
        step = ((x0 - dx, y0 - dy, z), (x1 + dx, y1 + dy, z + rise))
        plan.put(step, paint, warm)
        z += rise
    return step


def _windows(
    plan: Plan,
    wall: Wall,
    along: Range,
    height: Range,
    paint: int,
    columns: int | None = None,
    rows: int | None = None,
    pier: float = _PIER,
) -> list[tuple[Range, Range]]:
    """Cut a grid of equal openings with panes into a wall, except for some at random; return each opening's extents.
    The openings lie within `along` (less `_CORNER` at both ends) and `height`; extents are along the wall and in z.
    `columns` and `rows` of the grid follow from the wall's size if None. `pier` is the least wall beside an opening."""
    a0, a1 = along[0] + _CORNER, along[1] - _CORNER
    z0, z1 = height
    room = 2.0 * pier + _OPENING
    most_columns, most_rows = int((a1 - a0) / room), int((z1 - z0) / room)
    if most_columns < 1 or most_rows < 1:
        return []
    columns = min(columns or 1 + int((a1 - a0) / 22.0), most_columns)
    rows = min(rows or 1 + int((z1 - z0) / 26.0), most_rows)
    cell, storey = (a1 - a0) / columns, (z1 - z0) / rows
    share_wide, share_tall, depth = plan.u(0.75, 1.0), plan.u(0.75, 1.0), plan.u(SMALLEST, 4.6)
    warm, cut = plan.u(0.5, 0.85), []
    for row in range(rows):
        for column in range(columns):
            if plan.chance(0.15):
                continue
            half = 0.5 * max(share_wide * (cell - 2.0 * pier), _OPENING)
            tall = max(share_tall * (storey - 2.0 * pier), _OPENING)
            middle, bottom = a0 + (column + 0.5) * cell, z0 + row * storey + pier
            opening = ((middle - half, middle + half), (bottom, bottom + tall))
            plan.recess(wall, *opening, depth, paint, warm + plan.u(-0.15, 0.15))
            cut.append(opening)
    return cut


def _spots(plan: Plan, boxes: tuple[Box, ...], high: float) -> None:
    """Add one to three warm spots on random boxes, and a cold spot on the first; their reach is a share of `high`."""
    for _ in range(int(plan.draw.integers(1, 4))):
        plan.spot(boxes[int(plan.draw.integers(len(boxes)))], plan.u(0.7, 1.1), plan.u(0.15, 0.4) * high)
    plan.spot(boxes[0], plan.u(0.1, 0.2), plan.u(0.2, 0.5) * high)


def _put_ground(plan: Plan, size_x: float, size_y: float, thickest: float, paint: int | None, warmest: float) -> None:
    """Add a slab below z = 0, 4 to `thickest` voxels thick and of warmth 0 to `warmest`; `paint` None: a random one."""
    half_x, half_y, thick = 0.5 * size_x, 0.5 * size_y, plan.u(4, thickest)
    paint = plan.paint("ground") if paint is None else paint
    plan.put(((-half_x, -half_y, -thick), (half_x, half_y, 0.0)), paint, plan.u(0.0, warmest))


def _grown(lo: tuple[float, float, float], hi: tuple[float, float, float], by: float) -> Box:
    """Return a box widened by `by` on all four sides in x and y."""
    return (lo[0] - by, lo[1] - by, lo[2]), (hi[0] + by, hi[1] + by, hi[2])


def _against(wall: Wall, out: float, along: Range, height: Range) -> Box:
    """Return a box that stands out from a wall by `out`, with extents along the wall and in z."""
    axis, sign, plane = wall
    return box_beside(axis, (plane, plane + sign * out), along, height)


def machinery(plan: Plan) -> None:
    """Add a floor slab with a tank, a drum, a ball, a block, a frame, and mostly a second one of these, to a plan."""
    u = plan.u
    size_x, size_y = u(102, WIDEST), u(84, 108)
    _put_ground(plan, size_x, size_y, 6, None, 0.2)
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
    """Add a wall on a floor to a plan, with a radiator on one side or both, upright pipes, and level pipes on posts."""
    u = plan.u
    size_x, size_y = u(102, WIDEST), u(86, 100)
    _put_ground(plan, size_x, size_y, 6, None, 0.15)
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


def _radiator(plan: Plan, sign: int, plane: float, along: Range) -> float:
    """Add a radiator (panel, or columns between rails) before the wall face y = `sign` * `plane`; return its reach."""
    u = plan.u
    gap, thick, low, tall = u(4, 6), u(4, 6), u(6, 12), u(20, 28)
    paint, warm = plan.paint("metal"), u(0.75, 1.0)
    near = sign * (plane + gap)
    across, top = (near, sign * (plane + gap + thick)), low + tall
    if plan.chance(0.5):
        plan.put(box_beside(1, across, along, (low, top)), paint, warm)
    else:
        rail, wide, space = u(3.5, 4.5), u(3.6, 4.8), u(3.3, 4.2)
        count = int((along[1] - along[0] + space) / (wide + space))
        along = (along[0], along[0] + count * (wide + space) - space)
        for z in (low, top - rail):
            plan.put(box_beside(1, across, along, (z, z + rail)), paint, warm)
        for number in range(count):
            x = along[0] + number * (wide + space)
            plan.put(box_beside(1, across, (x, x + wide), (low, top)), paint, warm)
    bracket = u(3.3, 3.6)
    for x in (along[0], along[1] - bracket):
        box = box_beside(1, (sign * plane, near), (x, x + bracket), (top - bracket, top))
        plan.put(box, paint, u(0.4, 0.6))
    return gap + thick


def _lying_pipe(plan: Plan, sign: int, near: float, half: float, high: float) -> None:
    """Add a level pipe on two posts along a wall of half length `half` and height `high`, on its side `sign` (1: +y).
    The pipe's near side has the distance `near` from the wall's middle plane."""
    u = plan.u
    radius, length, z = u(2.2, 5), u(1.1, 1.8) * half, u(0.25, 0.8) * high
    x, y = u(-1, 1) * (half - 0.5 * length), sign * (near + radius)
    plan.put(Cylinder((x, y, z), radius, length, 0), plan.paint("metal"), u(0.3, 1.0))
    paint, thick = plan.paint("stone"), 0.5 * u(3.4, 4.6)
    for at in (x - 0.4 * length, x + 0.4 * length):
        plan.put(_upright((at, y), (thick, thick), 0.0, z - radius - HAIR), paint, u(0.1, 0.3))


def _tank(plan: Plan, middle: Range, half: Range) -> None:
    """Put an upright cylinder on a foot, within `half` of `middle` in x and y."""
    u = plan.u
    radius, length, foot = u(7, 0.95 * min(half)), u(22, 48), u(3.4, 6)
    plan.put(_upright(middle, (0.55 * radius, 0.55 * radius), 0.0, foot), plan.paint("stone"), u(0.2, 0.4))
    centre = (*middle, foot + HAIR + 0.5 * length)
    plan.put(Cylinder(centre, radius, length, 2), plan.paint("metal"), u(0.4, 1.0))


def _drum(plan: Plan, middle: Range, half: Range) -> None:
    """Put a lying cylinder on two saddles, within `half` of `middle` in x and y."""
    u = plan.u
    axis = int(plan.draw.integers(2))
    radius, length, saddle = u(6, 9), u(1.6, 2.0) * half[axis], u(4, 8)
    centre = (*middle, saddle + HAIR + radius)
    plan.put(Cylinder(centre, radius, length, axis), plan.paint("metal"), u(0.4, 1.0))
    paint, thick = plan.paint("stone"), u(3.6, 5)
    sides = (0.5 * thick, 0.5 * radius) if axis == 0 else (0.5 * radius, 0.5 * thick)
    for share in (-0.3, 0.3):
        plan.put(_upright(_moved(middle, axis, share * length), sides, 0.0, saddle), paint, u(0.2, 0.5))


def _ball(plan: Plan, middle: Range, half: Range) -> None:
    """Put a sphere on a foot or on the floor, within `half` of `middle` in x and y."""
    u = plan.u
    radius, foot = u(8, 0.95 * min(half)), 0.0
    if plan.chance(0.6):
        foot = u(4, 14)
        plan.put(_upright(middle, (0.45 * radius, 0.45 * radius), 0.0, foot), plan.paint("stone"), u(0.2, 0.4))
    plan.put(Sphere((*middle, foot + radius), radius), plan.paint("metal"), u(0.4, 1.0))


def _block(plan: Plan, middle: Range, half: Range) -> None:
    """Put a housing with a smaller housing on top and a hatch in one side, within `half` of `middle` in x and y."""
    u = plan.u
    (x, y), sides, high = middle, (u(0.7, 1) * half[0], u(0.7, 1) * half[1]), u(14, 28)
    body = _upright(middle, sides, 0.0, high)
    plan.put(body, plan.paint("metal"), u(0.3, 0.7))
    smaller = (u(0.4, 1.0 - 3.4 / sides[0]) * sides[0], u(0.4, 1.0 - 3.4 / sides[1]) * sides[1])
    dx, dy = (u(-1, 1) * (side - less - SMALLEST) for side, less in zip(sides, smaller))
    plan.put(_upright((x + dx, y + dy), smaller, high, high + u(6, 20)), plan.paint("metal"), u(0.4, 0.9))
    axis, sign = int(plan.draw.integers(2)), 1 if plan.chance(0.5) else -1
    across, wide = middle[axis] + sign * sides[axis], 0.5 * sides[1 - axis]
    along = (middle[1 - axis] - wide, middle[1 - axis] + wide)
    plan.recess((axis, sign, across), along, (3.6, high - 3.6), u(SMALLEST, 4.5), plan.paint("metal"), u(0.7, 1.0))
    plan.spot(body, u(0.8, 1.1), u(6, 14))


def _frame(plan: Plan, middle: Range, half: Range) -> None:
    """Put two posts and a beam on top of them, within `half` of `middle` in x and y."""
    u = plan.u
    axis = int(plan.draw.integers(2))
    thick, high, beam, reach = u(4.5, 7), u(24, 44), u(4, 6), u(0.75, 1.0) * half[axis]
    paint, side = plan.paint("metal"), 0.5 * thick
    posts = []
    for sign in (-1, 1):
        posts.append(_upright(_moved(middle, axis, sign * (reach - side)), (side, side), 0.0, high))
        plan.put(posts[-1], paint, u(0.2, 0.7))
    (x0, y0, _), (x1, y1, _) = posts[0][0], posts[1][1]
    plan.put(((x0, y0, high), (x1, y1, high + beam)), paint, u(0.3, 0.8))


def _upright(middle: Range, sides: Range, low: float, high: float) -> Box:
    """Return a box around a vertical axis at `middle`, with half sides `sides` along x and y, from `low` to `high`."""
    (x, y), (half_x, half_y) = middle, sides
    return (x - half_x, y - half_y, low), (x + half_x, y + half_y, high)


def _moved(middle: Range, axis: int, by: float) -> Range:
    return (middle[0] + by, middle[1]) if axis == 0 else (middle[0], middle[1] + by)
