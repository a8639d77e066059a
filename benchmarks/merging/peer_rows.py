"""What peers and we answered, a row a pair and method with its verdict, and what the tables of them count."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from topomerge.datasets.core.physical import physical_building

from benchmarks.merging.false_merges import false_merge, negative_kind
from benchmarks.merging.peer_pairs import AREA_BINS, OVERLAP_BINS, bin_of
from benchmarks.merging.peer_thresholds import PeerVerdict, possible, refined
from benchmarks.merging.peers import target_of
from benchmarks.merging.register import FINE
from benchmarks.merging.tables import METHOD_TITLES, Row, good, modality, rows_of, share, table
from topomerge.statistics import precision_recall

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
    return answers(rows_of(target_of(what).name), verdicts)


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
