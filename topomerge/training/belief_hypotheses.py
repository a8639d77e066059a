"""Hypotheses of registration that the odds of merges are fitted to."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.datasets.core.builder import derive, read_derived
from topomerge.datasets.pairs.grid_drawings import build_drawings
from topomerge.datasets.pairs.grid_pairs import GridPair, GridRecipe, build_grids, load_grids
from topomerge.datasets.pairs.lookalikes import LookalikeRecipe, build_lookalikes
from topomerge.datasets.real.maps import build_floor
from topomerge.matching.poses import wrap_yaw
from topomerge.metrics import is_pose_right
from topomerge.networks.network import Network, Run
from topomerge.registration.judge import Judge
from topomerge.registration.pipeline import build_candidate, count_repeats, select_rivals
from topomerge.registration.places import CROP_ARRAYS, Crops, Places, compute_place_log_odds, read_weights
from topomerge.registration.places import load_weights as place_weights
from topomerge.registration.prepared import prepare
from topomerge.registration.search import search, search_scaled
from topomerge.registration.verify import rank
from topomerge.training.packed_pairs import name_building
from topomerge.training.task_settings import MergeBelief, PlaceEvidence
from topomerge.training.tasks import find_weights
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


def build_hypothesis_files(recipe: GridRecipe, settings: MergeBelief | PlaceEvidence, log_line: Any) -> list[Path]:
    """Build files of the judged hypotheses of a set's pairs, drawings and strangers among them (`evaluate_pair`), cached."""
    grids, _ = build_grids(recipe, settings, log_line)
    drawings, _ = build_drawings(recipe, settings, log_line) if any(recipe.drawings) else ([], None)
    rng = np.random.default_rng(len(grids))
    strangers: list[list[int]] = rng.integers(len(grids), size=(recipe.strangers, 2)).tolist() if grids else []
    sources = [[path] for path in (*drawings, *grids)] + [[grids[i], grids[j]] for i, j in strangers]
    return derive_hypothesis_files(recipe.name, sources, settings, log_line)


def derive_hypothesis_files(
    name: str, sources: Sequence[Sequence[Path]], settings: MergeBelief | PlaceEvidence, log_line: Any
) -> list[Path]:
    """Return files of the judged hypotheses of pairs, or of map a of one and b of another one, cached."""
    options = {"hypotheses": settings.hypotheses, "inspected": settings.inspected}
    return derive(f"{name}_hypotheses", evaluate_pair, sources, settings, options, log_line)[0]


def evaluate_pair(*paths: Path, hypotheses: int, inspected: int) -> dict[str, Array]:
    """Return the row of one pair, or of map a of one and b of another one, as JSON, and the squares of its places (`Crops`) with
    the hypothesis that each is of (``owner``)."""
    pairs = [load_grids(path) for path in paths]
    return evaluate_arrays(pairs[0] if len(pairs) == 1 else pair_different_buildings(*pairs), hypotheses, inspected)


def evaluate_arrays(pair: GridPair, hypotheses: int, inspected: int) -> dict[str, Array]:
    """Evaluate the hypotheses of a pair (see `evaluate_pair`)."""
    about = {key: pair.about[key] for key in DESCRIBED if key in pair.about}
    hyps, seen, middle = evaluate_hypotheses(pair, hypotheses, inspected)
    row = {"name": pair.name, "common": pair.common, **about, "hyps": hyps, "middle": middle.tolist()}
    owner = [np.full(len(c), k, np.int16) for k, c in seen.items()]
    crops = {f: np.concatenate([getattr(c, f) for c in seen.values()]) for f in CROP_ARRAYS} if seen else {}
    return {
        "row": np.frombuffer(json.dumps(row).encode(), np.uint8),
        "owner": np.concatenate([*owner, np.zeros(0, np.int16)]),
        **crops,
    }


def assign_half(row: Mapping[str, Any]) -> int:
    """Return 0 or 1: the half of the physical buildings that that of a pair is in; networks of places are trained on one each."""
    return hashlib.sha256(name_building(row).encode()).digest()[0] % 2


def build_belief_rows(recipe: GridRecipe, settings: MergeBelief, log_line: Any) -> list[Row]:
    """Build the pairs of a set with their judged hypotheses, and what their places say."""
    networks = load_place_networks(settings)
    return [read_row(path, networks) for path in build_hypothesis_files(recipe, settings, log_line)]


def load_place_networks(settings: MergeBelief) -> list[Network]:
    """Return the networks of the runs that saw one half of the buildings each (`task=place_evidence half=1`, `half=2`); the one
    that ships where none are named.

    Raises:
        InputError: a run without a network.
    """
    if not settings.halves:
        return [place_weights()] * 2
    return [read_weights(find_weights("place_evidence", run)) for run in settings.halves]


def read_row(path: Path, networks: Sequence[Run]) -> Row:
    """Read the row of a file, with what its places say (``place_mean`` and the like) by the network of the other half of the
    buildings: what it was trained on it knows too well."""
    data = read_derived(path)
    row: Row = json.loads(data["row"].tobytes())
    network = networks[1 - assign_half(row)]
    for k, h in enumerate(row["hyps"]):
        if "bent" in h:
            pick = np.flatnonzero(data["owner"] == k)
            crops = Crops(**{f: data[f][pick] for f in CROP_ARRAYS}) if len(pick) else Crops.none()
            h["bent"] |= Places(crops, compute_place_log_odds(crops, network)).features
    return row


def compute_pose_error(pose: Sim3, pair: GridPair) -> list[float] | None:
    """Return the horizontal and vertical error in the middle of what both saw, m, and of yaw, degrees; None where no pose is
    right."""
    if pair.truth is None or pair.about["kind"] != "overlap":
        return None
    middle = pair.anchor[None]
    off = (pose.apply(middle) - pair.truth.apply(middle))[0]
    return [float(np.hypot(*off[:2])), float(off[2]), float(np.degrees(abs(wrap_yaw(pose.yaw - pair.truth.yaw))))]


def is_hypothesis_right(err: Sequence[float] | None, sensors: Sequence[str], limits: tuple[float, float] = RIGHT_POSE) -> bool:
    """Return whether a pose is right. A slice or a drawing must lie on its storey only (`metrics.is_pose_right`)."""
    return err is not None and is_pose_right(err, "laser2d" in sensors or "drawing" in sensors, limits)


def pair_different_buildings(first: GridPair, second: GridPair) -> GridPair:
    """Map a of one pair and b of another one, of another building."""
    same = first.about["building"] == second.about["building"]
    sensors = [first.about["sensors"][0], second.about["sensors"][1]]  # type: ignore[index]
    buildings = f"{first.about['building']} + {second.about['building']}"
    about = {**first.about, "sensors": sensors, "building": buildings, "kind": "same" if same else "strangers", "overlap": 0.0}
    return GridPair(f"{first.name}+{second.name}", first.a, second.b, (first.free[0], second.free[1]), None, 0.0, about)


def evaluate_hypotheses(pair: GridPair, hypotheses: int, inspected: int) -> tuple[list[Row], dict[int, Crops], Array]:
    """Return the hypotheses with what they are judged by, their errors and their labels; those that registration looks at
    closely, and besides the first right one and the first wrong ones, with what the maps show once they are bent (``bent``),
    their squares; and the middle (3,) of the second map, m, where poses are compared."""
    first, second = (prepare(g, f) for g, f in zip((pair.a, pair.b), pair.free, strict=True))
    scaled = bool(pair.about.get("scaled"))
    turn = second.order < first.order
    if turn:
        first, second = second, first
    poses = (search_scaled if scaled else search)(first.storeys, second.storeys)
    ranked = rank(poses, Judge(first.storeys, second.storeys))[:hypotheses] if poses else []
    errors = [compute_pose_error(h.transform.inverse() if turn else h.transform, pair) for h in ranked]
    labels = [label_error(err, pair.about["sensors"]) for err in errors]
    registered = set(select_rivals(ranked)) if ranked else set()
    right_one, wrong_ones = (np.flatnonzero(np.array(labels) == label) for label in (1, 0))
    closely = registered | set(right_one[:1].tolist()) | set(wrong_ones[:inspected].tolist())
    rows: list[Row] = []
    seen: dict[int, Crops] = {}
    for k, h in enumerate(ranked):
        rows.append({**h.features, "err": errors[k], "label": labels[k], "score": h.score})
        if k in closely:
            bent = build_candidate(first, second, h, scaled)
            pose = bent.bend.transform
            errors[k] = compute_pose_error(pose.inverse() if turn else pose, pair)  # as registration gives it
            rows[k] |= {"err": errors[k], "label": label_error(errors[k], pair.about["sensors"])}
            rows[k] |= {
                "bent": bent.compute_all_features() | {"repeats": count_repeats(ranked)},
                "bent_pose": pose.matrix.tolist(),
                "rival": k in registered,
            }
            seen[k] = bent.places.crops
    return rows, seen, np.append(second.storeys[0].middle, 0.0)


def label_error(err: Sequence[float] | None, sensors: Any) -> int:
    """Return the label of an error: 1 right, 0 wrong, -1 neither, as a map that is bent by drift fits in no one pose."""
    return 1 if is_hypothesis_right(err, sensors) else -1 if is_hypothesis_right(err, sensors, BENT) else 0


def is_distinguishable(row: dict[str, Any]) -> bool:
    """Return pairs that anybody could tell: no twin wings that are the same where both maps look, and no drawings of a storey
    with the same walls. A drawing of a map's own building of which the map shows nothing has a wrong truth: the generator gave
    a twin's frame."""
    differs = row.get("differs")
    if row["kind"] == "overlap" and row["common"] < 1 and "drawing" in row["sensors"]:
        return False
    if row["kind"] == "same" or row.get("walls_differ", SAME_WALLS) < SAME_WALLS:
        return False
    return row["kind"] != "twin-wing" or differs is None or differs >= ALIKE_WINGS


def classify_pair(row: dict[str, Any]) -> str:
    """Bin by the area in common; look-alikes by their kind, and by whether anybody could tell them apart."""
    if "lookalike" in row:
        return f"{row['lookalike']}{'' if row['tellable'] else ' (nobody can tell)'}"
    if row["kind"] != "overlap" or row["common"] < 1 or row.get("overlap") == 0:
        return f"none ({row['kind']})"
    return next(name for limit, name in ((40, "<40"), (80, "40-80"), (200, "80-200"), (np.inf, ">200")) if row["common"] < limit)


def build_floor_rows(settings: MergeBelief, log_line: Any) -> list[Row]:
    """Return the pairs of the floor with their judged hypotheses, cached; each weighs `settings.floor`, and none are taken where
    that is 0 or no real data is there."""
    if not settings.floor or not settings.data.folder:
        return []
    networks = load_place_networks(settings)
    paths = build_floor(settings.data.folder, settings.cache, log_line)
    rows = [
        read_row(path, networks)
        for path in derive_hypothesis_files("development_floor", [[p] for p in paths], settings, log_line)
    ]
    return [{**row, "weight": settings.floor, "real": True} for row in rows if row["hyps"]]


def build_lookalike_rows(recipe: LookalikeRecipe, settings: MergeBelief, log_line: Any) -> list[Row]:
    """Return the look-alikes of a set with their judged hypotheses, cached; none where the task takes none. ``judged_only``:
    trains nothing."""
    if settings.lookalikes == "none":
        return []
    paths, _ = build_lookalikes(recipe, settings, log_line)
    networks = load_place_networks(settings)
    rows = [
        read_row(file, networks) for file in derive_hypothesis_files(recipe.name, [[path] for path in paths], settings, log_line)
    ]
    judged = [settings.lookalikes == "judged" or not is_training_row(row) for row in rows]
    return [{**row, "judged_only": only, "weight": settings.alike_weight} for row, only in zip(rows, judged, strict=True)]


def is_training_row(row: Row) -> bool:
    """Return whether a look-alike may train the belief."""
    return bool(row["tellable"] or row["repeats"])


def score_lookalikes(rows: Sequence[Row], accepted: Array, true: Array, threshold: float) -> dict[str, float]:
    """Return the shares of look-alikes that are wrong and believed, of those that somebody can tell apart (``tellable``) and of
    the others (``untellable``), and their numbers. Ordinary pairs are passed over; pairs that fit in no one pose are not
    wrong."""
    out: dict[str, float] = {}
    wrong = (np.asarray(true) == 0) & (np.asarray(accepted) >= threshold)
    for name, tellable in (("tellable", True), ("untellable", False)):
        chosen = np.array([row.get("tellable") is tellable for row in rows], bool)
        if chosen.any():
            out |= {f"wrong_believed_{name}": float(wrong[chosen].mean()), f"pairs_{name}": float(chosen.sum())}
    return out
