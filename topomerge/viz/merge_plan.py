"""Plans of two maps in one frame, and how maps were bent.

Both maps side by side with a line from each room to the room that it is in the other map.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from topomerge.fusion.result import RoomMatch
from topomerge.io.rooms_ply import assign_room_colours
from topomerge.types import Array, Deformation, Placement, Sim3, TopometricMap
from topomerge.viz.plan import StoreyView, find_label_places, format_hex_colour
from topomerge.viz.report import render_zoom_buttons
from topomerge.viz.svg import Sheet, lay_out, render_drawing, trace_rooms, trace_walls
from topomerge.viz.tables import Markup, build_element, join, render_room_link

LONGEST_EDGE = 200.0  # cm of an outline, that are drawn straight also where they are bent
CUT_HEIGHT = 1.0  # m above the floor, where the plan shows how the map is bent
LEAST_ARROW = 0.001  # m: shorter moves have no arrow
MOST_ARROWS = 400  # on one storey, the longest
ARROW_SHARE = 0.1  # of the paper's longer side, that the longest arrows reach at most, and
LONGEST_ARROW = 500.0  # cm
FACTORS = (1, 2, 5, 10, 20, 50, 100, 200, 500)  # by which arrows are drawn too long


@dataclass(frozen=True, eq=False)
class PieceShifts:
    """Where the pieces of a map are and by how much they are moved, in the map's own frame.

    Args:
        anchor: (n, 2) m.
        shift: (n, 2) m, with what neighbouring pieces blend into it.
        turn: (n,) rad.
        room: (n,) of each piece, -1 none.
        storey: (n,).
    """

    anchor: Array
    shift: Array
    turn: Array
    room: Array
    storey: Array

    @classmethod
    def from_deformation(cls, bend: Deformation | None) -> PieceShifts:
        """Return the shifts of a deformation's pieces; of no piece where the map is rigid."""
        if bend is None:
            return cls(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), np.zeros(0, np.int64), np.zeros(0, np.int64))
        places = np.column_stack([bend.anchors, bend.floors[bend.storey] + CUT_HEIGHT])
        return cls(bend.anchors, (bend.apply(places) - places)[:, :2], bend.moves[:, 2], bend.room, bend.storey)

    @property
    def length(self) -> Array:
        """(n,) m."""
        out: Array = np.hypot(*self.shift.T)
        return out


def choose_arrow_factor(shifts: Iterable[PieceShifts], sheet: Sheet) -> int:
    """Choose a round factor of the arrows' length with which the longest are well seen and none is in the way."""
    longest = 100 * max((float(s.length.max(initial=0.0)) for s in shifts), default=0.0)
    room = min(ARROW_SHARE * max(sheet.size), LONGEST_ARROW)
    return max((f for f in FACTORS if f * longest <= room), default=1)


def render_arrows(name: str, shifts: PieceShifts, storey: int, sheet: Sheet, factor: int) -> Markup:
    """Render an arrow from where each piece of a storey was, `factor` times as long as its move; the true length in a tooltip."""
    rows = np.flatnonzero((shifts.storey == storey) & (shifts.length >= LEAST_ARROW))
    rows = np.sort(rows[np.argsort(-shifts.length[rows], kind="stable")[:MOST_ARROWS]])
    start, end = sheet.convert_to_cm(shifts.anchor[rows]), sheet.convert_to_cm(shifts.anchor[rows] + factor * shifts.shift[rows])
    parts = []
    for k, (x, y), (u, v) in zip(rows.tolist(), start.tolist(), end.tolist(), strict=True):
        room = f", room {shifts.room[k]}" if shifts.room[k] >= 0 else ""
        text = f"{name}{room}: moved by {format_centimetres(shifts.length[k])}, turned by {np.degrees(shifts.turn[k]):.2f}°"
        shaft = build_element("path", class_="shaft", d=_format_arrow(x, y, u, v))
        dot = build_element("circle", cx=x, cy=y)
        parts.append(
            build_element(
                "g", build_element("title", text), build_element("path", class_="near", d=f"M{x} {y}L{u} {v}"), dot, shaft
            )
        )
    return build_element("g", *parts, class_="bend-arrows")


def _format_arrow(x: int, y: int, u: int, v: int) -> str:
    """Return a line to (u, v) with a head, which is a third of it long, 10 to 40 cm."""
    length = max(float(np.hypot(u - x, v - y)), 1.0)
    head = min(max(length / 3, 10.0), 40.0)
    a, b = (u - x) / length * head, (v - y) / length * head
    left, right = (u - a - b / 2, v - b + a / 2), (u - a + b / 2, v - b - a / 2)
    return f"M{x} {y}L{u} {v}M{left[0]:.0f} {left[1]:.0f}L{u} {v}L{right[0]:.0f} {right[1]:.0f}"


def deform_path(d: str, sheet: Sheet, bend: Deformation, height: float) -> tuple[str, str]:
    """Return an outline as it was and as it is bent, with as many corners: what is between the two is between their numbers.

    Args:
        d: of closed rings, as `outline.trace` gives them.
        sheet: the paper of the map.
        bend: of the map.
        height: m, at which the plan is cut.
    """
    rigid, bent = [], []
    for ring in d.split("z")[:-1]:
        numbers = np.array(ring[1:].replace("l", " ").split(), np.int64).reshape(-1, 2)
        places = _subdivide_ring(np.cumsum(numbers, axis=0))
        points = np.column_stack([sheet.convert_to_metres(places), np.full(len(places), height)])
        rigid.append(_format_closed_path(places))
        bent.append(_format_closed_path(sheet.convert_to_cm(bend.apply(points))))
    return "".join(rigid), "".join(bent)


def _subdivide_ring(corners: Array) -> Array:
    """Return (n, 2) int64 cm, of a ring none of whose edges is longer than `LONGEST_EDGE`."""
    edges = np.roll(corners, -1, axis=0) - corners
    parts = np.maximum(np.ceil(np.hypot(*edges.T) / LONGEST_EDGE), 1).astype(np.int64)
    first = np.repeat(np.cumsum(parts) - parts, parts)
    share = (np.arange(len(first)) - first) / np.repeat(parts, parts)
    out: Array = np.rint(np.repeat(corners, parts, axis=0) + share[:, None] * np.repeat(edges, parts, axis=0)).astype(np.int64)
    return out


def _format_closed_path(places: Array) -> str:
    (x, y), steps = places[0].tolist(), np.diff(places, axis=0).tolist()
    return f"M{x} {y}l{' '.join(f'{u} {v}' for u, v in steps)}z"


def render_deformation_controls() -> Markup:
    """Render the slider from rigid to bent, and the switch of the arrows."""
    text = "From rigid to bent"
    slider = build_element("input", type="range", min="0", max="1", step="0.01", value="1", data_bend=True, aria_label=text)
    bar = build_element("div", "rigid", slider, "bent", class_="blend bend")
    box = build_element("label", build_element("input", type="checkbox", checked=True, data_layer="bends"), " arrows")
    return join([bar, build_element("div", box, class_="layers")])


def describe_deformation(count: int, factor: int) -> str:
    """Describe the arrows and the slider of `count` bent maps."""
    maps = "the maps were" if count > 1 else "the map was"
    drawn = f"drawn {factor} times as long as the move" if factor > 1 else "drawn as long as the move"
    point = "point at one for its true length" if factor > 1 else "point at one for its length"
    return f"Arrows show where {maps} bent and by how much, {drawn}; {point}. The second slider bends the outlines."


def render_deformation_table(placements: Sequence[Placement], names: Sequence[str], keys: Sequence[str | None]) -> Markup:
    """Render the largest and median shift of each map, and where the largest is.

    Args:
        placements: of the maps.
        names: what the page calls them.
        keys: what stands before the numbers of their rooms on the page; None where it has no plan of them.
    """
    heads = ("map", "largest shift", "median shift", "largest turn", "largest shift in")
    head = build_element("thead", build_element("tr", *(build_element("th", name, class_="text", scope="col") for name in heads)))
    rows = [
        build_element(
            "tr",
            *(
                build_element("td", text, class_="text")
                for text in _iter_row_cells(PieceShifts.from_deformation(place.bend), name, key)
            ),
        )
        for place, name, key in zip(placements, names, keys, strict=True)
    ]
    table = build_element("table", build_element("caption", "How the maps were bent"), head, build_element("tbody", *rows))
    return build_element("div", table, class_="scroller")


def _iter_row_cells(shifts: PieceShifts, name: str, key: str | None) -> Iterator[str]:
    yield name
    if not len(shifts.length):
        yield from ("rigid", "–", "–", "–")
        return
    yield format_centimetres(float(shifts.length.max()))
    yield format_centimetres(float(np.median(shifts.length)))
    yield f"{np.degrees(np.abs(shifts.turn).max()):.2f}°"
    farthest = int(shifts.length.argmax())
    room, storey = int(shifts.room[farthest]), f"storey {shifts.storey[farthest]}"
    if room < 0:
        yield storey
    else:
        yield join(["room ", str(room) if key is None else render_room_link(key, room), f", {storey}"])


def format_centimetres(metres: float) -> str:
    """Format a length as text."""
    return f"{100 * metres:.1f} cm" if metres < 0.1 else f"{100 * metres:.0f} cm"


Drawn = tuple[Sheet, list[StoreyView]]
LEVEL_TOLERANCE = 0.7  # m by which floors of one storey may differ
AFFINE_REACH = 10_000  # cm: places on the paper are rounded, so an affine map is measured over a long way


def lay_out_pair(a: TopometricMap, b: TopometricMap, pose: Sim3 | None) -> tuple[Drawn, Drawn]:
    """Return paper and plans of both maps; b's is turned as a's where it is known how b lies in a."""
    first = lay_out(a, "a")
    return first, lay_out(b, "b", None if pose is None else first[0].turn + pose.yaw)


Overlay = Callable[[int | None, Sheet], list[Markup]]


def render_blend_view(
    a: TopometricMap,
    b: TopometricMap,
    drawn: tuple[Drawn, Drawn],
    pose: Sim3,
    bends: Mapping[int, Deformation] | None = None,
    names: tuple[str, str] = ("a", "b"),
    overlay: Overlay | None = None,
) -> Markup:
    """Render both plans in the frame of a, with a slider that shows the one, the other or both; where one is bent, with arrows
    and a slider from rigid to bent.

    Args:
        drawn: of `lay_out_pair`.
        pose: T_ab.
        bends: 0 or 1 -> how a or b is bent.
        names: what the page calls the maps.
        overlay: what is drawn over a storey of a on the common paper; the view then has a swipe, too.
    """
    (sheet_a, plans_a), (sheet_b, plans_b) = drawn
    bent = {n: bend for n, bend in (bends or {}).items() if len(bend)}
    sides = [
        _OverlaySide("a", a, sheet_a, plans_a, Sim3(), bent.get(0)),
        _OverlaySide("b", b, sheet_b, plans_b, pose, bent.get(1)),
    ]
    paper = _compute_enclosing_sheet(sheet_a, sheet_b, pose)
    factor = 0 if overlay else choose_arrow_factor([PieceShifts.from_deformation(side.bend) for side in sides], paper)
    figures, captions = [], []
    for k, storeys in enumerate(pair_storeys(a, b, pose)):
        layers = [_render_layer(side, s, paper, factor) for side, s in zip(sides, storeys, strict=True) if s is not None]
        layers = [*layers, build_element("g", *overlay(storeys[0], paper), class_="changes")] if overlay else layers
        parts = [f"storey {s} of {name}" for name, s in zip(names, storeys, strict=True) if s is not None]
        captions.append(" on ".join(reversed(parts)).capitalize())
        picture = render_drawing(a, replace(paper, key=f"ab{k}-"), 0, layers)
        figures.append(
            build_element("figure", build_element("figcaption", build_element("b", captions[-1])), picture, data_storey=k)
        )
    choices = [
        build_element("button", name, type="button", data_storey=k) for k, name in enumerate(captions) if len(captions) > 1
    ]
    bar = _render_sliders((a, b), names, overlay is not None)
    groups = [
        bar,
        *([render_deformation_controls()] if bent and factor else []),
        *([build_element("div", *choices, class_="choices")] if choices else []),
    ]
    controls = build_element("div", *groups, build_element("div", *render_zoom_buttons(), class_="zoom"), class_="controls")
    text = "Point at a change." if overlay else "Walls of one map on walls of the other support the merge."
    hint = build_element("p", text, class_="told", aria_live="polite")
    description = [build_element("p", describe_deformation(len(bent), factor), class_="note")] if bent and factor else []
    return build_element(
        "div", controls, build_element("div", *figures, class_="sheet", tabindex=0), hint, *description, class_="plan-view"
    )


def _render_sliders(maps: Sequence[TopometricMap], names: tuple[str, str], swipes: bool) -> Markup:
    """Render the slider that fades from one map to the other, and the one that wipes."""
    common = {"type": "range", "min": "0", "max": "1", "step": "0.01", "value": "0.5"}
    text = f"rom {names[0]} to {names[1]}"
    sliders = [build_element("input", **common, data_blend=True, aria_label=f"F{text}")]
    sliders += [build_element("input", **common, data_swipe=True, aria_label=f"Swipe f{text}")] if swipes else []
    first, second = (_render_source(sign, name, m) for sign, name, m in zip("ab", names, maps, strict=True))
    return build_element("div", first, *sliders, second, class_="blend")


@dataclass(frozen=True, eq=False)
class _OverlaySide:
    """One of the two maps: how the page calls it, its paper and plans, where it lies and how it is bent."""

    name: str
    map: TopometricMap
    sheet: Sheet
    plans: list[StoreyView]
    pose: Sim3
    bend: Deformation | None


def pair_storeys(a: TopometricMap, b: TopometricMap, pose: Sim3) -> list[tuple[int | None, int | None]]:
    """Return (storey of a, storey of b) that lie at one height, and those that lie at no other's; lowest first of a, then of
    b."""
    floors_a = a.storeys["floor"] if len(a.storeys) else np.zeros(1)
    floors_b = pose.scale * b.storeys["floor"] + pose.translation[2] if len(b.storeys) else floors_a[:1]
    pairs: list[tuple[int | None, int | None]] = []
    taken: set[int] = set()
    for i, floor in enumerate(floors_a):
        near = [
            j
            for j in np.argsort(np.abs(floors_b - floor)).tolist()
            if abs(floors_b[j] - floor) <= LEVEL_TOLERANCE and j not in taken
        ]
        taken.update(near[:1])
        pairs.append((i, near[0] if near else None))
    pairs += [(None, j) for j in range(len(floors_b)) if j not in taken]
    return sorted(pairs, key=lambda p: p[0] is None or p[1] is None)


def compute_sheet_transform(sheet: Sheet, paper: Sheet, pose: Sim3) -> Array:
    """Compute (2, 3) affine map of places on one paper onto another, cm.

    Args:
        pose: of the first paper's map in the frame of the other's.
    """
    corners = np.array([[0, 0], [AFFINE_REACH, 0], [0, AFFINE_REACH]], float)
    to = paper.convert_to_cm(pose.apply(np.column_stack([sheet.convert_to_metres(corners), np.zeros(3)]))).astype(float)
    return np.column_stack([(to[1] - to[0]) / AFFINE_REACH, (to[2] - to[0]) / AFFINE_REACH, to[0]])


def _compute_enclosing_sheet(a: Sheet, b: Sheet, pose: Sim3) -> Sheet:
    """Return a paper in a's frame, turned as a's, that holds what both show."""
    ends = []
    for sheet, move in ((a, Sim3()), (b, pose)):
        width, height = sheet.size
        corners = np.array([[0, 0], [width, 0], [0, height], [width, height]], float)
        ends.append(a.convert_to_cm(move.apply(np.column_stack([sheet.convert_to_metres(corners), np.zeros(4)]))))
    corners_of_both = np.concatenate(ends)
    low, high = corners_of_both.min(axis=0), corners_of_both.max(axis=0)
    x, y = low.tolist()
    wide, tall = (high - low).tolist()
    return replace(a, key="ab", corner=a.corner + np.array([x, -y]) / 100, size=(wide, tall))


def _render_layer(side: _OverlaySide, storey: int, paper: Sheet, factor: int) -> Markup:
    plan, sheet = side.plans[storey], side.sheet
    ground = [_render_outline(d, side, storey, "ground") for d in trace_rooms(plan, sheet).values()]
    signs = (
        []
        if side.bend is None or not factor
        else [render_arrows(side.name, PieceShifts.from_deformation(side.bend), storey, sheet, factor)]
    )
    matrix = "matrix(" + " ".join(f"{v:.6g}" for v in compute_sheet_transform(sheet, paper, side.pose).T.ravel()) + ")"
    walls = _render_outline(trace_walls(plan, sheet), side, storey)
    moved = build_element("g", *ground, walls, *signs, class_=f"of-{side.name}", transform=matrix)
    return build_element("g", moved, class_=f"side-{side.name}")


def _render_outline(d: str, side: _OverlaySide, storey: int, name: str | None = None) -> Markup:
    """Render an outline; of a bent map as it is bent, with the rigid one for the slider."""
    if side.bend is None:
        return build_element("path", class_=name, d=d, fill_rule="evenodd")
    floor = float(side.map.storeys["floor"][storey]) if len(side.map.storeys) else 0.0
    rigid, bent = deform_path(d, side.sheet, side.bend, floor + CUT_HEIGHT)
    return build_element("path", class_=name, d=bent, data_rigid=rigid, fill_rule="evenodd")


def _render_source(sign_name: str, name: str, map: TopometricMap) -> Markup:
    sign = build_element("i", class_=f"sign-{sign_name}")
    return build_element("span", sign, name, class_="legend", title=map.source or None)


MAP_GAP = 0.12  # of the width, between the two maps and between storeys
LINES_WIDTH = 1100  # pixels that the drawing is expected to have


def render_lines(
    maps: Sequence[TopometricMap], drawn: Sequence[Drawn], matches: Sequence[RoomMatch], colours: Sequence[Array | None]
) -> Markup:
    """Render the storeys of a at the left, those of b at the right, the lowest at the bottom, and a line for each match, the
    stronger the surer.

    Args:
        drawn: of `merge_plan.lay_out_pair`.
        colours: (R, 3) uint8 of the rooms of either map; neighbours differ if None.
    """
    sizes = [np.array(sheet.size) for sheet, _ in drawn]
    gap = round(MAP_GAP * (sizes[0][0] + sizes[1][0]))
    tall = [len(plans) * size[1] + (len(plans) - 1) * gap // 2 for (_, plans), size in zip(drawn, sizes, strict=True)]
    width, height = int(sizes[0][0] + gap + sizes[1][0]), int(max(tall))
    parts, at = [], []
    for k, (m, (sheet, plans), colour) in enumerate(zip(maps, drawn, colours, strict=True)):
        corner = np.array([0 if k == 0 else sizes[0][0] + gap, height - tall[k]])
        spots: dict[int, tuple[int, int]] = {}
        for storey, plan in enumerate(plans):
            x, y = (corner + (0, (len(plans) - 1 - storey) * (sizes[k][1] + gap // 2))).tolist()
            parts.append(build_element("g", *_render_storey(m, sheet, plan, colour), transform=f"translate({x} {y})"))
            for room, place in find_label_places(plan, sheet.frame).items():
                u, v = sheet.locate((place.x, place.y))
                spots[room] = (u + x, v + y)
        at.append(spots)
    parts.append(build_element("g", *_render_match_lines(matches, at[0], at[1]), class_="matches"))
    unit = max(width / LINES_WIDTH, height / 600)
    margin = round(20 * unit)
    view = f"{-margin} {-margin} {width + 2 * margin} {height + 2 * margin}"
    text = f"{len(matches)} matched room pairs, each joined by a line"
    style = f"--unit:{unit:.3f}"
    return build_element("svg", *parts, class_="plan lines", viewBox=view, style=style, role="img", aria_label=text)


def _render_storey(map: TopometricMap, sheet: Sheet, plan: StoreyView, colours: Array | None) -> list[Markup]:
    shades = assign_room_colours(map) if colours is None else colours
    rooms = [
        build_element(
            "path", class_="room", d=d, fill=format_hex_colour(shades[i]), fill_rule="evenodd", data_room=sheet.format_room_id(i)
        )
        for i, d in trace_rooms(plan, sheet).items()
    ]
    return [*rooms, build_element("path", class_="wall", d=trace_walls(plan, sheet), fill_rule="evenodd")]


def _render_match_lines(
    matches: Sequence[RoomMatch], a: dict[int, tuple[int, int]], b: dict[int, tuple[int, int]]
) -> list[Markup]:
    parts = []
    for match in matches:
        i, j = match.rooms
        if i not in a or j not in b:
            continue
        (x1, y1), (x2, y2) = a[i], b[j]
        title = build_element("title", f"room {i} of a matches room {j} of b: probability {match.probability:.2f}")
        strength = f"{0.25 + 0.75 * match.probability:.2f}"
        parts.append(build_element("line", title, x1=x1, y1=y1, x2=x2, y2=y2, class_="match", stroke_opacity=strength))
        parts += [build_element("circle", class_="end", cx=x, cy=y) for x, y in ((x1, y1), (x2, y2))]
    return parts
