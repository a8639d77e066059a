"""The report of an atlas: which maps belong together and why, what was thrown out, and the joined maps."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.fusion.atlas.result import AtlasResult
from topomerge.fusion.atlas.store import select_tile, split_into_tiles
from topomerge.fusion.pipeline import format_probability
from topomerge.types import Array, Sim3, TopometricMap
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
from topomerge.viz.tables import Markup, build_element, join, render_landmarks, render_rooms_table

SEEN_BY_COLOURS = ("#9a9a9a", "#4a90d9", "#4fae74", "#d9a441")  # cells that were assumed, seen by one map, by two, by more
SEEN_BY_NAMES = ("assumed", "seen by one map", "seen by two maps", "seen by three or more")


def render_atlas_html(
    result: AtlasResult,
    joined: Mapping[int, TopometricMap],
    title: str = "Atlas",
    more: Sequence[Markup] = (),
    stamp: str = "",
    pages: Mapping[int, str] | None = None,
    component: int | None = None,
    tile: int | None = None,
) -> str:
    """Render the report as HTML, or the page of one component, or of one tile of it.

    Args:
        result: where the maps lie, and what contradicts.
        joined: component -> its joined map; of those that are left out there is no plan.
        title: what it is called.
        more: sections that stand behind the list of the maps.
        stamp: as of `report.render_page`.
        pages: component -> the file beside this one that shows its joined map: this one shows none then.
        component: the page of this one alone, which says nothing of the others, nor how long it took.
        tile: of it, as of `tiles.tiles`: the page of this tile alone.
    """
    if component is not None:
        return _render_component_html(result, component, joined[component], title, stamp, tile)
    sections = [
        _render_verdict(result, _format_counts(result) if pages else result.format_summary().split("; ")),
        render_warnings(result.warnings),
    ]
    data: dict[str, Any] = {}
    if pages:
        sections.append(_render_index(result, pages))
    for n, members in enumerate(result.components):
        if len(members) > 1 and n in joined and not pages:
            shown, scene = _render_joined_map(result, n, joined[n], not data)
            sections += shown
            data |= scene
    sections += [_render_maps(result, pages=pages), *more, _render_links(result)]
    return render_page(title, f"Atlas of {len(result.names)} maps", sections, data, stamp)


def _render_component_html(result: AtlasResult, n: int, map: TopometricMap, title: str, stamp: str, tile: int | None) -> str:
    """Render the page of one component: of one that is cut into tiles an overview, or the page of a tile."""
    name, stamped, parts = f"{title}, joined map {n}", f"stamp-{n}", split_into_tiles(map)
    kind = f"{len(result.components[n])} maps of an atlas"
    if tile is not None:
        back = build_element("p", build_element("a", name, href=get_page_name(n)), class_="note")
        sections, data = _render_tile(n, map, parts, tile)
        return render_page(f"{name}, tile {tile}", kind, [back, *sections], data, stamp, stamped)
    back = build_element("p", build_element("a", f"All of {title}", href="report.html"), class_="note")
    sections, data = _render_joined_map(result, n, map, len(parts) == 1)
    if len(parts) > 1:
        sections.append(_render_tiles_index(n, map, parts))
    sections = [back, *sections, _render_maps(result, [n]), _render_links(result, result.components[n])]
    return render_page(name, kind, sections, data, stamp, stamped)


def get_page_name(component: int, tile: int | None = None) -> str:
    """Return the file beside the report that shows a joined map, or a tile of it."""
    return f"map_{component}.html" if tile is None else f"map_{component}_tile_{tile}.html"


def _render_tile(n: int, map: TopometricMap, parts: Sequence[Array], tile: int) -> tuple[list[Markup], dict[str, Any]]:
    """Render a tile of a joined map: its sections, and what their scripts read. Rooms have the numbers of the whole map."""
    rooms, part = parts[tile], select_tile(map, parts[tile])
    sheet, plans = lay_out(part)
    view = build_element(
        "div",
        render_plan_view(part, sheet, plans),
        render_scroller(render_rooms_table(part, only=rooms.tolist())),
        class_="beside",
    )
    sections = [render_section(f"Tile {tile} of {len(parts)}", view, f"tile-{tile}")]
    home = {room: k for k, of in enumerate(parts) for room in of.tolist()}
    connections = [(a, b) if home[a] == tile else (b, a) for a, b in part.edges["rooms"].tolist()]
    beyond = sorted({(a, b) for a, b in connections if home[b] != tile})
    if beyond:
        rows = [(str(a), str(b), _render_link(f"tile {home[b]}", get_page_name(n, home[b]))) for a, b in beyond]
        sections.append(
            render_section("Doors into other tiles", _render_text_table(("from room", "to room", "in"), rows), "beyond")
        )
    return [*sections, _render_space(part)], {"scene-data": _build_scene(part, sheet.turn, rooms)}


def _render_tiles_index(n: int, map: TopometricMap, parts: Sequence[Array]) -> Markup:
    """Render the tiles of a joined map, which have pages of their own."""
    rows = []
    for k, rooms in enumerate(parts):
        storeys = np.unique(map.rooms["storey"][rooms]).tolist()
        area = f"{float(map.rooms['area'][rooms].sum()):.0f} m²"
        rows.append((_render_link(f"tile {k}", get_page_name(n, k)), str(len(rooms)), area, ", ".join(str(s) for s in storeys)))
    element = build_element("p", "Each tile shows all of its cells in 3D.", class_="note")
    return render_section("Tiles", join([element, _render_text_table(("page", "rooms", "floor area", "storeys"), rows)]), "tiles")


def _render_joined_map(result: AtlasResult, n: int, map: TopometricMap, in_space: bool) -> tuple[list[Markup], dict[str, Any]]:
    """Render the joined map of a component: its sections, and what their scripts read."""
    prefix = f"m{n}-" if n else ""
    sheet, plans = lay_out(map, prefix)
    view = build_element(
        "div", render_plan_view(map, sheet, plans), render_scroller(render_rooms_table(map, prefix)), class_="beside"
    )
    parts = join([view, *render_landmarks(map, prefix)])
    sections = [render_section(f"{_format_names(result, result.components[n])}: rooms", parts, f"joined-{n}")]
    if not in_space:
        return sections, {}
    return [*sections, _render_space(map)], {"scene-data": _build_scene(map, sheet.turn)}


def _render_index(result: AtlasResult, pages: Mapping[int, str]) -> Markup:
    """Render the index of the joined maps, which have pages of their own."""
    rows = [
        (
            _render_link(f"joined map {n}", file),
            str(len(result.components[n])),
            format_probability(result.get_probability(n)),
            _format_names(result, members),
        )
        for n, file in pages.items()
        for members in (result.components[n],)
    ]
    return render_section("The joined maps", _render_text_table(("page", "maps", "weakest link", "names"), rows), "joined")


def _render_link(text: str, file: str | None) -> str:
    """Render words that lead to a file beside this one, if there is one."""
    return text if file is None else build_element("a", text, href=file)


def _render_verdict(result: AtlasResult, parts: Iterable[str]) -> Markup:
    head = {"merged": "All maps are connected", "parted": "Some maps are connected", "abstained": "No maps are connected"}
    element = [build_element("b", head[result.status]), build_element("ul", *(build_element("li", part) for part in parts))]
    return build_element("div", *element, class_="verdict" if result.status != "abstained" else "verdict refused")


def _format_counts(result: AtlasResult) -> list[str]:
    """Format the counts of the result, where the names of all maps would fill a page."""
    joined = [members for members in result.components if len(members) > 1]
    counts = [f"{sum(map(len, joined))} of {len(result.names)} maps, in {len(joined)} joined maps"]
    counts += [f"stand apart: {len(result.alone)}"] if result.alone else []
    return counts + ([f"matches that were thrown out: {len(result.rejected)}"] if result.rejected else [])


def _format_names(result: AtlasResult, members: Iterable[int]) -> str:
    return " + ".join(Path(result.names[k]).name for k in members)


def _render_maps(result: AtlasResult, components: Sequence[int] | None = None, pages: Mapping[int, str] | None = None) -> Markup:
    """Render where the maps lie, those of some components or all."""
    rows = []
    for n in range(len(result.components)) if components is None else components:
        members = result.components[n]
        for k in members:
            pose, off = result.transforms[k], result.residuals.get(k, float("nan"))
            moved = f"{np.degrees(pose.yaw):.1f}° · " + ", ".join(f"{v:.2f}" for v in pose.translation)
            scale = f" · scale {pose.scale:.3f}" if pose.scale != 1.0 else ""
            where = "apart" if len(members) == 1 else _render_link(f"joined map {n}", (pages or {}).get(n))
            missed = f"{100 * off:.0f} cm" if np.isfinite(off) else "–"
            rows.append((str(k), result.names[k], where, "–" if pose == Sim3() else moved + scale, missed))
    heads = ("map", "name", "where", "rotation, x, y, z in m", "residual")
    return render_section("The maps", _render_text_table(heads, rows), "maps")


def _render_links(result: AtlasResult, within: Sequence[int] | None = None) -> Markup:
    """Render the links that hold the maps together and those thrown out; of some maps, or of all with the time it took."""
    parts: list[Markup] = []
    links, rejected = ([x for x in of if within is None or {*x.maps} & {*within}] for of in (result.links, result.rejected))
    if links:
        rows = [
            (*_get_pair_names(result, x.maps), format_probability(x.hypothesis.probability), format_probability(x.probability))
            for x in links
        ]
        text = "Each link is also checked by all other pairs of maps that it places over each other."
        parts += [
            build_element("p", text, class_="note"),
            _render_text_table(("map", "map", "alone", "with all evidence"), rows),
        ]
    if rejected:
        out = [
            (
                *_get_pair_names(result, x.maps),
                format_probability(x.hypothesis.probability),
                _format_names(result, x.against) if x.against else "other maps",
            )
            for x in rejected
        ]
        parts += [build_element("h3", "Thrown out"), _render_text_table(("map", "map", "alone", "contradicted by"), out)]
    differing = [c for c in result.contradictions if within is None or {*c.maps} & {*within}]
    if differing:
        text = "Walls of one map stand on free floor of the other. Both versions are kept, with their source."
        rooms = [tuple(", ".join(map(str, of)) or "none" for of in c.rooms) for c in differing]
        entries: list[tuple[str, ...]] = [
            (*_get_pair_names(result, c.maps), *of, f"{c.area:.1f} m²") for c, of in zip(differing, rooms, strict=True)
        ]
        heads = ("map", "map", "rooms of the first", "rooms of the second", "walls")
        parts += [
            build_element("h3", "Contradictions"),
            build_element("p", text, class_="note"),
            _render_text_table(heads, entries),
        ]
    tried = f"{result.registered[0]} of {result.registered[1]} pairs were registered, in {result.seconds:.1f} s."
    if within is None:
        parts.append(build_element("p", tried, class_="note"))
    return render_section("Links between the maps", join(parts), "links")


def _get_pair_names(result: AtlasResult, maps: tuple[int, int]) -> tuple[str, str]:
    return result.names[maps[0]], result.names[maps[1]]


def _render_text_table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> Markup:
    body = [build_element("tr", *(build_element("td", text, class_="text") for text in row)) for row in rows]
    head = build_element("thead", build_element("tr", *(build_element("th", name, class_="text", scope="col") for name in heads)))
    return build_element("div", build_element("table", head, build_element("tbody", *body)), class_="scroller")


def _count_observers(map: TopometricMap) -> Array:
    """Return (n,) how many maps saw each cell, 3 for more."""
    assert map.provenance is not None
    return np.minimum(np.bitwise_count(map.provenance), 3).astype(np.int64)


def _build_scene(map: TopometricMap, turn: float, only: Array | None = None) -> dict[str, Any]:
    data = build_scene_data(map, turn=turn, seen=_count_observers(map), only=only)
    data["colours"]["map"] = [SEEN_BY_COLOURS[group[2]] for group in data["groups"]]
    return data


def _render_space(map: TopometricMap) -> Markup:
    share = np.bincount(_count_observers(map), minlength=4) / max(len(map.grid), 1)
    items = [
        build_element(
            "li", build_element("i", style=f"background:{SEEN_BY_COLOURS[k]}"), f"{SEEN_BY_NAMES[k]}: {100 * share[k]:.0f} %"
        )
        for k in (1, 2, 3, 0)
        if share[k]
    ]
    element = build_element("p", "Colour by “map” shows how many maps saw each cell.", class_="note")
    legend = build_element("ul", *items, class_="legend")
    return render_section("3D view", join([element, render_scene_view("scene-data"), legend]), "space")
