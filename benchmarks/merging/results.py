"""docs/results/merging.md from what `register.py`, `strangers.py` and `lookalikes.py` left in ``cache/merge``.

``python -m benchmarks.merging.results docs/results/merging.md``
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.merging import results_text as text
from benchmarks.merging.false_merges import broken, false_merge, false_merges, headline, negatives, rate_at, tellable
from benchmarks.merging.reliability import ORIGINS, calibrated, errors, origin, reliability
from benchmarks.merging.tables import Row, by, good, modality, physical_of, put, rows_of, share, table
from topomerge.statistics import exact_interval
from topomerge.training.belief_hypotheses import kind_of

AREA_NAMES = ("<40", "40-80", "80-200", ">200")
LARGE = AREA_NAMES[2:]
MODALITIES = ("3D–3D", "with a slice")  # of pairs of maps; those with a floor plan have a table of their own


def positives(rows: Sequence[Row]) -> list[Row]:
    """Pairs that share a room."""
    return [r for r in rows if kind_of(r) in AREA_NAMES]


def source_of(row: Row) -> str:
    """Where a simulated pair is from, in words."""
    words = {"procedural": "procedural buildings", "campus": "schools (real plans)", "r2v": "flats (real plans)"}
    return words.get(row["source"], row["source"])


def pairs_made(rows: Sequence[Row]) -> str:
    """How many pairs of how many buildings the recipe gives, by source."""
    count = Counter(source_of(r) for r in rows)
    each = [f"{n} of {len({physical_of(r) for r in rows if source_of(r) == s})} {s}" for s, n in count.most_common()]
    return f"{len(rows)} simulated pairs of {len({physical_of(r) for r in rows})} physical test buildings: {', '.join(each)}"


def _source_and_modality(row: Row) -> str:
    return f"{source_of(row)}, {modality(row)}"


def _plan_of(row: Row) -> str:
    return ("a slice" if "laser2d" in row["sensors"] else "a scan") + (", no scale" if row.get("scaled") else "")


def merged(mine: Sequence[Row], drawn: Sequence[Row]) -> list[str]:
    """Pairs that share rooms: by kind of pair and area, by source, by sensors, and with floor plans."""
    whole = positives(mine)
    large = [r for r in whole if kind_of(r) in LARGE]
    groups = [f"{m}, {area}" for m in MODALITIES for area in AREA_NAMES]
    plans = ("a scan", "a scan, no scale", "a slice", "a slice, no scale")
    sensors = sorted({"-".join(sorted(r["sensors"])) for r in large})
    wrong = [r for r in (*whole, *positives(drawn)) if r["believed"] and not good(r)]
    storeys = sum(bool(r.get("wrong_storey")) and modality(r) != "3D–3D" for r in (*whole, *positives(drawn)))
    return [
        by(whole, lambda r: f"{modality(r)}, {kind_of(r)}", groups, "shared area, m²"),
        f"Believed at a wrong pose: {len(wrong)} of {len(whole) + len(positives(drawn))}, floor plans included. Slices and floor "
        f"plans placed on the wrong storey (counted as wrong): {storeys}.",
        "Pairs that share 80 m² or more, by source:",
        by(large, _source_and_modality, sorted(set(map(_source_and_modality, large))), "pairs of"),
        "The same pairs by sensors:",
        by(large, lambda r: "-".join(sorted(r["sensors"])), sensors, "sensors"),
        "Maps and the floor plan of their own building (a third of the plans have no scale):",
        by(positives(drawn), _plan_of, plans, "floor plan and"),
    ]


def real(rows: Sequence[Row]) -> str:
    """Real pairs by source and what they show."""
    out = []
    names = [f"{r['source']} {' to '.join(sorted(set(r['sensors']), reverse=True))}" for r in rows]
    for name in sorted(set(names)):
        mine = [r for r, group in zip(rows, names, strict=True) if group == name]
        scale = [abs(r["scale"] - 1) for r in mine if r["scale"] and good(r)]
        believed = [r for r in mine if r["believed"]]
        wrong = [r["name"].split("/")[1] for r in mine if not good(r)]
        out.append([
            name, len(mine), len({physical_of(r) for r in mine}), sum(map(good, mine)), sum(good(r, (0.1, 1.0)) for r in mine),
            sum(good(r) for r in believed), sum(not good(r) for r in believed), f"{100 * max(scale, default=0.0):.1f} %",
            f"{np.median([r['seconds'] for r in mine]):.1f}", ", ".join(wrong),
        ])  # fmt: skip
    return table(text.REAL_HEADS, out)


def changed(mine: Sequence[Row], every: Sequence[Row], not_to_merge: Sequence[Row]) -> str:
    """The figures before, the figures now, and why they differ."""
    large = [r for r in positives(mine) if kind_of(r) in LARGE]
    hit = {physical_of(r) for r in not_to_merge if false_merge(r)}
    places = {physical_of(r) for r in not_to_merge}
    low, high = (100 * v for v in exact_interval(len(hit), len(places)))
    whole = calibrated(every)
    above = f"{whole.above.error:.3f} over those of 0.1 or more" if whole.above else "none of 0.1 or more"
    separable = [r for r in not_to_merge if tellable(r)]
    now = {
        "right": f"{share(large, good)} of {len(large)} pairs",
        "believed": share(large, lambda r: good(r) and r["believed"]),
        "pairs": f"{sum(map(false_merge, not_to_merge))} of {len(not_to_merge)}",
        "buildings": f"{len(hit)} of {len(places)}: {low:.1f} to {high:.1f} %",
        "told": f"{sum(map(false_merge, separable))} of {len(separable)}, beside the figure over all pairs",
        "prior": f"{100 * rate_at(not_to_merge)[0]:.1f} %",
        "calibration": f"{whole.error:.3f} over {len(every)}; {above}",
    }
    return table(("what", "before", "now", "why"), [[what, old, now[key], why] for key, what, old, why in text.CHANGES])


def misnamed(not_to_merge: Sequence[Row]) -> str:
    """How many pairs that the generator draws as two buildings are of one."""
    drawn = [r for r in not_to_merge if r["kind"] == "other-building"]
    same = [r for r in drawn if r["negative"] == "other storey"]
    plans = sum(r["building"] == r["other"] for r in same)
    return f"Of {len(drawn)} pairs that were drawn as two buildings, {plans} show one plan furnished twice and " + (
        f"{len(same) - plans} two storeys of one school; these count as other storeys."
    )


def section() -> str:
    """The whole section."""
    mine = [r for r in rows_of("results_test.jsonl") if r["method"] == "ours"]
    drawn = [r for r in rows_of("results_test_drawings.jsonl") if not broken(r)]
    real_pairs, real_strangers = rows_of("results_real.jsonl"), rows_of("strangers_real.jsonl")
    lookalikes = rows_of("lookalikes_test.jsonl")
    pairs, strangers = [*mine, *drawn, *real_pairs], [*rows_of("strangers_test.jsonl"), *real_strangers]
    every = [r for r in (*pairs, *strangers, *lookalikes) if not broken(r)]
    not_to_merge = negatives(every)
    large = [r for r in positives(mine) if kind_of(r) in LARGE]
    groups = {name: [r for r in every if origin(r) == name] for name in ORIGINS}
    groups |= {"all": every, "all but indistinguishable pairs": [r for r in every if tellable(r)]}
    parts = [
        headline(not_to_merge),
        f"Of {len(large)} simulated pairs that share 80 m² or more, {share(large, good)} % are placed right (0.5 m, 5°), "
        f"{share(large, lambda r: good(r, (0.1, 1.0)))} % within 0.1 m and 1°, and "
        f"{share(large, lambda r: good(r) and r['believed'])} % are right and believed.",
        text.COMMANDS, f"{pairs_made(mine)}. {text.ABOUT}", *merged(mine, drawn),
        "## Pairs that must not merge", text.MUST_NOT, false_merges(not_to_merge), misnamed(not_to_merge),
        "Real maps only:", text.STRANGE, false_merges([r for r in not_to_merge if origin(r) == ORIGINS[2]]),
        "## Is what it tells so?", text.CALIBRATION, errors(groups), reliability(every),
        "## Real pairs", text.REAL, real(real_pairs),
        "## Changes from earlier figures", changed(mine, every, not_to_merge), text.LOOKED_AT,
    ]  # fmt: skip
    return "\n\n".join(parts)


if __name__ == "__main__":
    written = section()
    print(written)
    if len(sys.argv) > 1:
        put(Path(sys.argv[1]), written)
