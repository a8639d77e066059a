"""Verdicts of the peers: what score, and how much of it, makes an answer believed; chosen on training pairs only.

``python -m benchmarks.peers.thresholds`` reads what `run.py` left of the training pairs and writes
``benchmarks/peers/thresholds.json``, which `tables.py` reads: thresholds, command, rule and the names of the pairs.

The rule is the same for every peer: among its variants (KISS-Matcher with rotations in space or with yaw), its scores, and
limits of the residual, the highest recall at a precision of .99 or more; the threshold lies halfway to the best score below it.
Pairs that nobody can tell apart are left out, as they are where our own belief is fitted.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.peers.run import read_result_rows
from topomerge.errors import InputError
from topomerge.evaluation.false_merges import Row, is_broken, is_good, is_tellable
from topomerge.statistics import compute_precision_recall
from topomerge.types import Array

THRESHOLDS_FILE = Path(__file__).with_name("thresholds.json")
THRESHOLDS_COMMAND = "python -m benchmarks.peers.run 2400 train; python -m benchmarks.peers.thresholds"
LEAST_PRECISION = 0.99
RESIDUAL_LIMITS = 9  # tried: quantiles of the residuals of right answers
VARIANTS = {"kiss02": ("kiss02", "kiss02q"), "kiss03": ("kiss03", "kiss03q"), "fpfh": ("fpfh",), "fgr": ("fgr",)}
SCORES = {"inliers": None, "fitness": "residual", "fitness_icp": "residual_icp"}  # and the residual that goes with it


@dataclass(frozen=True)
class PeerVerdict:
    """When a peer's answer is believed.

    Args:
        variant: of the peer, by its name in the rows of `run.py`.
        score: ``inliers``, ``fitness`` or ``fitness_icp`` (`methods.PeerAnswer`).
        at_least: of the score; None: nothing is believed.
        residual_at_most: m, of the residual that goes with the score; None: any.
        precision, recall: on the training pairs.
        right: answers within 0.5 m and 5 degrees there, of the variant.
    """

    variant: str
    score: str
    at_least: float | None
    residual_at_most: float | None
    precision: float
    recall: float
    right: int

    def get_score(self, outcome: Row) -> float:
        """Return the score of an answer; minus infinity where there is none, or its residual is too large."""
        scores = outcome["scores"]
        limit, residual = self.residual_at_most, SCORES[self.score]
        large = limit is not None and residual is not None and scores.get(residual, np.inf) > limit
        return -np.inf if large else scores.get(self.score, -np.inf)

    def is_accepted(self, outcome: Row) -> bool:
        """Return whether an answer is believed."""
        return self.at_least is not None and self.get_score(outcome) >= self.at_least


def apply_refinement(row: Row, variant: str) -> Row:
    """Return a pair's row with the outcome of a peer's variant: ``err`` is of the refined pose, ``err_solved`` of the
    solver's."""
    outcome = row["methods"][variant]
    return {**row, **outcome, "err": outcome.get("err_icp"), "err_solved": outcome["err"]}


def is_possible(row: Row) -> bool:
    """Return whether there is a right pose."""
    return row["kind"] == "overlap" and row["common"] >= 1


def find_least_score(score: Array, right: Array, of: int) -> tuple[float | None, float, float]:
    """Return the threshold of highest recall at `LEAST_PRECISION`, halfway to the best score below it (None: there is none), its
    precision and its recall.

    Args:
        score: (n,) of each answer, minus infinity where there is none.
        right: (n,) is the answer right?
        of: number of pairs that have a right answer.
    """
    scored = np.isfinite(score)
    thresholds, precision, recall = compute_precision_recall(score[scored], right[scored], max(of, 1))
    fine = np.flatnonzero((precision >= LEAST_PRECISION) & (recall > 0))
    if not len(fine):
        return None, 0.0, 0.0
    best = fine[np.argmax(recall[fine])]
    below = thresholds[best + 1] if best + 1 < len(thresholds) else 0.0
    return float(thresholds[best] + below) / 2, float(precision[best]), float(recall[best])


def iter_verdicts(rows: Sequence[Row], variant: str) -> Iterable[PeerVerdict]:
    """Yield a variant's verdicts by every score and limit of the residual."""
    mine = [apply_refinement(r, variant) for r in rows if variant in r["methods"]]
    right = np.array([is_good(r) for r in mine])
    of = sum(map(is_possible, mine))
    for score, residual in SCORES.items():
        if not any(score in r["scores"] for r in mine):
            continue
        limits: list[float | None] = [None]
        if residual is not None and right.any():
            seen = [r["scores"][residual] for r, hit in zip(mine, right, strict=True) if hit and residual in r["scores"]]
            limits += np.quantile(seen, np.linspace(1.0, 0.2, RESIDUAL_LIMITS)).tolist()
        for limit in limits:
            blank = PeerVerdict(variant, score, None, limit, 0.0, 0.0, int(right.sum()))
            at_least, precision, recall = find_least_score(np.array([blank.get_score(r) for r in mine]), right, of)
            yield PeerVerdict(variant, score, at_least, limit, precision, recall, int(right.sum()))


def choose(rows: Sequence[Row]) -> dict[str, PeerVerdict]:
    """Choose each peer's verdict of highest recall, of equal ones that with more right answers, then the first that was tried."""
    rows = [r for r in rows if is_tellable(r) and not is_broken(r)]
    return {
        peer: max((v for name in variants for v in iter_verdicts(rows, name)), key=lambda v: (v.recall, v.right))
        for peer, variants in VARIANTS.items()
    }


def load_verdicts(path: Path = THRESHOLDS_FILE) -> dict[str, PeerVerdict]:
    """Load the verdicts that were written by `main`.

    Raises:
        InputError: they were not.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file; make it with {THRESHOLDS_COMMAND}")
    return {peer: PeerVerdict(**values) for peer, values in json.loads(path.read_text(encoding="utf-8"))["verdicts"].items()}


def serialise_verdicts(rows: Sequence[Row], verdicts: dict[str, PeerVerdict]) -> dict[str, Any]:
    """Serialise the verdicts, the command and pairs that they are from, and how many pairs each variant had right."""
    fair = [r for r in rows if is_tellable(r) and not is_broken(r)]
    variants = {
        v: sum(is_good(apply_refinement(r, v)) for r in fair if v in r["methods"]) for names in VARIANTS.values() for v in names
    }
    return {
        "command": THRESHOLDS_COMMAND,
        "rule": f"highest recall at a precision of {LEAST_PRECISION} or more, over variants, scores and limits of the residual",
        "pairs": len(fair), "with a right pose": sum(map(is_possible, fair)), "right of each variant": variants,
        "verdicts": {peer: asdict(v) for peer, v in verdicts.items()}, "names": [r["name"] for r in fair],
    }  # fmt: skip


def main() -> None:
    """Choose and write."""
    rows = read_result_rows("train")
    verdicts = choose(rows)
    text = json.dumps(serialise_verdicts(rows, verdicts), indent=1) + "\n"
    THRESHOLDS_FILE.write_text(text, encoding="utf-8")
    print(text[: text.index('"names"')])


if __name__ == "__main__":
    main()
