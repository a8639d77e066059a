"""Observations that would settle whether two maps belong together: those that change the posterior most, for their cost.

An observation has two outcomes, as if this is the place or as if not. Its worth is the expected change of the posterior over the
named alternatives (mean of the total variation over both outcomes), divided by what it costs; as in active loop closing
(Stachniss, Hähnel, Burgard and Grisetti 2005), with alternatives in place of particles.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from topomerge.landmarks.evidence import Witness
from topomerge.landmarks.likelihood import ALTERNATIVES, KINDS
from topomerge.landmarks.sightings import build_sightings
from topomerge.landmarks.text import quote_text
from topomerge.types import Array, Sim3, TopometricMap

COSTS = {"read": 1.0, "read both": 2.0, "visit": 2.0}  # and a metre of way to a room that is not in the map yet:
COST_PER_METRE = 0.1
READ = 0.95  # probability that a sign is read as it stands, if somebody goes there for it
# Probability that a room which the one map shows is found beside the other one, as if they were of one place.
FOUND = {"here": 0.9, "elsewhere": 0.1, "storey": 0.8, "half": 0.8, "wing": 0.5, "building": 0.15, "outside": 0.05}
SEEN_WITHIN = 1.5  # m of the other map's cells: a place that it shows
REACHED_WITHIN = 15.0  # m of them: a room that can be visited from it
APART = 3.0  # m between two observations of a kind
RARE = 0.01  # share of the signs, up to which one is worth reading
MOST_SHOWN = 5
LEAST_CHANGE = 0.02  # expected, below which an observation settles nothing and is not shown


@dataclass(frozen=True)
class Observation:
    """Something to look at.

    Args:
        action: "read" the sign at a place of one map whose text the other one has; "read both" signs of a door that both show;
            "visit" a room that only the other one has.
        map: number of the map in which it is, 0 or 1.
        room: of that map in which the place is, -1 none.
        at: m, in the frame of that map: a goal for a robot.
        expected: the text that stands there if the maps belong together as they are laid; empty where it is not known.
        change: expected change of the posterior, 0 to 1.
        cost: as of `COSTS`.
    """

    action: str
    map: int
    room: int
    at: tuple[float, float, float]
    expected: str
    change: float
    cost: float

    def inverse(self) -> Observation:
        """Return the same with the maps the other way round."""
        return replace(self, map=1 - self.map)

    def describe(self, names: Sequence[str]) -> str:
        """Describe it in words, with the names of both maps."""
        x, y, _ = self.at
        where = f"at ({x:.1f}, {y:.1f}) m" + (f" in room {self.room}" if self.room >= 0 else "") + f" of {names[self.map]}"
        if self.action == "read":
            return f"read the sign {where}: {quote_text(self.expected)} if the maps belong together so"
        if self.action == "read both":
            return f"read the sign of the door {where}, and that of the same door in {names[1 - self.map]}"
        return f"visit the room {where}, which only {names[1 - self.map]} shows"

    def serialise(self) -> dict[str, Any]:
        """Return plain values, for merge.json."""
        place = {"map": self.map, "room": self.room if self.room >= 0 else None, "at": [round(v, 2) for v in self.at]}
        worth = {"change": round(self.change, 4), "cost": round(self.cost, 2)}
        return {"action": self.action, **place, "expected": self.expected, **worth}


def find_observations(
    a: TopometricMap, b: TopometricMap, pose: Sim3, posterior: Mapping[str, float], witnesses: Sequence[Witness] = ()
) -> list[Observation]:
    """Find what would settle T_ab, what changes the posterior most for its cost first.

    Args:
        posterior: over `ALTERNATIVES`.
        witnesses: landmarks that have testified already.
    """
    found: list[Observation] = []
    maps = a, b
    trees = [cKDTree(_sample(m.grid.compute_centroids())) if len(m.grid) else None for m in maps]
    for own in (0, 1):
        into = pose.inverse() if own == 0 else pose  # of places of this map into the other one
        text = {w.rows[own] for w in witnesses if w.verdict != "elsewhere"}
        other = trees[1 - own]
        if other is None:
            continue
        found += _list_signs(maps[own], into, other, 1 - own, text, posterior)
        found += _list_rooms(maps[own], into, other, 1 - own, posterior)
    found += _list_doors(maps, pose, trees[1], posterior, witnesses)
    found = [replace(o, room=_find_room(maps[o.map], o.at)) if o.action != "visit" else o for o in found]
    found.sort(key=lambda o: (-round(o.change / o.cost, 9), o.map, o.at))
    picked: list[Observation] = []
    for o in found:
        near = any(p.map == o.map and np.hypot(p.at[0] - o.at[0], p.at[1] - o.at[1]) < APART for p in picked)
        if not near and len(picked) < MOST_SHOWN and o.change >= LEAST_CHANGE:
            picked.append(o)
    return picked


def compute_expected_change(posterior: Mapping[str, float], outcome: Mapping[str, float]) -> float:
    """Return the expected change of a posterior by an observation with two outcomes: the mean total variation.

    Args:
        outcome: probability of the first outcome under each alternative.
    """
    change = 0.0
    for of in (outcome, {name: 1 - p for name, p in outcome.items()}):
        joint = {name: posterior[name] * of[name] for name in ALTERNATIVES}
        total = sum(joint.values())
        if total > 0:
            change += total * sum(abs(joint[name] / total - posterior[name]) for name in ALTERNATIVES) / 2
    return change


def _sample(points: Array) -> Array:
    return points[:: max(len(points) // 50_000, 1)]


def _list_signs(
    map: TopometricMap, into: Sim3, other: cKDTree, number: int, reported: set[int], posterior: Mapping[str, float]
) -> list[Observation]:
    """List the signs of a map that the other one could show and does not."""
    signs = build_sightings(map, ("text", "name"))
    kind = KINDS["text"]
    out = []
    for k in range(len(signs)):
        if (
            signs.share[k] > RARE
            or signs.sigma[k] > 2.0
            or int(signs.rows[k]) in reported
            or not np.isfinite(signs.position[k]).all()
        ):
            continue
        x, y, z = into.apply(signs.position[k][None])[0].tolist()
        if other.query((x, y, z))[0] > SEEN_WITHIN:
            continue
        agrees = {n: READ * (kind.repeats[n] if n != "here" else 1 - kind.changed) for n in ALTERNATIVES}
        change = compute_expected_change(posterior, agrees)
        out.append(Observation("read", number, -1, (x, y, z), signs.values[k], change, COSTS["read"]))
    return out


def _list_rooms(map: TopometricMap, into: Sim3, other: cKDTree, number: int, posterior: Mapping[str, float]) -> list[Observation]:
    """List the rooms of a map that lie beside what the other one shows."""
    out = []
    change = compute_expected_change(posterior, FOUND)
    for centroid in into.apply(map.rooms["centroid"]) if len(map.rooms) else ():
        away = float(other.query(centroid)[0])
        if SEEN_WITHIN < away <= REACHED_WITHIN:
            x, y, z = centroid.tolist()
            out.append(Observation("visit", number, -1, (x, y, z), "", change, COSTS["visit"] + COST_PER_METRE * away))
    return out


def _list_doors(
    maps: tuple[TopometricMap, TopometricMap],
    pose: Sim3,
    other: cKDTree | None,
    posterior: Mapping[str, float],
    witnesses: Sequence[Witness],
) -> list[Observation]:
    """List the doors that both maps show and of whose signs nothing is known."""
    a, b = maps
    doors = a.edges[(a.edges["kind"] == "door")]["centre"]
    if other is None or not len(doors) or not len(b.edges):
        return []
    kind = KINDS["text"]
    agrees = {n: READ**2 * (kind.repeats[n] if n != "here" else 1 - kind.changed) for n in ALTERNATIVES}
    change = compute_expected_change(posterior, agrees)
    placed = pose.apply(b.edges["centre"])
    known = np.array([w.at[0][:2] for w in witnesses if w.kind in ("text", "name")], float).reshape(-1, 2)
    out = []
    for x, y, z in doors.tolist():
        same = np.linalg.norm(placed - (x, y, z), axis=1).min() < SEEN_WITHIN
        if same and not (np.hypot(*(known - (x, y)).T) < SEEN_WITHIN).any():
            out.append(Observation("read both", 0, -1, (x, y, z), "", change, COSTS["read both"]))
    return out


def _find_room(map: TopometricMap, at: Sequence[float]) -> int:
    """Return the room of the nearest floor within `SEEN_WITHIN`, -1 none."""
    inside = map.navigable_room >= 0
    if not inside.any():
        return -1
    floor = map.navigable.compute_centroids(map.navigable.cells[inside])
    away = np.hypot(*(floor[:, :2] - np.asarray(at)[:2]).T) + np.where(np.abs(floor[:, 2] - at[2]) > 2.5, np.inf, 0.0)
    nearest = int(away.argmin())
    return int(map.navigable_room[inside][nearest]) if away[nearest] <= SEEN_WITHIN else -1
