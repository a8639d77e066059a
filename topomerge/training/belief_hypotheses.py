"""Hypotheses of registration of pairs of grids, with what they are judged by and whether they are right.

The belief in merges is fitted to them (`training.merge_belief`), and benchmarks of merging count them.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.datasets.core.derived import derive, read_derived
from topomerge.datasets.pairs.grid_drawings import build_drawings
from topomerge.datasets.pairs.grid_pairs import GridPair, GridRecipe, build_grids, load_grids
from topomerge.matching.poses import wrapped
from topomerge.metrics import pose_right
from topomerge.networks.network import Network, Run
from topomerge.registration.evidence.crops import CROP_ARRAYS, Crops
from topomerge.registration.evidence.network import place_log_odds, read_weights
from topomerge.registration.evidence.network import weights as place_weights
from topomerge.registration.evidence.places import Places
from topomerge.registration.judge import Judge
from topomerge.registration.pipeline import candidate, repeats, rivals
from topomerge.registration.prepared import prepare
from topomerge.registration.search import search, search_scaled
from topomerge.registration.verify import rank
from topomerge.training.splits import name_building
from topomerge.training.task_settings import MergeBelief, PlaceEvidence
from topomerge.training.tasks import weights_of
from topomerge.types import Array, Sim3

DESCRIBED = (
    *("sensors", "kind", "building", "source", "overlap", "differs", "walls_differ", "scaled"),
    *("lookalike", "furniture", "tellable", "repeats"),  # of look-alikes
    "captures",  # of the development floor
)
RIGHT_POSE = (0.5, 5.0)  # m, degrees
BENT = (1.5, 5.0)  # m, degrees: a map that is bent by drift fits in no one pose; neither right nor wrong
SAME_WALLS = 3.0  # m2 of walls by which two storeys differ at most that no drawing tells apart
ALIKE_WINGS = 0.3  # m by which walls of twin wings differ at most, where both maps look: drift does as much
Row = dict[str, Any]  # of a pair: name, common, `DESCRIBED`, and its hypotheses `hyps`


def hypothesis_files(recipe: GridRecipe, settings: MergeBelief | PlaceEvidence, say: Any) -> list[Path]:
    """Files of the judged hypotheses of a set's pairs, drawings and strangers among them (`judged_pair`), cached."""
    grids, _ = build_grids(recipe, settings, say)
    drawings, _ = build_drawings(recipe, settings, say) if any(recipe.drawings) else ([], None)
    rng = np.random.default_rng(len(grids))
    strangers: list[list[int]] = rng.integers(len(grids), size=(recipe.strangers, 2)).tolist() if grids else []
    sources = [[path] for path in (*drawings, *grids)] + [[grids[i], grids[j]] for i, j in strangers]
    return judged_files(recipe.name, sources, settings, say)


def judged_files(name: str, sources: Sequence[Sequence[Path]], settings: MergeBelief | PlaceEvidence, say: Any) -> list[Path]:
    """Files of the judged hypotheses of pairs, or of map a of one and b of another one, cached."""
    options = {"hypotheses": settings.hypotheses, "inspected": settings.inspected}
    return derive(f"{name}_hypotheses", judged_pair, sources, settings, options, say)[0]


def judged_pair(*paths: Path, hypotheses: int, inspected: int) -> dict[str, Array]:
    """The row of one pair, or of map a of one and b of another one, as JSON, and the squares of its places (`Crops`) with the
    hypothesis that each is of (``owner``)."""
    pairs = [load_grids(path) for path in paths]
    return judged_arrays(pairs[0] if len(pairs) == 1 else together(*pairs), hypotheses, inspected)


def judged_arrays(pair: GridPair, hypotheses: int, inspected: int) -> dict[str, Array]:
    """As `judged_pair`."""
    about = {key: pair.about[key] for key in DESCRIBED if key in pair.about}
    hyps, seen, middle = judged(pair, hypotheses, inspected)
    row = {"name": pair.name, "common": pair.common, **about, "hyps": hyps, "middle": middle.tolist()}
    owner = [np.full(len(c), k, np.int16) for k, c in seen.items()]
    crops = {f: np.concatenate([getattr(c, f) for c in seen.values()]) for f in CROP_ARRAYS} if seen else {}
    return {
        "row": np.frombuffer(json.dumps(row).encode(), np.uint8),
        "owner": np.concatenate([*owner, np.zeros(0, np.int16)]),
        **crops,
    }


def half_of(row: Mapping[str, Any]) -> int:
    """0 or 1: the half of the physical buildings that that of a pair is in; networks of places are trained on one each."""
    return hashlib.sha256(name_building(row).encode()).digest()[0] % 2


def belief_rows(recipe: GridRecipe, settings: MergeBelief, say: Any) -> list[Row]:
    """The pairs of a set with their judged hypotheses, and what their places say."""
    networks = place_networks(settings)
    return [row_of(path, networks) for path in hypothesis_files(recipe, settings, say)]


def place_networks(settings: MergeBelief) -> list[Network]:
    """The networks of the runs that saw one half of the buildings each (`task=place_evidence half=1`, `half=2`); the one that
    ships where none are named.

    Raises:
        InputError: a run without a network.
    """
    if not settings.halves:
        return [place_weights()] * 2
    return [read_weights(weights_of("place_evidence", run)) for run in settings.halves]


def row_of(path: Path, networks: Sequence[Run]) -> Row:
    """The row of a file, with what its places say (``place_mean`` and the like) by the network of the other half of the
    buildings: what it was trained on it knows too well."""
    data = read_derived(path)
    row: Row = json.loads(data["row"].tobytes())
    network = networks[1 - half_of(row)]
    for k, h in enumerate(row["hyps"]):
        if "bent" in h:
            pick = np.flatnonzero(data["owner"] == k)
            crops = Crops(**{f: data[f][pick] for f in CROP_ARRAYS}) if len(pick) else Crops.none()
            h["bent"] |= Places(crops, place_log_odds(crops, network)).features
    return row


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


def judged(pair: GridPair, hypotheses: int, inspected: int) -> tuple[list[Row], dict[int, Crops], Array]:
    """Hypotheses with what they are judged by, their errors and their labels; those that registration looks at closely, and
    besides the first right one and the first wrong ones, with what the maps show once they are bent (``bent``), their squares;
    and the middle (3,) of the second map, m, where poses are compared."""
    first, second = (prepare(g, f) for g, f in zip((pair.a, pair.b), pair.free, strict=True))
    scaled = bool(pair.about.get("scaled"))
    turn = second.order < first.order
    if turn:
        first, second = second, first
    poses = (search_scaled if scaled else search)(first.storeys, second.storeys)
    ranked = rank(poses, Judge(first.storeys, second.storeys))[:hypotheses] if poses else []
    errors = [error(h.transform.inverse() if turn else h.transform, pair) for h in ranked]
    labels = [label_of(err, pair.about["sensors"]) for err in errors]
    registered = set(rivals(ranked)) if ranked else set()
    right_one, wrong_ones = (np.flatnonzero(np.array(labels) == label) for label in (1, 0))
    closely = registered | set(right_one[:1].tolist()) | set(wrong_ones[:inspected].tolist())
    rows: list[Row] = []
    seen: dict[int, Crops] = {}
    for k, h in enumerate(ranked):
        rows.append({**h.features, "err": errors[k], "label": labels[k], "score": h.score})
        if k in closely:
            bent = candidate(first, second, h, scaled)
            pose = bent.bend.transform
            errors[k] = error(pose.inverse() if turn else pose, pair)  # as registration gives it
            rows[k] |= {"err": errors[k], "label": label_of(errors[k], pair.about["sensors"])}
            rows[k] |= {
                "bent": bent.closely() | {"repeats": repeats(ranked)},
                "bent_pose": pose.matrix.tolist(),
                "rival": k in registered,
            }
            seen[k] = bent.places.crops
    return rows, seen, np.append(second.storeys[0].middle, 0.0)


def label_of(err: Sequence[float] | None, sensors: Any) -> int:
    """1 right, 0 wrong, -1 neither: a map that is bent by drift fits in no one pose."""
    return 1 if right(err, sensors) else -1 if right(err, sensors, BENT) else 0


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
