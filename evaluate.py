"""Measure what the library makes, or judge a learned part on buildings that trained nothing.

    python evaluate.py data=heldout_small merge=false
    python evaluate.py data=heldout run=runs/x
    python evaluate.py data=real run=runs/x write=docs/results.md section=real-pairs
    python evaluate.py task=door_classification run=runs/door_classification jobs=2
    python evaluate.py task=rooms data=homes write=docs/results/rooms.md
    python evaluate.py task=merges data=test data.limit=40

Without `task=`: embedders and descriptors. Tasks of what the library makes: rooms, doors, windows, walls, merges, joined,
bending, atlases, retrieval, edits (topomerge/evaluation). All others are learned parts.

Predictions go to disk first (`runs/eval/<name>/predictions`), then they are scored: a run that was killed goes on where it was.
Keys: configs/evaluate.yaml and configs/data/*.yaml; of a learned part configs/task/<task>.yaml, whose `heldout` data
is judged on.
"""

from __future__ import annotations

import shlex
import sys
from pathlib import Path

from topomerge.datasets.core.builder import run_script

from topomerge.code_digest import find_other_clone
from topomerge.config import compose, find_plugins
from topomerge.evaluation.evaluate import evaluate
from topomerge.evaluation.settings import Evaluation
from topomerge.evaluation.tasks import MODULES, run_task
from topomerge.registry import TASKS
from topomerge.training.tasks import DEFAULT_TASK, evaluate_task, get_word


def print_progress(text: str) -> None:
    """Report the progress."""
    print(text, file=sys.stderr, flush=True)


def main(words: list[str]) -> int:
    """Read the settings with Hydra, evaluate, and print the short tables."""
    if {"-h", "--help"} & set(words):
        print(__doc__)
        return 0
    if other := find_other_clone(Path(__file__)):
        print_progress(f"evaluate: {other}")
    command = shlex.join(
        ["python", "evaluate.py", *words]
    )  # brackets and spaces in quotes, so that a shell takes it as it stands
    task = get_word(words, "task", DEFAULT_TASK)

    def work() -> None:
        find_plugins(words)
        if task not in MODULES and TASKS[task].is_descriptor:
            keys = [word for word in words if not word.startswith("task=")]
            keys = [f"run=[{w[4:]}]" if w.startswith("run=") and not w.startswith("run=[") else w for w in keys]
            scores = evaluate(compose("evaluate", Evaluation, keys), print_progress, command)
            print(f"{scores.summary}\n\nAll tables and figures: {scores.folder}")
        elif task in MODULES:
            outcome = run_task(task, words, print_progress)
            print(f"{outcome.summary}\n\nWritten to {outcome.folder}")
        else:
            judgement = evaluate_task(task, words, print_progress)
            print(f"{judgement.summary}\n\nWritten to {judgement.folder}")

    return run_script("evaluate", work)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
