"""Doors of a map, those that plans show and those that walls show weighed together (beyond the thesis: docs/adr/0018).

What both show lies where the wall shows it: a leaf that stands open hides from the plan where its doorway ends. What the plan
alone shows is dropped where the wall is seen and closed; what the wall alone shows is a door that the plan missed, mostly a shut
one: it joins two rooms, too. Slices and grid maps show no walls at heights: there the plan alone is weighed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from topomerge.archive import read_weights_json
from topomerge.extraction.elevations.doorways import STRAIGHT, StoreyWalls, merge_openings
from topomerge.extraction.elevations.elevation import ALONG, BANDS, BEFORE, BEHIND, PLACES, Elevations
from topomerge.extraction.plans.storey_plan import PLAN_SIGNS, ClassifiedStorey, compute_plan_features
from topomerge.extraction.topology import DOOR_MOST_WIDTH
from topomerge.numpy_nn import sigmoid
from topomerge.types import EDGE_DTYPE, Array, TopometricMap

WALL_DOORS_FILE = "wall_doors.json"
WALL_DOOR_FEATURES = (
    "wall",  # log odds of a door that the wall shows, the highest along it
    "wall_mean",  # and on average
    "both_sides",  # 0 or 1: seen on two faces
    "shut",  # share of that which speaks for a shut one
    "plan",  # probability of a door that the plan shows
    "near",  # the highest that walls show near a door of the plan alone
    "covered",  # 0 or 1: is a wall seen there?
    "odd_width",  # how far from 0.9 m, as a logarithm
    "complete",  # of the less complete of the two rooms
    "apart",  # m between where plan and wall show it
    "wide",  # 0 or 1: an opening
    "fill",  # logarithm of the share of the walls' elements that hold points: what sparse scans show is less sure
    *PLAN_SIGNS,
)
# What shows a door (flat: the plan of a map without walls); there is a model for each.
SOURCES = ("both", "plan", "wall", "flat")
WALL_DOOR_REACH = 1.0  # m between a door of the plan and the same one on the wall
NEAR = 0.3  # m around a door of the plan
PART_OFF = 0.5  # m between the middle of an opening of the plan and the wall that shows a part of it
HALF_SHARE = 0.5  # of what speaks for a doorway, that speaks for a leaf that stands half open
SUREST = 0.0005  # probability: what walls show is not taken for surer
LEAST_FILL = 0.01  # share of the elements


@dataclass(frozen=True, eq=False)
class DoorCandidates:
    """Candidates for doors from plans or walls.

    Args:
        edges: (n,) EDGE_DTYPE.
        features: (n, 16) `WALL_DOOR_FEATURES`.
        source: (n,) int8, index into `SOURCES`.
    """

    edges: Array
    features: Array
    source: Array


def add_wall_doors(map: TopometricMap, storeys: Sequence[ClassifiedStorey], walls: StoreyWalls | None) -> TopometricMap:
    """Return the map with the doors that its plans and walls show.

    Args:
        storeys: what probably stands in the columns of its plans.
        walls: with the map's rooms beside them; None of a map that shows none at heights.
    """
    level = np.isin(map.edges["kind"], ("door", "opening"))
    candidates = build_door_candidates(map.edges[level], map.rooms["completeness"], storeys, walls)
    probability = compute_door_probability(candidates)
    edges = candidates.edges.copy()
    edges["confidence"] = probability
    edges = np.concatenate(
        [edges[(probability >= 0.5) | _is_only_way(candidates, probability, len(map.rooms))], map.edges[~level]]
    )
    order = np.lexsort((*edges["centre"].T[::-1], edges["rooms"][:, 1], edges["rooms"][:, 0]))
    return replace(map, edges=edges[order])


def compute_door_probability(candidates: DoorCandidates, models: Mapping[str, Sequence[float]] | None = None) -> Array:
    """Return (n,) probability that each is a door. Wide openings that the plan alone shows are as likely as the plan says: walls
    show doors, and without the opening two rooms between which one walks would not be joined.

    Args:
        models: of each of `SOURCES` a constant and the weights of `WALL_DOOR_FEATURES`; None: those that ship.

    Raises:
        InputError: the weights that ship are damaged.
    """
    models = read_weights_json("topomerge.extraction.elevations", WALL_DOORS_FILE) if models is None else models
    table = np.array([models.get(name, ()) for name in SOURCES], float)
    weights = table[candidates.source]
    probability = sigmoid((weights[:, 1:] * candidates.features).sum(axis=1) + weights[:, 0])
    plan, wide = (WALL_DOOR_FEATURES.index(name) for name in ("plan", "wide"))
    opening = (candidates.source == SOURCES.index("plan")) & (candidates.features[:, wide] > 0)
    return np.where(opening, candidates.features[:, plan], probability)


def build_door_candidates(
    edges: Array, complete: Array, storeys: Sequence[ClassifiedStorey], walls: StoreyWalls | None
) -> DoorCandidates:
    """Gather all doors and openings that plans or walls show, between rooms or between segments.

    Args:
        edges: EDGE_DTYPE, those that plans show; of their `confidence` the plan is as sure.
        complete: (R,) share of each room's outline at which a wall was seen.
        storeys: what probably stands in the columns of the plans.
        walls: with what lies beside them numbered as in the edges; None of a map that shows none at heights.
    """
    # Slices and grids show no walls at several heights: a model of its own weighs the plan alone (docs/adr/0018).
    if walls is None:
        return _build_flat_candidates(complete, storeys, edges)
    doorways, shown = merge_openings(walls.doorways)
    whole = _match_openings(edges, doorways)
    partner = _match_doorways(edges, doorways, whole)
    rows, features, source = [], [], []
    for edge, i in zip(edges, partner, strict=True):
        less = float(complete[edge["rooms"]].min())
        if i >= 0:
            way = doorways[i]
            part = whole[i] >= 0
            apart = 0.0 if part else float(np.hypot(*(way["centre"] - edge["centre"])[:2]))
            rows.append(edge if part else _move_door(edge, way))
            features.append(
                [*_compute_doorway_features(way), float(edge["confidence"]), 0, 1, *_compute_size_features(shown[i], less, apart)]
            )
        else:
            near, covered = _measure_near_doors(walls.elevations, walls.doors, edge)
            rows.append(edge)
            features.append(
                [0, 0, 0, 0, float(edge["confidence"]), near, covered, *_compute_size_features(edge["width"], less, 0)]
            )
        source.append(SOURCES.index("both" if i >= 0 else "plan"))
    for i in np.setdiff1d(np.arange(len(doorways)), partner).tolist():
        way = doorways[i]
        if way["rooms"][1] >= 0 and whole[i] < 0:
            rows.append(_build_edge(way))
            features.append(
                [
                    *_compute_doorway_features(way),
                    0,
                    0,
                    1,
                    *_compute_size_features(shown[i], float(complete[way["rooms"]].min()), 0),
                ]
            )
            source.append(SOURCES.index("wall"))
    table = np.array(rows, EDGE_DTYPE) if rows else np.zeros(0, EDGE_DTYPE)
    # In sparse scans walls show less, so the same evidence means more: doors' recall .81 to .90 (docs/adr/0018).
    seen = walls.elevations.strips[..., :BANDS] > 0
    fill = float(np.log(LEAST_FILL + (seen.mean() if seen.size else 0.0)))
    return _build_candidates(table, features, fill, storeys, np.array(source, np.int8))


def _is_only_way(candidates: DoorCandidates, probability: Array, rooms: int) -> Array:
    """Return (n,) bool: passages of a map without walls by which alone one walks from some rooms to others, the likeliest: what
    parts a room wrongly must not part the graph."""
    needed, group = np.zeros(len(probability), bool), np.arange(rooms)
    for k in np.argsort(-probability, kind="stable").tolist():
        a, b = group[candidates.edges["rooms"][k]].tolist()
        if a != b and candidates.source[k] == SOURCES.index("flat"):
            needed[k] = True
            group[group == b] = a
    return needed


def _build_flat_candidates(complete: Array, storeys: Sequence[ClassifiedStorey], edges: Array) -> DoorCandidates:
    """Return the doors of the plans of a map without walls."""
    less = complete[edges["rooms"]].min(axis=1).tolist()
    sizes = [_compute_size_features(width, c, 0) for width, c in zip(edges["width"], less, strict=True)]
    features = [[0, 0, 0, 0, float(e["confidence"]), 0, 0, *size] for e, size in zip(edges, sizes, strict=True)]
    return _build_candidates(edges, features, 0.0, storeys, np.full(len(edges), SOURCES.index("flat"), np.int8))


def _build_candidates(
    edges: Array, features: Sequence[Sequence[float]], fill: float, storeys: Sequence[ClassifiedStorey], source: Array
) -> DoorCandidates:
    """Put the signs of the plan beside what was measured; where walls alone show a door the plan is not asked."""
    measured = np.array(features, float).reshape(len(edges), len(WALL_DOOR_FEATURES) - len(PLAN_SIGNS) - 1)
    measured = np.column_stack([measured, np.full(len(edges), fill)])
    # With the plan's signs a shut door was dropped that both faces show surely and the plan does not see (docs/adr/0018).
    unasked = source == SOURCES.index("wall")
    signs = np.where(unasked[:, None], 0.0, compute_plan_features(storeys, edges["centre"]))
    return DoorCandidates(edges, np.hstack([measured, signs]), source)


def _compute_doorway_features(way: Array) -> list[float]:
    chances = np.clip([way["probability"], way["mean"]], SUREST, 1 - SUREST)
    return [*np.log(chances / (1 - chances)).tolist(), float(way["faces"] > 1), 1 - float(way["open"])]


def _compute_size_features(width: float, complete: float, apart: float) -> tuple[float, ...]:
    """Return the four of `WALL_DOOR_FEATURES` before the last ones, which are not of a door alone."""
    odd = abs(float(np.log(max(float(width), 0.1) / 0.9)))
    return odd, complete, apart, float(width > DOOR_MOST_WIDTH)


def _match_openings(edges: Array, doorways: Array) -> Array:
    """Return (W,) the opening of the plan, wider than doors are, of which each doorway is a part, -1 none: walls show where it
    begins and where it ends. A doorway on one side only may be a door in a wall that the plan lacks, of glass for example."""
    out = np.full(len(doorways), -1)
    for k in np.flatnonzero(edges["width"] > DOOR_MOST_WIDTH).tolist():
        edge = edges[k]
        normal = np.array([np.cos(edge["direction"]), np.sin(edge["direction"])])
        apart = doorways["centre"] - edge["centre"]
        along, off = apart[:, :2] @ (-normal[1], normal[0]), np.abs(apart[:, :2] @ normal)
        inside = (np.abs(along) < edge["width"] / 2) & (off < PART_OFF) & (doorways["width"] < edge["width"])
        inside &= (np.abs(doorways["out"] @ normal) > STRAIGHT) & (np.abs(apart[:, 2]) < WALL_DOOR_REACH)
        inside &= np.isin(doorways["rooms"], edge["rooms"]).any(axis=1)
        if along[inside].min(initial=0) < 0 < along[inside].max(initial=0):
            out[inside] = k
    return out


def _match_doorways(edges: Array, doorways: Array, whole: Array) -> Array:
    """Return (E,) the doorway that each door of the plan is, -1 none: the nearest first, each once. A part of an opening is no
    other."""
    partner = np.full(len(edges), -1)
    if not len(edges) or not len(doorways):
        return partner
    apart = np.linalg.norm(edges["centre"][:, None, :2] - doorways["centre"][None, :, :2], axis=2)
    level = np.abs(edges["centre"][:, None, 2] - doorways["centre"][None, :, 2]) < WALL_DOOR_REACH
    first, second = doorways["rooms"].T
    pair = edges["rooms"][:, None]
    fits = (pair == first[:, None]).any(axis=2) & ((second < 0) | (pair == second[:, None]).any(axis=2))
    apart = np.where(fits & level & ((whole < 0) | (whole == np.arange(len(edges))[:, None])), apart, np.inf)
    for i, j in np.column_stack(np.unravel_index(np.argsort(apart, axis=None, kind="stable"), apart.shape)).tolist():
        reach = max(WALL_DOOR_REACH, float(edges["width"][i]) / 2 + NEAR)
        if apart[i, j] < reach and partner[i] < 0 and j not in partner:
            partner[i] = j
    return partner


def _move_door(edge: Array, way: Array) -> Array:
    """Return a door of the plan where the wall shows it."""
    out = edge.copy()
    out["centre"] = (*way["centre"][:2], edge["centre"][2])
    out["width"], out["direction"], out["half"] = way["width"], _compute_normal(way), _is_half_open(way) and edge["open"]
    out["kind"] = "door" if way["width"] <= DOOR_MOST_WIDTH else "opening"
    out["lower"] = out["upper"] = out["centre"]
    return out


def _is_half_open(way: Array) -> bool:
    """Return whether most of what speaks for a doorway speaks for a leaf that stands half open."""
    return bool(way["half"] >= HALF_SHARE)


def _build_edge(way: Array) -> Array:
    """Return a door that the plan does not show."""
    out = np.zeros((), EDGE_DTYPE)
    out["rooms"], out["centre"], out["width"] = np.sort(way["rooms"]), way["centre"], way["width"]
    out["direction"], out["open"], out["half"] = _compute_normal(way), way["open"] >= 0.5, _is_half_open(way)
    out["kind"] = "door" if way["width"] <= DOOR_MOST_WIDTH else "opening"
    out["lower"] = out["upper"] = out["centre"]
    return out


def _compute_normal(way: Array) -> float:
    return float(np.arctan2(way["out"][1], way["out"][0]) % np.pi)


def _measure_near_doors(walls: Elevations, doors: Array, edge: Array) -> tuple[float, float]:
    """Return the highest probability of a door that walls show around a door of the plan, and is any wall seen there?"""
    best, covered = 0.0, 0.0
    at = edge["centre"][:2] - walls.faces["start"]
    t = (at * walls.faces["along"]).sum(axis=1)
    off = (at * walls.faces["out"]).sum(axis=1)
    level = np.abs(walls.faces["floor"] - edge["centre"][2]) < WALL_DOOR_REACH
    near = (off > -BEFORE) & (off < BEHIND) & (t > 0) & (t < walls.faces["length"]) & level
    for f in np.flatnonzero(near).tolist():
        first, last = int(walls.first[f]) // PLACES, int(walls.first[f + 1]) // PLACES
        low, high = (first + round((t[f] + side * NEAR) / ALONG / PLACES) for side in (-1, 1))
        some = slice(max(low, first), min(high + 1, last))
        if doors[some].size and walls.strips[some.start * PLACES : some.stop * PLACES].any():
            best, covered = max(best, float(doors[some].sum(axis=1).max())), 1.0
    return best, covered
