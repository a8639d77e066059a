"""Doors that are new, gone, opened, shut or bricked up: how each place of a door stands in either map, and what that makes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from topomerge.changes.elements import WallChange
from topomerge.changes.layers import CHANGE_CELL, MapLayer, PlacedMap, StoreyLayers
from topomerge.extraction.cleaning import compute_cell_means
from topomerge.types import Array, TopometricMap

STATES = ("open", "leaf", "wall", "none")  # a way through, a shut door, a wall, and neither wall nor door
SAME_DOOR = 0.6  # m
DOOR_HEIGHTS = (0.4, 1.8)  # m above the floor, in which a leaf stands back from its wall
JAMB = 0.35  # m beside a door
PLANE_REACH = 0.2  # m on either side of the middle of its wall
FACE_SPAN, FACE_BIN, FACE_REACH = 0.4, 0.01, 0.03  # m across a wall, in which its faces are looked for, and about them
LEAST_THICK, MOST_THICK, SECOND_FACE = 0.07, 0.35, 0.25  # m between them; share of the points of the stronger one
FLUSH = 0.15, 0.03  # share of what blocks a door that lies in the weaker face, from which on it is a wall; its softness
LEAST_POINTS = 12  # to measure that
MISREAD = 0.04  # share of the doors whose state a map takes for another one, however sure it is
BLIND_LEAF = 0.85  # of what blocks a door and was seen from one side: it is a leaf
OWN_OPEN, OWN_SHUT = 6.0, 3.0  # log odds by which a map's own door speaks for how it says that the door stands
OWN_LEAF = 4.0  # odds of a leaf against a wall, where the map has a door that it calls shut
WAY_ODDS = 10.0  # log odds per share of a door's width that is passable
# How much rarer than no change each change is, before anything was seen: old state, new state.
PRIOR = {
    ("open", "leaf"): 0.25, ("leaf", "open"): 0.25, ("open", "wall"): 0.06, ("leaf", "wall"): 0.04, ("wall", "open"): 0.06,
    ("wall", "leaf"): 0.02, ("open", "none"): 0.05, ("leaf", "none"): 0.05, ("none", "open"): 0.05, ("none", "leaf"): 0.05,
    ("wall", "none"): 0.05, ("none", "wall"): 0.05,
}  # fmt: skip
NAMES = {
    ("open", "leaf"): "door shut", ("leaf", "open"): "door opened", ("open", "wall"): "door bricked up",
    ("leaf", "wall"): "door bricked up", ("wall", "open"): "door new", ("wall", "leaf"): "door new",
    ("open", "none"): "door gone", ("leaf", "none"): "door gone", ("none", "open"): "door new", ("none", "leaf"): "door new",
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class DoorChange:
    """A door that is not as it was.

    Args:
        kind: as in `NAMES`.
        centre: (2,) m.
        width: m.
        direction: rad, of the wall's normal.
        probability: 0..1.
        evidence: probability of each state in the old and in the new map.
        old, new: its number in the maps, -1 where they have no door there.
    """

    kind: str
    centre: Array
    width: float
    direction: float
    probability: float
    evidence: dict[str, float]
    old: int
    new: int


class DoorReader:
    """The doors of both maps in the frame of the old one, and the cells that leaves are told from walls by."""

    def __init__(self, old: TopometricMap, new: TopometricMap, placement: PlacedMap) -> None:
        self.maps, self.placement = (old, new), placement
        self.edges: list[Array] = []
        for k, m in enumerate(self.maps):
            edges = m.edges.copy()
            if k and len(edges):
                edges["centre"] = placement.transform_points(edges["centre"])
                edges["direction"] = (edges["direction"] + placement.pose.yaw) % np.pi
                edges["width"] *= placement.pose.scale
            self.edges.append(edges)

    @cached_property
    def points(self) -> tuple[Array, Array]:
        """(n, 3) m of the cells of both maps, in the frame of the old one."""
        first, second = (compute_cell_means(m.grid) for m in self.maps)
        return first, self.placement.transform_points(second)

    def select(self, which: int, layers: StoreyLayers) -> Array:
        """Select the rows of the doors and openings of one map that stand on a storey."""
        edges = self.edges[which]
        near = np.abs(edges["centre"][:, 2] - layers.floor) < 1.2
        out: Array = np.flatnonzero(np.isin(edges["kind"], ("door", "opening")) & near)
        return out

    def list_places(self, layers: StoreyLayers) -> list[tuple[Array, float]]:
        """List middle (2,) m and width of all doors of both maps on a storey."""
        return [(e["centre"][:2], float(e["width"])) for k in (0, 1) for e in self.edges[k][self.select(k, layers)]]


def find_door_changes(layers: StoreyLayers, reader: DoorReader, walls: Sequence[WallChange] = ()) -> list[DoorChange]:
    """Find the doors that changed, whatever their probability; one change a door.

    Args:
        layers: of the storey.
        reader: of both maps.
        walls: those that changed: where one stands in a door, it was walled up, or never a door.
    """
    rows = [reader.select(k, layers) for k in (0, 1)]
    a, b = (reader.edges[k][rows[k]] for k in (0, 1))
    partner = _pair_doors(a["centre"], b["centre"])
    places = [(i, partner.get(i, -1)) for i in range(len(a))]
    places += [(-1, j) for j in range(len(b)) if j not in set(partner.values())]
    found = []
    for i, j in places:
        own = [edges[k] if k >= 0 else None for edges, k in ((a, i), (b, j))]
        best = own[0] if own[0] is not None else own[1]
        assert best is not None
        states = [read_state(layers, layer, best, own[k], reader.points[k]) for k, layer in enumerate((layers.old, layers.new))]
        walled = max((w.probability for w in walls if _is_in_wall(best, w)), default=0.0)
        kind, probability = _decide(states[0], states[1], walled)
        evidence = {f"{when} {n}": p for when, s in zip(("old", "new"), states, strict=True) for n, p in s.items()}
        numbers = (int(rows[0][i]) if i >= 0 else -1, int(rows[1][j]) if j >= 0 else -1)
        if kind:
            door = (best["centre"][:2].copy(), float(best["width"]), float(best["direction"]))
            found.append(DoorChange(kind, *door, probability, evidence, *numbers))
    return found


def find_door_corrections(layers: StoreyLayers, reader: DoorReader) -> list[DoorChange]:
    """Find the doors of two maps of one scan that somebody added, deleted, opened or shut; all of them are certain."""
    rows = [reader.select(k, layers) for k in (0, 1)]
    a, b = (reader.edges[k][rows[k]] for k in (0, 1))
    partner = _pair_doors(a["centre"], b["centre"])
    corrections = [("door gone", a[i], int(rows[0][i]), -1) for i in range(len(a)) if i not in partner]
    corrections += [("door new", b[j], -1, int(rows[1][j])) for j in range(len(b)) if j not in set(partner.values())]
    turned = ((a[i], b[j], int(rows[0][i]), int(rows[1][j])) for i, j in partner.items() if a[i]["open"] != b[j]["open"])
    corrections += [("door opened" if after["open"] else "door shut", before, i, j) for before, after, i, j in turned]
    return [
        DoorChange(kind, d["centre"][:2].copy(), float(d["width"]), float(d["direction"]), 1.0, {"corrected": 1.0}, i, j)
        for kind, d, i, j in corrections
    ]


def _pair_doors(old: Array, new: Array) -> dict[int, int]:
    """Return the doors of the new map by those of the old one that stand where they do, the nearest first, one to one."""
    apart = np.linalg.norm(old[:, None, :2] - new[None, :, :2], axis=2)
    partner: dict[int, int] = {}
    for at in np.argsort(apart, axis=None, kind="stable").tolist():
        i, j = divmod(at, len(new))
        if apart[i, j] > SAME_DOOR:
            break
        if i not in partner and j not in partner.values():
            partner[i] = j
    return partner


def _is_in_wall(door: Array, wall: WallChange) -> bool:
    """Return whether a door is in a wall that is new or gone."""
    ends = wall.ends
    along = (ends[1] - ends[0]) / max(wall.length, 1e-9)
    apart = door["centre"][:2] - ends[0]
    place, off = float(apart @ along), abs(float(apart[0] * along[1] - apart[1] * along[0]))
    return off < SAME_DOOR / 2 and -float(door["width"]) < place < wall.length + float(door["width"])


def _decide(old: dict[str, float], new: dict[str, float], walled: float) -> tuple[str, float]:
    """Return the most probable change between two states, each state with its probability and ``seen``; "" where none is.

    Args:
        walled: probability that the wall of the door is new or gone: its doors are, too, then.
    """
    before, after = (
        {**s, **{name: (1 - MISREAD) * s[name] + MISREAD * sum(s[n] for n in STATES) / len(STATES) for name in STATES}}
        for s in (old, new)
    )
    prior = {pair: max(p, walled) if "none" in pair else p for pair, p in PRIOR.items()}
    joint = {(s, t): before[s] * after[t] * (1.0 if s == t else prior[s, t]) for s in STATES for t in STATES}
    total = sum(joint.values())
    kinds: dict[str, float] = {}
    for pair, share in joint.items():
        if pair in NAMES:
            kinds[NAMES[pair]] = kinds.get(NAMES[pair], 0.0) + share / max(total, 1e-12)
    kind = max(kinds, key=lambda k: kinds[k])
    probability = kinds[kind] * old["seen"] * new["seen"]
    return (kind, probability) if probability > 0.05 else ("", 0.0)


def read_state(layers: StoreyLayers, map: MapLayer, door: Array, own: Array | None, points: Array) -> dict[str, float]:
    """Read how the place of a door stands in one map.

    Args:
        layers: of the storey.
        map: one of its two.
        door: a row of EDGE_DTYPE in the old map's frame, of whichever map has it.
        own: this map's own door there; None: it has none.
        points: (n, 3) m of this map's cells, in the old map's frame.

    Returns:
        The probability of each of `STATES`, if anything was seen, and ``seen`` that it was.
    """
    width = float(door["width"])
    u = np.arange(-width / 2 - JAMB, width / 2 + JAMB + 1e-6, CHANGE_CELL)
    v = np.arange(-PLANE_REACH, PLANE_REACH + 1e-6, CHANGE_CELL)
    normal = np.array([np.cos(door["direction"]), np.sin(door["direction"])])
    along = np.array([-normal[1], normal[0]])
    at = (door["centre"][:2] + u[:, None, None] * along + v[None, :, None] * normal).reshape(-1, 2)
    standing = layers.sample(map.filled, at).astype(bool).reshape(len(u), len(v))
    open_ground = layers.sample(map.free | (map.standing & ~map.filled), at).astype(bool).reshape(len(u), len(v))
    blocked = np.asarray(standing.any(axis=1))
    passed = np.asarray(~blocked & (open_ground.mean(axis=1) > 0.6))
    inner, jambs = np.asarray(np.abs(u) < width / 2 - 0.12), np.asarray(np.abs(u) > width / 2 + 0.05)
    way, shut = float(passed[inner].mean()), float(blocked[inner].mean())
    prior = 0.0 if own is None else (OWN_OPEN if own["open"] else -OWN_SHUT) * float(own["confidence"])
    share = way / max(way + shut, 1e-6)
    through = float(1 / (1 + np.exp(-(WAY_ODDS * (share - 0.5) + prior))))
    bare = float(1 / (1 + np.exp(-WAY_ODDS * (passed[jambs].mean() - 0.7))))
    if own is not None and own["kind"] == "door":
        bare *= 0.2
    leaf = _estimate_leaf(door, own, points, layers.floor)
    seen = float(np.clip((way + shut - 0.4) / 0.4, 0.0, 1.0)) * _is_beside_seen(layers, map, door, normal)
    states = {"open": through * (1 - bare), "none": through * bare, "leaf": (1 - through) * leaf}
    return states | {"wall": (1 - through) * (1 - leaf), "seen": seen}


def _is_beside_seen(layers: StoreyLayers, map: MapLayer, door: Array, normal: Array) -> float:
    """Return how surely the map saw the ground on one side of a door at least, 0 to 1."""
    steps = np.array([0.45, 0.6, 0.75])
    sides = [layers.sample(map.free, door["centre"][:2] + sign * steps[:, None] * normal).mean() for sign in (-1, 1)]
    return float(np.clip(2 * max(sides), 0.0, 1.0))


def _estimate_leaf(door: Array, own: Array | None, points: Array, floor: float) -> float:
    """Return the probability that what blocks a door is a leaf and no wall: a leaf lies in one face of the wall beside it at
    most, masonry in both."""
    own_leaf = own is not None and own["kind"] == "door"
    blind = 0.5 + 0.48 * float(own["confidence"]) if own is not None and own_leaf else BLIND_LEAF
    width, reach = float(door["width"]), float(door["width"]) / 2 + 0.6
    apart = points[:, :2] - door["centre"][:2]
    high = points[:, 2] - floor
    near = (np.abs(apart) < reach).all(axis=1) & (high > DOOR_HEIGHTS[0]) & (high < DOOR_HEIGHTS[1])
    normal = np.array([np.cos(door["direction"]), np.sin(door["direction"])])
    v, u = apart[near] @ normal, apart[near] @ np.array([-normal[1], normal[0]])
    flat = np.abs(v) < FACE_SPAN
    inner = v[flat & (np.abs(u) < width / 2 - 0.12)]
    adjoining = v[flat & (np.abs(u) > width / 2 + 0.08) & (np.abs(u) < width / 2 + 0.5)]
    if min(len(inner), len(adjoining)) < LEAST_POINTS:
        return blind
    faces = _find_faces(adjoining)
    if len(faces) < 2:  # the wall was seen from one side
        return blind
    flush = min(float((np.abs(inner - face) < FACE_REACH).mean()) for face in faces)
    odds = np.exp((FLUSH[0] - flush) / FLUSH[1]) * (OWN_LEAF if own_leaf else 1.0)
    return float(odds / (1 + odds))


def _find_faces(off: Array) -> list[float]:
    """Return the two faces of a wall, m across it, of points that lie on it and beside it; one where only one was seen."""
    count = np.bincount(np.floor((off + FACE_SPAN) / FACE_BIN).astype(int), minlength=round(2 * FACE_SPAN / FACE_BIN))
    smooth = np.convolve(count, np.ones(3), "same")
    at = (np.arange(len(smooth)) + 0.5) * FACE_BIN - FACE_SPAN
    first = int(smooth.argmax())
    apart = np.abs(at - at[first])
    others = np.where((apart >= LEAST_THICK) & (apart <= MOST_THICK), smooth, 0)
    second = int(others.argmax())
    return [float(at[first])] + ([float(at[second])] if others[second] >= SECOND_FACE * smooth[first] else [])
