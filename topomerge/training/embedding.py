"""Task `embedding`: the network that gives each room of a map a row of numbers, so that two views of one room get close ones.

The loop is `training.loop`; several processes share its steps by fabric.
"""

from __future__ import annotations

import hashlib
import logging
import os
import sys
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from topomerge.checkpoint import load_state
from topomerge.errors import InputError
from topomerge.models.embedder import Embedder
from topomerge.models.losses import Objective
from topomerge.models.weights import read_embedder, save_embedder
from topomerge.training.batches import ChangedPairs, MapPair
from topomerge.training.device_batches import DevicePairs, supports_device_batches
from topomerge.training.embedding_pictures import show_embedder
from topomerge.training.log import Log
from topomerge.training.loop import Loop, Schedule, State, made_by_threads, mixed, pace
from topomerge.training.packed import EXTRAS, GraphPair, load_pairs
from topomerge.training.run_folder import export_files, write_settings
from topomerge.training.settings import VALIDATION, Augment, Training, check, to_dict
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
    fabric = start_fabric(settings)
    chief = fabric.is_global_zero
    say = say if chief else lambda text: None
    settings = with_own_pairs(settings, say, fabric)
    train, watched = _data(settings, say, fabric)
    network = _network(settings, train)
    trained = [p for p in network.parameters() if p.requires_grad]
    fused = fabric.device.type == "cuda"  # one launch for all weights
    optimizer = torch.optim.AdamW(trained, settings.rate, weight_decay=settings.decay, fused=fused)
    state = State()
    if settings.resume:
        state = State(**load_state(settings.folder / "last", network, optimizer))
    elif chief:
        write_settings(settings.folder, to_dict(settings))
    fabric.barrier()
    job = EmbeddingJob(settings, fabric, network, optimizer, (train, watched))
    log = Log(settings.folder, settings.tensorboard, state.epoch) if chief else None
    perfect = 1.0 if settings.overfit else float("inf")
    schedule = Schedule(settings.folder, settings.epochs, job.steps, settings.watch, settings.patience, perfect)
    best = Loop(job, schedule, state, log, say).run()
    if settings.export and chief:
        export_files(settings.folder / "best", settings.export, "topomerge.embedding.pretrained")
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
        self.objective, self.optimizer = fabric.setup(Objective(network, settings.loss), optimizer)
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
        """Take one step of the optimizer; return the losses, which may still be under way on the device."""
        settings, done = self.settings, state.epoch * self.steps + state.step
        for group in self.optimizer.param_groups:
            group["lr"] = settings.rate * pace(done / (settings.epochs * self.steps), settings.warmup)
        torch.manual_seed(mixed(settings.seed, state.epoch, state.step, self.fabric.global_rank, 1))  # of the dropout
        batch = batch.to(self.fabric.device)
        losses = self.objective(batch.tensors, batch.truth)
        self.optimizer.zero_grad()
        self.fabric.backward(losses["loss"])
        self.fabric.clip_gradients(self.objective, self.optimizer, max_norm=settings.clip)
        self.optimizer.step()
        return {name: value.detach() for name, value in losses.items()}

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
        """The embedder's two files."""
        save_embedder(self.network, folder, about(self.settings, {}))

    def write_best(self, folder: Path, row: Mapping[str, Any], log: Log) -> None:
        """The embedder's two files, and pictures of what it does."""
        save_embedder(self.network, folder, about(self.settings, row))
        show_embedder(log.board, self.network, self.watched, row["epoch"], row["val/least"], self.fabric.device)

    def line(self, row: Mapping[str, Any]) -> str:
        """The scores that tell most."""
        scores = [row[f"val/{name}"] for name in ("recall@1", "recall@5", "f1", "merged")]
        return "recall@1 {:.3f} @5 {:.3f} F1 {:.3f} merged {:.2f}".format(*scores)


def about(settings: Training, row: Mapping[str, Any]) -> dict[str, Any]:
    """What an embedder's file says about its training."""
    origin = {"data": settings.data, "validation": settings.validation, "seed": settings.seed, "loss": settings.loss.kind}
    return {"run": settings.name, **origin, **{k: round(v, 5) if isinstance(v, float) else v for k, v in row.items()}}


def start_fabric(settings: Training) -> Any:
    """Return the Fabric of a training: its device, its precision and its processes."""
    from lightning_fabric import Fabric

    logging.getLogger("lightning_fabric").setLevel(logging.WARNING)
    devices = int(os.environ.get("LOCAL_WORLD_SIZE", settings.devices))
    precision = settings.precision
    if precision == "auto":
        on_cuda = settings.accelerator in ("cuda", "gpu", "auto") and torch.cuda.is_available()
        precision = "bf16-mixed" if on_cuda else "32-true"
    fabric = Fabric(
        accelerator=settings.accelerator, devices=devices, precision=precision,  # type: ignore[arg-type]
        strategy="ddp" if devices > 1 else "auto",
    )  # fmt: skip
    fabric.launch()
    return fabric


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


def hold_out(pairs: Sequence[GraphPair]) -> tuple[list[GraphPair], list[GraphPair]]:
    """A tenth of the pairs, by whole buildings in the order of a hash of their names, is kept from training; at least one of
    them has rooms that match.

    Raises:
        InputError: no pair has any, or all that have are of one building.
    """
    buildings = [str(p.about.get("building")) for p in pairs]
    held: set[str] = set()
    for name in sorted(set(buildings), key=lambda name: hashlib.sha256(name.encode()).digest()):
        watched = [p for p, of in zip(pairs, buildings, strict=True) if of in held]
        if 10 * len(watched) >= len(pairs) and any(len(p.matches) for p in watched):
            break
        held.add(name)
    parts = tuple([p for p, of in zip(pairs, buildings, strict=True) if (of in held) is which] for which in (False, True))
    if not all(any(len(p.matches) for p in part) for part in parts):
        raise InputError("too few pairs whose rooms match, to train on some buildings and watch others; make more of them")
    return parts[0], parts[1]


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
