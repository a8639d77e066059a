"""The runs of a folder as one table, Markdown: ``python -m topomerge.training.table runs/sweep``.

A second table has the mean over the seeds of runs that differ in nothing else, with its 95 % interval (Student's t); of
two seeds with both.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.archive import replace_on_success
from topomerge.errors import InputError
from topomerge.registry import TASKS, load_plugins
from topomerge.statistics import estimate_mean
from topomerge.training.run_folder import MAY_CHANGE
from topomerge.training.tasks import DEFAULT_TASK
from topomerge.types import Array


class SweepTable:
    """Hydra's callback that writes table.md when all runs of a sweep have ended."""

    def _ignore_event(self, **_: Any) -> None:
        """What else Hydra reports."""

    on_run_start = on_run_end = on_multirun_start = on_job_start = on_job_end = on_compose_config = _ignore_event

    def on_multirun_end(self, config: Any, **_: Any) -> None:
        """Write the table when Hydra's sweep has ended."""
        folder = Path(str(config.hydra.sweep.dir))
        if folder.is_dir():
            print(f"{write_table(folder)}")


def write_table(folder: str | Path) -> Path:
    """Write table.md into a folder of runs, best first.

    Raises:
        InputError: no runs in it.
    """
    folder = Path(folder)
    rows = [row for path in sorted(folder.rglob("metrics.jsonl")) if (row := read_best_epoch(path.parent)) is not None]
    if not rows:
        raise InputError(f"{folder}: no runs in it")
    rows.sort(key=lambda row: -row["best"])
    columns = list(dict.fromkeys(name for row in rows for name in row if name not in ("best", "same")))
    lines = format_table(rows, columns)
    if gathered := gather_seeds(rows):
        lines += [
            "",
            "Mean over seeds, with its 95 % interval:",
            "",
            *format_table(gathered, ["seeds" if n == "seed" else n for n in columns]),
        ]
    with replace_on_success(folder / "table.md") as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return folder / "table.md"


def gather_seeds(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return a row for all runs that differ in nothing but the seed, where there are several: numbers as mean and interval."""
    groups: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault(row["same"], []).append(row)
    out = []
    for group in groups.values():
        if len({row["seed"] for row in group}) < 2:
            continue
        first = group[0]
        row = {"run": re.sub(r"(^|,)seed=[^,]*", "", first["run"]).strip(",") or "all", "seeds": len(group)}
        for name in (name for name in first if name not in ("run", "seed", "same", "best")):
            values = [one[name] for one in group]
            numbers = isinstance(first[name], float) and name != "s an epoch"
            row[name] = _format_mean(np.array(values)) if numbers else first[name]
        out.append({key: value for key, value in row.items() if key not in ("epoch", "s an epoch")})
    return out


def _format_mean(values: Array) -> str:
    """Mean with its interval; of two values, whose interval would tell nothing, with these."""
    mean, low, high = estimate_mean(values) if len(values) > 2 else (values.mean(), values.min(), values.max())
    return f"{mean:.3f} [{low:.3f}, {high:.3f}]" if len(values) > 2 else f"{mean:.3f}, {low:.3f}–{high:.3f}"


def format_table(rows: Sequence[dict[str, Any]], columns: Sequence[str]) -> list[str]:
    """Format rows as the lines of a table in Markdown."""
    head = [name for name in columns if any(name in row for row in rows)]
    lines = [f"| {' | '.join(head)} |", f"|{'---|' * len(head)}"]
    return lines + [f"| {' | '.join(_format_cell(row.get(name, '–')) for name in head)} |" for row in rows]


def _format_cell(value: Any) -> str:
    return f"{value:.3f}" if isinstance(value, float) else str(value)


def read_best_epoch(run: Path) -> dict[str, Any] | None:
    """Return the best epoch of a run; None where there is none yet."""
    config = json.loads((run / "config.json").read_text(encoding="utf-8"))
    rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text(encoding="utf-8").splitlines()]
    if not rows:
        return None
    load_plugins(config.get("plugins", []))
    task = TASKS[config.get("task", DEFAULT_TASK)]
    sign = -1 if config["watch"] in task.lower else 1
    best = max(rows, key=lambda row: sign * float(row[f"val/{config['watch']}"]))
    same = json.dumps({key: value for key, value in config.items() if key not in MAY_CHANGE - {"epochs", "patience"} | {"seed"}})
    about = task.describe(config)
    return {
        "run": run.name,
        "best": sign * float(best[f"val/{config['watch']}"]),
        "same": same,
        **about,
        "seed": config["seed"],
        **{f"val {name}" if name in about else name: best.get(f"val/{name}", "–") for name in task.scores},
        "epoch": best["epoch"] + 1,
        "s an epoch": sum(float(row["seconds"]) for row in rows) / len(rows),
    }


if __name__ == "__main__":
    try:
        print(write_table(sys.argv[1]).read_text(encoding="utf-8"))
    except (InputError, IndexError) as error:
        sys.exit(f"table: {error if isinstance(error, InputError) else 'name a folder of runs'}")
