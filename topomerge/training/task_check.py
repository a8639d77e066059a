"""What the settings of the tasks of `train.py` may be."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from topomerge.datasets.pairs.own_pairs import OWN_DATA, check_own_path
from topomerge.errors import InputError
from topomerge.extraction.elevations.elevation import WALL_CLASSES
from topomerge.training.scan_settings import PlanSegmentation, WallSegmentation
from topomerge.training.settings import TaskSettings, check_numbers
from topomerge.training.task_settings import LOOKALIKES_TAKEN, MergeBelief, RoomMatching


def check_task(settings: TaskSettings) -> None:
    """Refuse what makes no sense.

    Raises:
        InputError: names the key.
    """
    check_numbers(asdict(settings))
    keys = ("epochs", "batch", "steps", "hidden", "networks", "hypotheses", "inspected")
    at_least = {**dict.fromkeys(keys, 1), "jobs": 1, "patience": 0, "seed": 0, "warmup": 0, "folds": 2, "hold_out": 2}
    for key, least in at_least.items():
        if getattr(settings, key, least) < least:
            raise InputError(f"{key} must be {least} or more, not {getattr(settings, key)}")
    for key in ("rate", "pose_strength", "winner_strength", "kinds_strength"):
        if not getattr(settings, key, 1.0) > 0:
            raise InputError(f"{key} must be above 0, not {getattr(settings, key)}")
    if getattr(settings, "decay", 0.0) < 0:
        raise InputError(f"decay must be 0 or more, not {settings.decay}")  # type: ignore[attr-defined]
    if not 0 < getattr(settings, "risk", 20.0) <= 1000:
        raise InputError(f"risk must be above 0 and at most 1000, not {settings.risk}")  # type: ignore[attr-defined]
    if not 0 <= getattr(settings, "floor", 0.5) <= 10:
        raise InputError(f"floor must be 0 to 10, not {settings.floor}")  # type: ignore[attr-defined]
    if getattr(settings, "half", 0) not in (0, 1, 2):
        raise InputError(f"half must be 0, 1 or 2, not {settings.half}")  # type: ignore[attr-defined]
    if isinstance(settings, MergeBelief) and settings.lookalikes not in LOOKALIKES_TAKEN:
        raise InputError(f"lookalikes must be {', '.join(LOOKALIKES_TAKEN)}, not {settings.lookalikes!r}")
    if isinstance(settings, MergeBelief) and settings.refit not in ("all", "closely", "plan"):
        raise InputError(f"refit must be all, closely or plan, not {settings.refit!r}")
    if getattr(settings, "accelerator", "cpu") not in ("cpu", "cuda"):
        raise InputError(f"accelerator must be cpu or cuda, not {settings.accelerator!r}")  # type: ignore[attr-defined]
    if len(getattr(settings, "halves", [])) not in (0, 2):
        raise InputError(f"halves must name two runs, not {settings.halves}")  # type: ignore[attr-defined]
    data = getattr(getattr(settings, "data", None), "name", "")
    if isinstance(settings, RoomMatching):
        check_own_path(data, settings.path)
    elif data == OWN_DATA:
        raise InputError(f"data={OWN_DATA}: is for the tasks embedding and room_matcher, not for {settings.task}")
    if not settings.name or Path(settings.name).is_absolute() or ".." in Path(settings.name).parts:
        raise InputError(f"name must name a folder inside {settings.runs}, not {settings.name!r}")
    if isinstance(settings, PlanSegmentation):
        if settings.crop < 16 or settings.crop % 16:
            raise InputError(f"crop must be a multiple of 16, not {settings.crop}")
        if len(settings.widths) != 8 or min(settings.widths) < 1:
            raise InputError(f"widths must be 8 numbers of channels, not {settings.widths}")
        if len(settings.loss.classes) != 5 or min(settings.loss.classes) <= 0:
            raise InputError(f"loss.classes must be 5 weights above 0, not {settings.loss.classes}")
    if isinstance(settings, WallSegmentation):
        if len(settings.widths) != 4 or min(settings.widths) < 1:
            raise InputError(f"widths must be 4 numbers of channels, not {settings.widths}")
        if settings.length < 8 or settings.length % 2:
            raise InputError(f"length must be an even number of places, 8 or more, not {settings.length}")
        if len(settings.classes) != len(WALL_CLASSES) or min(settings.classes) <= 0:
            raise InputError(f"classes must be {len(WALL_CLASSES)} weights above 0, not {settings.classes}")
