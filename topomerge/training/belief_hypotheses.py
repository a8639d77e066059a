"""Hypotheses of registration of pairs of grids, with what they are judged by and whether they are right.

The belief in merges is fitted to them (`training.merge_belief`), and benchmarks of merging count them.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.datasets.core.derived import derive, read_derived
from topomerge.datasets.pairs.grid_drawings import build_drawings
from topomerge.datasets.pairs.grid_pairs import GridPair, GridRecipe, build_grids, load_grids
from topomerge.fusion.bend.judged import judged_as_bent
from topomerge.fusion.judge import Judge
from topomerge.fusion.prepared import prepare
from topomerge.fusion.scale import search_scaled
from topomerge.fusion.search import search
from topomerge.fusion.verify import rank
from topomerge.matching.poses import wrapped
from topomerge.metrics import pose_right
from topomerge.training.task_settings import MergeBelief
from topomerge.types import Array, Sim3

DESCRIBED = (
    *("sensors", "kind", "building", "source", "overlap", "differs", "walls_differ", "scaled"),
    *("lookalike", "furniture", "tellable", "repeats"),  # of look-alikes
)
RIGHT_POSE = (0.5, 5.0)  # m, degrees
SAME_WALLS = 3.0  # m2 of walls by which two storeys differ at most that no drawing tells apart
ALIKE_WINGS = 0.3  # m by which walls of twin wings differ at most, where both maps look: drift does as much
Row = dict[str, Any]  # of a pair: name, common, `DESCRIBED`, and its hypotheses `hyps`


def belief_rows(recipe: GridRecipe, settings: MergeBelief, say: Any) -> list[Row]:
    """The pairs of a set, drawings and strangers among them, with their judged hypotheses, cached."""
    grids, _ = build_grids(recipe, settings, say)
    drawings, _ = build_drawings(recipe, settings, say) if any(recipe.drawings) else ([], None)
    rng = np.random.default_rng(len(grids))
    strangers: list[list[int]] = rng.integers(len(grids), size=(recipe.strangers, 2)).tolist() if grids else []
    sources = [[path] for path in (*drawings, *grids)] + [[grids[i], grids[j]] for i, j in strangers]
    options = {"hypotheses": settings.hypotheses, "inspected": settings.inspected}
    files, _ = derive(f"{recipe.name}_hypotheses", judged_pair, sources, settings, options, say)
    return [json.loads(read_derived(file)["row"].tobytes()) for file in files]


def judged_pair(*paths: Path, hypotheses: int, inspected: int) -> dict[str, Array]:
    """The row of one pair, or of map a of one and b of another one, as JSON."""
    pairs = [load_grids(path) for path in paths]
    pair = pairs[0] if len(pairs) == 1 else together(*pairs)
    about = {key: pair.about[key] for key in DESCRIBED if key in pair.about}
    row = {"name": pair.name, "common": pair.common, **about, "hyps": judged(pair, hypotheses, inspected)}
    return {"row": np.frombuffer(json.dumps(row).encode(), np.uint8)}


def error(pose: Sim3, pair: GridPair) -> list[float] | None:
    """Horizontal and vertical error in the middle of what both saw, m, and of yaw, degrees; None where no pose is right."""
    if pair.truth is None or pair.about["kind"] != "overlap":
        return None
    middle = pair.anchor[None]
    off = (pose.apply(middle) - pair.truth.apply(middle))[0]
    return [float(np.hypot(*off[:2])), float(off[2]), float(np.degrees(abs(wrapped(pose.yaw - pair.truth.yaw))))]


def right(err: Sequence[float] | None, sensors: Sequence[str], limits: tuple[float, float] = RIGHT_POSE) -> bool:
    """Is a pose right? A slice or a drawing says nothing of its height, but must lie on its storey (`metrics.pose_right`)."""
    return err is not None and pose_right(err, "laser2d" in sensors or "drawing" in sensors, limits)


def together(first: GridPair, second: GridPair) -> GridPair:
    """Map a of one pair and b of another one, of another building."""
    same = first.about["building"] == second.about["building"]
    sensors = [first.about["sensors"][0], second.about["sensors"][1]]  # type: ignore[index]
    buildings = f"{first.about['building']} + {second.about['building']}"
    about = {**first.about, "sensors": sensors, "building": buildings, "kind": "same" if same else "strangers", "overlap": 0.0}
    return GridPair(f"{first.name}+{second.name}", first.a, second.b, (first.free[0], second.free[1]), None, 0.0, about)


def judged(pair: GridPair, hypotheses: int, inspected: int) -> list[dict[str, Any]]:
    """Hypotheses with what they are judged by and their errors; the first ones with what the maps show once they are bent
    (``bent``), which only the best one is asked."""
    first, second = (prepare(g, f) for g, f in zip((pair.a, pair.b), pair.free, strict=True))
    scaled = bool(pair.about.get("scaled"))
    turn = second.order < first.order
    if turn:
        first, second = second, first
    rows = []
    poses = (search_scaled if scaled else search)(first.storeys, second.storeys)
    for k, h in enumerate(rank(poses, Judge(first.storeys, second.storeys))[:hypotheses]):
        pose = h.transform.inverse() if turn else h.transform
        closely: dict[str, Any] = {}
        if k < inspected:
            bent = judged_as_bent(first, second, h.transform, scaled)[1]
            closely = {"bent": {**h.features, **bent, "rigid_conflict_share": h.features["conflict_share"]}}
            closely["pose"] = h.transform.matrix.tolist()
        rows.append({**h.features, **closely, "err": error(pose, pair)})
    return rows


def fair(row: dict[str, Any]) -> bool:
    """Pairs that anybody could tell: no twin wings that are the same where both maps look, and no drawings of a storey
    with the same walls. A drawing of a map's own building of which the map shows nothing has a wrong truth: the generator gave
    a twin's frame."""
    differs = row.get("differs")
    if row["kind"] == "overlap" and row["common"] < 1 and "drawing" in row["sensors"]:
        return False
    if row["kind"] == "same" or row.get("walls_differ", SAME_WALLS) < SAME_WALLS:
        return False
    return row["kind"] != "twin-wing" or differs is None or differs >= ALIKE_WINGS


def kind_of(row: dict[str, Any]) -> str:
    """Bin by the area in common; look-alikes by their kind, and by whether anybody could tell them apart."""
    if "lookalike" in row:
        return f"{row['lookalike']}{'' if row['tellable'] else ' (nobody can tell)'}"
    if row["kind"] != "overlap" or row["common"] < 1 or row.get("overlap") == 0:
        return f"none ({row['kind']})"
    return next(name for limit, name in ((40, "<40"), (80, "40-80"), (200, "80-200"), (np.inf, ">200")) if row["common"] < limit)
