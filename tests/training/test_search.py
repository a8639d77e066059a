"""A search for settings: what it asks and finds, that it goes on after a kill, ends what is worse, and names what is wrong."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.cases import list_longer
from tests.forked import run_words
from tests.graphs import write_set
from tests.training import tiny
from topomerge.errors import InputError
from topomerge.training import door_classification
from topomerge.training.door_classification import DoorJob
from topomerge.training.search import SearchResult, compose_search, parse_space, search_settings

pytest.importorskip("optuna")
parallel_config = pytest.importorskip("joblib").parallel_config
ROOT = Path(__file__).parent.parent.parent
SPACE = ["search.space.rate=[1e-4,1e-1,log]", "search.space.hidden=[2,8]", "search.space.optimizer=[adamw,sgd]"]


def quiet(text: str) -> None:
    """Say nothing."""


@pytest.fixture
def words(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """A search whose trials take a tenth of a second."""
    monkeypatch.setattr(door_classification, "build_door_examples", lambda *_: tiny.door_tables(320))
    common = ["task=door_classification", f"runs={tmp_path}", "logger=none", "epochs=2", "batch=64", "networks=2"]
    return [*common, "search=optuna", "search.startup=2", *SPACE]


def search(words: list[str]) -> SearchResult:
    asked = compose_search(words)
    assert asked is not None
    return search_settings(asked, words, quiet)


def read_trials(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(path.read_text()) for path in sorted(folder.glob("trial_*/config.json"))]


@pytest.mark.longer
def test_the_best_trial_is_named_and_is_a_run(words, tmp_path) -> None:
    result = search([*words, "name=x", "search.trials=4", "search.prune=false"])
    trials = read_trials(tmp_path / "x")
    assert len(trials) == 4 and all(1e-4 <= t["rate"] <= 1e-1 and 2 <= t["hidden"] <= 8 for t in trials)
    assert len({t["rate"] for t in trials}) == 4 and {t["optimizer"] for t in trials} <= {"adamw", "sgd"}
    lines = result.table.read_text().splitlines()
    assert lines[0] == "| trial | rate | hidden | optimizer | auc | epochs | state |" and len(lines) == 6
    scores = [float(line.split("|")[5]) for line in lines[2:]]
    assert scores == sorted(scores, reverse=True) and result.score == pytest.approx(scores[0], abs=1e-3)
    assert lines[2].startswith(f"| {result.best.name} ") and result.describe().startswith(f"best: {result.best}: auc ")
    card = json.loads((result.best / "best" / "door_classifier.card.json").read_text())
    assert card["metrics"]["val/auc"] == pytest.approx(result.score, abs=1e-5)
    assert card["settings"]["rate"] == result.found["rate"]
    lowest = search([*words, "name=y", "search.trials=2", "watch=log_loss"])
    losses = [float(line.split("|")[5]) for line in lowest.table.read_text().splitlines()[2:]]
    assert lowest.score == pytest.approx(min(losses), abs=1e-3)


@pytest.mark.longer
def test_a_search_that_was_cut_off_asks_what_it_would_have_asked(words, tmp_path, monkeypatch) -> None:
    search([*words, "name=whole", "search.trials=4"])
    real, done = DoorJob.train_step, []

    def interrupt(self, batch, state):
        done.append(1)
        if self.settings.name == "trial_002" and state.epoch == 1:
            raise KeyboardInterrupt
        return real(self, batch, state)

    monkeypatch.setattr(DoorJob, "train_step", interrupt)
    with pytest.raises(KeyboardInterrupt):
        search([*words, "name=cut", "search.trials=3"])
    monkeypatch.setattr(DoorJob, "train_step", real)
    result = search([*words, "name=cut", "search.trials=4", "resume=true"])
    assert result.table.read_text() == (tmp_path / "whole" / "table.md").read_text()
    for name in ("whole", "cut"):
        assert len((tmp_path / name / "trial_002" / "metrics.jsonl").read_text().splitlines()) == 2
    assert search([*words, "name=cut", "search.trials=4", "resume=true"]).table.read_text() == result.table.read_text()
    with pytest.raises(InputError, match=r"holds a search; resume=true goes on"):
        search([*words, "name=cut", "search.trials=4"])
    with pytest.raises(InputError, match=r"search.space: resume=true goes on with .*1e-4|search.space: resume=true goes on with"):
        search([*words, "name=cut", "resume=true", "search.space.rate=[1e-4,1e-2,log]"])
    with pytest.raises(InputError, match=r"resume=true goes on .*batch \(was 64, now 32\)"):
        search([*words, "name=cut", "resume=true", "batch=32"])
    assert len(read_trials(search([*words, "name=cut", "overwrite=true", "search.trials=1"]).table.parent)) == 1


@pytest.mark.longer
def test_what_is_worse_than_most_ends_early_and_what_fails_is_told(words, tmp_path, monkeypatch) -> None:
    scores = DoorJob.compute_scores

    def judge(self) -> dict[str, float]:
        number = int(self.settings.name[-3:])
        if number == 1:
            raise InputError("data: is broken")
        return scores(self) | {"auc": 1.0 - number / 10}

    monkeypatch.setattr(DoorJob, "compute_scores", judge)
    table = search([*words, "name=x", "search.trials=6", "epochs=4"]).table.read_text()
    assert table.count("| failed |") == 1 and "| – | – | failed |" in table
    assert table.count("| pruned |") >= 2 and "| 2 | pruned |" in table  # after a first epoch that is never judged
    assert not (tmp_path / "x" / "trial_005" / "best" / "door_classifier.json").exists()
    kept = search([*words, "name=y", "search.trials=4", "search.prune=false"]).table.read_text()
    assert "pruned" not in kept and kept.count("| ended |") == 3
    monkeypatch.setattr(DoorJob, "compute_scores", lambda self: (_ for _ in ()).throw(InputError("data: is broken")))
    with pytest.raises(InputError, match="no trial has ended with a score: data: is broken"):
        search([*words, "name=z", "search.trials=2"])


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("rate=3", r"search.space.rate=3: give \[low, high\]"),
        ("rate=[0,1,log]", "a logarithmic range begins above 0"),
        ("rte=[0.1,0.2]", "search.space.rte: 0.1 is refused: .*rte"),
        ("optimizer=[adamw,adm]", "search.space.optimizer: adm is refused: optimizer: unknown 'adm'"),
        ("seed=[1,9]", "search.space.seed: cannot be searched"),
        *list_longer(
            ("rate=[0.1,0.01]", "the first number must be below the second"),
            ("rate=[a,log]", "rate: a is refused"),
            ("rate=[1,2,3,log]", r"log is of two numbers"),
            ("rate=[1,1,1]", "choices must be two or more, and differ"),
            ("rate=[nan,1]", "numbers must be finite"),
            ("rate=[[1],[2]]", "choices are numbers, words, true or false"),
            ("rate=[-1.0,1.0]", "search.space.rate: -1 is refused: rate must be above 0"),
            ("batch=[32,64]", "search.space.batch: cannot be searched, or is given as batch=, too"),
        ),
    ],
)
def test_a_space_that_makes_no_sense_is_one_line(words, tmp_path, given, said) -> None:
    with pytest.raises(InputError, match=said) as raised:
        search([*words[:-3], f"search.space.{given}"])
    assert "\n" not in str(raised.value) and not any(tmp_path.glob("*"))


@pytest.mark.longer
def test_words_that_make_no_sense_are_one_line(words, monkeypatch) -> None:
    wrong = {"search.trials=0": "search.trials must be 1", "search.trialz=3": "trialz", "watch=x": "watch: unknown"}
    for word, said in wrong.items():
        with pytest.raises(InputError, match=said):
            search([*words, word])
    with pytest.raises(InputError, match="search.space: is empty"):
        search(words[:-3])
    with pytest.raises(InputError, match="leave out -m"):
        compose_search(["-m", *words])
    assert compose_search(["-m", "experiment=gat_scalars,none_scalars", "seed=0,1"]) is None  # a sweep of experiments
    with pytest.raises(InputError, match="leave out -m"):
        compose_search(["-m", "experiment=gat_scalars,none_scalars", "search=optuna"])
    assert compose_search(["task=door_classification"]) is None and compose_search(["experiment=gat_scalars"]) is None
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(InputError, match=r"search=optuna needs optuna: pip install topomerge\[search\]"):
        search(words)


def test_ranges_and_choices() -> None:
    nested = {"c": [1e-3, 1.0, "log"], "d": [16, 32, "choice"]}
    space = parse_space({"a": [1, 4], "b": nested, "e": [True, False], "f": ["x", "y"]})
    assert list(space) == ["a", "b.c", "b.d", "e", "f"]
    kinds = [type(one).__name__[:3] for one in space.values()]
    assert kinds == ["Int", "Flo", "Cat", "Cat", "Cat"] and space["b.c"].log and not space["a"].log


@pytest.mark.longer
@pytest.mark.usefixtures("unexported")
def test_processes_share_a_search(tmp_path) -> None:
    write_set(tmp_path / "cache", "procedural", 6)
    words = ["search=optuna", "search.space.network.node.kind=[gat,sage]", "search.space.rate=[1e-4,1e-2,log]", "search.jobs=2"]
    words += ["search.trials=2", "data=procedural", "validation=", "epochs=1", "batch=2", "logger=none", "name=x"]
    with parallel_config(backend="multiprocessing"):  # forks, where the product starts processes that import all of torch again
        done = run_words([ROOT / "train.py", *words], tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("| ended |") == 2 and "best: runs/x/trial_00" in done.stdout
    assert (tmp_path / "runs" / "x" / "trial_001" / "best" / "embedder.safetensors").is_file()
