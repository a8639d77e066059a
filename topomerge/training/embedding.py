"""Task `embedding`: the network that gives each room of a map a descriptor."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Generator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure

from topomerge.checkpoint import load_state
from topomerge.embedding.learned import STATE_FILE, STATE_SETTINGS
from topomerge.embedding.network import LANDMARK_PART, Network, build_network
from topomerge.errors import InputError
from topomerge.matching.assignment import assign_certain, compute_certainty
from topomerge.models.embedder import DOOR_ROWS, Embedder, match_scores
from topomerge.models.export import check_exporter, export_embedder
from topomerge.models.losses import Objective, Truth
from topomerge.models.weights import read_embedder, read_state, save_state
from topomerge.networks.network import WEIGHTS_PACKAGE
from topomerge.registry import SCHEDULES
from topomerge.training.batches import AugmentedPairs, MapPair, add_invented_signs
from topomerge.training.captured_step import CapturedStep, Step, can_capture
from topomerge.training.descent import build_optimizer, set_rate
from topomerge.training.device_batches import DevicePairs, supports_device_batches
from topomerge.training.loop import (
    Loop,
    Schedule,
    State,
    build_diverged,
    derive_seed,
    prefetch_by_threads,
)
from topomerge.training.packed_pairs import EXTRAS, GraphPair, hold_out, load_pairs
from topomerge.training.processes import FabricProcesses, find_precision, start_fabric
from topomerge.training.run_folder import MetricsLog, begin_run, compare_settings, describe_provenance, export_files
from topomerge.training.samplers import draw_pairs
from topomerge.training.settings import (
    FREEZE,
    VALIDATION,
    Augment,
    Training,
    build_recipe_schema,
    check,
    convert_composed,
    convert_to_dict,
)
from topomerge.training.tasks import RANKINGS, Task, check_start
from topomerge.training.validate import embed, validate
from topomerge.types import LogFn

PROJECTED_PAIRS = 12  # in the embedding projector


def show_embedder(board: Any, network: Embedder, pairs: Sequence[GraphPair], epoch: int, least: float, device: Any) -> None:
    """Show the embedding projector and a figure of matched rooms.

    Args:
        board: TensorBoard's writer; None: nothing is shown.
        least: certainty of a match that is drawn.
    """
    matched_pairs = [pair for pair in pairs if len(pair.matches)][:PROJECTED_PAIRS]
    if board is None or not matched_pairs:
        return
    sides = embed(network, matched_pairs, device)
    labels = [f"{k // 2}{'ab'[k % 2]} {int(t)}" for k, rooms in enumerate(_list_true_rooms(matched_pairs)) for t in rooms]
    board.add_embedding(np.concatenate([e.numpy() for e, _ in sides]), labels, global_step=epoch, tag="rooms")
    board.add_figure("matched rooms", plot_matches(network, matched_pairs[0], sides[0], sides[1], least), epoch)


def _list_true_rooms(pairs: Sequence[GraphPair]) -> list[Any]:
    return [true.tolist() for pair in pairs for true in pair.true]


def plot_matches(network: Embedder, pair: GraphPair, a: tuple[Any, Any], b: tuple[Any, Any], least: float) -> Any:
    """Plot two maps beside each other with the matches that were made: right ones green, wrong ones red, missing ones grey."""
    rows, columns = match_scores(a[0], b[0], a[1], b[1], float(network.temperature.detach()))
    matches = {(i, j) for i, j in assign_certain(compute_certainty(rows.exp().numpy(), columns.exp().numpy()), least).tolist()}
    true = {(i, j) for i, j in pair.matches.tolist()}
    places = [graph["pos"][:, :2].numpy() for graph in (pair.a, pair.b)]
    places = [p - p.min(axis=0) for p in places]
    places[1] = places[1] + [places[0][:, 0].max() + 8, 0]
    out = Figure(figsize=(9, 4), layout="constrained")
    axes = out.add_subplot()
    for graph, place in zip((pair.a, pair.b), places, strict=True):
        for i, j in graph["edge_index"].T.tolist():
            axes.plot(*place[[i, j]].T, color="0.8", lw=1, zorder=0)
        axes.scatter(place[:, 0], place[:, 1], s=4 * graph["x"][:, 0].numpy(), color="0.6", zorder=1)
    for i, j in matches | true:
        color = "tab:green" if (i, j) in matches & true else "tab:red" if (i, j) in matches else "0.6"
        axes.plot(*np.stack([places[0][i], places[1][j]]).T, color=color, lw=1.2, ls="-" if (i, j) in matches else ":", zorder=2)
    axes.set_aspect("equal")
    axes.set_axis_off()
    counts = f"{len(matches & true)} right, {len(matches - true)} wrong, {len(true - matches)} missing"
    axes.set_title(f"{pair.about.get('building', '')}: {counts}")
    return out


def fit(settings: Training, log_line: LogFn = lambda text: print(text, file=sys.stderr, flush=True)) -> dict[str, float]:
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
    settings = adopt_network(settings)
    check_exporter()
    check_start(settings)  # before other processes, if any, have come so far
    fabric = start_fabric(settings)
    is_main_process = fabric.is_global_zero
    log_line = log_line if is_main_process else lambda text: None
    settings = with_own_pairs(settings, log_line, fabric)
    train, watched, replayed = _load_data(settings, log_line, fabric)
    network = _build_network(settings, train)
    on_cuda = fabric.device.type == "cuda"
    optimizer = build_optimizer(settings, network, fused=on_cuda, capturable=on_cuda)  # one launch for all weights
    state = State()
    if settings.resume:
        state = State(**load_state(settings.folder / "last", network, optimizer))
    if is_main_process:
        name = torch.cuda.get_device_name() if on_cuda else "cpu"
        begin_run(settings, f"{fabric.world_size} x {name}, {find_precision(settings)}", torch.get_num_threads())
    fabric.barrier()
    job = EmbeddingJob(settings, fabric, network, optimizer, (train, watched, replayed))
    log = MetricsLog(settings, state.epoch) if is_main_process else None
    perfect = 1.0 if settings.overfit else float("inf")
    schedule = Schedule(settings, job.steps, perfect, settings.watch in TASK.lower)
    best = Loop(job, schedule, state, log, log_line).run()
    if settings.export and is_main_process:
        export_files(settings.folder / "best", settings.export, WEIGHTS_PACKAGE)
    return best


class EmbeddingJob:
    """The job of training an embedder, as the loop runs it.

    Args:
        pairs: to train on, to watch, and, where `replay` is set, to draw from besides.
    """

    unit = "rooms"

    def __init__(
        self, settings: Training, fabric: Any, network: Embedder, optimizer: Any, pairs: tuple[Sequence[GraphPair], ...]
    ) -> None:
        self.settings, self.fabric, self.network = settings, fabric, network
        processes = FabricProcesses(fabric) if fabric.world_size > 1 else None
        self.objective, self.optimizer = fabric.setup(Objective(network, settings.loss, processes), optimizer)
        own, self.watched = pairs[:2]
        self.train = [*own, *(pair for of in pairs[2:] for pair in of)]
        self.own, self.drawn = len(own), round(len(own) * settings.replay / (1 - settings.replay))
        self.steps = max((self.own + self.drawn) // (settings.batch * fabric.world_size), 1)
        self.augment: Augment | None = None if settings.overfit else settings.augment
        self.pairs = self._load_pairs()
        self.take_step: Step = self._descend
        self.state = State()  # that the step under way is of
        # Without an edge in the set there is none to fill batches up with.
        if isinstance(self.pairs, DevicePairs) and self.pairs.edges.any() and can_capture(settings, fabric, self.get_optimizer()):
            self.pairs.mean_shape = self.pairs.measure_mean(settings.batch)
            for group in self.get_optimizer().param_groups:  # that graphs read it where it is
                group["lr"] = torch.tensor(settings.rate, device=fabric.device)
            self.take_step = CapturedStep(self._descend)

    def _load_pairs(self) -> AugmentedPairs | DevicePairs:
        """Return the pairs that batches are made of, on the device or on the host, as `batches` says.

        Raises:
            InputError: batches cannot be made on the device.
        """
        requested, names = self.settings.batches, self.network.tensors
        if requested == "device" or (requested == "auto" and self.fabric.device.type != "cpu"):
            if supports_device_batches(self.settings.network, names, self.augment):
                return DevicePairs(self.train, names, self.augment, self.fabric.device)
            if requested == "device":
                raise InputError("batches=device: this network or augmentation needs batches=host")
        return AugmentedPairs(self.train, names, self.augment, lambda pair: pair)

    def _draw_order(self, generator: torch.Generator) -> list[int]:
        """Draw the pairs of an epoch: those of one's own by the sampler, and those for replay, with replacement, among them."""
        order = draw_pairs(self.settings.sampler, self.train[: self.own], generator)
        if self.drawn:
            replayed = torch.randint(self.own, len(self.train), (self.drawn,), generator=generator)
            order = torch.cat([order, replayed])[torch.randperm(self.own + self.drawn, generator=generator)]
        return [int(number) for number in order]

    def iter_batches(self, state: State) -> Generator[MapPair, None, None]:
        """Yield the batches of the state's epoch from its step on, prefetched by threads."""
        self.objective.train()
        settings = self.settings
        shuffle = torch.Generator().manual_seed(derive_seed(settings.seed, state.epoch))
        order = self._draw_order(shuffle)
        if settings.overfit:
            order = list(range(len(self.train)))
        rank, world, size = self.fabric.global_rank, self.fabric.world_size, settings.batch
        steps = [order[k * size * world :][: size * world][rank::world] for k in range(state.step, self.steps)]

        def seed_of(pair: int) -> int:
            return derive_seed(settings.seed, state.epoch, pair)

        if isinstance(self.pairs, DevicePairs):
            for numbers in steps:
                yield self.pairs.make_batch(numbers, seed_of)
            return
        pairs = AugmentedPairs(self.train, self.network.tensors, self.augment, seed_of)
        yield from prefetch_by_threads(pairs.build_batch, steps, settings.threads)

    def train_step(self, batch: MapPair, state: State) -> dict[str, torch.Tensor]:
        """Take one step of the optimizer; return the losses and the gradient's length, which may be under way on the device.

        A gradient that is no finite number does not reach the weights. Under a scaler of half precision the step is skipped and
        counted, and the scale lowered; otherwise the training ends, on a device when the loop next reads the losses.

        Raises:
            InputError: the training diverged.
        """
        settings, done = self.settings, state.epoch * self.steps + state.step
        factor = SCHEDULES[settings.schedule](done / (settings.epochs * self.steps), settings.warmup)
        self.state, state.rate = state, settings.rate * factor
        set_rate(self.optimizer, state.rate)
        torch.manual_seed(derive_seed(settings.seed, state.epoch, state.step, self.fabric.global_rank, 1))  # of the dropout
        batch = batch.to(self.fabric.device)
        read = (*self.network.tensors, *DOOR_ROWS, "map")
        return self.take_step({name: batch[name] for name in read if name in batch}, batch.truth)

    def _descend(self, tensors: Mapping[str, torch.Tensor], truth: Truth) -> dict[str, torch.Tensor]:
        """Take a step of the optimizer down the gradient of a batch's loss."""
        losses = self.objective(tensors, truth)
        self.optimizer.zero_grad()
        self.fabric.backward(losses["loss"])
        limits = {"max_norm": self.settings.clip, "error_if_nonfinite": False}
        norm = self.fabric.clip_gradients(self.objective, self.optimizer, **limits)
        lost = ~norm.isfinite()
        out = {name: value.detach() for name, value in losses.items()}
        if self.get_scaler() is not None:
            out |= {"norm": norm.masked_fill(lost, 0.0), "skipped": lost.float()}
        elif self.get_optimizer().defaults.get("fused"):
            self.get_optimizer().found_inf, out["norm"] = lost.float(), norm  # type: ignore[attr-defined]
        elif lost:
            raise build_diverged(self.state)
        else:
            out["norm"] = norm
        self.optimizer.step()
        return out

    def count_items(self, batch: MapPair) -> int:
        """Count the rooms of a batch."""
        return sum(batch.rooms)

    def sum_over_processes(self, sizes: int) -> float:
        """Sum the rooms of all processes."""
        return float(self.fabric.all_reduce(torch.tensor(float(sizes)), reduce_op="sum"))

    def compute_scores(self) -> dict[str, float]:
        """Compute the scores of the validation pairs (`validate`), and their loss."""
        return validate(self.network, self.watched, self.fabric.device) | {"loss": self._compute_validation_loss()}

    @torch.no_grad()
    def _compute_validation_loss(self) -> float:
        """Compute the mean loss of the validation pairs, as they are, in batches as of the training; each process computes all of
        it."""
        objective = Objective(self.network, self.settings.loss).eval()
        pairs = AugmentedPairs(self.watched, self.network.tensors, None, lambda pair: pair)
        total, size, count = 0.0, self.settings.batch, len(self.watched)
        for numbers in (list(range(k, min(k + size, count))) for k in range(0, count, size)):
            batch = pairs.build_batch(numbers).to(self.fabric.device)
            with self.fabric.autocast():
                total += float(objective(batch.tensors, batch.truth)["loss"]) * len(numbers)
        return total / max(count, 1)

    def get_optimizer(self) -> torch.optim.Optimizer:
        """Return the optimizer within fabric's."""
        optimizer: torch.optim.Optimizer = self.optimizer.optimizer
        return optimizer

    def get_scaler(self) -> Any:
        """Return the scaler of half precision; None where there is none."""
        return getattr(self.fabric.strategy.precision, "scaler", None)

    def write_network(self, folder: Path) -> None:
        """Write the embedder's state."""
        save_state(self.network, folder, describe_training(self.settings, {}))

    def export_best(self, folder: Path) -> None:
        """Export the best embedder, in the place of its state."""
        if (folder / STATE_SETTINGS).exists():
            network, origin = read_state(folder)
            export_embedder(network, folder, origin)
            for name in (STATE_FILE, STATE_SETTINGS):
                (folder / name).unlink()

    def write_checkpoint(self, folder: Path, row: Mapping[str, Any]) -> None:
        """Write the embedder's state; what was exported of an earlier one goes."""
        shutil.rmtree(folder, ignore_errors=True)
        save_state(self.network, folder, describe_training(self.settings, row))

    def show_best(self, row: Mapping[str, Any], log: MetricsLog) -> None:
        """Show pictures of what the embedder does."""
        show_embedder(log.board, self.network, self.watched, row["epoch"], row["val/least"], self.fabric.device)

    def format_scores(self, row: Mapping[str, Any]) -> str:
        """Format the scores that tell most."""
        scores = [row[f"val/{name}"] for name in ("recall@1", "recall@5", "f1", "merged")]
        return "recall@1 {:.3f} @5 {:.3f} F1 {:.3f} merged {:.2f}".format(*scores)


def describe_training(settings: Training, row: Mapping[str, Any]) -> dict[str, Any]:
    """Describe the training as in an embedder's file."""
    origin = {"data": settings.data, "validation": settings.validation, "seed": settings.seed, "loss": settings.loss.kind}
    origin |= {"settings": convert_to_dict(settings), "provenance": describe_provenance(settings.folder)}
    return {"run": settings.name, **origin, **{k: round(v, 5) if isinstance(v, float) else v for k, v in row.items()}}


def with_own_pairs(settings: Training, log_line: LogFn, fabric: Any) -> Training:
    """Name the sets of a folder of one's own captures, made by one process while the others wait.

    Raises:
        InputError: whatever is wrong with the folder.
    """
    if not settings.path:
        return settings
    from topomerge.datasets.pairs.own_pairs import build_own_sets

    with fabric.rank_zero_first():
        manifests = build_own_sets(settings.path, settings.cache, log_line=log_line, data=settings.data).manifests
    watched = str(manifests["val"]) if settings.validation == VALIDATION else settings.validation
    return replace(settings, data=str(manifests["train"]), validation=watched)


def adopt_network(settings: Training) -> Training:
    """Take the settings of the network from where its weights come from; how much drops out may differ.

    Raises:
        InputError: there is no network, or settings are asked for that are neither its own nor the defaults.
    """
    if not settings.init_from:
        return settings
    try:
        loaded, asked = asdict(read_embedder(settings.init_from)[0].network), asdict(settings.network)
    except InputError as error:
        raise InputError(f"init_from={settings.init_from}: {error}") from error
    given = compare_settings(asdict(Network()), asked)
    differing = {key: values for key, values in compare_settings(loaded, asked).items() if key in given and key != "dropout"}
    if differing:
        text = ", ".join(f"{key} ({was!r} there, {now!r} asked for)" for key, (was, now) in differing.items())
        raise InputError(f"init_from={settings.init_from}: is another network: {text}; leave out what differs")
    dropout = settings.network.dropout if "dropout" in given else loaded["dropout"]
    return replace(settings, network=build_network({**loaded, "dropout": dropout}))


def _load_data(settings: Training, log_line: LogFn, fabric: Any) -> tuple[list[GraphPair], list[GraphPair], list[GraphPair]]:
    """Load the pairs to train on, to watch, and to replay; a set is packed by one process while the others wait."""
    names = (settings.data, settings.validation, settings.replay_data if settings.replay else "")
    with fabric.rank_zero_first():
        train, watched, replayed = (
            load_read_pairs(settings, _get_manifest_path(settings, name), log_line, 0 if k else settings.limit) if name else []
            for k, name in enumerate(names)
        )
    if settings.overfit:
        matched = [pair for pair in train if len(pair.matches)][: settings.batch]
        return matched, matched, []
    if not watched:
        train, watched = hold_out(train)
    if not train:
        raise InputError(f"{settings.data}: no pairs to train on")
    if settings.augment.signs and LANDMARK_PART in settings.network.geometry.parts:
        generator = torch.Generator().manual_seed(settings.seed)
        watched = [add_invented_signs(pair, settings.augment.signs, generator) for pair in watched]
    return train, watched, replayed


def load_read_pairs(settings: Training, manifest: Path, log_line: LogFn, limit: int = 0) -> list[GraphPair]:
    """Load the pairs of a manifest with what the network reads; `limit` as of `load_pairs`."""
    extras = [part for part in settings.network.geometry.parts if part in (*EXTRAS, LANDMARK_PART)]
    extras += ["near"] if settings.network.node.near else []
    extras += ["sheet"] if settings.network.turns > 1 else []
    return load_pairs(manifest, extras, log_line, limit, settings.network.node.around)


def _get_manifest_path(settings: Training, name: str) -> Path:
    path = Path(name)
    return path if path.suffix in (".jsonl", ".npz") else Path(settings.cache) / f"{name}.jsonl"


def _build_network(settings: Training, train: Sequence[GraphPair]) -> Embedder:
    torch.manual_seed(derive_seed(settings.seed))
    requested = replace(settings.network, dropout=0.0) if settings.overfit else settings.network
    network = Embedder(requested)
    network.fit_scales([graph for pair in train for graph in (pair.a, pair.b)])
    if settings.init_from:
        network.load_state_dict(read_embedder(settings.init_from)[0].state_dict())
    if settings.geometry_from:
        other, _ = read_embedder(settings.geometry_from)
        try:
            network.geometry.load_state_dict(other.geometry.state_dict())
        except RuntimeError as error:
            raise InputError(f"geometry_from={settings.geometry_from}: has another geometry encoder") from error
    for part in FREEZE[settings.freeze]:
        network.get_submodule(part).requires_grad_(False)
    return network


def describe_network(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return what tells runs apart in a table, out of the settings of one: its encoders and its loss."""
    geometry, node = config["network"]["geometry"], config["network"]["node"]
    edges = "yes"
    if node["kind"] == "none" or not node["edges"]:
        edges = "–"
    elif node["doors"]:
        edges = "near doors" if node["near"] else "doors"
    elif node.get("around"):
        edges = f"rooms within {node['around']:g} m"
    kind = node["kind"] if node["kind"] == "none" else f"{node['kind']} {node['layers']}"
    return {"geometry": "+".join(geometry["parts"]), "node": kind, "edges": edges, "loss": config["loss"]["kind"]}


TASK = Task(
    Training,
    fit,
    (*RANKINGS, "recall@1_clear", "recall@5_clear", "mrr", "precision", "recall", "f1", "merged", "loss"),
    lower=("loss",),
    package=WEIGHTS_PACKAGE,
    file="embedder.onnx",
    hours=4.5,  # two of them for the sets; by the rate of an epoch, not measured as a whole
    words=("experiment=surroundings", "precision=bf16-mixed"),  # as the model card says
    sets=("train_walks", "val_small"),
    schema=build_recipe_schema,
    convert=convert_composed,
    is_descriptor=True,
    describe=describe_network,
)
