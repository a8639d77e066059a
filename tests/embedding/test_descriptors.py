"""Descriptors: a row for each room, the same from every side, and what is written on them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.embedding.test_graph import turned
from tests.scenes_map import building
from topomerge.embedding.engineered import FEATURES, add_context, build_feather, compute_raw_features, compute_walk_matrix
from topomerge.embedding.learned import EMBEDDERS, build_embedder
from topomerge.embedding.quarter_turns import find_neighbours, get_rows, join_rooms
from topomerge.errors import InputError
from topomerge.types import TopometricMap

FAST = {"engineered": {}, "shapedna": {"values": 8, "spacing": 0.5}, "feather": {}, "learned": {}}


@pytest.fixture(scope="module")
def map() -> TopometricMap:
    return building(2)


def permuted(map: TopometricMap, order: np.ndarray) -> TopometricMap:
    """The map with its rooms in another order: new room r is old room order[r]."""
    new = np.argsort(order).astype(np.int32)
    labels = [np.where(r >= 0, new[r], -1).astype(np.int32) for r in (map.room, map.navigable_room)]
    edges = map.edges.copy()
    edges["rooms"] = new[edges["rooms"]]
    return replace(map, room=labels[0], navigable_room=labels[1], rooms=map.rooms[order], edges=edges)


@pytest.mark.longer
@pytest.mark.parametrize("name", EMBEDDERS)
@pytest.mark.parametrize("k", [0, 1, 2])
def test_rows_and_columns(map: TopometricMap, name: str, k: int):
    if name == "learned" and k:  # its rows see what is around them
        with pytest.raises(InputError, match="leave k out"):
            build_embedder(name, k)(map)
        return
    rows = get_rows(build_embedder(name, k, **FAST[name])(map))
    assert rows.dtype == np.float64 and len(rows) == len(map.rooms) and np.isfinite(rows).all()
    assert rows.shape[1:] == ((4, 64) if name == "learned" else ((k + 1) * build_embedder(name, **FAST[name])(map).shape[1],))


@pytest.mark.longer
@pytest.mark.parametrize("name", EMBEDDERS)
def test_order_of_rooms(map: TopometricMap, name: str):
    order = np.array([3, 0, 4, 1, 2])
    describe = build_embedder(name, int(name != "learned"), **FAST[name])
    assert np.allclose(get_rows(describe(permuted(map, order))), get_rows(describe(map))[order], atol=1e-6)


@pytest.mark.parametrize("name", ["engineered", "feather"])
def test_turns_change_nothing(map: TopometricMap, name: str):
    describe = build_embedder(name, 1)
    other, storeys = turned(map), map.storeys.copy()
    storeys["floor"] += other.grid.origin[2] - map.grid.origin[2]
    assert np.allclose(describe(replace(other, storeys=storeys)), describe(map), atol=0.02)


def test_engineered_by_hand(map: TopometricMap):
    rows = compute_raw_features(map)
    of = dict(zip(FEATURES, rows[0], strict=True))
    assert np.expm1(of["area"]) == pytest.approx(20.0) and of["clear_height"] == pytest.approx(2.9)
    assert np.expm1(of["projection"]) == pytest.approx(20.0) and of["step"] == pytest.approx(0.05, abs=0.11)
    assert np.allclose(np.expm1(rows[4, [FEATURES.index("degree"), FEATURES.index("doors")]]), 4)


def test_twin_rooms_are_alike(map: TopometricMap):
    rows = build_embedder("engineered")(map)
    apart = np.linalg.norm(rows[:, None] - rows[None], axis=2)
    assert apart[0, 1] < 0.1 * apart[0, 4]


def test_context_of_nothing_is_the_room(map: TopometricMap):
    describe = build_embedder("engineered", features="thesis")
    alone = replace(map, edges=map.edges[:0])
    rows = add_context(describe, 1)(alone)
    assert np.array_equal(rows[:, :12], rows[:, 12:])
    mean = add_context(describe, 1, "mean")(map)
    assert np.allclose(mean[0, 12:], describe(map)[[0, 4]].mean(axis=0))


def test_joined_and_neighbours(map: TopometricMap):
    assert find_neighbours(map, 1)[0].tolist() == [0, 4] and find_neighbours(map, 2)[0].tolist() == [0, 1, 2, 3, 4]
    one = join_rooms(map, np.array([0, 4]))
    assert len(one.rooms) == 1 and one.rooms["area"][0] == pytest.approx(map.rooms["area"][[0, 4]].sum())
    assert len(one.grid) == np.isin(map.room, [0, 4]).sum()


def test_feather_is_the_formula(map: TopometricMap):
    values = np.arange(len(map.rooms), dtype=float)[:, None]
    rows = build_feather(lambda _: values, steps=2, points=1, largest=0.3)(map)
    walk = compute_walk_matrix(map)
    assert np.allclose(walk.sum(axis=1), 1)
    waves = np.exp(0.3j * values[:, 0])
    once, twice = walk @ waves, walk @ walk @ waves
    assert np.allclose(rows, np.stack([once.real, twice.real, once.imag, twice.imag], axis=1))


def test_bad_names():
    wrong = [("x", {}), ("", {}), ("shapedna", {"value": 3}), ("feather", {"steps": 0})]
    for name, options in [*wrong, *(("engineered", {"k": k}) for k in (-1, 100_000, 0.5, True))]:
        with pytest.raises(InputError):
            build_embedder(name, **options)
