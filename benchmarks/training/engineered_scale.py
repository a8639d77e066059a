"""Write `topomerge/embedding/engineered.json`: what the engineered features are scaled by.

Run from the root: ``python -m benchmarks.training.engineered_scale MANIFEST``, of pairs of the *training* split (``python -m
topomerge.datasets.pairs.build data=matching_train``). Rooms weigh alike, looked-into ones (most of the outline unseen) not at
all.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
from topomerge.datasets.pairs.evaluation_pair import load_set

from topomerge.embedding.engineered import FEATURES, raw_features
from topomerge.io.atomic import replacing

SHRINK = 0.1  # share of the features' own variances in the covariance of the differences: few rooms give a noisy one


def main(manifest: str) -> None:
    values, differences = [], []
    for pair in load_set(Path(manifest)):
        maps = pair.maps()
        (a, b), (glimpsed_a, glimpsed_b) = map(raw_features, maps), (m.rooms["glimpsed"] for m in maps)
        values += [a[~glimpsed_a], b[~glimpsed_b]]
        i, j = pair.matches.T
        good = pair.one[0][i] & pair.one[1][j] & ~glimpsed_a[i] & ~glimpsed_b[j]
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
    target = Path(__file__).parent.parent.parent / "topomerge" / "embedding" / "engineered.json"
    with replacing(target) as beside:
        beside.write_text(json.dumps(known, indent=1) + "\n", encoding="utf-8")
    print(f"{target}: {len(rooms)} rooms, {len(apart)} seen twice")


if __name__ == "__main__":
    main(sys.argv[1])
