"""Malls of the indoor location competition 2.0: ``geojson_map.json`` beside ``floor_info.json``, one folder a storey.

The first feature is the floor, the others are shops, service rooms, closed areas and things that stand in the halls, in WGS84.
What the floor has left is halls. There are no doors: each room gets one to the hall that it faces longest.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import shapely
import shapely.geometry
from topomerge.datasets.plans.sketch import Sketch, check_size, find_overlaps, place_door

from topomerge.errors import InputError
from topomerge.types import Array

MALL_KINDS = {  # words in the (pinyin) names
    "xishoujian": "toilets",
    "weishengjian": "toilets",
    "louti": "stairs",
    "dianti": "lift",
    "huoti": "lift",
}
CLOSED = ("feikaifangquyu", "fuzhumian", "zhongkong")  # not open to people, service, void over the storey below
STANDING = ("xiuxiqu", "zidongfuti", "churukou")  # seats, escalators and entrances belong to the hall around them
PARKING = re.compile(r"^[A-Z]{0,2}-?\d+$")
KIOSK = 8.0  # m2; smaller shops are stands in the hall
INSET = 0.1  # m
FRONT, SHOP_DOOR = 2.4, 0.9  # m, of shops and of the others
SHOP_REACH = 1.0  # m between a room and the hall it opens to
NARROW_FRONT = 0.6  # m; strips of floor between shops that are narrower are no halls
DEGREE = 111_320.0  # m
MALL_BYTES = 50 << 20


def iter_sketches(path: Path) -> Iterator[tuple[str, Callable[[], Sketch]]]:
    """Yield the name (of the folder) and maker of the one storey."""
    check_size(path, MALL_BYTES)
    yield path.parent.name, partial(read_sketch, path)


def read_sketch(path: Path) -> Sketch:
    """Return one storey; its origin is the nearest tenth of a degree, so that the storeys of a mall lie over each other.

    Raises:
        InputError: no JSON, not of this format, `floor_info.json` missing or of another size.
    """
    features = _load(path).get("features")
    if not isinstance(features, list) or len(features) < 2:
        raise InputError("not a mall plan: no 'features'")
    origin = np.round(shapely.get_coordinates(shapely.geometry.shape(features[0]["geometry"])).mean(axis=0), 1)
    floor = _convert_to_metres(features[0], origin)
    _check_size(floor, path.with_name("floor_info.json"))
    result = Sketch(inset=INSET, height=5.0, ceiling=3.6)
    closed = []
    for feature in features[1:]:
        shape = _find_largest_part(_convert_to_metres(feature, origin))
        name = str(feature.get("properties", {}).get("name") or "")
        if shape.is_empty or any(word in name for word in STANDING) or PARKING.match(name):
            continue
        if not name or any(word in name for word in CLOSED):
            closed.append(shape)
        elif shape.area >= KIOSK:
            result.add_room(f"{name} {len(result.shapes)}", _classify_room(name), shape)
    _remove_duplicates(result)
    _add_halls(result, floor, closed)
    return result


def _load(path: Path) -> dict[str, Any]:
    try:
        loaded = json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        raise InputError(f"damaged JSON: {path.name}: {error}") from error
    if not isinstance(loaded, dict):
        raise InputError(f"not a mall plan: {path.name} holds no object")
    return loaded


def _convert_to_metres(feature: dict[str, Any], origin: Array) -> shapely.Geometry:
    """Convert a shape to metres, x east, y north."""
    shape = shapely.geometry.shape(feature["geometry"])
    factor = np.array([np.cos(np.radians(origin[1])), 1.0]) * DEGREE
    return shapely.make_valid(shapely.transform(shape, lambda points: (points - origin) * factor))


def _find_largest_part(shape: shapely.Geometry) -> shapely.Polygon:
    parts = (p for p in shapely.get_parts(shape) if p.geom_type == "Polygon")
    return max(parts, key=lambda p: p.area, default=shapely.Polygon())


def _check_size(floor: shapely.Geometry, path: Path) -> None:
    if not path.is_file():
        raise InputError(f"missing file: {path.name}")
    info = _load(path).get("map_info", {})
    stated = np.array([info.get("width", np.nan), info.get("height", np.nan)], float)
    low, high = np.array(floor.bounds).reshape(2, 2)
    if not (np.abs(stated / (high - low) - 1) < 0.05).all():
        raise InputError(f"absurd scale: floor of {high - low} m, stated as {stated}")


def _classify_room(name: str) -> str:
    return next((kind for word, kind in MALL_KINDS.items() if word in name), "shop")


def _remove_duplicates(result: Sketch) -> None:
    """Remove duplicates: many rooms are in the file twice, and small ones lie within larger ones: the smaller one stays."""
    gone: set[int] = set()
    for i, j, share in find_overlaps(result.shapes):
        small, large = sorted((i, j), key=lambda k: (result.shapes[k].area, k))
        if gone & {small, large}:
            continue
        if result.shapes[small].area > 0.9 * result.shapes[large].area and share > 0.9:
            gone.add(large)
        else:
            rest = shapely.get_parts(result.shapes[large].difference(result.shapes[small]))
            result.shapes[large] = max(rest, key=lambda p: p.area)
    for name in ("names", "kinds", "shapes"):
        setattr(result, name, [v for k, v in enumerate(getattr(result, name)) if k not in gone])


def _add_halls(result: Sketch, floor: shapely.Geometry, closed: list[shapely.Polygon]) -> None:
    """Add what is left of the floor, and a door from each room to it."""
    rooms = list(result.shapes)
    rest = floor.difference(shapely.union_all([*rooms, *closed]))
    rest = rest.buffer(-NARROW_FRONT / 2, join_style="mitre").buffer(NARROW_FRONT / 2, join_style="mitre").intersection(rest)
    halls = [p for p in shapely.get_parts(rest) if p.geom_type == "Polygon" and p.area > 20]
    if not halls:
        raise InputError("no doors: the floor has no hall that rooms could open to")
    first = len(rooms)
    for hall in halls:
        result.add_room(f"hall {len(result.shapes)}", "hall", hall)
    for i, room in enumerate(rooms):
        shop = result.kinds[i] == "shop"
        for j in np.argsort(shapely.distance(np.array(halls), room)).tolist()[:3]:
            opening = place_door(room, halls[j], FRONT if shop else SHOP_DOOR, SHOP_REACH, None, "door")
            if opening is not None:
                result.add_opening(opening, (i, first + j))
                break
