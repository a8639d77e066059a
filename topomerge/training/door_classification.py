"""Task `door_classification`: is a narrowing of the floor a door (`extraction.plans.passages`)?

A plan is cut into regions as the extraction does. Two neighbouring regions are an example: 1 where most of them lie in different
true rooms. Regions of one true room are then merged, as a perfect classifier would, and what remains gives more examples: the
classifier is asked about half-merged rooms, too. It hears the plan network, which is trained before.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from topomerge.archive import find_weights_file, replace_on_success
from topomerge.datasets.core.builder import derive, read_derived, read_sources
from topomerge.datasets.pairs.plan_examples import PlanRecipe, build_plans, load_examples
from topomerge.errors import InputError
from topomerge.extraction.plans.passages import (
    DOOR_FEATURES,
    compute_clearance,
    compute_door_features,
    find_passages,
    read_classifier,
    segment_regions,
)
from topomerge.extraction.plans.plan_network import (
    GRID_NETWORK_FILE,
    PLAN_NETWORK_FILE,
    compute_column_probabilities,
    load_weights,
    remove_furniture,
)
from topomerge.extraction.plans.storey_plan import StoreyPlan
from topomerge.numpy_nn import apply_mlp, sigmoid
from topomerge.training.loop import NetworkJob, State, derive_seed, descend_gradient, run_network
from topomerge.training.packed_pairs import number_buildings, read_scan_building
from topomerge.training.processes import let_main_process_first
from topomerge.training.scan_settings import DoorClassification
from topomerge.training.tasks import Task
from topomerge.types import Array, LogFn

PURE = 0.7  # share of a region in its true room; regions between rooms are no example
LEAST_FEATURE_SPREAD = 1e-3  # of a feature: weights are written with four digits
RANGE = (0.005, 0.995)  # quantiles that features are clipped to
Doors = tuple[Array, Array, Array]  # (n, 17) features, (n,) is it a door, (n,) number of the building


def fit(settings: DoorClassification, log_line: LogFn) -> dict[str, float]:
    """Train; the scores of the best epoch.

    Raises:
        InputError: no scan to train on or to watch.
    """
    with let_main_process_first(settings):
        x, y, building = build_door_examples(settings.data, settings, log_line)
    watched = building % settings.hold_out == 0
    if len(np.unique(y[~watched])) < 2 or len(np.unique(y[watched])) < 2:
        raise InputError(f"data.scans={settings.data.scans}: too few scans to learn doors from some and watch others")
    torch.manual_seed(derive_seed(settings.seed))
    job = DoorJob(settings, (x[~watched], y[~watched], building[~watched]), (x[watched], y[watched], building[watched]))
    log_line(f"{len(y)} examples of {len(np.unique(building))} buildings, {y.mean():.3f} of them doors")
    return run_network(job, settings, job.steps, log_line)


def build_door_examples(recipe: PlanRecipe, settings: DoorClassification, log_line: LogFn) -> Doors:
    """Build examples of a set of scans, cached."""
    paths, _ = build_plans(recipe, settings, log_line)
    networks = (find_weights_file("topomerge.networks", name) for name in (PLAN_NETWORK_FILE, GRID_NETWORK_FILE))
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in networks)).hexdigest()[:16]
    files, _ = derive(
        f"{recipe.name}_doors", compute_scan_doors, [[path] for path in paths], settings, {"plan_networks": digest}, log_line
    )
    scans = [read_derived(file) for file in files]
    if not scans:
        raise InputError(f"{recipe.name}: no scan could be made; see the reasons above")
    scan_of = {path.stem: path for path in paths}
    buildings = number_buildings([read_scan_building(scan_of[read_sources(file)[0]]) for file in files])
    numbers = np.repeat(buildings, [len(s["y"]) for s in scans])
    return np.concatenate([s["x"] for s in scans]), np.concatenate([s["y"] for s in scans]), numbers


def compute_scan_doors(path: Path, plan_networks: str) -> dict[str, Array]:
    """Compute features and answers for the neighbouring regions of the plans of a scan.

    Args:
        plan_networks: digest of the weights that cut the plans; they only name the cached file.
    """
    parts = []
    for e in load_examples(path):
        probability = compute_column_probabilities(e.plan, load_weights(raised=e.source.startswith("drawn/")))
        parts.append(compute_region_pairs(e.plan, probability, e.room, set(e.visited.tolist())))
    x = np.array([row for rows, _ in parts for row in rows], float).reshape(-1, len(DOOR_FEATURES))
    return {"x": x, "y": np.array([answer for _, answers in parts for answer in answers], bool)}


def compute_region_pairs(plan: StoreyPlan, probability: Array, truth: Array, visited: set[int]) -> tuple[list[Array], list[bool]]:
    """Compute features and answers for the neighbouring regions of one plan, before and while those of one room are merged."""
    plan = remove_furniture(plan, probability)
    clearance = compute_clearance(plan)
    region = segment_regions(plan, probability)
    room, area = _assign_regions_to_rooms(region, truth, plan.edge)
    peak = np.zeros(len(room))
    inside = region >= 0
    np.maximum.at(peak, region[inside], clearance[inside])
    links = dict(find_passages(plan, clearance, region, probability))
    x: list[Array] = []
    y: list[bool] = []

    def add(pairs: list[tuple[int, int]]) -> None:
        for a, b in pairs:
            if room[a] >= 0 and room[b] >= 0 and (room[a] in visited or room[b] in visited):
                x.append(compute_door_features(links[a, b], (peak[a], peak[b]), (area[a], area[b])))
                y.append(bool(room[a] != room[b]))

    add(list(links))
    while same := [p for p in links if room[p[0]] >= 0 and room[p[0]] == room[p[1]]]:
        left, gone = max(same, key=lambda p: (links[p].width / min(peak[p[0]], peak[p[1]]), p))
        del links[left, gone]
        peak[left], area[left] = max(peak[left], peak[gone]), area[left] + area[gone]
        for old in [p for p in links if gone in p]:
            other = old[0] if old[1] == gone else old[1]
            new, passage = (min(left, other), max(left, other)), links.pop(old)
            if new not in links or passage.width > links[new].width:
                links[new] = passage
        add([p for p in links if left in p])
    return x, y


def _assign_regions_to_rooms(region: Array, truth: Array, edge: float) -> tuple[Array, Array]:
    """Return the true room of each region, -1 where it lies between rooms, and the regions' areas, m2."""
    count, rooms = int(region.max(initial=-1)) + 1, int(truth.max(initial=-1)) + 1
    votes = np.zeros((count, rooms + 1))
    inside = region >= 0
    np.add.at(votes, (region[inside], truth[inside]), 1)
    if not count:
        return np.zeros(0, int), np.zeros(0)
    room = np.where(votes.max(axis=1) >= PURE * votes.sum(axis=1), votes.argmax(axis=1), -1)
    room[room == rooms] = -1
    return room, votes.sum(axis=1) * edge**2


class Perceptrons(nn.Module):
    """Several networks with one hidden layer each, that know nothing of each other."""

    def __init__(self, inputs: int, hidden: int, networks: int) -> None:
        super().__init__()
        self.members = nn.ModuleList(
            nn.Sequential(nn.Linear(inputs, hidden), nn.ReLU(), nn.Linear(hidden, 1)) for _ in range(networks)
        )

    def forward(self, inputs: Sequence[Tensor]) -> list[Tensor]:
        """Return the scores (n,) of each network of its own inputs (n, k)."""
        return [member(rows)[:, 0] for member, rows in zip(self.members, inputs, strict=True)]

    def merge_layers(self) -> list[tuple[Array, Array]]:
        """Return the mean of their scores as one network with as many times the hidden units: weights (in, out) and biases."""
        first = [member[0] for member in self.members]  # type: ignore[index]
        last = [member[2] for member in self.members]  # type: ignore[index]
        numbers = [[(m.weight.detach().numpy().T, m.bias.detach().numpy()) for m in layer] for layer in (first, last)]
        w, b = np.concatenate([w for w, _ in numbers[0]], axis=1), np.concatenate([b for _, b in numbers[0]])
        return [(w, b), (np.concatenate([v for v, _ in numbers[1]]) / len(last), np.mean([c for _, c in numbers[1]], axis=0))]


class DoorJob(NetworkJob):
    """All examples an epoch, in another order for each network; buildings with many examples count less than proportionally."""

    def __init__(self, settings: DoorClassification, learned: Doors, watched: Doors) -> None:
        x, y, building = learned
        origin = {"set": settings.data.name, "split": settings.data.split, "examples": len(y), "watched": len(watched[1])}
        super().__init__(settings, Perceptrons(x.shape[1], settings.hidden, settings.networks), origin)
        self.options, self.watched = settings, watched
        low, high = np.quantile(x, RANGE, axis=0)
        clipped = np.clip(x, low, high)
        spread = clipped.std(axis=0)  # grids have no lintels: what is the same everywhere says nothing
        scale = np.where(spread > LEAST_FEATURE_SPREAD, spread, 1.0)
        self.scaling = {"low": low, "high": high, "mean": clipped.mean(axis=0), "scale": scale}
        weight = 1 / np.sqrt(np.unique(building, return_counts=True)[1][np.unique(building, return_inverse=True)[1]])
        inputs = (clipped - self.scaling["mean"]) / self.scaling["scale"]
        self.tensors = [torch.tensor(v, dtype=torch.float32) for v in (inputs, y, weight / weight.mean())]
        self.steps = math.ceil(len(y) / (settings.batch * self.fabric.world_size))

    def iter_batches(self, state: State) -> Generator[list[tuple[Tensor, ...]], None, None]:
        """Yield batches of the rows of each network: jittered inputs, answers, weights."""
        options, count = self.options, len(self.tensors[0])
        of_epoch = [torch.Generator().manual_seed(derive_seed(options.seed, k, state.epoch)) for k in range(options.networks)]
        orders = [torch.randperm(count, generator=generator) for generator in of_epoch]
        rank, world = self.fabric.global_rank, self.fabric.world_size
        if world > 1:  # each process gets as many
            orders = [order.repeat(self.steps * world)[: self.steps * world * options.batch][rank::world] for order in orders]
        for step in range(state.step, self.steps):
            batch: list[tuple[Tensor, ...]] = []
            for k, order in enumerate(orders):
                rows = order[step * options.batch :][: options.batch]
                generator = torch.Generator().manual_seed(derive_seed(options.seed, k, state.epoch, step, 1 + rank))
                inputs, answers, weight = (tensor[rows] for tensor in self.tensors)
                noise = torch.randn(inputs.shape, generator=generator)
                batch.append((inputs + options.noise * noise, answers, weight))
            yield batch

    def train_step(self, batch: list[tuple[Tensor, ...]], state: State) -> dict[str, float]:
        """Take one step of the optimizer, of all networks."""
        options = self.options
        for group in self.optimizer.param_groups:
            group["lr"] = options.rate * 0.5 * (1 + math.cos(math.pi * state.epoch / options.epochs))
        losses = []
        predicted = self.network([inputs for inputs, _, _ in batch])
        for scores, (_, answers, weight) in zip(predicted, batch, strict=True):
            each = nn.functional.binary_cross_entropy_with_logits(scores, answers, reduction="none")
            losses.append((each * weight).mean())
        taken = descend_gradient(self.optimizer, torch.stack(losses).sum(), state)
        return {**taken, "loss": taken["loss"] / len(losses)}

    def count_items(self, batch: list[tuple[Tensor, ...]]) -> int:
        """Count the examples of a batch."""
        return len(batch[0][0])

    def export_weights(self) -> dict[str, Any]:
        """Return the weights as the package reads them."""
        assert isinstance(self.network, Perceptrons)
        values: dict[str, Any] = {name: numbers.round(4).tolist() for name, numbers in self.scaling.items()}
        layers = [[w.round(4).tolist(), b.round(4).tolist()] for w, b in self.network.merge_layers()]
        return {"features": list(DOOR_FEATURES), **values, "layers": layers}

    def compute_scores(self) -> dict[str, float]:
        """Compute the scores of the validation scans."""
        weights = self.export_weights()
        arrays: dict[str, Any] = {name: np.array(weights[name]) for name in self.scaling}
        layers = [(np.array(w), np.array(b)) for w, b in weights["layers"]]
        return score_doors(predict_probabilities(self.watched[0], {**arrays, "layers": layers}), self.watched[1])

    def write_weights(self, path: Path) -> None:
        """Write a table as JSON."""
        with replace_on_success(path) as temporary:
            temporary.write_text(json.dumps(self.export_weights()), encoding="utf-8")


def predict_probabilities(x: Array, weights: dict[str, Any]) -> Array:
    """Predict (n,) probability of a door, as `door_classifier.door_probability` with these weights."""
    z = (np.clip(x, weights["low"], weights["high"]) - weights["mean"]) / weights["scale"]
    return sigmoid(apply_mlp(z, weights["layers"])[:, 0])


def score_doors(p: Array, y: Array, threshold: float = 0.5) -> dict[str, float]:
    """Return the precision and recall of doors from a probability on, area under the ROC curve, log loss and the share that is
    right."""
    predicted, y = p > threshold, np.asarray(y, bool)
    order = np.unique(p, return_inverse=True)[1]
    ranks = (np.cumsum(np.bincount(order)) - (np.bincount(order) - 1) / 2)[order]
    positive, negative = int(y.sum()), int((~y).sum())
    auc = (ranks[y].sum() - positive * (positive + 1) / 2) / max(positive * negative, 1)
    return {
        "precision": float((predicted & y).sum() / max(predicted.sum(), 1)),
        "recall": float((predicted & y).sum() / max(positive, 1)),
        "auc": float(auc),
        "log_loss": float(-np.mean(np.log(np.where(y, p, 1 - p) + 1e-6))),
        "accuracy": float((predicted == y).mean()),
        "doors": float(y.mean()),
    }


def judge(settings: DoorClassification, file: Path, log_line: LogFn) -> dict[str, Any]:
    """Return scores of weights on scans of buildings that trained nothing."""
    x, y, building = build_door_examples(settings.heldout, settings, log_line)
    return {
        **score_doors(predict_probabilities(x, read_classifier(file)), y),
        "examples": len(y),
        "buildings": len(np.unique(building)),
    }


TASK = Task(
    DoorClassification,
    fit,
    ("auc", "precision", "recall", "accuracy", "log_loss"),
    judge,
    "topomerge.extraction.plans",
    "door_classifier.json",
    hours=0.7,
    lower=("log_loss",),
)
