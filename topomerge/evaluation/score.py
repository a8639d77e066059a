"""Score predictions against what is true."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from topomerge import archive
from topomerge.datasets.core.building import find_physical_building
from topomerge.datasets.pairs.evaluation_pair import EvaluationPair, convert_to_sim3, load_evaluation_pair
from topomerge.datasets.real.sources import REAL_SOURCES, find_captures
from topomerge.evaluation.settings import Evaluation, iter_variants
from topomerge.matching.room_plans import DIRECTION_BLUR, build_room_plans
from topomerge.metrics import is_on_storey, is_pose_right
from topomerge.types import Array, Sim3, TopometricMap

ROOM_NEAR = 0.1  # m within which every point of a room lies where it should


def collect_room_floors(map: TopometricMap, rooms: Iterable[Sequence[tuple[int, int]]]) -> list[Array]:
    """Return (n, 3) points of each shared room: its floor in map b, of all pieces; where none was seen, what stands in it.

    Args:
        map: b.
        rooms: matches (room of a, room of b) of the pieces of each shared room.
    """
    floor, cells = map.navigable.compute_centroids(), map.grid.compute_centroids()
    out = []
    for pieces in rooms:
        of_b = sorted({j for _, j in pieces})
        points = floor[np.isin(map.navigable_room, of_b)]
        out.append(points if len(points) else cells[np.isin(map.room, of_b)])
    return out


def measure_displacements(pose: Sim3, truth: Sim3, rooms: Sequence[Array], flat: bool = False) -> Array:
    """Return (R,) m, in the frame of a: how far an estimated pose of b puts the worst point of each room from its true place.

    The distance is convex over the room, so its largest is that of the outline.

    Args:
        pose, truth: T_ab.
        rooms: (n, 3) points of b of each room; one without points is infinitely far.
        flat: one of the maps says nothing of heights: distances are horizontal.
    """
    out = np.full(len(rooms), np.inf)
    for k, points in enumerate(rooms):
        if len(points):
            off = (pose.apply(points) - truth.apply(points))[:, : 2 if flat else 3]
            out[k] = float(np.linalg.norm(off, axis=1).max())
    return out


Row = dict[str, Any]
NEAR_POSE, FINE_POSE = (0.5, 5.0), (0.1, 1.0)  # m, degrees
SHARED = 80.0  # m2 in common, from which on maps should be merged
AREAS = (("<40", 40.0), ("40-80", 80.0), ("80-200", 200.0), (">200", np.inf))  # m2
OVERLAPS = ((0.0, "0"), (0.175, "0.1"), (0.375, "0.25"), (0.625, "0.5"), (1.0, "0.75"))  # share: up to, name
WHOLE, GLIMPSED = "_whole", "_glimpsed"  # rooms that both maps entered, and those that one of them only looked into
GROUPS = ("", "_twin", "_single")  # rooms that have a near-identical one in the other map, and those that have none


def score_all(pairs: Sequence[Path], predictions: Sequence[Path], settings: Evaluation) -> tuple[list[Row], list[Row], list[Row]]:
    """Return rows of matches, of the ranking of rooms, and of merges."""
    matches: list[Row] = []
    ranks: list[Row] = []
    merges: list[Row] = []
    evaluated_variants = list(iter_variants(settings))
    for path, file in zip(pairs, predictions, strict=True):
        pair, data = load_evaluation_pair(path), archive.read(file, "predictions")
        record = json.loads(data["told"].tobytes())
        about = {**classify_pair(pair, settings), "code": record["code"]}
        rooms_have_truth = pair.about["rooms"] != "laid" or bool(len(pair.matches))
        for v in evaluated_variants if rooms_have_truth else ():
            head = {**about, "variant": v.name, "descriptor": v.descriptor, "k": v.k, "context": v.context if v.k else "-"}
            cost, agreed = data[f"{v.name}/cost"], data.get(f"{v.name}/consistent/rooms")
            ranks.append(
                {**head, "seconds": record["seconds"][v.name], **count_ranks(pair, cost), **count_ranks_after(pair, cost, agreed)}
            )
            for method in v.methods:
                rooms, text = data[f"{v.name}/{method}/rooms"], data[f"{v.name}/{method}/probability"]
                seconds = float(data[f"{v.name}/{method}/seconds"])
                row = {**head, "method": method, "seconds": seconds, **count_matches(pair, rooms)}
                matches.append({**row, "chance": text.tolist(), "good": is_right_match(pair, rooms).tolist()})
        if record["merge"]:
            floors = collect_room_floors(pair.load_maps()[1], find_shared_rooms(pair).values())
            merges += [{**about, "variant": n, **count_merges(pair, verdict, floors)} for n, verdict in record["merge"].items()]
    return matches, ranks, merges


def classify_pair(pair: EvaluationPair, settings: Evaluation) -> Row:
    """Classify a pair into the groups that it is counted under.

    `building` is the physical one; the maps are `independent` where they come from two captures.
    """
    about = pair.about
    source, common, kind = about["source"], float(about["common"]), about["kind"]
    real = source in REAL_SOURCES
    own = "captures" in about
    title = about["title"] if real or own else pair.name
    origins = find_captures(source, title) if real else about["captures"] if own else (f"{pair.name}a", f"{pair.name}b")
    size = next(name for name, limit in AREAS if common < limit) if kind == "overlap" and common >= 1 else "none"
    return {
        "pair": pair.name,
        "title": title,
        "building": find_physical_building(source, about["building"]),
        "capture_a": origins[0],
        "capture_b": origins[1],
        "independent": origins[0] != origins[1],
        "source": source,
        "origin": "real maps" if real or own else "procedural" if source == "procedural" else "real plans",
        "seen": "trained" if source in settings.data.trained else "unseen",
        "sensors": "-".join(sorted(about["sensors"])),
        "modality": classify_modality(about["sensors"]),
        "kind": kind,
        "overlap": classify_overlap(float(about["overlap"]), kind),
        "common": common,
        "area": size,
        "large": common >= SHARED and kind == "overlap",
        "truth": about["rooms"],
    }


def classify_modality(sensors: Sequence[str]) -> str:
    """Return the kind of a pair by what its maps show: two scans in 3D, one with a slice, or one with a floor plan."""
    if "drawing" in sensors:
        return "with a floor plan"
    return "with a slice" if any(s in SLICED_SENSORS for s in sensors) else "3D scans"


def classify_overlap(share: float, kind: str = "overlap") -> str:
    """Return the name of the bin that a share of rooms in common falls in; of hard negatives their kind."""
    return kind if kind != "overlap" else next(name for limit, name in OVERLAPS if share <= limit)


def is_right_match(pair: EvaluationPair, rooms: Array) -> Array:
    """Return (M,) bool: are both rooms of each match one true room?"""
    true = {tuple(m) for m in pair.matches.tolist()}
    return np.array([tuple(m) in true for m in rooms.tolist()], bool)


def count_matches(pair: EvaluationPair, rooms: Array) -> Row:
    """Return counts of matches (M, 2).

    `predicted`, `right`: matches; `units`, `found`: true rooms that both maps have, and those that a right match found; each also
    of rooms with (`_twin`) and without (`_single`) a near-identical one in the other map. `strict_right`: right ones between the
    rooms that are assigned to the true room one to one; `strict_units`: true rooms for which both maps have one.
    """
    good = is_right_match(pair, rooms)
    i, j = rooms.T if len(rooms) else (np.zeros(0, int), np.zeros(0, int))
    twin = pair.twin[0][i] | pair.twin[1][j]
    units = find_shared_rooms(pair)
    hit = {_find_true_pair(pair, *m) for m in rooms[good].tolist()}
    of_twins = {u for u, pieces in units.items() if any(pair.twin[0][a] or pair.twin[1][b] for a, b in pieces)}
    strict = {u for u, pieces in units.items() if any(pair.one[0][a] and pair.one[1][b] for a, b in pieces)}
    both = pair.one[0][i] & pair.one[1][j] & good
    out: Row = {"strict_right": int(both.sum()), "strict_units": len(strict), "pairs": 1}
    true_rooms = (set(units), of_twins, set(units) - of_twins)
    for name, chosen, true in zip(GROUPS, (twin | True, twin, ~twin), true_rooms, strict=True):
        out |= {f"predicted{name}": int(chosen.sum()), f"right{name}": int((good & chosen).sum())}
        out |= {f"units{name}": len(true), f"found{name}": len(true & hit)}
    return out


def _find_true_pair(pair: EvaluationPair, i: int, j: int) -> tuple[int, int]:
    return int(pair.true[0][i]), int(pair.true[1][j])


def find_shared_rooms(pair: EvaluationPair) -> dict[tuple[int, int], list[tuple[int, int]]]:
    """Map true rooms that both maps have to the matches of their pieces."""
    out: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for i, j in pair.matches.tolist():
        out.setdefault(_find_true_pair(pair, i, j), []).append((i, j))
    return out


def rank_partners(cost: Array, matches: Array) -> tuple[Array, Array]:
    """Return (Q,) rows that have a partner, and (Q,) rank of its best partner, from 1: columns that are no partner and cost as
    much count before it.

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


def count_ranks(pair: EvaluationPair, cost: Array) -> Row:
    """Count `queries`: rooms of either map with a true partner in the other; `first`, `five`: whose partner ranks first, within
    five; `reciprocal`: sum of 1 / rank; each also with and without a twin, and where neither room was looked into only
    (`_whole`), or one was (`_glimpsed`). `chance`: first ones to be expected of a draw."""
    rank, twin, entered, by_chance = [], [], [], 0.0
    for side, c, m in ((0, cost, pair.matches), (1, cost.T, pair.matches[:, ::-1])):
        rooms, room_ranks = rank_partners(c, m)
        rank.append(room_ranks)
        twin.append(pair.twin[side][rooms])
        entered_rooms = m[~pair.glimpsed[side][m[:, 0]] & ~pair.glimpsed[1 - side][m[:, 1]], 0]
        entered.append(np.isin(rooms, entered_rooms))
        by_chance += len(m) / max(c.shape[1], 1)
    r, t, w = np.concatenate(rank), np.concatenate(twin).astype(bool), np.concatenate(entered)
    out: Row = {"pairs": 1, "chance": by_chance}
    for name, queries in zip((*GROUPS, WHOLE, GLIMPSED), (t | True, t, ~t, w, ~w), strict=True):
        out[f"queries{name}"] = int(queries.sum())
        out[f"first{name}"] = int((r[queries] == 1).sum())
        out[f"five{name}"] = int((r[queries] <= 5).sum())
        out[f"reciprocal{name}"] = float((1 / r[queries]).sum())
    return out


def count_ranks_after(pair: EvaluationPair, cost: Array, agreed: Array | None) -> Row:
    """Count `first`, `first_single` and `five` as of `count_ranks`, each with `_after`: of a ranking in which the matches (M, 2)
    that one transform explains come first, and the descriptor ranks what they leave; nan where that was not run."""
    names = ("first", "first_single", "five")
    if agreed is None:
        return {f"{name}_after": np.nan for name in names}
    reranked = cost.astype(np.float64)
    reranked[agreed[:, 0], agreed[:, 1]] = -1.0  # costs are 0 or more
    counts = count_ranks(pair, reranked)
    return {f"{name}_after": counts[name] for name in names}


def measure_pose_error(pose: Sim3, truth: Sim3, anchor: Array) -> tuple[float, float, float]:
    """Measure the error at a point of b: horizontal and vertical, m, and of the yaw, degrees."""
    off = (pose.apply(anchor[None]) - truth.apply(anchor[None]))[0]
    turned = abs((pose.yaw - truth.yaw + np.pi) % (2 * np.pi) - np.pi)
    return float(np.hypot(*off[:2])), float(abs(off[2])), float(np.degrees(turned))


def is_within(error: tuple[float, float, float], flat: bool, limits: tuple[float, float]) -> bool:
    """Return whether a pose is right. A slice says nothing of its height, but must lie on its storey
    (`metrics.is_pose_right`)."""
    return is_pose_right(error, flat, limits)


def count_merges(pair: EvaluationPair, verdict: Mapping[str, Any], floors: Sequence[Array] = ()) -> Row:
    """Count, of a pair: `near`, `fine`: the best pose is right within 0.5 m and 5 degrees, 0.1 m and 1 degree; `merged`: believed
    and near; `false`: believed and not; `refused`: right but not believed; `mergeable`: the maps have something in common;
    `every_room`: it puts, not bent, every shared room within 0.1 m of its true place; `rooms_near`: so many of the
    `rooms_shared`; `place`: where it puts the middle of what both saw, m, and its yaw, degrees.

    Args:
        floors: (n, 3) points of b on the floor of each shared room.
    """
    pose = None if verdict["pose"] is None else convert_to_sim3(np.array(verdict["pose"]))
    place = [] if pose is None else [*pose.apply(pair.anchor[None])[0].tolist(), float(np.degrees(pose.yaw))]
    mergeable = pair.transform is not None and pair.about["kind"] == "overlap" and pair.about["common"] >= 1
    near = fine = False
    error = (np.nan,) * 3
    off = np.full(len(floors) if mergeable else 0, np.inf)
    if mergeable and pose is not None:
        assert pair.transform is not None
        error = measure_pose_error(pose, pair.transform, pair.anchor)
        flat = any(s in FLAT_SENSORS for s in pair.about["sensors"])
        near, fine = is_within(error, flat, NEAR_POSE), is_within(error, flat, FINE_POSE)
        off = measure_displacements(pose, pair.transform, floors, flat and is_on_storey(error[1]))
    accepted = bool(verdict["believed"])
    rooms = np.array(verdict["rooms"], np.int64).reshape(-1, 2)
    return {
        "mergeable": int(mergeable),
        "near": int(near),
        "fine": int(fine),
        "believed": int(accepted),
        "merged": int(accepted and near),
        "merged_fine": int(accepted and fine),
        "false": int(accepted and not near),
        "refused": int(near and not accepted),
        "with_rooms": int(len(off) > 0),
        "every_room": int(len(off) > 0 and bool((off <= ROOM_NEAR).all())),
        "rooms_shared": len(off),
        "rooms_near": int((off <= ROOM_NEAR).sum()),
        "farthest_room": float(off.max(initial=0.0)) if len(off) else np.nan,
        "probability": verdict["probability"],
        "seconds": verdict["seconds"],
        **dict(zip(("off", "off_above", "turned"), error, strict=True)),
        **count_matches(pair, rooms),
        "place": place,
        "chance": list(verdict["chance"]),
        "good": is_right_match(pair, rooms).tolist(),
    }


FLAT_SENSORS = ("laser2d", "drawing")  # sensors whose maps have no height


SLICED_SENSORS = ("laser2d", "phone")  # whose maps are of one height, or were drawn from above


WITHIN = (0.1, 0.6)  # m: what is free between a wall and its copy, at least, and from middle to middle, at most
PARALLEL = np.radians(25.0)  # two walls that differ by less
ACROSS = np.radians(55.0)  # between the wall and the way to its copy, at least: the other end of a doorway is no copy


def find_doubled_columns(first: Array, second: Array, seen: Array, edge: float) -> Array:
    """Return (nx, ny) bool columns of the walls of a map that another map shows a second time: a parallel wall of the other one
    stands within `WITHIN` where this map has none, the other one has none here, and what lies between the two was looked into.
    (Where it was not, the two are the faces of one thick wall, seen from its two sides.)

    Args:
        first, second: (nx, ny) bool walls of the two maps, on one raster.
        seen: (nx, ny) bool columns of which the floor, or free space, was seen.
        edge: m, of a column.
    """
    out = np.zeros(first.shape, bool)
    if not first.any() or not second.any():
        return out
    distance, nearest = ndimage.distance_transform_edt(~second, return_indices=True)
    distance *= edge
    near = first & (distance >= WITHIN[0] + 0.99 * edge) & (distance <= WITHIN[1] + 0.01 * edge)
    here = np.argwhere(near)
    partners = nearest[:, near].T
    alone = ~ndimage.binary_dilation(first, np.ones((3, 3)))[tuple(partners.T)]
    normals = [_estimate_normals(walls) for walls in (first, second)]
    apart = partners - here
    n, m = normals[0][tuple(here.T)], normals[1][tuple(partners.T)]
    parallel = np.abs(np.angle(np.exp(2j * (n - m)))) <= 2 * PARALLEL
    across = np.abs(np.angle(np.exp(2j * (n - np.arctan2(apart[:, 1], apart[:, 0]))))) <= 2 * (np.pi / 2 - ACROSS)
    between = np.zeros(len(here), bool)
    for share in (0.35, 0.5, 0.65):
        at = tuple(np.rint(here + share * apart).astype(int).T)
        between |= seen[at] & ~first[at] & ~second[at]
    out[tuple(here[alone & parallel & across & between].T)] = True
    return out


def _estimate_normals(walls: Array) -> Array:
    """Return (nx, ny) rad, across the wall, modulo pi."""
    image = ndimage.gaussian_filter(walls.astype(np.float32), DIRECTION_BLUR)
    slope = ndimage.sobel(image, 0) + 1j * ndimage.sobel(image, 1)
    square = slope**2
    mean = ndimage.gaussian_filter(square.real, DIRECTION_BLUR) + 1j * ndimage.gaussian_filter(square.imag, DIRECTION_BLUR)
    return np.asarray(np.angle(mean) / 2)


def measure_doubled_walls(joined: TopometricMap) -> float:
    """Return share of a joined map's wall columns that stand there twice (`find_doubled_columns`); nan without walls.

    Args:
        joined: with the provenance of its cells.
    """
    if joined.provenance is None:
        return float("nan")
    whole = build_room_plans(joined)
    seen = np.stack([plan.is_occupied(-0.3, 0.25) for plan in whole.plans]) if whole.plans else np.zeros((0, 0, 0), bool)
    bits = int(np.bitwise_or.reduce(joined.provenance, initial=0)).bit_length()
    walls = [_rasterise_walls(joined, bit) for bit in range(bits)]
    doubled = np.zeros(whole.walls.shape, bool)
    for i, mine in enumerate(walls):
        for j, other in enumerate(walls):
            for s in range(len(doubled)) if i != j else ():
                doubled[s] |= find_doubled_columns(mine[s], other[s], seen[s], whole.edge)
    every = whole.walls | np.logical_or.reduce(walls)
    return float((doubled & every).sum() / every.sum()) if every.any() else float("nan")


def _rasterise_walls(joined: TopometricMap, bit: int) -> Array:
    """Return (S, nx, ny) bool walls of what one map saw."""
    assert joined.provenance is not None
    chosen = (joined.provenance >> np.uint32(bit) & np.uint32(1)) > 0
    grid, room = joined.grid.select_cells(chosen), joined.room[chosen]
    return build_room_plans(replace(joined, grid=grid, room=room, provenance=None, free=None)).walls
