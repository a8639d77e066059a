"""For Open-RMF: a building file of its traffic editor, and the navigation graph of its fleet adapters, from Nav2's routes.

Coordinates are metres with y up (`cartesian_meters`). Lanes lead both ways. A lift is what a room's name says is one; rooms above
each other are one lift. Sources: the files of rmf_traffic_editor and rmf_fleet_adapter (`*.building.yaml`, `nav_graphs/0.yaml`).
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.archive import replace_on_success
from topomerge.io.exports.ros import Route, count_storeys, plan_storey_route, rasterize_occupancy
from topomerge.structure.floors import build_floor_polygons
from topomerge.types import Array, TopometricMap, find_room_names

LIFT = re.compile(r"\b(lift|elevator|aufzug|ascenseur|ascensor|ascensore|hiss|elevador)s?\b", re.IGNORECASE)
SAME_SHAFT = 1.5  # m, between the middles of rooms of one lift
SIMPLER = 0.05  # m, by which the outline of a floor may change
TEXT, WHOLE, REAL, TRUTH = 1, 2, 3, 4  # kinds of parameters


@dataclass
class _Level:
    """A storey: vertices as (x, y, z, name, parameters), and lists that name them."""

    name: str
    elevation: float
    vertices: list[tuple[float, float, float, str, dict[str, Any]]] = field(default_factory=list)
    lanes: list[tuple[int, int]] = field(default_factory=list)
    doors: list[tuple[int, int, str]] = field(default_factory=list)
    floors: list[list[int]] = field(default_factory=list)

    def add(self, point: Any, name: str = "", **parameters: Any) -> int:
        """Add a vertex and return its number."""
        x, y = (round(float(v), 4) for v in point[:2])
        self.vertices.append((x, y, 0.0, name, parameters))
        return len(self.vertices) - 1


@dataclass(frozen=True)
class _Lift:
    """A lift: its rooms by storey, its middle and its sides, m."""

    name: str
    rooms: dict[int, int]
    at: tuple[float, float]
    size: tuple[float, float]


def prepare_files(map: TopometricMap, folder: Path, stem: str, storey: int | None = None) -> list[tuple[Path, partial[None]]]:
    """Prepare the building file and the navigation graph of all storeys, or of one.

    Raises:
        InputError: there is no such storey, or none at all.
    """
    count = count_storeys(map, storey, "there are no lanes")
    names = find_room_names(map.landmarks, len(map.rooms))
    lifts = find_lifts(map, names)
    levels, first = [], 0
    for s in range(count):
        route, first = plan_storey_route(map, rasterize_occupancy(map, s), s, first)
        if storey in (None, s):
            levels.append(_build_level(map, s, route, names, lifts))
    name = stem.rstrip("_") or "building"
    building = partial(_write, _format_building(name, levels, map, lifts))
    graph = partial(_write, _format_graph(name, levels, lifts))
    return [
        (folder / f"{stem or 'building_'}rmf.building.yaml", building),
        (folder / f"{stem or 'building_'}rmf_nav.yaml", graph),
    ]


def find_lifts(map: TopometricMap, names: Sequence[str]) -> list[_Lift]:
    """Find the lifts: rooms that are called so, those above each other as one."""
    found: list[list[int]] = []
    for r in (r for r, name in enumerate(names) if LIFT.search(name)):
        at, storey = map.rooms["centroid"][r, :2], map.rooms["storey"][r]
        own = next(
            (
                group
                for group in found
                if np.linalg.norm(map.rooms["centroid"][group[0], :2] - at) <= SAME_SHAFT
                and storey not in map.rooms["storey"][group]
            ),
            None,
        )
        if own is None:
            found.append([r])
        else:
            own.append(r)
    lifts = []
    for k, group in enumerate(found):
        low, high = map.rooms["lo"][group, :2].min(axis=0), map.rooms["hi"][group, :2].max(axis=0)
        x, y = ((low + high) / 2).tolist()
        wide, deep = (high - low).tolist()
        lifts.append(_Lift(f"lift_{k}", {int(map.rooms["storey"][r]): r for r in group}, (x, y), (wide, deep)))
    return lifts


def _name_level(storey: int) -> str:
    return f"L{storey + 1}"


def _build_level(map: TopometricMap, storey: int, route: Route, names: Sequence[str], lifts: Sequence[_Lift]) -> _Level:
    level = _Level(_name_level(storey), float(map.storeys["floor"][storey]))
    cabin = {lift.rooms[storey]: lift.name for lift in lifts if storey in lift.rooms}
    number = {}
    for node in route.nodes:
        room = node.metadata.get("room") if node.metadata["kind"] == "room" else None
        name = "" if room is None else names[room] or f"room_{room}"
        more = {"lift_cabin": [TEXT, cabin[room]]} if room in cabin else {}
        number[node.id] = level.add(node.point, _make_unique(name, level), **more)
    level.lanes = [(number[a], number[b]) for a, b in route.links]
    for i, edge in enumerate(map.edges):
        rooms = [r for r in edge["rooms"].tolist() if map.rooms["storey"][r] == storey]
        if rooms and str(edge["kind"]) == "door":
            along = np.array([-np.sin(edge["direction"]), np.cos(edge["direction"])]) * edge["width"] / 2
            ends = (level.add(edge["centre"][:2] - along), level.add(edge["centre"][:2] + along))
            level.doors.append((*ends, f"{level.name}_door_{i}"))
    for r, floor in enumerate(build_floor_polygons(map)):
        if map.rooms["storey"][r] == storey and not floor.is_empty:
            parts = getattr(floor.simplify(SIMPLER), "geoms", [floor.simplify(SIMPLER)])
            outline = max(parts, key=lambda part: part.area).exterior.coords[:-1]
            level.floors.append([level.add(point) for point in outline])
    return level


def _make_unique(name: str, level: _Level) -> str:
    taken = {vertex[3] for vertex in level.vertices}
    if not name or name not in taken:
        return name
    return next(other for k in range(2, len(taken) + 3) if (other := f"{name} {k}") not in taken)


def _write(text: str, path: Path) -> None:
    with replace_on_success(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _dump(value: Any) -> str:
    """Return a value as JSON, which YAML reads as its own in one line."""
    return json.dumps(value, ensure_ascii=False, allow_nan=False)


def _list(lines: list[str], indent: str) -> list[str]:
    return [f"{indent}- {line}" for line in lines] or [f"{indent}[]"]


def _format_building(name: str, levels: Sequence[_Level], map: TopometricMap, lifts: Sequence[_Lift]) -> str:
    lane = {"bidirectional": [TRUTH, True], "graph_idx": [WHOLE, 0], "orientation": [TEXT, ""], "speed_limit": [REAL, 0]}
    door = {"motion_axis": [TEXT, "start"], "motion_degrees": [REAL, 90], "motion_direction": [WHOLE, 1]}
    lines = ["coordinate_system: cartesian_meters", "graphs: {}", "levels:"]
    for level in levels:
        lines += [f"  {level.name}:", "    doors:"]
        lines += _list(
            [_dump([a, b, {**door, "name": [TEXT, n], "type": [TEXT, "hinged"]}]) for a, b, n in level.doors], "      "
        )
        lines += [f"    elevation: {level.elevation!r}", "    floors:"]
        lines += _list([_dump({"parameters": {}, "vertices": floor}) for floor in level.floors], "      ")
        lines += [
            "    lanes:",
            *_list([_dump([a, b, lane]) for a, b in level.lanes], "      "),
            "    layers: {}",
            "    vertices:",
        ]
        vertices = [_dump([*v[:4], v[4]] if v[4] else list(v[:4])) for v in level.vertices]
        lines += _list(vertices, "      ")
        lines += ["    walls: []"]
    lines += ["lifts:" if lifts else "lifts: {}"]
    for lift in lifts:
        lines += [f"  {lift.name}: {_dump(_describe_lift(map, lift))}"]
    return "\n".join([*lines, f"name: {_dump(name)}"]) + "\n"


def _describe_lift(map: TopometricMap, lift: _Lift) -> dict[str, Any]:
    storeys = sorted(lift.rooms)
    doors: dict[str, Any] = {}
    level_doors: dict[str, list[str]] = {}
    for storey in storeys:
        for edge in map.edges[(map.edges["rooms"] == lift.rooms[storey]).any(axis=1)]:
            x, y = (np.asarray(edge["centre"][:2]) - lift.at).tolist()
            name = next((n for n, d in doors.items() if np.hypot(d["x"] - x, d["y"] - y) <= SAME_SHAFT / 2), None)
            if name is None:
                name = f"{lift.name}_door_{len(doors)}"
                across = float(edge["direction"] + np.pi / 2)
                doors[name] = {
                    "door_type": 2,
                    "motion_axis_orientation": round(across, 4),
                    "width": round(float(edge["width"]), 3),
                }
                doors[name] |= {"x": round(x, 3), "y": round(y, 3)}
            level_doors.setdefault(_name_level(storey), []).append(name)
    floors = [_name_level(s) for s in storeys]
    about: dict[str, Any] = {"x": round(lift.at[0], 4), "y": round(lift.at[1], 4), "yaw": 0.0, "width": round(lift.size[0], 3)}
    about |= {"depth": round(lift.size[1], 3), "doors": doors, "level_doors": level_doors, "lowest_floor": floors[0]}
    return about | {
        "highest_floor": floors[-1],
        "initial_floor_name": floors[0],
        "reference_floor_name": floors[0],
        "plugins": False,
    }


def _format_graph(name: str, levels: Sequence[_Level], lifts: Sequence[_Lift]) -> str:
    """Return the graph that fleet adapters read: lanes have one direction, and vertices of floors and doors are left out."""
    lines = [f"building_name: {_dump(name)}", "levels:"]
    for level in levels:
        used = sorted({end for lane in level.lanes for end in lane})
        number = {vertex: k for k, vertex in enumerate(used)}
        lanes = [_dump([number[a], number[b], {"speed_limit": 0}]) for pair in level.lanes for a, b in (pair, pair[::-1])]
        vertices = []
        for vertex in used:
            x, y, _, title, more = level.vertices[vertex]
            about = {"name": title, **({"lift": more["lift_cabin"][1]} if more else {})}
            vertices.append(_dump([x, y, about]))
        lines += [f"  {level.name}:", "    lanes:", *_list(lanes, "    "), "    vertices:", *_list(vertices, "    ")]
    doors = {n: _describe_door(level, a, b) for level in levels for a, b, n in level.doors}
    lines += [f"doors: {_dump(doors)}"]
    placed = {
        lift.name: {"position": [*(round(v, 4) for v in lift.at), 0.0], "dims": [round(v, 3) for v in lift.size]}
        for lift in lifts
    }
    return "\n".join([*lines, f"lifts: {_dump(placed)}"]) + "\n"


def _describe_door(level: _Level, a: int, b: int) -> dict[str, Any]:
    ends: list[Array] = [np.array(level.vertices[k][:2]) for k in (a, b)]
    return {"map": level.name, "endpoints": [end.tolist() for end in ends]}
