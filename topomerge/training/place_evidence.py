"""Task `place_evidence`: the network that scores whether two squares from above show one place (`registration.places`).

Squares of simulated maps under their right pose and under wrong ones that the search proposed: another place of the building, a
twin wing, another storey, another building. Furniture is moved, doors are opened and maps drift between the two. Turned, mirrored
and exchanged, with heights taken away now and then, as other sensors miss them. Some of the buildings are watched.
"""

from __future__ import annotations

import json
from collections.abc import Generator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.nn import functional

from topomerge.datasets.core.builder import read_derived
from topomerge.datasets.pairs.lookalikes import build_lookalikes
from topomerge.errors import InputError
from topomerge.models.convolutional import PlaceLogOdds, PlaceNetwork
from topomerge.models.export import build_sample
from topomerge.registration.places import (
    PLACE_SIGNATURE,
    UPPER_PLANES,
    compute_network_log_odds,
    compute_planes,
    read_weights,
)
from topomerge.training.belief_hypotheses import assign_half, build_hypothesis_files, derive_hypothesis_files, is_distinguishable
from topomerge.training.loop import Exported, ExportedJob, State, derive_seed, run_network
from topomerge.training.packed_pairs import name_building
from topomerge.training.processes import let_main_process_first
from topomerge.training.task_settings import PlaceAugment, PlaceEvidence
from topomerge.training.tasks import Task
from topomerge.types import Array, LogFn


@dataclass(frozen=True, eq=False)
class Places:
    """Squares of many pairs.

    Args:
        planes: (n, side, side, PLANES) float16, what the network sees of each.
        right: (n,) bool, is it one place?
        weight: (n,) those of one hypothesis weigh as much as their number's root; of each two kinds of sensors, in
            ordinary pairs and in look-alikes, right and wrong ones weigh alike: else whoever sees a tablet knows that most of its
            pairs are wrong.
        building: (n,) number of the building of the first map.
        buildings: their names.
    """

    planes: Array
    right: Array
    weight: Array
    building: Array
    buildings: Sequence[str]


def collect_places(paths: Sequence[Path], half: int = 0) -> Places:
    """Return the squares of the hypotheses of pairs (`belief_hypotheses`) that are right or wrong; none of those that are
    neither, and none of pairs that nobody can tell apart.

    Raises:
        InputError: there is none.
    """
    seen, right, weight, building, names, sensors = [], [], [], [], [], []
    for path in paths:
        data = read_derived(path)
        row = json.loads(data["row"].tobytes())
        if (
            row.get("tellable") is False
            or ("lookalike" not in row and not is_distinguishable(row))
            or half == 2 - assign_half(row)
        ):
            continue
        name = name_building(row)
        names.append(name)
        label = np.array([h["label"] for h in row["hyps"]])[data["owner"]] if len(data["owner"]) else np.zeros(0)
        pick = np.flatnonzero(label >= 0)
        if not len(pick):
            continue
        owner = data["owner"][pick]
        seen.append(compute_planes(data["parts"][pick], data["ceiling"][pick], data["looked"][pick]).astype(np.float16))
        right.append(label[pick] == 1)
        weight.append(np.bincount(owner)[owner] ** -0.5)
        building.append(np.full(len(pick), names.index(name)))
        sensors.append(np.full(len(pick), "+".join([*sorted(row["sensors"]), *(["alike"] if "lookalike" in row else [])])))
    if not right:
        raise InputError("data.sets: no pair has a hypothesis that shows a place in both maps")
    is_right = np.concatenate(right)
    weights = balance_weights(np.concatenate(weight), is_right, np.concatenate(sensors))
    return Places(np.concatenate(seen), is_right, weights, np.concatenate(building), names)


def balance_weights(weight: Array, right: Array, group: Array) -> Array:
    """Return (n,) weights with which right and wrong ones of each group weigh alike; a group of one side only weighs nothing, and
    others as much as the root of the weight of their smaller side."""
    _, owner = np.unique(group, return_inverse=True)
    total = np.zeros((owner.max() + 1, 2))
    np.add.at(total, (owner, right.astype(int)), weight)
    share = np.sqrt(total.min(axis=1))[:, None] / np.maximum(total, 1e-9)
    out: Array = weight * share[owner, right.astype(int)]
    return out


def select_places(places: Places, pick: Array) -> Places:
    """Select places by index."""
    return Places(places.planes[pick], places.right[pick], places.weight[pick], places.building[pick], places.buildings)


class PlaceJob(ExportedJob):
    """Squares, right ones and wrong ones alike."""

    unit = "squares"

    def __init__(self, settings: PlaceEvidence, learned: Places, watched: Places) -> None:
        origin = {"set": settings.data.name, "split": settings.data.split, "places": len(learned.right)}
        origin |= {"right": int(learned.right.sum()), "watched": len(watched.right)}
        super().__init__(settings, PlaceNetwork(settings.widths, settings.dropout), origin)
        self.options, self.learned, self.watched = settings, learned, watched
        self.probability = learned.weight / learned.weight.sum()
        self.planes, self.right = (
            torch.from_numpy(learned.planes).to(self.device),
            torch.from_numpy(learned.right).to(self.device),
        )

    def iter_batches(self, state: State) -> Generator[tuple[torch.Tensor, torch.Tensor], None, None]:
        """Yield squares, by a generator of each step."""
        self.network.train()
        options = self.options
        for step in range(state.step, options.steps):
            rng = self.start_generator(1, state.epoch, step)
            rows = torch.from_numpy(rng.choice(len(self.probability), options.batch, p=self.probability)).to(self.device)
            x = augment_planes(self.planes.index_select(0, rows).float(), options.augment, rng)
            yield x.permute(0, 3, 1, 2), self.right[rows].float()

    def train_step(self, batch: tuple[torch.Tensor, torch.Tensor], state: State) -> dict[str, float]:
        """Take one step of the optimizer."""
        options, (x, right) = self.options, batch
        torch.manual_seed(derive_seed(options.seed, state.epoch, state.step, self.fabric.global_rank, 1))  # of the dropout
        loss = functional.binary_cross_entropy_with_logits(self.network(x), right)
        return self.optimize(loss, options, state)

    def count_items(self, batch: tuple[torch.Tensor, torch.Tensor]) -> int:
        """Count the squares of a batch."""
        return len(batch[0])

    def exported(self) -> Exported:
        """Return the network with probabilities for scores."""
        assert isinstance(self.network, PlaceNetwork)
        return Exported(PlaceLogOdds(self.network), PLACE_SIGNATURE, build_sample(PLACE_SIGNATURE))

    def compute_scores(self) -> dict[str, float]:
        """Compute the scores of the validation buildings."""
        return score_places(compute_network_log_odds(self.watched.planes, self.run()), self.watched.right, self.watched.weight)


def augment_planes(x: torch.Tensor, augment: PlaceAugment, rng: np.random.Generator) -> torch.Tensor:
    """Return planes (n, side, side, PLANES) turned by quarters and mirrored, and some without what is above a body."""
    count, planes = len(x), x.shape[3]
    turned = torch.rot90(x, int(rng.integers(4)), (1, 2))
    mirrored = turned.flip(1) if rng.random() < 0.5 else turned
    blind = rng.random(count) < augment.upper
    factor = rng.normal(1.0, augment.noise, (count, planes))
    factor[np.ix_(blind, np.array(UPPER_PLANES))] = 0
    return mirrored.contiguous() * torch.from_numpy(factor.astype(np.float32)).to(x.device)[:, None, None]


def score_places(odds: Array, right: Array, weight: Array) -> dict[str, float]:
    """Compute the area under the ROC curve and log loss of both sides alike, of weighted places."""
    w = weight.astype(float)
    for side in (True, False):
        w[right == side] /= max(2 * w[right == side].sum(), 1e-9)
    order = np.argsort(odds, kind="stable")
    below = np.cumsum(np.where(right, 0.0, w)[order])
    auc = float((w[order] * right[order] * below).sum() / max((w * right).sum() * below[-1], 1e-9))
    return {"auc": auc, "log_loss": float((w * np.logaddexp(0, np.where(right, -odds, odds))).sum())}


def fit(settings: PlaceEvidence, log_line: LogFn) -> dict[str, float]:
    """Train; the scores of the best epoch.

    Raises:
        InputError: too few buildings to train on some and watch others.
    """
    with let_main_process_first(settings):
        paths = build_hypothesis_files(settings.data, settings, log_line)
        if settings.lookalikes:
            alike, _ = build_lookalikes(settings.alike, settings, log_line)
            paths += derive_hypothesis_files(settings.alike.name, [[path] for path in alike], settings, log_line)
    return train(settings, collect_places(paths, settings.half), log_line)


def train(settings: PlaceEvidence, places: Places, log_line: LogFn) -> dict[str, float]:
    """Train on places; the scores of the best epoch.

    Raises:
        InputError: too few buildings to train on some and watch others.
    """
    order = np.random.default_rng(0).permutation(len(places.buildings))  # else the sources, which come in turn
    watches = order[places.building] % settings.hold_out == 0
    if not watches.any() or watches.all():
        raise InputError("data.sets: too few pairs: buildings to train on and others to watch are needed")
    torch.manual_seed(derive_seed(settings.seed))
    learned, watched = select_places(places, np.flatnonzero(~watches)), select_places(places, np.flatnonzero(watches))
    job = PlaceJob(settings, learned, watched)
    log_line(f"{len(learned.right)} places, {sum(p.numel() for p in job.network.parameters())} weights")
    return run_network(job, settings, settings.steps, log_line)


def judge(settings: PlaceEvidence, file: Path, log_line: LogFn) -> dict[str, Any]:
    """Return scores of weights on places of buildings that trained nothing."""
    places = collect_places(build_hypothesis_files(settings.heldout, settings, log_line))
    scores = score_places(compute_network_log_odds(places.planes, read_weights(file)), places.right, places.weight)
    return {**scores, "places": len(places.right)}


TASK = Task(
    PlaceEvidence,
    fit,
    ("auc", "log_loss"),
    judge,
    "topomerge.networks",
    "place_network.onnx",
    hours=4.0,
    lower=("log_loss",),
)
