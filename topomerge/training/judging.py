"""What `evaluate.py task=...` does for the parts that are no embedder: scores of weights on buildings that trained nothing."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from topomerge.errors import InputError
from topomerge.io.atomic import replacing
from topomerge.training.tasks import TASKS, Say, settings_of, weights_of


@dataclass(frozen=True)
class Judgement:
    """Scores, as numbers and as a Markdown table, and the folder that they are written to."""

    scores: dict[str, Any]
    summary: str
    folder: Path


def judge_task(task: str, words: Sequence[str], say: Say) -> Judgement:
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
    settings = settings_of(rest)
    file = weights_of(task, named.get("run", ""))
    module = import_module(f"topomerge.training.{TASKS[task].module}")
    scores = dict(module.judge(settings, file, say))
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
        with replacing(folder / name) as beside:
            beside.write_text(text + "\n", encoding="utf-8")
    return Judgement(scores, summary, folder)
