"""Pages of two maps: what has changed, and a matching.

Changes: both plans on each other with a fader and a swipe, and a list that zooms. A matching: both plans, rooms coloured by how
sure their match is, and what stands around them side by side.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.changes.compare import Change, Changes
from topomerge.changes.layers import RelativePlacement
from topomerge.embedding.sheets import build_sheet_arrays
from topomerge.embedding.surroundings import CROP, CROP_PLANES, SHEET_PIXEL, cut_crops
from topomerge.fusion.result import RoomMatch
from topomerge.matching.match import Matching
from topomerge.types import Array, TopometricMap
from topomerge.viz.merge_plan import lay_out_pair, render_blend_view, render_lines
from topomerge.viz.merge_report import FOR, PIXEL_COLOURS, SILENT, UNKNOWN, encode_png_uri, flip_north_up
from topomerge.viz.report import render_page, render_plan_view, render_scroller, render_section, write_page
from topomerge.viz.svg import Sheet
from topomerge.viz.tables import (
    Markup,
    build_element,
    join,
    measure,
    render_cell,
    render_properties,
    render_room_link,
    render_share_bar,
    render_table,
)

PRESENT = 64  # of 255: so much of a pixel is drawn as of a kind
ROOM_TINT = np.array([196, 222, 240], np.uint8)  # the floor of the room in the middle


def save_match_report(matching: Matching, a: TopometricMap, b: TopometricMap, path: str | Path) -> None:
    """Write the report. The same matching gives the same bytes.

    Raises:
        InputError: the path can't be written.
    """
    write_page(render_match_html(matching, a, b), path)


def render_match_html(matching: Matching, a: TopometricMap, b: TopometricMap) -> str:
    """Return the report as HTML: the plans, a line for each match, and for each match what stands around both rooms."""
    matches = [
        RoomMatch((0, 1), (i, j), float(p)) for (i, j), p in zip(matching.rooms.tolist(), matching.probability, strict=True)
    ]
    drawn = lay_out_pair(a, b, matching.transform)
    shades = [_compute_shades(m, matching.rooms[:, k], matching.probability) for k, m in enumerate((a, b))]
    views = []
    for name, m, (sheet, plans), colours in zip("ab", (a, b), drawn, shades, strict=True):
        head = build_element("h3", f"{name}: {m.title} ", build_element("small", f"{len(m.rooms)} rooms"))
        views.append(build_element("div", head, render_plan_view(m, sheet, plans, colours)))
    text = "Green rooms have a match (greener: more probable), grey ones none. Click a room to compare the surroundings."
    compared = [
        build_element("p", text, class_="note"),
        build_element("div", *views, class_="pair"),
        build_element("div", *_render_pairs(matches, a, b), class_="places"),
    ]
    sections = [
        _render_match_summary(matches, a, b),
        render_section("The two maps", join(compared), "places"),
        render_section(
            "Room matches",
            build_element("div", render_lines((a, b), drawn, matches, shades), class_="sheet"),
            "lines",
        ),
        render_section("Matched rooms", render_scroller(_render_table(matches, a, b)), "matches"),
        render_section("How it was made", _render_provenance(matching, a, b), "made"),
    ]
    names = " + ".join(m.title for m in (a, b))
    return render_page(names, "Rooms of two maps", sections, {"mates": _collect_partners(matches)})


def _render_match_summary(matches: Sequence[RoomMatch], a: TopometricMap, b: TopometricMap) -> Markup:
    sure = sum(match.probability >= 0.5 for match in matches)
    figures = [
        (len(a.rooms), "rooms of a"),
        (len(b.rooms), "rooms of b"),
        (len(matches), "matches"),
        (sure, "with probability 0.5 or more"),
    ]
    items = [build_element("li", build_element("b", str(value)), build_element("span", name)) for value, name in figures]
    return build_element("ul", *items, class_="summary")


def _compute_shades(map: TopometricMap, rooms: Array, probability: Array) -> Array:
    """Return (R, 3) uint8, from grey (no match) to green (sure)."""
    sure = np.zeros(len(map.rooms))
    np.maximum.at(sure, rooms, probability)
    return np.round(SILENT + sure[:, None] * (FOR - SILENT)).astype(np.uint8)


def _render_pairs(matches: Sequence[RoomMatch], a: TopometricMap, b: TopometricMap) -> list[Markup]:
    """Render the surroundings of the rooms of each match, folded."""
    if not matches:
        return []
    around_a, around_b = (cut_crops(build_sheet_arrays(m)) for m in (a, b))
    rooms = np.array([match.rooms for match in matches])
    turned = np.rot90(around_b, find_aligning_quarters(around_a[rooms[:, 0]], around_b[rooms[:, 1]]), (1, 2))
    out = []
    for match in matches:
        i, j = match.rooms
        images = [
            build_element(
                "img",
                src=encode_png_uri(draw_surroundings(crop)),
                alt=f"room {r} of {name} from above",
                width="192",
                height="192",
            )
            for name, r, crop in (("a", i, around_a[i]), ("b", j, turned[j]))
        ]
        text = f"{CROP * SHEET_PIXEL:g} m around room {i} of a and room {j} of b, turned alike"
        cards = build_element("div", build_element("figure", *images, build_element("figcaption", text)), class_="cards")
        head = build_element(
            "summary", render_room_link("a", i), " matches ", render_room_link("b", j), f", probability {match.probability:.2f}"
        )
        out.append(build_element("details", head, cards, data_room_of_a=i, data_room_of_b=j))
    return out


def find_aligning_quarters(a: Array, b: Array) -> int:
    """Return the quarter turns, counter-clockwise, after which most walls around rooms of b are where they are around their
    partners in a.

    Args:
        a, b: (M, CROP, CROP, len(CROP_PLANES)) of `crops`, a row for each match.
    """
    wall = CROP_PLANES.index("wall")
    first, second = a[..., wall].astype(np.float32), b[..., wall].astype(np.float32)
    return int(np.argmax([(first * np.rot90(second, k, (1, 2))).sum() for k in range(4)]))


def draw_surroundings(crop: Array) -> Array:
    """Draw (CROP, CROP, 3) uint8 picture of what stands around a room, up where y is large."""
    of = dict(zip(CROP_PLANES, np.moveaxis(crop, -1, 0), strict=True))
    image = np.full((*crop.shape[:2], 3), UNKNOWN, np.uint8)
    image[(of["explored"] >= PRESENT) | (of["floor"] >= PRESENT)] = PIXEL_COLOURS["free"]
    image[of["room"] > 0] = ROOM_TINT
    image[np.maximum(of["low"], of["high"]) >= PRESENT] = PIXEL_COLOURS["clutter"]
    image[of["wall"] >= PRESENT] = PIXEL_COLOURS["wall"]
    return flip_north_up(image)


def _render_table(matches: Sequence[RoomMatch], a: TopometricMap, b: TopometricMap) -> Markup:
    columns = [(name, "number") for name in ("room of a", "area m²", "room of b", "area m²")] + [("probability", "text")]
    rows = []
    for match in matches:
        cells = []
        for key, m, room in zip("ab", (a, b), match.rooms, strict=True):
            area = float(m.rooms["area"][room])
            cells += [render_cell(render_room_link(key, room), room), render_cell(f"{area:.1f}", area)]
        rows.append(build_element("tr", *cells, render_cell(render_share_bar(match.probability), match.probability, kind="text")))
    return render_table(columns, rows, "Matched rooms")


def _render_provenance(matching: Matching, a: TopometricMap, b: TopometricMap) -> Markup:
    sources = {name: m.source or "–" for name, m in zip("ab", (a, b), strict=True)}
    poses = {
        f"{k + 1}": f"probability {h.probability:.2f}, {len(h.rooms)} matches, rotation {np.degrees(h.transform.yaw):.1f}°"
        for k, h in enumerate(matching.alternatives[:5])
    }
    return build_element(
        "div",
        render_properties(sources, "Maps"),
        render_properties(poses or {"poses": "none needed"}, "Poses of b"),
        class_="facts-row",
    )


def _collect_partners(matches: Sequence[RoomMatch]) -> dict[str, Any]:
    """Map each room, as the page calls it, to its partners."""
    mates: dict[str, list[str]] = {}
    for match in matches:
        one, other = (f"{name}{room}" for name, room in zip("ab", match.rooms, strict=True))
        mates.setdefault(one, []).append(other)
        mates.setdefault(other, []).append(one)
    return dict(sorted(mates.items()))


TONES = {"new": "new", "opened": "new", "grown": "new", "gone": "gone", "missing": "gone", "bricked": "gone", "shut": "gone"}
ALTERED = "altered"  # moved, elsewhere, split, joined, shrunk
WORDS = {"new": "new, opened or grown", "gone": "gone, shut, bricked up or missing", ALTERED: "moved, split, joined or elsewhere"}
ELEMENTS = ("wall", "door", "room", "furniture", "element")
PLURALS = {"furniture": "furniture"}
DOOR_SIGN = 14  # cm, of the ring around a door that changed


def save_changes_report(changes: Changes, path: str | Path) -> None:
    """Write the page. The same changes give the same bytes.

    Raises:
        InputError: the path can't be written.
    """
    write_page(render_changes_html(changes), path)


def render_changes_html(changes: Changes) -> str:
    """Render the page as HTML: what changed on the plans of both maps, as a list, and of a model its elements."""
    sections = [_render_summary(changes), render_section("What has changed", _render_view(changes), "changes")]
    sections.append(render_section("List", render_scroller(_render_list(changes)), "list"))
    if changes.elements:
        sections.append(render_section("Elements of the model", render_scroller(_render_elements(changes)), "elements"))
    properties = {
        "old": changes.old.source or "–",
        "new": changes.new.source or "–",
        "off by less is no change": f"{100 * changes.slack:.0f} cm",
        "seen by both": ", ".join(f"storey {k}: {v:.0f} m²" for k, v in sorted(changes.compared.items())),
        "new map turned by": f"{np.degrees(changes.placement.pose.yaw):.2f}°",
    }
    sections.append(render_section("How it was made", render_properties(properties, "Comparison"), "made"))
    names = f"{changes.old.title} → {changes.new.title}"
    return render_page(names, "What has changed", sections, {})


def get_tone(change: Change) -> str:
    """Get the class of colours of a change: "new", "gone" or "altered"."""
    return TONES.get(change.kind.split(" ")[1], ALTERED)


def _render_summary(changes: Changes) -> Markup:
    counts = changes.count_kinds()
    items = [build_element("li", build_element("b", str(count)), build_element("span", kind)) for kind, count in counts.items()]
    states = [row.state for row in changes.elements]
    items += [
        build_element("li", build_element("b", str(states.count(state))), build_element("span", f"elements {state}"))
        for state in dict.fromkeys(states)
        if state in ("seen", "unseen")
    ]
    nothing = build_element("li", build_element("b", "0"), build_element("span", "changes that both maps could see"))
    return build_element("ul", *(items or [nothing]), class_="summary")


def _render_view(changes: Changes) -> Markup:
    place = changes.placement
    bends, pose, to_paper = {}, place.pose, lambda points: points  # drawn as they lie, bent
    if isinstance(place, RelativePlacement):
        bends = {k: p.bend for k, p in enumerate((place.old, place.new)) if p.bend is not None}
        to_paper = place.old.transform_points
    drawn = lay_out_pair(changes.old, changes.new, pose)

    def overlay(storey: int | None, paper: Sheet) -> list[Markup]:
        return [
            _render_mark(k, change, paper, to_paper)
            for k, change in enumerate(changes.changes)
            if change.storey == storey or (storey is None and not len(changes.old.storeys))
        ]

    view = render_blend_view(changes.old, changes.new, drawn, pose, bends, names=("old", "new"), overlay=overlay)
    boxes = [
        build_element(
            "label", build_element("input", type="checkbox", checked=True, data_layer=name), f" {PLURALS.get(name, f'{name}s')}"
        )
        for name in ELEMENTS
        if any(c.element == name for c in changes.changes)
    ]
    signs = [build_element("li", build_element("i", class_=f"sign-{tone}"), element) for tone, element in WORDS.items()]
    note = (
        "The first slider fades between the maps; the second one wipes: old to its left, new to its right. Click a row to zoom."
    )
    return join(
        [
            build_element("div", view, build_element("div", *boxes, class_="layers diff-layers"), class_="diff-view"),
            build_element("ul", *signs, class_="legend"),
            build_element("p", note, class_="note"),
        ]
    )


def _render_mark(k: int, change: Change, paper: Sheet, to_paper: Any) -> Markup:
    """Render a change on the paper: an outline, a line, or a ring around a door; furniture that moved has an arrow."""
    heights = np.full(len(change.shape), change.place[2])
    places = paper.convert_to_cm(to_paper(np.column_stack([change.shape, heights])))
    parts: list[Markup] = [build_element("title", _describe(change))]
    if change.from_place is not None:
        start, end = (paper.convert_to_cm(to_paper(p[None]))[0].tolist() for p in (change.from_place, change.place))
        parts.append(build_element("path", d=f"M{start[0]} {start[1]}L{end[0]} {end[1]}", class_="way"))
        parts.append(build_element("circle", cx=start[0], cy=start[1], r=8, class_="start"))
    parts.append(build_element("path", d=_format_path(places), class_="shape"))
    if change.element == "door":
        x, y = places.mean(axis=0).round().astype(int).tolist()
        radius = int(50 * change.extent) + DOOR_SIGN
        parts.append(build_element("circle", cx=x, cy=y, r=radius, class_="shape ring"))
    kind = f"change {get_tone(change)} of-{change.element}"
    return build_element("g", *parts, class_=kind, data_edge=f"c{k}", data_sure=f"{change.probability:.3f}")


def _describe(change: Change) -> str:
    return f"{change.kind}{f' {change.name}' if change.name else ''}, probability {change.probability:.2f}"


def _format_path(places: Array) -> str:
    (x, y), rest = places[0].tolist(), places[1:].tolist()
    return f"M{x} {y}L{' '.join(f'{u} {v}' for u, v in rest)}{'z' if len(places) > 2 else ''}"


def _render_list(changes: Changes) -> Markup:
    columns = [("no.", "number"), ("change", "text"), ("what", "text"), ("storey", "number"), ("size m", "number")]
    columns += [("shift cm", "number")] if changes.elements else []
    columns += [("x m", "number"), ("y m", "number"), ("probability", "text")]
    rows = []
    for k, change in enumerate(changes.changes):
        swatch = build_element("span", class_=f"swatch sign-{get_tone(change)}")
        about = change.name or _name_rooms(change)
        cells = [render_cell(str(k), k), render_cell(join([swatch, change.kind]), kind="text"), render_cell(about, kind="text")]
        cells += [render_cell(str(change.storey), change.storey), measure(change.extent, 2)]
        cells += [measure(100 * change.evidence.get("shift", float("nan")), 1)] if changes.elements else []
        cells += [measure(v, 2) for v in change.place[:2].tolist()]
        cells.append(render_cell(render_share_bar(change.probability), change.probability, kind="text"))
        rows.append(build_element("tr", *cells, data_edge=f"c{k}", tabindex=0))
    return render_table(columns, rows, "Changes")


def _name_rooms(change: Change) -> str:
    """Tell which doors or rooms of the maps a change is about."""
    what = {"door": "door", "room": "room"}.get(change.element, "")
    sides = [f"{what} {', '.join(map(str, n))} of {when}" for n, when in ((change.old, "old"), (change.new, "new")) if n]
    return " → ".join(sides) if what else ""


def _render_elements(changes: Changes) -> Markup:
    columns = [("kind", "text"), ("name", "text"), ("GUID", "text"), ("state", "text"), ("shift cm", "number")]
    columns += [("± cm", "number"), ("seen", "text"), ("probability", "text")]
    rows = []
    for row in changes.elements:
        cells = [render_cell(text, kind="text") for text in (row.element.kind, row.element.name, row.element.guid, row.state)]
        cells += [measure(100 * row.shift, 1), measure(100 * row.sigma, 1)]
        cells += [render_cell(render_share_bar(v), v, kind="text") for v in (row.share, row.probability)]
        rows.append(build_element("tr", *cells))
    return render_table(columns, rows, "Elements")
