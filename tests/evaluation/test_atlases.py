"""Sets of maps put together: what of a set of many buildings counts as right."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.scenes import two_rooms
from topomerge.errors import InputError
from topomerge.evaluation.atlases import SMALL, AtlasSet, Settings, errors, list_inputs, load_set, make_small_set, measure
from topomerge.evaluation.tasks import Data
from topomerge.io.maps import load_map
from topomerge.types import Sim3, VoxelGrid


def test_a_map_of_another_building_is_never_right() -> None:
    maps = [
        SimpleNamespace(
            grid=VoxelGrid.from_cells(
                np.unique(np.floor(two_rooms().points() / 0.2 + 5).astype(int), axis=0), np.full(3, -1.0), 0.2
            )
        )
        for _ in range(3)
    ]
    shift = Sim3(0.0, (1.0, 0.0, 0.0), 1.0)
    about: dict[str, object] = {"sensors": ["depth"] * 3, "places": [0, 0, 1]}
    made = AtlasSet("x", (Path("0"), Path("1"), Path("2")), (Sim3(), shift, Sim3()), about)
    result: Any = SimpleNamespace(components=[[0, 1, 2]], transforms=[Sim3(), shift, Sim3()], maps=maps)
    off = errors(made, result)
    assert off[2] is None and off[1] is not None and max(off[1]) < 1e-9


@pytest.mark.longer
def test_small_maps_lie_where_the_truth_says_and_some_have_signs(tmp_path: Path) -> None:
    make_small_set(0.5, 2, 3, tmp_path)
    made = load_set(tmp_path)
    maps = [load_map(file) for file in made.files]
    assert made.about["places"] == [0, 0] and len(maps) == 2
    assert json.loads((tmp_path / "truth.json").read_text())["building"] == "1 buildings"
    one, two = (m.grid.compute_centroids() for m in maps)
    assert made.truth[1] is not None
    moved = np.unique(np.floor(made.truth[1].apply(two)[:, :2] / 0.5), axis=0)
    there = {tuple(p) for p in np.unique(np.floor(one[:, :2] / 0.5), axis=0).tolist()}
    assert sum(tuple(p) in there for p in moved.tolist()) > 0.2 * len(moved)  # they share a room
    assert [len(m.landmarks) > 0 for m in maps] == [True, False]


def test_signs_are_of_small_maps_only() -> None:
    with pytest.raises(InputError, match="needs data=small"):
        measure(Settings(signs=0.5), print)
    assert list_inputs(Settings(Data(set=SMALL), signs=0.5, sizes=[6], sets=1)) == ["('small-0.5', 6, 0)"]
