"""What a loop can have besides: an average of weights, the best checkpoints, a trace of steps, a search for what is no number."""

from __future__ import annotations

import re
import shutil
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load
from torch import Tensor

from topomerge.errors import InputError

AVERAGE_FILE = "average.safetensors"  # in `last/`
TRACE_FILE = "trace.json"
TOP = "top"  # folder of the best epochs
TRACED_STEPS = 5
EpochReport = Callable[[dict[str, Any]], None]
# What is told the row of each epoch besides the loggers; it may raise, which ends the run (`training.search`).
REPORT: ContextVar[EpochReport | None] = ContextVar("report", default=None)


class WeightAverage:
    """Exponential moving average of the weights and buffers of a network (Polyak & Juditsky 1992).

    The first steps count more: the decay is at most (1 + step) / (10 + step).

    Args:
        decay: of a step.
    """

    def __init__(self, network: torch.nn.Module, decay: float) -> None:
        self.decay = decay
        self.live = {name: tensor for name, tensor in network.state_dict().items() if tensor.is_floating_point()}
        self.kept = {name: tensor.detach().clone() for name, tensor in self.live.items()}

    @torch.no_grad()
    def update(self, step: int) -> None:
        """Take in the weights after a step, the first of which is number 0."""
        share = 1 - min(self.decay, (1 + step) / (10 + step))
        torch._foreach_lerp_(list(self.kept.values()), list(self.live.values()), share)

    @contextmanager
    def apply(self) -> Iterator[None]:
        """Let the network have the average instead of its weights for a while."""
        before = {name: tensor.detach().clone() for name, tensor in self.live.items()}
        self._copy(self.kept, self.live)
        try:
            yield
        finally:
            self._copy(before, self.live)

    def load(self, path: Path) -> None:
        """Read an average that was kept.

        Raises:
            InputError: it is damaged, or of another network.
        """
        try:
            self._copy(load(path.read_bytes()), self.kept)
        except (KeyError, RuntimeError, OSError, ValueError, SafetensorError) as error:
            reason = " ".join(str(error).split())[:120]
            raise InputError(f"{path}: holds no average of this network ({reason}); start again without resume") from error

    @torch.no_grad()
    def _copy(self, source: dict[str, Tensor], target: dict[str, Tensor]) -> None:
        for name, tensor in target.items():
            tensor.copy_(source[name])


def rank_epochs(before: Sequence[Sequence[float]], score: float, epoch: int, count: int) -> list[list[float]]:
    """Return the best epochs so far, best first, as [score, epoch]; of equal ones the earlier."""
    return sorted([*(list(one) for one in before), [score, epoch]], key=lambda one: (-one[0], one[1]))[:count]


def name_top(folder: Path, epoch: int) -> Path:
    """Name the folder of an epoch that is one of the best."""
    return folder / TOP / f"epoch_{epoch + 1:03d}"


def tidy_top(folder: Path, ranked: Sequence[Sequence[float]]) -> None:
    """Delete the folders of epochs that are no longer among the best."""
    kept = {name_top(folder, int(epoch)) for _, epoch in ranked}
    for path in (folder / TOP).glob("epoch_*"):
        if path not in kept:
            shutil.rmtree(path)


class StepTracer:
    """Trace of a few steps of an epoch, the first one left out, for chrome://tracing or ui.perfetto.dev.

    Args:
        steps: of the epoch.
    """

    def __init__(self, path: Path, steps: int) -> None:
        self.path, self.first, self.done = path, min(1, steps - 1), 0
        self.profiler: Any = None

    def begin_step(self) -> None:
        """Begin with the trace, or end it, as it is time."""
        if self.done == self.first:
            kinds = torch.profiler.ProfilerActivity
            activities = [kinds.CPU, *([kinds.CUDA] if torch.cuda.is_available() else [])]
            self.profiler = torch.profiler.profile(activities=activities)
            self.profiler.start()
        elif self.done == self.first + TRACED_STEPS:
            self.close()
        self.done += 1

    def close(self) -> None:
        """Write the trace, if it began."""
        if self.profiler is not None:
            self.profiler.stop()
            self.profiler.export_chrome_trace(str(self.path))
            self.profiler = None


@contextmanager
def find_anomaly() -> Iterator[None]:
    """Name the operation of a backward pass whose gradient is no number, and the line of its forward pass.

    Raises:
        InputError: such an operation.
    """
    with warnings.catch_warnings(record=True) as warned, torch.autograd.detect_anomaly(check_nan=True):
        warnings.simplefilter("always")
        try:
            yield
        except RuntimeError as error:
            found = re.match(r"Function '(\w+)' returned nan values", str(error))
            if not found:
                raise
            text = "\n".join(str(one.message) for one in warned)
            own = [where for where in re.findall(r'File "([^"]+)", line (\d+)', text) if "site-packages" not in where[0]]
            where = f", computed in {Path(own[-1][0]).name}:{own[-1][1]}," if own else ""
            raise InputError(f"anomaly: the gradient of {found[1].removesuffix('0')}{where} is no number") from error
