"""Figures of an evaluation: reliability, recall by overlap, precision against recall."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.archive import replace_on_success
from topomerge.evaluation.merge_tables import select_last_variant
from topomerge.evaluation.score import OVERLAPS, Row
from topomerge.evaluation.tables import compute_value
from topomerge.statistics import measure_calibration

ROUNDS = 500


def save_figures(ranks: Sequence[Row], matches: Sequence[Row], merges: Sequence[Row], folder: Path) -> list[str]:
    """Draw what there is something to draw of; names of the files."""
    done = []
    for name, draw in (
        ("reliability", _draw_reliability),
        ("overlap", _draw_overlap),
        ("pr", _draw_precision_recall),
    ):
        figure = draw(ranks, matches, merges)
        if figure is not None:
            with replace_on_success(folder / f"{name}.png") as temporary:
                figure.savefig(temporary, dpi=120, bbox_inches="tight", format="png")
            done.append(f"{name}.png")
    return done


def _create_figure(columns: int) -> tuple[Any, Any]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.4 * columns, 3.6))
    return figure, figure.subplots(1, columns, squeeze=False)[0]


def _add_legend(ax: Any) -> None:
    """Below the axes, where it hides nothing; none where nothing is drawn, as of merges that were not asked for."""
    if ax.get_legend_handles_labels()[0]:
        ax.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.17), ncols=2, frameon=False)


def _group_rows(rows: Sequence[Row], key: str) -> dict[str, list[Row]]:
    out: dict[str, list[Row]] = {}
    for row in rows:
        out.setdefault(row[key], []).append(row)
    return out


def _collect_values(rows: Sequence[Row], key: str) -> list[Any]:
    return [value for row in rows for value in row[key]]


def _draw_reliability(ranks: Sequence[Row], matches: Sequence[Row], merges: Sequence[Row]) -> Any:
    """Share that was right against the probability that was told, over bins of equal mass; merges by where the maps come from."""
    by_origin = _group_rows(select_last_variant(merges), "origin")
    sets = [("merges", {n: ([r["probability"] for r in s], [r["near"] for r in s]) for n, s in by_origin.items()})]
    rows_with_probability = [m for m in matches if m["k"] == 0 and m["method"] in ("consistent", "mutual")]
    named = _group_rows([{**m, "title": f"{m['variant']} {m['method']}"} for m in rows_with_probability], "title")
    sets.append(("matches of rooms", {n: (_collect_values(s, "chance"), _collect_values(s, "good")) for n, s in named.items()}))
    sets = [(title, predictions) for title, predictions in sets if any(len(p) for p, _ in predictions.values())]
    if not sets:
        return None
    figure, axes = _create_figure(len(sets))
    for ax, (title, predictions) in zip(axes, sets, strict=True):
        ax.plot([0, 1], [0, 1], color="0.7", lw=1)
        for name, (p, y) in predictions.items():
            if len(p):
                c = measure_calibration(p, y)
                line = ax.plot(c.probability, c.right, "o-", ms=4, label=f"{name} ({len(p)}; ECE {c.error:.2f})")[0]
                if len(predictions) == 1:
                    for x, r, n in zip(c.probability, c.right, c.count, strict=True):
                        ax.annotate(
                            str(n), (x, r), fontsize=7, color=line.get_color(), xytext=(3, -9), textcoords="offset points"
                        )
        ax.set(title=title, xlabel="predicted probability", ylabel="share right", xlim=(0, 1), ylim=(0, 1.02))
        _add_legend(ax)
    return figure


def _draw_overlap(ranks: Sequence[Row], matches: Sequence[Row], merges: Sequence[Row]) -> Any:
    """Recall of rooms and merges by the share of rooms in common."""
    bins = [name for _, name in OVERLAPS]
    if not any(r["overlap"] in bins for r in ranks):
        return None
    panels = [("recall@1 of rooms", "recall@1", {n: s for n, s in _group_rows(ranks, "variant").items() if s[0]["k"] == 0})]
    method_rows = [
        {**m, "title": f"{m['variant']}, {m['method']}"}
        for m in matches
        if m["k"] == 0 and m["method"] in ("growing", "consistent")
    ]
    panels.append(("F1 of matches", "F1", _group_rows(method_rows, "title")))
    if merges:
        panels.append(("pairs merged right", "merged", _group_rows(merges, "variant")))
    figure, axes = _create_figure(len(panels))
    for ax, (title, metric, rows_by_name) in zip(axes, panels, strict=True):
        for shift, (name, rows) in enumerate(rows_by_name.items()):
            values = [compute_value([r for r in rows if r["overlap"] == b], metric, ROUNDS) for b in bins]
            x = np.arange(len(bins)) + 0.05 * (shift - len(rows_by_name) / 2)
            mid = np.array([v.value for v in values])
            ends = np.array([[max(v.value - v.low, 0), max(v.high - v.value, 0)] for v in values]).T
            ax.errorbar(x, mid, yerr=np.nan_to_num(ends), fmt="o-", ms=4, lw=1, capsize=2, label=name)
        ax.set(title=title, xlabel="share of rooms in common", xticks=range(len(bins)), xticklabels=bins, ylim=(0, 1.02))
        _add_legend(ax)
    return figure


def _draw_precision_recall(ranks: Sequence[Row], matches: Sequence[Row], merges: Sequence[Row]) -> Any:
    """Precision against recall of matches, as the least probability that is taken falls; dots: methods that tell none."""
    if not matches:
        return None
    figure, (ax,) = _create_figure(1)
    for name, variant_rows in _group_rows(matches, "variant").items():
        if variant_rows[0]["k"]:
            continue
        color = None
        for method, method_rows in _group_rows(variant_rows, "method").items():
            units = sum(r["units"] for r in method_rows)
            p = np.concatenate([r["chance"] for r in method_rows])
            good = np.concatenate([r["good"] for r in method_rows]).astype(float)
            if not len(p) or not units:
                continue
            if method in ("consistent", "mutual"):
                order = np.argsort(-p, kind="stable")
                right = good[order].cumsum()
                share = sum(r["found"] for r in method_rows) / max(good.sum(), 1)  # pieces of a room found twice count once
                line = ax.plot(
                    right * share / units, right / np.arange(1, len(p) + 1), lw=1.2, color=color, label=f"{name}, {method}"
                )
                color = line[0].get_color()
            else:
                v = [compute_value(method_rows, m, 1).value for m in ("recall", "precision")]
                mark = {"full": "s", "assignment": "o", "growing": "^"}.get(method, "x")
                dot = ax.plot(*v, mark, ms=5, color=color, label=f"{name}, {method}")
                color = dot[0].get_color()
    ax.set(xlabel="recall of rooms in common", ylabel="precision", xlim=(0, 1), ylim=(0, 1.02))
    _add_legend(ax)
    return figure
