"""One row of counts for each pair, variant and method: what is right, what is wrong, what was missed.

Counts are kept, not ratios, so that any group of pairs can be summed (`groups`). A match is right when both rooms are the same
true room; of a room that came out in pieces every piece may be matched (method 5). What should be found are the true
rooms that both maps have: one right match finds one.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.datasets.core.physical import physical_building
from topomerge.datasets.pairs.evaluation_pair import EvaluationPair, load_evaluation_pair, sim3_of
from topomerge.datasets.real.captures import captures
from topomerge.datasets.real.sources import REAL_SOURCES
from topomerge.evaluation.room_errors import ROOM_NEAR, displacements, floors_of_rooms
from topomerge.evaluation.settings import Evaluation, variants
from topomerge.io import archive
from topomerge.metrics import on_storey, pose_right
from topomerge.types import Array, Sim3

Row = dict[str, Any]
NEAR_POSE, FINE_POSE = (0.5, 5.0), (0.1, 1.0)  # m, degrees
SHARED = 80.0  # m2 in common, from which on maps should be merged
AREAS = (("<40", 40.0), ("40-80", 80.0), ("80-200", 200.0), (">200", np.inf))  # m2
OVERLAPS = ((0.0, "0"), (0.175, "0.1"), (0.375, "0.25"), (0.625, "0.5"), (1.0, "0.75"))  # share: up to, name
WHOLE, GLIMPSED = "_whole", "_glimpsed"  # rooms that both maps entered, and those that one of them only looked into
GROUPS = ("", "_twin", "_single")  # rooms that have a near-identical one in the other map, and those that have none


def score_all(pairs: Sequence[Path], predictions: Sequence[Path], settings: Evaluation) -> tuple[list[Row], list[Row], list[Row]]:
    """Rows of matches, of the ranking of rooms, and of merges."""
    matches: list[Row] = []
    ranks: list[Row] = []
    merges: list[Row] = []
    evaluated_variants = list(variants(settings))
    for path, file in zip(pairs, predictions, strict=True):
        pair, data = load_evaluation_pair(path), archive.read(file, "predictions")
        record = json.loads(data["told"].tobytes())
        about = {**group_of(pair, settings), "code": record["code"]}
        rooms_have_truth = pair.about["rooms"] != "laid" or bool(len(pair.matches))
        for v in evaluated_variants if rooms_have_truth else ():
            head = {**about, "variant": v.name, "descriptor": v.descriptor, "k": v.k, "context": v.context if v.k else "-"}
            cost, agreed = data[f"{v.name}/cost"], data.get(f"{v.name}/consistent/rooms")
            ranks.append(
                {**head, "seconds": record["seconds"][v.name], **rank_counts(pair, cost), **after_counts(pair, cost, agreed)}
            )
            for method in v.methods:
                rooms, chance = data[f"{v.name}/{method}/rooms"], data[f"{v.name}/{method}/probability"]
                seconds = float(data[f"{v.name}/{method}/seconds"])
                row = {**head, "method": method, "seconds": seconds, **match_counts(pair, rooms)}
                matches.append({**row, "chance": chance.tolist(), "good": right_matches(pair, rooms).tolist()})
        if record["merge"]:
            floors = floors_of_rooms(pair.maps()[1], shared_rooms(pair).values())
            merges += [{**about, "variant": n, **merge_counts(pair, verdict, floors)} for n, verdict in record["merge"].items()]
    return matches, ranks, merges


def group_of(pair: EvaluationPair, settings: Evaluation) -> Row:
    """What a pair is counted under.

    `building` is the physical one; the maps are `independent` where they come from two captures.
    """
    about = pair.about
    source, common, kind = about["source"], float(about["common"]), about["kind"]
    real = source in REAL_SOURCES
    own = "captures" in about
    title = about["title"] if real or own else pair.name
    origins = captures(source, title) if real else about["captures"] if own else (f"{pair.name}a", f"{pair.name}b")
    size = next(name for name, limit in AREAS if common < limit) if kind == "overlap" and common >= 1 else "none"
    change = about.get("change") or ("", 0.0)
    change = ("", 0.0) if change[0] == "plan" else change  # another sensor, no curve
    return {
        "pair": pair.name,
        "title": title,
        "building": physical_building(source, about["building"]),
        "capture_a": origins[0],
        "capture_b": origins[1],
        "independent": origins[0] != origins[1],
        "source": source,
        "origin": "real maps" if real or own else "procedural" if source == "procedural" else "real plans",
        "seen": "trained" if source in settings.data.trained else "unseen",
        "sensors": "-".join(sorted(about["sensors"])),
        "modality": modality(about["sensors"]),
        "kind": kind,
        "overlap": overlap_bin(float(about["overlap"]), kind),
        "common": common,
        "area": size,
        "large": common >= SHARED and kind == "overlap",
        "truth": about["rooms"],
        "change": change[0],
        "value": float(change[1]),
    }


def modality(sensors: Sequence[str]) -> str:
    """The kind of a pair by what its maps show: two scans in 3D, one with a slice, or one with a floor plan."""
    if "drawing" in sensors:
        return "with a floor plan"
    return "with a slice" if any(s in SLICED_SENSORS for s in sensors) else "3D scans"


def overlap_bin(share: float, kind: str = "overlap") -> str:
    """Name of the bin that a share of rooms in common falls in; of hard negatives their kind."""
    return kind if kind != "overlap" else next(name for limit, name in OVERLAPS if share <= limit)


def right_matches(pair: EvaluationPair, rooms: Array) -> Array:
    """(M,) bool: are both rooms of each match one true room?"""
    true = {tuple(m) for m in pair.matches.tolist()}
    return np.array([tuple(m) in true for m in rooms.tolist()], bool)


def match_counts(pair: EvaluationPair, rooms: Array) -> Row:
    """Counts of matches (M, 2).

    `predicted`, `right`: matches; `units`, `found`: true rooms that both maps have, and those that a right match found; each also
    of rooms with (`_twin`) and without (`_single`) a near-identical one in the other map. `strict_right`: right ones between the
    rooms that are assigned to the true room one to one; `strict_units`: true rooms for which both maps have one.
    """
    good = right_matches(pair, rooms)
    i, j = rooms.T if len(rooms) else (np.zeros(0, int), np.zeros(0, int))
    twin = pair.twin[0][i] | pair.twin[1][j]
    units = shared_rooms(pair)
    hit = {_unit(pair, *m) for m in rooms[good].tolist()}
    of_twins = {u for u, pieces in units.items() if any(pair.twin[0][a] or pair.twin[1][b] for a, b in pieces)}
    strict = {u for u, pieces in units.items() if any(pair.one[0][a] and pair.one[1][b] for a, b in pieces)}
    both = pair.one[0][i] & pair.one[1][j] & good
    out: Row = {"strict_right": int(both.sum()), "strict_units": len(strict), "pairs": 1}
    true_rooms = (set(units), of_twins, set(units) - of_twins)
    for name, chosen, true in zip(GROUPS, (twin | True, twin, ~twin), true_rooms, strict=True):
        out |= {f"predicted{name}": int(chosen.sum()), f"right{name}": int((good & chosen).sum())}
        out |= {f"units{name}": len(true), f"found{name}": len(true & hit)}
    return out


def _unit(pair: EvaluationPair, i: int, j: int) -> tuple[int, int]:
    return int(pair.true[0][i]), int(pair.true[1][j])


def shared_rooms(pair: EvaluationPair) -> dict[tuple[int, int], list[tuple[int, int]]]:
    """True rooms that both maps have -> matches of their pieces."""
    out: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for i, j in pair.matches.tolist():
        out.setdefault(_unit(pair, i, j), []).append((i, j))
    return out


def ranks_of(cost: Array, matches: Array) -> tuple[Array, Array]:
    """(Q,) rows that have a partner, and (Q,) rank of its best partner, from 1: columns that are no partner and cost as much
    count before it.

    Args:
        cost: (R_a, R_b).
        matches: (M, 2) true ones.
    """
    rooms = np.unique(matches[:, 0])
    rank = np.zeros(len(rooms), int)
    for q, i in enumerate(rooms.tolist()):
        partner = np.zeros(cost.shape[1], bool)
        partner[matches[matches[:, 0] == i, 1]] = True
        rank[q] = 1 + int((cost[i, ~partner] <= cost[i, partner].min()).sum())
    return rooms, rank


def rank_counts(pair: EvaluationPair, cost: Array) -> Row:
    """`queries`: rooms of either map with a true partner in the other; `first`, `five`: whose partner ranks first, within five;
    `reciprocal`: sum of 1 / rank; each also with and without a twin, and where neither room was looked into only (`_whole`), or
    one was (`_glimpsed`). `chance`: first ones to be expected of a draw."""
    rank, twin, entered, chance = [], [], [], 0.0
    for side, c, m in ((0, cost, pair.matches), (1, cost.T, pair.matches[:, ::-1])):
        rooms, room_ranks = ranks_of(c, m)
        rank.append(room_ranks)
        twin.append(pair.twin[side][rooms])
        entered_rooms = m[~pair.glimpsed[side][m[:, 0]] & ~pair.glimpsed[1 - side][m[:, 1]], 0]
        entered.append(np.isin(rooms, entered_rooms))
        chance += len(m) / max(c.shape[1], 1)
    r, t, w = np.concatenate(rank), np.concatenate(twin).astype(bool), np.concatenate(entered)
    out: Row = {"pairs": 1, "chance": chance}
    for name, queries in zip((*GROUPS, WHOLE, GLIMPSED), (t | True, t, ~t, w, ~w), strict=True):
        out[f"queries{name}"] = int(queries.sum())
        out[f"first{name}"] = int((r[queries] == 1).sum())
        out[f"five{name}"] = int((r[queries] <= 5).sum())
        out[f"reciprocal{name}"] = float((1 / r[queries]).sum())
    return out


def after_counts(pair: EvaluationPair, cost: Array, agreed: Array | None) -> Row:
    """`first`, `first_single` and `five` as of `rank_counts`, each with `_after`: of a ranking in which the matches (M, 2) that
    one transform explains come first, and the descriptor ranks what they leave; nan where that was not run."""
    names = ("first", "first_single", "five")
    if agreed is None:
        return {f"{name}_after": np.nan for name in names}
    again = cost.astype(np.float64)
    again[agreed[:, 0], agreed[:, 1]] = -1.0  # costs are 0 or more
    counts = rank_counts(pair, again)
    return {f"{name}_after": counts[name] for name in names}


def pose_error(pose: Sim3, truth: Sim3, anchor: Array) -> tuple[float, float, float]:
    """Error at a point of b: horizontal and vertical, m, and of the yaw, degrees."""
    off = (pose.apply(anchor[None]) - truth.apply(anchor[None]))[0]
    turned = abs((pose.yaw - truth.yaw + np.pi) % (2 * np.pi) - np.pi)
    return float(np.hypot(*off[:2])), float(abs(off[2])), float(np.degrees(turned))


def within(error: tuple[float, float, float], flat: bool, limits: tuple[float, float]) -> bool:
    """Is a pose right? A slice says nothing of its height, but must lie on its storey (`metrics.pose_right`)."""
    return pose_right(error, flat, limits)


def merge_counts(pair: EvaluationPair, verdict: Mapping[str, Any], floors: Sequence[Array] = ()) -> Row:
    """Of a pair: `near`, `fine`: the best pose is right within 0.5 m and 5 degrees, 0.1 m and 1 degree; `merged`: believed and
    near; `false`: believed and not; `refused`: right but not believed; `mergeable`: the maps have something in common;
    `every_room`: it puts, not bent, every shared room within 0.1 m of its true place; `rooms_near`: so many of the
    `rooms_shared`;
    `place`: where it puts the middle of what both saw, m, and its yaw, degrees.

    Args:
        floors: (n, 3) points of b on the floor of each shared room.
    """
    pose = None if verdict["pose"] is None else sim3_of(np.array(verdict["pose"]))
    place = [] if pose is None else [*pose.apply(pair.anchor[None])[0].tolist(), float(np.degrees(pose.yaw))]
    mergeable = pair.transform is not None and pair.about["kind"] == "overlap" and pair.about["common"] >= 1
    near = fine = False
    error = (np.nan,) * 3
    off = np.full(len(floors) if mergeable else 0, np.inf)
    if mergeable and pose is not None:
        assert pair.transform is not None
        error = pose_error(pose, pair.transform, pair.anchor)
        flat = any(s in FLAT_SENSORS for s in pair.about["sensors"])
        near, fine = within(error, flat, NEAR_POSE), within(error, flat, FINE_POSE)
        off = displacements(pose, pair.transform, floors, flat and on_storey(error[1]))
    believed = bool(verdict["believed"])
    rooms = np.array(verdict["rooms"], np.int64).reshape(-1, 2)
    return {
        "mergeable": int(mergeable),
        "near": int(near),
        "fine": int(fine),
        "believed": int(believed),
        "merged": int(believed and near),
        "merged_fine": int(believed and fine),
        "false": int(believed and not near),
        "refused": int(near and not believed),
        "with_rooms": int(len(off) > 0),
        "every_room": int(len(off) > 0 and bool((off <= ROOM_NEAR).all())),
        "rooms_shared": len(off),
        "rooms_near": int((off <= ROOM_NEAR).sum()),
        "farthest_room": float(off.max(initial=0.0)) if len(off) else np.nan,
        "probability": verdict["probability"],
        "seconds": verdict["seconds"],
        **dict(zip(("off", "off_above", "turned"), error, strict=True)),
        **match_counts(pair, rooms),
        "place": place,
        "chance": list(verdict["chance"]),
        "good": right_matches(pair, rooms).tolist(),
    }


FLAT_SENSORS = ("laser2d", "drawing")  # sensors whose maps have no height
SLICED_SENSORS = ("laser2d", "phone")  # whose maps are of one height, or were drawn from above
