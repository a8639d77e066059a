"""Two maps under a pose -> squares of both from above, one on the other: what the evidence of a place is read from.

Floor that both maps saw is cut into tiles; the square of a tile is wider than it and is laid on the middle of what both saw of
it, so that a wall between two tiles is whole in one of them. Both maps are drawn in the axes of the first one's walls.

What the places that two maps share say of a pose, one by one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from topomerge.extraction.plans.storey_plan import StoreyPlan
from topomerge.matching.poses import PlanFields, pair_storeys
from topomerge.networks.network import Network, Run, Signature, Tensor, load_network, load_shipped_network
from topomerge.types import Array, Sim3, are_within

CROP_PIXEL = 0.1  # m
SIDE = 64  # pixels of a square
TILE = 48  # pixels of a tile
LEAST_SEEN = 2.0  # m2 of a tile that both maps saw; less says nothing
CEILINGS = (1.5, 0.02)  # m: the lowest ceiling that is told, and the step in which it is
PARTS = ("wall", "free", "clutter", "low", "middle", "high", "hanging", "ceiling")  # bits of the first byte of a pixel
ROOFED = 1 << PARTS.index("free") | 1 << PARTS.index("ceiling")  # bits of free floor under a ceiling
HEIGHTS = ((0.25, 0.75), (0.75, 1.5), (1.5, 2.0))  # m above the floor: low, middle, high
CROP_ARRAYS = ("parts", "ceiling", "looked", "middle", "area")
LOOKED = 5  # numbers that say what a map looked at: a slice?, the three heights, ceilings


@dataclass(frozen=True, eq=False)
class Crops:
    """Squares of two maps, k of them.

    Args:
        parts: (k, 2, SIDE, SIDE) uint8, bits named `PARTS`; of the first map and of the second one.
        ceiling: (k, 2, SIDE, SIDE) uint8, height of the ceiling above the floor in steps (`CEILINGS`), 0 where none was seen;
            those of the second map raised to those of the first one (`level_ceilings`).
        looked: (k, 2, LOOKED) float32 of 0 and 1: what the maps looked at.
        middle: (k, 3) m, of the squares, in the first map's frame, on its floor.
        area: (k,) m2 of the tile that both maps saw.
    """

    parts: Array
    ceiling: Array
    looked: Array
    middle: Array
    area: Array

    @staticmethod
    def none() -> Crops:
        """Return no squares."""
        empty = np.zeros((0, 2, SIDE, SIDE), np.uint8)
        return Crops(empty, empty, np.zeros((0, 2, LOOKED), np.float32), np.zeros((0, 3)), np.zeros(0))

    def __len__(self) -> int:
        return len(self.area)


def cut_crops(a: Sequence[PlanFields], b: Sequence[PlanFields], pose: Sim3) -> Crops:
    """Return the squares of the storeys of two maps that lie on one level under a pose T_ab."""
    rows = [_cut_storey_crops(v, w, pose) for v, w in pair_storeys(a, b, pose.translation[2], pose.scale)]
    rows = [r for r in rows if len(r)]
    return Crops(*(np.concatenate([getattr(r, n) for r in rows]) for n in CROP_ARRAYS)) if rows else Crops.none()


def _cut_storey_crops(v: PlanFields, w: PlanFields, pose: Sim3) -> Crops:
    main = v.main_direction
    axes = np.array([[np.cos(main), np.sin(main)], [-np.sin(main), np.cos(main)]])  # rows: the axes of the raster in a's frame
    low, size = _find_common_box(v.plan, w.plan, pose, axes)
    if (size < 1).any():
        return Crops.none()
    index = np.stack(np.meshgrid(np.arange(size[0]), np.arange(size[1]), indexing="ij"), axis=-1)
    places = (low + (index + 0.5) * CROP_PIXEL) @ axes  # in a's frame
    back = pose.inverse()
    flat = places.reshape(-1, 2)
    placed = back.apply(np.column_stack([flat, np.zeros(len(flat))]))[:, :2].reshape(places.shape)
    drawn = (_draw_layers(v, places, 1.0), _draw_layers(w, placed, pose.scale))
    seen = np.asarray((drawn[0][0] & 7 > 0) & (drawn[1][0] & 7 > 0))
    middle, area = _select_tiles(seen)
    if not len(area):
        return Crops.none()
    drawn = (drawn[0], (drawn[1][0], level_ceilings(drawn[1], drawn[0])))
    parts, ceiling = (np.stack([_cut(d[k], middle) for d in drawn], axis=1) for k in (0, 1))
    at = np.column_stack([(low + (middle + 0.5) * CROP_PIXEL) @ axes, np.full(len(middle), v.plan.floor_guess)])
    examined = np.stack([_detect_observed_heights(v.plan), _detect_observed_heights(w.plan)]).astype(np.float32)
    return Crops(parts, ceiling, np.repeat(examined[None], len(area), axis=0), at, area)


def _find_common_box(a: StoreyPlan, b: StoreyPlan, pose: Sim3, axes: Array) -> tuple[Array, Array]:
    """Return the lower corner, m in the raster's axes, and size, pixels, of the box that both plans reach into."""
    lows, highs = [], []
    for plan, move in ((a, Sim3()), (b, pose)):
        span = np.array(plan.wall.shape) * plan.edge
        corners = plan.origin + np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * span
        at = move.apply(np.column_stack([corners, np.zeros(4)]))[:, :2] @ axes.T
        lows.append(at.min(axis=0))
        highs.append(at.max(axis=0))
    low = np.floor(np.max(lows, axis=0) / CROP_PIXEL) * CROP_PIXEL
    return low, np.ceil((np.min(highs, axis=0) - low) / CROP_PIXEL).astype(int)


def _draw_layers(fields: PlanFields, places: Array, scale: float) -> tuple[Array, Array]:
    """Draw the bytes of parts and of ceilings of a plan at places (..., 2), m in its frame; its heights grow by `scale`."""
    p = fields.plan
    cells = np.floor((places - p.origin) / p.edge).astype(np.int64)
    inside = are_within(cells, 0, p.wall.shape)
    i, j = np.moveaxis(np.where(inside[..., None], cells, 0), -1, 0)
    layers = [p.wall, p.free, p.clutter, *(p.is_occupied(*h) for h in HEIGHTS), fields.hung == 2, np.isfinite(p.ceiling)]
    packed = np.bitwise_or.reduce([layer.astype(np.uint8) << k for k, layer in enumerate(layers)])
    steps = np.clip(np.nan_to_num((scale * p.ceiling - CEILINGS[0]) / CEILINGS[1], nan=-1.0) + 1, 0, 255).astype(np.uint8)
    return np.where(inside, packed[i, j], 0).astype(np.uint8), np.where(inside, steps[i, j], 0).astype(np.uint8)


def level_ceilings(layers: tuple[Array, Array], other: tuple[Array, Array]) -> Array:
    """Return the bytes of the ceilings of a map, raised by the median of what the other one's are above them on floor that is
    free in both: in the storey below another one, what a map takes for the ceiling may be the floor above."""
    both = (layers[0] & other[0] & ROOFED) == ROOFED
    if not both.any():
        return layers[1]
    lift = int(np.median(other[1][both].astype(int) - layers[1][both]))
    return np.where(layers[1] > 0, np.clip(layers[1].astype(int) + lift, 1, 255), 0).astype(np.uint8)


def _select_tiles(seen: Array) -> tuple[Array, Array]:
    """Return the middles (k, 2), pixels, of what both maps saw of each tile, and how much that is, m2; those of enough of it
    only."""
    at = np.argwhere(seen)
    across = seen.shape[1] // TILE + 1
    tile = at[:, 0] // TILE * across + at[:, 1] // TILE
    count = np.bincount(tile, minlength=1)
    many = np.flatnonzero(count * CROP_PIXEL**2 >= LEAST_SEEN)
    middle = np.column_stack([np.bincount(tile, at[:, k], minlength=1)[many] / count[many] for k in (0, 1)])
    return np.round(middle).astype(int), count[many] * CROP_PIXEL**2


def _cut(layer: Array, middle: Array) -> Array:
    """Return (k, SIDE, SIDE) of a layer around middles (k, 2), pixels; 0 beyond its border."""
    padded = np.pad(layer, SIDE // 2)
    return np.stack([padded[i : i + SIDE, j : j + SIDE] for i, j in middle])


def _detect_observed_heights(plan: StoreyPlan) -> Array:
    """Return (LOOKED,) is the plan a slice, at which of `HEIGHTS` did the map look, and did it see ceilings?"""
    heights = [plan.observed & plan.bands.build_mask(*h) != 0 for h in HEIGHTS]
    return np.array([plan.sliced, *heights, np.isfinite(plan.ceiling).any()], float)


PLACE_NETWORK_FILE = "place_network.onnx"
CONVOLUTIONS = {"a": 1, "b": 2, "c": 2}  # layer -> stride
POOLED = 4  # pixels a side that become one
SLACK = 2  # pixels: what is that near is not told apart, as bent maps still are that far off
USUAL_CEILING, CEILING_GAP = 2.7, 0.4  # m; unlike by more is unlike
GROUND = 7  # bits of wall, free, clutter: something is known
BITS = {name: 1 << k for k, name in enumerate(PARTS)}
HEIGHT_PARTS = ("low", "middle", "high")
# Planes that compare the maps, at 0.4 m: with raw crops the network memorised sensors (AUC .57 to .83 on held-out buildings, so
# .82 to .87, with a third of the weights: docs/adr/0015).
PLANES = 22
UPPER_PLANES = (11, 12, 13, 14, 15, 16, 17, 18)  # high things, what hangs, ceilings
PLACE_SIGNATURE = Signature(
    "Says how much two squares from above speak for one place.",
    {
        "planes": Tensor(
            ("squares", SIDE // POOLED, SIDE // POOLED, PLANES),
            "what both maps show, what one misses (`planes`); 0.4 m",
        )
    },
    {"log_odds": Tensor(("squares",), "that they are one place, before any prior")},
)


def compute_planes(parts: Array, ceiling: Array, observed: Array) -> Array:
    """Return (k, SIDE / 4, SIDE / 4, PLANES) float32 of squares as in `Crops`, each the mean over 4 x 4 pixels. Which map is the
    first changes nothing.

    What both show (walls, clutter, at three heights, lamps), what one shows where the other looked and saw nothing near, what
    either knows, how unlike the ceilings are; and the walls, clutter and ceilings themselves: a bare corridor tells little.
    """
    bit = {name: (parts & mask) > 0 for name, mask in BITS.items()}
    spread = _widen_bits(parts)
    near = {name: (spread & mask) > 0 for name, mask in BITS.items()}
    explored = (parts & GROUND) > 0
    standing = near["wall"] | near["clutter"]
    empty = bit["free"] & ~standing
    out = [explored.all(axis=1), explored[:, 0] != explored[:, 1], bit["free"].all(axis=1)]
    out += _compare_layers(bit["wall"], empty, near["wall"])
    out += _compare_layers(bit["clutter"] & ~near["wall"], empty, standing)
    for n, name in enumerate(HEIGHT_PARTS):
        seen = explored & (observed[:, :, 1 + n, None, None] > 0)
        shown = bit[name] & seen & ~near["wall"]
        out += _compare_layers(shown, seen & ~near[name] & bit["free"], near[name])
    roof = bit["ceiling"] & bit["free"]
    out += _compare_layers(bit["hanging"], roof & ~near["hanging"], near["hanging"])
    height = CEILINGS[0] + (ceiling.astype(np.float32) - 1) * CEILINGS[1]
    both = roof.all(axis=1)
    gap = np.minimum(np.abs(height[:, 0] - height[:, 1]) / CEILING_GAP, 2.0)
    out += [both, both * gap, both & (gap > 1)]
    usual = np.clip(height - USUAL_CEILING, -1, 2) * roof
    out += [usual.sum(axis=1) / np.maximum(roof.sum(axis=1), 1)]
    sliced = np.broadcast_to(observed[:, :, 0].max(axis=1)[:, None, None], both.shape)
    out += [bit["wall"].any(axis=1), bit["clutter"].any(axis=1), sliced]
    return np.stack([_pool_mean(layer) for layer in out], axis=-1)


def _pool_mean(layer: Array) -> Array:
    """Return (k, SIDE / 4, SIDE / 4) float32 mean over 4 x 4 pixels."""
    total: Array = layer[:, ::POOLED].astype(np.uint8 if layer.dtype == bool else np.float32)
    for n in range(1, POOLED):
        total += layer[:, n::POOLED]
    across: Array = total[:, :, ::POOLED].copy()
    for n in range(1, POOLED):
        across += total[:, :, n::POOLED]
    out: Array = across / np.float32(POOLED**2)
    return out


def _compare_layers(shown: Array, missing: Array, near: Array) -> list[Array]:
    """Return (k, side, side) each: where both maps show something, and where one shows it and the other one misses it. All (k, 2,
    side, side): `shown` in a map, `missing` from it, there or `near` by."""
    both = (shown[:, 0] & near[:, 1]) | (shown[:, 1] & near[:, 0])
    one = (shown[:, 0] & missing[:, 1]) | (shown[:, 1] & missing[:, 0])
    return [both, one]


def _widen_bits(bits: Array) -> Array:
    """Return the bits (..., side, side) that any pixel up to `SLACK` away has."""
    side = bits.shape[-1]
    for axis in (-1, -2):
        pad = [(0, 0)] * bits.ndim
        pad[axis] = (SLACK, SLACK)
        rim = np.moveaxis(np.pad(bits, pad), axis, 0)
        out = rim[:side].copy()
        for step in range(1, 2 * SLACK + 1):
            out |= rim[step : step + side]
        bits = np.moveaxis(out, 0, axis)
    return bits


def compute_place_log_odds(crops: Crops, network: Run | None = None) -> Array:
    """Compute (k,) log odds that the two squares are one place and no look-alike, before any prior; by the network that ships or
    another."""
    return compute_network_log_odds(
        compute_planes(crops.parts, crops.ceiling, crops.looked), load_weights() if network is None else network
    )


def compute_network_log_odds(seen: Array, network: Run) -> Array:
    """Compute (k,) log odds of planes (k, side, side, PLANES), one after the other: what else is asked for changes none."""
    return np.array([network(planes=x[None])[0][0] for x in seen], float)


def load_weights() -> Network:
    """Load the network that ships, or the one in its place (`archive.find_weights_file`)."""
    return load_shipped_network(PLACE_NETWORK_FILE, PLACE_SIGNATURE)


def read_weights(path: Path) -> Network:
    """Load the network of a file.

    Raises:
        InputError: not the network that this version knows, or damaged.
    """
    return load_network(path, PLACE_SIGNATURE)


MOST_ODDS = 4.0  # log odds: one place never says more
WORST = 1 / 3  # of the places: the worst ones


@dataclass(frozen=True, eq=False)
class Places:
    """Squares of two maps under a pose, k of them, and what each says.

    Args:
        crops: what both maps show; middles in the frame of map a.
        log_odds: (k,) that it is one place and no look-alike, before any prior.
    """

    crops: Crops
    log_odds: Array

    def __len__(self) -> int:
        return len(self.log_odds)

    def inverse(self, pose: Sim3) -> Places:
        """Return the same places seen from b; `pose` is T_ab."""
        c = self.crops
        exchanged = (c.parts[:, ::-1], c.ceiling[:, ::-1], c.looked[:, ::-1], pose.inverse().apply(c.middle), c.area)
        return replace(self, crops=Crops(*exchanged))

    @property
    def features(self) -> dict[str, float]:
        """For the whole-map models: mean of the log odds, that of the worst ones, and the m2 of floor that they are of. Large
        places count more, none more than a full tile."""
        odds = np.clip(self.log_odds, -MOST_ODDS, MOST_ODDS)
        area, total = self.crops.area, float(self.crops.area.sum())
        if not len(odds):
            return {"place_mean": 0.0, "place_worst": 0.0, "place_area": 0.0}
        order = np.argsort(odds, kind="stable")
        share = np.cumsum(area[order]) / total
        worst = order[: max(int(np.searchsorted(share, WORST)) + 1, 1)]
        # Squares of one merge depend on each other: their log odds do not add up (docs/adr/0015).
        mean, low = (float(np.average(odds[k], weights=area[k])) for k in (slice(None), worst))
        return {"place_mean": mean, "place_worst": low, "place_area": total}


def score_places(a: Sequence[PlanFields], b: Sequence[PlanFields], pose: Sim3) -> Places:
    """Cut out the places that two maps share under a pose T_ab, and score each."""
    seen = cut_crops(a, b, pose)
    return Places(seen, compute_place_log_odds(seen))
