"""Tables of merges: by what the maps share, of pairs that must not merge, of calibration, and of real pairs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np

from topomerge.datasets.real.sources import find_captures
from topomerge.evaluation.documents import group_rows, write_table
from topomerge.evaluation.false_merges import (
    ORIGINS,
    Row,
    classify_origin,
    compute_rate,
    errors,
    format_headline,
    get_physical_building,
    is_broken,
    is_false_merge,
    is_good,
    is_tellable,
    reliability,
    select_negatives,
    tabulate_false_merges,
)
from topomerge.statistics import format_interval
from topomerge.training.belief_hypotheses import classify_pair

AREA_NAMES = ("<40", "40-80", "80-200", ">200")
LARGE = AREA_NAMES[2:]
MODALITIES = ("3D–3D", "with a slice")  # of pairs of maps; those with a floor plan have a table of their own


HEADS = ("pairs", "right", "right %", "within 0.1 m, 1° %", "right and believed %", "believed but wrong", "s")
REAL_HEADS = (
    "pairs", "number", "physical buildings", "right", "within 0.1 m, 1°", "right and believed", "wrong and believed",
    "scale error", "s", "wrong",
)  # fmt: skip
NEGATIVE_SETS = ("strangers", "drawn_strangers", "real_strangers", "lookalikes", "train_lookalikes")


def modality(row: Row) -> str:
    """Kind of a pair by what its maps show."""
    if "drawing" in row["sensors"]:
        return "with a floor plan"
    return "with a slice" if "laser2d" in row["sensors"] or "phone" in row["sensors"] else "3D–3D"


def format_share(rows: Sequence[Row], hit: Callable[[Row], bool]) -> str:
    """Per cent with its interval over physical buildings (`format_interval`)."""
    return format_interval(np.array([float(hit(r)) for r in rows]), np.array([get_physical_building(r) for r in rows]), 0, 100.0)


def format_measures(rows: Sequence[Row]) -> list[object]:
    """Number, right, fine, believed among the right ones, believed and wrong, seconds."""
    true = [r for r in rows if is_good(r)]
    wrong = sum(r["believed"] and r["answered"] and not is_good(r) for r in rows)
    seconds = float(np.median([r["seconds"] for r in rows]))
    shares = (
        format_share(rows, is_good),
        format_share(rows, lambda r: is_good(r, (0.1, 1.0))),
        format_share(rows, lambda r: is_good(r) and r["believed"]),
    )
    return [len(rows), len(true), *shares, wrong, f"{seconds:.1f}"]


def select_positives(rows: Sequence[Row]) -> list[Row]:
    """Return pairs that share a room."""
    return [r for r in rows if classify_pair(r) in AREA_NAMES]


def describe_source(row: Row) -> str:
    """Where a simulated pair is from, in words."""
    names = {"procedural": "procedural buildings", "campus": "schools (real plans)", "r2v": "flats (real plans)"}
    return names.get(str(row["source"]), str(row["source"]))


def describe_pairs(rows: Sequence[Row]) -> str:
    """How many pairs of how many buildings the recipe gives, by source."""
    count = Counter(describe_source(r) for r in rows)
    each = [
        f"{n} of {len({get_physical_building(r) for r in rows if describe_source(r) == s})} {s}" for s, n in count.most_common()
    ]
    return (
        f"{len(rows)} simulated pairs of {len({get_physical_building(r) for r in rows})} physical test buildings: "
        f"{', '.join(each)}"
    )


def name_source(row: Row) -> str:
    """Name source and modality."""
    return f"{describe_source(row)}, {modality(row)}"


def name_plan(row: Row) -> str:
    """Name what is put onto a floor plan."""
    return ("a slice" if "laser2d" in row["sensors"] else "a scan") + (", no scale" if row.get("scaled") else "")


def merged(mine: Sequence[Row], drawn: Sequence[Row]) -> list[str]:
    """Return pairs that share rooms: by kind of pair and area, by source, by sensors, and with floor plans."""
    whole = select_positives(mine)
    large = [r for r in whole if classify_pair(r) in LARGE]
    groups = [f"{m}, {area}" for m in MODALITIES for area in AREA_NAMES]
    plans = ("a scan", "a scan, no scale", "a slice", "a slice, no scale")
    sensors = sorted({"-".join(sorted(r["sensors"])) for r in large})
    wrong = [r for r in (*whole, *select_positives(drawn)) if r["believed"] and not is_good(r)]
    storeys = sum(bool(r.get("wrong_storey")) and modality(r) != "3D–3D" for r in (*whole, *select_positives(drawn)))
    return [
        tabulate_groups(whole, lambda r: f"{modality(r)}, {classify_pair(r)}", groups, "shared area, m²"),
        f"Believed at a wrong pose: {len(wrong)} of {len(whole) + len(select_positives(drawn))}, floor plans included. "
        f"Slices and floor "
        f"plans placed on the wrong storey (counted as wrong): {storeys}.",
        "Pairs that share 80 m² or more, by source:",
        tabulate_groups(large, name_source, sorted(set(map(name_source, large))), "pairs of"),
        "The same pairs by sensors:",
        tabulate_groups(large, lambda r: "-".join(sorted(r["sensors"])), sensors, "sensors"),
        "Maps and the floor plan of their own building (a third of the plans have no scale):",
        tabulate_groups(select_positives(drawn), name_plan, plans, "floor plan and"),
    ]


def tabulate_real(rows: Sequence[Row]) -> str:
    """Real pairs by source and what they show."""
    out = []
    names = [f"{r['source']} {' to '.join(sorted(set(r['sensors']), reverse=True))}" for r in rows]
    for name in sorted(set(names)):
        mine = [r for r, group in zip(rows, names, strict=True) if group == name]
        scale = [abs(r["scale"] - 1) for r in mine if r["scale"] and is_good(r)]
        accepted = [r for r in mine if r["believed"]]
        wrong = [r["name"].split("/")[1] for r in mine if not is_good(r)]
        out.append([
            name, len(mine), len({get_physical_building(r) for r in mine}), sum(map(is_good, mine)), sum(is_good(r, (0.1,
            1.0)) for r in mine),
            sum(is_good(r) for r in accepted), sum(not is_good(r) for r in accepted), f"{100 * max(scale, default=0.0):.1f} %",
            f"{np.median([r['seconds'] for r in mine]):.1f}", ", ".join(wrong),
        ])  # fmt: skip
    return write_table(REAL_HEADS, out)


def format_misnamed(not_to_merge: Sequence[Row]) -> str:
    """How many pairs that the generator draws as two buildings are of one."""
    drawn = [r for r in not_to_merge if r["kind"] == "other-building"]
    same = [r for r in drawn if r["negative"] == "other storey"]
    plans = sum(r["building"] == r["other"] for r in same)
    return f"Of {len(drawn)} pairs that were drawn as two buildings, {plans} show one plan furnished twice and " + (
        f"{len(same) - plans} two storeys of one school; these count as other storeys."
    )


def tabulate_groups(rows: Sequence[Row], key: Callable[[Row], str], groups: Sequence[str], name: str) -> str:
    """Tabulate a line a group."""
    grouped = group_rows(rows, key)
    return write_table((name, *HEADS), [[group, *format_measures(grouped[group])] for group in groups if group in grouped])


def tabulate_merges(rows: Sequence[Row]) -> dict[str, str]:
    """Tabulate what there are rows of, each under the name of its block."""
    boxes, own = ([r for r in rows if r["set"] == name and r["kind"]] for name in ("boxes", "folder"))
    rows = [r for r in rows if r.get("kind") and r["set"] not in ("boxes", "folder") and not is_broken(r)]
    simulated = [r for r in rows if r["set"] in ("test", "train")]
    drawn = [r for r in rows if r["set"].endswith("_drawings")]
    measured = [r for r in rows if r["set"] in ("real", "development", "storeys")]
    apart = select_negatives(rows)
    blocks = {}
    if simulated:
        blocks["merging"] = "\n\n".join([f"{describe_pairs(simulated)}.", *merged(simulated, drawn)])
    if any(r["set"] in NEGATIVE_SETS for r in rows):
        real_ones = [r for r in apart if classify_origin(r) == ORIGINS[2]]
        parts = [format_headline(apart), tabulate_false_merges(apart), format_misnamed(apart)]
        blocks["false-merges"] = "\n\n".join(
            [*parts, *(["Real maps only:", tabulate_false_merges(real_ones)] if real_ones else [])]
        )
        groups = {name: [r for r in rows if classify_origin(r) == name] for name in ORIGINS}
        groups |= {"all": list(rows), "all but indistinguishable pairs": [r for r in rows if is_tellable(r)]}
        blocks["calibration"] = f"{errors(groups)}\n\n{reliability([r for r in rows if 'probability' in r])}"
    if measured:
        blocks["real-merges"] = tabulate_real(measured)
    if boxes:
        blocks["boxes"] = tabulate_boxes(boxes)
    if own:
        blocks["own-merges"] = tabulate_own(own)
    return blocks


def tabulate_own(rows: Sequence[Row]) -> str:
    """Tabulate one's own pairs: how many are placed right, believed and wrongly merged, and each pair."""
    shared, apart = ([r for r in rows if (r["kind"] == "overlap") is which] for which in (True, False))
    right = [r for r in shared if r["right"]]
    wrong = [sum(r["believed"] and not r["right"] for r in of) for of in (shared, apart)]
    warnings = (
        f"{len(shared)} pairs of one place: {len(right)} placed right, {sum(r['believed'] for r in right)} of these believed, "
        f"{wrong[0]} merged wrongly. {len(apart)} pairs of two places: {wrong[1]} merged wrongly."
    )
    lines = []
    for r in sorted(rows, key=lambda r: (r["kind"] != "overlap", r["pair"])):
        off = ["–", "–"] if r["err"] is None else [f"{r['err'][0]:.2f}", f"{r['err'][2]:.1f}"]
        verdict = "two places" if r["kind"] != "overlap" else "right" if r["right"] else "wrong"
        said_so = f"{r['probability']:.2f}{' believed' if r['believed'] else ''}"
        lines.append([r["pair"], f"{r['common']:.0f}", verdict, said_so, *off, f"{r['seconds']:.1f}"])
    return f"{warnings}\n\n{write_table(('pair', 'm² in common', 'pose', 'probability', 'off m', 'off °', 's'), lines)}"


def tabulate_boxes(rows: Sequence[Row]) -> str:
    """Tabulate worlds of boxes by kind."""
    lines = []
    for kind, some in group_rows(rows, lambda r: str(r["kind"])).items():
        right = [sum(r["believed"] and r["right"] is value for r in some) for value in (True, False)]
        probabilities = ", ".join(f"{r['probability']:.2f}{'+' if r['right'] else ''}" for r in some)
        lines.append([f"`{kind}`", len(some), *right, probabilities])
    return write_table(("kind", "pairs", "merged right", "merged wrong", "probabilities (+ right pose)"), lines)


def count_real(rows: Sequence[Row], split: str) -> tuple[str, str] | None:
    """Count the real pairs of a set that are right, fine, merged, and merged wrongly; of ``real`` those of two captures only.

    None without any.
    """
    mine = [r for r in rows if r["set"] == split and (split != "real" or is_independent(r))]
    if not mine:
        return None
    merged_ones = [r for r in mine if r["believed"]]
    right, fine = sum(map(is_good, mine)), sum(is_good(r, (0.1, 1.0)) for r in mine)
    wrong = sum(map(is_false_merge, merged_ones))
    sites = len({get_physical_building(r) for r in mine})
    return f"{right}; {fine}; {len(merged_ones) - wrong}; {wrong}", f"{len(mine)} pairs of {sites} site{'s' * (sites > 1)}"


def is_independent(row: Row) -> bool:
    """Are the maps of a real pair of two captures (`datasets.real.sources.find_captures`)?"""
    one, other = find_captures(str(row["source"]), row["name"].split("/", 1)[1])
    return one != other


def compute_headline(rows: Sequence[Row], settings: object) -> dict[str, tuple[str, str]]:
    """Compute the figures of the README that there are rows of."""
    rows = [r for r in rows if r.get("kind") and r["set"] != "boxes" and not is_broken(r)]
    large = [
        r
        for r in select_positives([r for r in rows if r["set"] == "test"])
        if classify_pair(r) in LARGE and modality(r) == MODALITIES[0]
    ]
    out = {}
    if large:
        values = (is_good, lambda r: is_good(r, (0.1, 1.0)), lambda r: is_good(r) and r["believed"])
        names = ("merges-right", "merges-fine", "merges-merged")
        shares = (format_share(large, hit).partition(" ") for hit in values)
        out = {
            n: (f"{value} %{gap}{interval}", f"{len(large)} pairs")
            for n, (value, gap, interval) in zip(names, shares, strict=True)
        }
    apart = select_negatives(rows)
    strangers = [r for r in apart if r["negative"] == "stranger"]
    if strangers:
        out["false-strangers"] = str(sum(map(is_false_merge, strangers))), f"{len(strangers)} pairs"
    alike = [r for r in apart if r["set"] == "lookalikes" and r["kind"] != "overlap"]
    for name, some in (("false-storeys", [r for r in alike if r["lookalike"] == "storeys"]), ("false-lookalikes", alike)):
        if some:
            false = [r for r in some if is_false_merge(r)]
            hidden = f"; {sum(not is_tellable(r) for r in false)}" if name == "false-lookalikes" else ""
            out[name] = f"{len(false)}{hidden}", f"{len(some)} pairs"
    for name, split in (("merges-real", "real"), ("merges-office", "development")):
        if figure := count_real(rows, split):
            out[name] = figure
    if {r["set"] for r in rows} >= {"test", "strangers", "lookalikes"}:
        rate, low, high = (100 * v for v in compute_rate(apart))
        out["false-prior"] = f"{rate:.0f} % [{low:.0f}, {high:.0f}]", f"{len(apart)} pairs"
    return out
