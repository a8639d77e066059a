"""Samplers: which pairs an epoch has, and in what order; batches are taken from it one after the other.

A sampler gets the pairs of the set and a generator of the epoch, and returns the numbers of as many pairs.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from topomerge.errors import InputError
from topomerge.registry import SAMPLERS
from topomerge.training.packed_pairs import GraphPair


def shuffle_pairs(pairs: Sequence[GraphPair], generator: torch.Generator) -> Tensor:
    """Draw each pair once."""
    return torch.randperm(len(pairs), generator=generator)


def balance_buildings(pairs: Sequence[GraphPair], generator: torch.Generator) -> Tensor:
    """Draw pairs with replacement, so that each physical building is as likely as any other, however many pairs it has."""
    names = [pair.buildings[0] for pair in pairs]
    counts = {name: names.count(name) for name in set(names)}
    weights = torch.tensor([1 / counts[name] for name in names], dtype=torch.float64)
    return torch.multinomial(weights, len(pairs), replacement=True, generator=generator)


def draw_pairs(sampler: str, pairs: Sequence[GraphPair], generator: torch.Generator) -> Tensor:
    """Draw the pairs of an epoch by a registered sampler.

    Args:
        sampler: of `topomerge.registry.SAMPLERS`.

    Returns:
        (len(pairs),) int64 numbers of pairs.

    Raises:
        InputError: the sampler returns another count, or numbers of pairs that there are not.
    """
    given, count = SAMPLERS[sampler](pairs, generator), len(pairs)
    try:
        order = torch.as_tensor(given)
    except (TypeError, ValueError, RuntimeError):
        raise InputError(f"sampler={sampler}: must return {count} numbers of pairs, not {given!r:.60}") from None
    if order.shape != (count,) or order.is_floating_point() or order.dtype == torch.bool:
        raise InputError(f"sampler={sampler}: must return {count} numbers of pairs, not {order.dtype} {tuple(order.shape)}")
    order = order.long()
    low, high = (int(order.min()), int(order.max())) if count else (0, -1)
    if low < 0 or high >= count:
        raise InputError(f"sampler={sampler}: the pairs are 0 to {count - 1}, not {low} to {high}")
    return order
