"""The report of a merge: both maps, what they have in common, the joined map, and why it is believed or not."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.errors import InputError
from topomerge.fusion.explanation import chance, evidence_rows, hypothesis_row, posterior_rows
from topomerge.fusion.fuse import room_of_rooms
from topomerge.fusion.result import MergeResult, merge_to_json, placements
from topomerge.io.atomic import replacing
from topomerge.io.listing import json_text
from topomerge.io.maps import save_map
from topomerge.io.palette import room_colours
from topomerge.io.rooms_ply import save_rooms_ply
from topomerge.registration.pipeline import Registration
from topomerge.types import Array, Sim3
from topomerge.viz.atlas_report import atlas_html
from topomerge.viz.bend_plan import bend_table
from topomerge.viz.markup import Markup, element, join
from topomerge.viz.merge_lines import lines_view
from topomerge.viz.merge_plan import Drawn, blend_view, laid_alike
from topomerge.viz.places_view import places_section
from topomerge.viz.report import page, plan_view, scene_view, scroller, section, warnings
from topomerge.viz.scene import scene_data
from topomerge.viz.sheet import lay_out
from topomerge.viz.tables import cell, facts, room_link, rooms_table, share_bar, table

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
        ("merge.json", partial(_write, json_text(merge_to_json(result)))),
        ("report.html", partial(_write, merge_html(result))),
    ]
    if result.map is not None:
        writers += [("merged.ply", partial(save_rooms_ply, result.map)), ("map.tmap", partial(save_map, result.map))]
    try:
        with ExitStack() as stack:  # all are whole before the first is renamed
            for name, write in writers:
                write(stack.enter_context(replacing(folder / name)))
            (folder / "merge.json").unlink(missing_ok=True)  # renamed last: a kill leaves no list of another run's files
    except BaseException:
        if is_new and not any(folder.iterdir()):
            folder.rmdir()
        raise
    for name in set(FILES) - {name for name, _ in writers}:  # of an earlier merge: they would belong to nothing here
        (folder / name).unlink(missing_ok=True)


def _write(text: str, path: Path) -> None:
    path.write_text(text, encoding="utf-8", errors="replace", newline="\n")


def merge_html(result: MergeResult) -> str:
    """The report as HTML. A result that is not believed shows its best hypothesis, and says so."""
    if result.atlas is not None:
        names = " + ".join(m.title for m in result.maps)
        joined = {} if result.map is None else {result.atlas.component_of(0): result.map}
        return atlas_html(result.atlas, joined, names, _bends(result))
    a, b = result.maps
    registration = result.registration
    pose = registration.transform if registration else None
    drawn = laid_alike(a, b, pose)
    sections = [_verdict(result), warnings(result.warnings), _maps(result, drawn)]
    data: dict[str, Any] = {}
    if pose is not None:
        sections.append(_over(result, drawn, pose))
    if result.map is not None:
        sheet, plans = lay_out(result.map, turn=drawn[0][0].turn)
        view = element("div", plan_view(result.map, sheet, plans), scroller(rooms_table(result.map)), class_="beside")
        sections.append(section("The joined map, rooms extracted again", view, "joined"))
        sections.append(_space(result))
        data = {"scene-data": _scene(result, sheet.turn), "mates": _mates(result)}
    if registration is not None:
        sections.append(_evidence(result, registration))
        if registration.places is not None and len(registration.places):
            sections.append(places_section(a, drawn[0], registration.places))
    sections.append(_made(result))
    names = " + ".join(m.title for m in result.maps)
    return page(names, "Merge of two maps", sections, data)


def _bends(result: MergeResult) -> list[Markup]:
    """Of many maps: a table of how each was bent."""
    where = result.placements if result.bends else {}
    names = [f"{k}: {Path(result.maps[k].source).name or 'map'}" for k in where]
    return (
        [section("How the maps were bent", bend_table(list(where.values()), names, [None] * len(where)), "bent")] if where else []
    )


def _verdict(result: MergeResult) -> Markup:
    head = "Merged" if result.merged else "Joined by force (not believed)" if result.transforms else "Not merged (not believed)"
    parts = result.reason.replace(" m2 ", " m² ").split(": ", 1)[-1].split("; ")
    items = element("ul", *(element("li", part) for part in parts))
    words = element("b", f"{head} · probability {chance(result.probability)}")
    return join([element("div", words, items, class_="verdict" if result.merged else "verdict refused"), _figures(result)])


def _figures(result: MergeResult) -> Markup:
    """The figures that one wants first."""
    figures = [(str(len(m.rooms)), f"rooms of {name}") for name, m in zip("ab", result.maps, strict=True)]
    if result.map is not None:
        joined, pose = result.map, result.transforms[1]
        bits = np.bincount(_seen(result), minlength=4) / max(len(joined.grid), 1)
        figures += [
            (str(len(result.matches)), "matched room pairs"),
            (f"{len(joined.rooms)}", "rooms of the joined map"),
            (f"{float(joined.rooms['area'].sum()):,.0f} m²".replace(",", "\u202f"), "floor area"),
            (f"{100 * bits[3]:.0f} %", "of the cells seen by both"),
            (f"{np.degrees(pose.yaw):.1f}°", "rotation of b"),
        ]
        if pose.scale != 1.0:
            figures.append((f"{pose.scale:.3f}", "scale of b"))
    items = [element("li", element("b", value), element("span", name)) for value, name in figures]
    return element("ul", *items, class_="summary")


def _maps(result: MergeResult, drawn: tuple[Drawn, Drawn]) -> Markup:
    """Both plans side by side, rooms that are one in one colour, and the table of them."""
    colours = _colours(result) if result.map is not None else (None, None)
    views = []
    for name, m, (sheet, plans), shades in zip("ab", result.maps, drawn, colours, strict=True):
        head = element("h3", f"{name}: {m.title} ", element("small", f"{len(m.rooms)} rooms"))
        views.append(element("div", head, plan_view(m, sheet, plans, shades)))
    parts: list[Markup] = []
    if result.map is not None:
        words = "Matched rooms share a colour; grey rooms are in one map only. Point at a room to highlight its match."
        parts.append(element("p", words, class_="note"))
    parts.append(element("div", *views, class_="pair"))
    if result.matches:
        figure = element("div", lines_view(result.maps, drawn, result.matches, colours), class_="sheet")
        parts.append(element("div", element("h3", "Room matches"), figure, class_="more"))
        parts.append(element("div", element("h3", "Matched rooms"), scroller(_matches(result)), class_="more"))
    return section("The two maps", join(parts), "maps")


def _colours(result: MergeResult) -> tuple[Array, Array]:
    """(R, 3) uint8 of the rooms of both maps: matched ones have the colour of the joined map's room in which they lie."""
    assert result.map is not None
    palette = room_colours(result.map)
    of_maps = []
    for k, (m, within) in enumerate(zip(result.maps, _within(result), strict=True)):
        colour = np.tile(np.array(ALONE, np.uint8), (len(m.rooms), 1))
        matched = sorted({match.rooms[k] for match in result.matches})
        matched = [i for i in matched if within[i] >= 0]
        colour[matched] = palette[within[matched]]
        of_maps.append(colour)
    return of_maps[0], of_maps[1]


def _within(result: MergeResult) -> tuple[Array, Array]:
    """For each room of both maps the room of the joined map in which it lies, -1 none."""
    assert result.map is not None
    a, b = result.maps
    bends = result.bends
    return room_of_rooms(a, result.map, Sim3(), bends.get(0)), room_of_rooms(b, result.map, result.transforms[1], bends.get(1))


def _mates(result: MergeResult) -> dict[str, list[str]]:
    """Room as the page calls it -> rooms that are the same one."""
    mates: dict[str, set[str]] = {}

    def tell(one: str, other: str) -> None:
        mates.setdefault(one, set()).add(other)
        mates.setdefault(other, set()).add(one)

    for match in result.matches:
        tell(f"a{match.rooms[0]}", f"b{match.rooms[1]}")
    for name, within in zip("ab", _within(result), strict=True):
        for i, k in enumerate(within.tolist()):
            if k >= 0:
                tell(f"{name}{i}", str(k))
    return {room: sorted(others) for room, others in sorted(mates.items())}


def _matches(result: MergeResult) -> Markup:
    a, b = result.maps
    columns = [(name, "number") for name in ("room of a", "area m²", "room of b", "area m²")]
    columns += [("probability", "text"), ("room of the joined map", "number")]
    within = _within(result)[0]
    rows = []
    for match in result.matches:
        i, j = match.rooms
        joined = room_link("", int(within[i])) if within[i] >= 0 else Markup("–")
        cells = [
            cell(room_link("a", i), i),
            cell(f"{a.rooms['area'][i]:.1f}", float(a.rooms["area"][i])),
            cell(room_link("b", j), j),
            cell(f"{b.rooms['area'][j]:.1f}", float(b.rooms["area"][j])),
            cell(share_bar(match.probability), match.probability, kind="text"),
            cell(joined, float(within[i])),
        ]
        rows.append(element("tr", *cells))
    return table(columns, rows, "Matched rooms")


def _over(result: MergeResult, drawn: tuple[Drawn, Drawn], pose: Sim3) -> Markup:
    a, b = result.maps
    words = "Map b over map a. Move the slider to fade from one to the other."
    if not result.merged:
        words = "The best pose found for map b; it is not believed. " + words
    parts = [element("p", words, class_="note"), blend_view(a, b, drawn, pose, result.bends)]
    if result.bends:
        where = list(placements({1: pose}, result.bends).values())
        parts.append(element("div", element("h3", "How the maps were bent"), bend_table(where, "ab", "ab"), class_="more"))
    return section("Overlay", join(parts), "over")


def _seen(result: MergeResult) -> Array:
    """(n,) 0 assumed, 1 seen by a only, 2 by b only, 3 by both; either may be joined of several maps already."""
    assert result.map is not None and result.map.provenance is not None
    before = result.maps[0].provenance
    count = 1 if before is None else max(int(np.bitwise_or.reduce(before, initial=0)).bit_length(), 1)
    bits = result.map.provenance.astype(np.int64)
    out: Array = ((bits & ((1 << count) - 1)) > 0) + 2 * ((bits >> count) > 0)
    return out.astype(np.int64)


def _scene(result: MergeResult, turn: float) -> dict[str, Any]:
    assert result.map is not None
    data = scene_data(result.map, turn=turn, seen=_seen(result))
    data["colours"]["map"] = [SEEN_OF_COLOURS[group[2]] for group in data["groups"]]
    return data


def _space(result: MergeResult) -> Markup:
    share = np.bincount(_seen(result), minlength=4)
    names = {1: "seen by a only", 2: "seen by b only", 3: "seen by both", 0: "assumed"}
    items = []
    for k, name in names.items():
        if share[k]:
            sign = element("i", style=f"background:{SEEN_OF_COLOURS[k]}")
            items.append(element("li", sign, f"{name}: {100 * share[k] / share.sum():.0f} %"))
    legend = element("ul", *items, class_="legend")
    words = element("p", "Colour by “map” shows which map saw each cell.", class_="note")
    return section("3D view", join([words, scene_view("scene-data"), legend]), "space")


def _evidence(result: MergeResult, registration: Registration) -> Markup:
    title = "Why it is believed" if result.merged else "Why it is not believed"
    rows = evidence_rows(registration)
    if not rows:
        return section(title, element("p", result.reason), "why")
    parts = []
    if registration.posterior:
        words = "What the best pose may show, under the stated priors (docs/method.md)"
        parts.append(_texts(("alternative", "probability"), posterior_rows(registration), words))
    parts.append(_texts(("evidence", "value", "meaning"), rows, "Evidence for the best hypothesis"))
    if len(registration.alternatives) > 1:
        best, middle = registration.alternatives[0], result.maps[1].grid.centroids().mean(axis=0)
        others = [hypothesis_row(k, other, best, middle) for k, other in enumerate(registration.alternatives[:HYPOTHESES])]
        heads = ("pose", "rotation °", "distance to best m", "odds", "walls m²", "free floor m²", "walls on free floor")
        words = "Odds are relative to the best pose, each judged alone; 1 means equally good."
        more = [element("h3", "Other poses that were tried"), element("p", words, class_="note")]
        parts.append(element("div", *more, _texts(heads, others, "Other poses"), class_="more"))
    return section(title, join(parts), "why")


def _texts(heads: Sequence[str], rows: Iterable[Sequence[str]], caption: str) -> Markup:
    body = [element("tr", *(element("td", text, class_="text") for text in row)) for row in rows]
    head = element("thead", element("tr", *(element("th", name, class_="text", scope="col") for name in heads)))
    return element("div", element("table", element("caption", caption), head, element("tbody", *body)), class_="scroller")


def _made(result: MergeResult) -> Markup:
    seconds = {step: f"{s:.2f}" for step, s in result.seconds.items()}
    sources = {name: m.source or "–" for name, m in zip("ab", result.maps, strict=True)}
    matching = {"descriptor of rooms": result.descriptor or "–"}
    tables = [facts(sources, "Maps"), facts(matching, "Matching"), facts(seconds, "Seconds")]
    if result.transforms:
        matrix = result.file_transforms[1]
        rows = {f"row {k}": "  ".join(f"{v:.6g}" for v in row) for k, row in enumerate(matrix.tolist())}
        tables.append(facts(rows, "T_ab: points of b into the frame of a"))
    return section("How it was made", element("div", *tables, class_="facts-row"), "made")
