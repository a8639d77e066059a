"""Make all weights that ship again, in their order: ``python -m topomerge.training.weights`` (``make weights``).

A step that has ended is left as it is, one that was cut off goes on. Before each step it says how long what is left takes: by the
seconds that the steps took the last time, or about, where they never ran. Words like ``jobs=2`` or ``cache=...`` go to every
step; ``only=match_odds,feature_scale`` makes these only; ``export=`` (nothing) leaves the weights in the runs.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from topomerge.archive import replace_on_success
from topomerge.datasets.core.builder import run_script
from topomerge.errors import InputError
from topomerge.progress import Stopwatch
from topomerge.registry import TASKS
from topomerge.training.tasks import compose_settings, train

RUNS = Path("runs/weights")


def main(arguments: Sequence[str]) -> int:
    """Train every task that has not ended."""
    if {"-h", "--help"} & set(arguments):
        print(__doc__)
        return 0
    shipped = [task for task in TASKS if TASKS[task].hours]
    only = next((word[5:].split(",") for word in arguments if word.startswith("only=")), shipped)
    runs = Path(next((word[5:] for word in arguments if word.startswith("runs=")), str(RUNS)))
    shared = [word for word in arguments if not word.startswith(("only=", "runs="))]

    def work() -> None:
        if unknown := next((task for task in only if task not in shipped), ""):
            raise InputError(f"only={unknown}: {', '.join(shipped)} are possible")
        for task in [task for task in shipped if task in only]:
            seconds = _read_seconds(runs)
            left = [t for t in shipped if t in only and not _is_finished(runs, t)]
            if task not in left:
                _print_progress(f"{task}: is there ({runs / task})")
                continue
            _print_progress(
                f"{task}: about {_format_duration(seconds, [task])}; in all about {_format_duration(seconds, left)} left"
            )
            watch = Stopwatch()
            make_task(task, runs, shared)
            _record_seconds(runs, task, seconds.get(f"{task} so far", 0.0) + watch.elapsed)

    return run_script("weights", work)


def make_task(task: str, runs: Path, shared: Sequence[str]) -> None:
    """Build the sets of a task where it does not do so itself, and train it, or go on training it."""
    training_words = list(shared)
    if TASKS[task].sets:
        from topomerge.config import compose
        from topomerge.datasets.pairs.build import Build, build

        build_words = [word for word in shared if word.partition("=")[0] in ("cache", "jobs", "cluster")]
        for name in TASKS[task].sets:
            build(compose("build", Build, [f"data={name}", *build_words]), _print_progress)
        training_words = [word for word in shared if not word.startswith(("jobs=", "cluster=", "part="))]
    resume = "resume=true" if (runs / task / "last").exists() else "overwrite=true"
    exported = [] if any(word.startswith("export=") for word in shared) else ["export=package"]
    arguments = [f"task={task}", *TASKS[task].words, f"runs={runs}", f"name={task}", resume, *exported, *training_words]
    train(compose_settings(arguments), _print_progress)


def _print_progress(text: str) -> None:
    print(f"weights: {text}", file=sys.stderr, flush=True)


def _is_finished(runs: Path, task: str) -> bool:
    return f"{task} ended" in _read_seconds(runs)


def _read_seconds(runs: Path) -> dict[str, float]:
    """Read the seconds that were recorded of the steps."""
    path = runs / "seconds.json"
    seconds: dict[str, float] = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    return seconds


def _record_seconds(runs: Path, task: str, seconds: float) -> None:
    with replace_on_success(runs / "seconds.json") as temporary:
        temporary.write_text(json.dumps({**_read_seconds(runs), task: seconds, f"{task} ended": time.time()}, indent=1) + "\n")


def _format_duration(seconds: Mapping[str, float], tasks: Sequence[str]) -> str:
    """Tell how long steps take, by what they took or by what is usual."""
    hours = sum(seconds.get(task, 3600 * TASKS[task].hours) for task in tasks) / 3600
    return f"{hours:.1f} h" if hours >= 1 else f"{60 * hours:.0f} min"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
