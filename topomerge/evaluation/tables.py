"""Scores as tables: Markdown to read, CSV to reckon with, LaTeX for the thesis."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.archive import replace_on_success
from topomerge.evaluation.score import GLIMPSED, GROUPS, WHOLE, Row
from topomerge.evaluation.settings import Evaluation
from topomerge.statistics import FEWEST_GROUPS, compute_exact_interval
from topomerge.types import Array

LEVELS = [2.5, 97.5]  # percent
Ratio = tuple[str, str]  # names of two counts


@dataclass(frozen=True)
class Value:
    """A ratio of counts with its 95 % interval, and what it is of; nan where nothing was counted.

    Args:
        low, high: ends of the interval; of fewer than eight buildings the least and the largest of a building.
        buildings: those of the rows.
        counted: those of them in which anything was counted: what the interval is over.
    """

    value: float
    low: float
    high: float
    pairs: int
    buildings: int
    counted: int = 0

    @property
    def ranged(self) -> bool:
        """Is the interval the range of the buildings?"""
        return self.counted < FEWEST_GROUPS


def _compute_f1(precision: Array, recall: Array) -> Array:
    both = precision + recall
    return np.where(both > 0, 2 * precision * recall / np.where(both > 0, both, 1), np.where(np.isnan(both), np.nan, 0.0))


RATIOS: dict[str, Ratio] = {
    **{f"precision{g}": (f"right{g}", f"predicted{g}") for g in GROUPS},
    **{f"recall{g}": (f"found{g}", f"units{g}") for g in GROUPS},
    **{f"recall@1{g}": (f"first{g}", f"queries{g}") for g in GROUPS},
    **{f"recall@5{g}": (f"five{g}", f"queries{g}") for g in GROUPS},
    **{f"MRR{g}": (f"reciprocal{g}", f"queries{g}") for g in GROUPS},
    **{f"recall@1{g}": (f"first{g}", f"queries{g}") for g in (WHOLE, GLIMPSED)},
    "recall@1_after": ("first_after", "queries"),
    "recall@1_single_after": ("first_single_after", "queries_single"),
    "recall@5_after": ("five_after", "queries"),
    "strict recall": ("strict_right", "strict_units"),
    "right poses": ("near", "mergeable"),
    "right finely": ("fine", "mergeable"),
    "every room": ("every_room", "with_rooms"),
    "rooms": ("rooms_near", "rooms_shared"),
    "merged": ("merged", "mergeable"),
    "merged finely": ("merged_fine", "mergeable"),
    "refused": ("refused", "mergeable"),
    "false": ("false", "pairs"),
    "seconds": ("seconds", "pairs"),
}
COMBINED: dict[str, tuple[str, str, Callable[[Array, Array], Array]]] = {
    f"F1{g}": (f"precision{g}", f"recall{g}", _compute_f1) for g in GROUPS
}


def measure(metric: str, counts: Mapping[str, Array]) -> Array:
    """Return a metric of sums of counts, element by element; nan where there is nothing to divide by."""
    if metric in COMBINED:
        first, second, combine = COMBINED[metric]
        return combine(measure(first, counts), measure(second, counts))
    top, bottom = (np.asarray(counts[name], float) for name in RATIOS[metric])
    return np.where(bottom > 0, top / np.where(bottom > 0, bottom, 1), np.nan)


def list_needed_counts(metric: str) -> tuple[str, ...]:
    """Return the counts that a metric is made of."""
    if metric in COMBINED:
        return (*list_needed_counts(COMBINED[metric][0]), *list_needed_counts(COMBINED[metric][1]))
    return RATIOS[metric]


def sum_counts(rows: Sequence[Row], names: Iterable[str], buildings: Sequence[str]) -> dict[str, Array]:
    """Return counts (buildings,) by name."""
    number = {b: i for i, b in enumerate(buildings)}
    of = np.array([number[r["building"]] for r in rows], int)
    return {n: np.bincount(of, [float(r[n]) for r in rows], len(buildings)) for n in names}


@lru_cache(256)
def draw_buildings(buildings: int, rounds: int, seed: int = 0) -> Array:
    """Return (rounds, buildings) how often each building was drawn, with replacement."""
    drawn = np.random.default_rng(seed).integers(buildings, size=(rounds, buildings))
    rows = np.arange(rounds)[:, None] * buildings
    counts = np.bincount((drawn + rows).ravel(), minlength=rounds * buildings)
    return counts.reshape(rounds, buildings).astype(np.float64)  # a product of integers is no BLAS call


def compute_value(rows: Sequence[Row], metric: str, rounds: int = 2000) -> Value:
    """Return a metric over rows, all pairs summed, with its interval over buildings."""
    buildings = sorted({r["building"] for r in rows})
    if not rows:
        return Value(np.nan, np.nan, np.nan, 0, 0)
    counts = sum_counts(rows, list_needed_counts(metric), buildings)
    ratio = float(measure(metric, {n: c.sum() for n, c in counts.items()}))
    held, low, high = _estimate_interval(counts, rounds, lambda c: measure(metric, c))
    return Value(ratio, low, high, len({r["pair"] for r in rows}), len(buildings), held)


def compute_gain(rows: Sequence[Row], others: Sequence[Row], metric: str, rounds: int = 2000) -> Value:
    """Compute how much better rows are than others of the same pairs; buildings are drawn for both alike."""
    buildings = sorted({r["building"] for r in rows} | {r["building"] for r in others})
    if not rows or not others:
        return Value(np.nan, np.nan, np.nan, 0, 0)
    both = [sum_counts(compared_rows, list_needed_counts(metric), buildings) for compared_rows in (rows, others)]
    counts = {(side, name): c for side, of in enumerate(both) for name, c in of.items()}

    def subtract_sides(c: Mapping[tuple[int, str], Array]) -> Array:
        first, second = (measure(metric, {name: v for (s, name), v in c.items() if s == side}) for side in (0, 1))
        return first - second

    held, low, high = _estimate_interval(counts, rounds, subtract_sides)
    ratio = float(subtract_sides({key: c.sum() for key, c in counts.items()}))
    return Value(ratio, low, high, len({r["pair"] for r in rows}), len(buildings), held)


def _estimate_interval(counts: Mapping[Any, Array], rounds: int, measured: Callable[[Any], Array]) -> tuple[int, float, float]:
    """Estimate the number of buildings in which anything was counted, and the ends of the interval over them: of draws, or of
    fewer than eight their range.

    Args:
        counts: (buildings,) each.
        measured: the metric of such counts, element by element.
    """
    held = np.any([c != 0 for c in counts.values()], axis=0)
    by_building = {key: c[held] for key, c in counts.items()}
    number = int(held.sum())
    if number >= FEWEST_GROUPS:
        drawn = draw_buildings(number, rounds)
        by_building = {key: drawn @ c for key, c in by_building.items()}
    values = measured(by_building)
    finite = values[np.isfinite(values)]
    if not len(finite):
        return number, float("nan"), float("nan")
    low, high = np.percentile(finite, LEVELS if number >= FEWEST_GROUPS else [0, 100]).tolist()
    return number, low, high


def count_hit_buildings(rows: Sequence[Row], count: str) -> tuple[int, int, float, float]:
    """Count the buildings with a row that has any of a count, all buildings, and the ends of the exact 95 % interval of their
    share: for what is rare, as wrong merges are."""
    buildings = {r["building"] for r in rows}
    hit = {r["building"] for r in rows if r[count]}
    return len(hit), len(buildings), *compute_exact_interval(len(hit), len(buildings))


BY = {
    "overlap": "Share of rooms in common, or kind of hard negative",
    "area": "Area that both maps saw, m²",
    "sensors": "Sensors",
    "modality": "Kind of maps",
    "source": "Source",
    "seen": "Sources that training data came from, and unseen sources",
}
RANKING = ("recall@1", "recall@1_single", "recall@1_twin", "recall@1_whole", "recall@1_glimpsed", "recall@5", "MRR")
AFTER = ("recall@1_after", "recall@1_single_after", "recall@5_after")
MATCHING = ("precision", "recall", "F1", "F1_single", "F1_twin", "strict recall")
MERGING = ("right poses", "right finely", "every room", "rooms", "merged", "merged finely", "refused")
METRIC_NAMES = {
    "recall@1": "recall@1", "recall@1_single": "without twin", "recall@1_twin": "with twin",
    "recall@1_whole": "entered", "recall@1_glimpsed": "looked into", "recall@5": "recall@5", "MRR": "MRR",
    "recall@1_after": "after consensus: recall@1", "recall@1_single_after": "without twin", "recall@5_after": "recall@5",
    "precision": "precision", "recall": "recall", "F1": "F1", "F1_single": "F1 without twin", "F1_twin": "F1 with twin",
    "strict recall": "one-to-one recall", "right poses": "best pose right", "merged": "merged right",
    "refused": "right but refused", "right finely": "within 0.1 m, 1°", "every room": "all rooms within 0.1 m",
    "rooms": "rooms within 0.1 m", "merged finely": "merged within 0.1 m, 1°",
}  # fmt: skip


@dataclass(frozen=True)
class Table:
    """A table of words; the first `names` columns are no numbers."""

    title: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    names: int = 1

    def format_markdown(self) -> str:
        lines = ["| " + " | ".join(self.head) + " |", "|" + "---|" * len(self.head)]
        return f"{self.title}\n\n" + "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in self.rows)])

    def format_latex(self) -> str:
        columns = "l" * self.names + "r" * (len(self.head) - self.names)
        lines = [" & ".join(_escape_latex(c) for c in row) + r" \\" for row in (self.head, *self.rows)]
        body = "\n".join([lines[0], r"\midrule", *lines[1:]])
        caption = f"\\caption{{{_escape_latex(self.title)}}}"
        opening = [
            r"\begin{table}",
            r"\centering",
            caption,
            f"\\begin{{tabular}}{{{columns}}}",
            r"\toprule",
            body,
            r"\bottomrule",
        ]
        return "\n".join([*opening, r"\end{tabular}", r"\end{table}"])


def _escape_latex(text: str) -> str:
    text = re.sub(r"([&%$#_{}])", r"\\\1", text)
    for plain, tex in (("²", r"$^2$"), ("°", r"$^\circ$"), ("≥", r"$\geq$"), ("<", r"$<$"), (">", r"$>$"), ("–", "--")):
        text = text.replace(plain, tex)
    return text


def format_value(v: Value, interval: bool = True) -> str:
    """Return 0.52 [0.47, 0.58], or of fewer than eight buildings 0.52, 0.47–0.58 (4 buildings); – where nothing was counted."""
    if not np.isfinite(v.value):
        return "–"
    if not interval or v.counted < 2:
        return f"{v.value:.2f}"
    return f"{v.value:.2f}" + (
        f", {v.low:.2f}–{v.high:.2f} ({v.counted} buildings)" if v.ranged else f" [{v.low:.2f}, {v.high:.2f}]"
    )


def group_by(rows: Sequence[Row], key: str) -> dict[str, list[Row]]:
    """Return rows by what they say under a key, in the order of their names."""
    out: dict[str, list[Row]] = {}
    for row in rows:
        out.setdefault(str(row[key]), []).append(row)
    order = ["none", "<40", "40-80", "80-200", ">200"] if key == "area" else sorted(out)
    return {name: out[name] for name in order if name in out}


def tabulate_ranking(ranks: Sequence[Row], settings: Evaluation) -> Table:
    """Tabulate how high the true partner of a room ranks among all rooms of the other map."""
    first = [r for r in ranks if r["variant"] == settings.baseline]
    rows, after = [], AFTER if any(np.isfinite(r["first_after"]) for r in ranks) else ()
    for name, variant_rows in group_by_variant(ranks).items():
        better = compute_gain(variant_rows, first, "recall@1", settings.rounds) if name != settings.baseline else None
        cells = [format_value(compute_value(variant_rows, m, settings.rounds), m in ("recall@1", "recall@5")) for m in RANKING]
        took = np.median([r["seconds"] for r in variant_rows])
        cells += [
            _format_signed(better),
            *(format_value(compute_value(variant_rows, m, settings.rounds), m == AFTER[0]) for m in after),
        ]
        rows.append([name, *cells, f"{took:.2f}"])
    more = f"recall@1 gain over {settings.baseline}"
    head = ["descriptor", *(METRIC_NAMES[m] for m in RANKING), more, *(METRIC_NAMES[m] for m in after), "s per pair"]
    return Table("Ranking of rooms: is a room's true partner the nearest?", head, rows)


def _format_signed(v: Value | None) -> str:
    if v is None or not np.isfinite(v.value):
        return ""
    ends = f", {v.low:+.2f} to {v.high:+.2f} ({v.counted} buildings)" if v.ranged else f" [{v.low:+.2f}, {v.high:+.2f}]"
    return f"{v.value:+.2f}{ends}"


def group_by_variant(rows: Sequence[Row], key: Callable[[Row], str] = lambda r: r["variant"]) -> dict[str, list[Row]]:
    out: dict[str, list[Row]] = {}
    for row in rows:
        out.setdefault(key(row), []).append(row)
    return out


def tabulate_matching(matches: Sequence[Row], settings: Evaluation) -> Table:
    """Tabulate precision, recall and F1 of each descriptor and method where maps share rooms; how many matches there are where
    not."""
    rows = []
    for name, variant_rows in group_by_variant(matches).items():
        for method, these in group_by_variant(variant_rows, lambda r: r["method"]).items():
            sharing, apart = split_shared(these)
            cells = [format_value(compute_value(sharing, m, settings.rounds), m == "F1") for m in MATCHING]
            large = format_value(compute_value([r for r in these if r["large"]], "F1", settings.rounds))
            wrong = f"{np.mean([r['predicted'] for r in apart]):.1f}" if apart else "–"
            rows.append([name, method, *cells, large, wrong, f"{np.median([r['seconds'] for r in these]):.2f}"])
    metrics = (METRIC_NAMES[m] for m in MATCHING)
    head = ["descriptor", "matching", *metrics, "F1, ≥ 80 m² shared", "matches per pair without shared rooms", "s per pair"]
    return Table("Room matches, on pairs that share rooms", head, rows, 2)


def tabulate_methods(matches: Sequence[Row], settings: Evaluation) -> Table:
    """Tabulate precision, recall and F1 of the methods beside each other, a line a descriptor: the thesis' table, with recall."""
    methods = list(dict.fromkeys(m["method"] for m in matches))
    rows = []
    for name, variant_rows in group_by_variant(split_shared(matches)[0]).items():
        cells = []
        for method in methods:
            these = [r for r in variant_rows if r["method"] == method]
            both = " / ".join(format_value(compute_value(these, m, settings.rounds), False) for m in ("precision", "recall"))
            cells += [both if these else "–", format_value(compute_value(these, "F1", settings.rounds))]
        rows.append([name, *cells])
    head = ["descriptor", *(text for m in methods for text in (f"{m}: P / R", f"{m}: F1"))]
    return Table("Room matches by method, on pairs that share rooms", head, rows)


def split_shared(rows: Sequence[Row]) -> tuple[list[Row], list[Row]]:
    """Return rows of pairs that share rooms, and of those that share none."""
    return [r for r in rows if r["units"]], [r for r in rows if not r["units"]]


def tabulate_groups(ranks: Sequence[Row], matches: Sequence[Row], key: str, settings: Evaluation) -> Table:
    """Tabulate recall@1, and F1 of each method, for each group and descriptor without context or trained one."""
    rows = []
    matches_by_group = group_by(matches, key)
    for group, group_rows in group_by(ranks, key).items():
        for name, these in group_by_variant([r for r in group_rows if r["k"] == 0]).items():
            sharing = split_shared([m for m in matches_by_group.get(group, []) if m["variant"] == name])[0]
            matches_by_method = group_by_variant(sharing, lambda r: r["method"])
            cells = [
                format_value(compute_value(matches_by_method.get(m, []), "F1", settings.rounds)) for m in _list_methods(matches)
            ]
            pairs = compute_value(these, "recall@1", settings.rounds)
            rows.append([group, str(pairs.pairs), str(pairs.buildings), name, format_value(pairs), *cells])
    head = [key, "pairs", "buildings", "descriptor", "recall@1", *(f"F1 {m}" for m in _list_methods(matches))]
    return Table(BY[key], head, rows, 4)


def _list_methods(matches: Sequence[Row]) -> list[str]:
    return list(dict.fromkeys(m["method"] for m in matches if m["k"] == 0))


def iter_long_rows(ranks: Sequence[Row], matches: Sequence[Row], merges: Sequence[Row], settings: Evaluation) -> Iterator[Row]:
    """Yield every metric of every group, one a row, for other tools."""
    for rows, metrics in ((ranks, (*RANKING, *AFTER)), (matches, MATCHING), (merges, (*MERGING, "false"))):
        for (variant, method), variant_rows in _group_by_variant_and_method(rows).items():
            for key in ("all", *BY):
                for group, these in {"all": variant_rows}.items() if key == "all" else group_by(variant_rows, key).items():
                    sharing = split_shared(these)[0] if rows is matches else these
                    for metric in metrics:
                        v = compute_value(sharing, metric, min(settings.rounds, 500))
                        head = {"variant": variant, "method": method, "by": key, "group": group, "metric": metric}
                        yield {**head, "value": v.value, "low": v.low, "high": v.high, "pairs": v.pairs, "buildings": v.buildings}


def _group_by_variant_and_method(rows: Sequence[Row]) -> dict[tuple[str, str], list[Row]]:
    out: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        out.setdefault((row["variant"], row.get("method", "")), []).append(row)
    return out


def write_csv(rows: Sequence[Row], path: Path) -> None:
    """Write rows with the same keys; lists are left out."""
    if not rows:
        return
    names = [n for n in rows[0] if not isinstance(rows[0][n], list)]
    with replace_on_success(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, names, extrasaction="ignore")
        writer.writeheader()
        writer.writerows({n: f"{r[n]:.6g}" if isinstance(r[n], float) else r[n] for n in names} for r in rows)


def write_section(path: Path, mark: str, text: str) -> None:
    """Replace what stands between the two marks of a file, or add marks and a section at its end."""
    begin, end = f"<!-- {mark}:begin -->", f"<!-- {mark}:end -->"
    page = path.read_text(encoding="utf-8") if path.exists() else "# Results\n"
    if begin not in page or end not in page:
        page = f"{page.rstrip()}\n\n## {mark.capitalize()}\n\n{begin}\n{end}\n"
    before, rest = page.split(begin, 1)
    with replace_on_success(path) as temporary:
        temporary.write_text(f"{before}{begin}\n{text}\n{end}{rest.split(end, 1)[1]}", encoding="utf-8")
