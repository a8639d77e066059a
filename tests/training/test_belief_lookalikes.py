"""Look-alikes in the training of the belief: what trains, what is judged only, and that fitting with them believes fewer."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.training import tiny
from topomerge.errors import InputError
from topomerge.training import belief_hypotheses, merge_belief
from topomerge.training.belief_hypotheses import build_lookalike_rows, classify_pair, is_training_row, score_lookalikes
from topomerge.training.tasks import compose_settings, train


def quiet(text: str) -> None:
    """Say nothing."""


def tempting(*_: Any) -> list[dict[str, Any]]:
    """Look-alikes whose best hypothesis brings as many walls together as a right one, with furniture on free floor."""
    rows = []
    for k, row in enumerate(tiny.belief_rows()[:24]):
        first, *others = row["hyps"]
        first |= {"walls": 30.5, "conflict": 8.0, "err": None, "label": 0}
        first["bent"] |= {"walls": 30.5, "conflict": 8.0}
        about = {"kind": "lookalike", "lookalike": "modules", "tellable": k % 3 > 0, "repeats": k % 2 == 0, "common": 0.0}
        rows.append(
            {**row, **about, "building": f"modules-{k}", "hyps": [first, *({**h, "err": None, "label": 0} for h in others)]}
        )
    return rows


@pytest.fixture
def words(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    monkeypatch.setattr(merge_belief, "build_belief_rows", tiny.belief_rows)

    def rows(recipe: Any, settings: Any, log_line: Any) -> list[dict[str, Any]]:
        taken = settings.lookalikes
        made = [] if taken == "none" else tempting()
        return [{**row, "judged_only": taken == "judged" or not is_training_row(row)} for row in made]

    monkeypatch.setattr(merge_belief, "build_lookalike_rows", rows)
    return ["task=merge_belief", f"runs={tmp_path}", "logger=none", "floor=0"]


def test_pairs_that_nobody_can_tell_teach_only_where_a_map_shows_the_repetition() -> None:
    assert is_training_row({"tellable": True, "repeats": False}) and is_training_row({"tellable": False, "repeats": True})
    assert not is_training_row({"tellable": False, "repeats": False})


def test_look_alikes_are_binned_by_kind() -> None:
    row = {"kind": "overlap", "common": 90.0, "overlap": 0.4, "sensors": ["tls", "tls"]}
    assert classify_pair(row) == "80-200"
    assert classify_pair({**row, "lookalike": "modules", "tellable": True}) == "modules"
    assert classify_pair({**row, "lookalike": "modules", "tellable": False}) == "modules (nobody can tell)"


def test_scores_part_who_could_be_told_apart_by_hand() -> None:
    rows = [{"tellable": True}, {"tellable": True}, {"tellable": False}, {}, {"tellable": False}]
    scores = score_lookalikes(rows, np.array([0.9, 0.7, 0.95, 0.99, 0.9]), np.array([0, 0, 0, 0, 1]), 0.8)
    assert scores == {
        "wrong_believed_tellable": 0.5, "pairs_tellable": 2.0, "wrong_believed_untellable": 0.5, "pairs_untellable": 2.0,
    }  # fmt: skip
    assert score_lookalikes([{}], np.array([0.9]), np.array([0]), 0.8) == {}


@pytest.mark.longer
def test_without_look_alikes_the_weights_are_as_before_and_judging_them_changes_none(words, tmp_path) -> None:
    weights, ordinary = {}, set()
    for taken in ("none", "judged", "fitted"):
        scores = train(compose_settings([*words, f"name={taken}", f"lookalikes={taken}"]), quiet)
        weights[taken] = json.loads((tmp_path / taken / "best" / "calibration.json").read_text())
        assert ("val/pairs_tellable" in scores) == (taken != "none")
        ordinary.add(scores["val/pairs"])
    assert len(ordinary) == 1  # look-alikes are counted by themselves
    assert weights["none"] == weights["judged"] != weights["fitted"]


def test_a_word_that_is_none_of_the_three_is_refused() -> None:
    with pytest.raises(InputError, match="lookalikes"):
        compose_settings(["task=merge_belief", "lookalikes=yes"])


def test_none_are_built_where_none_are_taken(monkeypatch) -> None:
    monkeypatch.setattr(belief_hypotheses, "build_lookalikes", lambda *_: pytest.fail("nothing is to be built"))
    settings = compose_settings(["task=merge_belief", "lookalikes=none"])
    assert build_lookalike_rows(settings.alike, settings, quiet) == []
    assert settings.alike.split == "train" and settings.alike_heldout.split == "test"


@pytest.mark.longer
def test_the_models_of_rigid_poses_may_stay_as_they_are(words: list[str]) -> None:
    rows = [row for row in tiny.belief_rows() if "drawing" not in row["sensors"]]
    shipped = merge_belief.load_model()["solid"]["pose"]
    for refit, same in (("closely", True), ("all", False)):
        weights, _ = merge_belief.fit_models(rows, False, compose_settings([*words, f"name={refit}", f"refit={refit}"]))
        assert (weights["pose"] == shipped) is same


def test_another_word_for_what_is_refitted_is_refused(words: list[str]) -> None:
    with pytest.raises(InputError, match="refit must be all, closely or plan"):
        train(compose_settings([*words, "refit=some"]), quiet)
