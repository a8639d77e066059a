"""What a user reads of a verdict: numbers and words by hand."""

from __future__ import annotations

import inspect
from pathlib import Path

import numpy as np
import pytest

from topomerge.fusion.pipeline import explain_verdict, format_hypothesis, format_probability, list_evidence, list_posterior
from topomerge.matching.poses import PoseHypothesis
from topomerge.registration.pipeline import Registration, register
from topomerge.registration.posterior import POSTERIOR, describe_posterior
from topomerge.types import Sim3

FEATURES = {
    "walls": 20.4, "ratio": 0.83, "opposed": 0.05, "conflict": 1.26, "conflict_share": 0.062, "worst_conflict": 0.11,
    "free": 151.0, "clutter": 8.0, "met": 0.6, "chance": 0.15, "level": 0.04, "margin": 1.0, "ceiling_area": 30.0,
    "ceilings": 0.07, "rmse": 0.021, "moved_walls": 0.02, "worst_ratio": 0.71, "squares": 22.0, "bad_squares": 0.1,
    "tall_conflict": 0.5, "hanging": 4.0, "hanging_met": 3.0,
}  # fmt: skip


def registration(probability: float, **features: float) -> Registration:
    best, other = PoseHypothesis(Sim3(), 2.0, features=FEATURES), PoseHypothesis(Sim3(), 1.0, features=FEATURES)
    rest = (1 - probability) / 10
    each = {
        "here": probability,
        "elsewhere": 6 * rest,
        **dict.fromkeys(("storey", "wing", "building", "outside"), rest),
        "half": 0.0,
    }
    return Registration(Sim3(), probability, False, {**FEATURES, **features}, (best, other), posterior=each)


def test_the_sentence_says_verdict_evidence_and_rival():
    believed, refused = explain_verdict(registration(0.91), 0.9), explain_verdict(registration(0.6), 0.9)
    evidence = "20 m2 of walls agree, 151 m2 of free floor seen by both; 6.2 % of the walls stand on free floor of the other map"
    assert believed == f"merged: probability 0.91 reaches 0.90; {evidence}"
    assert (
        refused == f"not merged: probability 0.60 is below 0.90; {evidence}; it could also be another place in these maps (0.24)"
    )
    assert "another place" not in explain_verdict(registration(0.89), 0.9)  # nothing stands out
    little = explain_verdict(registration(0.5, walls=0.4), 0.9)
    assert little.endswith("the maps share too little area for a verdict")
    assert explain_verdict(registration(0.9), 0.9, force=True) == f"merged: probability 0.90 reaches 0.90; {evidence}"
    assert explain_verdict(registration(0.5), 0.9, force=True).endswith("joined anyway (--force)")
    assert explain_verdict(Registration(None, 0.0, False, reason="no walls"), 0.9) == "not merged: no walls"


def test_the_page_on_own_scans_names_what_a_refusal_says():
    """Each phrase in its table of reasons is one that the program prints."""
    page = (Path(__file__).parent.parent.parent / "docs" / "own-scan.md").read_text(encoding="utf-8")
    rows = page.partition("| the reason says |")[2].partition("\n\n")[0].splitlines()[2:]
    phrases = {phrase for row in rows for phrase in row.split("|")[1].split("`")[1::2]}
    printed = [
        explain_verdict(registration(0.6), 0.9),
        explain_verdict(registration(0.5, walls=0.4), 0.9),
        inspect.getsource(register),
    ]
    printed.append(describe_posterior({**dict.fromkeys(POSTERIOR, 0.0), "here": 0.5, "storey": 0.5}, 0.9))
    assert len(phrases) >= 7
    assert not [phrase for phrase in phrases if not any(phrase in text for text in printed)]


def test_the_alternatives_in_words_most_probable_first():
    rows = list_posterior(registration(0.6))
    assert rows[0] == ("the same place", "0.60") and rows[1] == ("another place in these maps", "0.24") and len(rows) == 6
    assert list_posterior(Registration(None, 0.0, False)) == []


def test_nothing_is_certain():
    assert [format_probability(p) for p in (1.0, 0.991, 0.99, 0.5, 0.01, 0.009)] == [
        "over 0.99",
        "over 0.99",
        "0.99",
        "0.50",
        "0.01",
        "below 0.01",
    ]


def test_the_evidence_row_by_row():
    rows = {what: (much, says) for what, much, says in list_evidence(registration(0.9))}
    assert rows["matching walls"][0] == "20.4 m²" and rows["matching walls"][1].startswith("83 %")
    assert rows["shared free floor"][0] == "151 m²" and rows["walls on free floor"][0] == "1.3 m²"
    assert rows["walls on free floor"][1] == "6 % of the walls compared, 11 % in the worse map; evidence against"
    assert rows["walls back to back"][0] == "5 %" and rows["furniture"][0] == "8.0 m²" and rows["floors"][0] == "0.04 m"
    assert rows["furniture"][1].startswith("60 %") and rows["furniture"][1].endswith("15 %")
    assert rows["ceilings"][0] == "0.07 m" and "30 m²" in rows["ceilings"][1] and rows["surfaces"][0] == "2.1 cm"
    assert (
        rows["walls in one direction"][0] == "71 %"
        and rows["squares of 3 m"][0] == "22"
        and rows["high walls on free floor"][0] == "0.5 m²"
    )
    assert rows["local misfit"][0] == "2 %" and "10 %" in rows["squares of 3 m"][1]
    assert rows["under the ceiling"][0] == "3" and rows["under the ceiling"][1].startswith("of 4 pieces")
    assert rows["lead over the next pose"][0] == f"{np.exp(1.0):.0f} times as probable"


def test_what_was_not_seen_has_no_row():
    few = registration(0.9, ceiling_area=0.0, rmse=float("nan"), tall_conflict=0.0, hanging=0.0, margin=0.1)
    rows = {what: much for what, much, _ in list_evidence(few)}
    assert not {"ceilings", "surfaces", "high walls on free floor", "under the ceiling"} & set(rows)
    assert rows["lead over the next pose"] == "about as probable" and list_evidence(Registration(None, 0.0, False)) == []


def test_a_hypothesis_beside_the_best_one():
    best, other = (
        PoseHypothesis(Sim3(), 3.0, features=FEATURES),
        PoseHypothesis(Sim3(-3.0, (0.0, 4.0, 3.0)), 1.0, features=FEATURES),
    )
    row = format_hypothesis(2, other, best, np.zeros(3))
    assert row == ["2", f"{np.degrees(-3.0):.1f}", "5.0", f"{np.exp(-2.0):.2g}", "20.4", "151", "6.2 %"]
    assert float(format_hypothesis(2, other, best, np.array([3.0, 0.0, 0.0]))[2]) == pytest.approx(
        np.hypot(np.hypot(3 * np.cos(3) - 3, 4 - 3 * np.sin(3)), 3), abs=0.05
    )
