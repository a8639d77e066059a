"""The tasks of `train.py` and `evaluate.py`: every learned part that ships, in the order in which they depend on each other."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from topomerge.errors import InputError
from topomerge.io.weight_files import weights_file

Say = Callable[[str], None]


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


def register_tasks() -> None:
    """Let Hydra know the keys of every task."""
    from topomerge.config import register

    for name in TASKS:
        register(name, schema_of(name), group="task")


def schema_of(task: str) -> type[Any]:
    """The dataclass of a task's settings.

    Raises:
        InputError: there is no such task.
    """
    if task not in TASKS:
        raise InputError(f"task={task}: {', '.join(TASKS)} are possible")
    if task == "embedding":
        from topomerge.training.settings import with_recipe

        return with_recipe()
    schema: type[Any] = getattr(import_module(f"topomerge.training.{TASKS[task].settings}"), TASKS[task].schema)
    return schema


def task_of(words: Sequence[str]) -> str:
    """The task that the words of a command line name; `embedding` where they name none.

    Raises:
        InputError: there is no such task.
    """
    task = next((word[len("task=") :] for word in reversed(words) if word.startswith("task=")), "embedding")
    schema_of(task)
    return task


def settings_of(words: Sequence[str] = ()) -> Any:
    """Settings of a task from `configs/train.yaml` and words like ``task=plan_segmentation data.scans=20``, by Hydra.

    Raises:
        InputError: one line with the key's name.
    """
    from topomerge.config import compose

    register_tasks()
    return _checked(compose("train", schema_of(task_of(words)), words))


def settings_from(config: Any) -> Any:
    """Settings of a task from what Hydra composed.

    Raises:
        InputError: one line with the key's name.
    """
    from topomerge.config import typed

    return _checked(typed(config, schema_of(str(config.task))))


def _checked(settings: Any) -> Any:
    if settings.task == "embedding":
        from topomerge.training.settings import composed

        return composed(settings)
    from topomerge.training.task_check import check_task

    check_task(settings)
    return settings


def train(settings: Any, say: Say) -> Mapping[str, float]:
    """Train a task, and leave a run's folder (`training.run_folder`).

    Returns:
        The scores of what is best.

    Raises:
        InputError: settings that make no sense, data or a state that can't be read.
        KeyboardInterrupt: after Ctrl-C or SIGTERM.
    """
    module = import_module(f"topomerge.training.{TASKS[settings.task].module}")
    scores: Mapping[str, float] = module.fit(settings, say)
    return scores


def weights_of(task: str, run: str) -> Path:
    """The file of weights of a run, a folder or a file; of the package where `run` is empty.

    Raises:
        InputError: there is none.
    """
    name = TASKS[task].file
    if not run:
        return weights_file(TASKS[task].package, name)
    places = (Path(run), Path(run) / "best" / name, Path(run) / name)
    path = next((path for path in places if path.is_file()), None)
    if path is None:
        raise InputError(f"run={run}: holds no {name}; name a run of task={task}, or what it exported")
    return path
