"""For robots: a map_server grid of each storey (image and yaml), where not to go, and a route graph for Nav2.

In the image 254 is free, 0 occupied and 205 unknown. Sources: http://wiki.ros.org/map_server; the graphs that nav2_route's
GeoJsonGraphFileLoader reads; the masks of nav2_costmap_2d's KeepoutFilter.
"""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from topomerge.errors import InputError
from topomerge.io.atomic import replacing
from topomerge.io.exports.occupancy import Occupancy, storey_occupancy
from topomerge.io.exports.route import Route, storey_route
from topomerge.types import TopometricMap

LIKELY_OUTSIDE = 0.5  # probability from which a room is kept out of
FREE_PIXEL, OCCUPIED_PIXEL, UNKNOWN_PIXEL = 254, 0, 205


def files(map: TopometricMap, folder: Path, stem: str, storey: int | None = None) -> list[tuple[Path, partial[None]]]:
    """What stands in the folder: for each storey `storey_0.pgm` and `.yaml`, `storey_0_keepout.pgm` and `.yaml` where floor is
    probably outside, and `storey_0_route.geojson` where there are routes.

    Numbers of nodes and edges are unique over all storeys. Where stairs begin or end, a node says in its metadata to which room
    of which storey they lead.

    Raises:
        InputError: there is no such storey, or none at all.
    """
    count = len(map.storeys)
    if storey is not None and not 0 <= storey < count:
        raise InputError(f"--storey {storey}: the map has no such storey (it has {count})")
    if not count:
        raise InputError("the map has no storeys, so that there is nothing to draw for a robot; extract it from a denser cloud")
    outputs: list[tuple[Path, partial[None]]] = []
    first = 0
    for s in range(count):
        grid = storey_occupancy(map, s)
        route, first = storey_route(map, grid, s, first)
        if storey not in (None, s):
            continue
        name = f"{stem}storey_{s}"
        outputs += _images(folder, name, grid)
        keepout = _keepout(map, grid)
        if keepout.occupied.any():
            outputs += _images(folder, f"{name}_keepout", keepout)
        if route.edges:
            outputs.append((folder / f"{name}_route.geojson", partial(_save_route, route, name)))
    return outputs


def _images(folder: Path, name: str, grid: Occupancy) -> list[tuple[Path, partial[None]]]:
    """A grid's image and what says where it lies."""
    image = f"{name}.pgm"
    return [(folder / image, partial(_save_image, grid)), (folder / f"{name}.yaml", partial(_save_yaml, grid, image))]


def _keepout(map: TopometricMap, grid: Occupancy) -> Occupancy:
    """Occupied: the floor of rooms that are probably outside; everything else is free."""
    outside = np.append(map.rooms["outside"] >= LIKELY_OUTSIDE, False)[grid.room]  # room -1: the last one
    return replace(grid, free=~outside, occupied=outside)


def _save_image(grid: Occupancy, path: Path) -> None:
    image = np.full(grid.free.shape, UNKNOWN_PIXEL, np.uint8)
    image[grid.free] = FREE_PIXEL
    image[grid.occupied] = OCCUPIED_PIXEL
    image = np.ascontiguousarray(image.T[::-1])  # rows from the top, y up
    height, width = len(image), len(image[0])
    with replacing(path) as beside, beside.open("wb") as file:
        file.write(f"P5\n# topomerge: {grid.size:g} m a pixel\n{width} {height}\n255\n".encode("ascii"))
        file.write(image.tobytes())


def _save_yaml(grid: Occupancy, image: str, path: Path) -> None:
    x, y = float(grid.low[0]), float(grid.low[1])
    lines = [f"image: {json.dumps(image)}", "mode: trinary", f"resolution: {grid.size!r}", f"origin: [{x!r}, {y!r}, 0.0]"]
    lines += ["negate: 0", "occupied_thresh: 0.65", "free_thresh: 0.196"]
    with replacing(path) as beside:
        beside.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _save_route(route: Route, name: str, path: Path) -> None:
    place = {node.id: [round(v, 4) for v in node.point] for node in route.nodes}
    features = []
    for node in route.nodes:
        properties = {"id": node.id, "frame": "map", "metadata": node.metadata}
        point = {"type": "Point", "coordinates": place[node.id]}
        features.append({"type": "Feature", "properties": properties, "geometry": point})
    for edge in route.edges:
        line = {"type": "MultiLineString", "coordinates": [[place[edge.start], place[edge.end]]]}
        properties = {"id": edge.id, "startid": edge.start, "endid": edge.end, "cost": round(edge.length, 4), "overridable": True}
        features.append({"type": "Feature", "properties": properties, "geometry": line})
    head = json.dumps({"type": "FeatureCollection", "name": name, "crs": None})[:-1]
    lines = ",\n".join(json.dumps(feature, allow_nan=False) for feature in features)
    with replacing(path) as beside:
        beside.write_text(f'{head}, "features": [\n{lines}\n]}}\n', encoding="utf-8")
