"""What a descriptor of rooms saves a merge: `python -m benchmarks.merging.hypotheses cache/evaluation/heldout.jsonl --limit 24`.

Rooms that look alike propose poses, which cost time to verify. For each descriptor: seconds to describe both maps, the poses
that are proposed, how many would be verified, most promising first, until one is right (1 m, 10 degrees: the refinement does
the rest), for how many pairs one is among the first 10 and 60, and what comes out of matching and merging. Pairs are of
`datasets.build` with data.maps=true, of known scale, with rooms in common. Seconds are of the processor.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
from topomerge.datasets.pairs.evaluation_pair import EvaluationPair, load_set

from topomerge.embedding.embedders import embedder
from topomerge.evaluation.score import FLAT_SENSORS, NEAR_POSE, pose_error, within
from topomerge.fusion.pipeline import merge
from topomerge.matching.consistency import CONSISTENCY, best_of, candidate_poses, votes
from topomerge.matching.costs import best_partners, descriptor_costs, similarities
from topomerge.matching.match import match
from topomerge.matching.room_plans import RoomPlans, room_plans
from topomerge.types import Array, Sim3, TopometricMap

REFINABLE = (1.0, 10.0)  # m, degrees from which the refinement reaches the true pose
PARTNERS = (1, 2, 3, CONSISTENCY.partners)  # of a room
MOST = 1000  # poses that are looked through


def right(pose: Sim3, pair: EvaluationPair, limits: tuple[float, float]) -> bool:
    """Is a pose near the true one, in the middle of what both maps saw?"""
    assert pair.transform is not None
    flat = any(sensor in FLAT_SENSORS for sensor in pair.about["sensors"])
    return within(pose_error(pose, pair.transform, pair.anchor), flat, limits)


def proposed(
    a: TopometricMap, b: TopometricMap, plans: tuple[RoomPlans, RoomPlans], cost: Array, partners: int, pair: EvaluationPair
) -> tuple[int, float]:
    """Number of poses, and the place of the first right one in the order of how many rooms speak for each; inf without one."""
    pairs = best_partners(cost, partners)
    weight = similarities(cost)[tuple(pairs.T)] + 1e-3
    poses = candidate_poses(a, b, plans, pairs, weight, False)
    ranked = best_of(poses, votes(poses), plans[1].middle, MOST) if len(poses) else poses
    places = (k for k in range(len(ranked)) if right(ranked.transform(k), pair, REFINABLE))
    return len(poses), float(next(places, np.inf)) + 1


def measured(pair: EvaluationPair, name: str, merged: bool) -> dict[str, Any]:
    """A row of a pair and a descriptor."""
    (a, b), describe = pair.maps(), embedder(name)
    began = time.process_time()
    rows = describe(a), describe(b)
    out: dict[str, Any] = {"embed": time.process_time() - began}
    rows_of_map = {id(a): rows[0], id(b): rows[1]}
    plans, cost = (room_plans(a), room_plans(b)), descriptor_costs(*rows)
    out["proposed"] = {n: proposed(a, b, plans, cost, n, pair) for n in PARTNERS}
    hypotheses = match(a, b, lambda m: rows_of_map[id(m)]).alternatives
    out["matched"] = bool(hypotheses) and right(hypotheses[0].transform, pair, NEAR_POSE)
    if merged:
        began = time.process_time()
        result = merge([a, b], embedder=name)
        best = result.registration.transform if result.registration else None
        good = best is not None and right(best, pair, NEAR_POSE)
        out |= {"merge": time.process_time() - began, "best": good, "said": result.merged}
    return out


def main() -> None:
    """Print a line a pair, and a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("manifest", type=Path)
    parser.add_argument("--limit", type=int, default=24)
    parser.add_argument("--merges", type=int, default=8, help="pairs that are merged, too")
    parser.add_argument("--descriptors", nargs="+", default=["engineered", "learned"])
    args = parser.parse_args()
    pairs = [k for k in load_set(args.manifest) if k.transform and len(k.matches) and not k.about["scale_free"]]
    pairs = sorted(pairs, key=lambda k: k.about["seed"])[: args.limit]  # names are hashes, which another version draws anew
    embedder("engineered")(pairs[0].maps()[0])  # compiles
    rows: dict[str, list[dict[str, Any]]] = {name: [] for name in args.descriptors}
    for number, pair in enumerate(pairs):
        for name in args.descriptors:
            rows[name].append(measured(pair, name, number < args.merges))
            print(pair.name[:8], name, rows[name][-1], flush=True)
    heads = "pairs | s to describe | partners a room | poses | until right: median / 90 % | right in 10 | in 60 | matching right"
    print(f"| descriptor | {heads} |\n|{'---|' * 9}")
    for name, some in rows.items():
        took, good = np.median([r["embed"] for r in some]), np.mean([r["matched"] for r in some])
        for n in PARTNERS:
            poses, place = np.array([r["proposed"][n] for r in some]).T
            most = " / ".join(f"{np.sort(place)[int(q * (len(place) - 1))]:.0f}" for q in (0.5, 0.9))
            cells = [f"{np.median(poses):.0f}", most, *(f"{np.mean(place <= k):.2f}" for k in (10, 60))]
            matched = f"{good:.2f}" if n == CONSISTENCY.partners else "–"
            print(f"| {name} | {len(some)} | {took:.3f} | {n} | {' | '.join(cells)} | {matched} |")
    for name, some in rows.items():
        done = [r for r in some if "merge" in r]
        words = [f"{sum(r[k] for r in done)} {text}" for k, text in (("best", "best pose right"), ("said", "believed"))]
        print(f"{name}: {len(done)} merges, {', '.join(words)}, {sum(r['merge'] for r in done):.1f} s in all")


if __name__ == "__main__":
    main()
