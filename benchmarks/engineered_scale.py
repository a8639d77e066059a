"""Write `topomerge/embedding/engineered.json`: what the engineered features are scaled by.

Run from the root: ``python benchmarks/engineered_scale.py FOLDER``, FOLDER being pairs of the *training* split that
`benchmarks/matching_pairs.py` made. Rooms weigh alike, looked-into ones (most of the outline unseen) not at all.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
from matching_pairs import load

from topomerge.embedding.engineered import FEATURES, raw_features
from topomerge.io.atomic import replacing

SHRINK = 0.1  # share of the features' own variances in the covariance of the differences: few rooms give a noisy one


def main(folder: str) -> None:
    values, differences = [], []
    for pair in load(Path(folder)):
        a, b = raw_features(pair.a), raw_features(pair.b)
        values += [a[~pair.a.rooms["glimpsed"]], b[~pair.b.rooms["glimpsed"]]]
        i, j = pair.matches.T
        good = pair.one_a[i] & pair.one_b[j] & ~pair.a.rooms["glimpsed"][i] & ~pair.b.rooms["glimpsed"][j]
        differences.append((a[i] - b[j])[good])
    rooms, apart = np.concatenate(values), np.concatenate(differences)
    limit = 4 * rooms.std(axis=0)
    apart = np.clip(apart, -limit, limit)
    second = apart.T @ apart / len(apart)
    second += np.diag(SHRINK * rooms.var(axis=0) + 1e-6)
    known = {
        "features": FEATURES,
        "rooms": len(rooms),
        "pairs_of_rooms": len(apart),
        "mean": np.round(rooms.mean(axis=0), 5).tolist(),
        "spread": np.round(rooms.std(axis=0) + 1e-6, 5).tolist(),
        "differences": np.round(second, 6).tolist(),
    }
    target = Path(__file__).parent.parent / "topomerge" / "embedding" / "engineered.json"
    with replacing(target) as beside:
        beside.write_text(json.dumps(known, indent=1) + "\n", encoding="utf-8")
    print(f"{target}: {len(rooms)} rooms, {len(apart)} seen twice")


if __name__ == "__main__":
    main(sys.argv[1])
