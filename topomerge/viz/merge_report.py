"""The report of a merge: both maps, what they have in common, the joined map."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from topomerge.archive import replace_on_success
from topomerge.errors import InputError
from topomerge.fusion.fuse import find_joined_rooms
from topomerge.fusion.pipeline import format_hypothesis, format_probability, list_evidence, list_posterior
from topomerge.fusion.result import MergeResult, build_placements, serialise_merge
from topomerge.fusion.transfer import transform_floor
from topomerge.io.listing import format_json
from topomerge.io.maps import save_map
from topomerge.io.rooms_ply import assign_room_colours, save_rooms_ply
from topomerge.registration.pipeline import Registration
from topomerge.registration.places import MOST_ODDS, PARTS, Places
from topomerge.types import Array, Placement, Sim3, TopometricMap
from topomerge.viz.merge_plan import Drawn, lay_out_pair, render_blend_view, render_deformation_table, render_lines
from topomerge.viz.plan import build_scene_data
from topomerge.viz.report import (
    render_page,
    render_plan_view,
    render_scene_view,
    render_scroller,
    render_section,
    render_warnings,
)
from topomerge.viz.svg import lay_out
from topomerge.viz.tables import (
    Markup,
    build_element,
    join,
    render_cell,
    render_landmarks,
    render_properties,
    render_room_link,
    render_rooms_table,
    render_share_bar,
    render_table,
)

MOST_SHOWN = 40  # places, those that say most
REACH = 3.0  # m between the middle of a place and the nearest floor of a room
AGAINST, FOR, SILENT = np.array([201, 64, 48.0]), np.array([38, 140, 86.0]), np.array([205, 203, 196.0])
PIXEL_COLOURS = {"free": (236, 234, 228), "clutter": (224, 152, 60), "wall": (40, 44, 52), "hanging": (120, 160, 214)}
UNKNOWN = (160, 160, 156)


def render_places(a: TopometricMap, drawn: Drawn, places: Places) -> Markup:
    """Render the plan of map a with its rooms in the colours of what they say, and the places that say most."""
    rooms = assign_places_to_rooms(a, places)
    odds = compute_room_log_odds(places, rooms, len(a.rooms))
    sheet, plans = drawn
    text = "Green rooms look the same in both maps, red ones more like another room; grey ones give no evidence."
    view = render_plan_view(a, sheet, plans, compute_room_shades(odds))
    order = np.argsort(-np.abs(places.log_odds), kind="stable")[:MOST_SHOWN]
    by_room = sorted({int(rooms[k]) for k in order}, key=lambda i: odds[i] if i >= 0 and np.isfinite(odds[i]) else 0.0)
    groups = [_render_room(i, [int(k) for k in order if rooms[k] == i], odds, places) for i in by_room]
    note = "Click a room to see what was compared there, map a left, map b right; rooms with evidence against come first."
    parts = [
        build_element("p", text, class_="note"),
        view,
        build_element("p", note, class_="note"),
        build_element("div", *groups, class_="places"),
    ]
    return render_section("Evidence by room", join(parts), "places")


def assign_places_to_rooms(map: TopometricMap, places: Places) -> Array:
    """Return (k,) room of a map in which each place is, -1 none."""
    floor, room = transform_floor(map, Placement.of(Sim3(), None))
    inside = room >= 0
    if not inside.any() or not len(places):
        return np.full(len(places), -1, np.int64)
    away, near = cKDTree(floor[inside]).query(places.crops.middle)
    out: Array = np.where(away <= REACH, room[inside][near], -1)
    return out


def compute_room_log_odds(places: Places, rooms: Array, count: int) -> Array:
    """Compute (count,) mean log odds of the places in each room; nan where nothing was compared."""
    odds = np.clip(places.log_odds, -MOST_ODDS, MOST_ODDS)
    inside = rooms >= 0
    total, weight = (np.bincount(rooms[inside], w[inside], count) for w in (odds * places.crops.area, places.crops.area))
    return np.where(weight > 0, total / np.maximum(weight, 1e-9), np.nan)


def compute_room_shades(odds: Array) -> Array:
    """Compute (R, 3) uint8 from red (against) over grey to green (for)."""
    share = np.nan_to_num(np.clip(odds / MOST_ODDS, -1, 1))[:, None]
    return np.where(share >= 0, SILENT + share * (FOR - SILENT), SILENT - share * (AGAINST - SILENT)).round().astype(np.uint8)


def _render_room(room: int, shown: Sequence[int], odds: Array, places: Places) -> Markup:
    """Render a room's places, folded."""
    name = render_room_link("a", room) if room >= 0 else Markup("outside rooms")
    text = f" {describe_log_odds(float(odds[room]))}, {len(shown)} shown" if room >= 0 else f" {len(shown)} shown"
    cards = [_render_card(k, places) for k in shown]
    return build_element(
        "details", build_element("summary", name, text), build_element("div", *cards, class_="cards"), data_room_of_a=room
    )


def _render_card(k: int, places: Places) -> Markup:
    images = [
        build_element(
            "img",
            src=encode_png_uri(draw_crop(places.crops.parts[k, m])),
            alt=f"map {name} from above",
            width="128",
            height="128",
        )
        for m, name in enumerate("ab")
    ]
    caption = f"{describe_log_odds(float(places.log_odds[k]))} · {places.crops.area[k]:.0f} m²"
    return build_element("figure", *images, build_element("figcaption", caption))


def describe_log_odds(odds: float) -> str:
    """Describe log odds in words."""
    if abs(odds) < 0.5:
        return "little evidence"
    times = np.exp(min(abs(odds), MOST_ODDS))
    return f"{times:.0f} times as likely {'the same place' if odds > 0 else 'another place'}"


def draw_crop(parts: Array) -> Array:
    """Draw (side, side, 3) uint8 picture of a square, north up."""
    image = np.full((*parts.shape, 3), UNKNOWN, np.uint8)
    for name, colour in PIXEL_COLOURS.items():
        image[(parts >> PARTS.index(name) & 1) > 0] = colour
    return flip_north_up(image)


def flip_north_up(image: Array) -> Array:
    """Return pixels (x, y, 3) as rows of a picture, the largest y first."""
    return np.ascontiguousarray(image.transpose(1, 0, 2)[::-1])


def encode_png_uri(image: Array) -> str:
    """Return a picture (h, w, 3) uint8 as a PNG in a data URI: the same picture gives the same bytes."""
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(image).save(file, "PNG")  # `optimize` takes five times as long for 5 % of the bytes
    return "data:image/png;base64," + base64.b64encode(file.getvalue()).decode("ascii")


FILES = ("merge.json", "report.html", "merged.ply", "map.tmap")
ALONE = (196, 196, 190)  # rooms without a partner
SEEN_OF_COLOURS = {0: "#9a9a9a", 1: "#4a90d9", 2: "#ef8a3c", 3: "#4fae74"}  # cells that were assumed, of a, of b, of both
HYPOTHESES = 6


def save_merge(result: MergeResult, folder: str | Path) -> None:
    """Write what `MergeResult.save` says. The same result gives the same bytes.

    Raises:
        InputError: the folder can't be made or written.
    """
    folder = Path(folder)
    is_new = not folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: can't be made ({error.strerror or error}); give another folder") from error
    writers: list[tuple[str, Callable[[Path], None]]] = [
        ("merge.json", lambda path: _write(format_json(serialise_merge(result)), path)),
        ("report.html", lambda path: _write(render_merge_html(result), path)),
    ]
    if result.map is not None:
        writers += [("merged.ply", partial(save_rooms_ply, result.map)), ("map.tmap", partial(save_map, result.map))]
        assign_room_colours(result.map)  # once: the page and the file beside it need the same
    try:
        with ExitStack() as stack, ThreadPoolExecutor(1) as pool:  # all are whole before the first is renamed
            places = [stack.enter_context(replace_on_success(folder / name)) for name, _ in writers]
            jobs = list(zip(writers, places, strict=True))
            background = [pool.submit(write, place) for (_, write), place in jobs[2:]]  # a third of it is compression
            for (_, write), place in jobs[:2]:
                write(place)
            for done in background:
                done.result()
            (folder / "merge.json").unlink(missing_ok=True)  # renamed last: a kill leaves no list of another run's files
    except BaseException:
        if is_new and not any(folder.iterdir()):
            folder.rmdir()
        raise
    for name in set(FILES) - {name for name, _ in writers}:  # of an earlier merge: they would belong to nothing here
        (folder / name).unlink(missing_ok=True)


def _write(text: str, path: Path) -> None:
    path.write_text(text, encoding="utf-8", errors="replace", newline="\n")


def render_merge_html(result: MergeResult) -> str:
    """Return the report as HTML. A result that is not believed shows its best hypothesis, and says so."""
    if result.atlas is not None:
        from topomerge.viz.atlas_report import render_atlas_html

        names = " + ".join(m.title for m in result.maps)
        joined = {} if result.map is None else {result.atlas.find_component(0): result.map}
        atlas = replace(result.atlas, warnings=result.warnings)
        return render_atlas_html(atlas, joined, names, _render_deformations(result))
    a, b = result.maps
    registration = result.registration
    pose = registration.transform if registration else None
    drawn = lay_out_pair(a, b, pose)
    within = None if result.map is None else _find_joined_rooms(result)
    sections = [_render_verdict(result), render_warnings(result.warnings), _render_maps(result, drawn, within)]
    data: dict[str, Any] = {}
    if pose is not None:
        sections.append(_render_overlay(result, drawn, pose))
    if result.map is not None and within is not None:
        sheet, plans = lay_out(result.map, turn=drawn[0][0].turn)
        view = build_element(
            "div", render_plan_view(result.map, sheet, plans), render_scroller(render_rooms_table(result.map)), class_="beside"
        )
        parts = join([view, *render_landmarks(result.map)])
        sections.append(render_section("The joined map", parts, "joined"))
        sections.append(_render_space(result))
        data = {"scene-data": _build_scene(result, sheet.turn), "mates": _collect_partners(result, within)}
    if registration is not None:
        sections.append(_render_evidence(result, registration))
        if registration.places is not None and len(registration.places):
            sections.append(render_places(a, drawn[0], registration.places))
    sections.append(_render_provenance(result))
    names = " + ".join(m.title for m in result.maps)
    return render_page(names, "Merge of two maps", sections, data)


def _render_deformations(result: MergeResult) -> list[Markup]:
    """Render, of many maps, a table of how each was bent."""
    where = result.placements if result.bends else {}
    names = [f"{k}: {Path(result.maps[k].source).name or 'map'}" for k in where]
    return (
        [
            render_section(
                "How the maps were bent", render_deformation_table(list(where.values()), names, [None] * len(where)), "bent"
            )
        ]
        if where
        else []
    )


def _render_verdict(result: MergeResult) -> Markup:
    head = "Merged" if result.merged else "Joined by force (not believed)" if result.transforms else "Not merged (not believed)"
    parts = result.reason.replace(" m2 ", " m² ").split(": ", 1)[-1].split("; ")
    items = build_element("ul", *(build_element("li", part) for part in parts))
    element = build_element("b", f"{head} · probability {format_probability(result.probability)}")
    block = build_element("div", element, items, class_="verdict" if result.merged else "verdict refused")
    return join([block, *_render_observations(result), _render_figures(result)])


def _render_observations(result: MergeResult) -> list[Markup]:
    """Render the observations that would settle the merge, where any would."""
    if not result.settle:
        return []
    names = [m.title for m in result.maps]
    items = [build_element("li", f"{o.describe(names)} ({100 * o.change:.0f} % expected change)") for o in result.settle]
    return [render_section("What would settle it", build_element("ol", *items), "settle")]


def _render_figures(result: MergeResult) -> Markup:
    """Render the figures that one wants first."""
    figures = [(str(len(m.rooms)), f"rooms of {name}") for name, m in zip("ab", result.maps, strict=True)]
    if result.map is not None:
        joined, pose = result.map, result.transforms[1]
        bits = np.bincount(_compute_observers(result), minlength=4) / max(len(joined.grid), 1)
        figures += [
            (str(len(result.matches)), "matched room pairs"),
            (f"{len(joined.rooms)}", "rooms of the joined map"),
            (f"{float(joined.rooms['area'].sum()):,.0f} m²".replace(",", "\u202f"), "floor area"),
            (f"{100 * bits[3]:.0f} %", "of the cells seen by both"),
            (f"{np.degrees(pose.yaw):.1f}°", "rotation of b"),
        ]
        if pose.scale != 1.0:
            figures.append((f"{pose.scale:.3f}", "scale of b"))
    items = [build_element("li", build_element("b", value), build_element("span", name)) for value, name in figures]
    return build_element("ul", *items, class_="summary")


def _render_maps(result: MergeResult, drawn: tuple[Drawn, Drawn], within: tuple[Array, Array] | None) -> Markup:
    """Render both plans side by side, rooms that are one in one colour, and the table of them.

    Args:
        within: of `_find_joined_rooms`; None where nothing is joined.
    """
    colours = (None, None) if within is None else _compute_colours(result, within)
    views = []
    for name, m, (sheet, plans), shades in zip("ab", result.maps, drawn, colours, strict=True):
        head = build_element("h3", f"{name}: {m.title} ", build_element("small", f"{len(m.rooms)} rooms"))
        views.append(build_element("div", head, render_plan_view(m, sheet, plans, shades)))
    parts: list[Markup] = []
    if result.map is not None:
        text = "Matched rooms share a colour; grey rooms are in one map only. Point at a room to highlight its match."
        parts.append(build_element("p", text, class_="note"))
    parts.append(build_element("div", *views, class_="pair"))
    if result.matches and within is not None:
        figure = build_element("div", render_lines(result.maps, drawn, result.matches, colours), class_="sheet")
        parts.append(build_element("div", build_element("h3", "Room matches"), figure, class_="more"))
        parts.append(
            build_element(
                "div", build_element("h3", "Matched rooms"), render_scroller(_render_matches(result, within[0])), class_="more"
            )
        )
    return render_section("The two maps", join(parts), "maps")


def _compute_colours(result: MergeResult, within: tuple[Array, Array]) -> tuple[Array, Array]:
    """Return (R, 3) uint8 of the rooms of both maps: matched ones have the colour of the joined map's room in which they lie."""
    assert result.map is not None
    palette = assign_room_colours(result.map)
    of_maps = []
    for k, (m, room) in enumerate(zip(result.maps, within, strict=True)):
        colour = np.tile(np.array(ALONE, np.uint8), (len(m.rooms), 1))
        matched = sorted({match.rooms[k] for match in result.matches})
        matched = [i for i in matched if room[i] >= 0]
        colour[matched] = palette[room[matched]]
        of_maps.append(colour)
    return of_maps[0], of_maps[1]


def _find_joined_rooms(result: MergeResult) -> tuple[Array, Array]:
    """Return, for each room of both maps, the room of the joined map in which it lies, -1 none."""
    assert result.map is not None
    a, b = result.maps
    bends = result.bends
    return find_joined_rooms(a, result.map, Sim3(), bends.get(0)), find_joined_rooms(
        b, result.map, result.transforms[1], bends.get(1)
    )


def _collect_partners(result: MergeResult, within: tuple[Array, Array]) -> dict[str, list[str]]:
    """Map each room, as the page calls it, to the rooms that are the same one; `within`: of `_find_joined_rooms`."""
    mates: dict[str, set[str]] = {}

    def tell(one: str, other: str) -> None:
        mates.setdefault(one, set()).add(other)
        mates.setdefault(other, set()).add(one)

    for match in result.matches:
        tell(f"a{match.rooms[0]}", f"b{match.rooms[1]}")
    for name, rooms in zip("ab", within, strict=True):
        for i, k in enumerate(rooms.tolist()):
            if k >= 0:
                tell(f"{name}{i}", str(k))
    return {room: sorted(others) for room, others in sorted(mates.items())}


def _render_matches(result: MergeResult, within: Array) -> Markup:
    """Render the table of matches; `within`: room of the joined map of each room of a."""
    a, b = result.maps
    columns = [(name, "number") for name in ("room of a", "area m²", "room of b", "area m²")]
    columns += [("probability", "text"), ("room of the joined map", "number")]
    rows = []
    for match in result.matches:
        i, j = match.rooms
        joined = render_room_link("", int(within[i])) if within[i] >= 0 else Markup("–")
        cells = [
            render_cell(render_room_link("a", i), i),
            render_cell(f"{a.rooms['area'][i]:.1f}", float(a.rooms["area"][i])),
            render_cell(render_room_link("b", j), j),
            render_cell(f"{b.rooms['area'][j]:.1f}", float(b.rooms["area"][j])),
            render_cell(render_share_bar(match.probability), match.probability, kind="text"),
            render_cell(joined, float(within[i])),
        ]
        rows.append(build_element("tr", *cells))
    return render_table(columns, rows, "Matched rooms")


def _render_overlay(result: MergeResult, drawn: tuple[Drawn, Drawn], pose: Sim3) -> Markup:
    a, b = result.maps
    text = "Map b over map a. Move the slider to fade from one to the other."
    if not result.merged:
        text = "The best pose found for map b; it is not believed. " + text
    parts = [build_element("p", text, class_="note"), render_blend_view(a, b, drawn, pose, result.bends)]
    if result.bends:
        where = list(build_placements({1: pose}, result.bends).values())
        parts.append(
            build_element(
                "div", build_element("h3", "How the maps were bent"), render_deformation_table(where, "ab", "ab"), class_="more"
            )
        )
    return render_section("Overlay", join(parts), "over")


def _compute_observers(result: MergeResult) -> Array:
    """Return (n,) 0 assumed, 1 seen by a only, 2 by b only, 3 by both; either may be joined of several maps already."""
    assert result.map is not None and result.map.provenance is not None
    before = result.maps[0].provenance
    count = 1 if before is None else max(int(np.bitwise_or.reduce(before, initial=0)).bit_length(), 1)
    bits = result.map.provenance.astype(np.int64)
    out: Array = ((bits & ((1 << count) - 1)) > 0) + 2 * ((bits >> count) > 0)
    return out.astype(np.int64)


def _build_scene(result: MergeResult, turn: float) -> dict[str, Any]:
    assert result.map is not None
    data = build_scene_data(result.map, turn=turn, seen=_compute_observers(result))
    data["colours"]["map"] = [SEEN_OF_COLOURS[group[2]] for group in data["groups"]]
    return data


def _render_space(result: MergeResult) -> Markup:
    share = np.bincount(_compute_observers(result), minlength=4)
    names = {1: "seen by a only", 2: "seen by b only", 3: "seen by both", 0: "assumed"}
    items = []
    for k, name in names.items():
        if share[k]:
            sign = build_element("i", style=f"background:{SEEN_OF_COLOURS[k]}")
            items.append(build_element("li", sign, f"{name}: {100 * share[k] / share.sum():.0f} %"))
    legend = build_element("ul", *items, class_="legend")
    element = build_element("p", "Colour by “map” shows which map saw each cell.", class_="note")
    return render_section("3D view", join([element, render_scene_view("scene-data"), legend]), "space")


def _render_evidence(result: MergeResult, registration: Registration) -> Markup:
    title = "Why it is believed" if result.merged else "Why it is not believed"
    rows = list_evidence(registration)
    if not rows:
        return render_section(title, build_element("p", result.reason), "why")
    parts = []
    if registration.posterior:
        text = "What the best pose may show, under the stated priors (docs/method.md)"
        parts.append(_render_text_table(("alternative", "probability"), list_posterior(registration), text))
    parts.append(_render_text_table(("evidence", "value", "meaning"), rows, "Evidence for the best hypothesis"))
    if len(registration.alternatives) > 1:
        best, middle = registration.alternatives[0], result.maps[1].grid.compute_centroids().mean(axis=0)
        others = [format_hypothesis(k, other, best, middle) for k, other in enumerate(registration.alternatives[:HYPOTHESES])]
        heads = ("pose", "rotation °", "distance to best m", "odds", "walls m²", "free floor m²", "walls on free floor")
        text = "Odds are relative to the best pose, each judged alone; 1 means equally good."
        more = [build_element("h3", "Other poses that were tried"), build_element("p", text, class_="note")]
        parts.append(build_element("div", *more, _render_text_table(heads, others, "Other poses"), class_="more"))
    return render_section(title, join(parts), "why")


def _render_text_table(heads: Sequence[str], rows: Iterable[Sequence[str]], caption: str) -> Markup:
    body = [build_element("tr", *(build_element("td", text, class_="text") for text in row)) for row in rows]
    head = build_element("thead", build_element("tr", *(build_element("th", name, class_="text", scope="col") for name in heads)))
    return build_element(
        "div", build_element("table", build_element("caption", caption), head, build_element("tbody", *body)), class_="scroller"
    )


def _render_provenance(result: MergeResult) -> Markup:
    seconds = {step: f"{s:.2f}" for step, s in result.seconds.items()}
    sources = {name: m.source or "–" for name, m in zip("ab", result.maps, strict=True)}
    matching = {"descriptor of rooms": result.descriptor or "–"}
    tables = [render_properties(sources, "Maps"), render_properties(matching, "Matching"), render_properties(seconds, "Seconds")]
    if result.transforms:
        matrix = result.file_transforms[1]
        rows = {f"row {k}": "  ".join(f"{v:.6g}" for v in row) for k, row in enumerate(matrix.tolist())}
        tables.append(render_properties(rows, "T_ab: points of b into the frame of a"))
    return render_section("How it was made", build_element("div", *tables, class_="facts-row"), "made")
