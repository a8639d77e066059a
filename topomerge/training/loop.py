"""The loop that every network is trained by, and what tasks share around it."""

from __future__ import annotations

import hashlib
import inspect
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
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeVar

import torch

from topomerge.checkpoint import NETWORK_FILE, load_state, read_network, save_state, write_network
from topomerge.errors import InputError
from topomerge.models.export import check_exporter, export_network, run_with_torch
from topomerge.networks.network import Run, Signature
from topomerge.registry import OPTIMIZERS, SCHEDULES, TASKS
from topomerge.training.run_folder import EtaClock, MetricsLog, begin_run, export_files, write_card
from topomerge.training.settings import NetworkTask
from topomerge.training.tasks import check_accelerator
from topomerge.types import LogFn

STEPS_BETWEEN_CHECKS = 20  # of whether the losses are finite: each waits for the device
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
    watch: score of validation by which an epoch is best; lower: less of it is better.
    patience: epochs without a better one after which it ends; 0: never.
    perfect: value of the score at which nothing is left to learn.
    """

    folder: Path
    epochs: int
    steps: int
    watch: str
    patience: int = 0
    perfect: float = math.inf
    lower: bool = False


class Job(Protocol):
    """What a task does in the loop."""

    @property
    def network(self) -> torch.nn.Module:
        """What is trained."""

    def iter_batches(self, state: State) -> Generator[Any, None, None]:
        """Yield the batches of the state's epoch, from its step on."""

    def train_step(self, batch: Any, state: State) -> Mapping[str, Any]:
        """One step of the optimizer; the losses, `loss` among them: numbers, or tensors of one that may be on a device."""

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

    def write_best(self, folder: Path, row: Mapping[str, Any], log: MetricsLog) -> None:
        """Write the best network so far into `best/`."""

    def export_best(self, folder: Path) -> None:
        """Make of `best/` what the package reads, once at the end of a run."""

    def format_scores(self, row: Mapping[str, Any]) -> str:
        """Format the scores for an epoch's line."""


class Loop:
    """A training under way.

    Args:
        log: None in all processes but the first.
    """

    def __init__(self, job: Job, schedule: Schedule, state: State, log: MetricsLog | None, log_line: LogFn) -> None:
        self.job, self.schedule, self.state, self.log, self.log_line = job, schedule, state, log, log_line
        self.stop = False

    def run(self) -> dict[str, float]:
        """Epochs until the last one, or until nothing has become better for long; the row of the best epoch.

        Raises:
            KeyboardInterrupt: after Ctrl-C or SIGTERM; the state is saved.
        """
        with self._handle_interrupts():
            return self._run_epochs()

    def _run_epochs(self) -> dict[str, float]:
        schedule, clock = self.schedule, EtaClock(self.state.epoch, self.schedule.epochs)
        best: dict[str, Any] = {}
        if self.log is not None and self.state.best_epoch >= 0:
            best = next((row for row in self.log.rows if row["epoch"] == self.state.best_epoch), {})
        while self.state.epoch < schedule.epochs and not self._is_converged():
            row = self._run_epoch()
            scores = self.job.compute_scores()
            row |= {f"val/{name}": value for name, value in scores.items()}
            state, score = self.state, -scores[schedule.watch] if schedule.lower else scores[schedule.watch]
            better = score > state.best or (state.best_epoch < 0 and math.isfinite(score))
            self.state = State(state.epoch + 1, 0, state.best, state.best_epoch, state.stale + 1)
            if better:
                best = row
                self.state.best, self.state.best_epoch, self.state.stale = score, state.epoch, 0
            self._keep(row, better)
            left = clock.format_time_left(state.epoch + 1)
            self.log_line(
                f"epoch {state.epoch + 1}/{schedule.epochs} loss {row['train/loss']:.3f} {self.job.format_scores(row)}"
                f"{' *' if better else ''} {row['rooms_per_second']:.0f} rooms/s, {left} left"
            )
        if self.log is not None:
            self.log.close()
            self.job.export_best(schedule.folder / "best")
        return {name: value for name, value in best.items() if isinstance(value, float)}

    def _is_converged(self) -> bool:
        """Has nothing become better for long, or is nothing left to learn?"""
        schedule, state = self.schedule, self.state
        return bool(schedule.patience and state.stale >= schedule.patience) or state.best >= schedule.perfect

    def _run_epoch(self) -> dict[str, Any]:
        """The steps of an epoch that are left."""
        began, waited, sizes, state = time.perf_counter(), 0.0, 0, self.state
        batches = self.job.iter_batches(state)
        while True:
            before = time.perf_counter()
            batch = next(batches, None)
            waited += time.perf_counter() - before
            if batch is None:
                break
            for name, value in self.job.train_step(batch, state).items():
                state.sums[name] = state.sums.get(name, 0.0) + value
            sizes += self.job.count_items(batch)
            state.step += 1
            if state.step % STEPS_BETWEEN_CHECKS == 0 or self.stop:
                self._read_losses()
            if self.stop:
                batches.close()
                self._save()
                raise KeyboardInterrupt
        self._read_losses()
        took = max(time.perf_counter() - began, 1e-9)
        row = {
            "epoch": state.epoch,
            "seconds": took,
            "rooms_per_second": self.job.sum_over_processes(sizes) / took,
            "waiting": waited / took,
        }
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
        self.log.append_row(row)
        if better:
            self.job.write_best(self.schedule.folder / "best", row, self.log)
        self._save()

    def _save(self) -> None:
        """Write the state as it is."""
        if self.log is not None:
            optimizer = self.job.get_optimizer()
            save_state(self.schedule.folder / "last", self.job.write_network, optimizer, vars(self.state))

    @contextmanager
    def _handle_interrupts(self) -> Iterator[None]:
        """Ctrl-C and SIGTERM let the step end and save; a second one ends at once."""
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
    """What is raised where a loss or its gradient is no finite number."""
    where = f"step {state.step + 1} of epoch {state.epoch + 1}"
    return InputError(f"training diverged by {where}: a loss or gradient is no finite number; train anew with a lower rate")


def group_parameters(network: torch.nn.Module, decay: float) -> list[dict[str, Any]]:
    """Weights that are trained, for an optimizer: those of layers decay; biases, gains of norms and lone numbers, such as a
    temperature, do not."""
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


def prefetch_batches(batches: Iterator[T]) -> Generator[T, None, None]:
    """Prefetch the same batches, each made by a thread while the one before it is worked on."""
    with ThreadPoolExecutor(1) as beside:
        coming = beside.submit(next, batches, None)
        while (batch := coming.result()) is not None:
            coming = beside.submit(next, batches, None)
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


def warmup_cosine(done: float, warmup: float) -> float:
    """Compute the factor of the learning rate after this share of all steps: a rise, then half a cosine down to 0."""
    if done < warmup:
        return (done + 1e-3) / (warmup + 1e-3)
    return 0.5 * (1 + math.cos(math.pi * (done - warmup) / (1 - warmup)))


def warmup_constant(done: float, warmup: float) -> float:
    """Compute the factor of the learning rate after this share of all steps: a rise, then 1."""
    return min((done + 1e-3) / (warmup + 1e-3), 1.0)


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
    """A job without processes beside it; a task adds batches, steps, scores and what is exported."""

    def __init__(self, settings: NetworkTask, network: torch.nn.Module, origin: Mapping[str, Any]) -> None:
        self.device = select_device(settings)
        self.settings, self.network, self.origin = settings, network.to(self.device), origin
        self.optimizer = build_optimizer(settings, network)

    def sum_over_processes(self, sizes: int) -> float:
        """Return the size of the one process."""
        return float(sizes)

    def get_optimizer(self) -> torch.optim.Optimizer:
        """Return the optimizer."""
        return self.optimizer

    def write_network(self, folder: Path) -> None:
        """Write the weights as torch has them."""
        write_network(self.network, folder)

    def move_to_device(self, batch: tuple[torch.Tensor, ...]) -> tuple[torch.Tensor, ...]:
        """Move a batch to the device of the network."""
        return tuple(tensor.to(self.device, non_blocking=True) for tensor in batch)

    def optimize(self, loss: torch.Tensor, options: Any, state: State) -> dict[str, float]:
        """One step of the optimizer at the rate of its place in the run: it rises over `options.warmup` steps, then falls."""
        total, done = options.epochs * options.steps, state.epoch * options.steps + state.step
        for group in self.optimizer.param_groups:
            factor = SCHEDULES[self.settings.schedule](done / total, min(options.warmup / total, 0.5))
            group["lr"] = options.rate * max(factor, 0.01)
        return descend_gradient(self.optimizer, loss, state)

    @abstractmethod
    def write_weights(self, path: Path) -> None:
        """Write the weights as the package has them."""

    def interface(self) -> dict[str, Any]:
        """What a card says of inputs and outputs; nothing of weights that are no network of `topomerge.networks`."""
        return {}

    def write_best(self, folder: Path, row: Mapping[str, Any], log: MetricsLog) -> None:
        """The weights as torch has them, and their scores; what was exported of earlier ones goes."""
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        metrics = {k: v for k, v in row.items() if k.startswith("val/")}
        (folder / METRICS_FILE).write_text(json.dumps(metrics) + "\n", encoding="utf-8")
        write_network(self.network, folder)

    def export_best(self, folder: Path) -> None:
        """Write the file of weights and its card, in the place of what `write_best` wrote."""
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
        """The network as the package runs it."""

    def run(self) -> Run:
        """The network as it is, for those who call what is exported."""
        module, signature, _ = self.exported()
        return run_with_torch(module, signature)

    def write_weights(self, path: Path) -> None:
        """Write the weights as the package has them."""
        module, signature, sample = self.exported()
        export_network(module, signature, [tensor.to(self.device) for tensor in sample], path)

    def interface(self) -> dict[str, Any]:
        """What it does, inputs and outputs."""
        return self.exported().signature.describe()


def select_device(settings: NetworkTask) -> torch.device:
    """Select the device of a task's network.

    Raises:
        InputError: torch finds no such device here.
    """
    check_accelerator(settings)
    return torch.device(getattr(settings, "accelerator", "cpu"))


def run_network(job: Job, settings: NetworkTask, steps: int, log_line: LogFn) -> dict[str, float]:
    """Train a job of a task, and leave a run's folder.

    Returns:
        The row of the best epoch.
    """
    check_exporter()
    state = State()
    if settings.resume:
        state = State(**load_state(settings.folder / "last", job.network, job.get_optimizer(), NETWORK_FILE))
    device = str(next(job.network.parameters()).device)
    begin_run(settings, torch.cuda.get_device_name() if device.startswith("cuda") else device, torch.get_num_threads())
    log = MetricsLog(settings.folder, settings.tensorboard, state.epoch)
    task = TASKS[settings.task]
    lower = settings.watch in task.lower
    schedule = Schedule(settings.folder, settings.epochs, steps, settings.watch, settings.patience, lower=lower)
    best = Loop(job, schedule, state, log, log_line).run()
    if settings.export:
        export_files(settings.folder / "best", settings.export, task.package)
    return best
