"""Weights that ship, and others in their place."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from topomerge.archive import VARIABLE, find_weights_file
from topomerge.errors import InputError
from topomerge.extraction.plans.passages import read_classifier
from topomerge.matching.consistency import compute_hypothesis_probability
from topomerge.registration.verify import load_model

EVIDENCE = np.array([[30.0, 1.0, 40.0], [3.0, 1.0, 2.0]])


def test_a_folder_takes_the_place_of_the_packaged_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shipped, threshold = compute_hypothesis_probability(EVIDENCE), load_model()["threshold"]
    (tmp_path / "odds.json").write_text(json.dumps({"hypothesis": [0.0] * 4, "match": [0.0] * 5}))
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    assert np.allclose(compute_hypothesis_probability(EVIDENCE), 1 / 3) and load_model()["threshold"] == threshold
    monkeypatch.delenv(VARIABLE)
    assert np.array_equal(compute_hypothesis_probability(EVIDENCE), shipped)
    monkeypatch.setenv(VARIABLE, str(tmp_path / "none"))
    with pytest.raises(InputError, match="no folder"):
        compute_hypothesis_probability(EVIDENCE)


@pytest.mark.parametrize("text", ["{", "[1]", '{"hypothesis": [1, 2]}', '{"match": [0, 0, 0, 0, 0]}'])
def test_damaged_odds_are_named(text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "odds.json").write_text(text)
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    with pytest.raises(InputError, match=r"odds\.json"):
        compute_hypothesis_probability(EVIDENCE)


def test_a_classifier_of_other_features_is_refused(tmp_path: Path) -> None:
    values = json.loads(find_weights_file("topomerge.extraction.plans", "door_classifier.json").read_text())
    for change in ({"features": ["width"]}, {"low": None}, {"layers": 3}):
        path = tmp_path / f"{len(list(tmp_path.iterdir()))}.json"
        path.write_text(json.dumps({**values, **change}))
        with pytest.raises(InputError, match=str(path)):
            read_classifier(path)
