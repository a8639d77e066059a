"""Right and wrong poses, judged as rigid and as bent; and the key points of the office floor."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from topomerge.datasets.pairs.grid_pairs import GridPair, load_grids
from topomerge.datasets.real.office_floor import OFFICE_PIXEL

from benchmarks.merging.bending_measures import conflict
from benchmarks.merging.cached_pairs import buildings_of
from benchmarks.merging.strangers import strangers
from topomerge.registration.bend.bend import Bend
from topomerge.registration.judge import Judge
from topomerge.registration.pipeline import Registration
from topomerge.registration.prepared import Prepared
from topomerge.registration.verify import plausibility
from topomerge.training.belief_hypotheses import error, right, together
from topomerge.types import Array, Sim3

MOST_WRONG = 3  # wrong poses of a pair
RIVAL_POSE = (1.5, 10.0)  # m, degrees off at least: between that and right a pose is neither


def judged(a: Prepared, b: Prepared, pose: Sim3, bent: Bend) -> dict[str, Any]:
    """What is counted under a pose, ``rigid`` and ``bent``, and what the bending itself tells (``bending``)."""
    features = Judge(a.storeys, b.storeys)(pose)
    after = Judge(a.storeys, bent.storeys(b.storeys))(bent.transform) if not bent.reason else features
    return {"rigid": counted(features), "bent": counted(after), "bending": {**bent.features, "reason": bent.reason}}


def counted(features: dict[str, float]) -> dict[str, float]:
    """Share of walls on free floor, as it is and drawn towards the usual; walls that meet, of all; log odds of all features."""
    some = {key: float(features[key]) for key in ("conflict_share", "walls", "conflict", "ratio", "share")}
    return {**some, "drawn": conflict(features), "score": plausibility(features)}


def wrong_poses(best: Registration, pair: GridPair) -> Iterator[tuple[str, Sim3]]:
    """Poses that were proposed for a pair, before their fine registration: "right" the best one if it is so, "wrong" those far
    from the truth, the most plausible first; of maps of two places the best one only."""
    poses = [h.transform for h in best.alternatives]
    if pair.about["kind"] != "overlap":
        yield from (("wrong", pose) for pose in poses[:1])
        return
    sensors: Any = pair.about["sensors"]
    flat = ("drawing",) if "phone" in sensors else sensors
    wrong = 0
    for k, pose in enumerate(poses):
        off = error(pose, pair)
        if k == 0 and right(off, flat):
            yield "right", pose
        elif not right(off, flat, RIVAL_POSE) and wrong < MOST_WRONG:
            wrong += 1
            yield "wrong", pose


def stranger_pairs(split: str) -> Iterator[GridPair]:
    """Map a of one cached pair and b of another one, of another building; ``about`` names both as ``buildings``."""
    for first, second in strangers(split):
        one, other = load_grids(first), load_grids(second)
        pair = together(one, other)
        if pair.about["kind"] == "strangers":
            pair.about["buildings"] = buildings_of(one, split)[0], buildings_of(other, split)[1]
            yield pair


def marked(folder: Path) -> Callable[[str], tuple[Array, Array]]:
    """Key points (n, 3), m, of both maps of a pair of the office floor, by the pair's name; the same rows are one place."""
    listed = json.loads((folder / "ground_truth_pairs.json").read_bytes())
    points = {name: np.array(p, float).reshape(-1, 2) * OFFICE_PIXEL for name, p in listed["keypoints_px"].items()}
    same = {f"{p['a']}-{p['b']}": (p["a"], p["b"], np.array(p["idx"], int).reshape(-1, 2)) for p in listed["pairs"]}

    def of(name: str) -> tuple[Array, Array]:
        first, second, rows = same[name.rpartition("/")[2]]
        a, b = (np.pad(points[m][rows[:, k]], ((0, 0), (0, 1))) for k, m in enumerate((first, second)))
        return a, b

    return of
