"""A report of a map: one HTML file with everything in it, which needs no network.

The Python side writes plans (SVG) and tables that can be read and printed as they are; the scripts in `template/` add
what moves: zoom, highlights, sorting and the 3D view. A page runs only the script whose hash it names, so that a name in
a file could not bring its own.
"""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from topomerge import __version__
from topomerge.fusion.result import BEND_PARAMETER
from topomerge.io.atomic import replacing
from topomerge.types import Array, TopometricMap
from topomerge.viz.markup import Markup, element, join, json_data
from topomerge.viz.plan import StoreyPlan
from topomerge.viz.scene import scene_data
from topomerge.viz.sheet import Sheet, lay_out
from topomerge.viz.svg import plan_svgs
from topomerge.viz.tables import doors_table, facts, rooms_table, seconds_table, storeys_table

SCRIPTS = ("plan.js", "tables.js", "camera.js", "cells.js", "scene.js", "merge.js", "places.js", "stamp.js", "page.js")
BESIDE = " 'self' file:"  # what a page that looks for a newer one may read: a style sheet that lies beside it, never a script


def save_report(map: TopometricMap, path: str | Path) -> None:
    """Write the report of one map. The same map gives the same bytes.

    Raises:
        InputError: the path can't be written.
    """
    text = report_html(map)
    with replacing(path) as beside:
        beside.write_text(text, encoding="utf-8", errors="replace", newline="\n")


def report_html(map: TopometricMap) -> str:
    """The report of one map as HTML: plans and rooms, 3D, doors, and what it was made with."""
    title = map.title
    sheet, plans = lay_out(map)
    rooms = element("div", plan_view(map, sheet, plans), scroller(rooms_table(map)), class_="beside")
    origin = element("div", storeys_table(map), seconds_table(map), parameters(map), class_="facts-row")
    sections = [
        summary(map),
        warnings(map.warnings),
        section("Plan and rooms", rooms, "plan"),
        section("3D view", scene_view("scene-data"), "space"),
        section("Doors and stairs", scroller(doors_table(map)), "doors"),
        section("How it was made", origin, "made"),
    ]
    return page(title, "Topometric map", sections, {"scene-data": scene_data(map, turn=sheet.turn)})


def page(
    title: str, kind: str, sections: Sequence[Markup], data: Mapping[str, Any], stamp: str = "", stamped: str = "stamp"
) -> str:
    """A whole page from the template.

    Args:
        title: what it is about; escaped.
        kind: what kind of report it is; escaped.
        sections: its content.
        data: id -> a JSON value that the scripts read, as `scene_data`.
        stamp: of the page; an open one loads itself anew when `report_stamp.css` beside it holds another one. Empty: never.
        stamped: the name under which that file holds it.
    """
    script = "".join(_template(name) for name in SCRIPTS)
    mark = [element("i", id="stamp", data_stamp=stamp, data_name=stamped, hidden=True)] if stamp else []
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii")
    parts = {
        "title": element("title", f"{title} – {kind}"),
        "heading": join([element("p", kind, class_="kind"), element("h1", title)]),
        "style": element("style", Markup(_template("report.css"))),
        "hash": Markup(digest),
        "styles": Markup(BESIDE if stamp else ""),
        "content": join([*sections, *mark]),
        "data": join(json_data(value, id) for id, value in data.items()),
        "script": element("script", Markup(script)),
        "version": Markup(__version__),
    }
    # In one pass: what is put in is not searched again.
    return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], _template("report.html"))


def _template(name: str) -> str:
    return (files("topomerge.viz") / "template" / name).read_text(encoding="utf-8")


def section(title: str, content: str, id: str) -> Markup:
    """A part of the page under a heading."""
    return element("section", element("h2", title), content, id=id)


def scroller(content: str) -> Markup:
    """A frame in which a long table scrolls on the screen."""
    return element("div", content, class_="scroller", tabindex=0)


def summary(map: TopometricMap) -> Markup:
    """The figures that one wants first."""
    way = np.isin(map.edges["kind"], ("door", "opening"))
    shut = int((way & ~map.edges["open"]).sum())
    glimpsed = int(map.rooms["glimpsed"].sum())
    stairs = int((~way).sum())
    figures = [
        (str(len(map.rooms)), "room" if len(map.rooms) == 1 else "rooms", f"{glimpsed} only glimpsed" if glimpsed else ""),
        (f"{float(map.rooms['area'].sum()):,.0f} m²".replace(",", "\u202f"), "floor area", ""),
        (str(len(map.storeys)), "storey" if len(map.storeys) == 1 else "storeys", ""),
        (str(int(way.sum())), "doors and openings", f"{shut} shut" if shut else ""),
        (str(stairs), "stairs and ramps", ""),
        (f"{map.grid.edge * 100:.3g} cm", "cells", f"{len(map.grid):,} occupied".replace(",", "\u202f")),
    ]
    items = [
        element("li", element("b", value), element("span", name), *([element("small", more)] if more else []))
        for value, name, more in figures
        if value != "0"
    ]
    return element("ul", *items, class_="summary")


def warnings(messages: Sequence[str]) -> Markup:
    """What the user should know; nothing where there is nothing."""
    if not messages:
        return Markup("")
    items = element("ul", *(element("li", message) for message in messages))
    return element("aside", element("h2", "Warnings"), items, class_="warnings")


def parameters(map: TopometricMap) -> Markup:
    """What the map was made from and with."""
    values = {"source": map.source or "–", "voxel_size": float(map.grid.edge), **map.parameters}
    if isinstance(values.get(BEND_PARAMETER), list):  # hundreds of numbers
        values[BEND_PARAMETER] = f"of {len(values[BEND_PARAMETER])} of its maps"
    return facts(values, "Parameters")


def storey_names(map: TopometricMap) -> list[tuple[str, str]]:
    """Short name and caption of each storey that has a plan."""
    names = []
    for i, storey in enumerate(map.storeys):
        rooms = int((map.rooms["storey"] == i).sum())
        area = float(map.rooms["area"][map.rooms["storey"] == i].sum())
        words = [f"floor at {storey['floor']:.2f} m", f"{rooms} room{'' if rooms == 1 else 's'}", f"{area:.0f} m²"]
        names.append((f"Storey {i}", " · ".join(words)))
    return names or [("Plan", "no storeys were found")]


def plan_view(map: TopometricMap, sheet: Sheet, plans: Sequence[StoreyPlan], colours: Array | None = None) -> Markup:
    """All storeys' plans, as `lay_out` made them; the page's script shows one at a time, zooms and switches layers.

    Args:
        colours: (R, 3) uint8 of the rooms; neighbours differ if None.
    """
    names = storey_names(map)
    choices = [element("button", name, type="button", data_storey=i) for i, (name, _) in enumerate(names) if len(names) > 1]
    layers = [("labels", "numbers", True), ("graph", "graph", True), ("doors", "doors", True)]
    if len(map.narrows):
        layers.append(("areas", "areas", True))
    if len(names) > 1:
        layers.append(("all", "rooms of all storeys", False))
    boxes = []
    for layer, name, on in layers:
        box = element("input", type="checkbox", checked=on, data_layer=layer)
        boxes.append(element("label", box, f" {name}"))
    if len(map.rooms):
        slider = element("input", type="range", min=0, max=90, step=10, value=0, data_sure="")
        boxes.append(element("label", "minimum confidence: ", slider))
    groups = [("choices", choices), ("layers", boxes), ("zoom", zoom_buttons())]
    bar = element("div", *(element("div", *parts, class_=name) for name, parts in groups if parts), class_="controls")
    figures = [
        element("figure", element("figcaption", element("b", name), f" {words}"), drawing, data_storey=i)
        for i, ((name, words), drawing) in enumerate(zip(names, plan_svgs(map, sheet, plans, colours), strict=True))
    ]
    hint = element("p", "Point at a room. Drag to move; click, then scroll to zoom.", class_="told", aria_live="polite")
    return element("div", bar, element("div", *figures, class_="sheet", tabindex=0), hint, legend(map), class_="plan-view")


def zoom_buttons() -> list[Markup]:
    """The buttons by which a plan is zoomed."""
    return [
        element("button", sign, type="button", data_zoom=step, title=words, aria_label=words)
        for sign, step, words in (("+", "in", "Zoom in"), ("−", "out", "Zoom out"), ("⤢", "all", "Show all"))
    ]


def legend(map: TopometricMap) -> Markup:
    """What the signs of the plan mean, of those that it has."""
    way = np.isin(map.edges["kind"], ("door", "opening"))
    doors = map.edges["kind"] == "door"
    entries = [
        ("door", "open door", bool((doors & map.edges["open"]).any())),
        ("shut", "shut door", bool((way & ~map.edges["open"]).any())),
        ("opening", "opening", bool((map.edges["kind"] == "opening").any())),
        ("window", "window", len(map.windows) > 0),
        ("stairs", "stairs or ramp", bool((~way).any())),
        ("glimpsed", "glimpsed: only looked into", bool(map.rooms["glimpsed"].any())),
        ("narrow", "narrowing within a room", len(map.narrows) > 0),
        ("wall", "wall, cut at 1 to 1.9 m", True),
        ("seen", "seen, not a room", True),
    ]
    items = [element("li", element("i", class_=f"sign-{sign}"), words) for sign, words, there in entries if there]
    return element("ul", *items, class_="legend")


def scene_view(data: str) -> Markup:
    """The place of a 3D view of the cells whose `scene_data` the page carries under the id `data`."""
    words = "The 3D view needs JavaScript and WebGL 2, which this browser does not offer. The plans above show the same rooms."
    return element("div", element("p", words, class_="missing"), class_="scene", data_scene=data)
