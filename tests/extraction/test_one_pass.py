"""The extraction looks once, weighs once and cuts once; what it weighs."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import topomerge.extraction
from tests.extraction.elevations.doors import three_doors
from tests.extraction.segments import storey_of
from topomerge.archive import read_weights_json
from topomerge.errors import InputError
from topomerge.extraction import extract as evidence
from topomerge.extraction import extract as pipeline
from topomerge.extraction import segment, walls
from topomerge.extraction.extract import PASSAGES_FILE, SCORE_INPUTS, choose_scorer
from topomerge.extraction.plans.passages import Passage
from topomerge.extraction.segment import find_segments

ONCE = (
    (pipeline, "rasterise_storeys"),
    (segment, "compute_column_probabilities"),
    (pipeline, "segment_storey"),
    (pipeline, "unroll_walls"),
    (walls, "classify_places"),
    (pipeline, "find_passages"),
    (pipeline, "partition_rooms"),
    (pipeline, "build_topometric_map"),
    (pipeline, "estimate_attributes"),
)
CLOUD = three_doors().points()
PASSAGE = Passage((10, 20), 0.8, (0.0, 1.0), (0.0,) * 12)


def test_each_step_is_taken_once(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[str] = []
    for module, name in ONCE:
        step = getattr(module, name)
        monkeypatch.setattr(module, name, lambda *a, step=step, name=name, **k: (calls.append(name), step(*a, **k))[1])
    map = pipeline.extract(CLOUD)
    assert calls.index("unroll_walls") < calls.index("find_passages") < calls.index("partition_rooms")
    assert sorted(calls) == sorted(name for _, name in ONCE) and len(map.rooms) == 2 and len(map.edges) == 2


def test_a_cloud_enters_few_files_of_the_extraction() -> None:
    pipeline.extract(CLOUD)  # compiled
    folder, entered = str(Path(topomerge.extraction.__file__).parent), set()

    def note(frame, event, _):
        if event == "call" and frame.f_code.co_filename.startswith(folder) and frame.f_code.co_name != "<module>":
            entered.add(frame.f_code.co_filename)

    sys.setprofile(note)
    try:
        pipeline.extract(CLOUD)
    finally:
        sys.setprofile(None)
    assert 10 < len(entered) <= MOST_FILES, sorted(entered)


MOST_FILES = 31  # of the extraction's 37


def test_places_lie_in_the_segment_of_the_nearest_floor_below_or_above() -> None:
    columns = np.repeat([[0], [1]], 10, axis=0).repeat(4, axis=1)
    lower = storey_of(columns, {})
    upper = replace(lower, number=1, plan=replace(lower.plan, floor=lower.plan.floor + 3.0))
    places = np.array([(0.25, 0.2, 0.1), (1.25, 0.2, 0.1), (0.25, 0.2, 2.9), (0.25, 0.2, 1.5), (9.0, 0.2, 0.0)])
    assert find_segments([lower, upper], places).tolist() == [0, 1, 2, -1, -1]


def test_doorways_that_walls_show_raise_the_score() -> None:
    score, x = (
        choose_scorer(True),
        np.tile(np.array([0.8, 0.4, 0.3, 0.5, 1, 1, 0.2, 0.3, 1, 1, 0, 1, 1, 0.8, 0.9, 2, 3.0]), (3, 1)),
    )
    none, shown, surely = score(x, [replace(PASSAGE, shown=odds) for odds in (0.0, 1.0, 3.0)]).tolist()
    assert none < shown < surely


def test_all_that_speaks_for_a_door_has_a_weight_above_0() -> None:
    weights = dict(zip(SCORE_INPUTS, read_weights_json("topomerge.extraction", PASSAGES_FILE)["walls"], strict=True))
    assert min(weight for name, weight in weights.items() if name != "constant") > 0


def test_damaged_weights_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evidence, "read_weights_json", lambda *_: {"walls": [0.0, np.nan]})
    with pytest.raises(InputError, match=r"passages.json: walls must be 3 numbers"):
        choose_scorer(True)
