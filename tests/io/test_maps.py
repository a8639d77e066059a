"""Maps in files: what is written comes back, and what is damaged is told apart."""

from __future__ import annotations

import io
import json
import os
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.scenes_map import building, same
from topomerge.errors import InputError
from topomerge.io import archive
from topomerge.io.maps import OLDER_ROOMS, convert_map_to_json, load_map, save_json, save_map, save_rooms_ply
from topomerge.types import EDGE_DTYPE, OLDER_EDGE_DTYPE, ROOM_DTYPE, ROOM_ODDS, STOREY_DTYPE, Array, TopometricMap, VoxelGrid


@pytest.fixture(scope="module")
def scene() -> TopometricMap:
    return building(2, 2)


@pytest.fixture(scope="module")
def saved(scene: TopometricMap, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("maps") / "a.tmap"
    save_map(scene, path)
    return path


def nothing() -> TopometricMap:
    grid = VoxelGrid.from_cells(np.zeros((0, 3), np.int32))
    none = np.zeros(0, np.int32)
    tables = [np.zeros(0, dtype) for dtype in (ROOM_DTYPE, EDGE_DTYPE, STOREY_DTYPE)]
    return TopometricMap(grid, none, grid, none, *tables)


def test_round_trip(scene: TopometricMap, saved: Path) -> None:
    back = load_map(saved)
    assert same(scene, back)
    back.room[0] = -1  # arrays can be written to


def test_round_trip_with_free_space_and_provenance(scene: TopometricMap, tmp_path: Path) -> None:
    free = VoxelGrid.from_cells(np.array([[5, 5, 5], [200, 3, 3], [1 << 20, 7, 9]]), np.array([-5.5, 1e6, 0.1]), 0.2)
    seen = np.arange(len(scene.grid), dtype=np.uint32) * 77777
    scene = replace(scene, free=free, provenance=seen)
    save_map(scene, tmp_path / "b.tmap")
    assert same(scene, load_map(tmp_path / "b.tmap"))


def test_round_trip_of_an_empty_map(tmp_path: Path) -> None:
    save_map(nothing(), tmp_path / "empty.tmap")
    assert same(nothing(), load_map(tmp_path / "empty.tmap"))


def test_same_map_same_bytes(scene: TopometricMap, saved: Path, tmp_path: Path) -> None:
    save_map(load_map(saved), tmp_path / "again.tmap")
    assert (tmp_path / "again.tmap").read_bytes() == saved.read_bytes()


def test_numpy_opens_it_and_it_is_small(scene: TopometricMap, saved: Path) -> None:
    with np.load(saved, allow_pickle=False) as arrays:
        assert int(arrays["format"]) == 3
        assert json.loads(arrays["about"].item())["source"] == "building.ply"
        assert (np.cumsum(arrays["grid_cells"], dtype=np.uint64) == scene.grid.codes).all()
    assert saved.stat().st_size < 0.1 * scene.grid.cells.nbytes


def test_properties_must_be_numbers(scene: TopometricMap, tmp_path: Path) -> None:
    odd = scene.grid.assign_properties(name=np.array(["a"] * len(scene.grid), object))
    with pytest.raises(ValueError, match="only numbers"):
        save_map(replace(scene, grid=odd), tmp_path / "odd.tmap")
    assert not list(tmp_path.iterdir())


def refused(path: Path, match: str = ".") -> None:
    with pytest.raises(InputError, match=match) as caught:
        load_map(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_truncated_at_any_length(saved: Path, tmp_path: Path) -> None:
    content = saved.read_bytes()
    bad = tmp_path / "bad.tmap"
    for length in {*range(0, len(content), len(content) // 60), 1, 2, 3, 4, len(content) - 1, len(content) - 22}:
        bad.write_bytes(content[:length])
        refused(bad)


def test_flipped_bytes(tmp_path: Path) -> None:
    small = building(1, 1)
    save_map(small, tmp_path / "small.tmap")
    content = (tmp_path / "small.tmap").read_bytes()
    random = np.random.default_rng(2)
    refusals = 0
    for _ in range(400):
        # Half of the flips hit the directory at the end, where a zip keeps its sizes and offsets.
        span = (0, len(content)) if random.random() < 0.5 else (len(content) - 1200, len(content))
        changed = bytearray(content)
        for at in random.integers(*span, size=random.integers(1, 4)):
            changed[at] ^= int(random.integers(1, 256))
        (tmp_path / "bad.tmap").write_bytes(changed)
        try:
            assert same(load_map(tmp_path / "bad.tmap"), small)
        except InputError:
            refusals += 1
    assert refusals > 200


def rewritten(saved: Path, path: Path, **changes: Array | None) -> Path:
    """The same archive with some arrays changed or (None) left out."""
    arrays: dict[str, Array] = {**archive.read(saved), **changes}  # type: ignore[dict-item]
    archive.write({name: array for name, array in arrays.items() if array is not None}, path)
    return path


def test_other_formats_and_missing_arrays(saved: Path, tmp_path: Path) -> None:
    refused(rewritten(saved, tmp_path / "a", format=np.array(99)), "format 99")
    refused(rewritten(saved, tmp_path / "b", format=np.array("one")), "format")
    refused(rewritten(saved, tmp_path / "c", room=None), "'room' is missing")
    refused(rewritten(saved, tmp_path / "d", format=None), "is not a map")
    refused(rewritten(saved, tmp_path / "e", **{"grid_property.count": None}), "count' is missing")


def test_contents_that_contradict_each_other(saved: Path, tmp_path: Path) -> None:
    good = archive.read(saved)
    far = good["grid_cells"].astype(np.uint64)
    far[5] = 1 << 63
    labels = np.full_like(good["room"], 999)
    bad: dict[str, dict[str, Array]] = {
        "order": {"grid_cells": np.zeros_like(good["grid_cells"])},
        "wrapped": {"grid_cells": far},
        "labels": {"room": labels},
        "frame": {"grid_frame": np.array([np.nan, 0, 0, 0.1])},
        "edge": {"grid_frame": np.array([0, 0, 0, -0.1])},
        "shape": {"grid_shape": np.array([1, 1, 1], np.int32)},
        "float": {"grid_cells": good["grid_cells"].astype(float)},
        "table": {"rooms": good["storeys"]},
        "json": {"about": np.array(b"{")},
        "list": {"about": np.array(b"[]")},
        "deep": {"about": np.array(b"[" * 100_000)},
        "number": {"about": np.array(3)},
        "text": {"edges": np.frombuffer(b"\xff" * good["edges"].nbytes, good["edges"].dtype)},
    }
    for name, change in bad.items():
        refused(rewritten(saved, tmp_path / name, **change), "damaged")


def test_offsets_of_points_come_back_and_are_checked(saved: Path, tmp_path: Path) -> None:
    map = load_map(saved)
    offset = np.random.default_rng(0).integers(0, 256, (len(map.grid), 3)).astype(np.uint8)
    path = tmp_path / "a.tmap"
    save_map(replace(map, grid=map.grid.assign_properties(offset=offset)), path)
    assert (load_map(path).grid.properties["offset"] == offset).all()
    for name, wrong in (("flat", offset[:, 0]), ("float", offset.astype(float)), ("wide", np.hstack([offset, offset]))):
        refused(rewritten(path, tmp_path / name, **{"grid_property.offset": wrong}), "no proper offsets")


@pytest.mark.parametrize(("name", "rows", "words"), [
    ("rooms", 20_000, "20,000 rooms, more than 5,000"), ("edges", 100_000, "100,000 edges, more than 200 .20 a room"),
    ("storeys", 1_001, "1,001 storeys"), ("areas", 10_000, "10,000 areas, more than"),
])  # fmt: skip
def test_more_declared_than_a_building_has(name: str, rows: int, words: str, saved: Path, tmp_path: Path) -> None:
    table = archive.read(saved)[name]
    table = table if len(table) else np.zeros(1, table.dtype)
    refused(rewritten(saved, tmp_path / "a.tmap", **{name: np.resize(table, rows)}), words)


def test_more_rooms_than_cells(tmp_path: Path) -> None:
    rooms = np.zeros(30, ROOM_DTYPE)
    save_map(replace(nothing(), rooms=rooms, storeys=np.zeros(1, STOREY_DTYPE)), tmp_path / "a.tmap")
    refused(tmp_path / "a.tmap", "30 rooms and has only 0 cells")


@pytest.mark.parametrize("value", [np.nan, np.inf, -1e300])
@pytest.mark.parametrize(("name", "column"), [
    ("rooms", "centroid"), ("rooms", "area"), ("edges", "centre"), ("edges", "width"), ("edges", "confidence"),
    ("storeys", "floor"),
])  # fmt: skip
def test_tables_hold_finite_numbers(name: str, column: str, value: float, saved: Path, tmp_path: Path) -> None:
    table = archive.read(saved)[name]
    table[column][0] = value
    refused(rewritten(saved, tmp_path / "a.tmap", **{name: table}), f"{name} has a {column} that is no number")


def test_a_ceiling_may_be_unseen_but_not_infinite(saved: Path, tmp_path: Path) -> None:
    storeys = archive.read(saved)["storeys"]
    storeys["ceiling"] = np.nan
    assert np.isnan(load_map(rewritten(saved, tmp_path / "a.tmap", storeys=storeys)).storeys["ceiling"]).all()
    storeys["ceiling"] = np.inf
    refused(rewritten(saved, tmp_path / "b.tmap", storeys=storeys), "ceiling")


@pytest.mark.parametrize(("frame", "words"), [
    ([1e300, 0, 0, 0.1], "origin beyond"), ([0, 0, -2e9, 0.1], "origin beyond"),
    ([0, 0, 0, 1e-4], "cells of 0.0001 m"), ([0, 0, 0, 1e12], r"cells of 1e\+12 m"),
])  # fmt: skip
@pytest.mark.parametrize("grid", ["grid", "navigable"])
def test_frames_that_no_building_has(grid: str, frame: list[float], words: str, saved: Path, tmp_path: Path) -> None:
    refused(rewritten(saved, tmp_path / "a.tmap", **{f"{grid}_frame": np.array(frame)}), words)


def test_a_map_that_could_not_be_loaded_is_not_written(scene: TopometricMap, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cells of 50 m"):
        save_map(replace(scene, grid=replace(scene.grid, edge=50.0)), tmp_path / "a.tmap")
    assert not list(tmp_path.iterdir())


def test_many_edges_of_many_rooms(saved: Path, tmp_path: Path) -> None:
    arrays = archive.read(saved)
    tables = {"rooms": np.resize(arrays["rooms"], 4_000), "edges": np.resize(arrays["edges"], 100_000)}
    refused(rewritten(saved, tmp_path / "a.tmap", **tables), "100,000 edges, more than 30,000")


def test_warnings_are_limited_in_number_and_length(scene: TopometricMap, tmp_path: Path) -> None:
    path = tmp_path / "a.tmap"
    save_map(replace(scene, warnings=("x\n" * 100_000, *("again",) * 99_999)), path)
    warnings = load_map(path).warnings
    assert len(warnings) == 21 and warnings[-1] == "and 99,980 more warnings"
    assert len(warnings[0]) <= 500 and "\n" not in warnings[0]
    save_map(load_map(path), path)
    assert load_map(path).warnings == warnings


def test_not_a_map(tmp_path: Path) -> None:
    refused(tmp_path / "absent.tmap", "no such file")
    refused(tmp_path, "folder")
    os.mkfifo(tmp_path / "pipe.tmap")
    refused(tmp_path / "pipe.tmap", "no regular file")
    for name, content in {"empty": b"", "text": b"ply\nformat ascii 1.0\n", "zip": b"PK\x05\x06" + bytes(18)}.items():
        (tmp_path / name).write_bytes(content)
        refused(tmp_path / name)
    with zipfile.ZipFile(tmp_path / "foreign.zip", "w") as foreign:
        foreign.writestr("readme.txt", "hello")
    refused(tmp_path / "foreign.zip", "is not a map")
    np.savez_compressed(tmp_path / "foreign.npz", points=np.zeros((3, 3)))
    refused(tmp_path / "foreign.npz", "is not a map")


def test_pickles_are_not_read(saved: Path, tmp_path: Path) -> None:
    np.savez(tmp_path / "pickle.npz", format=np.array(1), about=np.array([{"a": 1}], object))
    refused(tmp_path / "pickle.npz", "pickled")


def with_entry(path: Path, name: str, content: bytes) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as bomb:
        bomb.writestr(name, content)
    return path


def header(shape: tuple[int, ...], dtype: str = "<f8") -> bytes:
    buffer = io.BytesIO()
    np.lib.format.write_array_header_1_0(buffer, {"descr": dtype, "fortran_order": False, "shape": shape})
    return buffer.getvalue()


def test_absurd_sizes_take_no_memory(tmp_path: Path) -> None:
    import tracemalloc

    bomb = with_entry(tmp_path / "shape", "room.npy", header((10**15,)))
    huge = with_entry(tmp_path / "huge", "room.npy", header((10**30, 10**30)))
    negative = with_entry(tmp_path / "negative", "room.npy", header((-5,)))
    # An entry that claims 3 GB in the zip's directory and holds a few bytes.
    content = with_entry(tmp_path / "claim", "room.npy", header((375_000_000,))).read_bytes()
    size = len(header((375_000_000,))).to_bytes(4, "little")
    (tmp_path / "claim").write_bytes(content.replace(size, (3_000_000_000).to_bytes(4, "little")))
    tracemalloc.start()
    for path in (bomb, huge, negative, tmp_path / "claim"):
        refused(path)
    assert tracemalloc.get_traced_memory()[1] < 20_000_000
    tracemalloc.stop()


def test_json_fields_and_strictness(scene: TopometricMap, tmp_path: Path) -> None:
    save_json(scene, tmp_path / "a.json")

    def refuse(text: str) -> None:
        raise AssertionError(f"{text} is not JSON")

    listing = json.loads((tmp_path / "a.json").read_text(), parse_constant=refuse)
    assert listing == convert_map_to_json(scene)
    assert [listing[k] for k in ("format", "source", "voxel_size")] == [1, "building.ply", 0.1]
    room = listing["rooms"][1]
    assert list(room) == [
        "id", "storey", "centroid", "area", "height", "volume", "bounding_box", "cells",
        "completeness", "glimpsed", "confidence", "whole", "entered", "outside",
    ]  # fmt: skip
    assert room["area"] == 20.0 and room["id"] == 1 and room["glimpsed"] is False
    assert room["bounding_box"]["min"] == [2.1, 4.1, 0.5]
    edge = listing["edges"][0]
    assert edge["rooms"] == [0, 4] and edge["kind"] == "door"
    assert set(edge["door"]) == {"centre", "width", "height", "direction"}
    assert listing["storeys"][1]["ceiling"] is None
    assert listing["parameters"]["nothing"] is None
    assert list(listing["seconds"]) == ["read and voxelise", "rooms"]


def with_columns(table: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """A table with fewer columns."""
    older = np.zeros(len(table), dtype)
    for name in dtype.names or ():
        older[name] = table[name]
    return older


def test_maps_of_earlier_versions_open(saved: Path, scene: TopometricMap, tmp_path: Path) -> None:
    """Their tables of rooms say nothing of probabilities: what was mostly unseen was only looked into."""
    older = with_columns(archive.read(saved)["rooms"], OLDER_ROOMS)
    opened = load_map(rewritten(saved, tmp_path / "old.tmap", rooms=older)).rooms
    assert all((opened[name] == scene.rooms[name]).all() for name in OLDER_ROOMS.names or ())
    assert (opened["entered"] == ~opened["glimpsed"]).all() and (opened["entered"] == opened["whole"]).all()
    assert (opened["confidence"] == 1).all() and (opened["outside"] == 0).all()
    assert opened["glimpsed"].any() and not opened["glimpsed"].all()


def test_maps_that_tell_no_half_open_doors_open(saved: Path, scene: TopometricMap, tmp_path: Path) -> None:
    older = with_columns(archive.read(saved)["edges"], OLDER_EDGE_DTYPE)
    opened = load_map(rewritten(saved, tmp_path / "old.tmap", edges=older)).edges
    assert len(opened) == len(scene.edges) > 0 and not opened["half"].any()
    assert all((opened[name] == scene.edges[name]).all() for name in OLDER_EDGE_DTYPE.names or ())


def test_fixtures_of_earlier_versions_are_not_read(saved: Path, scene: TopometricMap, tmp_path: Path) -> None:
    columns = [("kind", "U8"), ("room", "i4"), ("centre", "f8", 3), *((n, "f8") for n in ("width", "depth", "bottom", "top"))]
    arrays = archive.read(saved, "map")
    about = json.loads(arrays["about"].item())
    about["arrays"].append("fixtures")
    arrays["about"] = np.array(json.dumps(about).encode())
    arrays["fixtures"] = np.array([("niche", 0, (1.0, 2.0, 0.0), 0.9, 0.1, 0.5, 2.0)] * 3, columns)
    archive.write(arrays, tmp_path / "older.tmap")
    assert same(load_map(tmp_path / "older.tmap"), scene)
    save_map(load_map(tmp_path / "older.tmap"), tmp_path / "again.tmap")
    assert (tmp_path / "again.tmap").read_bytes() == saved.read_bytes()


@pytest.mark.parametrize("name", ROOM_ODDS)
@pytest.mark.parametrize("value", [-0.01, 1.01, np.nan, np.inf])
def test_odds_that_are_none_are_refused(name: str, value: float, saved: Path, tmp_path: Path) -> None:
    rooms = archive.read(saved)["rooms"].copy()
    rooms[name][3] = value
    refused(rewritten(saved, tmp_path / "bad.tmap", rooms=rooms), name)


def test_json_of_odd_values(scene: TopometricMap, tmp_path: Path) -> None:
    odd = {"a": np.float32(0.5), "b": (1, np.int64(2)), "c": Path("x"), "d": {"e": np.inf}, "f": np.array([1, 2])}
    listing = convert_map_to_json(replace(scene, parameters=odd, source='q"\udcff.ply'))
    assert listing["parameters"] == {"a": 0.5, "b": [1, 2], "c": "x", "d": {"e": None}, "f": [1, 2]}
    save_json(replace(scene, source="q\udcff.ply"), tmp_path / "odd.json")
    save_map(replace(scene, parameters=odd, source="q\udcff.ply"), tmp_path / "odd.tmap")
    assert load_map(tmp_path / "odd.tmap").source == "q\udcff.ply"


def test_json_of_an_empty_map() -> None:
    listing = convert_map_to_json(nothing())
    assert listing["rooms"] == listing["edges"] == listing["storeys"] == []


@pytest.mark.parametrize("far", [0.0, 400_000.0])
def test_ply_opens_elsewhere(far: float, tmp_path: Path) -> None:
    o3d = pytest.importorskip("open3d", exc_type=ImportError)
    plyfile = pytest.importorskip("plyfile")
    scene = building(1, 1, origin=(2.0 + far, -3.0, 0.5))
    path = tmp_path / "rooms.ply"
    save_rooms_ply(scene, path)
    assert np.allclose(np.asarray(o3d.io.read_point_cloud(str(path)).points), scene.grid.compute_centroids(), atol=1e-5)
    ply = plyfile.PlyData.read(path)
    assert not ply.text and ply.byte_order == "<"
    vertex = ply["vertex"]
    assert vertex["x"].dtype.itemsize == (8 if far else 4)
    assert (vertex["room"] == scene.room).all() and vertex["room"].min() == -1
    assert (vertex["storey"] == scene.find_cell_storeys()).all()
    colours = {tuple(v) for v in np.stack([vertex[c] for c in ("red", "green", "blue")], axis=1)[scene.room >= 0]}
    assert len(colours) == len(scene.rooms)


def test_ply_of_an_empty_map(tmp_path: Path) -> None:
    save_rooms_ply(nothing(), tmp_path / "empty.ply")
    assert b"element vertex 0\n" in (tmp_path / "empty.ply").read_bytes()
