"""Several maps of a building in one file: what is true of each two, and that a training takes all pairs that share a room."""

from __future__ import annotations

import itertools
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from topomerge.datasets.pairs.build import Build, build
from topomerge.datasets.pairs.example import load_example
from topomerge.datasets.pairs.items import Recipe, check, draw_items

from tests.recipes import SMALL_HOUSES
from topomerge import archive
from topomerge.errors import InputError
from topomerge.training.packed_pairs import SHEET, load_pairs

THREE = Recipe(name="three", pairs=2, walks=3, **SMALL_HOUSES)


@pytest.fixture(scope="module")
def manifest(tmp_path_factory: pytest.TempPathFactory) -> Path:
    cache = tmp_path_factory.mktemp("cache")
    return build(Build(THREE, str(cache))).manifest


@pytest.mark.longer
def test_each_file_tells_what_is_true_of_each_two_maps(manifest: Path) -> None:
    rows = [json.loads(line) for line in manifest.read_text().splitlines()]
    assert rows and all(row["sides"] == "abc" and len(row["sensors"]) == 3 for row in rows)
    file = archive.read(manifest.parent / "pairs" / rows[0]["file"])
    for s, t in itertools.combinations("abc", 2):
        ending = "" if s + t == "ab" else f".{s}{t}"
        for i, j in file[f"matches{ending}"]:
            assert file[f"{s}.true_room"][i] == file[f"{t}.true_room"][j] >= 0
    ab, ac, bc = (file[name] for name in ("transform", "transform.ac", "transform.bc"))
    assert ab @ bc == pytest.approx(ac, abs=1e-9)
    assert load_example(manifest.parent / "pairs" / rows[0]["file"]).a.num_nodes == len(file["a.x"])


@pytest.mark.longer
def test_a_training_takes_all_pairs_that_share_a_room_with_their_sheets(manifest: Path) -> None:
    pairs = load_pairs(manifest, ["sheet"])
    rows = {json.loads(line)["file"] for line in manifest.read_text().splitlines()}
    assert len(pairs) > len(rows) and all(len(pair.matches) for pair in pairs)
    assert {pair.about["sides"] for pair in pairs} <= {"ab", "ac", "bc"}
    for pair in pairs:
        file = archive.read(manifest.parent / "pairs" / pair.about["file"])
        for side, graph in zip(pair.about["sides"], (pair.a, pair.b), strict=True):
            assert all(np.array_equal(graph[name].numpy(), file[f"{side}.{name}"], equal_nan=True) for name in SHEET)
            assert np.allclose(graph["x"].numpy(), file[f"{side}.x"])
    assert len(load_pairs(manifest, ["sheet"], limit=1)) == 1


@pytest.mark.longer
def test_what_a_limited_run_packed_serves_all_pairs(manifest: Path) -> None:
    shutil.rmtree(manifest.parent / "packed", ignore_errors=True)
    assert len(load_pairs(manifest, ["sheet"], limit=1)) == 1
    assert len({pair.about["file"] for pair in load_pairs(manifest, ["sheet"])}) > 1


def test_older_sets_keep_their_names_and_what_makes_no_sense_is_refused() -> None:
    two = draw_items(replace(THREE, walks=2), {})
    assert all(not item.more for item in two) and len(draw_items(THREE, {})[0].more) == 1
    assert [item.seed for item in two] == [item.seed for item in draw_items(THREE, {})]
    for wrong in ({"walks": 1}, {"walks": 7}, {"walks": 3, "maps": True}):
        with pytest.raises(InputError, match="walks must be 2 to 6"):
            check(replace(THREE, **wrong))
