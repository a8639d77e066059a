"""The loop that every network is trained by: the same settings and seed give the same weights, also where it was interrupted.

A task gives a `Job`; the loop writes metrics.jsonl, TensorBoard events, `best/` and `last/`, stops early, and goes on where a run
stopped. Nothing random may depend on what came before: a job draws from generators seeded by the seed, the epoch and the step.
"""

from __future__ import annotations

import hashlib
import json
import math
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, TypeVar

import torch

from topomerge.checkpoint import save_state
from topomerge.errors import InputError
from topomerge.training.log import Clock, Log

STEPS_BETWEEN_CHECKS = 20  # of whether the losses are finite: each waits for the device
Say = Callable[[str], None]
T = TypeVar("T")
K = TypeVar("K")


@dataclass
class State:
    """Where a training is: `epoch` and `step` of it come next; `sums` are those of the losses of the epoch so far."""

    epoch: int = 0
    step: int = 0
    best: float = -1.0
    best_epoch: int = -1
    stale: int = 0
    sums: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Schedule:
    """Args:
    folder: of the run.
    epochs: at most; steps: of each.
    watch: score of validation whose highest value is best.
    patience: epochs without a better one after which it ends; 0: never.
    perfect: value of the score at which nothing is left to learn.
    """

    folder: Path
    epochs: int
    steps: int
    watch: str
    patience: int = 0
    perfect: float = math.inf


class Job(Protocol):
    """What a task does in the loop."""

    @property
    def network(self) -> torch.nn.Module:
        """What is trained."""

    def batches(self, state: State) -> Generator[Any, None, None]:
        """Those of the state's epoch, from its step on."""

    def step(self, batch: Any, state: State) -> Mapping[str, Any]:
        """One step of the optimizer; the losses, `loss` among them: numbers, or tensors of one that may be on a device."""

    def size(self, batch: Any) -> int:
        """How many rooms, columns or examples a batch has."""

    def total(self, sizes: int) -> float:
        """That of all processes."""

    def scores(self) -> dict[str, float]:
        """Scores of validation."""

    def optimizer_state(self) -> torch.optim.Optimizer:
        """The optimizer whose state is kept."""

    def write_network(self, folder: Path) -> None:
        """Write the network's files of `last/`."""

    def write_best(self, folder: Path, row: Mapping[str, Any], log: Log) -> None:
        """Write the best network so far into `best/`."""

    def export_best(self, folder: Path) -> None:
        """Make of `best/` what the package reads, once at the end of a run."""

    def line(self, row: Mapping[str, Any]) -> str:
        """What an epoch's line says of the scores."""


class Loop:
    """A training under way.

    Args:
        log: None in all processes but the first.
    """

    def __init__(self, job: Job, schedule: Schedule, state: State, log: Log | None, say: Say) -> None:
        self.job, self.schedule, self.state, self.log, self.say = job, schedule, state, log, say
        self.stop = False

    def run(self) -> dict[str, float]:
        """Epochs until the last one, or until nothing has become better for long; the row of the best epoch.

        Raises:
            KeyboardInterrupt: after Ctrl-C or SIGTERM; the state is saved.
        """
        with self._interrupts():
            return self._epochs()

    def _epochs(self) -> dict[str, float]:
        schedule, clock = self.schedule, Clock(self.state.epoch, self.schedule.epochs)
        best: dict[str, Any] = {}
        if self.log is not None and self.state.best_epoch >= 0:
            best = next((row for row in self.log.rows if row["epoch"] == self.state.best_epoch), {})
        while self.state.epoch < schedule.epochs and not self._enough():
            row = self._epoch()
            scores = self.job.scores()
            row |= {f"val/{name}": value for name, value in scores.items()}
            state, score = self.state, scores[schedule.watch]
            better = score > state.best
            self.state = State(state.epoch + 1, 0, state.best, state.best_epoch, state.stale + 1)
            if better:
                best = row
                self.state.best, self.state.best_epoch, self.state.stale = score, state.epoch, 0
            self._keep(row, better)
            left = clock.left(state.epoch + 1)
            self.say(
                f"epoch {state.epoch + 1}/{schedule.epochs} loss {row['train/loss']:.3f} {self.job.line(row)}"
                f"{' *' if better else ''} {row['rooms_per_second']:.0f} rooms/s, {left} left"
            )
        if self.log is not None:
            self.log.close()
            self.job.export_best(schedule.folder / "best")
        return {name: value for name, value in best.items() if isinstance(value, float)}

    def _enough(self) -> bool:
        """Has nothing become better for long, or is nothing left to learn?"""
        schedule, state = self.schedule, self.state
        return bool(schedule.patience and state.stale >= schedule.patience) or state.best >= schedule.perfect

    def _epoch(self) -> dict[str, Any]:
        """The steps of an epoch that are left."""
        began, waited, sizes, state = time.perf_counter(), 0.0, 0, self.state
        batches = self.job.batches(state)
        while True:
            before = time.perf_counter()
            batch = next(batches, None)
            waited += time.perf_counter() - before
            if batch is None:
                break
            for name, value in self.job.step(batch, state).items():
                state.sums[name] = state.sums.get(name, 0.0) + value
            sizes += self.job.size(batch)
            state.step += 1
            if state.step % STEPS_BETWEEN_CHECKS == 0 or self.stop:
                self._read_losses()
            if self.stop:
                batches.close()
                self._save()
                raise KeyboardInterrupt
        self._read_losses()
        took = max(time.perf_counter() - began, 1e-9)
        row = {"epoch": state.epoch, "seconds": took, "rooms_per_second": self.job.total(sizes) / took, "waiting": waited / took}
        return row | {f"train/{name}": value / self.schedule.steps for name, value in state.sums.items()}

    def _read_losses(self) -> None:
        """Turn sums of losses that are on a device into numbers.

        Raises:
            InputError: the training diverged.
        """
        state = self.state
        state.sums = {name: float(value) for name, value in state.sums.items()}
        if not all(math.isfinite(state.sums.get(name, 0.0)) for name in ("loss", "norm")):
            raise build_diverged(state)

    def _keep(self, row: dict[str, Any], better: bool) -> None:
        """Write metrics, the best network and the state after an epoch."""
        if self.log is None:
            return
        self.log.row(row)
        if better:
            self.job.write_best(self.schedule.folder / "best", row, self.log)
        self._save()

    def _save(self) -> None:
        """Write the state as it is."""
        if self.log is not None:
            optimizer = self.job.optimizer_state()
            save_state(self.schedule.folder / "last", self.job.write_network, optimizer, vars(self.state))

    @contextmanager
    def _interrupts(self) -> Iterator[None]:
        """Ctrl-C and SIGTERM let the step end and save; a second one ends at once."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return

        def stop(number: int, _: object) -> None:
            if self.stop:
                raise KeyboardInterrupt
            self.stop = True
            self.say("saving, then ending")

        before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


def build_diverged(state: State) -> InputError:
    """What is raised where a loss or its gradient is no finite number."""
    where = f"step {state.step + 1} of epoch {state.epoch + 1}"
    return InputError(f"training diverged by {where}: a loss or gradient is no finite number; train anew with a lower rate")


def group_parameters(network: torch.nn.Module, decay: float) -> list[dict[str, Any]]:
    """Weights that are trained, for an optimizer: those of layers decay; biases, gains of norms and lone numbers, such as a
    temperature, do not."""
    trained = [p for p in network.parameters() if p.requires_grad]
    layers, others = [p for p in trained if p.ndim > 1], [p for p in trained if p.ndim < 2]
    return [{"params": of, "weight_decay": by} for of, by in ((layers, decay), (others, 0.0)) if of]


def descend_gradient(optimizer: torch.optim.Optimizer, loss: torch.Tensor, state: State) -> dict[str, float]:
    """Take one step of an optimizer down the gradient of a loss; return the loss and the gradient's length.

    Raises:
        InputError: one of them is no finite number; the weights are as they were.
    """
    optimizer.zero_grad()
    loss.backward()  # type: ignore[no-untyped-call]
    gradients = [p.grad for group in optimizer.param_groups for p in group["params"] if p.grad is not None]
    values = {"loss": float(loss.detach()), "norm": float(torch.nn.utils.get_total_norm(gradients))}
    if not all(map(math.isfinite, values.values())):
        raise build_diverged(state)
    optimizer.step()
    return values


def made_beside(batches: Iterator[T]) -> Generator[T, None, None]:
    """The same batches, each made by a thread while the one before it is worked on."""
    with ThreadPoolExecutor(1) as beside:
        coming = beside.submit(next, batches, None)
        while (batch := coming.result()) is not None:
            coming = beside.submit(next, batches, None)
            yield batch


def made_by_threads(make: Callable[[K], T], keys: Iterable[K], threads: int) -> Generator[T, None, None]:
    """What is made of each key, in their order; so many threads are one piece each ahead of what is worked on."""
    with ThreadPoolExecutor(threads) as pool:
        coming: deque[Future[T]] = deque()
        for key in keys:
            coming.append(pool.submit(make, key))
            if len(coming) > threads:
                yield coming.popleft().result()
        while coming:
            yield coming.popleft().result()


def pace(done: float, warmup: float) -> float:
    """Share of the learning rate after this share of all steps: a rise, then half a cosine down to 0."""
    if done < warmup:
        return (done + 1e-3) / (warmup + 1e-3)
    return 0.5 * (1 + math.cos(math.pi * (done - warmup) / (1 - warmup)))


def mixed(*numbers: int) -> int:
    """A seed out of several numbers."""
    return int.from_bytes(hashlib.sha256(json.dumps(numbers).encode()).digest()[:7])
