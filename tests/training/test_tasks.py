"""The tasks of `train.py`: each is trained on tiny data, goes on where it stopped, exports a file that the product reads, and is
judged; wrong words are named."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.forked import run_two
from tests.training import tiny
from topomerge.archive import VARIABLE, find_weights_file, read_weights_json
from topomerge.embedding.engineered import scale_features
from topomerge.errors import InputError
from topomerge.extraction.elevations.elevation import compute_place_probabilities
from topomerge.extraction.elevations.wall_doors import (
    SOURCES,
    WALL_DOOR_FEATURES,
    WALL_DOORS_FILE,
    DoorCandidates,
    compute_door_probability,
)
from topomerge.extraction.extract import choose_scorer
from topomerge.extraction.plans.passages import predict_door
from topomerge.extraction.plans.plan_network import compute_column_probabilities
from topomerge.extraction.plans.plan_network import load_weights as plan_weights
from topomerge.extraction.room_odds import load_room_weights
from topomerge.fusion.match_belief import load_belief_weights
from topomerge.matching.consistency import load_odds_weights
from topomerge.matching.room_matcher import load_matcher_weights
from topomerge.networks.drawing import compute_drawing_probabilities
from topomerge.networks.network import Network
from topomerge.registration.places import load_weights as place_weights
from topomerge.registration.verify import load_model
from topomerge.registry import TASKS
from topomerge.training import (
    door_classification,
    drawing_segmentation,
    passages,
    place_evidence,
    plan_segmentation,
    room_matcher,
    wall_doors,
    wall_segmentation,
)
from topomerge.training.door_classification import score_doors
from topomerge.training.loop import ExportedJob, State, prefetch_batches
from topomerge.training.plan_segmentation import score_classes
from topomerge.training.tasks import check_accelerator, compose_settings, evaluate_task, find_weights, train
from topomerge.types import EDGE_DTYPE, Array

PAGE = np.random.default_rng(0).integers(0, 255, (64, 96, 3), dtype=np.uint8)
ROOT = Path(__file__).parent.parent.parent
NETWORKS = {
    "plan_segmentation": ["epochs=2", "steps=2", "batch=2", "crop=32", "hold_out=2", "widths=[4,4,4,4,4,4,4,4]"],
    "grid_segmentation": ["epochs=2", "steps=2", "batch=2", "crop=32", "hold_out=2", "widths=[4,4,4,4,4,4,4,4]"],
    "drawing_segmentation": [
        *("epochs=2", "steps=2", "batch=2", "crop=64", "pages=3", "fresh=1", "watched_pages=2", "widths=[2,2,2,2,2,2]"),
        *(f"{name}.{key}" for name in ("data", "watched", "heldout") for key in ("procedural=2", "folder=")),
    ],
    "door_classification": ["epochs=2", "batch=64", "hidden=4", "networks=2"],
    "wall_segmentation": ["epochs=2", "steps=2", "batch=4", "length=32", "hold_out=2", "widths=[4,4,8,8]"],
    "place_evidence": ["epochs=2", "steps=2", "batch=8", "widths=[4,4,4]", "hold_out=2", "lookalikes=false"],
    "room_matcher": ["epochs=2", "steps=2", "batch=2", "width=8", "layers=1"],
}
# A process of two, on tiny data: it leaves hashes of its weights and batches, and its scores.
BOTH = """
import hashlib, importlib, json, os, sys
from pathlib import Path
import torch
from tests.training import tiny
from topomerge.registry import TASKS
from topomerge.training import loop
from topomerge.training.tasks import compose_settings, train

task, folder, words = sys.argv[1], Path(sys.argv[2]), json.loads(sys.argv[3])
module = importlib.import_module("topomerge.training." + {"grid_segmentation": "plan_segmentation"}.get(task, task))
for name, made in (
    ("build_plans", lambda: (sorted((folder / "plans").glob("*.npz")), None)),
    ("build_door_examples", lambda: tiny.door_tables(320)),
    ("build_walls", lambda: (sorted((folder / "walls").glob("*.npz")), None)), ("read_examples", lambda: tiny.room_examples(4)),
    ("build_hypothesis_files", lambda: sorted((folder / "places").glob("*.npz"))),
):
    if hasattr(module, name):
        setattr(module, name, lambda *_, made=made: made())
told = {"batches": [], "scores": []}
take, judge = loop.Loop._take_step, loop.Loop._judge_epoch

def keep(self, batch):
    told["batches"].append(hashlib.sha256(repr(batch).encode()).hexdigest())
    take(self, batch)
    state = self.job.network.state_dict()
    told["weights"] = {name: hashlib.sha256(value.numpy().tobytes()).hexdigest() for name, value in state.items()
                       if "running" not in name}

def note(self, row):
    better = judge(self, row)
    told["scores"].append({key: value for key, value in row.items() if key.startswith("val/")})
    return better

loop.Loop._take_step, loop.Loop._judge_epoch = keep, note
train(compose_settings(words), lambda text: None)
(folder / f"rank{os.environ['RANK']}.json").write_text(json.dumps(told))
"""
WITHOUT_MORE = {"merge_belief": ["lookalikes=none", "floor=0"]}  # data that takes minutes to make
FITS = ("merge_belief", "room_odds", "match_odds", "match_belief", "feature_scale", "passages", "wall_doors")


def quiet(text: str) -> None:
    """Say nothing."""


@pytest.fixture
def words(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Words of a task whose data is tiny."""
    paths = tiny.plan_files(tmp_path / "plans", 4)
    monkeypatch.setattr(plan_segmentation, "build_plans", lambda *_: (paths, None))
    monkeypatch.setattr(door_classification, "build_door_examples", lambda *_: tiny.door_tables(320))
    walls = tiny.wall_files(tmp_path / "walls", 6)
    monkeypatch.setattr(wall_segmentation, "build_walls", lambda *_: (walls, None))
    monkeypatch.setattr(wall_doors, "build_walls", lambda *_: (walls, None))
    monkeypatch.setattr(passages, "read_scans", lambda *_: tiny.passage_scans(10))
    places = tiny.place_files(tmp_path / "places")
    monkeypatch.setattr(place_evidence, "build_hypothesis_files", lambda *_: places)
    monkeypatch.setattr(room_matcher, "read_examples", lambda *_: tiny.room_examples(4))
    for task, name, make in (
        ("merge_belief", "build_belief_rows", tiny.belief_rows),
        ("room_odds", "build_room_scans", tiny.room_scans),
        ("match_odds", "build_pair_evidence", tiny.evidence),
        ("match_belief", "build_match_rows", tiny.match_rows),
        ("feature_scale", "build_pair_features", tiny.feature_pairs),
    ):
        monkeypatch.setattr(importlib.import_module(f"topomerge.training.{task}"), name, make)

    def of(task: str, *more: str) -> list[str]:
        return [
            f"task={task}",
            f"runs={tmp_path / 'runs'}",
            f"cache={tmp_path / 'cache'}",
            "logger=none",
            *NETWORKS.get(task, []),
            *WITHOUT_MORE.get(task, []),
            *more,
        ]

    return of


def matched_rows() -> Array:
    """What the matcher's first stage makes of rooms that are all alike."""
    run = load_matcher_weights().run
    assert isinstance(run, Network)
    inputs = {n: np.ones([3 if isinstance(s, str) else s for s in t.shape]) for n, t in run.signature.inputs.items()}
    inputs["stage"][1:] = 0
    return run(["next_a"], **inputs)[0]


def read(task: str) -> Any:
    """What the product does with a task's file."""
    plan, signs = tiny.two_rooms(0).plan, np.ones((4, len(WALL_DOOR_FEATURES)))
    return {
        "plan_segmentation": lambda: compute_column_probabilities(plan),
        "grid_segmentation": lambda: compute_column_probabilities(plan, plan_weights(raised=True)),
        "drawing_segmentation": lambda: compute_drawing_probabilities(PAGE),
        "door_classification": lambda: predict_door(np.zeros((3, 17))),
        "place_evidence": lambda: place_weights()(planes=np.ones((1, 16, 16, 22)))[0],
        "room_matcher": matched_rows,
        "wall_segmentation": lambda: compute_place_probabilities(tiny.two_doors(0)[2] / np.float32(255)),
        "passages": lambda: choose_scorer(True)(np.ones((2, 17)), tiny.passages(2)),
        "wall_doors": lambda: compute_door_probability(DoorCandidates(np.zeros(4, EDGE_DTYPE), signs, np.arange(4))),
        "merge_belief": lambda: np.array(load_model()["solid"]["pose"]["weight"]),
        "room_odds": lambda: np.array(load_room_weights()["entered"]),
        "match_odds": lambda: load_odds_weights("match"),
        "match_belief": lambda: load_belief_weights("attention"),
        "feature_scale": lambda: scale_features(np.ones((2, 18)), "matched"),
    }[task]()


TASK_NAMES = [*NETWORKS, *FITS]  # that of grids is the job of that of plans, with other weights


@pytest.mark.longer
@pytest.mark.parametrize("task", [pytest.param(t, marks=[pytest.mark.slow] * (t == "grid_segmentation")) for t in TASK_NAMES])
def test_a_task_is_trained_exported_read_and_judged(task, words, tmp_path, monkeypatch) -> None:
    shipped = read(task)
    scores = train(compose_settings(words(task, f"export={tmp_path / 'exported'}")), quiet)
    run = tmp_path / "runs" / task
    rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert len(rows) == (2 if task in NETWORKS else 1) and all(np.isfinite(value) for value in scores.values())
    assert {f"val/{name}" for name in TASKS[task].scores} <= set(rows[0])
    assert json.loads((run / "config.json").read_text())["task"] == task
    card = json.loads((run / "best" / f"{Path(TASKS[task].file).stem}.card.json").read_text())
    assert card["task"] == task and f"task={task}" in card["command"] and card["metrics"]
    assert card["provenance"]["starts"][0]["versions"]["numpy"] and card["provenance"]["data"]["data"]["name"]
    assert card["data"]["split"] == (
        "validation" if task == "match_belief" else "train"
    )  # it weighs what others were trained for
    monkeypatch.setenv(VARIABLE, str(tmp_path / "exported"))
    assert find_weights_file(TASKS[task].package, TASKS[task].file).parent == tmp_path / "exported"
    trained = read(task)
    assert np.isfinite(trained).all() and not np.array_equal(trained, shipped)
    monkeypatch.delenv(VARIABLE)
    assert np.array_equal(read(task), shipped)
    judged = evaluate_task(task, words(task, f"run={run}", f"folder={tmp_path / 'eval'}"), quiet)
    assert f"| {next(iter(judged.scores))} |" in judged.summary and (judged.folder / "scores.json").exists()
    assert find_weights(task, "").is_file() and evaluate_task(task, words(task, f"folder={tmp_path / 'eval'}"), quiet).scores


# The trainer knows no task by name: one task stands for all of them, the others are tried with the slow tests.
SAMPLED = [pytest.param(t, marks=() if t == "wall_segmentation" else pytest.mark.slow) for t in NETWORKS]


@pytest.mark.longer
@pytest.mark.parametrize("task", SAMPLED)
def test_resumed_equals_uninterrupted(task, words, tmp_path, monkeypatch) -> None:
    jobs = dict.fromkeys(("plan_segmentation", "grid_segmentation"), plan_segmentation.PlanJob)
    jobs |= {"door_classification": door_classification.DoorJob}
    jobs |= {"wall_segmentation": wall_segmentation.WallJob, "drawing_segmentation": drawing_segmentation.DrawingJob}
    kind = {**jobs, "place_evidence": place_evidence.PlaceJob, "room_matcher": room_matcher.MatcherJob}[task]
    monkeypatch.setattr(kind, "export_best", lambda self, folder: None)  # equal weights give equal files
    train(compose_settings(words(task, "name=whole")), quiet)
    step, seen = kind.train_step, []

    def cut(self, batch: Any, state: State) -> dict[str, float]:
        seen.append(1)
        if len(seen) == 4:
            os.kill(os.getpid(), 2)
        return step(self, batch, state)

    monkeypatch.setattr(kind, "train_step", cut)
    with pytest.raises(KeyboardInterrupt):
        train(compose_settings(words(task, "name=cut")), quiet)
    monkeypatch.setattr(kind, "train_step", step)
    train(compose_settings(words(task, "name=cut", "resume=true")), quiet)
    files = [tmp_path / "runs" / name / "last" / "network.safetensors" for name in ("cut", "whole")]
    assert files[0].read_bytes() == files[1].read_bytes()
    best = [tmp_path / "runs" / name / "best" / "network.safetensors" for name in ("cut", "whole")]
    assert best[0].read_bytes() == best[1].read_bytes() and len(list(best[0].parent.iterdir())) == 2
    with pytest.raises(InputError, match="nothing to resume"):
        train(compose_settings(words(task, "name=none", "resume=true")), quiet)


@pytest.mark.longer
@pytest.mark.parametrize("task", SAMPLED)
def test_two_processes_keep_the_same_weights(task, words, tmp_path, monkeypatch) -> None:
    """As by torchrun, with gloo: both processes make other batches and end with the same weights; the run is written once."""
    script = tmp_path / "both.py"
    script.write_text(BOTH)
    given = json.dumps(words(task, "name=two"))
    for done in run_two([script, task, tmp_path, given], ROOT):
        assert done.returncode == 0, done.stderr
    told = [json.loads((tmp_path / f"rank{k}.json").read_text()) for k in range(2)]
    assert told[0]["weights"] == told[1]["weights"] and told[0]["batches"] != told[1]["batches"]
    assert told[0]["scores"] == told[1]["scores"]
    rows = (tmp_path / "runs" / "two" / "metrics.jsonl").read_text().splitlines()
    assert len(rows) == 2 and (tmp_path / "runs" / "two" / "best" / TASKS[task].file).is_file()
    monkeypatch.setattr(ExportedJob, "export_best", lambda self, folder: None)  # seconds
    train(compose_settings(words(task, "name=one")), quiet)
    one = (tmp_path / "runs" / "one" / "last" / "network.safetensors").read_bytes()
    assert one != (tmp_path / "runs" / "two" / "last" / "network.safetensors").read_bytes()


@pytest.mark.longer
@pytest.mark.parametrize("task", FITS)
def test_a_fit_that_ended_is_left_as_it_is(task, words, tmp_path) -> None:
    first = train(compose_settings(words(task)), quiet)
    said: list[str] = []
    assert train(compose_settings(words(task, "resume=true")), said.append) == first and "is there" in said[0]


def test_fits_learn_what_is_so(words) -> None:
    assert train(compose_settings(words("merge_belief")), quiet)["val/right_first"] > 0.6
    odds = train(compose_settings(words("match_odds")), quiet)
    assert odds["val/match_accuracy"] > 0.7 and odds["val/hypothesis_accuracy"] > 0.7
    belief = train(compose_settings(words("match_belief")), quiet)
    assert belief["val/attention_all_after_accuracy"] > 0.9 > 0.7 > belief["val/attention_all_before_accuracy"]
    assert train(compose_settings(words("feature_scale")), quiet)["val/recall@1"] > 0.9
    assert train(compose_settings(words("door_classification", "epochs=8", "rate=0.02")), quiet)["val/auc"] > 0.9


@pytest.mark.parametrize(
    ("given", "key"),
    [
        (["task=door"], "task: unknown .door."),
        (["task=plan_segmentation", "data.scan=3"], "data.scan"),
        (["task=plan_segmentation", "epochs=many"], "epochs"),
        (["task=plan_segmentation", "crop=30"], "crop"),
        (["task=door_classification", "accelerator=cuda"], "accelerator"),
        (["task=match_odds", "pulls=1"], "pulls"),
        (["task=embedding", "epoch=3"], "epoch"),
        (["task=place_evidence", "rate=nan"], "rate"),
    ],
)
def test_a_wrong_word_is_one_line_with_its_key(given: list[str], key: str) -> None:
    with pytest.raises(InputError, match=key) as refused:
        compose_settings(given)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("task", "key", "value"),
    [
        ("plan_segmentation", "accelerator", "tpu"),
        ("wall_segmentation", "length", 31),
        ("wall_segmentation", "widths", [4, 4]),
        ("wall_segmentation", "classes", [1, 2]),
        ("plan_segmentation", "loss.classes", [1, 2]),
        ("door_classification", "networks", 0),
        ("merge_belief", "risk", 0.0),
        ("merge_belief", "halves", ["a"]),
        ("place_evidence", "half", 3),
        ("feature_scale", "name", "../x"),
        ("place_evidence", "rate", -1.0),
        ("place_evidence", "rate", 0.0),
        ("place_evidence", "rate", float("inf")),
        ("place_evidence", "augment.noise", float("nan")),
        ("place_evidence", "decay", -0.1),
    ],
)
def test_a_value_that_makes_no_sense_is_one_line_with_its_key(task: str, key: str, value: object) -> None:
    settings = TASKS[task].get_schema()()
    settings.check()
    *parents, last = key.split(".")
    setattr(getattr(settings, parents[0]) if parents else settings, last, value)
    with pytest.raises(InputError, match=key) as refused:
        settings.check()
    assert "\n" not in str(refused.value)


def test_a_device_that_is_not_there_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises(InputError, match="accelerator=cuda"):
        check_accelerator(compose_settings(["task=plan_segmentation", "accelerator=cuda"]))
    check_accelerator(compose_settings(["task=door_classification"]))  # which has the processor only


@pytest.mark.parametrize("task", list(TASKS))
def test_a_wrong_score_to_watch_is_one_line_before_any_data_is_made(task: str, tmp_path: Path) -> None:
    settings = TASKS[task].convert(TASKS[task].get_schema()())
    settings.runs, settings.cache, settings.watch = str(tmp_path), str(tmp_path / "cache"), "recal@1"
    with pytest.raises(InputError, match="watch: unknown 'recal@1'") as refused:
        train(settings, quiet)
    assert "\n" not in str(refused.value) and not list(tmp_path.iterdir())


def test_batches_made_beside_are_the_same() -> None:
    assert list(prefetch_batches(iter(range(1, 7)))) == list(range(1, 7))

    def broken() -> Iterator[int]:
        yield 1
        raise InputError("the second batch")

    batches = prefetch_batches(broken())
    assert next(batches) == 1
    with pytest.raises(InputError, match="the second batch"):
        next(batches)


def test_a_source_with_hardly_any_door_keeps_its_model() -> None:
    rng = np.random.default_rng(0)
    sources = np.repeat([SOURCES.index("wall"), SOURCES.index("flat")], [60, 20]).astype(np.int8)
    features = rng.normal(size=(80, len(WALL_DOOR_FEATURES)))
    right = (features[:, 0] > 0) & (sources == SOURCES.index("wall"))
    right[-2:] = True  # two doors of plans without walls
    model = wall_doors.fit_doors_model([(DoorCandidates(np.zeros(80, EDGE_DTYPE), features, sources), right)], 1.0)
    shipped = read_weights_json("topomerge.extraction.elevations", WALL_DOORS_FILE)
    assert model["flat"] == shipped["flat"] and model["wall"] != shipped["wall"] and model["wall"][1] > 0.5


def test_scores_of_classes_and_doors() -> None:
    scores = score_classes(np.diag([5, 4, 0, 0, 1]))
    assert scores["mean_iou"] == scores["mean_f1"] == scores["accuracy"] == 1 and scores["iou_shut"] == 0
    scores = score_classes(np.array([[3, 1], [1, 3]] + [[0, 0]] * 3) @ np.eye(2, 5, dtype=int))
    assert scores["iou_inside"] == pytest.approx(0.6) and scores["f1_wall"] == pytest.approx(0.75)
    doors = score_doors(np.array([0.9, 0.8, 0.3, 0.1]), np.array([True, False, True, False]))
    assert doors["precision"] == doors["recall"] == 0.5 and doors["auc"] == pytest.approx(0.75)


def run(*given: str, **variables: str) -> subprocess.CompletedProcess:
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "TOPOMERGE_DATA": "", **variables}
    common: dict[str, Any] = {"cwd": ROOT, "capture_output": True, "text": True, "timeout": 900, "check": False}
    return subprocess.run([sys.executable, *given], env=environment, **common)


SMALL_PAIRS = [
    "data.pairs=2", "data.rooms=[4,5]", "data.sources={procedural: 1, r2v: 0, campus: 0}", "heldout.pairs=1",
    "heldout.rooms=[4,5]",
]  # fmt: skip
SMALL_GRIDS = [
    "data.sets=[5]", "data.drawings=[2]", "data.rooms=[4,6]", "data.sensors={depth: 1.0, tls: 1.0}", "hypotheses=4",
    "heldout.sets=[1]", "heldout.drawings=[0]", "heldout.rooms=[4,6]", "heldout.strangers=0",
]  # fmt: skip
SIMULATED = {
    "plan_segmentation": [*NETWORKS["plan_segmentation"], "data.scans=4", "data.seed=0", "heldout.scans=1"],
    "door_classification": ["data=plan_scans", "data.scans=4", "data.seed=0", "epochs=2", "hold_out=2", "heldout.scans=1"],
    "wall_segmentation": [*NETWORKS["wall_segmentation"], "data.scans=4", "data.seed=0", "heldout.scans=1"],
    "passages": [
        "data=plan_scans", "data.scans=6", "data.seed=0", "folds=2", "data@heldout=plan_scans_heldout", "heldout.scans=4"
    ],
    "wall_doors": [
        *(f"{of}.scans=2" for of in ("data", "frameless", "flat", "heldout", "heldout_frameless", "heldout_flat")),
        *(f"{of}.seed=0" for of in ("data", "frameless", "flat")), "folds=2",
    ],
    "room_odds": [
        "data=plan_scans", "data.scans=4", "open.scans=2", "closed.scans=2", "grids.scans=2", "folds=2",
        *(f"{of}.seed=0" for of in ("data", "open", "closed", "grids")),
        *(f"{of}.scans=1" for of in ("heldout", "heldout_open", "heldout_grids")),
    ],
    "place_evidence": [*NETWORKS["place_evidence"], *SMALL_GRIDS],
    "merge_belief": [*SMALL_GRIDS, *WITHOUT_MORE["merge_belief"], "folds=2"],
    "match_odds": [*SMALL_PAIRS, "folds=2"],
    "match_belief": ["data.pairs=6", "data.rooms=[6,8]", *SMALL_PAIRS[2:], "folds=2"],  # fewer have no rooms that match
    "feature_scale": SMALL_PAIRS,
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("task", list(SIMULATED))
def test_from_simulated_data_to_a_merge(task: str, tmp_path: Path) -> None:
    """The whole way, as typed: data is made, weights trained and exported, judged, and used by extract and merge."""
    common = [f"task={task}", f"cache={tmp_path / 'cache'}", *SIMULATED[task]]
    done = run("train.py", *common, f"runs={tmp_path}", f"export={tmp_path / 'exported'}")
    assert done.returncode == 0, done.stderr
    assert list((tmp_path / task / "tb").glob("events*"))
    done = run("evaluate.py", *common, f"run={tmp_path / task}", f"folder={tmp_path / 'eval'}")
    assert done.returncode == 0 and "| score | value |" in done.stdout, done.stderr
    weights = {VARIABLE: str(tmp_path / "exported")}
    pair = ["--building", "office", "--seed", "5", "--sensors", "tls,depth", "--rooms", "8", "--overlap", "0.7"]
    assert run("-m", "topomerge", "simulate", *pair, "-o", str(tmp_path / "pair")).returncode == 0
    files = [str(tmp_path / "pair" / name) for name in ("a.ply", "b.ply")]
    done = run("-m", "topomerge", "merge", *files, "-o", str(tmp_path / "merged"), **weights)
    assert done.returncode in (0, 2), done.stderr
