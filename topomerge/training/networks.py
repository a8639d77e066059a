"""What tasks that train a network on one machine share: a run from its data to its export, in the loop of `training.loop`."""

from __future__ import annotations

import json
import shutil
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import torch

from topomerge.checkpoint import NETWORK_FILE, load_state, read_network, write_network
from topomerge.models.export import check_exporter, export_network, run_with_torch
from topomerge.networks.network import Run
from topomerge.networks.signature import Signature
from topomerge.training.log import Log
from topomerge.training.loop import Job, Loop, Say, Schedule, State, descend_gradient, group_parameters, pace
from topomerge.training.run_folder import begin_run, export_files, write_card
from topomerge.training.shared_settings import NetworkTask
from topomerge.training.tasks import TASKS, check_accelerator

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
        self.device = device_of(settings)
        self.settings, self.network, self.origin = settings, network.to(self.device), origin
        self.optimizer = torch.optim.AdamW(group_parameters(network, settings.decay), lr=settings.rate)

    def total(self, sizes: int) -> float:
        """Of the one process."""
        return float(sizes)

    def optimizer_state(self) -> torch.optim.Optimizer:
        """The optimizer."""
        return self.optimizer

    def write_network(self, folder: Path) -> None:
        """The weights as torch has them."""
        write_network(self.network, folder)

    def there(self, batch: tuple[torch.Tensor, ...]) -> tuple[torch.Tensor, ...]:
        """A batch where the network is."""
        return tuple(tensor.to(self.device, non_blocking=True) for tensor in batch)

    def descend(self, loss: torch.Tensor, options: Any, state: State) -> dict[str, float]:
        """One step of the optimizer at the rate of its place in the run: it rises over `options.warmup` steps, then falls."""
        total, done = options.epochs * options.steps, state.epoch * options.steps + state.step
        for group in self.optimizer.param_groups:
            group["lr"] = options.rate * max(pace(done / total, min(options.warmup / total, 0.5)), 0.01)
        return descend_gradient(self.optimizer, loss, state)

    @abstractmethod
    def write_weights(self, path: Path) -> None:
        """Write the weights as the package has them."""

    def interface(self) -> dict[str, Any]:
        """What a card says of inputs and outputs; nothing of weights that are no network of `topomerge.networks`."""
        return {}

    def write_best(self, folder: Path, row: Mapping[str, Any], log: Log) -> None:
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

    def line(self, row: Mapping[str, Any]) -> str:
        """The score that is watched."""
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


def device_of(settings: NetworkTask) -> torch.device:
    """Where the network of a task runs.

    Raises:
        InputError: torch finds no such device here.
    """
    check_accelerator(settings)
    return torch.device(getattr(settings, "accelerator", "cpu"))


def run_network(job: Job, settings: NetworkTask, steps: int, say: Say) -> dict[str, float]:
    """Train a job of a task, and leave a run's folder.

    Returns:
        The row of the best epoch.
    """
    check_exporter()
    state = State()
    if settings.resume:
        state = State(**load_state(settings.folder / "last", job.network, job.optimizer_state(), NETWORK_FILE))
    device = str(next(job.network.parameters()).device)
    begin_run(settings, torch.cuda.get_device_name() if device.startswith("cuda") else device, torch.get_num_threads())
    log = Log(settings.folder, settings.tensorboard, state.epoch)
    schedule = Schedule(settings.folder, settings.epochs, steps, settings.watch, settings.patience)
    best = Loop(job, schedule, state, log, say).run()
    if settings.export:
        export_files(settings.folder / "best", settings.export, TASKS[settings.task].package)
    return best
