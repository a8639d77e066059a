"""The loop that every network is trained by, and what tasks share around it."""

from __future__ import annotations

import hashlib
import json
import math
import shutil
import signal
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np
import torch

from topomerge.checkpoint import NETWORK_FILE, find_state_folder, load_state, read_network, save_state, write_network
from topomerge.errors import InputError
from topomerge.models.export import check_exporter, export_network, run_with_torch
from topomerge.networks.network import Run, Signature
from topomerge.registry import SCHEDULES, TASKS
from topomerge.training.compilation import choose_step_context
from topomerge.training.descent import build_optimizer
from topomerge.training.instruments import (
    AVERAGE_FILE,
    REPORT,
    TOP,
    TRACE_FILE,
    StepTracer,
    WeightAverage,
    name_top,
    rank_epochs,
    tidy_top,
)
from topomerge.training.processes import average_buffers, average_gradients, get_rank, start_fabric
from topomerge.training.run_folder import EtaClock, MetricsLog, begin_run, export_files, write_card
from topomerge.training.settings import NetworkSettings, NetworkTask
from topomerge.training.starts import start_from_exported
from topomerge.training.tasks import check_accelerator
from topomerge.types import LogFn

STEPS_BETWEEN_CHECKS = 20  # of whether the losses are finite: each waits for the device
T = TypeVar("T")
K = TypeVar("K")


@dataclass
class State:
    """Where a training is.

    Args:
        epoch, step: that come next; rate: of the last step.
        best, best_epoch: score of the best epoch so far; stale: epochs since.
        top: of the best epochs, [score, epoch].
        sums: of the losses of the epoch so far.
        scaler: state of the scaler of half precision, where there is one.
    """

    epoch: int = 0
    step: int = 0
    rate: float = 0.0
    best: float = -1.0
    best_epoch: int = -1
    stale: int = 0
    top: list[list[float]] = field(default_factory=list)
    sums: dict[str, float] = field(default_factory=dict)
    scaler: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Schedule:
    """Steps of a run, and the score by which it is watched.

    Args:
        settings: of the run; steps: of each epoch.
        perfect: value of the score at which nothing is left to learn; lower: less of the score is better.
    """

    settings: NetworkSettings
    steps: int
    perfect: float = math.inf
    lower: bool = False


class Job(Protocol):
    """The job of a task, as the loop runs it."""

    unit: str  # what `count_items` counts, for messages

    @property
    def network(self) -> torch.nn.Module:
        """Return the network that is trained."""

    def iter_batches(self, state: State) -> Generator[Any, None, None]:
        """Yield the batches of the state's epoch, from its step on."""

    def train_step(self, batch: Any, state: State) -> Mapping[str, Any]:
        """Return one step of the optimizer; the losses, `loss` among them: numbers, or tensors of one that may be on a device."""

    def count_items(self, batch: Any) -> int:
        """Count the rooms, columns or examples of a batch."""

    def sum_over_processes(self, sizes: int) -> float:
        """Return the sum of sizes over all processes."""

    def compute_scores(self) -> dict[str, float]:
        """Compute the validation scores."""

    def get_optimizer(self) -> torch.optim.Optimizer:
        """Return the optimizer whose state is kept."""

    def write_network(self, folder: Path) -> None:
        """Write the network's files of `last/`."""

    def get_scaler(self) -> Any:
        """Return the scaler of half precision; None where there is none."""

    def write_checkpoint(self, folder: Path, row: Mapping[str, Any]) -> None:
        """Write the network as it is, with its scores, into a folder, in the place of what stands there."""

    def show_best(self, row: Mapping[str, Any], log: MetricsLog) -> None:
        """Show what the best network so far does."""

    def export_best(self, folder: Path) -> None:
        """Make of a checkpoint what the package reads, once at the end of a run."""

    def format_scores(self, row: Mapping[str, Any]) -> str:
        """Format the scores for an epoch's line."""


class Loop:
    """A training under way.

    Args:
        log: None in all processes but the first.
    """

    def __init__(self, job: Job, schedule: Schedule, state: State, log: MetricsLog | None, log_line: LogFn) -> None:
        self.job, self.schedule, self.state, self.log, self.log_line = job, schedule, state, log, log_line
        self.settings, self.stop = schedule.settings, False
        self.average = WeightAverage(job.network, self.settings.ema) if self.settings.ema else None
        if self.average is not None and self.settings.resume:
            self.average.load(find_state_folder(self.settings.folder / "last") / AVERAGE_FILE)
        if state.scaler:
            job.get_scaler().load_state_dict(state.scaler)
        self.step_context = choose_step_context(self.settings, job.network)
        self.traces = self.settings.profile and log is not None

    def run(self) -> dict[str, float]:
        """Run epochs until the last one, or until nothing has become better for long; return the row of the best epoch.

        Raises:
            KeyboardInterrupt: after Ctrl-C or SIGTERM; the state is saved.
        """
        ended = "aborted"
        try:
            with self._handle_interrupts():
                best = self._run_epochs()
            ended = "success"
        finally:
            if self.log is not None:
                self.log.close(ended)
        return best

    def _run_epochs(self) -> dict[str, float]:
        settings, clock = self.settings, EtaClock(self.state.epoch, self.settings.epochs)
        best: dict[str, Any] = {}
        if self.log is not None and self.state.best_epoch >= 0:
            best = next((row for row in self.log.rows if row["epoch"] == self.state.best_epoch), {})
        while self.state.epoch < settings.epochs and not self._is_converged():
            row = self._run_epoch()
            average_buffers(self.job.network)
            with nullcontext() if self.average is None else self.average.apply():
                better = self._judge_epoch(row)
            self._save()
            if better:
                best = row
            left = clock.format_time_left(self.state.epoch)
            self.log_line(
                f"epoch {self.state.epoch}/{settings.epochs} loss {row['train/loss']:.3f} {self.job.format_scores(row)}"
                f"{' *' if better else ''} {row['rooms_per_second']:.0f} {self.job.unit}/s, {left} left"
            )
            if self.log is not None and (report := REPORT.get()) is not None:
                report(row)
        if self.log is not None:
            for folder in (settings.folder / "best", *sorted((settings.folder / TOP).glob("epoch_*"))):
                self.job.export_best(folder)
        return {name: value for name, value in best.items() if isinstance(value, float)}

    def _judge_epoch(self, row: dict[str, Any]) -> bool:
        """Add the scores of validation to an epoch's row, keep it and the network; whether it is the best epoch so far."""
        scores = self.job.compute_scores()
        row |= {f"val/{name}": value for name, value in scores.items()}
        state, watched = self.state, scores[self.settings.watch]
        score = -watched if self.schedule.lower else watched
        better = score > state.best or (state.best_epoch < 0 and math.isfinite(score))
        best = (score, state.epoch, 0) if better else (state.best, state.best_epoch, state.stale + 1)
        top = rank_epochs(state.top, score, state.epoch, self.settings.top) if self.settings.top > 1 else []
        self.state = State(state.epoch + 1, 0, state.rate, *best, top)
        if self.log is not None:
            folder = self.settings.folder
            self.log.append_row(row)
            if better:
                self.job.write_checkpoint(folder / "best", row)
                self.job.show_best(row, self.log)
            if any(epoch == state.epoch for _, epoch in top):
                self.job.write_checkpoint(name_top(folder, state.epoch), row)
            tidy_top(folder, top)
        return better

    def _is_converged(self) -> bool:
        """Return whether nothing has become better for long, or nothing is left to learn."""
        patience, state = self.settings.patience, self.state
        return bool(patience and state.stale >= patience) or state.best >= self.schedule.perfect

    def _run_epoch(self) -> dict[str, Any]:
        """Run the steps of an epoch that are left."""
        began, waited, sizes, state = time.perf_counter(), 0.0, 0, self.state
        batches = self.job.iter_batches(state)
        tracer = StepTracer(self.settings.folder / TRACE_FILE, self.schedule.steps - state.step) if self.traces else None
        self.traces = False  # of the first epoch only
        while True:
            before = time.perf_counter()
            batch = next(batches, None)
            waited += time.perf_counter() - before
            if batch is None:
                break
            if tracer is not None:
                tracer.begin_step()
            self._take_step(batch)
            sizes += self.job.count_items(batch)
            if self.stop:
                batches.close()
                self._save()
                raise KeyboardInterrupt
        self._read_losses()
        if tracer is not None:
            tracer.close()
            self.log_line(f"{tracer.path}: a trace of some steps; open it in ui.perfetto.dev")
        took = max(time.perf_counter() - began, 1e-9)
        row = {
            "epoch": state.epoch,
            "seconds": took,
            "rooms_per_second": self.job.sum_over_processes(sizes) / took,
            "waiting": waited / took,
            "train/rate": state.rate,
        }
        return row | {f"train/{name}": value / self.schedule.steps for name, value in state.sums.items()}

    def _take_step(self, batch: Any) -> None:
        """Train on a batch, and count it."""
        state = self.state
        with self.step_context():
            losses = self.job.train_step(batch, state)
        for name, value in losses.items():
            state.sums[name] = state.sums.get(name, 0.0) + value
        if self.average is not None:
            self.average.update(state.epoch * self.schedule.steps + state.step)
        state.step, rate = state.step + 1, self.job.get_optimizer().param_groups[0]["lr"]
        if not isinstance(rate, torch.Tensor):  # else on the device, and the job sets the state's
            state.rate = float(rate)
        if state.step % STEPS_BETWEEN_CHECKS == 0 or self.stop:
            self._read_losses()

    def _read_losses(self) -> None:
        """Turn sums of losses that are on a device into numbers.

        Raises:
            InputError: the training diverged.
        """
        state = self.state
        state.sums = {name: float(value) for name, value in state.sums.items()}
        if not all(math.isfinite(state.sums.get(name, 0.0)) for name in ("loss", "norm")):
            raise build_diverged(state)

    def _save(self) -> None:
        """Write the state as it is."""
        if self.log is None:
            return
        scaler = self.job.get_scaler()
        self.state.scaler = {} if scaler is None else scaler.state_dict()
        tensors = {} if self.average is None else {AVERAGE_FILE: self.average.kept}
        job = self.job
        save_state(self.settings.folder / "last", job.write_network, job.get_optimizer(), vars(self.state), tensors)

    @contextmanager
    def _handle_interrupts(self) -> Iterator[None]:
        """Let the step end and save at Ctrl-C and SIGTERM; a second one ends at once."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return

        def stop(number: int, _: object) -> None:
            if self.stop:
                raise KeyboardInterrupt
            self.stop = True
            self.log_line("saving, then ending")

        before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


def build_diverged(state: State) -> InputError:
    """Build the error for a loss or gradient that is no finite number."""
    where = f"step {state.step + 1} of epoch {state.epoch + 1}"
    return InputError(f"training diverged by {where}: a loss or gradient is no finite number; train anew with a lower rate")


def descend_gradient(optimizer: torch.optim.Optimizer, loss: torch.Tensor, state: State) -> dict[str, float]:
    """Take one step of an optimizer down the gradient of a loss, its mean over all processes; return the loss and the gradient's
    length.

    Raises:
        InputError: one of them is no finite number; the weights are as they were.
    """
    optimizer.zero_grad()
    loss.backward()  # type: ignore[no-untyped-call]
    weights = [p for group in optimizer.param_groups for p in group["params"]]
    average_gradients(weights)
    gradients = [p.grad for p in weights if p.grad is not None]
    values = {"loss": float(loss.detach()), "norm": float(torch.nn.utils.get_total_norm(gradients))}
    if not all(map(math.isfinite, values.values())):
        raise build_diverged(state)
    optimizer.step()
    return values


def prefetch_batches(batches: Iterator[T]) -> Generator[T, None, None]:
    """Prefetch the same batches, each made by a thread while the one before it is worked on."""
    with ThreadPoolExecutor(1) as temporary:
        coming = temporary.submit(next, batches, None)
        while (batch := coming.result()) is not None:
            coming = temporary.submit(next, batches, None)
            yield batch


def prefetch_by_threads(make: Callable[[K], T], keys: Iterable[K], threads: int) -> Generator[T, None, None]:
    """Yield what is made of each key, in their order; threads prefetch one piece each."""
    with ThreadPoolExecutor(threads) as pool:
        coming: deque[Future[T]] = deque()
        for key in keys:
            coming.append(pool.submit(make, key))
            if len(coming) > threads:
                yield coming.popleft().result()
        while coming:
            yield coming.popleft().result()


def derive_seed(*numbers: int) -> int:
    """Derive a seed from several numbers."""
    return int.from_bytes(hashlib.sha256(json.dumps(numbers).encode()).digest()[:7])


METRICS_FILE = "metrics.json"  # of the best network, beside its weights while the run goes on


class Exported(NamedTuple):
    """A network as the package runs it.

    Args:
        sample: inputs that it is exported with.
    """

    module: torch.nn.Module
    signature: Signature
    sample: Sequence[torch.Tensor]


class NetworkJob(ABC):
    """A job of a task; the task adds batches, steps, scores and what is exported. Processes beside it make other batches."""

    unit = "examples"

    def __init__(self, settings: NetworkTask, network: torch.nn.Module, origin: Mapping[str, Any]) -> None:
        check_accelerator(settings)
        self.fabric = start_fabric(settings)
        self.device: torch.device = self.fabric.device
        self.settings, self.network, self.origin = settings, network.to(self.device), origin
        self.optimizer = build_optimizer(settings, network)

    def sum_over_processes(self, sizes: int) -> float:
        """Sum the sizes of all processes."""
        return float(self.fabric.all_reduce(torch.tensor(float(sizes), device=self.device), reduce_op="sum"))

    def start_generator(self, *numbers: int) -> np.random.Generator:
        """Return random numbers by the run's seed and some numbers, others in each process."""
        rank = [self.fabric.global_rank] if self.fabric.global_rank else []
        return np.random.default_rng([self.settings.seed, *numbers, *rank])

    def get_optimizer(self) -> torch.optim.Optimizer:
        """Return the optimizer."""
        return self.optimizer

    def get_scaler(self) -> Any:
        """Return none: tasks train in 32 bits."""
        return None

    def show_best(self, row: Mapping[str, Any], log: MetricsLog) -> None:  # noqa: B027
        """Show nothing, unless a task does."""

    def write_network(self, folder: Path) -> None:
        """Write the weights as torch has them."""
        write_network(self.network, folder)

    def optimize(self, loss: torch.Tensor, options: Any, state: State) -> dict[str, float]:
        """Take a step of the optimizer at the rate of its place in the run: it rises over `options.warmup` steps, then falls."""
        total, done = options.epochs * options.steps, state.epoch * options.steps + state.step
        for group in self.optimizer.param_groups:
            factor = SCHEDULES[self.settings.schedule](done / total, min(options.warmup / total, 0.5))
            group["lr"] = options.rate * max(factor, 0.01)
        return descend_gradient(self.optimizer, loss, state)

    @abstractmethod
    def write_weights(self, path: Path) -> None:
        """Write the weights as the package has them."""

    def interface(self) -> dict[str, Any]:
        """Describe inputs and outputs for the card; nothing for weights that are no network of `topomerge.networks`."""
        return {}

    def write_checkpoint(self, folder: Path, row: Mapping[str, Any]) -> None:
        """Write the weights as torch has them, and their scores; what was exported of earlier ones goes."""
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        metrics = {k: v for k, v in row.items() if k.startswith("val/")}
        (folder / METRICS_FILE).write_text(json.dumps(metrics) + "\n", encoding="utf-8")
        write_network(self.network, folder)

    def export_best(self, folder: Path) -> None:
        """Write the file of weights and its card, in the place of what `write_checkpoint` wrote."""
        if not (folder / NETWORK_FILE).exists():
            return
        read_network(self.network, folder)
        path = folder / TASKS[self.settings.task].file
        self.write_weights(path)
        metrics = json.loads((folder / METRICS_FILE).read_text(encoding="utf-8"))
        write_card(path, asdict(self.settings), self.origin, metrics, self.interface())
        for name in (NETWORK_FILE, METRICS_FILE):
            (folder / name).unlink()

    def format_scores(self, row: Mapping[str, Any]) -> str:
        """Format the monitored score."""
        return f"{self.settings.watch} {row[f'val/{self.settings.watch}']:.3f}"


class ExportedJob(NetworkJob):
    """A job whose network `topomerge.networks` runs."""

    @abstractmethod
    def exported(self) -> Exported:
        """Return the network as the package runs it."""

    def run(self) -> Run:
        """Return the network as it is, for those who call what is exported."""
        module, signature, _ = self.exported()
        return run_with_torch(module, signature)

    def write_weights(self, path: Path) -> None:
        """Write the weights as the package has them."""
        module, signature, sample = self.exported()
        export_network(module, signature, [tensor.to(self.device) for tensor in sample], path)

    def interface(self) -> dict[str, Any]:
        """Describe what the network does, its inputs and outputs."""
        return self.exported().signature.describe()


def run_network(job: Job, settings: NetworkTask, steps: int, log_line: LogFn) -> dict[str, float]:
    """Train a job of a task, leave a run's folder, and return the row of the best epoch."""
    check_exporter()
    state, is_main_process = State(), get_rank() == 0
    task = TASKS[settings.task]
    if settings.init_from and not settings.resume:
        start_from_exported(job, settings)
    if settings.resume:
        state = State(**load_state(settings.folder / "last", job.network, job.get_optimizer(), NETWORK_FILE))
    if is_main_process:
        device = str(next(job.network.parameters()).device)
        begin_run(settings, torch.cuda.get_device_name() if device.startswith("cuda") else device, torch.get_num_threads())
    log = MetricsLog(settings, state.epoch) if is_main_process else None
    schedule = Schedule(settings, steps, lower=settings.watch in task.lower)
    best = Loop(job, schedule, state, log, log_line).run()
    if settings.export and is_main_process:
        export_files(settings.folder / "best", settings.export, task.package)
    return best
