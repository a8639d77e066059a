"""The tasks of `train.py` and `evaluate.py`: every learned part that ships."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from topomerge.errors import InputError
from topomerge.io.archive import find_weights_file, replace_on_success
from topomerge.types import LogFn


@dataclass(frozen=True)
class Task:
    """A learned part.

    Args:
        module: of `topomerge.training`: its function `fit(settings, say)` trains, `judge(settings, file, say)` gives the scores
            of a file of weights on buildings that trained nothing.
        schema: its settings, in the module `settings` of `topomerge.training`.
        package, file: where its weights ship.
        hours: that `make weights` takes for it on two cores, about; once it ran, what it took stands instead.
    """

    module: str
    schema: str
    package: str
    file: str
    hours: float
    settings: str = "task_settings"


TASKS = {
    "plan_segmentation": Task(
        "plan_segmentation", "PlanSegmentation", "topomerge.networks", "plan_network.onnx", 5.0, "scan_settings"
    ),
    "grid_segmentation": Task(
        "plan_segmentation", "GridSegmentation", "topomerge.networks", "grid_network.onnx", 1.2, "scan_settings"
    ),
    "door_classification": Task(
        "door_classification", "DoorClassification", "topomerge.extraction.plans", "door_classifier.json", 0.7, "scan_settings"
    ),
    "wall_segmentation": Task(
        "wall_segmentation", "WallSegmentation", "topomerge.networks", "wall_network.onnx", 1.2, "scan_settings"
    ),
    "passages": Task("passages", "Passages", "topomerge.extraction", "passages.json", 0.2, "scan_settings"),
    "wall_doors": Task("wall_doors", "WallDoors", "topomerge.extraction.elevations", "wall_doors.json", 0.2, "scan_settings"),
    "room_odds": Task("room_odds", "RoomOdds", "topomerge.extraction", "room_odds.json", 0.5, "scan_settings"),
    "feature_scale": Task("feature_scale", "FeatureScale", "topomerge.embedding", "engineered.json", 0.3),
    "match_odds": Task("match_odds", "MatchOdds", "topomerge.matching", "odds.json", 0.3),
    "place_evidence": Task("place_evidence", "PlaceEvidence", "topomerge.networks", "place_network.onnx", 4.0),
    "match_belief": Task("match_belief", "MatchBelief", "topomerge.fusion", "match_belief.json", 0.3),
    "merge_belief": Task("merge_belief", "MergeBelief", "topomerge.registration", "calibration.json", 4.0),
    "embedding": Task("embedding", "", "topomerge.networks", "embedder.onnx", 0.6),
    "room_matcher": Task("room_matcher", "RoomMatching", "topomerge.networks", "room_matcher.onnx", 0.3),
}
RANKINGS = tuple(f"recall@{k}{of}" for k in (1, 5) for of in ("", "_single", "_twin"))
PLAN_CLASSES = ("inside", "wall", "doorway", "shut", "outside")
PLAN_SCORES = ("mean_iou", "mean_f1", "accuracy", *(f"{of}_{name}" for of in ("iou", "f1") for name in PLAN_CLASSES))
SCORES = {  # of each task: what may be watched; the higher, the better
    "plan_segmentation": PLAN_SCORES,
    "grid_segmentation": PLAN_SCORES,
    "door_classification": ("auc", "precision", "recall", "accuracy"),
    "wall_segmentation": ("f1_doors", "f1_wall", "f1_open", "f1_shut", "f1_window", "f1_half", "f1_niche", "f1_cupboard"),
    "passages": ("log_loss", "accuracy"),
    "wall_doors": ("precision", "recall"),
    "room_odds": ("entered_auc", "whole_auc", "confidence_auc"),
    "feature_scale": ("recall@1", "recall@5", "mrr"),
    "match_odds": ("match_accuracy", "hypothesis_accuracy"),
    "place_evidence": ("auc",),
    "match_belief": ("attention_all_after_accuracy",),
    "merge_belief": ("right_believed", "right_first"),
    "embedding": (*RANKINGS, "recall@1_clear", "recall@5_clear", "mrr", "precision", "recall", "f1", "merged"),
    "room_matcher": (*RANKINGS, "mrr", "precision", "recall", "f1", "turn"),
}


def register_tasks() -> None:
    """Let Hydra know the keys of every task."""
    from topomerge.config import register

    for name in TASKS:
        register(name, get_schema(name), group="task")


def get_schema(task: str) -> type[Any]:
    """Return the dataclass of a task's settings.

    Raises:
        InputError: there is no such task.
    """
    if task not in TASKS:
        raise InputError(f"task={task}: {', '.join(TASKS)} are possible")
    if task == "embedding":
        from topomerge.training.settings import build_recipe_schema

        return build_recipe_schema()
    schema: type[Any] = getattr(import_module(f"topomerge.training.{TASKS[task].settings}"), TASKS[task].schema)
    return schema


def parse_task(words: Sequence[str]) -> str:
    """Parse the task that the words of a command line name; `embedding` where they name none.

    Raises:
        InputError: there is no such task.
    """
    task = next((word[len("task=") :] for word in reversed(words) if word.startswith("task=")), "embedding")
    get_schema(task)
    return task


def compose_settings(words: Sequence[str] = ()) -> Any:
    """Return settings of a task from `configs/train.yaml` and words like ``task=plan_segmentation data.scans=20``, by Hydra.

    Raises:
        InputError: one line with the key's name.
    """
    from topomerge.config import compose

    register_tasks()
    return _check_settings(compose("train", get_schema(parse_task(words)), words))


def convert_settings(config: Any) -> Any:
    """Return settings of a task from what Hydra composed.

    Raises:
        InputError: one line with the key's name.
    """
    from topomerge.config import convert_to_dataclass

    return _check_settings(convert_to_dataclass(config, get_schema(str(config.task))))


def _check_settings(settings: Any) -> Any:
    if settings.task == "embedding":
        from topomerge.training.settings import convert_composed

        return convert_composed(settings)
    from topomerge.training.task_check import check_task

    check_task(settings)
    return settings


def train(settings: Any, log_line: LogFn) -> Mapping[str, float]:
    """Train a task, and leave a run's folder (`training.run_folder`).

    Returns:
        The scores of what is best.

    Raises:
        InputError: settings that make no sense, data or a state that can't be read.
        KeyboardInterrupt: after Ctrl-C or SIGTERM.
    """
    if settings.task != "embedding":  # which does so itself, with and without Hydra
        check_start(settings)
    module = import_module(f"topomerge.training.{TASKS[settings.task].module}")
    scores: Mapping[str, float] = module.fit(settings, log_line)
    return scores


def check_start(settings: Any) -> None:
    """Refuse, before any data is made, what a training would stumble over later.

    Raises:
        InputError: a score to watch that there is not, an accelerator that is not here, a folder that holds another run.
    """
    from topomerge.training.provenance import check_folder

    possible = SCORES[settings.task]
    if settings.watch not in possible:
        raise InputError(f"watch: unknown {settings.watch!r}; {', '.join(possible)} are possible for task={settings.task}")
    check_accelerator(settings)
    check_folder(settings.folder, asdict(settings))


def check_accelerator(settings: Any) -> None:
    """Refuse an accelerator that is not here.

    Raises:
        InputError: names the key.
    """
    name, requested = getattr(settings, "accelerator", "cpu"), getattr(settings, "devices", 1)
    scaled = name == "auto" and getattr(settings, "precision", "") == "16-mixed"  # which no processor has
    if name not in ("cuda", "gpu") and not scaled:
        return
    import torch

    if not torch.cuda.is_available():
        raise InputError(f"accelerator={name}: torch finds no such device here; leave it out to train on the processor")
    if torch.cuda.device_count() < requested:
        raise InputError(f"devices={requested}: torch finds {torch.cuda.device_count()} here")


def find_weights(task: str, run: str) -> Path:
    """Find the file of weights of a run, a folder or a file; of the package where `run` is empty.

    Raises:
        InputError: there is none.
    """
    name = TASKS[task].file
    if not run:
        return find_weights_file(TASKS[task].package, name)
    places = (Path(run), Path(run) / "best" / name, Path(run) / name)
    path = next((path for path in places if path.is_file()), None)
    if path is None:
        raise InputError(f"run={run}: holds no {name}; name a run of task={task}, or what it exported")
    return path


@dataclass(frozen=True)
class EvaluationResult:
    """Scores, as numbers and as a Markdown table, and the folder that they are written to."""

    scores: dict[str, Any]
    summary: str
    folder: Path


def evaluate_task(task: str, words: Sequence[str], log_line: LogFn) -> EvaluationResult:
    """Judge the weights that ship, or those of a run (``run=runs/x``), on the task's `heldout` data.

    Args:
        words: overrides like those of `train.py`; besides ``run=`` and ``folder=`` (runs/eval).

    Raises:
        InputError: a wrong word, no such weights, or no data.
    """
    if task not in TASKS or task == "embedding":
        raise InputError(f"task={task}: {', '.join(TASKS)} are possible")
    named = {key: word[len(key) + 1 :] for key in ("run", "folder") for word in words if word.startswith(f"{key}=")}
    rest = [word for word in words if not word.startswith(("run=", "folder="))]
    settings = compose_settings(rest)
    file = find_weights(task, named.get("run", ""))
    module = import_module(f"topomerge.training.{TASKS[task].module}")
    scores = dict(module.judge(settings, file, log_line))
    own = getattr(settings, "path", "")
    heldout = Path(own).resolve().name if own else settings.heldout.name
    folder = Path(named.get("folder", "runs/eval")) / f"{task}-{heldout}"
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    record = {"task": task, "weights": str(file), "sha256": digest, "heldout": heldout, "scores": scores}
    texts = {name: f"{value:.3f}" if isinstance(value, float) else str(value) for name, value in scores.items()}
    rows = [f"| {name} | {text} |" for name, text in texts.items()]
    head = f"{task}: {file.name} of {named.get('run') or 'the package'} on {heldout}"
    summary = "\n".join([f"{head}\n", "| score | value |", "|---|---|", *rows])
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in (("scores.json", json.dumps(record, indent=1)), ("report.md", f"# {summary}")):
        with replace_on_success(folder / name) as beside:
            beside.write_text(text + "\n", encoding="utf-8")
    return EvaluationResult(scores, summary, folder)
