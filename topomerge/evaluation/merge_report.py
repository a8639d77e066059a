"""Tables of merges: by what the maps share, group and site, of pairs that must not merge, of calibration, and of real pairs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from itertools import combinations

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
from topomerge.statistics import Calibration, format_interval, measure_calibration
from topomerge.training.belief_hypotheses import classify_pair

PLACE_ORIGINS = ("procedural", "real plans", "real maps")  # of the places that maps are of
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
    """Group rows by way of merging; ways whose merges come out alike are one, with the seconds of the last of them."""
    names: dict[object, list[str]] = {}
    rows: dict[object, list[Row]] = {}
    for name, these in group_by_variant(merges).items():
        outcome = tuple(sorted((r["pair"], r["believed"], r["near"], r["fine"], r["every_room"], r["rooms_near"]) for r in these))
        names.setdefault(outcome, []).append(name)
        rows[outcome] = these
    return {" = ".join(names[outcome]): these for outcome, these in rows.items()}


def _format_wrong(rows: Sequence[Row]) -> str:
    """Tell how many merges are wrong, and in how many buildings, with the exact interval in per cent."""
    hit, buildings, low, high = count_hit_buildings(rows, "false")
    count = str(sum(r["false"] for r in rows))
    return f"{count}; {hit} of {buildings} buildings [{100 * low:.1f}, {100 * high:.1f}] %" if buildings > 1 else count


def tabulate_sites(merges: Sequence[Row]) -> Table:
    """Tabulate real pairs by physical building, in numbers of pairs."""
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
    """Measure the metres and degrees between two places; where only one way has a pose, they are infinitely far apart."""
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
    """Collect the probability of each match of rows, and whether it is right."""
    return [p for r in rows for p in r["chance"]], [g for r in rows for g in r["good"]]


def _collect_merge_predictions(rows: Sequence[Row]) -> tuple[list[float], list[bool]]:
    """Collect the probability of each merge, and whether its pose is right."""
    return [r["probability"] for r in rows], [bool(r["near"]) for r in rows]


def _iter_calibration_rows(what: str, rows: Sequence[Row], of: Predictions) -> Iterator[list[str]]:
    """Yield a line for each origin that there are any of."""
    for origin in PLACE_ORIGINS:
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
    """Format the number, mean probability, share that is right, expected calibration error and what chance makes of it."""
    number = int(c.count.sum())
    means = (float((x * c.count).sum() / number) for x in (c.probability, c.right))
    return [str(number), *(f"{m:.2f}" for m in means), f"{c.error:.3f}", f"{c.by_chance:.3f}"]


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
    """Return the kind of a pair by what its maps show."""
    if "drawing" in row["sensors"]:
        return "with a floor plan"
    return "with a slice" if "laser2d" in row["sensors"] or "phone" in row["sensors"] else "3D–3D"


def format_share(rows: Sequence[Row], hit: Callable[[Row], bool]) -> str:
    """Format per cent with its interval over physical buildings (`format_interval`)."""
    return format_interval(np.array([float(hit(r)) for r in rows]), np.array([get_physical_building(r) for r in rows]), 0, 100.0)


def format_measures(rows: Sequence[Row]) -> list[object]:
    """Format the number, right, fine, believed among the right ones, believed and wrong, seconds."""
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
    """Tell where a simulated pair is from, in words."""
    names = {"procedural": "procedural buildings", "campus": "schools (real plans)", "r2v": "flats (real plans)"}
    return names.get(str(row["source"]), str(row["source"]))


def describe_pairs(rows: Sequence[Row]) -> str:
    """Tell how many pairs of how many buildings the recipe gives, by source."""
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
    """Tabulate real pairs by source and what they show."""
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
    """Tell how many pairs that the generator draws as two buildings are of one."""
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
        probability = f"{r['probability']:.2f}{' believed' if r['believed'] else ''}"
        lines.append([r["pair"], f"{r['common']:.0f}", verdict, probability, *off, f"{r['seconds']:.1f}"])
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
    """Return whether the maps of a real pair are of two captures (`datasets.real.sources.find_captures`)."""
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
