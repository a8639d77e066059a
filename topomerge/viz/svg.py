"""The plan of a map as SVG: outlines, sheet, drawing."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from scipy import ndimage

from topomerge.io.rooms_ply import assign_room_colours
from topomerge.structure.lines import estimate_wall_directions
from topomerge.types import LANDMARK_KINDS, Array, TopometricMap, find_room_names
from topomerge.viz.plan import (
    KEPT_DRAWINGS,
    Frame,
    Place,
    StoreyView,
    compute_frame,
    find_label_places,
    format_hex_colour,
    rasterize_storeys,
)
from topomerge.viz.tables import (
    SHOWN_KINDS,
    Markup,
    build_element,
    fold_words,
    format_edge_confidence,
    format_room_confidence,
    format_window_confidence,
    shorten,
)

UPRIGHT_ANGLE = np.radians(3.0)  # buildings that stand this nearly upright are drawn as they are
TALL = 1.15  # turned buildings that are taller than wide by this are laid down


@dataclass(frozen=True, eq=False)
class Sheet:
    """Where things stand on the paper.

    Args:
        frame: the pixels of the plan.
        key: what the page puts before the numbers of this map's rooms.
        turn: rad, by which the building is turned against the clock.
        corner: (2,) m, the upper left corner of what is drawn, in the turned frame.
        size: width and height of what is drawn, cm.
    """

    frame: Frame
    key: str
    turn: float
    corner: Array
    size: tuple[int, int]

    def convert_to_cm(self, points: Array) -> Array:
        """Return (n, 2) int64 places on the paper of (n, 2+) points in the input's frame, m."""
        turned = np.asarray(points, np.float64).reshape(-1, np.shape(points)[-1])[:, :2] @ build_rotation(self.turn).T
        return np.round(100 * (turned - self.corner) * (1, -1)).astype(np.int64)

    def convert_to_metres(self, places: Array) -> Array:
        """Return (n, 2) m in the input's frame, of places (n, 2) on the paper, cm."""
        back = np.array(self.back).reshape(2, 3)
        out: Array = places @ back[:, :2].T + back[:, 2]
        return out

    def locate(self, point: Any) -> tuple[int, int]:
        """Return the place on the paper of one point."""
        x, y = self.convert_to_cm(np.asarray([point]))[0].tolist()
        return x, y

    def format_room_id(self, room: int) -> str:
        """Return the identifier of a room in the page."""
        return f"{self.key}{room}"

    @property
    def back(self) -> list[float]:
        """a, b, c, d, e, f: the paper's (X, Y) cm are (a X + b Y + c, d X + e Y + f) m of the input."""
        undo = build_rotation(-self.turn)
        scaled = undo * (0.01, -0.01)
        x, y = undo @ self.corner
        return [*scaled[0].tolist(), float(x), *scaled[1].tolist(), float(y)]


def build_rotation(angle: float) -> Array:
    """Build the rotation (2, 2)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


def lay_out(map: TopometricMap, key: str = "", turn: float | None = None) -> tuple[Sheet, list[StoreyView]]:
    """Return the paper for a map and the plan of each storey, lowest first.

    Args:
        map: any map.
        key: stands before the numbers of its rooms, to tell the rooms of several maps on a page apart.
        turn: rad, by which the building is turned against the clock; None: so that its walls run along the paper.
    """
    frame = compute_frame(map)
    plans = rasterize_storeys(map, frame)
    return build_sheet(plans, frame, key, turn), plans


def build_sheet(plans: list[StoreyView], frame: Frame, key: str = "", turn: float | None = None) -> Sheet:
    """Build the paper for the plans of all storeys."""
    mask = np.any([plan.room >= 0 for plan in plans], axis=0)
    if not mask.any():
        mask = np.any([plan.floor for plan in plans], axis=0)
    pixels = np.argwhere(mask)
    points = frame.compute_centre(pixels) if len(pixels) else frame.low[None]
    if turn is None:
        walls = frame.compute_centre(np.argwhere(np.any([plan.wall for plan in plans], axis=0)))
        turn = float((np.pi / 4 - estimate_wall_directions(walls)[0]) % (np.pi / 2) - np.pi / 4)  # the nearest to none
        turn = 0.0 if abs(turn) < UPRIGHT_ANGLE else turn
        wide, high = np.ptp(points @ build_rotation(turn).T, axis=0)
        if turn and high > TALL * wide:
            turn -= np.copysign(np.pi / 2, turn)
    turned = points @ build_rotation(turn).T
    low, top = turned.min(axis=0) - frame.size, turned.max(axis=0) + frame.size
    width, height = np.round(100 * (top - low)).astype(int).tolist()
    return Sheet(frame, key, float(turn), np.array([low[0], top[1]]), (width, height))


CLOSED = 0.3  # m: gaps in a room's cells up to twice this are closed: scan lines on a floor, legs of tables
ROOM_HOLE = 6.0  # m2: holes in a room up to this are furniture or shadows, larger ones are courtyards and cores
SMOOTH = 0.8  # pixels: standard deviation of the blur before an outline is traced
TOLERANCE = 0.5  # pixels that an outline may be off for having fewer corners
WALL_TRACE = (0.6, 0.36)  # blur and level for walls: lines of one pixel stay whole, single pixels go
SPECK = 0.3  # m2: smaller patches of what was seen outside rooms are left out


@lru_cache(maxsize=KEPT_DRAWINGS)
def fill_rooms(plan: StoreyView, frame: Frame) -> Array:
    """Return (nx, ny) int32 room of each pixel, -1 none, with small gaps and holes filled; no pixel changes from room to room."""
    reach = max(round(CLOSED / frame.size), 1)
    room = plan.room.copy()
    for i, box in enumerate(ndimage.find_objects(plan.room + 1)):
        if box is None:
            continue
        low = [max(s.start - reach - 1, 0) for s in box]
        wide = tuple(slice(a, s.stop + reach + 1) for a, s in zip(low, box, strict=True))
        mask = np.pad(plan.room[wide] == i, reach)  # away from the rim, where closing would eat the mask
        closed = ndimage.binary_closing(mask, ndimage.generate_binary_structure(2, 1), iterations=reach)
        inner = _fill_small_holes(closed, ROOM_HOLE / frame.size**2)[reach:-reach, reach:-reach]
        part = room[wide]
        part[inner & (part < 0)] = i
    return room


def _fill_small_holes(mask: Array, most: float) -> Array:
    holes, count = ndimage.label(ndimage.binary_fill_holes(mask) & ~mask)
    small = np.bincount(holes.ravel(), minlength=count + 1) <= most
    small[0] = False
    return mask | small[holes]


@lru_cache(maxsize=KEPT_DRAWINGS)
def trace_rooms(plan: StoreyView, sheet: Sheet) -> dict[int, str]:
    """Trace each room: room -> its outline as the `d` of an SVG path."""
    room = fill_rooms(plan, sheet.frame)
    return {i: trace_room(room[box] == i, sheet, box) for i, box in enumerate(ndimage.find_objects(room + 1)) if box is not None}


def trace_room(mask: Array, sheet: Sheet, box: tuple[slice, slice]) -> str:
    """Trace one room as the `d` of an SVG path, of its pixels (nx, ny) bool in a box."""
    share, start = mask.astype(np.float32), np.array([s.start for s in box])
    return trace(share, sheet, start) or trace(share, sheet, start, blur=0.0)


@lru_cache(maxsize=KEPT_DRAWINGS)
def trace_walls(plan: StoreyView, sheet: Sheet) -> str:
    """Trace walls as the `d` of an SVG path; the two faces of a thin wall are drawn as one."""
    near = round(0.1 / sheet.frame.size)
    wall = plan.wall
    if near:
        padded = np.pad(wall, near)
        wall = ndimage.binary_closing(padded, np.ones((3, 3), bool), iterations=near)[near:-near, near:-near]
    blur, level = WALL_TRACE
    return trace(wall.astype(np.float32), sheet, blur=blur, level=level)


def trace_observed_floor(plan: StoreyView, sheet: Sheet) -> str:
    """Trace the observed floor of the storey outside rooms, as the `d` of an SVG path."""
    patches, count = ndimage.label(plan.floor & (fill_rooms(plan, sheet.frame) < 0))
    large = np.bincount(patches.ravel(), minlength=count + 1) >= SPECK / sheet.frame.size**2
    large[0] = False
    return trace(large[patches].astype(np.float32), sheet)


def trace(
    share: Array, sheet: Sheet, start: Array | None = None, blur: float = SMOOTH, level: float = 0.5, tolerance: float = TOLERANCE
) -> str:
    """Trace the `d` of an SVG path around the pixels of which a share above `level` is filled; "" where there are none.

    Args:
        share: (nx, ny) float, of the frame's pixels from `start` on.
        sheet: the paper and the pixels' place.
        start: (2,) pixel at share[0, 0], by default (0, 0).
        blur: standard deviation of the blur before, in pixels.
        level: above this is inside.
        tolerance: how far the path may be off, in pixels (Douglas and Peucker 1973).
    """
    import contourpy
    import shapely

    pad = int(np.ceil(3 * blur)) + 1
    field = ndimage.gaussian_filter(np.pad(share, pad), blur) if blur else np.pad(share, pad)
    lines = contourpy.contour_generator(z=field.T).lines(level)  # closed: the padding is outside
    closed: list[Array] = [np.asarray(line) for line in lines if line is not None and len(line) > 3]
    if not closed:
        return ""
    owner = np.repeat(np.arange(len(closed)), [len(line) for line in closed])
    rings = shapely.simplify(shapely.linearrings(np.concatenate(closed), indices=owner), tolerance)  # all at once
    corners, owner = shapely.get_coordinates(rings, return_index=True)
    offset = (np.zeros(2) if start is None else start) - pad + 0.5
    return "".join(_format_rings(corners + offset, owner, sheet))


def _format_rings(pixels: Array, owner: Array, sheet: Sheet) -> Iterator[str]:
    """Yield each closed ring, as steps in cm.

    Args:
        pixels: (n, 2) corners of one ring after the other, the first one of each twice.
        owner: (n,) ascending, of which ring each is.
    """
    cm = sheet.convert_to_cm(sheet.frame.low + pixels * sheet.frame.size)
    starts = np.flatnonzero(np.diff(owner, prepend=-1))
    ends = np.append(starts[1:], len(cm)) - 1  # without the corner that closes the ring
    steps = np.diff(cm, axis=0, append=cm[-1:])
    moves, every = (steps != 0).any(axis=1), cm.tolist()
    texts = [f"{x} {y}" for x, y in steps.tolist()]
    for first, last in zip(starts.tolist(), ends.tolist(), strict=True):
        taken = [texts[first + k] for k in np.flatnonzero(moves[first : last - 1]).tolist()]
        if len(taken) > 1:
            yield f"M{every[first][0]} {every[first][1]}l{' '.join(taken)}z"


SCREEN = (840, 560)  # pixels that the drawing is expected to have: the page's script knows better
PLAN_MARGIN = 0.04  # of the longer side, around the building
MOST_LANDMARKS_DRAWN = 1000  # on a storey
SHORTEST_FLIGHT = 0.5  # m: stairs whose ends are nearer to each other, seen from above, are drawn as a sign


def render_plan_svgs(map: TopometricMap, sheet: Sheet, plans: Sequence[StoreyView], colours: Array | None = None) -> list[Markup]:
    """Render the plan of each storey, lowest first.

    Args:
        map: any map.
        sheet: the paper, and `plans`, the plan of each storey: both from `lay_out`.
        colours: (R, 3) uint8 of the rooms; neighbours differ if None.

    Returns:
        `<svg class="plan" data-storey=…>` elements. Rooms, their labels and their nodes in the graph carry `data-room`, and all
        that is not certain `data-sure`.
    """
    colours = assign_room_colours(map) if colours is None else colours
    named = [find_label_places(plan, sheet.frame) for plan in plans]
    names = find_room_names(map.landmarks, len(map.rooms))
    everywhere = {room: place for of_storey in named for room, place in of_storey.items()}
    drawings = []
    for storey, plan in enumerate(plans):
        outlines = trace_rooms(plan, sheet)
        layers = [
            build_element("path", class_="seen", d=trace_observed_floor(plan, sheet)),
            _render_layer("rooms", [_render_room(map, sheet, i, d, format_hex_colour(colours[i])) for i, d in outlines.items()]),
            build_element("path", class_="wall", d=trace_walls(plan, sheet), fill_rule="evenodd"),
            _render_layer("windows", _render_windows(map, sheet, storey)),
            _render_layer("areas", _render_narrows(map, sheet, storey)),
            _render_layer("graph", _render_graph(map, sheet, storey, everywhere)),
            _render_layer("doors", _render_doors(map, sheet, storey)),
            _render_layer("landmarks", _render_landmarks(map, sheet, storey)),
            _render_layer(
                "labels", [_render_label(map, sheet, i, place, names[i]) for i, place in sorted(named[storey].items())]
            ),
        ]
        drawings.append(render_drawing(map, sheet, storey, layers))
    return drawings


def _render_layer(name: str, parts: list[Markup]) -> Markup:
    return build_element("g", *parts, class_=name)


def render_drawing(map: TopometricMap, sheet: Sheet, storey: int, layers: list[Markup]) -> Markup:
    """Render one `<svg class="plan">` of what its layers hold, with scale bar and axes, that the page's script can zoom."""
    width, height = sheet.size
    margin = round(PLAN_MARGIN * max(width, height)) + 30
    unit = max((width + 2 * margin) / SCREEN[0], (height + 2 * margin) / SCREEN[1])
    hatch = f"hatch-{sheet.key}{storey}"
    stripe = build_element("line", x1=0, y1=0, x2=0, y2=24)
    pattern = build_element("pattern", stripe, id=hatch, width=24, height=24, patternUnits="userSpaceOnUse",
                      patternTransform="rotate(45)", class_="hatch")  # fmt: skip
    glimpsed = np.flatnonzero(map.rooms["glimpsed"] & (map.rooms["storey"] == storey)) if len(map.rooms) else ()
    style = f"--unit:{unit:.3f};" + (f"--hatch:url(#{hatch})" if len(glimpsed) else "")
    return build_element(
        "svg",
        build_element("defs", pattern),
        *layers,
        _render_scale_bar(height, margin, unit),
        _render_axes(sheet, margin, unit),
        class_="plan",
        viewBox=f"{-margin} {-margin} {width + 2 * margin} {height + 2 * margin + round(26 * unit)}",
        data_storey=storey,
        data_back=" ".join(f"{value:.8g}" for value in sheet.back),
        style=style,
        role="img",
        aria_label=f"Plan of storey {storey}",
    )


def _render_scale_bar(height: int, margin: int, unit: float) -> Markup:
    """Render a bar of a round length below the drawing; the page's script makes another when the drawing is zoomed."""
    lengths = [m * 10**k for k in range(-2, 6) for m in (1, 2, 5)]
    length = max((s for s in lengths if 100 * s <= 160 * unit), default=lengths[0])
    bar = build_element("path", d=f"M0 0v{6 * unit:.0f}h{100 * length:.0f}v{-6 * unit:.0f}")
    text = build_element("text", f"{length:g} m", x=round(100 * length + 6 * unit), y=round(6 * unit))
    return build_element("g", bar, text, class_="scale", transform=f"translate(0 {height + margin})")


def _render_axes(sheet: Sheet, margin: int, unit: float) -> Markup:
    """Render the directions of the input's x and y, in the lower right corner."""
    width, height = sheet.size
    parts = []
    for name, angle in (("x", sheet.turn), ("y", sheet.turn + math.pi / 2)):
        u, v = math.cos(angle), -math.sin(angle)
        parts.append(build_element("path", d=f"M0 0L{20 * u:.1f} {20 * v:.1f}"))
        parts.append(build_element("text", name, x=round(28 * u, 1), y=round(28 * v, 1)))
    mark = build_element("g", *parts, transform=f"scale({unit:.3f})")
    return build_element("g", mark, class_="axes", transform=f"translate({width + margin - round(40 * unit)} {height + margin})")


def _render_room(map: TopometricMap, sheet: Sheet, room: int, path: str, colour: str) -> Markup:
    about = map.rooms[room]
    kind = "room glimpsed" if about["glimpsed"] else "room"
    text = f"Room {room}, {about['area']:.1f} m²"
    drawn = {"d": path, "fill_rule": "evenodd", "data_sure": format_room_confidence(about)}
    shape = build_element("path", class_=kind, **drawn, fill=colour, data_room=sheet.format_room_id(room), aria_label=text)
    if not about["glimpsed"]:
        return shape
    return Markup(shape + build_element("path", class_="over", **drawn))


def _render_landmarks(map: TopometricMap, sheet: Sheet, storey: int) -> list[Markup]:
    """Render a mark with its text for each sign, tag, object and name of a storey whose place is known, of very many the
    surest."""
    table = map.landmarks.table
    shown = map.landmarks.is_kind(*SHOWN_KINDS) & np.isfinite(table["position"]).all(axis=1) & (table["storey"] == storey)
    rows = np.flatnonzero(shown)
    rows = np.sort(rows[np.argsort(-table["confidence"][rows], kind="stable")[:MOST_LANDMARKS_DRAWN]])
    parts = []
    for row, (x, y) in zip(table[rows], sheet.convert_to_cm(table["position"][rows]).tolist(), strict=True):
        value, kind = map.landmarks.values[row["value"]], LANDMARK_KINDS[row["kind"]]
        element = build_element("title", f"{kind}: {value}")
        dot, text = build_element("circle", r=1), build_element("text", shorten(value))
        about = {
            "data_room": sheet.format_room_id(int(row["room"])) if row["room"] >= 0 else None,
            "data_words": fold_words([value]),
        }
        parts.append(build_element("g", element, dot, text, class_=f"landmark {kind}", transform=f"translate({x} {y})", **about))
    return parts


def _render_label(map: TopometricMap, sheet: Sheet, room: int, place: Place, name: str) -> Markup:
    """Render the number, and its name or else its area; the page's script hides what has no room."""
    x, y = sheet.locate((place.x, place.y))
    number = build_element("text", str(room), class_="number")
    area = build_element("text", shorten(name) if name else f"{map.rooms['area'][room]:.1f} m²", class_="size")
    clear = round(100 * place.clear)
    about = {"data_room": sheet.format_room_id(room), "data_clear": clear, "data_sure": format_room_confidence(map.rooms[room])}
    return build_element("g", number, area, class_="label", transform=f"translate({x} {y})", **about)


def _compute_jambs(edge: Any) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the two jambs of a door, seen from above, m."""
    x, y = edge["centre"][:2].tolist()
    half = max(float(edge["width"]), 0.2) / 2
    u, v = -math.sin(edge["direction"]) * half, math.cos(edge["direction"]) * half
    return (x - u, y - v), (x + u, y + v)


def _render_line(sheet: Sheet, a: Any, b: Any, **attributes: Any) -> Markup:
    (x1, y1), (x2, y2) = sheet.locate(a), sheet.locate(b)
    return build_element("line", x1=x1, y1=y1, x2=x2, y2=y2, **attributes)


def _render_doors(map: TopometricMap, sheet: Sheet, storey: int) -> list[Markup]:
    parts = []
    labelled: set[int] = set()  # rooms above or below that a word names already
    for i, edge in enumerate(map.edges):
        rooms = [room for room in edge["rooms"].tolist() if map.rooms["storey"][room] == storey]
        if not rooms:
            continue
        if edge["kind"] in ("stairs", "ramp"):
            parts.append(_render_stairs(map, sheet, storey, i, labelled))
            continue
        state = f"door {edge['kind']} {'open' if edge['open'] else 'shut'}"
        lines = [_render_line(sheet, *_compute_jambs(edge), class_=name) for name in ("gap", "leaf")]
        parts.append(build_element("g", *lines, class_=state, **_build_edge_attributes(map, sheet, i)))
    return parts


def _build_edge_attributes(map: TopometricMap, sheet: Sheet, i: int) -> dict[str, str]:
    return {"data_edge": f"{sheet.key}{i}", "data_sure": format_edge_confidence(map, map.edges[i])}


def _render_stairs(map: TopometricMap, sheet: Sheet, storey: int, i: int, labelled: set[int]) -> Markup:
    """Render treads from the lower to the upper end with an arrow up, and a word where they lead, once for each room."""
    edge = map.edges[i]
    a, b = edge["rooms"].tolist()
    other = b if map.rooms["storey"][a] == storey else a
    level = int(map.rooms["storey"][other])
    parts: list[Markup] = []
    spot = edge["centre"]
    if np.hypot(*(edge["upper"] - edge["lower"])[:2]) >= SHORTEST_FLIGHT:
        parts = _render_flight(
            sheet.locate(edge["lower"]), sheet.locate(edge["upper"]), float(edge["width"]), edge["kind"] == "stairs"
        )
        spot = (edge["lower"] + edge["upper"]) / 2
    element = [] if parts else [build_element("path", class_="sign", d="M-6 5L0 -6L6 5z")]
    if other not in labelled:
        labelled.add(other)
        element.append(build_element("text", f"{'up ' if level > storey else 'down ' if level < storey else ''}to {other}"))
    x, y = sheet.locate(spot)
    place = build_element("g", *element, class_="to", transform=f"translate({x} {y})")
    return build_element("g", *parts, place, class_=f"door {edge['kind']}", **_build_edge_attributes(map, sheet, i))


def _render_flight(lower: tuple[int, int], upper: tuple[int, int], width: float, treads: bool) -> list[Markup]:
    """Render an arrow up and, across it, treads 30 cm apart."""
    (x, y), (x2, y2) = lower, upper
    length = math.hypot(x2 - x, y2 - y)
    u, v = (x2 - x) / length, (y2 - y) / length
    half = 50 * max(width, 0.6)

    def at(along: float, across: float) -> str:
        return f"{x + u * along - v * across:.0f} {y + v * along + u * across:.0f}"

    lines = "".join(f"M{at(s, -half)}L{at(s, half)}" for s in range(0, int(length) + 1, 30)) if treads else ""
    arrow = f"M{at(0, 0)}L{at(length, 0)}M{at(length - 30, -18)}L{at(length, 0)}L{at(length - 30, 18)}"
    return [build_element("path", class_="tread", d=lines), build_element("path", class_="flight", d=arrow)]


def _render_graph(map: TopometricMap, sheet: Sheet, storey: int, named: dict[int, Place]) -> list[Markup]:
    """Render lines from room to door to room; of stairs the half that lies on this storey."""
    parts = []
    for edge in map.edges:
        rooms = [room for room in edge["rooms"].tolist() if room in named and map.rooms["storey"][room] == storey]
        if not rooms:
            continue
        spots = [sheet.locate((named[room].x, named[room].y)) for room in rooms]
        spots.insert(1, sheet.locate(edge["centre"]))
        path = "M" + "L".join(f"{x} {y}" for x, y in spots)
        parts.append(build_element("path", class_=f"link {edge['kind']}", d=path, data_sure=format_edge_confidence(map, edge)))
    for room, place in sorted(named.items()):
        if map.rooms["storey"][room] == storey:
            x, y = sheet.locate((place.x, place.y))
            about = {"data_room": sheet.format_room_id(room), "data_sure": format_room_confidence(map.rooms[room])}
            parts.append(build_element("circle", class_="node", cx=x, cy=y, **about))
    return parts


def _render_narrows(map: TopometricMap, sheet: Sheet, storey: int) -> list[Markup]:
    """Render where rooms narrow: thin dashed lines between their areas, with the probability that these are two rooms."""
    if not len(map.narrows):
        return []
    rooms = map.rooms[map.areas["room"][map.narrows["rooms"][:, 0]]]
    shown = [(edge, room) for edge, room in zip(map.narrows, rooms, strict=True) if room["storey"] == storey]
    return [
        build_element(
            "g",
            build_element("title", f"zones of one room; two rooms with a probability of {edge['confidence']:.2f}"),
            _render_line(sheet, *_compute_jambs(edge), class_="narrow", data_sure=format_room_confidence(room)),
        )
        for edge, room in shown
    ]


def _render_windows(map: TopometricMap, sheet: Sheet, storey: int) -> list[Markup]:
    """Thin double lines in a gap of the wall, as in floor plans."""
    on_storey = map.rooms["storey"][map.windows["rooms"][:, 0]] == storey
    parts = []
    for window in map.windows[on_storey]:
        lines = [_render_line(sheet, *_compute_jambs(window), class_=name) for name in ("gap", "frame", "pane")]
        parts.append(build_element("g", *lines, class_="window", data_sure=format_window_confidence(map, window)))
    return parts
