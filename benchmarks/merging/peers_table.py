"""The section "Beside other methods" of docs/results/peers.md, and its figure, from what `peers.py` left in ``cache/merge``.

``python -m benchmarks.merging.peers_table docs/results/peers.md``
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from benchmarks.merging.peer_calls import CALL_SECONDS
from benchmarks.merging.peer_figure import draw_curves
from benchmarks.merging.peer_methods import EVALUATED_WITHIN, OPEN3D_VOXEL, RANSAC_ITERATIONS
from benchmarks.merging.peer_pairs import ORDINARY, PAIR_CLASSES, bin_of
from benchmarks.merging.peer_rows import (
    ANSWER_HEADS,
    answer_columns,
    answers_of,
    behind,
    by_area,
    crossed,
    curves_table,
    methods_of,
    negatives_by_kind,
)
from benchmarks.merging.peer_thresholds import THRESHOLDS_COMMAND, PeerVerdict, load_verdicts, possible
from benchmarks.merging.tables import METHOD_TITLES, Row, modality, put, table

CURVES_IMAGE = Path("images/peers_precision_recall.png")  # beside the folder of the page
LOOKALIKE_PAIRS = "lookalikes_heldout.jsonl"
PEERS_COMMANDS = (
    "`python -m benchmarks.merging.cached_pairs test jobs=2; python -m benchmarks.merging.cached_pairs train jobs=2; "
    f"{THRESHOLDS_COMMAND}; python -m benchmarks.merging.peers 3600 test; python -m benchmarks.merging.peers 900 raw; "
    "python -m benchmarks.merging.peers 900 thinned; "
    "python -m benchmarks.merging.peers 1800 real; python -m benchmarks.merging.peers_table docs/results/peers.md`"
)
PEERS_SETUP = (
    "One core, one thread, seconds of processor from points in memory to the pose. Everyone gets the means of the points of "
    "0.1 m cells but where the table says *raw*. KISS-Matcher 1.0.2 thins them itself, at 0.2 or 0.3 m, with its own noise "
    f"bounds (1 and 0.75 voxels). Open3D 0.19: {OPEN3D_VOXEL} m, FPFH within five voxels, FGR, and RANSAC of "
    f"{RANSAC_ITERATIONS:,} iterations (0.999) with correspondences within 1.5 voxels, as its tutorial has it. All peers' poses "
    "are refined by ICP (point to plane, 0.3 m), made upright, and judged then; the seconds are with ICP. An answer that takes "
    f"more than {CALL_SECONDS:.0f} s of processor is a miss. Open3D's methods got every "
    "third pair. Right: 0.5 m and 5° in the middle of what both maps saw (slices and "
    "floor plans: horizontally, and on the right storey). In brackets 95 % over physical buildings, under eight of them their "
    "range. A dash: no pairs."
)


def verdicts_table(verdicts: Mapping[str, PeerVerdict]) -> str:
    """What makes each peer's answer believed, and what that gives on training pairs."""
    out = []
    for name, v in verdicts.items():
        solver = "" if not name.startswith("kiss") else ("yaw only (Quatro)" if v.variant.endswith("q") else "all rotations")
        score = {"inliers": "final inliers"}.get(v.score, f"fitness within {EVALUATED_WITHIN.get(v.score, 0.0):g} m")
        score += " after ICP" * (v.score == "fitness_icp")
        least = "nothing is believed" if v.at_least is None else f"{score} ≥ {v.at_least:.3g}"
        limit = "" if v.residual_at_most is None else f", residual ≤ {v.residual_at_most:.3f} m"
        out.append([METHOD_TITLES[name], solver or "–", least + limit, v.right, f"{v.recall:.2f}", f"{v.precision:.2f}"])
    return table(["method", "solver", "believed where", "right", "recall", "precision"], out)


def raw_table(verdicts: Mapping[str, PeerVerdict]) -> str:
    """The same pairs with all points and thinned."""
    thin, raw = answers_of("thinned", verdicts), answers_of("raw", verdicts)
    both = {r["name"] for r in thin} & {r["name"] for r in raw}
    out = []
    for method in methods_of(raw):
        for title, rows in (("thinned", thin), ("raw", raw)):
            mine = [r for r in rows if r["name"] in both and r["method"] == method]
            out.append([METHOD_TITLES[method], title, *answer_columns(mine)])
    return table(["method", "points", *ANSWER_HEADS], out)


def real_table(rows: Sequence[Row]) -> str:
    """Real pairs by source and modality."""
    groups = sorted({(modality(r), r["source"]) for r in rows}, key=lambda g: (PAIR_CLASSES.index(g[0]), g[1]))
    out = []
    for what, source in groups:
        for method in methods_of(rows):
            mine = [r for r in rows if (modality(r), r["source"]) == (what, source) and r["method"] == method]
            out.append([f"{source}, {what}", METHOD_TITLES[method], *answer_columns(mine)])
    return table(["real pairs", "method", *ANSWER_HEADS], out)


def whole_way(rows: Sequence[Row]) -> str:
    """How long it takes from two clouds to a map with rooms."""
    done = [r["whole"] for r in rows if r["method"] == "ours" and r["whole"]]
    if not done:
        return ""
    extract, merge = (float(np.median([r[k] for r in done])) for k in ("extract", "merge"))
    return (
        f"From two clouds to one map with its rooms, on {len(done)} pairs: extraction of both {extract:.1f} s, merge "
        f"{merge:.1f} s (medians). For a map with rooms the others would need the same extraction and joining, too."
    )


def by_class(rows: Sequence[Row]) -> list[str]:
    """Tables of pairs with a right pose: ordinary scans first, the hard kinds apart."""
    parts = []
    for name in PAIR_CLASSES:
        mine = [r for r in rows if modality(r) == name and possible(r)]
        if mine:
            parts += [f"### {name}", by_area(mine)]
            parts += ["Right · right and believed · wrong and believed, of the pairs of each cell:", crossed(mine)]
    return parts


def section(folder: Path) -> str:
    """The whole section; the figure is written below the folder of the documents."""
    verdicts = load_verdicts()
    rows = answers_of("test", verdicts)
    ordinary = [r for r in rows if modality(r) == ORDINARY]
    groups = {"3D–3D": ordinary, "all": rows}
    draw_curves({f"{name}: {len({r['name'] for r in mine})} pairs": mine for name, mine in groups.items()}, folder / CURVES_IMAGE)
    keys = [lambda r: modality(r) + ", " + bin_of(r["common"])]
    parts = [PEERS_COMMANDS, PEERS_SETUP, "### Verdicts, chosen on training pairs", verdicts_table(verdicts)]
    parts += ["### Precision and recall on test pairs", curves_table(groups), f"![precision and recall](../{CURVES_IMAGE})"]
    parts += by_class(rows)
    parts += [f"Cells in which another method has more right: {behind([r for r in rows if possible(r)], keys)}.", whole_way(rows)]
    parts += ["### Pairs that must not merge", negatives_by_kind([*rows, *answers_of(LOOKALIKE_PAIRS, verdicts)])]
    if answers_of("raw", verdicts):
        parts += ["### Raw clouds and thinned ones", raw_table(verdicts)]
    for what, title in (("real", "### Real pairs"), ("heldout", "### Maps that were extracted")):
        if mine := [r for r in answers_of(what, verdicts) if possible(r)]:
            parts += [title, real_table(mine) if what == "real" else by_area(mine)]
    return "\n\n".join(part for part in parts if part)


if __name__ == "__main__":
    page = Path(sys.argv[1])
    put(page, section(page.parent.parent), "peers")
