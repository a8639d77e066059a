"""Where two regions of a storey meet, and what speaks for a door there (beyond the thesis: findings.md, "What worked").

The regions are the basins of a watershed of the clearance: they part at every narrowing. Its width, what is on both sides of
it, what is above it and how the walls beside it stand tell whether it is a door (`door_classifier`).
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import edt
import numpy as np
from scipy import ndimage

from topomerge.archive import find_weights_file
from topomerge.errors import InputError
from topomerge.extraction.plans.storey_plan import DOORWAY_CLASS, SHUT_CLASS, WALL_CLASS, StoreyPlan
from topomerge.kernels import rays
from topomerge.kernels.rasters import compute_watershed, find_contacts
from topomerge.numpy_nn import apply_mlp, sigmoid
from topomerge.types import Array

PEAK_PROMINENCE = 0.1  # m: lower peaks of the clearance are noise of the walls
LINTEL_REACH = 1.2  # m: what lies so near to a narrowing is looked at
LINTEL_DROP = 0.2  # m below the ceiling
BARRIER_CHANCE = 0.5  # probability of a wall, a doorway or a shut door: what is more likely one parts regions

DOOR_FEATURES = (
    "width",  # m, at the narrowest
    "share",  # of the narrower side's greatest width
    "wider",  # of the wider side's
    "clearance",  # m, by which the clearance grows within 0.6 m, on the side where it grows less
    "opens",  # m, by which the free width grows within 0.6 m, on the side where it grows less
    "opens_wide",  # and where it grows more
    "length",  # m, over which it is as narrow
    "lintel",  # m by which what is above lies below both ceilings
    "lintel_cover",  # share of the opening that has a lintel
    "ceiling_seen",  # 0 or 1
    "step",  # m between the two ceilings
    "jamb",  # m by which the wall goes on in line with the narrowing, on the shorter side, up to 1
    "longer_jamb",
    "doorway",  # probability of a doorway along the opening (`plan_network`)
    "boundary",  # of a wall, a doorway or a shut door
    "small",  # log of the smaller side's area, m2
    "large",
)


Pair = tuple[int, int]  # of two regions, segments or rooms, the smaller number first


@dataclass(frozen=True)
class Passage:
    """The widest connection of two neighbouring regions; what does not depend on how the regions are merged."""

    place: tuple[int, int]  # element of the plan
    width: float  # m
    across: tuple[float, float]  # unit vector from jamb to jamb
    measured: tuple[float, ...]  # the features 3 to 14
    log_odds: float = 0.0  # of a door, by the maps that were joined (`part_rooms`): added to what the classifier says
    shown: float = 0.0  # log odds of a door by the walls, once they were read (`extract.find_passages`)


def joined(one: Passage, other: Passage) -> Passage:
    """Return the wider of two passages between the same rooms, with what walls show of either."""
    wider = one if one.width > other.width else other
    return replace(wider, shown=max(one.shown, other.shown))


def compute_clearance(plan: StoreyPlan) -> Array:
    """Return (nx, ny) m from each open column to the next wall or to the end of what is known; 0 elsewhere."""
    return np.asarray(edt.edt(plan.inside.view(np.uint8), black_border=True, parallel=1), np.float64) * plan.edge


def segment_regions(plan: StoreyPlan, probability: Array, parted: Array | None = None) -> Array:
    """Return (nx, ny) int64 basin of each open column, -1 elsewhere.

    What the network takes for a wall or a doorway parts basins as walls do: openings as wide as the room have no narrowing, and
    sparse scans have holes in their walls. Its columns then go to the nearest basin.

    Args:
        probability: (nx, ny, 5) what probably stands in each column, see `COLUMN_CLASSES`.
        parted: (nx, ny) bool, columns in which regions end whatever stands there; None: nowhere.
    """
    barrier = plan.inside & (probability[..., WALL_CLASS : SHUT_CLASS + 1].sum(axis=-1) > BARRIER_CHANCE)
    barrier = barrier if parted is None else barrier | (plan.inside & parted)
    clearance = edt.edt((plan.inside & ~barrier).view(np.uint8), black_border=True, parallel=1) * plan.edge
    order = np.argsort(-clearance, axis=None, kind="stable")
    order = order[clearance.ravel()[order] > 0]
    region = np.asarray(compute_watershed(np.asarray(clearance, np.float64), order, PEAK_PROMINENCE))
    if not barrier.any() or not (region >= 0).any():
        return region
    nearest = ndimage.distance_transform_edt(region < 0, return_distances=False, return_indices=True)
    return np.where(barrier, region[tuple(nearest)], region)


def find_passages(plan: StoreyPlan, clearance: Array, region: Array, probability: Array) -> dict[tuple[int, int], Passage]:
    """Return the widest connection of each pair of neighbouring regions.

    Args:
        clearance: (nx, ny) m, of each column to the next wall.
        region: (nx, ny) of each column, -1 none.
        probability: (nx, ny, 5) what probably stands in each column, see `COLUMN_CLASSES`.
    """
    meet = find_contacts(region, clearance)
    if not len(meet):
        return {}
    width = clearance.ravel()[meet[:, 2]]
    order = np.lexsort((meet[:, 2], -width, meet[:, 1], meet[:, 0]))
    meet = meet[order]
    first = np.ones(len(meet), bool)
    first[1:] = (meet[1:, :2] != meet[:-1, :2]).any(axis=1)
    measure = _PassageMeasurer(plan, clearance, region, probability)
    return {(int(a), int(b)): measure.measure_passage(int(a), int(b), int(at)) for a, b, at in meet[first]}


class _PassageMeasurer:
    """Measures passages of one plan."""

    def __init__(self, plan: StoreyPlan, clearance: Array, region: Array, probability: Array) -> None:
        self.plan, self.clearance, self.region = plan, clearance, region
        self.thick_wall = ndimage.binary_dilation(plan.wall, np.ones((3, 3)))  # walls are not quite straight
        self.nearest_wall = ndimage.distance_transform_edt(plan.inside, return_distances=False, return_indices=True)
        low = plan.clear < plan.ceiling - LINTEL_DROP  # nan: no
        doorway, boundary = probability[..., DOORWAY_CLASS], probability[..., WALL_CLASS : SHUT_CLASS + 1].sum(axis=-1)
        self.layers = [np.ascontiguousarray(layer, np.float32) for layer in (low, doorway, boundary)]

    def measure_passage(self, a: int, b: int, at: int) -> Passage:
        """Return the passage between two regions at a flat index of the plan."""
        x, y = divmod(at, self.plan.wall.shape[1])
        inside, e = self.plan.inside, self.plan.edge
        wall = self.nearest_wall[:, x, y] - (x, y)
        dx, dy = (wall / max(float(np.hypot(*wall)), 1e-9)).tolist()
        limit = 3.0 / e
        ahead, behind = (rays.measure_run(inside, float(x), float(y), s * dx, s * dy, limit) for s in (1, -1))
        mx, my, half = x + dx * (ahead - behind) / 2, y + dy * (ahead - behind) / 2, (ahead + behind) / 2
        jambs = sorted(
            rays.measure_run(self.thick_wall, mx + s * (half + 1) * dx, my + s * (half + 1) * dy, s * dx, s * dy, 1.0 / e) * e
            for s in (1, -1)
        )
        steps = int(0.6 / e)
        across = rays.measure_widths(inside, mx, my, dx, dy, steps, limit) * e
        narrow = max(float(across[steps]), e)
        opens = sorted(max(float(side.max(initial=narrow)), narrow) - narrow for side in (across[:steps], across[steps + 1 :]))
        length = float(((across > 0) & (across <= narrow + 0.15)).sum()) * e
        lintel, seen, step, growth = self._measure_above(a, b, x, y)
        cover, doorway, boundary = (
            float(rays.measure_cover(layer, mx, my, dx, dy, half, half, int(0.3 / e))) for layer in self.layers
        )
        width = min((2 * half + 1) * e, 2 * float(self.clearance[x, y]) + 2 * e)
        return Passage((x, y), width, (dx, dy), (growth, *opens, length, lintel, cover, seen, step, *jambs, doorway, boundary))

    def _measure_above(self, a: int, b: int, x: int, y: int) -> tuple[float, float, float, float]:
        """Return the depth of a lintel below both ceilings, whether it was seen, the step between the ceilings, and the growth of
        the clearance."""
        plan, clearance = self.plan, self.clearance
        reach = int(np.ceil(LINTEL_REACH / plan.edge))
        box = slice(max(x - reach, 0), x + reach + 1), slice(max(y - reach, 0), y + reach + 1)
        near, c, clear = self.region[box], clearance[box], plan.clear[box]
        u, v = np.ogrid[: near.shape[0], : near.shape[1]]
        distance = np.hypot(u - (x - box[0].start), v - (y - box[1].start)) * plan.edge
        growth, ceilings = [], []
        for side in (near == a, near == b):
            growth.append(float(c[side & (distance <= 0.6)].max(initial=clearance[x, y])) - float(clearance[x, y]))
            heights = clear[side & (distance > 0.4)]
            heights = heights[~np.isnan(heights)]
            ceilings.append(float(np.median(heights)) if len(heights) >= 5 else np.nan)
        strip = clear[(distance <= 0.35) & (near >= 0)]
        strip = strip[~np.isnan(strip)]
        if len(strip) < 3 or np.isnan(sum(ceilings)):
            return 0.0, 0.0, 0.0, min(growth)
        # A lintel is as deep as the wall, a fifth of the window; single low points are none.
        return min(ceilings) - float(np.quantile(strip, 0.2)), 1.0, abs(ceilings[0] - ceilings[1]), min(growth)


def compute_door_features(passage: Passage, peaks: Sequence[float] | Array, areas: Sequence[float] | Array) -> Array:
    """Return (17,) what speaks for a door, see `DOOR_FEATURES`.

    Args:
        passage: between two sides.
        peaks: m, the greatest clearance of each side.
        areas: m2 of each.
    """
    half = passage.width / 2
    sides = half / max(min(peaks), half), half / max(max(peaks), half)
    small, large = (float(np.log(max(a, 0.1))) for a in sorted(areas))
    return np.array([passage.width, *sides, *passage.measured, small, large])


def sort_pair(a: int, b: int) -> Pair:
    """Return two rooms, the smaller number first."""
    return (a, b) if a < b else (b, a)


# Is a narrowing of the floor a door? A small network trained on simulated buildings (`train.py task=door_classification`).
#
# The findings' rule (a passage that has less than 0.7 of the narrower side's width is a door) leaves open what a lintel, a wall
# in line with the opening or a step of the ceiling say; these are weighed by what simulated scans of training buildings show.

# On 20,424 narrowings the rule was right for 85 %, a logistic regression for 90 %, this network for 92 % (docs/adr/0004).
DOOR_CLASSIFIER_FILE = "door_classifier.json"


def predict_door(x: Array) -> Array:
    """Return (n,) probability that a door parts the two sides of each narrowing, from its (n, 17) features."""
    weights = read_classifier(find_weights_file("topomerge.extraction.plans", DOOR_CLASSIFIER_FILE))
    h = (np.clip(x, weights["low"], weights["high"]) - weights["mean"]) / weights["scale"]
    return sigmoid(apply_mlp(h, weights["layers"])[:, 0])


@lru_cache(maxsize=4)
def read_classifier(path: Path) -> dict[str, Any]:
    """Read range, mean and scale of the features, and (weight, bias) of each layer.

    Raises:
        InputError: damaged, or trained with other features.
    """
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        arrays: dict[str, Any] = {key: np.array(values[key], float) for key in ("low", "high", "mean", "scale")}
        if not all(np.isfinite(array).all() for array in arrays.values()):
            raise ValueError("not finite")
        layers = [(np.array(w, float), np.array(b, float)) for w, b in values["layers"]]
    except (OSError, ValueError, KeyError, TypeError) as error:
        reason = " ".join(str(error).split())[:100]
        raise InputError(f"{path}: is no door classifier ({reason}); install topomerge again") from error
    if tuple(values["features"]) != DOOR_FEATURES:
        raise InputError(f"{path}: was trained with other features: run train.py task=door_classification export=package")
    return {**arrays, "layers": layers}
