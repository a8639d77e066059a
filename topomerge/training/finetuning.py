"""Fine-tuning: the embedder that ships goes on learning on one's own pairs, and is kept if it got better on pairs left out."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.datasets.pairs.own_pairs import OWN_DATA, build_own_sets
from topomerge.embedding.learned import EMBEDDER_FILE, PRETRAINED
from topomerge.errors import InputError
from topomerge.models.export import check_exporter
from topomerge.models.weights import read_embedder
from topomerge.networks.network import card_of, read_card, write_card
from topomerge.statistics import FEWEST_GROUPS, OUTSIDE
from topomerge.training.embedding import adopt_network, fit, load_read_pairs
from topomerge.training.run_folder import export_files
from topomerge.training.settings import Training, check
from topomerge.training.validate import PairScores, score_pairs
from topomerge.types import Array, LogFn

SCORES = ("recall@1", "recall@5", "F1")
BOOTSTRAPS = 5000
RUN = "run"  # folder of the training in the output


@dataclass(frozen=True)
class Verdict:
    """The verdict on fine-tuning: its gain on the pairs that were left out.

    Args:
        old, new, gain: of each of `SCORES`: value, and the ends of its 95 % interval; the gain is drawn in pairs.
        overall: gain of the mean of recall@1 and F1, by which it is judged, and the ends of its interval.
        unit, units: what is drawn anew, and how many there are of it.
        pairs, rooms: that were left out.
        helped: there are enough units, and the whole interval of `overall` is above zero.
    """

    old: dict[str, tuple[float, float, float]]
    new: dict[str, tuple[float, float, float]]
    gain: dict[str, tuple[float, float, float]]
    overall: tuple[float, float, float]
    unit: str
    units: int
    pairs: int
    rooms: int
    helped: bool

    def format_lines(self) -> list[str]:
        """Format a table, and in one line whether it helped."""
        few = self.units < FEWEST_GROUPS  # of which an interval would say nothing

        def write(value: tuple[float, float, float], sign: str = "") -> str:
            return f"{value[0]:{sign}.3f}" if few else _format(value, sign)

        rows = [f"{'':10}{'old':22}{'new':22}gain"]
        for name in SCORES:
            rows.append(f"{name:10}{write(self.old[name]):22}{write(self.new[name]):22}{write(self.gain[name], '+')}")
        over = f"{self.units} {self.unit}" if few else f"intervals over {self.units} {self.unit}"
        of = f"{self.pairs} pairs left out, {self.rooms} rooms; {over}"
        change = f"the mean of recall@1 and F1 changed by {write(self.overall, '+')}"
        if self.helped:
            text = "it helped"
        elif few:
            text = f"too few captures to tell whether it helped: {self.units} left out, at least {FEWEST_GROUPS} are needed"
        else:
            text = "it did not help: the interval is not above zero"
        return [*rows, of, f"{text}; {change}"]


def _format(value: tuple[float, float, float], sign: str = "") -> str:
    return "{:{s}.3f} [{:{s}.3f}, {:{s}.3f}]".format(*value, s=sign)


def finetune(
    settings: Training, output: str | Path, keep: bool = False, jobs: int = 1, log_line: LogFn = lambda text: None
) -> Verdict:
    """Train on a folder of one's own pairs, compare with the start on those left out, and write what is better.

    Args:
        settings: `path` names the folder, `init_from` the start.
        output: folder for the run, and for the embedder and its card if it helped.
        keep: write it in any case.
        jobs: processes that extract the captures.

    Raises:
        InputError: whatever is wrong with the folder or the settings; nothing was trained.
    """
    output = Path(output)
    settings = replace(settings, data=OWN_DATA, name=RUN, runs=str(output), logger=[], overwrite=True)
    check(settings)
    settings = adopt_network(settings)
    check_exporter()
    if output.exists() and not output.is_dir():
        raise InputError(f"{output}: is a file; give the name of a folder")
    manifests = build_own_sets(settings.path, settings.cache, jobs, log_line).manifests
    left_out = load_read_pairs(settings, manifests["test"], log_line)
    fit(settings, log_line)
    best = settings.folder / "best"
    each = [score_pairs(read_embedder(place)[0], left_out) for place in (settings.init_from, best)]
    trained = {name for row in _read_rows(manifests["train"]) for name in row["captures"]}
    verdict = judge(each[0], each[1], _read_rows(manifests["test"]), trained)
    shutil.rmtree(settings.folder / "last", ignore_errors=True)
    for file in (output / EMBEDDER_FILE, card_of(output / EMBEDDER_FILE)):
        file.unlink(missing_ok=True)
    if verdict.helped or keep:
        export_files(best, str(output), "")
        card = read_card(output / EMBEDDER_FILE)
        write_card(output / EMBEDDER_FILE, {**card, "about": {**card["about"], "finetuned": describe(verdict, settings)}})
    return verdict


def _read_rows(manifest: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in manifest.read_text(encoding="utf-8").splitlines()]


def describe(verdict: Verdict, settings: Training) -> dict[str, Any]:
    """Describe a verdict as in the card of an embedder."""
    scores = {key: {n: [round(v, 4) for v in of[n]] for n in SCORES} for key, of in (("old", verdict.old), ("new", verdict.new))}
    return {"from": settings.init_from, "pairs": verdict.pairs, "rooms": verdict.rooms, "helped": verdict.helped, **scores}


def judge(old: Sequence[PairScores], new: Sequence[PairScores], about: Sequence[dict[str, Any]], trained: set[str]) -> Verdict:
    """Compare two embedders on the same pairs by a paired bootstrap over buildings or captures that were left out.

    Drawn anew are buildings where eight were left out, else captures: pairs of one capture are not independent. Of fewer than
    eight captures it cannot be told whether it helped. Each embedder matches at the certainty that suits it best.

    Args:
        about: what is known of each pair.
        trained: names of captures that trained.

    Raises:
        InputError: no rooms match in any pair.
    """
    buildings = [str(of["building"]) for of in about]
    captures = [next((n for n in of["captures"] if n not in trained), of["captures"][0]) for of in about]
    many = len(set(buildings)) >= FEWEST_GROUPS
    unit, names = ("buildings", buildings) if many else ("captures left out", captures)
    _, group = np.unique(names, return_inverse=True)
    tables = [np.array([_count(one) for one in of], float) for of in (old, new)]
    if not tables[0][:, 0].sum():
        raise InputError("no rooms match in the pairs left out; see topomerge dataset check, or change split")
    groups = int(group.max()) + 1
    summed = [np.stack([table[group == k].sum(axis=0) for k in range(groups)]) for table in tables]
    drawn = np.random.default_rng(0).multinomial(groups, np.full(groups, 1 / groups), size=BOOTSTRAPS)
    values = [_compute_scores(of.sum(axis=0)[None], of) for of in summed]
    draws = [_compute_scores(drawn @ of, full) for of, full in zip(summed, summed, strict=True)]
    old_values, new_values = (_bound(v, d) for v, d in zip(values, draws, strict=True))
    gain = _bound(values[1] - values[0], draws[1] - draws[0])
    both = [(v[:, 0] + v[:, 2]) / 2 for v in (values[1] - values[0], draws[1] - draws[0])]
    overall = _bound(both[0][:, None], both[1][:, None])[0]
    before, after, gained = (dict(zip(SCORES, of, strict=True)) for of in (old_values, new_values, gain))
    helped = groups >= FEWEST_GROUPS and overall[1] > 0
    return Verdict(before, after, gained, overall, unit, groups, len(old), int(tables[0][:, 0].sum()), helped)


def _count(one: PairScores) -> list[float]:
    """Count the rooms with a partner, those whose partner is first, or among five, and `count_pairs` at each certainty."""
    return [len(one.ranks), (one.ranks <= 1).sum(), (one.ranks <= 5).sum(), *one.counts.ravel()]


def _compute_scores(sums: Array, every: Array) -> Array:
    """Return (n, 3) `SCORES` of sums (n, ...) of `_count`; at the certainty at which F1 of all groups together is best."""

    def f1(of: Array) -> Array:
        matched, right, requested, got = np.moveaxis(of[:, 3:].reshape(len(of), -1, 4), 2, 0)
        precision, recall = right / np.maximum(matched, 1), got / np.maximum(requested, 1)
        return np.asarray(2 * precision * recall / np.maximum(precision + recall, 1e-9))

    best = int(f1(every.sum(axis=0)[None])[0].argmax())
    rooms = np.maximum(sums[:, 0], 1)
    return np.column_stack([sums[:, 1] / rooms, sums[:, 2] / rooms, f1(sums)[:, best]])


def _bound(values: Array, draws: Array) -> list[tuple[float, float, float]]:
    """Return each value (1, k) with the ends of the 95 % interval of its draws (n, k)."""
    ends = np.quantile(draws, [OUTSIDE, 1 - OUTSIDE], axis=0)
    return [(float(v), float(low), float(high)) for v, low, high in zip(values[0], ends[0], ends[1], strict=True)]


def start_settings(path: str | Path, cache: str | Path, **given: Any) -> Training:
    """Return the settings of fine-tuning: few epochs at a small rate, from the embedder that ships."""
    common = {"init_from": PRETRAINED, "epochs": 6, "rate": 2e-4, "batch": 8, "patience": 0}
    return Training(path=str(path), cache=str(cache), **{**common, **given})
