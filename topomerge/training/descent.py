"""Optimizers of a training, by the settings, and schedules of the learning rate."""

from __future__ import annotations

import inspect
import math
from typing import Any

import torch

from topomerge.errors import InputError
from topomerge.registry import OPTIMIZERS


def group_parameters(network: torch.nn.Module, decay: float) -> list[dict[str, Any]]:
    """Return the weights that are trained, for an optimizer: those of layers decay; biases, gains of norms and lone numbers, such
    as a temperature, do not."""
    trained = [p for p in network.parameters() if p.requires_grad]
    layers, others = [p for p in trained if p.ndim > 1], [p for p in trained if p.ndim < 2]
    return [{"params": of, "weight_decay": by} for of, by in ((layers, decay), (others, 0.0)) if of]


def build_optimizer(settings: Any, network: torch.nn.Module, **options: Any) -> torch.optim.Optimizer:
    """Build the optimizer that settings name.

    Args:
        options: that it gets if it takes them.

    Raises:
        InputError: it does not take the settings' `optimizer_options`.
    """
    kind = OPTIMIZERS[settings.optimizer]
    taken = inspect.signature(kind).parameters
    options = {name: value for name, value in options.items() if name in taken}
    try:
        optimizer: torch.optim.Optimizer = kind(
            group_parameters(network, settings.decay), lr=settings.rate, **options, **settings.optimizer_options
        )
    except (TypeError, ValueError) as error:
        raise InputError(
            f"optimizer={settings.optimizer}: {' '.join(str(error).split())[:160]}; see optimizer_options"
        ) from error
    return optimizer


def set_rate(optimizer: Any, rate: float) -> None:
    """Set the learning rate of all groups, in place where it is a tensor that a graph reads."""
    for group in optimizer.param_groups:
        if isinstance(group["lr"], torch.Tensor):
            group["lr"].fill_(rate)
        else:
            group["lr"] = rate


def warmup_cosine(done: float, warmup: float) -> float:
    """Compute the factor of the learning rate after this share of all steps: a rise, then half a cosine down to 0."""
    if done < warmup:
        return (done + 1e-3) / (warmup + 1e-3)
    return 0.5 * (1 + math.cos(math.pi * (done - warmup) / (1 - warmup)))


def warmup_constant(done: float, warmup: float) -> float:
    """Compute the factor of the learning rate after this share of all steps: a rise, then 1."""
    return min((done + 1e-3) / (warmup + 1e-3), 1.0)
