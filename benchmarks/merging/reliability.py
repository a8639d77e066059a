"""Are the probabilities true? Reliability and calibration error by where the maps are from, over bins of equal mass."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks.merging.tables import Row, good, table
from topomerge.statistics import NEAR_ZERO, Calibration, calibration

ORIGINS = ("procedural buildings", "simulated scans of real plans", "real maps", "look-alikes, generated")
PER_BIN = 8  # pairs
MEANS = "believed: mean probability, share right"
REAL_MAPS = ("carmen", "halmstad", "strands", "utexas", "ipad", "libpointmatcher", "octomap")


def origin(row: Row) -> str:
    """Where the maps of a pair are from: one of `ORIGINS`; a real plan beside a procedural building is a real plan.

    Look-alikes stand apart: a set of pairs that are all made to deceive says nothing of how sure a probability is elsewhere.
    """
    if row.get("lookalike"):
        return ORIGINS[3]
    sources = {row.get("source", "procedural"), row.get("other_source", row.get("source", "procedural"))}
    if sources & set(REAL_MAPS):
        return ORIGINS[2]
    return ORIGINS[0] if sources == {"procedural"} else ORIGINS[1]


def calibrated(rows: Sequence[Row]) -> Calibration:
    """`calibration` of the probabilities of pairs, in ten bins, or fewer where a bin of those above the mass near zero would have
    fewer than `PER_BIN`."""
    above = sum(r["probability"] >= NEAR_ZERO for r in rows)
    return calibration([r["probability"] for r in rows], [good(r) for r in rows], min(max(above // PER_BIN, 1), 10))


def errors(groups: dict[str, Sequence[Row]]) -> str:
    """A line a group of pairs: the calibration error with and without the mass near zero, and how believed pairs fare."""
    out: list[Sequence[object]] = []
    for name, rows in groups.items():
        if rows:
            whole, believed = calibrated(rows), [r for r in rows if r["believed"]]
            means = [float(np.mean([f(r) for r in believed])) for f in (_probability, good)] if believed else []
            above = [_error(whole.above), int(whole.above.count.sum())] if whole.above else ["–", 0]
            out.append([name, len(rows), _error(whole), *above[::-1], len(believed), ", ".join(f"{m:.2f}" for m in means) or "–"])
    heads = ("pairs of", "pairs", "error (by chance)", "pairs of 0.1 or more", "error (by chance)", "believed", MEANS)
    return table(heads, out)


def _probability(row: Row) -> float:
    return float(row["probability"])


def _error(c: Calibration) -> str:
    return f"{c.error:.3f} ({c.by_chance:.3f})"


def reliability(rows: Sequence[Row]) -> str:
    """A line a bin of equal mass and origin: of all pairs, and of those of 0.1 and above."""
    out: list[Sequence[object]] = []
    for name in ORIGINS:
        whole = calibrated([r for r in rows if origin(r) == name])
        for title, c in ((f"{name}, all", whole), (f"{name}, 0.1 or more", whole.above)):
            bins = zip(c.count.tolist(), c.probability.tolist(), c.right.tolist(), strict=True) if c else ()
            out += [[title, n, f"{p:.2f}", f"{y:.2f}"] for n, p, y in bins]
    return table(("pairs of", "pairs", "mean probability", "share right"), out)
