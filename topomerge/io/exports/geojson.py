"""Rooms and walls as polygons, doors and windows as lines and as openings in walls: GeoJSON (RFC 7946), for QGIS and web maps.

With an origin, coordinates are longitude and latitude of WGS84. Without, they are metres in the frame of the map; then `crs` is
null, which tells readers of the older GeoJSON that there are no degrees, and the member `topomerge` says so in words.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from topomerge.archive import replace_on_success
from topomerge.errors import InputError
from topomerge.io.landmarks import serialise_landmarks
from topomerge.structure.floors import compute_jambs, is_flight, measure_room_levels
from topomerge.structure.plan_structure import build_plan_structure
from topomerge.structure.walls import build_wall_polygon
from topomerge.types import ROOM_ODDS, Array, TopometricMap, find_room_names

SEMI_MAJOR, FLATTENING = 6378137.0, 1 / 298.257223563  # m; the ellipsoid of WGS84
ECCENTRICITY2 = FLATTENING * (2 - FLATTENING)
OWN_FRAME_REACH = 50e3  # m from the origin: beyond, a map stands in a grid of its country, not in a frame of its own
DIGITS_M, DIGITS_DEGREES = 4, 9  # a tenth of a millimetre either way
Place = Callable[[Array], list[list[float]]]  # (n, 3) points of the map -> positions


@dataclass(frozen=True)
class Origin:
    """Where (0, 0) of the map's frame lies on the earth, and where its y axis points: degrees clockwise from north."""

    latitude: float
    longitude: float
    heading: float = 0.0


def parse_origin(text: str) -> Origin:
    """Parse the origin in "latitude,longitude" or "latitude,longitude,heading", in degrees.

    Raises:
        InputError: something else, or a place that is not on earth.
    """
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (2, 3) or not all(map(math.isfinite, numbers)):
        raise InputError(f"--origin {text}: is latitude,longitude or latitude,longitude,heading in degrees, as 52.52,13.37,0")
    if abs(numbers[0]) > 89.9 or abs(numbers[1]) > 180:
        raise InputError(f"--origin {text}: latitude is -89.9 to 89.9 degrees, longitude -180 to 180; latitude goes first")
    return Origin(*numbers)


def save(map: TopometricMap, path: Path, origin: Origin | None = None, storey: int | None = None) -> None:
    """Write one FeatureCollection: a feature for each room, then for each door, opening and flight of stairs, each window,
    each wall, each door, opening or window as a hole in its wall, and each landmark.

    Args:
        map: any map.
        path: where.
        origin: of the map's frame; None: coordinates stay metres.
        storey: only what lies on this storey, or begins or ends there; None: all.

    Raises:
        InputError: the path can't be written, there is no such storey, or the map is too far from its own origin for `origin`.
    """
    if storey is not None and not 0 <= storey < len(map.storeys):
        valid = f"0 to {len(map.storeys) - 1}" if len(map.storeys) else "none"
        raise InputError(f"--storey {storey}: the map has no such storey ({valid})")
    if origin is not None:
        _check_near(map)
    place = round_positions if origin is None else _build_geodetic_transform(origin)
    features = [*_iter_rooms(map, place, storey), *_iter_doors(map, place, storey), *_iter_windows(map, place, storey)]
    features += [*_iter_walls(map, place, storey), *_iter_openings(map, place, storey), *_iter_landmarks(map, place, storey)]
    listing: dict[str, Any] = {"type": "FeatureCollection"}
    if origin is None:
        listing |= {
            "crs": None,
            "topomerge": _describe_map(map, "metres in the frame of the map, z up; not longitude and latitude"),
        }
    else:
        listing["topomerge"] = _describe_map(map, "WGS84 longitude and latitude in degrees; then metres in the frame of the map")
        listing["topomerge"]["origin"] = vars(origin)
    with replace_on_success(path) as temporary:
        temporary.write_text(format_collection(listing, features), encoding="utf-8", errors="replace")


def _describe_map(map: TopometricMap, coordinates: str) -> dict[str, Any]:
    return {"coordinates": coordinates, "source": map.source, "voxel_size": float(map.grid.edge)}


def format_collection(listing: dict[str, Any], features: list[dict[str, Any]]) -> str:
    """Return a line for each feature, so that files can be compared."""
    head = json.dumps(listing, ensure_ascii=False, allow_nan=False)[:-1]
    lines = ",\n".join(json.dumps(f, ensure_ascii=False, allow_nan=False) for f in features)
    return f'{head}, "features": [\n{lines}\n]}}\n'


def _iter_rooms(map: TopometricMap, place: Place, storey: int | None) -> Iterator[dict[str, Any]]:
    levels, seen = measure_room_levels(map)
    names = find_room_names(map.landmarks, len(map.rooms))
    for r, (room, floor) in enumerate(zip(map.rooms, build_plan_structure(map).rooms, strict=True)):
        if storey not in (None, int(room["storey"])):
            continue
        properties: dict[str, Any] = {"kind": "room", "room": r, **({"name": names[r]} if names[r] else {})}
        properties |= {"storey": int(room["storey"]), "area": round(float(room["area"]), 3)}
        properties["height"] = round(float(room["height"]), 3) if seen[r] else None
        properties |= {"floor": round(float(levels[r, 0]), 3), "completeness": round(float(room["completeness"]), 3)}
        properties["glimpsed"] = bool(room["glimpsed"])
        properties |= {name: round(float(room[name]), 3) for name in ROOM_ODDS}
        yield _build_feature(f"room {r}", _build_polygons(floor, float(levels[r, 0]), place), properties)


def _iter_doors(map: TopometricMap, place: Place, storey: int | None) -> Iterator[dict[str, Any]]:
    for i, edge in enumerate(map.edges):
        ends = edge["rooms"].tolist()
        storeys = sorted({int(s) for s in map.rooms["storey"][ends]})
        if storey is not None and storey not in storeys:
            continue
        line = np.stack([edge["lower"], edge["upper"]]) if is_flight(edge) else compute_jambs(edge)
        properties = {"kind": str(edge["kind"]), "rooms": ends, "storey": storeys[0], "storeys": storeys}
        properties |= {name: round(float(edge[name]), 3) for name in ("width", "confidence")}
        properties |= {"height": round(float(edge["height"]), 3) or None, "open": bool(edge["open"]), "half": bool(edge["half"])}
        yield _build_feature(f"edge {i}", {"type": "LineString", "coordinates": place(line)}, properties)


def _iter_windows(map: TopometricMap, place: Place, storey: int | None) -> Iterator[dict[str, Any]]:
    for k, (window, pane) in enumerate(zip(map.windows, build_plan_structure(map).windows, strict=True)):
        if storey in (None, level := int(map.rooms["storey"][window["rooms"][0]])):
            properties = {"kind": "window", "window": k, "rooms": _list_side_rooms(window), "storey": level}
            properties |= {name: _round_height(window[name]) for name in ("width", "sill", "head", "confidence")}
            yield _build_feature(f"window {k}", {"type": "LineString", "coordinates": place(compute_jambs(pane))}, properties)


def _iter_landmarks(map: TopometricMap, place: Place, storey: int | None) -> Iterator[dict[str, Any]]:
    """Yield a point each; its `position` stays in metres. Readings of radio are as many as points of a cloud and are left out."""
    for k, row in enumerate(serialise_landmarks(map.landmarks.select(~map.landmarks.is_kind("radio", "pressure")))):
        if storey in (None, row["storey"]):
            at = None if row["position"] is None else place(np.array([row["position"]]))[0]
            geometry = None if at is None else {"type": "Point", "coordinates": at}
            yield _build_feature(f"landmark {k}", geometry, {**row, "kind": "landmark", "of": row["kind"]})


def _round_height(value: Any) -> float | None:
    return round(float(value), 3) if np.isfinite(value) else None


def _iter_walls(map: TopometricMap, place: Place, storey: int | None) -> Iterator[dict[str, Any]]:
    for k, wall in enumerate(build_plan_structure(map).walls):
        if storey in (None, int(wall["storey"])):
            properties = {"kind": "wall", "wall": k, "storey": int(wall["storey"]), "rooms": _list_side_rooms(wall)}
            properties |= {"thickness": round(float(wall["thickness"]), 3), "faces": int(wall["faces"])}
            properties |= {name: round(float(wall[name]), 3) for name in ("low", "high")}
            shape = shapely.MultiPolygon([build_wall_polygon(wall)])
            yield _build_feature(f"wall {k}", _build_polygons(shape, float(wall["low"]), place), properties)


def _iter_openings(map: TopometricMap, place: Place, storey: int | None) -> Iterator[dict[str, Any]]:
    structure = build_plan_structure(map)
    for opening in structure.openings[structure.openings["wall"] >= 0]:
        i, wall = int(opening["edge"]), structure.walls[opening["wall"]]
        if storey in (None, int(wall["storey"])):
            properties = {"kind": "wall_opening", "of": str(opening["kind"]), "edge": i, "wall": int(opening["wall"])}
            properties |= {"storey": int(wall["storey"]), "rooms": map.edges["rooms"][i].tolist()}
            properties |= {"width": round(float(opening["width"]), 3), "height": round(float(opening["height"]), 3) or None}
            shape = shapely.MultiPolygon([build_wall_polygon(wall, opening)])
            yield _build_feature(f"opening {i}", _build_polygons(shape, float(opening["centre"][2]), place), properties)
    for pane in structure.windows[structure.windows["wall"] >= 0]:
        k, wall = int(pane["window"]), structure.walls[pane["wall"]]
        if storey in (None, int(wall["storey"])):
            properties = {"kind": "wall_opening", "of": "window", "window": k, "wall": int(pane["wall"])}
            properties |= {
                "storey": int(wall["storey"]),
                "rooms": _list_side_rooms(map.windows[k]),
                "width": _round_height(pane["width"]),
            }
            properties |= {name: _round_height(map.windows[name][k]) for name in ("sill", "head")}
            shape = shapely.MultiPolygon([build_wall_polygon(wall, pane)])
            yield _build_feature(f"pane {k}", _build_polygons(shape, float(pane["centre"][2] + pane["sill"]), place), properties)


def _list_side_rooms(wall: Any) -> list[int | None]:
    """List the rooms on both sides of a wall or a window; null where none was seen."""
    return [r if r >= 0 else None for r in wall["rooms"].tolist()]


def _build_feature(name: str, geometry: dict[str, Any] | None, properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "Feature", "id": name, "geometry": geometry, "properties": properties}


def _build_polygons(floor: shapely.MultiPolygon, z: float, place: Place) -> dict[str, Any] | None:
    """Return the geometry of a floor; null, as RFC 7946 has it, where there is none."""
    parts = [
        [place(np.column_stack([ring.coords, np.full(len(ring.coords), z)])) for ring in (part.exterior, *part.interiors)]
        for part in floor.geoms
    ]
    if not parts:
        return None
    return {"type": "Polygon", "coordinates": parts[0]} if len(parts) == 1 else {"type": "MultiPolygon", "coordinates": parts}


def round_positions(points: Array) -> list[list[float]]:
    rounded: list[list[float]] = np.round(np.asarray(points, np.float64), DIGITS_M).tolist()
    return rounded


def _check_near(map: TopometricMap) -> None:
    corners = np.abs(np.concatenate([map.rooms["lo"][:, :2], map.rooms["hi"][:, :2]])).max(initial=0.0)
    if corners > OWN_FRAME_REACH:
        far = f"{corners / 1000:.0f} km from (0, 0) of its frame, as in a national grid"
        raise InputError(f"--origin: the map lies {far}; leave --origin out and name that grid in your GIS")


def _build_geodetic_transform(origin: Origin) -> Place:
    """Build the transform to the longitude and latitude of points in the plane that touches the ellipsoid at the origin; their z
    stays."""
    lat, lon, heading = (math.radians(v) for v in (origin.latitude, origin.longitude, origin.heading))
    up = np.array([math.cos(lat) * math.cos(lon), math.cos(lat) * math.sin(lon), math.sin(lat)])
    east = np.array([-math.sin(lon), math.cos(lon), 0.0])
    north = np.cross(up, east)
    normal = SEMI_MAJOR / math.sqrt(1 - ECCENTRICITY2 * math.sin(lat) ** 2)
    start = normal * up * (1, 1, 1 - ECCENTRICITY2)
    right, ahead = math.cos(heading) * east - math.sin(heading) * north, math.sin(heading) * east + math.cos(heading) * north

    def place(points: Array) -> list[list[float]]:
        points = np.asarray(points, np.float64)
        x, y, z = (start + points[:, :1] * right + points[:, 1:2] * ahead).T
        across = np.hypot(x, y)
        reduced = np.arctan2(z, across * (1 - FLATTENING))  # Bowring 1976: exact to nanometres this near the ellipsoid
        latitude = np.arctan2(
            z + ECCENTRICITY2 / (1 - ECCENTRICITY2) * SEMI_MAJOR * (1 - FLATTENING) * np.sin(reduced) ** 3,
            across - ECCENTRICITY2 * SEMI_MAJOR * np.cos(reduced) ** 3,
        )
        degrees = np.round(np.degrees([np.arctan2(y, x), latitude]), DIGITS_DEGREES)
        return [[*position, round(float(h), 3)] for position, h in zip(degrees.T.tolist(), points[:, 2], strict=True)]

    return place
