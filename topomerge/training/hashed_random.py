"""Random numbers that are hashes of a seed, a stream and an index: the same on host and device, whatever else is drawn."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from topomerge.types import Array


def hash_numbers(seed: Array, stream: int, index: Array) -> Array:
    """Return (n,) uint64, well mixed numbers of seeds (n,), a stream and indices (n,) (the finaliser of SplitMix64)."""
    with np.errstate(over="ignore"):
        x = seed.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15) + index.astype(np.uint64) * np.uint64(0xD1B54A32D192ED03)
        x += np.uint64(stream) * np.uint64(0x8CB92BA72F3D8DD7)
        x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        return x ^ (x >> np.uint64(31))


def draw_uniform(seed: Array, stream: int, index: Array) -> Array:
    """Return (n,) float64 uniform numbers between 0 and 1."""
    return (hash_numbers(seed, stream, index) >> np.uint64(11)).astype(np.float64) * 2.0**-53


def hash_tensors(seed: Tensor, stream: int, index: Tensor) -> Tensor:
    """Return int64 tensors with the bits of `hash_numbers`, of int64 seeds and indices that broadcast."""

    def shifted(x: Tensor, bits: int) -> Tensor:
        return (x >> bits) & ((1 << (64 - bits)) - 1)

    x = (
        seed * convert_to_signed(0x9E3779B97F4A7C15)
        + index * convert_to_signed(0xD1B54A32D192ED03)
        + convert_to_signed(stream * 0x8CB92BA72F3D8DD7)
    )
    x = (x ^ shifted(x, 30)) * convert_to_signed(0xBF58476D1CE4E5B9)
    x = (x ^ shifted(x, 27)) * convert_to_signed(0x94D049BB133111EB)
    return x ^ shifted(x, 31)


def draw_uniforms(seed: Tensor, stream: int, index: Tensor) -> Tensor:
    """Return float32 uniform numbers between 0 and 1 of int64 seeds and indices that broadcast."""
    return ((hash_tensors(seed, stream, index) >> 11) & ((1 << 53) - 1)).double().mul(2.0**-53).float()


def draw_words(seed: Tensor, stream: int, count: int) -> Tensor:
    """Return (n, count) int32 uniform numbers from 0 to 65535 of int64 seeds (n,): four of each hash, as many cost much."""
    index = torch.arange(-(-count // 4), device=seed.device)
    words = hash_tensors(seed[:, None], stream, index).view(torch.int16)
    return words[:, :count].int() & 0xFFFF


def draw_normal(seed: Tensor, stream: int, index: Tensor) -> Tensor:
    """Return float32 normal numbers (Box and Muller) of int64 seeds and indices that broadcast."""
    first, second = (hash_tensors(seed, stream, 2 * index + k) for k in (0, 1))
    u, v = (((x >> 11) & ((1 << 53) - 1)).double() * 2.0**-53 for x in (first, second))
    return ((-2 * (1 - u).log()).sqrt() * (2 * math.pi * v).cos()).float()


def convert_to_signed(number: int) -> int:
    """Return the int64 with the lowest 64 bits of a number."""
    number &= (1 << 64) - 1
    return number - (1 << 64) if number >> 63 else number
