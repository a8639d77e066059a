"""Devices and processes of a training, by Fabric.

Several processes run the same program (``torchrun --nproc-per-node 2 train.py ...``, or ``devices=2``). Each makes batches of its
own. Gradients are averaged before each step, so that weights stay equal in all of them.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, distributed


def count_processes(settings: Any) -> int:
    """Count the processes that a training is to have on this machine."""
    return int(os.environ.get("LOCAL_WORLD_SIZE", getattr(settings, "devices", 1)))


def start_fabric(settings: Any) -> Any:
    """Return the Fabric of a training: its device, its precision and its processes."""
    from lightning_fabric import Fabric

    logging.getLogger("lightning_fabric").setLevel(logging.WARNING)
    devices = count_processes(settings)
    fabric = Fabric(
        accelerator=getattr(settings, "accelerator", "cpu"), devices=devices, precision=find_precision(settings),  # type: ignore[arg-type]
        strategy="ddp" if devices > 1 else "auto",
    )  # fmt: skip
    fabric.launch()
    return fabric


def find_precision(settings: Any) -> str:
    """Return the precision of a training: what is asked for, or what suits the accelerator."""
    asked, on = str(getattr(settings, "precision", "32-true")), getattr(settings, "accelerator", "cpu")
    on_cuda = on in ("cuda", "gpu", "auto") and torch.cuda.is_available()
    return ("bf16-mixed" if on_cuda else "32-true") if asked == "auto" else asked


@contextmanager
def let_main_process_first(settings: Any) -> Iterator[None]:
    """Let the first process do something, such as making data that is missing, while the others wait; then they do it, too."""
    if count_processes(settings) == 1:
        yield
        return
    with start_fabric(settings).rank_zero_first():
        yield


def is_parallel() -> bool:
    """Return whether there are other processes."""
    return distributed.is_available() and distributed.is_initialized() and distributed.get_world_size() > 1


def get_rank() -> int:
    """Return the number of this process."""
    return distributed.get_rank() if is_parallel() else 0


def average_gradients(weights: Iterable[Tensor]) -> None:
    """Give each weight the mean of its gradients in all processes; none counts as zero."""
    if not is_parallel():
        return
    kept = list(weights)
    for weight in kept:
        if weight.grad is None:
            weight.grad = torch.zeros_like(weight)
    _average([weight.grad for weight in kept if weight.grad is not None])


def average_buffers(network: torch.nn.Module) -> None:
    """Give each buffer of a network, such as the statistics of its norms, its mean in all processes."""
    if is_parallel():
        _average([buffer for buffer in network.buffers() if buffer.is_floating_point()])


def _average(tensors: list[Tensor]) -> None:
    """Take the mean over all processes, in place, in one message."""
    if not tensors:
        return
    flat = torch.cat([tensor.detach().reshape(-1) for tensor in tensors])
    distributed.all_reduce(flat)
    flat /= distributed.get_world_size()
    for tensor, part in zip(tensors, flat.split([tensor.numel() for tensor in tensors]), strict=True):
        with torch.no_grad():
            tensor.copy_(part.view_as(tensor))


class FabricProcesses:
    """The processes of a Fabric, as `models.losses.Processes`."""

    def __init__(self, fabric: Any) -> None:
        self.fabric = fabric

    def gather_others(self, rows: Tensor) -> Tensor:
        """Return the rows (M, ...) of all other processes; gradients flow back to where they come from."""
        counts = self.fabric.all_gather(torch.tensor(len(rows), device=rows.device)).tolist()
        padded = torch.cat([rows, rows.new_zeros((max(counts) - len(rows), *rows.shape[1:]))])
        every = self.fabric.all_gather(padded, sync_grads=rows.requires_grad)
        return torch.cat([every[k, :count] for k, count in enumerate(counts) if k != self.fabric.global_rank])

    def average(self, value: Tensor) -> Tensor:
        """Return the mean of a value over the processes, without a gradient."""
        mean: Tensor = self.fabric.all_reduce(value.detach().clone(), reduce_op="mean")
        return mean
