"""Verdicts of pairs, every one counted: what was believed that must not be, by kind and at a stated prior; calibration."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from topomerge.datasets.core.building import find_physical_building
from topomerge.evaluation.documents import write_table
from topomerge.statistics import NEAR_ZERO, Calibration, compute_exact_interval, measure_calibration
from topomerge.training.belief_hypotheses import classify_pair, is_distinguishable, is_hypothesis_right

Row = dict[str, Any]
ORIGINS = ("procedural buildings", "simulated scans of real plans", "real maps", "look-alikes, generated")
PER_BIN = 8  # pairs
REAL_MAPS = ("carmen", "halmstad", "strands", "utexas", "ipad", "libpointmatcher", "octomap")
CALIBRATION_HEADS: tuple[str, ...] = (
    "pairs of",
    "pairs",
    "error (by chance)",
    "pairs of 0.1 or more",
    "error (by chance)",
    "believed",
)
CALIBRATION_HEADS += ("believed: mean probability, share right",)

# Of the pairs that somebody would try and that must not merge, how many are of each kind: an assumption, not a measurement.
# Most are of other buildings; in one building the next storey comes first. What was made to be alike is rarer.
PRIOR = {
    "stranger": 0.4,
    "no room in common": 0.1,
    "other storey": 0.2,
    "twin wing": 0.1,
    "repeated modules": 0.1,
    "own mirror image": 0.03,
    "own other half": 0.03,
    "other look-alikes": 0.04,
}
LOOKALIKE_NAMES = {
    "modules": "repeated modules",
    "shifted-row": "repeated modules",
    "mirror": "own mirror image",
    "storeys": "other storey",
    "point-symmetric": "own other half",
}
PRIOR_ROUNDS = 20_000
NEGATIVE_HEADS = (
    "kind", "pairs", "believed", "physical buildings", "with a false merge (exact 95 %)", "indistinguishable pairs",
    "of these, believed", "highest probabilities",
)  # fmt: skip


def is_good(row: Row, limits: tuple[float, float] = (0.5, 5.0)) -> bool:
    """Return whether a pose is right within m and degrees; a slice or a drawing on the wrong storey is not. Maps of two places
    have no right pose."""
    return bool(is_hypothesis_right(row.get("err"), row["sensors"], limits))


def get_physical_building(row: Row) -> str:
    """Return the physical building of map a."""
    return str(row.get("physical") or find_physical_building(row.get("source", "procedural"), row["building"]))


def classify_negative(row: Row) -> str:
    """Classify why a pair must not merge: a key of `PRIOR`; empty where its maps share a room.

    Look-alikes are all in, as those that share rooms must not merge a period away.
    """
    if row.get("lookalike"):
        return LOOKALIKE_NAMES.get(row["lookalike"], "other look-alikes")
    if row["kind"] == "overlap":
        return "no room in common" if classify_pair(row).startswith("none") else ""
    if row["kind"] in ("strangers", "other-building"):
        return "other storey" if row["physical"] == row.get("physical_other") else "stranger"
    return {"other-storey": "other storey", "twin-wing": "twin wing"}[row["kind"]]


def is_broken(row: Row) -> bool:
    """Return whether what is called true is known to be wrong. Of a drawing of a map's own building of which the map shows
    nothing the generator gave a twin's frame."""
    return bool(row["kind"] == "overlap" and row.get("common", 1) < 1 and "drawing" in row["sensors"])


def is_tellable(row: Row) -> bool:
    """Return whether anybody could tell the two places apart by what the maps show. Else the right answer is to abstain."""
    return bool(row["tellable"]) if "tellable" in row else bool(is_distinguishable(row))


def is_false_merge(row: Row) -> bool:
    """Return whether a pair is believed, and not at a right pose."""
    return bool(row["believed"]) and not is_good(row)


def measure_hit_buildings(rows: Sequence[Row]) -> dict[str, float]:
    """Map each physical building of map a to the share of its pairs that were merged falsely."""
    of: dict[str, list[bool]] = {}
    for r in rows:
        of.setdefault(get_physical_building(r), []).append(is_false_merge(r))
    return {name: float(np.mean(hits)) for name, hits in of.items()}


def format_tally(name: str, rows: Sequence[Row]) -> list[object]:
    """Return a line of the table: under `NEGATIVE_HEADS`."""
    shares = measure_hit_buildings(rows)
    hit = sum(share > 0 for share in shares.values())
    low, high = compute_exact_interval(hit, len(shares))
    alike = [r for r in rows if not is_tellable(r)]
    most = np.round(sorted((r["probability"] for r in rows), reverse=True)[:3], 2).tolist()
    interval = f"{hit}: {100 * low:.1f} to {100 * high:.1f} %"
    accepted = sum(map(is_false_merge, rows))
    return [
        name,
        len(rows),
        accepted,
        len(shares),
        interval,
        len(alike),
        sum(map(is_false_merge, alike)),
        ", ".join(map(str, most)),
    ]


def iter_difficulties(row: Row) -> Iterator[str]:
    """Yield the difficulties of a pair beside its kind."""
    yield from row.get("hard", ())
    for sensor, name in (("laser2d", "a 2D slice"), ("drawing", "a floor plan")):
        if sensor in row["sensors"]:
            yield name


def select_negatives(rows: Sequence[Row]) -> list[Row]:
    """Return the pairs that must not merge, each with its `negative`."""
    return [{**r, "negative": kind} for r in rows if not is_broken(r) and (kind := classify_negative(r))]


def tabulate_false_merges(rows: Sequence[Row]) -> str:
    """Return the table of `negatives`: kinds, all, those that nobody can tell apart, and what is difficult."""
    out = [format_tally(kind, mine) for kind in PRIOR if (mine := [r for r in rows if r["negative"] == kind])]
    out.append(format_tally("**all**", rows))
    alike = [r for r in rows if not is_tellable(r)]
    if alike:
        out.append(format_tally("**indistinguishable** (of all; right: to abstain)", alike))
    for name in sorted({name for r in rows for name in iter_difficulties(r)}):
        out.append(format_tally(f"of all, with {name}", [r for r in rows if name in iter_difficulties(r)]))
    return write_table(NEGATIVE_HEADS, out)


def compute_rate(rows: Sequence[Row], prior: Mapping[str, float] = PRIOR) -> tuple[float, float, float]:
    """Return share of false merges at a prior of kinds, and the ends of its 95 % interval; nan where there is no row.

    Of each kind the mean over its physical buildings of the share of their pairs. What of a kind is not sure is drawn as of k of
    n buildings, Beta(k + 1/2, n - k + 1/2) (Jeffreys' prior). Kinds without a row are left out, and the others' shares raised.
    """
    total = sum(weight for kind, weight in prior.items() if any(r["negative"] == kind for r in rows))
    if not total:
        return float("nan"), float("nan"), float("nan")
    rng = np.random.default_rng(0)
    rate, drawn = 0.0, np.zeros(PRIOR_ROUNDS)
    for kind, weight in prior.items():
        shares = list(measure_hit_buildings([r for r in rows if r["negative"] == kind]).values())
        if shares:
            hits = sum(shares)
            rate += weight / total * hits / len(shares)
            drawn += weight / total * rng.beta(hits + 0.5, len(shares) - hits + 0.5, PRIOR_ROUNDS)
    low, high = np.quantile(drawn, [0.025, 0.975]).tolist()
    return rate, low, high


def format_headline(rows: Sequence[Row]) -> str:
    """Return the rate at `PRIOR` with every pair in, and without what nobody can tell apart, in words."""
    shares = ", ".join(f"{kind} {weight:g}" for kind, weight in PRIOR.items())
    missing = [kind for kind in PRIOR if not any(r["negative"] == kind for r in rows)]
    rate, low, high = (100 * v for v in compute_rate(rows))
    apart, least, most = (100 * v for v in compute_rate([r for r in rows if is_tellable(r)]))
    text = f"**{rate:.1f} % [{low:.1f}, {high:.1f}] of the pairs that must not merge are believed**, over all pairs, at this "
    text += f"prior of kinds: {shares}. Without the indistinguishable pairs it is {apart:.1f} % [{least:.1f}, {most:.1f}]."
    return text + (f" Not measured, so the other shares are scaled up: {', '.join(missing)}." if missing else "")


def classify_origin(row: Row) -> str:
    """Tell where the maps of a pair are from: one of `ORIGINS`; a real plan beside a procedural building is a real plan.

    Look-alikes stand apart: a set of pairs that are all made to deceive says nothing of how sure a probability is elsewhere.
    """
    if row.get("lookalike"):
        return ORIGINS[3]
    sources = {row.get("source", "procedural"), row.get("other_source", row.get("source", "procedural"))}
    if sources & set(REAL_MAPS):
        return ORIGINS[2]
    return ORIGINS[0] if sources == {"procedural"} else ORIGINS[1]


def compute_calibration(rows: Sequence[Row]) -> Calibration:
    """Compute the calibration (`measure_calibration`) of the probabilities of pairs, in ten bins, or fewer where a bin of those
    above the mass near zero would have fewer than `PER_BIN`."""
    above = sum(r["probability"] >= NEAR_ZERO for r in rows)
    return measure_calibration([r["probability"] for r in rows], [is_good(r) for r in rows], min(max(above // PER_BIN, 1), 10))


def errors(groups: Mapping[str, Sequence[Row]]) -> str:
    """Return a line a group of pairs: the calibration error with and without the mass near zero, and how believed pairs fare."""
    out: list[Sequence[object]] = []
    for name, rows in groups.items():
        if rows:
            whole, accepted = compute_calibration(rows), [r for r in rows if r["believed"]]
            means = [float(np.mean([f(r) for r in accepted])) for f in (probability_of, is_good)] if accepted else []
            above = [write_error(whole.above), int(whole.above.count.sum())] if whole.above else ["–", 0]
            out.append(
                [name, len(rows), write_error(whole), *above[::-1], len(accepted), ", ".join(f"{m:.2f}" for m in means) or "–"]
            )
    return write_table(CALIBRATION_HEADS, out)


def probability_of(row: Row) -> float:
    """Get the probability of a pair."""
    return float(row["probability"])


def write_error(c: Calibration) -> str:
    """Write a calibration error and what chance makes of it."""
    return f"{c.error:.3f} ({c.by_chance:.3f})"


def reliability(rows: Sequence[Row]) -> str:
    """Return a line a bin of equal mass and origin: of all pairs, and of those of 0.1 and above."""
    out: list[Sequence[object]] = []
    for name in ORIGINS:
        whole = compute_calibration([r for r in rows if classify_origin(r) == name])
        for title, c in ((f"{name}, all", whole), (f"{name}, 0.1 or more", whole.above)):
            bins = zip(c.count.tolist(), c.probability.tolist(), c.right.tolist(), strict=True) if c else ()
            out += [[title, n, f"{p:.2f}", f"{y:.2f}"] for n, p, y in bins]
    return write_table(("pairs of", "pairs", "mean probability", "share right"), out)
