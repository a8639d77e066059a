"""Task `embedding`: the network that gives each room of a map a row of numbers, so that two views of one room get close ones.

The loop is `training.loop`; several processes share its steps by fabric.
"""

from __future__ import annotations

import logging
import os
import shutil
import sys
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from topomerge.checkpoint import load_state
from topomerge.embedding.weights import STATE_FILE, STATE_SETTINGS
from topomerge.errors import InputError
from topomerge.models.embedder import Embedder
from topomerge.models.export import check_exporter, export_embedder
from topomerge.models.losses import Objective
from topomerge.models.weights import read_embedder, read_state, save_state
from topomerge.networks.network import WEIGHTS_PACKAGE
from topomerge.training.batches import ChangedPairs, MapPair
from topomerge.training.device_batches import DevicePairs, supports_device_batches
from topomerge.training.embedding_pictures import show_embedder
from topomerge.training.log import Log
from topomerge.training.loop import Loop, Schedule, State, build_diverged, group_parameters, made_by_threads, mixed, pace
from topomerge.training.packed import EXTRAS, GraphPair, load_pairs
from topomerge.training.provenance import describe_provenance
from topomerge.training.run_folder import begin_run, export_files
from topomerge.training.settings import VALIDATION, Augment, Training, check, to_dict
from topomerge.training.splits import hold_out
from topomerge.training.tasks import check_start
from topomerge.training.validate import validate

Say = Callable[[str], None]


def fit(settings: Training, say: Say = lambda text: print(text, file=sys.stderr, flush=True)) -> dict[str, float]:
    """Train, and leave a run's folder: config.json, config.yaml, metrics.jsonl, best/, last/, tb/.

    Returns:
        The scores of the best epoch.

    Raises:
        InputError: settings that make no sense, data or a state that can't be read.
        KeyboardInterrupt: after Ctrl-C or SIGTERM; the state is saved.
    """
    if settings.overfit:
        settings = replace(settings, watch="f1", patience=0)
    check(settings)
    check_exporter()
    check_start(settings)  # before other processes, if any, have come so far
    fabric = start_fabric(settings)
    chief = fabric.is_global_zero
    say = say if chief else lambda text: None
    settings = with_own_pairs(settings, say, fabric)
    train, watched = _data(settings, say, fabric)
    network = _network(settings, train)
    fused = fabric.device.type == "cuda"  # one launch for all weights
    optimizer = torch.optim.AdamW(group_parameters(network, settings.decay), settings.rate, fused=fused)
    state = State()
    if settings.resume:
        state = State(**load_state(settings.folder / "last", network, optimizer))
    if chief:
        on_cuda = fabric.device.type == "cuda"
        name = torch.cuda.get_device_name() if on_cuda else "cpu"
        begin_run(settings, f"{fabric.world_size} x {name}, {find_precision(settings)}", torch.get_num_threads())
    fabric.barrier()
    job = EmbeddingJob(settings, fabric, network, optimizer, (train, watched))
    log = Log(settings.folder, settings.tensorboard, state.epoch) if chief else None
    perfect = 1.0 if settings.overfit else float("inf")
    schedule = Schedule(settings.folder, settings.epochs, job.steps, settings.watch, settings.patience, perfect)
    best = Loop(job, schedule, state, log, say).run()
    if settings.export and chief:
        export_files(settings.folder / "best", settings.export, WEIGHTS_PACKAGE)
    return best


class EmbeddingJob:
    """What the loop does for an embedder.

    Args:
        pairs: to train on, and to watch.
    """

    def __init__(
        self, settings: Training, fabric: Any, network: Embedder, optimizer: Any, pairs: tuple[Sequence[GraphPair], ...]
    ) -> None:
        self.settings, self.fabric, self.network = settings, fabric, network
        processes = FabricProcesses(fabric) if fabric.world_size > 1 else None
        self.objective, self.optimizer = fabric.setup(Objective(network, settings.loss, processes), optimizer)
        self.train, self.watched = pairs
        self.steps = max(len(self.train) // (settings.batch * fabric.world_size), 1)
        self.augment: Augment | None = None if settings.overfit else settings.augment
        self.pairs = self._load_pairs()

    def _load_pairs(self) -> ChangedPairs | DevicePairs:
        """Return the pairs that batches are made of, on the device or on the host, as `batches` says.

        Raises:
            InputError: batches cannot be made on the device.
        """
        wanted, names = self.settings.batches, self.network.tensors
        if wanted == "device" or (wanted == "auto" and self.fabric.device.type != "cpu"):
            if supports_device_batches(self.settings.network, names, self.augment):
                return DevicePairs(self.train, names, self.augment, self.fabric.device)
            if wanted == "device":
                raise InputError("batches=device: this network or augmentation needs batches=host")
        return ChangedPairs(self.train, names, self.augment, lambda pair: pair)

    def batches(self, state: State) -> Generator[MapPair, None, None]:
        """Those of the state's epoch from its step on, made by threads while the ones before are worked on."""
        self.objective.train()
        settings = self.settings
        shuffle = torch.Generator().manual_seed(mixed(settings.seed, state.epoch))
        order = torch.randperm(len(self.train), generator=shuffle).tolist()
        if settings.overfit:
            order = list(range(len(self.train)))
        rank, world, size = self.fabric.global_rank, self.fabric.world_size, settings.batch
        steps = [order[k * size * world :][: size * world][rank::world] for k in range(state.step, self.steps)]

        def seed_of(pair: int) -> int:
            return mixed(settings.seed, state.epoch, pair)

        if isinstance(self.pairs, DevicePairs):
            for numbers in steps:
                yield self.pairs.make_batch(numbers, seed_of)
            return
        pairs = ChangedPairs(self.train, self.network.tensors, self.augment, seed_of)
        yield from made_by_threads(pairs.batch, steps, settings.threads)

    def step(self, batch: MapPair, state: State) -> dict[str, torch.Tensor]:
        """Take one step of the optimizer; return the losses and the gradient's length, which may be under way on the device.

        A gradient that is no finite number does not reach the weights. Under a scaler of half precision the step is skipped and
        counted, and the scale lowered; otherwise the training ends, on a device when the loop next reads the losses.

        Raises:
            InputError: the training diverged.
        """
        settings, done = self.settings, state.epoch * self.steps + state.step
        for group in self.optimizer.param_groups:
            group["lr"] = settings.rate * pace(done / (settings.epochs * self.steps), settings.warmup)
        torch.manual_seed(mixed(settings.seed, state.epoch, state.step, self.fabric.global_rank, 1))  # of the dropout
        batch = batch.to(self.fabric.device)
        losses = self.objective(batch.tensors, batch.truth)
        self.optimizer.zero_grad()
        self.fabric.backward(losses["loss"])
        norm = self.fabric.clip_gradients(self.objective, self.optimizer, max_norm=settings.clip, error_if_nonfinite=False)
        lost = ~norm.isfinite()
        out = {name: value.detach() for name, value in losses.items()}
        if getattr(self.fabric.strategy.precision, "scaler", None) is not None:
            out |= {"norm": norm.masked_fill(lost, 0.0), "skipped": lost.float()}
        elif self.optimizer_state().defaults["fused"]:
            self.optimizer_state().found_inf, out["norm"] = lost.float(), norm  # type: ignore[attr-defined]
        elif lost:
            raise build_diverged(state)
        else:
            out["norm"] = norm
        self.optimizer.step()
        return out

    def size(self, batch: MapPair) -> int:
        """Rooms."""
        return sum(batch.rooms)

    def total(self, sizes: int) -> float:
        """Rooms of all processes."""
        return float(self.fabric.all_reduce(torch.tensor(float(sizes)), reduce_op="sum"))

    def scores(self) -> dict[str, float]:
        """Of the pairs watched (`validate`)."""
        return validate(self.network, self.watched, self.fabric.device)

    def optimizer_state(self) -> torch.optim.Optimizer:
        """The optimizer within fabric's."""
        optimizer: torch.optim.Optimizer = self.optimizer.optimizer
        return optimizer

    def write_network(self, folder: Path) -> None:
        """The embedder's state."""
        save_state(self.network, folder, about(self.settings, {}))

    def export_best(self, folder: Path) -> None:
        """Export the best embedder, in the place of its state."""
        if (folder / STATE_SETTINGS).exists():
            network, origin = read_state(folder)
            export_embedder(network, folder, origin)
            for name in (STATE_FILE, STATE_SETTINGS):
                (folder / name).unlink()

    def write_best(self, folder: Path, row: Mapping[str, Any], log: Log) -> None:
        """The embedder's state, and pictures of what it does; what was exported of an earlier one goes."""
        shutil.rmtree(folder, ignore_errors=True)
        save_state(self.network, folder, about(self.settings, row))
        show_embedder(log.board, self.network, self.watched, row["epoch"], row["val/least"], self.fabric.device)

    def line(self, row: Mapping[str, Any]) -> str:
        """The scores that tell most."""
        scores = [row[f"val/{name}"] for name in ("recall@1", "recall@5", "f1", "merged")]
        return "recall@1 {:.3f} @5 {:.3f} F1 {:.3f} merged {:.2f}".format(*scores)


class FabricProcesses:
    """The processes of a Fabric, as `models.losses.Processes`."""

    def __init__(self, fabric: Any) -> None:
        self.fabric = fabric

    def gather_others(self, rows: torch.Tensor) -> torch.Tensor:
        """Return the rows (M, ...) of all other processes; gradients flow back to where they come from."""
        counts = self.fabric.all_gather(torch.tensor(len(rows), device=rows.device)).tolist()
        padded = torch.cat([rows, rows.new_zeros((max(counts) - len(rows), *rows.shape[1:]))])
        every = self.fabric.all_gather(padded, sync_grads=rows.requires_grad)
        return torch.cat([every[k, :count] for k, count in enumerate(counts) if k != self.fabric.global_rank])

    def average(self, value: torch.Tensor) -> torch.Tensor:
        """Return the mean of a value over the processes, without a gradient."""
        mean: torch.Tensor = self.fabric.all_reduce(value.detach().clone(), reduce_op="mean")
        return mean


def about(settings: Training, row: Mapping[str, Any]) -> dict[str, Any]:
    """What an embedder's file says about its training."""
    origin = {"data": settings.data, "validation": settings.validation, "seed": settings.seed, "loss": settings.loss.kind}
    origin |= {"settings": to_dict(settings), "provenance": describe_provenance(settings.folder)}
    return {"run": settings.name, **origin, **{k: round(v, 5) if isinstance(v, float) else v for k, v in row.items()}}


def start_fabric(settings: Training) -> Any:
    """Return the Fabric of a training: its device, its precision and its processes."""
    from lightning_fabric import Fabric

    logging.getLogger("lightning_fabric").setLevel(logging.WARNING)
    devices = int(os.environ.get("LOCAL_WORLD_SIZE", settings.devices))
    fabric = Fabric(
        accelerator=settings.accelerator, devices=devices, precision=find_precision(settings),  # type: ignore[arg-type]
        strategy="ddp" if devices > 1 else "auto",
    )  # fmt: skip
    fabric.launch()
    return fabric


def find_precision(settings: Training) -> str:
    """Return the precision of a training: what is asked for, or what suits the accelerator."""
    on_cuda = settings.accelerator in ("cuda", "gpu", "auto") and torch.cuda.is_available()
    return ("bf16-mixed" if on_cuda else "32-true") if settings.precision == "auto" else settings.precision


def with_own_pairs(settings: Training, say: Say, fabric: Any) -> Training:
    """Name the sets of a folder of one's own captures, made by one process while the others wait.

    Raises:
        InputError: whatever is wrong with the folder.
    """
    if not settings.path:
        return settings
    from topomerge.datasets.pairs.own_pairs import build_own_sets

    with fabric.rank_zero_first():
        manifests = build_own_sets(settings.path, settings.cache, say=say).manifests
    watched = str(manifests["val"]) if settings.validation == VALIDATION else settings.validation
    return replace(settings, data=str(manifests["train"]), validation=watched)


def _data(settings: Training, say: Say, fabric: Any) -> tuple[list[GraphPair], list[GraphPair]]:
    """Pairs to train on, and to watch; a set is packed by one process while the others wait."""
    extras = [part for part in settings.network.geometry.parts if part in EXTRAS]
    extras += ["near"] if settings.network.node.near else []
    extras += ["sheet"] if settings.network.turns > 1 else []
    with fabric.rank_zero_first():
        around = settings.network.node.around
        train = load_pairs(_manifest(settings, settings.data), extras, say, settings.limit, around)
        watched = load_pairs(_manifest(settings, settings.validation), extras, say, around=around) if settings.validation else []
    if settings.overfit:
        matched = [pair for pair in train if len(pair.matches)][: settings.batch]
        return matched, matched
    if not watched:
        train, watched = hold_out(train)
    if not train:
        raise InputError(f"{settings.data}: no pairs to train on")
    return train, watched


def _manifest(settings: Training, name: str) -> Path:
    path = Path(name)
    return path if path.suffix in (".jsonl", ".npz") else Path(settings.cache) / f"{name}.jsonl"


def _network(settings: Training, train: Sequence[GraphPair]) -> Embedder:
    torch.manual_seed(mixed(settings.seed))
    wanted = replace(settings.network, dropout=0.0) if settings.overfit else settings.network
    network = Embedder(wanted)
    network.fit_scales([graph for pair in train for graph in (pair.a, pair.b)])
    if settings.geometry_from:
        other, _ = read_embedder(settings.geometry_from)
        try:
            network.geometry.load_state_dict(other.geometry.state_dict())
        except RuntimeError as error:
            raise InputError(f"geometry_from={settings.geometry_from}: has another geometry encoder") from error
    if settings.freeze == "geometry":
        network.geometry.requires_grad_(False)
    return network
