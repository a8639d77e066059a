"""What registration needs of a map is drawn once, in whatever process."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

import topomerge as tm
from tests.fusion.atlas.atlas_scenes import office_map
from topomerge.embedding import learned
from topomerge.kernels import count_threads, set_thread_count
from topomerge.registration import pipeline, prepared
from topomerge.registration.bend.pieces import _find_joints
from topomerge.registration.prepared import prepare, unpack_prepared
from topomerge.types import TopometricMap


@pytest.fixture(scope="module")
def halves() -> tuple[TopometricMap, TopometricMap]:
    return office_map(0), office_map(2)


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What is drawn from now on."""
    calls: list[str] = []

    def note(name: str) -> None:
        original = getattr(prepared, name)
        monkeypatch.setattr(prepared, name, lambda *args: calls.append(name) or original(*args))

    for name in ("build_plans", "build_surface", "build_pieces", "sample_walls", "build_wall_lines", "Target"):
        note(name)
    return calls


@pytest.mark.longer
def test_of_what_was_sent_nothing_is_drawn_again_and_where_walls_decide_no_descriptor_is_needed(halves, drawn, monkeypatch):
    monkeypatch.setattr(learned, "load_embedder", lambda *_: pytest.fail("the embedder was loaded"))
    parts = [pickle.loads(pickle.dumps(prepare(map).pack())) for map in halves]
    once = ["Target", "build_pieces", "build_plans", "build_surface", "build_wall_lines", "sample_walls"]
    assert sorted(drawn) == sorted(once * 2)
    sent = tm.merge([unpack_prepared(part, map) for part, map in zip(parts, halves, strict=True)])
    assert sorted(drawn) == sorted(once * 2)
    here = tm.merge(list(halves))
    assert here.merged and sent.transforms == here.transforms and sent.probability == here.probability
    assert sent.map is not None and here.map is not None and np.array_equal(sent.map.room, here.map.room)


def test_any_number_of_threads_finds_the_same(halves, drawn):
    before, found = count_threads(), []
    try:
        for threads in (1, 2):
            set_thread_count(threads)
            found.append(pipeline.register(*halves))
    finally:
        set_thread_count(before)
    alone, beside = found
    assert alone.transform == beside.transform and alone.features == beside.features
    assert alone.probability == beside.probability and len(drawn) == 2 * 12


def test_plans_that_are_too_large_are_not_sent(halves, monkeypatch):
    monkeypatch.setattr(prepared, "SENT_COLUMNS", 10)
    assert prepare(halves[0]).pack() is None


def test_joints_are_pairs_of_pieces_whose_walls_are_near():
    rng = np.random.default_rng(3)
    walls = rng.uniform(0, 6, (300, 2))
    owner = (walls[:, 0] // 1.5).astype(np.int64)
    anchors = np.array([walls[owner == k].mean(axis=0) for k in range(4)])
    joints, lengths = _find_joints(walls, owner, anchors)
    gap = np.linalg.norm(walls[:, None] - walls[None], axis=2) <= 1.0
    near = [[i, j] for i in range(4) for j in range(i + 1, 4) if gap[owner == i][:, owner == j].sum() >= 3]
    assert joints.tolist() == near and len(lengths) == len(near)
