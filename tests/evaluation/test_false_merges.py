"""Tables of merging against rows made by hand: every pair counts, a building counts once, and what nobody can tell is told."""

from __future__ import annotations

import importlib

import pytest


@pytest.fixture
def counts():
    return importlib.import_module("topomerge.evaluation.false_merges")


@pytest.fixture
def reliable():
    return importlib.import_module("topomerge.evaluation.false_merges")


def row(kind: str = "strangers", believed: bool = False, building: str = "office-900001-1", **more: object) -> dict:
    """A row of results; `physical` and the like are as `places_of` tells them."""
    places = importlib.import_module("topomerge.evaluation.tasks").describe_places
    names = (building, str(more.pop("other", "lab-900009-1" if kind == "strangers" else building)))
    about = {"name": "x", "kind": kind, "sensors": ["tls", "depth"], "probability": 0.9 if believed else 0.01}
    return {**about, **places(names), "believed": believed, **more}


@pytest.mark.parametrize(
    ("kind", "pair"),
    [
        ("stranger", row()),
        ("stranger", row("other-building", other="lab-900009-1")),
        ("other storey", row("other-building", building="school/Sabadell1", other="school/Sabadell2")),
        ("other storey", row("other-building", building="school/Sabadell1", other="school/Sabadell1")),
        ("other storey", row("other-storey")),
        ("twin wing", row("twin-wing")),
        ("no room in common", row("overlap", common=0.4)),
        ("", row("overlap", common=90.0, overlap=0.5)),
        ("repeated modules", row("lookalike", lookalike="modules")),
        ("repeated modules", row("overlap", common=60.0, lookalike="shifted-row")),
        ("own mirror image", row("lookalike", lookalike="mirror")),
        ("other look-alikes", row("lookalike", lookalike="same-room")),
    ],
)
def test_kinds_of_pairs_that_must_not_merge(counts, kind, pair) -> None:
    assert counts.classify_negative(pair) == kind and (not kind or kind in counts.PRIOR)


def test_the_prior_is_one() -> None:
    assert sum(importlib.import_module("topomerge.evaluation.false_merges").PRIOR.values()) == pytest.approx(1)


def test_a_building_counts_once_and_every_pair_is_in(counts) -> None:
    names = ("school/Sabadell1", "school/Sabadell2", "school/Sabadell3", "school/Sabadell1 + school/Sabadell2")
    rows = counts.select_negatives([row(building=n, other="lab-900009-1", believed=True) for n in names])
    rows += counts.select_negatives([row(building=f"office-{900000 + k}-1") for k in range(9)])
    name, pairs, believed, buildings, interval, *_ = counts.format_tally("stranger", rows)
    assert (name, pairs, believed, buildings) == ("stranger", 13, 4, 10)
    assert interval == "1: 0.3 to 44.5 %"  # Clopper and Pearson, 1 of 10


def test_what_nobody_can_tell_is_in_and_told(counts) -> None:
    alike = [row("twin-wing", believed=True, differs=0.1), row("lookalike", lookalike="mirror", tellable=False)]
    rows = counts.select_negatives([*alike, row("twin-wing", differs=2.0), row("lookalike", lookalike="mirror", tellable=True)])
    assert [counts.is_tellable(r) for r in rows] == [False, False, True, True]
    assert counts.format_tally("all", rows)[1:3] == [4, 1] and counts.format_tally("all", rows)[5:7] == [2, 1]
    lines = counts.tabulate_false_merges(rows).splitlines()
    assert lines[-1].startswith("| **indistinguishable**") and "| 2 | 1 |" in lines[-1]
    assert counts.compute_rate(rows)[0] > 0


def test_a_right_pose_of_parts_of_a_row_is_no_false_merge(counts) -> None:
    right, wrong = ([0.1, 0.0, 0.2], [4.2, 0.0, 0.1])
    rows = [row("overlap", believed=True, common=50.0, lookalike="modules", tellable=True, err=e) for e in (right, wrong)]
    assert [counts.is_false_merge(r) for r in rows] == [False, True]


def test_a_truth_that_is_wrong_is_left_out(counts) -> None:
    assert counts.select_negatives([row("overlap", believed=True, common=0.0, sensors=["tls", "drawing"])]) == []


def test_the_rate_at_a_prior_by_hand(counts) -> None:
    strangers = [row(believed=True), row(), row(building="office-900002-1"), row(building="office-900002-1")]
    rows = counts.select_negatives([*strangers, row("other-storey", believed=True)])
    rate, low, high = counts.compute_rate(rows, {"stranger": 0.4, "other storey": 0.2, "twin wing": 0.4})
    assert rate == pytest.approx((0.4 * 0.25 + 0.2 * 1.0) / 0.6)  # twin wings were not measured
    assert 0 < low < rate < high < 1
    many = counts.select_negatives([row(building=f"office-{900000 + k}-1") for k in range(200)])
    assert counts.compute_rate(many)[0] == 0 and counts.compute_rate(many)[2] < 0.02
    assert "Not measured" in counts.format_headline(rows) and "twin wing" in counts.format_headline(rows).split("Not measured")[1]
    assert counts.compute_rate([])[0] != counts.compute_rate([])[0]


def test_origins(reliable) -> None:
    procedural, plans, real, made_alike = reliable.ORIGINS
    assert (
        reliable.classify_origin(row())
        == reliable.classify_origin({"source": "procedural"})
        == reliable.classify_origin({})
        == procedural
    )
    assert reliable.classify_origin(row(building="school/Franch1")) == reliable.classify_origin({"source": "ifc"}) == plans
    assert reliable.classify_origin(row(other="school/Franch1")) == plans
    assert reliable.classify_origin({"source": "carmen", "other_source": "utexas"}) == real
    assert reliable.classify_origin({"lookalike": "modules", "source": "procedural"}) == made_alike


def test_probabilities_below_the_truth_show_above_a_tenth_only(reliable) -> None:
    right = [row("overlap", True, common=90.0, err=[0.0, 0.0, 0.0], source="carmen") | {"probability": 0.83} for _ in range(20)]
    rows = [*right, *(row(source="carmen") | {"probability": 0.0} for _ in range(180))]
    cells = [c.strip() for c in reliable.errors({"real maps": rows, "none": []}).splitlines()[-1].split("|")[1:-1]]
    assert cells[0] == "real maps" and cells[1] == "200" and cells[2].startswith("0.017 (")
    assert cells[3] == "20" and cells[4].startswith("0.170 (") and cells[5:] == ["20", "0.83, 1.00"]
    lines = reliable.reliability(rows).splitlines()
    assert "| real maps, 0.1 or more | 20 | 0.83 | 1.00 |" in lines


def test_shares_of_few_buildings_show_their_range() -> None:
    tables = importlib.import_module("topomerge.evaluation.merge_report")
    rows = [row("overlap", method="ours", answered=True, common=90.0, err=[e, 0.0, 0.0], seconds=1.0) for e in (0.05, 0.3, 3.0)]
    assert tables.format_share(rows, tables.is_good) == "67 (1 building)"
    text = tables.tabulate_groups(rows, lambda r: "all", ["all"], "pairs")
    assert text.splitlines()[-1] == "| all | 3 | 2 | 67 (1 building) | 33 (1 building) | 0 (1 building) | 0 | 1.0 |"
