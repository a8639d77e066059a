"""The training loop: the same settings and seed give the same weights on a CPU, also where it was interrupted and resumed.

Nothing random depends on what came before it: every step draws from a generator seeded by the run's seed, the epoch, the step
and the process.
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch

from topomerge.checkpoint import load_state, save_state
from topomerge.errors import InputError
from topomerge.io.atomic import replacing
from topomerge.models.embedder import Embedder
from topomerge.models.losses import Objective
from topomerge.models.weights import read_embedder, save_embedder
from topomerge.training.batches import MapPair, make_batch
from topomerge.training.log import Clock, Log
from topomerge.training.packed import EXTRAS, GraphPair, load_pairs
from topomerge.training.settings import Augment, Training, check, to_dict
from topomerge.training.validate import validate

Say = Callable[[str], None]


@dataclass
class State:
    """Where a training is: `epoch` and `step` of it come next; `sums` are those of the losses of the epoch so far."""

    epoch: int = 0
    step: int = 0
    best: float = -1.0
    best_epoch: int = -1
    stale: int = 0
    sums: dict[str, float] = field(default_factory=dict)


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
    fabric = _fabric(settings)
    chief = fabric.is_global_zero
    say = say if chief else lambda text: None
    train, watched = _data(settings, say if chief else lambda text: None, fabric)
    network = _network(settings, train)
    trained = [p for p in network.parameters() if p.requires_grad]
    optimizer = torch.optim.AdamW(trained, settings.rate, weight_decay=settings.decay)
    state = State()
    if settings.resume:
        state = State(**load_state(settings.folder / "last", network, optimizer))
    elif chief:
        _write_settings(settings)
    fabric.barrier()
    objective, optimizer = fabric.setup(Objective(network, settings.loss), optimizer)
    run = Run(settings, fabric, objective, network, optimizer, train, watched, state, say)
    with _interrupts(run):
        return run.all()


class Run:
    """A training under way."""

    def __init__(
        self, settings: Training, fabric: Any, objective: Any, network: Embedder, optimizer: Any,
        train: Sequence[GraphPair], watched: Sequence[GraphPair], state: State, say: Say,
    ) -> None:  # fmt: skip
        self.settings, self.fabric, self.say = settings, fabric, say
        self.objective, self.network, self.optimizer = objective, network, optimizer
        self.train, self.watched, self.state = train, watched, state
        self.steps = max(len(train) // (settings.batch * fabric.world_size), 1)
        self.log = Log(settings.folder, settings.tensorboard, state.epoch) if fabric.is_global_zero else None
        self.stop = False
        self.augment: Augment | None = None if settings.overfit else settings.augment

    def all(self) -> dict[str, float]:
        """Epochs until the last one, or until nothing has become better for long."""
        settings, clock = self.settings, Clock(self.state.epoch, self.settings.epochs)
        best: dict[str, float] = {}
        if self.log is not None and self.state.best_epoch >= 0:
            best = next((row for row in self.log.rows if row["epoch"] == self.state.best_epoch), {})
        while self.state.epoch < settings.epochs and not self.enough():
            row = self.epoch()
            scored = validate(self.network, self.watched, self.fabric.device)
            row |= {f"val/{name}": value for name, value in scored.items()}
            epoch, better = self.state.epoch, scored[settings.watch] > self.state.best
            self.state = State(epoch + 1, 0, *(
                (scored[settings.watch], epoch, 0) if better else (self.state.best, self.state.best_epoch, self.state.stale + 1)
            ))  # fmt: skip
            best = row if better else best
            self.keep(row, better)
            left = clock.left(epoch + 1)
            self.say(
                f"epoch {epoch + 1}/{settings.epochs} loss {row['train/loss']:.3f} recall@1 {scored['recall@1']:.3f} "
                f"@5 {scored['recall@5']:.3f} F1 {scored['f1']:.3f} merged {scored['merged']:.2f}{' *' if better else ''} "
                f"{row['rooms_per_second']:.0f} rooms/s, {left} left"
            )
        if self.log is not None:
            self.log.close()
        return {name: value for name, value in best.items() if isinstance(value, float)}

    def enough(self) -> bool:
        """Has nothing become better for long, or is nothing left to learn of the one batch?"""
        settings, state = self.settings, self.state
        return bool(settings.patience and state.stale >= settings.patience) or (settings.overfit and state.best >= 1)

    def epoch(self) -> dict[str, Any]:
        """The steps of an epoch that are left."""
        self.objective.train()
        began, waited, rooms = time.perf_counter(), 0.0, 0
        batches = self.batches()
        while True:
            before = time.perf_counter()
            batch = next(batches, None)
            waited += time.perf_counter() - before
            if batch is None:
                break
            for name, value in self.step(batch).items():
                self.state.sums[name] = self.state.sums.get(name, 0.0) + value
            rooms += sum(batch.rooms)
            self.state.step += 1
            if self.stop:
                batches.close()
                self.save()
                raise KeyboardInterrupt
        took = max(time.perf_counter() - began, 1e-9)
        row: dict[str, Any] = {"epoch": self.state.epoch, "seconds": took}
        of_all = float(self.fabric.all_reduce(torch.tensor(float(rooms)), reduce_op="sum"))  # processes
        row |= {"rooms_per_second": of_all / took, "waiting": waited / took}
        return row | {f"train/{name}": value / self.steps for name, value in self.state.sums.items()}

    def step(self, batch: MapPair) -> dict[str, float]:
        """One step of the optimizer; the losses."""
        settings, done = self.settings, self.state.epoch * self.steps + self.state.step
        for group in self.optimizer.param_groups:
            group["lr"] = settings.rate * pace(done / (settings.epochs * self.steps), settings.warmup)
        torch.manual_seed(mixed(settings.seed, self.state.epoch, self.state.step, self.fabric.global_rank, 1))  # of the dropout
        batch = batch.to(self.fabric.device)
        losses = self.objective(batch.tensors, batch.truth)
        self.optimizer.zero_grad()
        self.fabric.backward(losses["loss"])
        if not math.isfinite(float(losses["loss"].detach())):
            raise InputError(f"training diverged in epoch {self.state.epoch + 1}: lower rate, now {settings.rate}")
        self.fabric.clip_gradients(self.objective, self.optimizer, max_norm=settings.clip)
        self.optimizer.step()
        return {name: float(value.detach()) for name, value in losses.items()}

    def batches(self) -> Generator[MapPair, None, None]:
        """Those of this epoch from the state's step on, each made while the one before it is worked on."""
        settings, state = self.settings, self.state
        shuffle = torch.Generator().manual_seed(mixed(settings.seed, state.epoch))
        order = torch.randperm(len(self.train), generator=shuffle).tolist()
        if settings.overfit:
            order = list(range(len(self.train)))
        rank, world, size, names = self.fabric.global_rank, self.fabric.world_size, settings.batch, self.network.tensors

        def make(step: int) -> MapPair:
            chosen = order[step * size * world :][: size * world][rank::world]
            generator = torch.Generator().manual_seed(mixed(settings.seed, state.epoch, step, rank))
            return make_batch([self.train[i] for i in chosen], names, self.augment, generator)

        with ThreadPoolExecutor(1) as beside:
            coming = beside.submit(make, state.step) if state.step < self.steps else None
            for step in range(state.step, self.steps):
                assert coming is not None
                batch = coming.result()
                coming = beside.submit(make, step + 1) if step + 1 < self.steps else None
                yield batch

    def keep(self, row: dict[str, Any], better: bool) -> None:
        """Write metrics, the best network and the state after an epoch."""
        if self.log is None:
            return
        self.log.row(row)
        if better:
            save_embedder(self.network, self.settings.folder / "best", about(self.settings, row))
            self.log.show(self.network, self.watched, row["epoch"], row["val/least"], self.fabric.device)
        self.save()

    def save(self) -> None:
        """Write the state as it is."""
        if self.fabric.is_global_zero:
            told = dict(vars(self.state))
            save_state(self.settings.folder / "last", self.network, self.optimizer.optimizer, told, about(self.settings, {}))


def pace(done: float, warmup: float) -> float:
    """Share of the learning rate after this share of all steps: a rise, then half a cosine down to 0."""
    if done < warmup:
        return (done + 1e-3) / (warmup + 1e-3)
    return 0.5 * (1 + math.cos(math.pi * (done - warmup) / (1 - warmup)))


def mixed(*numbers: int) -> int:
    """A seed out of several numbers."""
    return int.from_bytes(hashlib.sha256(json.dumps(numbers).encode()).digest()[:7])


def about(settings: Training, row: dict[str, Any]) -> dict[str, Any]:
    """What an embedder's file tells about its training."""
    told = {"data": settings.data, "validation": settings.validation, "seed": settings.seed, "loss": settings.loss.kind}
    return {"run": settings.name, **told, **{k: round(v, 5) if isinstance(v, float) else v for k, v in row.items()}}


def _fabric(settings: Training) -> Any:
    from lightning_fabric import Fabric

    logging.getLogger("lightning_fabric").setLevel(logging.WARNING)
    devices = int(os.environ.get("LOCAL_WORLD_SIZE", settings.devices))
    fabric = Fabric(
        accelerator=settings.accelerator, devices=devices, precision=settings.precision,  # type: ignore[arg-type]
        strategy="ddp" if devices > 1 else "auto",
    )  # fmt: skip
    fabric.launch()
    return fabric


def _data(settings: Training, say: Say, fabric: Any) -> tuple[list[GraphPair], list[GraphPair]]:
    """Pairs to train on, and to watch; a set is packed by one process while the others wait."""
    extras = [part for part in settings.network.geometry.parts if part in EXTRAS]
    extras += ["near"] if settings.network.node.near else []
    with fabric.rank_zero_first():
        around = settings.network.node.around
        train = load_pairs(_manifest(settings, settings.data), extras, say, settings.limit, around)
        watched = load_pairs(_manifest(settings, settings.validation), extras, say, around=around) if settings.validation else []
    if settings.overfit:
        some = [pair for pair in train if len(pair.matches)][: settings.batch]
        return some, some
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


def _write_settings(settings: Training) -> None:
    import yaml

    try:
        settings.folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{settings.folder}: can't be written ({error.strerror or error})") from error
    told = to_dict(settings)
    texts = {"config.json": json.dumps(told, indent=1) + "\n", "config.yaml": yaml.safe_dump(told, sort_keys=False)}
    for name, text in texts.items():
        with replacing(settings.folder / name) as beside:
            beside.write_text(text, encoding="utf-8")


@contextmanager
def _interrupts(run: Run) -> Iterator[None]:
    """Ctrl-C and SIGTERM let the step end and save; a second one ends at once."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(number: int, _: object) -> None:
        if run.stop:
            raise KeyboardInterrupt
        run.stop = True
        run.say("saving, then ending")

    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
