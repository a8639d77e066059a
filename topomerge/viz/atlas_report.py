"""The report of an atlas: which maps belong together and why, what was thrown out, and the joined maps."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.fusion.atlas.result import AtlasResult
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
) -> str:
    """The report as HTML.

    Args:
        result: where the maps lie, and what contradicts.
        joined: component -> its joined map; of those that are left out there is no plan.
        title: what it is called.
        more: sections that stand behind the list of the maps.
        stamp: as of `report.page`.
    """
    sections = [_verdict(result), warnings(result.warnings)]
    data: dict[str, Any] = {}
    for n, members in enumerate(result.components):
        if len(members) > 1 and n in joined:
            sheet, plans = lay_out(joined[n], f"m{n}-" if n else "")
            table = scroller(rooms_table(joined[n], f"m{n}-" if n else ""))
            view = element("div", plan_view(joined[n], sheet, plans), table, class_="beside")
            sections.append(section(f"{_names(result, members)}: rooms found anew", view, f"joined-{n}"))
            if not data:
                data["scene-data"] = _scene(joined[n], sheet.turn)
                sections.append(_space(joined[n]))
    sections += [_maps(result), *more, _links(result)]
    return page(title, f"Atlas of {len(result.names)} maps", sections, data, stamp)


def _verdict(result: AtlasResult) -> Markup:
    head = {"merged": "All maps belong together", "parted": "Some maps belong together", "abstained": "Nothing is believed"}
    parts = result.words().split("; ")
    words = [element("b", head[result.status]), element("ul", *(element("li", part) for part in parts))]
    return element("div", *words, class_="verdict" if result.status != "abstained" else "verdict refused")


def _names(result: AtlasResult, members: Iterable[int]) -> str:
    return " + ".join(Path(result.names[k]).name for k in members)


def _maps(result: AtlasResult) -> Markup:
    rows = []
    for n, members in enumerate(result.components):
        for k in members:
            pose, off = result.transforms[k], result.residuals.get(k, float("nan"))
            moved = f"{np.degrees(pose.yaw):.1f}° · " + ", ".join(f"{v:.2f}" for v in pose.translation)
            scale = f" · scale {pose.scale:.3f}" if pose.scale != 1.0 else ""
            where = "apart" if len(members) == 1 else f"joined map {n}"
            missed = f"{100 * off:.0f} cm" if np.isfinite(off) else "–"
            rows.append((str(k), result.names[k], where, "–" if pose == Sim3() else moved + scale, missed))
    heads = ("map", "name", "where", "turn, x, y, z in m", "measurements miss it by")
    return section("The maps", _texts(heads, rows), "maps")


def _links(result: AtlasResult) -> Markup:
    parts: list[Markup] = []
    if result.links:
        rows = [(*_pair(result, x.maps), chance(x.hypothesis.probability), chance(x.probability)) for x in result.links]
        words = "Every other two maps that a link brings over each other say what they think of it."
        parts += [element("p", words, class_="note"), _texts(("map", "map", "by itself", "with all that is said"), rows)]
    if result.rejected:
        out = [
            (*_pair(result, x.maps), chance(x.hypothesis.probability), _names(result, x.against) if x.against else "other maps")
            for x in result.rejected
        ]
        parts += [element("h3", "Thrown out"), _texts(("map", "map", "by itself", "contradicted by"), out)]
    tried = f"{result.registered[0]} of {result.registered[1]} pairs were searched in each other, in {result.seconds:.1f} s."
    return section("Links between the maps", join([*parts, element("p", tried, class_="note")]), "links")


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


def _scene(map: TopometricMap, turn: float) -> dict[str, Any]:
    data = scene_data(map, turn=turn, seen=_seen(map))
    data["colours"]["map"] = [SEEN_BY_COLOURS[group[2]] for group in data["groups"]]
    return data


def _space(map: TopometricMap) -> Markup:
    share = np.bincount(_seen(map), minlength=4) / max(len(map.grid), 1)
    items = [
        element("li", element("i", style=f"background:{SEEN_BY_COLOURS[k]}"), f"{SEEN_BY_NAMES[k]}: {100 * share[k]:.0f} %")
        for k in (1, 2, 3, 0)
        if share[k]
    ]
    words = element("p", "Colour by “map” shows how many maps saw what.", class_="note")
    legend = element("ul", *items, class_="legend")
    return section("In three dimensions", join([words, scene_view("scene-data"), legend]), "space")
