"""The evaluation as a whole: settings, folders, predictions on disk, tables and figures."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from topomerge.datasets.pairs.evaluation_pair import load_evaluation_pair
from topomerge.datasets.pairs.items import check as check_recipe

from tests.cases import list_longer
from tests.recipes import SMALL_HOUSES
from topomerge.config import compose
from topomerge.errors import InputError
from topomerge.evaluation import predict as predicting
from topomerge.evaluation.evaluate import claim, compute_headline, evaluate
from topomerge.evaluation.settings import (
    Evaluation,
    Pairs,
    check,
    collect_prediction_settings,
    find_difference,
    format_run_title,
    get_folder,
    iter_variants,
)
from topomerge.evaluation.tables import Table, write_section

SETS = ("heldout", "heldout_small", "real")
SMALL = Pairs(name="two", pairs=2, split="test", maps=True, **SMALL_HOUSES)


@pytest.mark.longer
@pytest.mark.parametrize("data", SETS)
def test_every_set_composes(data: str) -> None:
    settings = compose("evaluate", Evaluation, [f"data={data}"])
    check(settings)
    if not settings.data.real:
        check_recipe(settings.data)
        assert settings.data.maps and settings.data.split == "test"
    assert len(list(iter_variants(settings))) == 4 * 5


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("slow_kk=3", "slow_kk"),
        ("methods=[guess]", "methods: unknown 'guess'"),
        ("run=[runs/nowhere]", "runs/nowhere"),
        *list_longer(
            ("context=[max]", "context: unknown"),
            ("descriptors.engineered.name=deep", "descriptors.engineered.name 'deep'"),
            ("mergers=[x]", "mergers: 'x'"),
            ("only=[]", "nothing to evaluate"),
            ("tables=[sizes]", "tables: unknown 'sizes'"),
        ),
    ],
)
def test_a_wrong_key_is_named(word: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        check(compose("evaluate", Evaluation, [word]))


def test_a_folder_of_other_settings_is_refused(tmp_path: Path) -> None:
    settings = Evaluation(SMALL, folder=str(tmp_path), descriptors={"engineered": {"name": "engineered"}}, only=["engineered"])
    folder = get_folder(settings)
    assert folder == tmp_path / "two"
    claim(folder, collect_prediction_settings(settings))
    claim(folder, collect_prediction_settings(settings))  # the same again
    with pytest.raises(InputError, match=r"k: \[0\] there, \[0, 1\] now.*another folder"):
        claim(folder, collect_prediction_settings(replace(settings, k=[0, 1])))
    with pytest.raises(InputError, match=r"data\.seed: 4 there, 5 now"):
        claim(folder, collect_prediction_settings(replace(settings, data=replace(SMALL, seed=5))))
    claim(folder, collect_prediction_settings(replace(settings, rounds=10, write="x.md")))  # how it is told changes no prediction
    (folder / "evaluation.json").write_text("{")
    with pytest.raises(InputError, match="damaged"):
        claim(folder, collect_prediction_settings(settings))
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "photo.png").touch()
    with pytest.raises(InputError, match="something else"):
        claim(tmp_path / "other", collect_prediction_settings(settings))


def test_a_run_is_told_by_its_weights(tmp_path: Path) -> None:
    for name, weights in (("a", b"one"), ("b", b"two")):
        (tmp_path / name / "best").mkdir(parents=True)
        (tmp_path / name / "best" / "embedder.onnx").write_bytes(weights)
    runs = [str(tmp_path / name) for name in "ab"]
    settings = Evaluation(SMALL, run=runs, methods=["assignment", "mutual"], folder=str(tmp_path))
    assert [v.name for v in iter_variants(settings)] == ["a", "b"] and get_folder(settings).name == "two-a-b"
    assert next(iter_variants(settings)).methods == ("assignment", "mutual")
    before = collect_prediction_settings(settings)
    assert before["run"]["a"] != before["run"]["b"]
    (tmp_path / "b" / "best" / "embedder.onnx").write_bytes(b"three")
    assert find_difference(before, collect_prediction_settings(settings)).startswith("run.b")


def test_runs_are_called_by_what_they_are_made_of() -> None:
    run, title = (
        "pretrained",
        "scalars + surroundings + wide_surroundings + door_surroundings, gat around ways, infonce",
    )
    assert format_run_title(run) == title
    settings = Evaluation(SMALL, run=[run], titles=True, mergers=[])
    assert [v.name for v in iter_variants(settings)] == [title] == list(collect_prediction_settings(settings)["run"])
    with pytest.raises(InputError, match=re.escape(f"two are called '{title}'")):
        check(replace(settings, run=[run, "topomerge/networks"]))


def test_the_first_difference_is_told() -> None:
    assert find_difference({"a": {"b": 1}}, {"a": {"b": 1}}) == ""
    assert find_difference({"a": {"b": 1}}, {"a": {"b": 2}}) == "a.b: 1 there, 2 now"
    assert find_difference({}, {"c": None, "d": 1}) == "d: null there, 1 now"


def test_marks_are_replaced(tmp_path: Path) -> None:
    path = tmp_path / "results.md"
    path.write_text("# Results\n\n## Rooms\n\nkept\n")
    write_section(path, "rooms-matched", "first")
    write_section(path, "rooms-matched", "second")
    text = path.read_text()
    assert "kept" in text and "second" in text and "first" not in text and text.count("rooms-matched:begin") == 1


def test_a_table_as_latex() -> None:
    text = Table("50 % of m²", ["a_b", "x"], [["one", "0.5 [0.4, 0.6]"]]).format_latex()
    assert r"a\_b & x \\" in text and r"50 \% of m$^2$" in text and r"\begin{tabular}{lr}" in text


@pytest.mark.slow
def test_two_simulated_pairs_from_beginning_to_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    descriptors = {"engineered": {"name": "engineered"}, "shape": {"name": "shapedna", "values": 8, "spacing": 0.5}}
    settings = Evaluation(
        SMALL,
        folder=str(tmp_path / "eval"),
        cache=str(tmp_path / "cache"),
        descriptors=descriptors,
        only=list(descriptors),
        k=[0, 1],
        rounds=50,
    )
    first = evaluate(settings, command="python evaluate.py")
    assert first.ranks and first.matches and first.merges and "recall@1" in first.summary
    files = {p.name for p in first.folder.iterdir()}
    assert {"report.md", "tables.tex", "scores.csv", "matches.csv", "ranks.csv", "merges.csv", "pr.png"} <= files
    row = first.ranks[0]
    pair = load_evaluation_pair(tmp_path / "cache" / "pairs" / f"{row['pair']}.npz")
    assert row["queries"] == sum(len(np.unique(pair.matches[:, s])) for s in (0, 1))
    assert len(pair.load_maps()[0].rooms) == len(pair.true[0]) == len(pair.twin[0])
    table = list(csv.DictReader((first.folder / "scores.csv").open()))
    assert {"variant", "method", "by", "group", "metric", "value", "low", "high"} <= set(table[0])

    def never(*_: object) -> None:
        raise AssertionError("predictions that are there are not made again")

    monkeypatch.setattr(predicting, "describe_maps", never)
    again = evaluate(replace(settings, write=str(tmp_path / "results.md")))
    assert json.dumps(again.ranks) == json.dumps(first.ranks)
    text = (tmp_path / "results.md").read_text()
    assert "<!-- evaluation:begin -->" in text and "made by `python evaluate.py`" in text
    trained = [{**row, "variant": "pretrained"} for row in first.ranks if row["variant"] == "engineered"]
    (name, (result, of)), *none = compute_headline([*first.ranks, *trained], settings).items()
    assert name == "ranking" and not none and len(set(result.split("; "))) == 1 and of.endswith("held-out pairs")
    assert not compute_headline(first.ranks, settings)
    with pytest.raises(InputError, match="other settings"):
        evaluate(replace(settings, k=[0]))
