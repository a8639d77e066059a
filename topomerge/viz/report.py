"""A report of a map: one HTML file."""

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
from topomerge.archive import replace_on_success
from topomerge.fusion.result import BEND_PARAMETER
from topomerge.fusion.transfer import LANDMARK_PARAMETER
from topomerge.types import Array, TopometricMap
from topomerge.viz.plan import StoreyView, build_scene_data
from topomerge.viz.svg import Sheet, lay_out, render_plan_svgs
from topomerge.viz.tables import (
    SHOWN_KINDS,
    Markup,
    build_element,
    embed_json,
    join,
    render_doors_table,
    render_landmarks,
    render_properties,
    render_rooms_table,
    render_seconds_table,
    render_storeys_table,
)

SCRIPTS = ("plan.js", "tables.js", "camera.js", "cells.js", "scene.js", "merge.js", "places.js", "diff.js", "stamp.js", "page.js")
MODULE_WORDS = re.compile(r"^(?:import .*;\n|export )", re.MULTILINE)  # elsewhere they are modules, here one script
BESIDE = " 'self' file:"  # what a page that looks for a newer one may read: a style sheet that lies beside it, never a script


def save_report(map: TopometricMap, path: str | Path) -> None:
    """Write the report of one map. The same map gives the same bytes.

    Raises:
        InputError: the path can't be written.
    """
    write_page(render_report_html(map), path)


def write_page(text: str, path: str | Path) -> None:
    """Write a page whole or not at all, the same bytes on every system.

    Raises:
        InputError: the path can't be written.
    """
    with replace_on_success(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="replace", newline="\n")


def render_report_html(map: TopometricMap) -> str:
    """Render the report of one map as HTML: plans and rooms, 3D, doors, and what it was made with."""
    title = map.title
    sheet, plans = lay_out(map)
    rooms = build_element("div", render_plan_view(map, sheet, plans), render_scroller(render_rooms_table(map)), class_="beside")
    origin = build_element(
        "div", render_storeys_table(map), render_seconds_table(map), render_parameters(map), class_="facts-row"
    )
    sections = [
        render_summary(map),
        render_warnings(map.warnings),
        render_section("Plan and rooms", join([rooms, *render_landmarks(map)]), "plan"),
        render_section("3D view", render_scene_view("scene-data"), "space"),
        render_section("Doors and stairs", render_scroller(render_doors_table(map)), "doors"),
        render_section("How it was made", origin, "made"),
    ]
    return render_page(title, "Topometric map", sections, {"scene-data": build_scene_data(map, turn=sheet.turn)})


def render_page(
    title: str, kind: str, sections: Sequence[Markup], data: Mapping[str, Any], stamp: str = "", stamped: str = "stamp"
) -> str:
    """Render a whole page from the template.

    Args:
        title: what it is about; escaped.
        kind: what kind of report it is; escaped.
        sections: its content.
        data: id -> a JSON value that the scripts read, as `build_scene_data`.
        stamp: of the page; an open one loads itself anew when `report_stamp.css` beside it holds another one. Empty: never.
        stamped: the name under which that file holds it.
    """
    script = "".join(MODULE_WORDS.sub("", _read_template(name)) for name in SCRIPTS)
    mark = [build_element("i", id="stamp", data_stamp=stamp, data_name=stamped, hidden=True)] if stamp else []
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii")
    parts = {
        "title": build_element("title", f"{title} – {kind}"),
        "heading": join([build_element("p", kind, class_="kind"), build_element("h1", title)]),
        "style": build_element("style", Markup(_read_template("report.css"))),
        "hash": Markup(digest),
        "styles": Markup(BESIDE if stamp else ""),
        "content": join([*sections, *mark]),
        "data": join(embed_json(value, id) for id, value in data.items()),
        "script": build_element("script", Markup(script)),
        "version": Markup(__version__),
    }
    # In one pass: what is put in is not searched again.
    return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], _read_template("report.html"))


def _read_template(name: str) -> str:
    return (files("topomerge.viz") / "template" / name).read_text(encoding="utf-8")


def render_section(title: str, content: str, id: str) -> Markup:
    """Render a part of the page under a heading."""
    return build_element("section", build_element("h2", title), content, id=id)


def render_scroller(content: str) -> Markup:
    """Render a frame in which a long table scrolls on the screen."""
    return build_element("div", content, class_="scroller", tabindex=0)


def render_summary(map: TopometricMap) -> Markup:
    """Render the figures that one wants first."""
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
        (f"{len(map.landmarks):,}".replace(",", "\u202f"), "landmark" if len(map.landmarks) == 1 else "landmarks", ""),
        (f"{map.grid.edge * 100:.3g} cm", "cells", f"{len(map.grid):,} occupied".replace(",", "\u202f")),
    ]
    items = [
        build_element(
            "li", build_element("b", value), build_element("span", name), *([build_element("small", more)] if more else [])
        )
        for value, name, more in figures
        if value != "0"
    ]
    return build_element("ul", *items, class_="summary")


def render_warnings(messages: Sequence[str]) -> Markup:
    """Render the warnings for the user; nothing where there are none."""
    if not messages:
        return Markup("")
    items = build_element("ul", *(build_element("li", message) for message in messages))
    return build_element("aside", build_element("h2", "Warnings"), items, class_="warnings")


def render_parameters(map: TopometricMap) -> Markup:
    """Render the source and the parameters of the map."""
    values = {"source": map.source or "–", "voxel_size": float(map.grid.edge), **map.parameters}
    if isinstance(values.get(BEND_PARAMETER), list):  # hundreds of numbers
        values[BEND_PARAMETER] = f"of {len(values[BEND_PARAMETER])} of its maps"
    values.pop(LANDMARK_PARAMETER, None)  # the table of landmarks shows them
    return render_properties(values, "Parameters")


def list_storey_names(map: TopometricMap) -> list[tuple[str, str]]:
    """List short name and caption of each storey that has a plan."""
    names = []
    for i, storey in enumerate(map.storeys):
        rooms = int((map.rooms["storey"] == i).sum())
        area = float(map.rooms["area"][map.rooms["storey"] == i].sum())
        parts = [f"floor at {storey['floor']:.2f} m", f"{rooms} room{'' if rooms == 1 else 's'}", f"{area:.0f} m²"]
        names.append((f"Storey {i}", " · ".join(parts)))
    return names or [("Plan", "no storeys were found")]


def render_plan_view(map: TopometricMap, sheet: Sheet, plans: Sequence[StoreyView], colours: Array | None = None) -> Markup:
    """Render all storeys' plans, as `lay_out` made them; the page's script shows one at a time, zooms and switches layers.

    Args:
        colours: (R, 3) uint8 of the rooms; neighbours differ if None.
    """
    names = list_storey_names(map)
    choices = [build_element("button", name, type="button", data_storey=i) for i, (name, _) in enumerate(names) if len(names) > 1]
    layers = [("labels", "numbers", True), ("graph", "graph", True), ("doors", "doors", True)]
    marked = bool(map.landmarks.is_kind(*SHOWN_KINDS).any())
    if marked:
        layers.append(("landmarks", "landmarks", True))
    if len(map.narrows):
        layers.append(("areas", "areas", True))
    if len(names) > 1:
        layers.append(("all", "rooms of all storeys", False))
    boxes = []
    for layer, name, on in layers:
        box = build_element("input", type="checkbox", checked=on, data_layer=layer)
        boxes.append(build_element("label", box, f" {name}"))
    if len(map.rooms):
        slider = build_element("input", type="range", min=0, max=90, step=10, value=0, data_sure="")
        boxes.append(build_element("label", "minimum confidence: ", slider))
    if marked:
        boxes.append(build_element("label", "find: ", build_element("input", type="search", data_find="", size=12)))
    groups = [("choices", choices), ("layers", boxes), ("zoom", render_zoom_buttons())]
    bar = build_element("div", *(build_element("div", *parts, class_=name) for name, parts in groups if parts), class_="controls")
    figures = [
        build_element("figure", build_element("figcaption", build_element("b", name), f" {text}"), drawing, data_storey=i)
        for i, ((name, text), drawing) in enumerate(zip(names, render_plan_svgs(map, sheet, plans, colours), strict=True))
    ]
    hint = build_element("p", "Point at a room. Drag to move; click, then scroll to zoom.", class_="told", aria_live="polite")
    return build_element(
        "div", bar, build_element("div", *figures, class_="sheet", tabindex=0), hint, render_legend(map), class_="plan-view"
    )


def render_zoom_buttons() -> list[Markup]:
    """Render the buttons by which a plan is zoomed."""
    return [
        build_element("button", sign, type="button", data_zoom=step, title=text, aria_label=text)
        for sign, step, text in (("+", "in", "Zoom in"), ("−", "out", "Zoom out"), ("⤢", "all", "Show all"))
    ]


def render_legend(map: TopometricMap) -> Markup:
    """Render the legend of the signs that the plan has."""
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
        ("landmark", "sign, tag, object or name", bool(map.landmarks.is_kind(*SHOWN_KINDS).any())),
        ("wall", "wall, cut at 1 to 1.9 m", True),
        ("seen", "seen, not a room", True),
    ]
    items = [build_element("li", build_element("i", class_=f"sign-{sign}"), text) for sign, text, shown in entries if shown]
    return build_element("ul", *items, class_="legend")


def render_scene_view(data: str) -> Markup:
    """Render the place of a 3D view of the cells whose `build_scene_data` the page carries under the id `data`."""
    text = "The 3D view needs JavaScript and WebGL 2, which this browser does not offer. The plans above show the same rooms."
    return build_element("div", build_element("p", text, class_="missing"), class_="scene", data_scene=data)
