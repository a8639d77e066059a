"""The report of an atlas: which maps belong together and why, what was thrown out, and the joined maps."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.fusion.atlas.result import AtlasResult
from topomerge.fusion.atlas.store import tile_map, tiles
from topomerge.fusion.explanation import chance
from topomerge.types import Array, Sim3, TopometricMap
from topomerge.viz.markup import Markup, element, join
from topomerge.viz.report import page, plan_view, scene_view, scroller, section, warnings
from topomerge.viz.scene import scene_data
from topomerge.viz.sheet import lay_out
from topomerge.viz.tables import rooms_table

SEEN_BY_COLOURS = ("#9a9a9a", "#4a90d9", "#4fae74", "#d9a441")  # cells that were assumed, seen by one map, by two, by more
SEEN_BY_NAMES = ("assumed", "seen by one map", "seen by two maps", "seen by three or more")


def atlas_html(
    result: AtlasResult,
    joined: Mapping[int, TopometricMap],
    title: str = "Atlas",
    more: Sequence[Markup] = (),
    stamp: str = "",
    pages: Mapping[int, str] | None = None,
    component: int | None = None,
    tile: int | None = None,
) -> str:
    """The report as HTML, or the page of one component, or of one tile of it.

    Args:
        result: where the maps lie, and what contradicts.
        joined: component -> its joined map; of those that are left out there is no plan.
        title: what it is called.
        more: sections that stand behind the list of the maps.
        stamp: as of `report.page`.
        pages: component -> the file beside this one that shows its joined map: this one shows none then.
        component: the page of this one alone, which says nothing of the others, nor how long it took.
        tile: of it, as of `tiles.tiles`: the page of this tile alone.
    """
    if component is not None:
        return _component_html(result, component, joined[component], title, stamp, tile)
    sections = [_verdict(result, _counts(result) if pages else result.words().split("; ")), warnings(result.warnings)]
    data: dict[str, Any] = {}
    if pages:
        sections.append(_index(result, pages))
    for n, members in enumerate(result.components):
        if len(members) > 1 and n in joined and not pages:
            shown, scene = _joined(result, n, joined[n], not data)
            sections += shown
            data |= scene
    sections += [_maps(result, pages=pages), *more, _links(result)]
    return page(title, f"Atlas of {len(result.names)} maps", sections, data, stamp)


def _component_html(result: AtlasResult, n: int, map: TopometricMap, title: str, stamp: str, tile: int | None) -> str:
    """The page of one component: of one that is cut into tiles an overview, or the page of a tile."""
    name, stamped, parts = f"{title}, joined map {n}", f"stamp-{n}", tiles(map)
    kind = f"{len(result.components[n])} maps of an atlas"
    if tile is not None:
        back = element("p", element("a", name, href=page_file(n)), class_="note")
        sections, data = _tile(n, map, parts, tile)
        return page(f"{name}, tile {tile}", kind, [back, *sections], data, stamp, stamped)
    back = element("p", element("a", f"All of {title}", href="report.html"), class_="note")
    sections, data = _joined(result, n, map, len(parts) == 1)
    if len(parts) > 1:
        sections.append(_tiles_index(n, map, parts))
    sections = [back, *sections, _maps(result, [n]), _links(result, result.components[n])]
    return page(name, kind, sections, data, stamp, stamped)


def page_file(component: int, tile: int | None = None) -> str:
    """The file beside the report that shows a joined map, or a tile of it."""
    return f"map_{component}.html" if tile is None else f"map_{component}_tile_{tile}.html"


def _tile(n: int, map: TopometricMap, parts: Sequence[Array], tile: int) -> tuple[list[Markup], dict[str, Any]]:
    """A tile of a joined map: its sections, and what their scripts read. Rooms have the numbers of the whole map."""
    rooms, part = parts[tile], tile_map(map, parts[tile])
    sheet, plans = lay_out(part)
    view = element("div", plan_view(part, sheet, plans), scroller(rooms_table(part, only=rooms.tolist())), class_="beside")
    sections = [section(f"Tile {tile} of {len(parts)}", view, f"tile-{tile}")]
    home = {room: k for k, of in enumerate(parts) for room in of.tolist()}
    ways = [(a, b) if home[a] == tile else (b, a) for a, b in part.edges["rooms"].tolist()]
    beyond = sorted({(a, b) for a, b in ways if home[b] != tile})
    if beyond:
        rows = [(str(a), str(b), _linked(f"tile {home[b]}", page_file(n, home[b]))) for a, b in beyond]
        sections.append(section("Doors into other tiles", _texts(("from room", "to room", "in"), rows), "beyond"))
    return [*sections, _space(part)], {"scene-data": _scene(part, sheet.turn, rooms)}


def _tiles_index(n: int, map: TopometricMap, parts: Sequence[Array]) -> Markup:
    """The tiles of a joined map, which have pages of their own."""
    rows = []
    for k, rooms in enumerate(parts):
        storeys = np.unique(map.rooms["storey"][rooms]).tolist()
        area = f"{float(map.rooms['area'][rooms].sum()):.0f} m²"
        rows.append((_linked(f"tile {k}", page_file(n, k)), str(len(rooms)), area, ", ".join(str(s) for s in storeys)))
    words = element("p", "Each tile shows all of its cells in 3D.", class_="note")
    return section("Tiles", join([words, _texts(("page", "rooms", "floor area", "storeys"), rows)]), "tiles")


def _joined(result: AtlasResult, n: int, map: TopometricMap, in_space: bool) -> tuple[list[Markup], dict[str, Any]]:
    """The joined map of a component: its sections, and what their scripts read."""
    prefix = f"m{n}-" if n else ""
    sheet, plans = lay_out(map, prefix)
    view = element("div", plan_view(map, sheet, plans), scroller(rooms_table(map, prefix)), class_="beside")
    sections = [section(f"{_names(result, result.components[n])}: rooms extracted again", view, f"joined-{n}")]
    if not in_space:
        return sections, {}
    return [*sections, _space(map)], {"scene-data": _scene(map, sheet.turn)}


def _index(result: AtlasResult, pages: Mapping[int, str]) -> Markup:
    """The joined maps, which have pages of their own."""
    rows = [
        (_linked(f"joined map {n}", file), str(len(result.components[n])), chance(result.probability(n)), _names(result, members))
        for n, file in pages.items()
        for members in (result.components[n],)
    ]
    return section("The joined maps", _texts(("page", "maps", "weakest link", "names"), rows), "joined")


def _linked(words: str, file: str | None) -> str:
    """Words that lead to a file beside this one, if there is one."""
    return words if file is None else element("a", words, href=file)


def _verdict(result: AtlasResult, parts: Iterable[str]) -> Markup:
    head = {"merged": "All maps are connected", "parted": "Some maps are connected", "abstained": "No maps are connected"}
    words = [element("b", head[result.status]), element("ul", *(element("li", part) for part in parts))]
    return element("div", *words, class_="verdict" if result.status != "abstained" else "verdict refused")


def _counts(result: AtlasResult) -> list[str]:
    """What came out, where the names of all maps would fill a page."""
    joined = [members for members in result.components if len(members) > 1]
    counts = [f"{sum(map(len, joined))} of {len(result.names)} maps, in {len(joined)} joined maps"]
    counts += [f"stand apart: {len(result.alone)}"] if result.alone else []
    return counts + ([f"matches that were thrown out: {len(result.rejected)}"] if result.rejected else [])


def _names(result: AtlasResult, members: Iterable[int]) -> str:
    return " + ".join(Path(result.names[k]).name for k in members)


def _maps(result: AtlasResult, components: Sequence[int] | None = None, pages: Mapping[int, str] | None = None) -> Markup:
    """Where the maps lie, those of some components or all."""
    rows = []
    for n in range(len(result.components)) if components is None else components:
        members = result.components[n]
        for k in members:
            pose, off = result.transforms[k], result.residuals.get(k, float("nan"))
            moved = f"{np.degrees(pose.yaw):.1f}° · " + ", ".join(f"{v:.2f}" for v in pose.translation)
            scale = f" · scale {pose.scale:.3f}" if pose.scale != 1.0 else ""
            where = "apart" if len(members) == 1 else _linked(f"joined map {n}", (pages or {}).get(n))
            missed = f"{100 * off:.0f} cm" if np.isfinite(off) else "–"
            rows.append((str(k), result.names[k], where, "–" if pose == Sim3() else moved + scale, missed))
    heads = ("map", "name", "where", "rotation, x, y, z in m", "residual")
    return section("The maps", _texts(heads, rows), "maps")


def _links(result: AtlasResult, within: Sequence[int] | None = None) -> Markup:
    """What holds the maps together and what was thrown out; of some of them, or of all and how long it took."""
    parts: list[Markup] = []
    links, rejected = ([x for x in of if within is None or {*x.maps} & {*within}] for of in (result.links, result.rejected))
    if links:
        rows = [(*_pair(result, x.maps), chance(x.hypothesis.probability), chance(x.probability)) for x in links]
        words = "Each link is also checked by all other pairs of maps that it places over each other."
        parts += [element("p", words, class_="note"), _texts(("map", "map", "alone", "with all evidence"), rows)]
    if rejected:
        out = [
            (*_pair(result, x.maps), chance(x.hypothesis.probability), _names(result, x.against) if x.against else "other maps")
            for x in rejected
        ]
        parts += [element("h3", "Thrown out"), _texts(("map", "map", "alone", "contradicted by"), out)]
    differing = [c for c in result.contradictions if within is None or {*c.maps} & {*within}]
    if differing:
        words = "Walls of one map stand on free floor of the other. Both versions are kept, with their source."
        rooms = [tuple(", ".join(map(str, of)) or "none" for of in c.rooms) for c in differing]
        told: list[tuple[str, ...]] = [
            (*_pair(result, c.maps), *of, f"{c.area:.1f} m²") for c, of in zip(differing, rooms, strict=True)
        ]
        heads = ("map", "map", "rooms of the first", "rooms of the second", "walls")
        parts += [element("h3", "Contradictions"), element("p", words, class_="note"), _texts(heads, told)]
    tried = f"{result.registered[0]} of {result.registered[1]} pairs were registered, in {result.seconds:.1f} s."
    if within is None:
        parts.append(element("p", tried, class_="note"))
    return section("Links between the maps", join(parts), "links")


def _pair(result: AtlasResult, maps: tuple[int, int]) -> tuple[str, str]:
    return result.names[maps[0]], result.names[maps[1]]


def _texts(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> Markup:
    body = [element("tr", *(element("td", text, class_="text") for text in row)) for row in rows]
    head = element("thead", element("tr", *(element("th", name, class_="text", scope="col") for name in heads)))
    return element("div", element("table", head, element("tbody", *body)), class_="scroller")


def _seen(map: TopometricMap) -> Array:
    """(n,) how many maps saw each cell, 3 for more."""
    assert map.provenance is not None
    return np.minimum(np.bitwise_count(map.provenance), 3).astype(np.int64)


def _scene(map: TopometricMap, turn: float, only: Array | None = None) -> dict[str, Any]:
    data = scene_data(map, turn=turn, seen=_seen(map), only=only)
    data["colours"]["map"] = [SEEN_BY_COLOURS[group[2]] for group in data["groups"]]
    return data


def _space(map: TopometricMap) -> Markup:
    share = np.bincount(_seen(map), minlength=4) / max(len(map.grid), 1)
    items = [
        element("li", element("i", style=f"background:{SEEN_BY_COLOURS[k]}"), f"{SEEN_BY_NAMES[k]}: {100 * share[k]:.0f} %")
        for k in (1, 2, 3, 0)
        if share[k]
    ]
    words = element("p", "Colour by “map” shows how many maps saw each cell.", class_="note")
    legend = element("ul", *items, class_="legend")
    return section("3D view", join([words, scene_view("scene-data"), legend]), "space")
