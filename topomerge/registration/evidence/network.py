"""How much two squares from above speak for one place: a small convolutional network, trained on places of
simulated maps under right and wrong poses (`train.py task=place_evidence`; docs/adr/0015)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from topomerge.networks.network import Network, Run, load_network, load_shipped_network
from topomerge.networks.signature import Signature, Tensor
from topomerge.registration.evidence.crops import CEILINGS, PARTS, SIDE, Crops
from topomerge.types import Array

PLACE_NETWORK_FILE = "place_network.onnx"
CONVOLUTIONS = {"a": 1, "b": 2, "c": 2}  # layer -> stride
POOLED = 4  # pixels a side that become one
SLACK = 2  # pixels: what is that near is not told apart, as bent maps still are that far off
USUAL_CEILING, CEILING_GAP = 2.7, 0.4  # m; unlike by more is unlike
GROUND = 7  # bits of wall, free, clutter: something is known
BITS = {name: 1 << k for k, name in enumerate(PARTS)}
HEIGHT_PARTS = ("low", "middle", "high")
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


def planes(parts: Array, ceiling: Array, looked: Array) -> Array:
    """(k, SIDE / 4, SIDE / 4, PLANES) float32 of squares as in `Crops`, each the mean over 4 x 4 pixels. Which map is the first
    changes nothing.

    What both show (walls, clutter, at three heights, lamps), what one shows where the other looked and saw nothing near, what
    either knows, how unlike the ceilings are; and the walls, clutter and ceilings themselves: a bare corridor tells little.
    """
    bit = {name: (parts & mask) > 0 for name, mask in BITS.items()}
    spread = _widened(parts)
    near = {name: (spread & mask) > 0 for name, mask in BITS.items()}
    explored = (parts & GROUND) > 0
    standing = near["wall"] | near["clutter"]
    empty = bit["free"] & ~standing
    out = [explored.all(axis=1), explored[:, 0] != explored[:, 1], bit["free"].all(axis=1)]
    out += _compared(bit["wall"], empty, near["wall"])
    out += _compared(bit["clutter"] & ~near["wall"], empty, standing)
    for n, name in enumerate(HEIGHT_PARTS):
        seen = explored & (looked[:, :, 1 + n, None, None] > 0)
        there = bit[name] & seen & ~near["wall"]
        out += _compared(there, seen & ~near[name] & bit["free"], near[name])
    roof = bit["ceiling"] & bit["free"]
    out += _compared(bit["hanging"], roof & ~near["hanging"], near["hanging"])
    height = CEILINGS[0] + (ceiling.astype(np.float32) - 1) * CEILINGS[1]
    both = roof.all(axis=1)
    gap = np.minimum(np.abs(height[:, 0] - height[:, 1]) / CEILING_GAP, 2.0)
    out += [both, both * gap, both & (gap > 1)]
    usual = np.clip(height - USUAL_CEILING, -1, 2) * roof
    out += [usual.sum(axis=1) / np.maximum(roof.sum(axis=1), 1)]
    sliced = np.broadcast_to(looked[:, :, 0].max(axis=1)[:, None, None], both.shape)
    out += [bit["wall"].any(axis=1), bit["clutter"].any(axis=1), sliced]
    return np.stack([_pooled(layer) for layer in out], axis=-1)


def _pooled(layer: Array) -> Array:
    """(k, SIDE / 4, SIDE / 4) float32 mean over 4 x 4 pixels."""
    total: Array = layer[:, ::POOLED].astype(np.uint8 if layer.dtype == bool else np.float32)
    for n in range(1, POOLED):
        total += layer[:, n::POOLED]
    across: Array = total[:, :, ::POOLED].copy()
    for n in range(1, POOLED):
        across += total[:, :, n::POOLED]
    out: Array = across / np.float32(POOLED**2)
    return out


def _compared(there: Array, missing: Array, near: Array) -> list[Array]:
    """(k, side, side) each: where both maps show something, and where one shows it and the other one misses it. All (k, 2, side,
    side): `there` in a map, `missing` from it, there or `near` by."""
    both = (there[:, 0] & near[:, 1]) | (there[:, 1] & near[:, 0])
    one = (there[:, 0] & missing[:, 1]) | (there[:, 1] & missing[:, 0])
    return [both, one]


def _widened(bits: Array) -> Array:
    """Bits (..., side, side) that any pixel up to `SLACK` away has."""
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


def place_log_odds(crops: Crops, network: Run | None = None) -> Array:
    """Compute (k,) log odds that the two squares are one place and no look-alike, before any prior; by the network that ships or
    another."""
    return network_log_odds(planes(crops.parts, crops.ceiling, crops.looked), weights() if network is None else network)


def network_log_odds(seen: Array, network: Run) -> Array:
    """Compute (k,) log odds of planes (k, side, side, PLANES), one after the other: what else is asked for changes none."""
    return np.array([network(planes=x[None])[0][0] for x in seen], float)


def weights() -> Network:
    """Load the network that ships, or the one in its place (`io.weight_files`)."""
    return load_shipped_network(PLACE_NETWORK_FILE, PLACE_SIGNATURE)


def read_weights(path: Path) -> Network:
    """Load the network of a file.

    Raises:
        InputError: not the network that this version knows, or damaged.
    """
    return load_network(path, PLACE_SIGNATURE)
