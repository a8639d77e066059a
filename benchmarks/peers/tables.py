"""Ours beside other methods: answers with their verdicts, tables of them, and a figure of precision against recall.

``python -m benchmarks.peers.tables docs/results/peers.md`` writes the block of that page from what `run.py` left.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from topomerge.datasets.core.building import find_physical_building

from benchmarks.peers.methods import EVALUATED_WITHIN
from benchmarks.peers.pairs import AREA_BINS, ORDINARY, OVERLAP_BINS, PAIR_CLASSES, find_bin
from benchmarks.peers.run import read_result_rows
from benchmarks.peers.thresholds import PeerVerdict, apply_refinement, is_possible, load_verdicts
from topomerge.evaluation.documents import FIGURES, build_stamp, write_blocks, write_headline
from topomerge.evaluation.documents import write_table as table
from topomerge.evaluation.false_merges import Row, classify_negative, is_false_merge, is_good
from topomerge.evaluation.merge_report import format_share, modality
from topomerge.evaluation.merges import FINE
from topomerge.statistics import compute_precision_recall

CURVES_IMAGE = Path("images/peers_precision_recall.png")  # beside the folder of the page
LOOKALIKE_PAIRS = "lookalikes_heldout.jsonl"
METHOD_TITLES = {
    "ours": "topomerge", "learned": "topomerge, rooms matched by learning", "kiss02": "KISS-Matcher 0.2 m",
    "kiss03": "KISS-Matcher 0.3 m", "fpfh": "FPFH + RANSAC", "fgr": "FGR",
}  # fmt: skip
HEADLINE_AREA = 80.0  # m2 in common
LEVELS = (1.0, 0.99, 0.95)  # of precision, at which recall is told
ANSWER_HEADS = (
    "pairs", "right %", "within 0.1 m, 1° %", "before ICP", "right and believed", "wrong and believed", "over the cap",
    "s, median", "s, most",
)  # fmt: skip


def build_answers(rows: Sequence[Row], verdicts: Mapping[str, PeerVerdict]) -> list[Row]:
    """Return a row a pair and method: ``method``, ``err`` (of peers after ICP), ``err_solved``, ``score``, ``believed``,
    ``seconds``."""
    out: list[Row] = []
    for row in rows:
        base = {k: v for k, v in row.items() if k != "methods"}
        first = find_physical_building(row.get("source") or "procedural", row["building"])
        base |= {"physical": row.get("physical", first), "physical_other": row.get("physical_other")}
        for name in ("ours", "learned"):
            if name in row["methods"]:
                mine = row["methods"][name]
                out.append({**base, **mine, "method": name, "err_solved": mine["err"], "score": mine["scores"]["probability"]})
        for name, verdict in verdicts.items():
            if verdict.variant not in row["methods"]:
                continue  # not tried on this pair
            answer = apply_refinement({**base, "methods": row["methods"]}, verdict.variant)
            answer |= {"score": verdict.get_score(answer), "believed": verdict.is_accepted(answer)}
            answer["seconds"] += answer.get("refinement_seconds", 0.0)
            out.append({**{k: v for k, v in answer.items() if k != "methods"}, "method": name})
    return out


def load_answers(what: str, verdicts: Mapping[str, PeerVerdict]) -> list[Row]:
    """Load the answers (`build_answers`) of a set of pairs; none where nothing was measured."""
    return build_answers(read_result_rows(what), verdicts)


def list_methods(rows: Sequence[Row]) -> list[str]:
    """List the names of the methods that answered, in the order of the tables."""
    return [m for m in METHOD_TITLES if any(r["method"] == m for r in rows)]


def format_answer_columns(mine: Sequence[Row]) -> list[object]:
    """Format the columns under `ANSWER_HEADS`; fine before ICP is of the solver's own pose. Dashes where there is none."""
    if not mine:
        return [0] + ["–"] * (len(ANSWER_HEADS) - 1)
    solved = sum(is_good({**r, "err": r["err_solved"]}, FINE) for r in mine)
    believed = sum(is_good(r) and r["believed"] for r in mine), sum(map(is_false_merge, mine))
    seconds = [r["seconds"] for r in mine]
    over = sum(bool(r["status"]) for r in mine)
    shares = format_share(mine, is_good), format_share(mine, lambda r: is_good(r, FINE)), f"{100 * solved / len(mine):.0f}"
    return [len(mine), *shares, *believed, over, f"{np.median(seconds):.1f}", f"{max(seconds):.1f}"]


def tabulate_by_area(rows: Sequence[Row]) -> str:
    """Tabulate the pairs with a right pose, by the area in common and method."""
    out = []
    for area in AREA_BINS:
        for method in list_methods(rows):
            mine = [r for r in rows if r["method"] == method and find_bin(r["common"]) == area]
            out.append([area, METHOD_TITLES[method], *format_answer_columns(mine)])
    return table(["in common", "method", *ANSWER_HEADS], out)


def tabulate_crossed(rows: Sequence[Row]) -> str:
    """Tabulate the pairs with a right pose, by area in common and share of rooms in common: right, right and believed, wrong and
    believed."""
    methods = list_methods(rows)
    out: list[list[object]] = []
    for area in AREA_BINS:
        for overlap in OVERLAP_BINS:
            here = [r for r in rows if find_bin(r["common"]) == area and find_bin(r["overlap"], OVERLAP_BINS) == overlap]
            cells = [_format_three([r for r in here if r["method"] == m]) for m in methods]
            out.append([area, overlap, len({r["name"] for r in here}), *cells])
    return table(["in common", "rooms in common (Dice)", "pairs", *(METHOD_TITLES[m] for m in methods)], out)


def _format_three(mine: Sequence[Row]) -> str:
    if not mine:
        return "–"
    return f"{sum(map(is_good, mine))} · {sum(is_good(r) and r['believed'] for r in mine)} · {sum(map(is_false_merge, mine))}"


def tabulate_negatives_by_kind(rows: Sequence[Row]) -> str:
    """Tabulate, of pairs that must not merge, by kind and modality, how many each method believes."""
    methods = list_methods(rows)
    groups: dict[tuple[str, str], list[Row]] = {}
    for r in rows:
        kind = classify_negative(r)
        if kind:
            groups.setdefault((kind, modality(r)), []).append(r)
    out: list[list[object]] = []
    whole = [r for mine in groups.values() for r in mine]
    for (kind, what), mine in [*sorted(groups.items()), (("**all**", ""), whole)]:
        believed = [sum(is_false_merge(r) for r in mine if r["method"] == m) for m in methods]
        out.append([kind, what, len({r["name"] for r in mine}), *believed])
    return table(["kind", "maps", "pairs", *(f"believed: {METHOD_TITLES[m]}" for m in methods)], out)


def compute_curve(rows: Sequence[Row]) -> tuple[Any, Any]:
    """Compute precision and recall of a method's answers by every threshold of its score, the strictest first."""
    scored = [r for r in rows if np.isfinite(r["score"])]  # the rest has no answer
    score, right = [r["score"] for r in scored], [is_good(r) for r in scored]
    return compute_precision_recall(score, right, max(sum(map(is_possible, rows)), 1))[1:]


def interpolate_curve(precision: Any, recall: Any) -> list[float]:
    """Return the recall at each of `LEVELS` of precision, and the area under the curve."""
    best = [float(recall[precision >= level].max(initial=0.0)) for level in LEVELS]
    return [*best, float((np.diff(recall, prepend=0.0) * precision).sum())]


def tabulate_curves(groups: Mapping[str, Sequence[Row]]) -> str:
    """Tabulate points of the curves of each group of rows and method."""
    out = []
    for name, rows in groups.items():
        for method in list_methods(rows):
            mine = [r for r in rows if r["method"] == method]
            points = [f"{v:.2f}" for v in interpolate_curve(*compute_curve(mine))]
            out.append([name, METHOD_TITLES[method], sum(map(is_possible, mine)), sum(not is_possible(r) for r in mine), *points])
    heads = [f"recall at precision {level:g}" for level in LEVELS]
    return table(["pairs", "method", "with a right pose", "that must not merge", *heads, "area"], out)


def tabulate_behind(rows: Sequence[Row], keys: Sequence[Callable[[Row], str]]) -> str:
    """Tabulate where another method has more right than ours."""
    shortfalls = []
    for key in keys:
        for group in sorted({key(r) for r in rows}):
            mine = [r for r in rows if key(r) == group]
            for limit in ((0.5, 5.0), FINE):
                many = {m: sum(is_good(r, limit) for r in mine if r["method"] == m) for m in list_methods(mine)}
                more = [f"{METHOD_TITLES[m]} {n}" for m, n in many.items() if n > many["ours"]]
                shortfalls += [f"{group}, within {limit[0]} m: {', '.join(more)}, topomerge {many['ours']}"] * bool(more)
    return "; ".join(shortfalls) or "nowhere"


INK, GRID = "#444444", "#dddddd"
LINES = {  # colour, dashes
    "ours": ("#20639b", "-"), "learned": ("#20639b", ":"), "kiss02": ("#b5651d", "-"), "kiss03": ("#b5651d", "--"),
    "fpfh": ("#6b8e5a", "-"), "fgr": ("#7d6b91", "-"),
}  # fmt: skip


def draw_curves(groups: Mapping[str, Sequence[Row]], path: Path) -> None:
    """Draw a panel a group of rows (`build_answers`), a line a method; the dot is at the threshold of the verdict."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.2 * len(groups), 4.0), layout="constrained", facecolor="white")
    panels = figure.subplots(1, len(groups), squeeze=False)[0]
    for panel, (title, rows) in zip(panels, groups.items(), strict=True):
        for method in list_methods(rows):
            mine = [r for r in rows if r["method"] == method]
            precision, recall = compute_curve(mine)
            color, dashes = LINES[method]
            panel.plot(recall, precision, color=color, linestyle=dashes, linewidth=1.6, label=METHOD_TITLES[method])
            if any(r["believed"] for r in mine):
                panel.plot(*_measure_believed(mine), marker="o", color=color, markersize=5)
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


def _measure_believed(rows: Sequence[Row]) -> tuple[float, float]:
    """Measure recall and precision of what the verdict believes."""
    believed = [is_good(r) for r in rows if r["believed"]]
    return sum(believed) / max(sum(map(is_possible, rows)), 1), sum(believed) / len(believed)


def tabulate_verdicts(verdicts: Mapping[str, PeerVerdict]) -> str:
    """Render the threshold from which each peer's answer is accepted, with its recall and precision on training pairs."""
    out = []
    for name, v in verdicts.items():
        solver = "" if not name.startswith("kiss") else ("yaw only (Quatro)" if v.variant.endswith("q") else "all rotations")
        score = {"inliers": "final inliers"}.get(v.score, f"fitness within {EVALUATED_WITHIN.get(v.score, 0.0):g} m")
        score += " after ICP" * (v.score == "fitness_icp")
        least = "nothing is believed" if v.at_least is None else f"{score} ≥ {v.at_least:.3g}"
        limit = "" if v.residual_at_most is None else f", residual ≤ {v.residual_at_most:.3f} m"
        out.append([METHOD_TITLES[name], solver or "–", least + limit, v.right, f"{v.recall:.2f}", f"{v.precision:.2f}"])
    return table(["method", "solver", "believed where", "right", "recall", "precision"], out)


def tabulate_raw(verdicts: Mapping[str, PeerVerdict]) -> str:
    """Tabulate the same pairs with all points and thinned."""
    thin, raw = load_answers("thinned", verdicts), load_answers("raw", verdicts)
    both = {r["name"] for r in thin} & {r["name"] for r in raw}
    out = []
    for method in list_methods(raw):
        for title, rows in (("thinned", thin), ("raw", raw)):
            mine = [r for r in rows if r["name"] in both and r["method"] == method]
            out.append([METHOD_TITLES[method], title, *format_answer_columns(mine)])
    return table(["method", "points", *ANSWER_HEADS], out)


def tabulate_real(rows: Sequence[Row]) -> str:
    """Tabulate real pairs by source and modality."""
    groups = sorted({(modality(r), r["source"]) for r in rows}, key=lambda g: (PAIR_CLASSES.index(g[0]), g[1]))
    out = []
    for what, source in groups:
        for method in list_methods(rows):
            mine = [r for r in rows if (modality(r), r["source"]) == (what, source) and r["method"] == method]
            out.append([f"{source}, {what}", METHOD_TITLES[method], *format_answer_columns(mine)])
    return table(["real pairs", "method", *ANSWER_HEADS], out)


def format_whole_way(rows: Sequence[Row]) -> str:
    """Tell how long it takes from two clouds to a map with rooms."""
    done = [r["whole"] for r in rows if r["method"] == "ours" and r["whole"]]
    if not done:
        return ""
    extract, merge = (float(np.median([r[k] for r in done])) for k in ("extract", "merge"))
    return (
        f"From two clouds to one map with its rooms, on {len(done)} pairs: extraction of both {extract:.1f} s, merge "
        f"{merge:.1f} s (medians). For a map with rooms the others would need the same extraction and joining, too."
    )


def tabulate_by_class(rows: Sequence[Row]) -> list[str]:
    """Return tables of pairs with a right pose: ordinary scans first, the hard kinds apart."""
    parts = []
    for name in PAIR_CLASSES:
        mine = [r for r in rows if modality(r) == name and is_possible(r)]
        if mine:
            parts += [f"### {name}", tabulate_by_area(mine)]
            parts += ["Right · right and believed · wrong and believed, of the pairs of each cell:", tabulate_crossed(mine)]
    return parts


def format_section(folder: Path) -> str:
    """Return the whole section; the figure is written below the folder of the documents."""
    verdicts = load_verdicts()
    rows = load_answers("test", verdicts)
    ordinary = [r for r in rows if modality(r) == ORDINARY]
    groups = {"3D–3D": ordinary, "all": rows}
    draw_curves({f"{name}: {len({r['name'] for r in mine})} pairs": mine for name, mine in groups.items()}, folder / CURVES_IMAGE)
    keys = [lambda r: modality(r) + ", " + find_bin(r["common"])]
    parts = ["### Verdicts, chosen on training pairs", tabulate_verdicts(verdicts)]
    parts += ["### Precision and recall on test pairs", tabulate_curves(groups), f"![precision and recall](../{CURVES_IMAGE})"]
    parts += tabulate_by_class(rows)
    parts += [
        f"Cells in which another method has more right: {tabulate_behind([r for r in rows if is_possible(r)], keys)}.",
        format_whole_way(rows),
    ]
    parts += ["### Pairs that must not merge", tabulate_negatives_by_kind([*rows, *load_answers(LOOKALIKE_PAIRS, verdicts)])]
    if load_answers("raw", verdicts):
        parts += ["### Raw clouds and thinned ones", tabulate_raw(verdicts)]
    for what, title in (("real", "### Real pairs"), ("heldout", "### Maps that were extracted")):
        if mine := [r for r in load_answers(what, verdicts) if is_possible(r)]:
            parts += [title, tabulate_real(mine) if what == "real" else tabulate_by_area(mine)]
    return "\n\n".join(part for part in parts if part)


def compute_headline(rows: Sequence[Row]) -> dict[str, tuple[str, str]]:
    """Compute the README's figure: pairs of 3D scans that share 80 m² or more, right by us and by KISS-Matcher."""
    large = [r for r in rows if modality(r) == ORDINARY and is_possible(r) and r["common"] >= HEADLINE_AREA]
    mine = {name: [r for r in large if r["method"] == name] for name in ("ours", "kiss02", "kiss03")}
    shares = [f"{format_share(some, is_good)} %" for some in mine.values() if some]
    return {"peers-right": ("; ".join(shares), f"{len(mine['ours'])} of these pairs")} if len(shares) == len(mine) else {}


if __name__ == "__main__":
    page = Path(sys.argv[1])
    stamp = build_stamp(f"python -m benchmarks.peers.tables {page}", ("topomerge.registration.pipeline", "topomerge.metrics"))
    write_headline(FIGURES, compute_headline(load_answers("test", load_verdicts())), stamp)
    write_blocks(page, {"peers": format_section(page.parent.parent)}, stamp)
