"""Precision against recall of ours and of the peers: a picture of two panels, ordinary scans and all pairs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from benchmarks.merging.peer_rows import curve, methods_of
from benchmarks.merging.tables import METHOD_TITLES, Row

INK, GRID = "#444444", "#dddddd"
LINES = {  # colour, dashes
    "ours": ("#20639b", "-"), "learned": ("#20639b", ":"), "kiss02": ("#b5651d", "-"), "kiss03": ("#b5651d", "--"),
    "fpfh": ("#6b8e5a", "-"), "fgr": ("#7d6b91", "-"),
}  # fmt: skip


def draw_curves(groups: Mapping[str, Sequence[Row]], path: Path) -> None:
    """A panel a group of rows (`peer_rows.answers`), a line a method; the dot is at the threshold of the verdict."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.2 * len(groups), 4.0), layout="constrained", facecolor="white")
    panels = figure.subplots(1, len(groups), squeeze=False)[0]
    for panel, (title, rows) in zip(panels, groups.items(), strict=True):
        for method in methods_of(rows):
            mine = [r for r in rows if r["method"] == method]
            precision, recall = curve(mine)
            color, dashes = LINES[method]
            panel.plot(recall, precision, color=color, linestyle=dashes, linewidth=1.6, label=METHOD_TITLES[method])
            if any(r["believed"] for r in mine):
                panel.plot(*_believed(mine), marker="o", color=color, markersize=5)
        panel.set(xlim=(0, 1.02), ylim=(0, 1.04))
        panel.set_xlabel("recall", fontsize=9, color=INK)
        panel.set_ylabel("precision", fontsize=9, color=INK)
        panel.set_title(title, fontsize=9, color=INK, loc="left")
        panel.grid(color=GRID, linewidth=0.6)
        panel.tick_params(labelsize=8, colors=INK)
        panel.spines[["top", "right"]].set_visible(False)
    figure.legend(*panels[-1].get_legend_handles_labels(), fontsize=8, frameon=False, loc="outside lower center", ncols=6)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)


def _believed(rows: Sequence[Row]) -> tuple[float, float]:
    """Recall and precision of what the verdict believes."""
    from benchmarks.merging.peer_thresholds import possible
    from benchmarks.merging.tables import good

    believed = [good(r) for r in rows if r["believed"]]
    return sum(believed) / max(sum(map(possible, rows)), 1), sum(believed) / len(believed)
