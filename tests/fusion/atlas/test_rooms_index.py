"""The index of a large atlas: it agrees with exact search, grows with the atlas, and another one's is refused."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.fusion.atlas.atlas_scenes import office_map
from topomerge import archive
from topomerge.embedding.quarter_turns import TurnedRows
from topomerge.errors import InputError
from topomerge.fusion.atlas import find as finding
from topomerge.fusion.atlas import rooms_index as indexing
from topomerge.fusion.atlas.find import Sighting, find, rank_sightings
from topomerge.fusion.atlas.folder import read_atlas
from topomerge.fusion.atlas.partners import find_nearest
from topomerge.fusion.atlas.rooms_index import (
    INDEX_FILE,
    LINKS,
    ROOMS_FILE,
    RoomsIndex,
    check_graph,
    compute_embedder_signature,
    encode_signature,
)
from topomerge.types import Array

MAPS, KINDS, SIZE = 300, 40, 8  # kinds of rooms, of which maps draw theirs: many maps have rooms that look alike


def rows_of(rng: np.random.Generator, rooms: Array, noise: float = 0.0) -> TurnedRows:
    rows = rooms + noise * rng.normal(size=rooms.shape)
    return TurnedRows(rows / np.linalg.norm(rows, axis=2, keepdims=True), rng.uniform(0, 20, (len(rows), 2)))


def many_maps(seed: int = 0) -> list[TurnedRows]:
    rng = np.random.default_rng(seed)
    kinds = rng.normal(size=(KINDS, 4, SIZE))
    return [rows_of(rng, kinds[rng.integers(0, KINDS, rng.integers(3, 12))], 0.8) for _ in range(MAPS)]


def write_atlas(folder: Path, maps: dict[str, TurnedRows]) -> Path:
    """An atlas of which only the rows are there."""
    folder.mkdir(exist_ok=True)
    listed = [{"name": n, "key": f"{n:0>16}", "source": n, "rooms": len(of), "storeys": 1} for n, of in maps.items()]
    (folder / "atlas.json").write_text(json.dumps({"format": 1, "maps": listed, "settings": {}}))
    arrays = {"embedder": encode_signature(compute_embedder_signature("learned"))}
    for name, of in maps.items():
        arrays |= {f"{name:0>16}": of.rows.astype(np.float32), f"{name:0>16}.places": of.places}
    archive.write(arrays, folder / ROOMS_FILE)
    return folder


def look(folder: Path, new: TurnedRows, number: int, monkeypatch: pytest.MonkeyPatch) -> tuple[Sighting, ...]:
    """`find` of a map with these rows."""
    monkeypatch.setattr(finding, "embed_rooms", lambda describe, map: new)
    monkeypatch.setattr(finding, "register_sightings", lambda stored, map, sightings: sightings)
    return find(folder, office_map(0), number)


def seen_again(maps: list[TurnedRows], k: int) -> TurnedRows:
    """Half of a map's rooms, turned."""
    rng = np.random.default_rng(k)
    rooms = rng.permutation(len(maps[k]))[: len(maps[k]) // 2 + 2]
    again = rows_of(rng, np.roll(maps[k].rows[rooms], -(k % 4), axis=1), 0.1)
    way = maps[k].places[rooms] @ np.array([1, 1j]) * 1j ** (k % 4)
    return replace(again, places=np.column_stack([way.real, way.imag]))


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Indices of small atlases, too."""
    pytest.importorskip("usearch")
    monkeypatch.setattr(indexing, "INDEX_FROM", 100)


@pytest.fixture
def indexed(small: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An atlas with an index."""
    maps = many_maps()
    folder = write_atlas(tmp_path / "town", {str(k): of for k, of in enumerate(maps)})
    look(folder, maps[0], 5, monkeypatch)
    return folder


LEAST_SHARE = 1e-4  # of the probability: maps with less come in any order


@pytest.mark.longer
def test_a_shortlist_gives_what_the_comparison_with_all_maps_gives(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    maps = many_maps()
    folder = write_atlas(tmp_path / "town", {str(k): of for k, of in enumerate(maps)})
    written = (folder / ROOMS_FILE).read_bytes()
    for k in (1, 70, 143, 210):
        new = seen_again(maps, k)
        among_all = rank_sightings(
            [str(m) for m in range(MAPS)], [replace(m, rows=m.rows.astype(np.float32)) for m in maps], new, 3
        )
        shown = look(folder, new, 3, monkeypatch)
        counted, expected = ([s.name for s in some if s.share > LEAST_SHARE] for some in (shown, among_all))
        assert shown[0].name == str(k) and counted == expected and len(shown) == 3
        assert shown[0].rooms[0][:2] == among_all[0].rooms[0][:2] and shown[0].share >= among_all[0].share - 1e-9
    assert not (folder / INDEX_FILE).exists() and (folder / ROOMS_FILE).read_bytes() == written
    assert len(look(folder, seen_again(maps, 1), MAPS, monkeypatch)) == MAPS  # who asks for all gets all


@pytest.mark.longer
def test_index_and_exact_search_name_the_same_maps(indexed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    maps = many_maps()
    assert (indexed / INDEX_FILE).exists()
    for k in range(0, MAPS, 35):
        new = seen_again(maps, k)
        with monkeypatch.context() as patch:
            patch.setattr(indexing, "find_spec", lambda name: None)
            exact = look(indexed, new, 5, monkeypatch)
        by_index = look(indexed, new, 5, monkeypatch)
        assert [s.name for s in by_index] == [s.name for s in exact] and exact[0].name == str(k)
        assert [s.rooms for s in by_index] == [s.rooms for s in exact]


def test_nineteen_of_twenty_neighbours_are_the_nearest() -> None:
    pytest.importorskip("usearch")
    rng = np.random.default_rng(3)
    table = np.repeat(rng.normal(size=(200, 64)), 20, axis=0) + 0.5 * rng.normal(size=(4000, 64))
    asked = table[rng.integers(0, 4000, 100)] + 0.2 * rng.normal(size=(100, 64))
    table, asked = (of / np.linalg.norm(of, axis=1, keepdims=True) for of in (table, asked))
    index = RoomsIndex(64)
    index.add(["a", "b"], [1000, 3000], table.astype(np.float32))
    rooms, cosine = index.find_nearest(asked, 10)
    exact, of_exact = find_nearest(table, asked, 10)
    assert np.mean([len(set(a) & set(b)) / 10 for a, b in zip(rooms.tolist(), exact.tolist(), strict=True)]) >= 0.95
    assert np.allclose(cosine, np.take_along_axis(asked @ table.T, rooms, axis=1), atol=0.02)
    assert np.allclose(cosine.mean(), of_exact.mean(), atol=0.005)


def test_fewer_rooms_than_are_asked_for() -> None:
    pytest.importorskip("usearch")
    index = RoomsIndex(4)
    index.add(["a"], [3], np.eye(4, dtype=np.float32)[:3])
    rooms, cosine = index.find_nearest(np.eye(4, dtype=np.float32)[[1]], 64)
    assert rooms[0, 0] == 1 and cosine[0, 0] == pytest.approx(1, abs=0.02) and (cosine[0, 3:] == -np.inf).all()


def test_the_same_maps_give_the_same_bytes(indexed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = (indexed / INDEX_FILE).read_bytes()
    look(indexed, many_maps()[0], 5, monkeypatch)
    assert (indexed / INDEX_FILE).read_bytes() == first
    (indexed / INDEX_FILE).unlink()
    look(indexed, many_maps()[0], 5, monkeypatch)
    assert (indexed / INDEX_FILE).read_bytes() == first


def test_maps_that_come_and_go(indexed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    maps = many_maps()
    new = many_maps(9)[:40]
    names = {str(k): of for k, of in enumerate(maps)} | {f"new{k}": of for k, of in enumerate(new)}
    write_atlas(indexed, names)
    assert look(indexed, seen_again(new, 7), 1, monkeypatch)[0].name == "new7"
    assert len(archive.read(indexed / INDEX_FILE)["keys"]) == MAPS + 40
    write_atlas(indexed, {n: of for n, of in names.items() if n != "5"})
    assert look(indexed, seen_again(maps, 6), 1, monkeypatch)[0].name == "6"
    assert "5" not in [s.name for s in look(indexed, seen_again(maps, 5), 50, monkeypatch)]
    assert len(archive.read(indexed / INDEX_FILE)["keys"]) == MAPS + 40  # they stay, but don't count
    write_atlas(indexed, {n: of for n, of in names.items() if len(n) < 3 or n.startswith("new")})
    assert look(indexed, seen_again(maps, 6), 1, monkeypatch)[0].name == "6"
    assert len(archive.read(indexed / INDEX_FILE)["keys"]) == 100 + 40


def test_an_index_that_is_damaged_or_another_s_is_refused(indexed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, new = indexed / INDEX_FILE, many_maps()[0]
    good, arrays = path.read_bytes(), archive.read(path)
    path.write_bytes(good[:-40])
    with pytest.raises(InputError, match=r"rooms_index.npz: damaged or cut off"):
        look(indexed, new, 5, monkeypatch)
    spoilt = {
        "of another embedder; delete it": {"embedder": arrays["embedder"][::-1]},
        "of another atlas; delete it": {"keys": np.array([b"other%d" % k for k in range(MAPS)])},
        "rooms of a map are missing": {"counts": arrays["counts"] + 1},
        "cut off.*delete it": {"graph": arrays["graph"][:-40]},
        "damaged .*delete it": {"counts": arrays["counts"][1:]},
        "of other vectors": {"graph": np.concatenate([arrays["graph"][:4] + 1, arrays["graph"][4:]])},
    }
    for message, other in spoilt.items():
        archive.write({**arrays, **other}, path)
        with pytest.raises(InputError, match=message):
            look(indexed, new, 5, monkeypatch)
    archive.write({name: array for name, array in arrays.items() if name != "graph"}, path)
    with pytest.raises(InputError, match="damaged"):
        look(indexed, new, 5, monkeypatch)
    path.unlink()
    assert look(indexed, new, 5, monkeypatch)[0].name == "0" and path.read_bytes() == good


@pytest.mark.longer
def test_a_graph_that_would_lead_the_library_astray_is_refused(indexed: Path) -> None:
    """Each byte of all but the vectors is spoilt: what is not refused can be searched."""
    arrays = archive.read(indexed / INDEX_FILE)
    graph, count = arrays["graph"], int(arrays["counts"].sum())
    check_graph(graph.tobytes(), count, 4 * SIZE, LINKS)
    after = 8 + count * 4 * SIZE
    rng = np.random.default_rng(0)
    places = [*range(8), *range(after, after + 104), *rng.integers(after + 104, len(graph), 150).tolist()]
    refused = 0
    for at in places:
        spoilt = graph.copy()
        spoilt[at] ^= 0xFF
        index = RoomsIndex(4 * SIZE)
        try:
            check_graph(spoilt.tobytes(), count, 4 * SIZE, LINKS)
            index._graph.load(spoilt.tobytes())
        except (ValueError, RuntimeError):
            refused += 1
            continue
        assert (index.find_nearest(np.eye(4 * SIZE, dtype=np.float32))[0] < count).all()
    assert refused > 120  # of other bytes: links that lead to another room, or places that are not in use


def test_without_the_package_or_a_folder_to_write_to_search_is_exact(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(indexing, "INDEX_FROM", 100)
    maps = many_maps()
    folder = write_atlas(tmp_path / "town", {str(k): of for k, of in enumerate(maps)})
    with monkeypatch.context() as patch:
        patch.setattr(indexing.os, "access", lambda path, mode: False)
        assert look(folder, seen_again(maps, 3), 1, monkeypatch)[0].name == "3"
    with monkeypatch.context() as patch:
        patch.setattr(indexing, "find_spec", lambda name: None)
        assert look(folder, seen_again(maps, 3), 1, monkeypatch)[0].name == "3"
    assert not (folder / INDEX_FILE).exists() and read_atlas(folder).entries


def test_an_index_without_the_package_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "usearch.index", None)
    with pytest.raises(InputError, match=r"pip install 'topomerge\[index\]'"):
        RoomsIndex(4)
