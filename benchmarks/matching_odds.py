"""The weights of `ODDS` in `topomerge/matching/consistency.py`: how likely a hypothesis is right, given its evidence.

Run from the root: ``python benchmarks/matching_odds.py MANIFEST``, of pairs of the *training* split (``python -m
topomerge.datasets.build data=matching_train``). Hypotheses are searched in each pair, and in as many of two buildings; then
a softmax over the hypotheses and "none" is fitted to which one is right. Prints the weights, and how often which was right.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
from scipy.optimize import minimize
from topomerge.datasets.kept import load_set

from topomerge.matching.consistency import odds_features
from topomerge.matching.match import match
from topomerge.types import Array

RIGHT = (1.0, np.radians(5))  # m at any room's middle, rad


def collect(manifest: Path) -> list[tuple[Array, Array]]:
    """(features (H, 4), right (H,)) of each pair of maps."""
    pairs, found = [p for p in load_set(manifest) if p.transform is not None and len(p.matches)], []
    for n, p in enumerate(pairs):
        if "tablet" in p.about["sensors"]:  # the extraction of September finds their floor a table high
            continue
        a, own = p.maps()
        for b, true in ((own, True), (pairs[(n + 7) % len(pairs)].maps()[1], False)):
            hypotheses = match(a, b).alternatives
            assert p.transform is not None
            c = b.rooms["centroid"]
            off = [np.linalg.norm(h.transform.apply(c) - p.transform.apply(c), axis=1).max() for h in hypotheses]
            right = np.array(off) < RIGHT[0] if true else np.zeros(len(off), bool)
            evidence = np.array([list(h.evidence.values()) for h in hypotheses]).reshape(-1, 3)
            found.append((odds_features(evidence), right))
    return found


def fit(found: list[tuple[Array, Array]]) -> Array:
    """Weights (4,) of the most likely softmax, with a mild pull to 0."""

    def loss(w: Array) -> float:
        total = 0.05 * float(w[1:] @ w[1:])
        for x, right in found:
            logits = np.append(x @ w, 0.0)
            total -= float(np.logaddexp.reduce(logits[np.append(right, not right.any())]) - np.logaddexp.reduce(logits))
        return total

    out: Array = minimize(loss, np.zeros(4)).x
    return out


def main(manifest: str) -> None:
    found = collect(Path(manifest))
    w = fit(found)
    print(json.dumps(np.round(w, 3).tolist()), len(found))
    top = np.array([(p[0], right[0]) for p, right in ((chances(x @ w), r) for x, r in found) if len(p)])
    for low, high in zip((0, 0.1, 0.3, 0.7, 0.9, 0.99), (0.1, 0.3, 0.7, 0.9, 0.99, 1.1), strict=True):
        some = top[(top[:, 0] >= low) & (top[:, 0] < high)]
        print(f"{low:.2f}..{min(high, 1):.2f}: {len(some)} pairs, first one right {some[:, 1].mean() if len(some) else 0:.2f}")


def chances(logits: Array) -> Array:
    e = np.exp(np.clip(logits, -50, 50))
    out: Array = e / (e.sum() + 1)
    return out


if __name__ == "__main__":
    main(sys.argv[1])
