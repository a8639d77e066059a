"""Markdown tables of the extraction's benchmark."""

from __future__ import annotations

from typing import Any

import numpy as np

from topomerge.metrics import bootstrap

Row = dict[str, Any]
COLUMNS = (
    ("iou", "IoU"), ("mcc", "MCC"), ("precision", "P"), ("recall", "R"), ("door_precision", "doors P"), ("door_recall", "doors R"),
    ("edge_precision", "edges P"), ("edge_recall", "edges R"), ("storeys", "storeys"), ("seconds", "s"),
)  # fmt: skip
FAILED = 0.5


def markdown(rows: list[Row]) -> str:
    """A table of the cases, and one of the sets."""
    lines = ["| case | preset | rooms | " + " | ".join(n for _, n in COLUMNS) + " |", "|---" * (3 + len(COLUMNS)) + "|"]
    for row in rows:
        counts = f"{row.get('found', 0)}/{row.get('rooms', 0)}"
        lines.append(f"| {row['case']} | {row['preset']} | {counts} | " + " | ".join(_cell(row.get(k)) for k, _ in COLUMNS) + " |")
    lines += ["", "| set | preset | cases | " + " | ".join(n for _, n in COLUMNS) + " |", "|---" * (3 + len(COLUMNS)) + "|"]
    for name, preset in dict.fromkeys((r["set"], r["preset"]) for r in rows):
        these = [r for r in rows if (r["set"], r["preset"]) == (name, preset)]
        lines.append(f"| {name} | {preset} | {len(these)} | " + " | ".join(_mean(these, k) for k, _ in COLUMNS) + " |")
    return "\n".join(lines)


def _cell(value: Any) -> str:
    return "–" if value is None or not np.isfinite(value) else f"{value:.2f}"


def _mean(rows: list[Row], key: str) -> str:
    values = np.array([r.get(key, np.nan) for r in rows], float)
    mean, low, high = bootstrap(values, np.array([r["place"] for r in rows]))
    return "–" if not np.isfinite(mean) else f"{mean:.2f}" + (f" [{low:.2f}, {high:.2f}]" if key in ("iou", "mcc") else "")
