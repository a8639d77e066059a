"""Tables of merges: by group, by site, what decides them, and how far their probabilities can be believed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import combinations

import numpy as np

from topomerge.evaluation.score import Row
from topomerge.evaluation.settings import Evaluation
from topomerge.evaluation.tables import (
    BY,
    MERGING,
    METRIC_NAMES,
    Table,
    compute_value,
    count_hit_buildings,
    format_value,
    group_by,
    group_by_variant,
)
from topomerge.statistics import Calibration, measure_calibration

ORIGINS = ("procedural", "real plans", "real maps")  # of the places that maps are of
SAME_POSE = (0.05, 0.5)  # m, degrees: poses that differ by less are one; the truth of real pairs is no finer
Predictions = Callable[[Sequence[Row]], tuple[list[float], list[bool]]]  # probabilities of rows, and what came true
LARGEST = ("largest difference of poses, m", "largest difference of probabilities")
INDEPENDENCE = {True: "two captures", False: "parts or copies of one capture"}


def tabulate_merging(merges: Sequence[Row], key: str, settings: Evaluation) -> Table:
    """Return share of pairs merged right, refused and merged wrongly, by group."""
    rows = []
    for name, variant_rows in _group_distinct(merges).items():
        groups = {"all": variant_rows, **(group_by(variant_rows, key) if key else {})}
        if key == "area":
            groups["≥ 80"] = [r for r in variant_rows if r["large"]]
        for group, these in groups.items():
            pairs, able = len({r["pair"] for r in these}), sum(r["mergeable"] for r in these)
            cells = [format_value(compute_value(these, m, settings.rounds), m in ("every room", "merged")) for m in MERGING]
            took = np.median([r["seconds"] for r in these] or [0.0])
            rows.append([name, group, str(pairs), str(able), *cells, _format_wrong(these), f"{took:.1f}"])
    metrics = (METRIC_NAMES[m] for m in MERGING)
    head = ["merged with", key or "pairs", "pairs", "mergeable", *metrics, "merged wrongly", "s per pair"]
    title = "Merges: shares of the overlapping pairs; right: within 0.5 m and 5°, unless the column says otherwise"
    return Table(title + (f", by {BY[key][0].lower()}{BY[key][1:]}" if key else ""), head, rows, 2)


def _group_distinct(merges: Sequence[Row]) -> dict[str, list[Row]]:
    """Rows by way of merging; ways whose merges come out alike are one, with the seconds of the last of them."""
    names: dict[object, list[str]] = {}
    rows: dict[object, list[Row]] = {}
    for name, these in group_by_variant(merges).items():
        outcome = tuple(sorted((r["pair"], r["believed"], r["near"], r["fine"], r["every_room"], r["rooms_near"]) for r in these))
        names.setdefault(outcome, []).append(name)
        rows[outcome] = these
    return {" = ".join(names[outcome]): these for outcome, these in rows.items()}


def _format_wrong(rows: Sequence[Row]) -> str:
    """Merges that are wrong, and in how many buildings, with the exact interval in per cent."""
    hit, buildings, low, high = count_hit_buildings(rows, "false")
    count = str(sum(r["false"] for r in rows))
    return f"{count}; {hit} of {buildings} buildings [{100 * low:.1f}, {100 * high:.1f}] %" if buildings > 1 else count


def tabulate_sites(merges: Sequence[Row]) -> Table:
    """Real pairs by physical building, in numbers of pairs."""
    rows = []
    for site, these in group_by(merges, "building").items():
        for independent, title in INDEPENDENCE.items():
            some = [r for r in these if r["independent"] == independent]
            if some:
                counts = (sum(r[k] for r in some) for k in ("near", "fine", "every_room", "merged", "false", "refused"))
                names = {r[k] for r in some for k in ("capture_a", "capture_b")}
                rows.append([site, title, str(len(names)), str(len(some)), *map(str, counts)])
    head = ["site", "the two maps are", "captures", "pairs", *NUMBERS]
    return Table("Real pairs by site: numbers of pairs; right: within 0.5 m and 5°", head, rows, 2)


NUMBERS = (
    "right",
    "within 0.1 m, 1°",
    "all rooms within 0.1 m",
    "believed and right",
    "believed and wrong",
    "right and refused",
)


def tabulate_independence(merges: Sequence[Row], settings: Evaluation) -> Table:
    """Tabulate merges over sites: independent pairs apart from those of one capture."""
    groups = {title: [r for r in merges if r["independent"] == so] for so, title in INDEPENDENCE.items()}
    rows = []
    for title, these in {**groups, "all": merges}.items():
        if these:
            cells = [format_value(compute_value(these, m, settings.rounds), m in ("right poses", "merged")) for m in MERGING]
            by_site = [np.mean([r["merged"] for r in some]) for some in group_by(these, "building").values()]
            some, every = sum(s > 0 for s in by_site), sum(s == 1 for s in by_site)
            shares = [f"{np.mean(by_site):.2f}", f"{some} of {len(by_site)}", f"{every} of {len(by_site)}"]
            rows.append([title, str(len(these)), str(len(by_site)), *cells, *shares, _format_wrong(these)])
    over = ["merged right, mean over sites", "sites with a merge", "sites with all merged"]
    head = ["the two maps are", "pairs", "sites", *(METRIC_NAMES[m] for m in MERGING), *over, "merged wrongly"]
    return Table("Independent and dependent real pairs: shares of pairs", head, rows)


def select_last_variant(merges: Sequence[Row]) -> list[Row]:
    """Return rows of the last way of merging, or of matching: that with the trained descriptor, where there is one."""
    last = merges[-1]["variant"] if merges else ""
    return [r for r in merges if r["variant"] == last]


def tabulate_descriptor_effect(merges: Sequence[Row]) -> Table:
    """Tabulate how alike two variants of merging come out on the same pairs."""
    variants = {name: {r["pair"]: r for r in rows} for name, rows in group_by_variant(merges).items()}
    rows = []
    for first, second in combinations(variants, 2):
        both = [(row, variants[second][pair]) for pair, row in variants[first].items() if pair in variants[second]]
        verdicts = sum(a["believed"] == b["believed"] for a, b in both)
        apart = np.array([_measure_pose_difference(a["place"], b["place"]) for a, b in both]).reshape(-1, 2)
        poses = int((apart < SAME_POSE).all(axis=1).sum())
        probability = max((abs(a["probability"] - b["probability"]) for a, b in both), default=0.0)
        counts = map(str, (len(both), verdicts, poses))
        rows.append([first, second, *counts, f"{np.max(apart[:, 0], initial=0.0):.3f}", f"{probability:.3f}"])
    same = f"same pose ({SAME_POSE[0]:g} m, {SAME_POSE[1]:g}°)"
    head = ["merged with", "and with", "pairs", "same verdict", same, *LARGEST]
    return Table("Effect of room descriptors: the same pairs, merged with and without them", head, rows, 2)


def _measure_pose_difference(a: Sequence[float], b: Sequence[float]) -> tuple[float, float]:
    """m and degrees between two places; where only one way has a pose, they are infinitely far apart."""
    if not a or not b:
        return (0.0, 0.0) if a == b else (np.inf, np.inf)
    return float(np.linalg.norm(np.subtract(a[:3], b[:3]))), abs((a[3] - b[3] + 180) % 360 - 180)


def tabulate_reliability(matches: Sequence[Row], merges: Sequence[Row]) -> Table:
    """Tabulate how far predicted probabilities are from what came true, by where the maps come from."""
    rows: list[list[str]] = []
    for name, method_rows in group_by_variant(matches, lambda r: f"{r['variant']} {r['method']}").items():
        if method_rows[0]["k"] == 0 and method_rows[0]["method"] in ("consistent", "mutual"):
            rows += _iter_calibration_rows(f"match, {name}", method_rows, _collect_match_predictions)
    for name, variant_rows in group_by_variant(merges).items():
        rows += _iter_calibration_rows(f"merge, {name}", variant_rows, _collect_merge_predictions)
        rows += _iter_calibration_rows(f"match of believed merges, {name}", variant_rows, _collect_match_predictions)
    more = ("expected by chance", "number ≥ 0.1", "mean probability", "share right", "error", "expected by chance")
    head = ["probability of", "maps from", "number", "mean probability", "share right", "calibration error (ECE)", *more]
    return Table("Calibration over ten bins of equal mass: of all probabilities, and of those of 0.1 or more", head, rows, 2)


def _collect_match_predictions(rows: Sequence[Row]) -> tuple[list[float], list[bool]]:
    """Probability of each match of rows, and whether it is right."""
    return [p for r in rows for p in r["chance"]], [g for r in rows for g in r["good"]]


def _collect_merge_predictions(rows: Sequence[Row]) -> tuple[list[float], list[bool]]:
    """Probability of each merge, and whether its pose is right."""
    return [r["probability"] for r in rows], [bool(r["near"]) for r in rows]


def _iter_calibration_rows(what: str, rows: Sequence[Row], of: Predictions) -> Iterator[list[str]]:
    """A line for each origin that there are any of."""
    for origin in ORIGINS:
        p, right = of([r for r in rows if r["origin"] == origin])
        if len(p):
            all_bins = measure_calibration(p, right)
            yield [
                what,
                origin,
                *_format_calibration(all_bins),
                *(_format_calibration(all_bins.above) if all_bins.above else ["0", *["–"] * 4]),
            ]


def _format_calibration(c: Calibration) -> list[str]:
    """Number, mean probability, share that is right, expected calibration error and what chance makes of it."""
    number = int(c.count.sum())
    means = (float((x * c.count).sum() / number) for x in (c.probability, c.right))
    return [str(number), *(f"{m:.2f}" for m in means), f"{c.error:.3f}", f"{c.by_chance:.3f}"]
