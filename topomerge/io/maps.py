"""Read and write maps (`.tmap`), within limits."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from topomerge import archive
from topomerge.archive import ArrayHeader, convert_to_plain
from topomerge.errors import InputError
from topomerge.io.listing import convert_map_to_json, save_json
from topomerge.io.rooms_ply import save_rooms_ply
from topomerge.types import (
    AREA_DTYPE,
    EDGE_DTYPE,
    LANDMARK_DTYPE,
    LONGEST_VALUE,
    MOST_LANDMARKS,
    OLDER_EDGE_DTYPE,
    ROOM_DTYPE,
    ROOM_ODDS,
    STOREY_DTYPE,
    WINDOW_DTYPE,
    Array,
    Landmarks,
    TopometricMap,
    VoxelGrid,
    add_outline_odds,
    clean_landmarks,
    read_levelling,
)

# The largest buildings have about 1,000 rooms, the tallest 163 storeys.
ROOM_LIMIT, STOREY_LIMIT = 5_000, 200
ROOM_COLUMNS, TOTAL_COLUMNS = 50_000_000, 100_000_000  # of the grid, in the rectangle around a room's floor, and around each
CONNECTION_LIMIT = 30_000  # of edges, areas, narrows and windows each, however many rooms there are
EDGES_PER_ROOM, AREAS_PER_ROOM, WINDOWS_PER_ROOM = 20, 20, 100  # on average
ABOUT_LIMIT = 1 << 24  # bytes of what a map says about itself
STRINGS_LIMIT = 1 << 28  # bytes of the strings of its landmarks
PROPERTY_WIDTH = 64  # numbers of one property in a cell
CELL_ARRAYS = {"grid": ("room", "provenance"), "navigable": ("navigable_room", "navigable_area"), "free": ()}  # a row for each


def require_sane_counts(heads: Mapping[str, ArrayHeader]) -> None:
    """Refuse what the arrays of a map declare, before any of them is unpacked: tables longer than the cells can fill, and rows of
    cells that there are not.

    Raises:
        KeyError: an array is missing.
        ValueError: more rooms, edges, storeys, areas, narrows or windows than a building has; more or fewer rows of a property
            than cells; words that no map says.
    """
    rooms, areas = heads["rooms"].size, heads["areas"].size
    cells = heads["room"].size + heads["navigable_room"].size
    limits = {
        "rooms": (ROOM_LIMIT, ""),
        "storeys": (STOREY_LIMIT, ""),
        "edges": (min(EDGES_PER_ROOM * rooms, CONNECTION_LIMIT), f" ({EDGES_PER_ROOM} a room)"),
        "areas": (min(AREAS_PER_ROOM * rooms, CONNECTION_LIMIT), f" ({AREAS_PER_ROOM} a room)"),
        "narrows": (min(EDGES_PER_ROOM * areas, CONNECTION_LIMIT), f" ({EDGES_PER_ROOM} an area)"),
        "windows": (min(WINDOWS_PER_ROOM * rooms, CONNECTION_LIMIT), f" ({WINDOWS_PER_ROOM} a room)"),
        "landmarks": (MOST_LANDMARKS, ""),
    }
    for name, (limit, share) in limits.items():
        text = share if limit < CONNECTION_LIMIT else ""
        if name in heads and heads[name].size > limit:
            raise ValueError(f"declares {heads[name].size:,} {name}, more than {limit:,}{text}")
    if rooms > cells:
        raise ValueError(f"declares {rooms:,} rooms and has only {cells:,} cells")
    if heads["about"].size * heads["about"].dtype.itemsize > ABOUT_LIMIT:
        raise ValueError(f"says more than {ABOUT_LIMIT >> 20} MB about itself")
    if "landmarks" in heads and heads["landmark_strings"].size * heads["landmark_strings"].dtype.itemsize > STRINGS_LIMIT:
        raise ValueError(f"has more than {STRINGS_LIMIT >> 20} MB of strings of landmarks")
    _require_rows(heads)


def _require_rows(heads: Mapping[str, ArrayHeader]) -> None:
    """Refuse arrays that have not one row for each cell, or more numbers in one than any property has."""
    for grid, of_cells in CELL_ARRAYS.items():
        if f"{grid}_cells" not in heads:
            continue
        count = heads[f"{grid}_cells"].size
        named = [name for name in heads if name in of_cells or name.startswith(f"{grid}_property.")]
        for name in named:
            shape = heads[name].shape
            if shape[:1] != (count,):
                raise ValueError(f"{name} has the shape {shape} for {count:,} cells")
            if heads[name].size > PROPERTY_WIDTH * count:
                raise ValueError(f"{name} has {heads[name].size // max(count, 1):,} numbers a cell, more than {PROPERTY_WIDTH}")


def require_compact_rooms(navigable: VoxelGrid, room: Array, rooms: int) -> None:
    """Refuse rooms whose floor is strewn over the map: what draws a room goes through the rectangle around it.

    Raises:
        ValueError: the rectangles have more columns than those of a building.
    """
    inside = (room >= 0) & (room < rooms)
    low, high = np.full((rooms, 2), np.iinfo(np.int64).max), np.full((rooms, 2), -1)
    order = np.argsort(room[inside].astype(np.uint16), kind="stable")  # below ROOM_LIMIT
    of, columns = room[inside][order], navigable.cells[inside, :2][order].astype(np.int64)
    starts = np.flatnonzero(np.diff(of, prepend=-1))
    if len(starts):
        low[of[starts]] = np.minimum.reduceat(columns, starts, axis=0)
        high[of[starts]] = np.maximum.reduceat(columns, starts, axis=0)
    sizes = np.where(high[:, 0] >= 0, np.prod(np.where(high >= 0, high - low + 1, 0), axis=1, dtype=np.float64), 0.0)
    if sizes.max(initial=0) > ROOM_COLUMNS or sizes.sum() > TOTAL_COLUMNS:
        raise ValueError(f"has rooms that span {sizes.sum():.2g} columns of cells, the largest {sizes.max():.2g}")


__all__ = ["TMAP_FORMAT", "convert_map_to_json", "load_map", "save_json", "save_map", "save_rooms_ply"]
TMAP_FORMAT = 3  # raised with landmarks
READ_FORMATS = (2, 3)
KIND = "map of topomerge (.tmap)"
COORDINATE_LIMIT = 1e9  # m, either way: beyond, float64 is coarser than 0.1 micrometres
AREA_LIMIT = 1e12  # m2, and m3 for volumes
SHORTEST_CELL_EDGE, LONGEST_CELL_EDGE = 0.001, 10.0  # m
OLDER_ROOMS = np.dtype([(n, ROOM_DTYPE[n]) for n in ROOM_DTYPE.names or () if n not in ROOM_ODDS])  # before there were odds
# Columns of tables that are nan where nothing was seen.
UNSEEN = {"storeys": ("ceiling",), "windows": ("sill", "head")}
UNREAD = {"fixtures"}  # niches and cupboards, in files of earlier versions
WARNING_LIMIT, LONGEST_WARNING = 20, 500  # warnings of a map, characters of one


def save_map(map: TopometricMap, path: str | Path) -> None:
    """Write a map. The same map gives the same bytes; `load_map` gives back an equal one.

    Tuples in the parameters come back as lists.

    Raises:
        InputError: the path can't be written, or a frame or a number of landmarks is one that `load_map` refuses.
        ValueError: a property of a grid holds Python objects.
    """
    for name, grid in (("grid", map.grid), ("navigable", map.navigable)):
        try:
            _require_usable_frame(name, grid.origin, grid.edge)
        except ValueError as error:
            raise InputError(f"{path}: not written ({error}); check --unit, --scale and --voxel-size") from error
    arrays = _pack("grid", map.grid) | {"room": map.room.astype("<i4")}
    arrays |= _pack("navigable", map.navigable) | {"navigable_room": map.navigable_room.astype("<i4")}
    arrays |= {"rooms": map.rooms, "edges": map.edges, "storeys": map.storeys, "areas": map.areas, "narrows": map.narrows}
    arrays["navigable_area"] = np.asarray(map.navigable_area, "<i4")
    if map.free is not None:
        arrays |= _pack("free", map.free)
    if len(map.windows):
        arrays["windows"] = map.windows
    if len(map.landmarks) > MOST_LANDMARKS:
        raise InputError(f"{path}: not written ({len(map.landmarks):,} landmarks, more than {MOST_LANDMARKS:,}); take fewer")
    if len(map.landmarks):
        arrays |= _pack_landmarks(clean_landmarks(map.landmarks))
    if map.provenance is not None:
        arrays["provenance"] = map.provenance.astype("<u4")
    about = {
        "source": map.source,
        "parameters": convert_to_plain(dict(map.parameters)),
        "seconds": convert_to_plain(dict(map.seconds)),
        "warnings": list(map.warnings),
        "arrays": list(arrays),
    }
    arrays = {"format": np.array(TMAP_FORMAT, "<i4"), "about": np.array(json.dumps(about).encode()), **arrays}
    archive.write(arrays, path)


def load_map(path: str | Path) -> TopometricMap:
    """Read a map that `save_map` wrote.

    Args:
        path: of the `.tmap`.

    Raises:
        InputError: no such file, not a map, of a newer format, damaged or cut off; more rooms or edges than a building has, a
            number in a table that is none, a frame that no building has.
    """
    heads = archive.read_array_headers(path, KIND)
    _check_format(path, heads)
    with _convert_map_errors(path):
        require_sane_counts(heads)  # before anything is unpacked
    arrays = archive.read(path, KIND, [name for name in heads if name not in UNREAD])
    with _convert_map_errors(path):
        return _build_map(arrays)


def _check_format(path: str | Path, heads: Mapping[str, ArrayHeader]) -> None:
    """Refuse what is no map, or one of another format."""
    if "format" not in heads or "about" not in heads:
        raise InputError(f"{path}: is not a {KIND}: make one with `topomerge extract SCAN -o A.tmap`")
    number: Any = archive.read(path, KIND, ["format"])["format"] if heads["format"].shape == () else heads["format"]
    if number.shape != () or number.dtype.kind not in "iu" or int(number) not in READ_FORMATS:
        older = number.shape == () and number.dtype.kind in "iu" and int(number) < TMAP_FORMAT
        advice = "make it again with `topomerge extract`" if older else "update topomerge"
        raise InputError(f"{path}: is of format {number}, and this topomerge reads format {TMAP_FORMAT}; {advice}")


@contextmanager
def _convert_map_errors(path: str | Path) -> Iterator[None]:
    """Turn whatever is wrong with the arrays of a map, within, into one line about its file."""
    try:
        yield
    except KeyError as error:
        raise InputError(f"{path}: damaged ({error} is missing); make it again") from error
    except (ValueError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        reason = " ".join(str(error).split())[:120]
        raise InputError(f"{path}: damaged ({reason}); make it again") from error


def _pack(name: str, grid: VoxelGrid) -> dict[str, Array]:
    """Return a grid as arrays. Differences of neighbouring Morton codes are mostly 1, so they compress to about a bit."""
    deltas = np.diff(grid.codes, prepend=np.zeros(1, np.uint64))
    small = len(deltas) == 0 or deltas.max() < 1 << 32
    packed = {
        f"{name}_cells": deltas.astype("<u4" if small else "<u8"),
        f"{name}_frame": np.array([*grid.origin, grid.edge], "<f8"),
        f"{name}_shape": np.array(grid.shape, "<i4"),
    }
    for key in sorted(grid.properties):
        values = np.asarray(grid.properties[key])
        if values.dtype.kind not in "biuf":
            raise ValueError(f"property {key!r} has type {values.dtype}; only numbers can be saved")
        packed[f"{name}_property.{key}"] = values
    return packed


def _unpack(arrays: dict[str, Array], name: str) -> VoxelGrid:
    deltas, frame = _check_array(arrays, f"{name}_cells", "u", 1), _check_array(arrays, f"{name}_frame", "f", 1)
    shape = _check_array(arrays, f"{name}_shape", "i", 1)
    if frame.shape != (4,) or shape.shape != (3,) or not np.isfinite(frame).all():
        raise ValueError(f"{name} has no proper frame")
    _require_usable_frame(name, frame[:3], float(frame[3]))
    codes = np.cumsum(deltas, dtype=np.uint64)
    if len(codes) and (int(codes[-1]) >> 63 or not (codes[1:] > codes[:-1]).all()):
        raise ValueError(f"the cells of {name} are not in order")
    start = f"{name}_property."
    properties = {key.removeprefix(start): values for key, values in arrays.items() if key.startswith(start)}
    offset = properties.get("offset")
    if offset is not None and (offset.dtype != np.uint8 or offset.shape != (len(codes), 3)):
        raise ValueError(f"the points of the cells of {name} have no proper offsets")
    x, y, z = shape.tolist()
    return VoxelGrid.from_codes(codes, frame[:3].copy(), float(frame[3]), (x, y, z), properties)


def _require_usable_frame(name: str, origin: Array, edge: float) -> None:
    if (np.abs(origin) > COORDINATE_LIMIT).any():
        raise ValueError(f"{name} has its origin beyond {COORDINATE_LIMIT:.0e} m")
    if not SHORTEST_CELL_EDGE * (1 - 1e-6) <= edge <= LONGEST_CELL_EDGE * (1 + 1e-6):
        raise ValueError(f"{name} has cells of {edge:.4g} m, not of {SHORTEST_CELL_EDGE} to {LONGEST_CELL_EDGE:g} m")


def _check_array(arrays: dict[str, Array], name: str, kind: str, dimensions: int) -> Array:
    array = arrays[name]
    if array.dtype.kind != kind or array.ndim != dimensions:
        raise ValueError(f"{name} has type {array.dtype} and shape {array.shape}")
    return array


def _check_table(arrays: dict[str, Array], name: str, dtype: np.dtype[Any]) -> Array:
    table = _check_array(arrays, name, "V", 1)
    if table.dtype != dtype:
        raise ValueError(f"{name} has other columns")
    for column in (c for c in dtype.names or () if dtype[c].base.kind == "f"):
        values = table[column]
        if column in UNSEEN.get(name, ()):
            values = values[~np.isnan(values)]
        limit = AREA_LIMIT if column in ("area", "volume") else COORDINATE_LIMIT
        if not (np.abs(values) <= limit).all():  # nan is not, either
            raise ValueError(f"{name} has a {column} that is no number or beyond {limit:.0e}")
        if column == "area" and (values < 0).any():
            raise ValueError(f"{name} has an area below 0")
        if column == "confidence" and not ((values >= 0) & (values <= 1)).all():
            raise ValueError(f"{name} has a confidence that is not from 0 to 1")
    return table.astype(dtype, copy=False)


def _widen_table(table: Array, dtype: np.dtype[Any]) -> Array:
    """Return a table with more columns, 0 in the new ones."""
    out = np.zeros(len(table), dtype)
    for name in table.dtype.names or ():
        out[name] = table[name]
    return out


def _read_rooms(arrays: dict[str, Array]) -> Array:
    """Return the table of rooms. Files of earlier versions say no probabilities: there a glimpsed room was not entered."""
    if arrays["rooms"].dtype == OLDER_ROOMS:
        return add_outline_odds(_widen_table(_check_table(arrays, "rooms", OLDER_ROOMS), ROOM_DTYPE))
    rooms = _check_table(arrays, "rooms", ROOM_DTYPE)
    for name in ROOM_ODDS:
        if not ((rooms[name] >= 0) & (rooms[name] <= 1)).all():
            raise ValueError(f"rooms has a {name} that is not from 0 to 1")
    return rooms


def _read_edges(arrays: dict[str, Array], name: str) -> Array:
    """Return a table of edges. Files of earlier versions do not tell half-open doors from open ones."""
    older = arrays[name].dtype == OLDER_EDGE_DTYPE
    return _widen_table(_check_table(arrays, name, OLDER_EDGE_DTYPE if older else EDGE_DTYPE), EDGE_DTYPE)


def _read_windows(arrays: dict[str, Array]) -> Array:
    """Return the table of windows. Files of earlier versions have none."""
    windows = _check_table(arrays, "windows", WINDOW_DTYPE) if "windows" in arrays else np.zeros(0, WINDOW_DTYPE)
    if (windows["width"] <= 0).any() or (windows["head"] <= windows["sill"]).any():
        raise ValueError("windows has one that is not wide or not high")
    return windows


def _pack_landmarks(landmarks: Landmarks) -> dict[str, Array]:
    """Return landmarks as arrays: their table, and the strings that it counts as JSON."""
    strings = json.dumps([landmarks.values, landmarks.sources], separators=(",", ":")).encode()
    return {"landmarks": landmarks.table, "landmark_strings": np.frombuffer(strings, np.uint8)}


def _read_landmarks(arrays: dict[str, Array]) -> Landmarks:
    """Return the landmarks. Files of earlier versions have none.

    Raises:
        ValueError: a string, a position or another number is none that `clean_landmarks` leaves.
    """
    if "landmarks" not in arrays:
        return Landmarks()
    table = _check_array(arrays, "landmarks", "V", 1)
    if table.dtype != LANDMARK_DTYPE:
        raise ValueError("landmarks has other columns")
    strings = json.loads(_check_array(arrays, "landmark_strings", "u", 1).tobytes())
    if not isinstance(strings, list) or [type(part) for part in strings] != [list, list]:
        raise ValueError("landmarks have no strings")
    values, sources = (tuple(part) for part in strings)
    if max(len(values), len(sources)) > MOST_LANDMARKS:
        raise ValueError(f"has more than {MOST_LANDMARKS:,} strings of landmarks")
    if not all(isinstance(value, str) and len(value) <= LONGEST_VALUE and value.isprintable() for value in (*values, *sources)):
        raise ValueError(f"has a string of a landmark that can't be printed or is longer than {LONGEST_VALUE} characters")
    known = np.isfinite(table["position"])
    if (
        not ((np.abs(table["position"]) <= COORDINATE_LIMIT) | ~known.any(axis=1, keepdims=True)).all()
        or np.isinf(table["position"]).any()
    ):
        raise ValueError(f"landmarks has a position that is no number or beyond {COORDINATE_LIMIT:.0e}")
    for column in ("sigma", "number", "time"):
        if np.isinf(table[column]).any() or ((table[column] < 0).any() and column == "sigma"):
            raise ValueError(f"landmarks has a {column} that is no number")
    if not ((table["confidence"] >= 0) & (table["confidence"] <= 1)).all():
        raise ValueError("landmarks has a confidence that is not from 0 to 1")
    return Landmarks(table, values, sources)


def _limit_warnings(messages: list[Any]) -> tuple[str, ...]:
    """Return the first warnings, each one line of bounded length, and how many more there are."""
    surplus = len(messages) - WARNING_LIMIT
    if surplus <= 1:  # one more takes no more room than the line that counts it, which may be that one
        surplus = 0
    lines = []
    for message in messages[: len(messages) - surplus]:
        text = str(message)
        cut = text if len(text) <= LONGEST_WARNING else text[: LONGEST_WARNING - 1] + "…"
        lines.append(" ".join(cut.splitlines()))
    return (*lines, f"and {surplus:,} more warnings") if surplus else tuple(lines)


def _build_map(arrays: dict[str, Array]) -> TopometricMap:
    about = json.loads(arrays["about"].item())
    if missing := set(about["arrays"]) - set(arrays) - UNREAD:
        raise KeyError(min(missing))
    provenance = _check_array(arrays, "provenance", "u", 1).astype(np.uint32) if "provenance" in arrays else None
    edges, narrows = _read_edges(arrays, "edges"), _read_edges(arrays, "narrows")
    for table in (edges, narrows):
        table["kind"].tolist()  # fails here, not later, where the text is none
    navigable, navigable_room = _unpack(arrays, "navigable"), _check_array(arrays, "navigable_room", "i", 1).astype(np.int32)
    if len(navigable) == len(navigable_room):  # else the map itself refuses them
        require_compact_rooms(navigable, navigable_room, arrays["rooms"].size)
    read_levelling(about["parameters"])  # fails here, not where points are moved by it
    return TopometricMap(
        grid=_unpack(arrays, "grid"),
        room=_check_array(arrays, "room", "i", 1).astype(np.int32),
        navigable=navigable,
        navigable_room=navigable_room,
        rooms=_read_rooms(arrays),
        edges=edges,
        storeys=_check_table(arrays, "storeys", STOREY_DTYPE),
        areas=_check_table(arrays, "areas", AREA_DTYPE),
        navigable_area=_check_array(arrays, "navigable_area", "i", 1).astype(np.int32),
        narrows=narrows,
        windows=_read_windows(arrays),
        landmarks=_read_landmarks(arrays),
        free=_unpack(arrays, "free") if "free_cells" in arrays else None,
        provenance=provenance,
        source=str(about["source"]),
        parameters=dict(about["parameters"]),
        seconds={str(step): float(s) for step, s in about["seconds"].items()},
        warnings=_limit_warnings(list(about["warnings"])),
    )


def load_landmarks(path: str | Path) -> tuple[Landmarks, Array]:
    """Read the landmarks of a map and its rooms' storeys, (R,) int32, without its cells.

    Raises:
        InputError: as `load_map`, as far as the tables of rooms and landmarks show it.
    """
    _check_format(path, (heads := archive.read_array_headers(path, KIND)))
    arrays = archive.read(path, KIND, ["rooms", "landmarks", "landmark_strings"])
    with _convert_map_errors(path):
        require_sane_counts(heads)
        rooms, landmarks = _read_rooms(arrays), _read_landmarks(arrays)
        if int(landmarks.table["room"].max(initial=-1)) >= len(rooms):
            raise ValueError("a landmark's room does not exist")
    return landmarks, rooms["storey"]
