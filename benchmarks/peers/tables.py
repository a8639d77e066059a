"""Ours beside other methods: answers with their verdicts, tables of them, and a figure of precision against recall.

``python -m benchmarks.peers.tables docs/results/peers.md`` writes the block of that page from what `run.py` left.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from topomerge.datasets.core.physical import physical_building

from benchmarks.peers.methods import EVALUATED_WITHIN
from benchmarks.peers.pairs import AREA_BINS, ORDINARY, OVERLAP_BINS, PAIR_CLASSES, bin_of
from benchmarks.peers.run import rows_of
from benchmarks.peers.thresholds import PeerVerdict, load_verdicts, possible, refined
from topomerge.evaluation.documents import build_stamp, write_blocks
from topomerge.evaluation.false_merges import Row, false_merge, good, negative_kind
from topomerge.evaluation.markdown import write_table as table
from topomerge.evaluation.merge_report import modality, share
from topomerge.evaluation.merges import FINE
from topomerge.statistics import precision_recall

CURVES_IMAGE = Path("images/peers_precision_recall.png")  # beside the folder of the page
LOOKALIKE_PAIRS = "lookalikes_heldout.jsonl"
METHOD_TITLES = {
    "ours": "topomerge", "learned": "topomerge, rooms matched by learning", "kiss02": "KISS-Matcher 0.2 m",
    "kiss03": "KISS-Matcher 0.3 m", "fpfh": "FPFH + RANSAC", "fgr": "FGR",
}  # fmt: skip
LEVELS = (1.0, 0.99, 0.95)  # of precision, at which recall is told
ANSWER_HEADS = (
    "pairs", "right %", "within 0.1 m, 1° %", "before ICP", "right and believed", "wrong and believed", "over the cap",
    "s, median", "s, most",
)  # fmt: skip


def answers(rows: Sequence[Row], verdicts: Mapping[str, PeerVerdict]) -> list[Row]:
    """A row a pair and method: ``method``, ``err`` (of peers after ICP), ``err_solved``, ``score``, ``believed``, ``seconds``."""
    out: list[Row] = []
    for row in rows:
        base = {k: v for k, v in row.items() if k != "methods"}
        first = physical_building(row.get("source") or "procedural", row["building"])
        base |= {"physical": row.get("physical", first), "physical_other": row.get("physical_other")}
        for name in ("ours", "learned"):
            if name in row["methods"]:
                mine = row["methods"][name]
                out.append({**base, **mine, "method": name, "err_solved": mine["err"], "score": mine["scores"]["probability"]})
        for name, verdict in verdicts.items():
            if verdict.variant not in row["methods"]:
                continue  # not tried on this pair
            answer = refined({**base, "methods": row["methods"]}, verdict.variant)
            answer |= {"score": verdict.score_of(answer), "believed": verdict.believes(answer)}
            answer["seconds"] += answer.get("refinement_seconds", 0.0)
            out.append({**{k: v for k, v in answer.items() if k != "methods"}, "method": name})
    return out


def answers_of(what: str, verdicts: Mapping[str, PeerVerdict]) -> list[Row]:
    """`answers` of a set of pairs; none where nothing was measured."""
    return answers(rows_of(what), verdicts)


def methods_of(rows: Sequence[Row]) -> list[str]:
    """Names of the methods that answered, in the order of the tables."""
    return [m for m in METHOD_TITLES if any(r["method"] == m for r in rows)]


def answer_columns(mine: Sequence[Row]) -> list[object]:
    """Under `ANSWER_HEADS`; fine before ICP is of the solver's own pose. Dashes where there is none."""
    if not mine:
        return [0] + ["–"] * (len(ANSWER_HEADS) - 1)
    solved = sum(good({**r, "err": r["err_solved"]}, FINE) for r in mine)
    believed = sum(good(r) and r["believed"] for r in mine), sum(map(false_merge, mine))
    seconds = [r["seconds"] for r in mine]
    over = sum(bool(r["status"]) for r in mine)
    shares = share(mine, good), share(mine, lambda r: good(r, FINE)), f"{100 * solved / len(mine):.0f}"
    return [len(mine), *shares, *believed, over, f"{np.median(seconds):.1f}", f"{max(seconds):.1f}"]


def by_area(rows: Sequence[Row]) -> str:
    """Pairs with a right pose, by the area in common and method."""
    out = []
    for area in AREA_BINS:
        for method in methods_of(rows):
            mine = [r for r in rows if r["method"] == method and bin_of(r["common"]) == area]
            out.append([area, METHOD_TITLES[method], *answer_columns(mine)])
    return table(["in common", "method", *ANSWER_HEADS], out)


def crossed(rows: Sequence[Row]) -> str:
    """Pairs with a right pose, by area in common and share of rooms in common: right, right and believed, wrong and believed."""
    methods = methods_of(rows)
    out: list[list[object]] = []
    for area in AREA_BINS:
        for overlap in OVERLAP_BINS:
            here = [r for r in rows if bin_of(r["common"]) == area and bin_of(r["overlap"], OVERLAP_BINS) == overlap]
            cells = [_three([r for r in here if r["method"] == m]) for m in methods]
            out.append([area, overlap, len({r["name"] for r in here}), *cells])
    return table(["in common", "rooms in common (Dice)", "pairs", *(METHOD_TITLES[m] for m in methods)], out)


def _three(mine: Sequence[Row]) -> str:
    if not mine:
        return "–"
    return f"{sum(map(good, mine))} · {sum(good(r) and r['believed'] for r in mine)} · {sum(map(false_merge, mine))}"


def negatives_by_kind(rows: Sequence[Row]) -> str:
    """Pairs that must not merge, by kind and modality: how many each method believes."""
    methods = methods_of(rows)
    groups: dict[tuple[str, str], list[Row]] = {}
    for r in rows:
        kind = negative_kind(r)
        if kind:
            groups.setdefault((kind, modality(r)), []).append(r)
    out: list[list[object]] = []
    whole = [r for mine in groups.values() for r in mine]
    for (kind, what), mine in [*sorted(groups.items()), (("**all**", ""), whole)]:
        believed = [sum(false_merge(r) for r in mine if r["method"] == m) for m in methods]
        out.append([kind, what, len({r["name"] for r in mine}), *believed])
    return table(["kind", "maps", "pairs", *(f"believed: {METHOD_TITLES[m]}" for m in methods)], out)


def curve(rows: Sequence[Row]) -> tuple[Any, Any]:
    """Precision and recall of a method's answers by every threshold of its score, the strictest first."""
    scored = [r for r in rows if np.isfinite(r["score"])]  # the rest has no answer
    score, right = [r["score"] for r in scored], [good(r) for r in scored]
    return precision_recall(score, right, max(sum(map(possible, rows)), 1))[1:]


def points_of(precision: Any, recall: Any) -> list[float]:
    """Recall at each of `LEVELS` of precision, and the area under the curve."""
    best = [float(recall[precision >= level].max(initial=0.0)) for level in LEVELS]
    return [*best, float((np.diff(recall, prepend=0.0) * precision).sum())]


def curves_table(groups: Mapping[str, Sequence[Row]]) -> str:
    """Points of the curves of each group of rows and method."""
    out = []
    for name, rows in groups.items():
        for method in methods_of(rows):
            mine = [r for r in rows if r["method"] == method]
            points = [f"{v:.2f}" for v in points_of(*curve(mine))]
            out.append([name, METHOD_TITLES[method], sum(map(possible, mine)), sum(not possible(r) for r in mine), *points])
    heads = [f"recall at precision {level:g}" for level in LEVELS]
    return table(["pairs", "method", "with a right pose", "that must not merge", *heads, "area"], out)


def behind(rows: Sequence[Row], keys: Sequence[Callable[[Row], str]]) -> str:
    """Where another method has more right than ours."""
    shortfalls = []
    for key in keys:
        for group in sorted({key(r) for r in rows}):
            mine = [r for r in rows if key(r) == group]
            for limit in ((0.5, 5.0), FINE):
                many = {m: sum(good(r, limit) for r in mine if r["method"] == m) for m in methods_of(mine)}
                more = [f"{METHOD_TITLES[m]} {n}" for m, n in many.items() if n > many["ours"]]
                shortfalls += [f"{group}, within {limit[0]} m: {', '.join(more)}, topomerge {many['ours']}"] * bool(more)
    return "; ".join(shortfalls) or "nowhere"


INK, GRID = "#444444", "#dddddd"
LINES = {  # colour, dashes
    "ours": ("#20639b", "-"), "learned": ("#20639b", ":"), "kiss02": ("#b5651d", "-"), "kiss03": ("#b5651d", "--"),
    "fpfh": ("#6b8e5a", "-"), "fgr": ("#7d6b91", "-"),
}  # fmt: skip


def draw_curves(groups: Mapping[str, Sequence[Row]], path: Path) -> None:
    """A panel a group of rows (`answers`), a line a method; the dot is at the threshold of the verdict."""
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
    believed = [good(r) for r in rows if r["believed"]]
    return sum(believed) / max(sum(map(possible, rows)), 1), sum(believed) / len(believed)


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
    parts = ["### Verdicts, chosen on training pairs", verdicts_table(verdicts)]
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
    stamp = build_stamp(f"python -m benchmarks.peers.tables {page}", ("topomerge.registration.pipeline", "topomerge.metrics"))
    write_blocks(page, {"peers": section(page.parent.parent)}, stamp)
