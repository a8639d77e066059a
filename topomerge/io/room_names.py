"""Landmarks and names of rooms out of the files of other programs, for `topomerge mark --from`.

Tables of landmarks, the JSON of a map, GeoJSON (landmarks, names of polygons), IndoorGML (names of cells), scene graphs (objects,
names of rooms) and maps of vacuum robots (names of rooms). Positions must be in metres, in the frame of the map.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as xml

import numpy as np
import shapely

from topomerge.errors import InputError
from topomerge.io import valetudo
from topomerge.io.json_map import LARGEST_MAP_JSON, find_graph_landmarks, is_scene_graph, load_json_map
from topomerge.io.landmarks import parse_landmarks, read_landmark_file
from topomerge.io.piece import build_damage_error
from topomerge.types import LANDMARK_KINDS, Landmarks

NAME_KEYS = ("name", "ref", "number", "long_name")  # of a polygon's properties, in this order
STOREY_KEYS = ("storey", "level")
UNNAMED = re.compile(r"(room|wall|door|opening|stairs|ramp|window) [\d-]+|")  # what topomerge calls things without a name
XML_SUFFIXES = (".gml", ".indoorgml", ".xml")
DEGREES_ACROSS = 0.5  # of coordinates in degrees, at most
GIVEN_ABOVE_FLOOR = 1.0  # m, of a name that has the height of a floor


def load_landmark_source(path: Path) -> Landmarks:
    """Read what a file says of signs, tags, objects and names; the name of the file is their source.

    Raises:
        InputError: it can't be read, is of no such kind, or holds none.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file; check the path")
    suffix = path.suffix.lower()
    if suffix == ".csv":
        found = read_landmark_file(path)
    elif suffix in XML_SUFFIXES:
        found = parse_landmarks(_iter_cells(path), path.name)
    elif suffix in (".json", ".geojson"):
        found = _find_in_json(path, load_json_map(path))
    else:
        found = _read_scan(path)
    if not len(found):
        raise InputError(f"{path}: holds no landmarks and no names of rooms; give another file")
    return found


def _read_scan(path: Path) -> Landmarks:
    """Read what comes with the points of a scan or a model: spaces of IFC, labels of RTAB-Map, objects of USDZ ..."""
    from topomerge.io.points import list_suffixes, read_chunks

    if path.suffix.lower() not in list_suffixes():
        known = "a .csv, .json, .geojson or .gml, or what `topomerge extract` reads"
        raise InputError(f"{path}: no landmarks can be read of it; give {known} (docs/landmarks.md)")
    found = [chunk.landmarks for chunk in read_chunks(path)][-1]  # they come with the last
    return Landmarks() if found is None else found


def _find_in_json(path: Path, about: Any) -> Landmarks:
    if valetudo.is_robot_map(about):
        return valetudo.find_segment_names(valetudo.parse_robot_map(path, about), path.name)
    if is_scene_graph(about):
        return find_graph_landmarks(path, about)
    try:
        if about["type"] == "FeatureCollection":
            return parse_landmarks(_iter_features(path, about), path.name)
    except (KeyError, TypeError, ValueError, AttributeError, IndexError, shapely.errors.ShapelyError) as error:
        if isinstance(error, InputError):
            raise
        if not isinstance(about, dict) or not isinstance(about.get("landmarks"), list):
            raise build_damage_error(path, "a file with landmarks", error) from error
    return parse_landmarks(about["landmarks"], path.name)


def _iter_features(path: Path, about: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield the rows of landmarks: features that are some, and the names of polygons that these do not say."""
    shapes = [(feature.get("properties") or {}, feature.get("geometry")) for feature in about["features"]]
    own = [properties for properties, _ in shapes if properties.get("kind") == "landmark"]
    yield from ({**row, "kind": row["of"]} for row in own)
    given = {(row.get("room"), row.get("value")) for row in own}
    named = []
    for properties, geometry in shapes:
        name = next((str(properties[key]) for key in NAME_KEYS if properties.get(key)), "")
        if (
            geometry
            and name
            and geometry.get("type") in ("Polygon", "MultiPolygon")
            and (properties.get("room"), name) not in given
        ):
            named.append((name, properties, shapely.geometry.shape(geometry)))
    if named:
        _check_metres(path, about, np.array([shape.bounds for _, _, shape in named]))
    for name, properties, shape in named:
        inside = shape.representative_point()
        height = shapely.get_coordinates(shape, include_z=True)[:, 2]
        z = float(height.min()) + GIVEN_ABOVE_FLOOR if np.isfinite(height).all() else GIVEN_ABOVE_FLOOR
        storey = next((properties[key] for key in STOREY_KEYS if isinstance(properties.get(key), int)), None)
        storey = storey if storey is not None and storey >= 0 else None
        yield {"kind": "name", "value": name, "position": (inside.x, inside.y, z), "storey": storey}


def _check_metres(path: Path, about: Mapping[str, Any], bounds: Any) -> None:
    """Refuse degrees: RFC 7946 has no others, but plans are written in metres all the same."""
    low, high = bounds[:, :2].min(axis=0), bounds[:, 2:].max(axis=0)
    own = about.get("topomerge")
    degrees = isinstance(own, dict) and "origin" in own
    if own is None and about.get("crs", "") is not None:
        degrees = bool((high - low).max() < DEGREES_ACROSS and np.abs(high).max() <= 180)
    if degrees:
        raise InputError(f"{path}: is in degrees of longitude and latitude; export it in metres, in the frame of the map")


def _iter_cells(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the rows of the landmarks of IndoorGML (states of the layer that topomerge writes), and of the names of cells that
    they do not say."""
    if path.stat().st_size > LARGEST_MAP_JSON:
        raise InputError(f"{path}: has more than {LARGEST_MAP_JSON >> 20} MB, too many for IndoorGML; give a part of it")
    text = path.read_bytes()
    if b"<!DOCTYPE" in text or b"<!ENTITY" in text:  # entities may grow without end
        raise InputError(f"{path}: declares entities, which IndoorGML has no use for; export it again")
    try:
        root = xml.fromstring(text)
        states = [state for state in root.iter() if _get_name(state) == "State"]
        points = {_get_id(state): _find_middle(state) for state in states}
        own = [row for state in states if (row := _read_landmark(state))]
        yield from own
        given = {(f"C{row.get('room')}", row["value"]) for row in own}
        for cell in root.iter():
            row = _read_cell(cell, points) if _get_name(cell).endswith("Space") else None
            if row and (_get_id(cell), row["value"]) not in given:
                yield row
    except (xml.ParseError, ValueError, RecursionError, LookupError) as error:
        raise build_damage_error(path, "IndoorGML", error) from error


def _read_landmark(state: Any) -> dict[str, Any] | None:
    texts = {_get_name(part): part.text or "" for part in state}
    fields = dict(re.findall(r'(\w+)="([^"]*)"', texts.get("description", "")))
    if fields.get("kind") not in LANDMARK_KINDS:
        return None
    return {**fields, "value": texts.get("name", "").strip(), "position": _find_middle(state)}


def _read_cell(cell: Any, points: Mapping[str, Any]) -> dict[str, Any] | None:
    name, properties, at = "", "", None
    for part in cell:
        if _get_name(part) == "name":
            name = (part.text or "").strip()
        elif _get_name(part) == "description":
            properties = part.text or ""
        elif _get_name(part) == "duality":
            at = points.get(next(iter(part.attrib.values()), "").removeprefix("#"))
    if UNNAMED.fullmatch(name):
        return None
    at = _find_middle(cell) if at is None else at
    storey = re.search(r'storey="(\d{1,3})"', properties)
    position = None if at is None else (float(at[0]), float(at[1]), float(at[2]) + GIVEN_ABOVE_FLOOR)
    return {"kind": "name", "value": name, "position": position, "storey": int(storey[1]) if storey else None}


def _get_name(element: Any) -> str:
    return str(element.tag).rpartition("}")[2]


def _get_id(element: Any) -> str:
    return next((str(value) for key, value in element.attrib.items() if key.rpartition("}")[2] == "id"), "")


def _find_middle(element: Any) -> Any:
    """Return the mean (3,) of the positions below an element: the middle from above, at the lowest one; None without any."""
    numbers = [[float(v) for v in (pos.text or "").split()] for pos in element.iter() if _get_name(pos) == "pos"]
    places = np.array([[*row, 0.0][:3] for row in numbers if len(row) in (2, 3)])
    return None if not len(places) else np.array([*places[:, :2].mean(axis=0), places[:, 2].min()])
