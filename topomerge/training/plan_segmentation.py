"""Task `plan_segmentation`: the network that says what stands in each column of a plan (`extraction.plans.plan_network`).

Crops of simulated scans' plans, turned and mirrored, with things taken away now and then. Every n-th scan is watched. The network
of grids (`grid_segmentation`) sees the same scans as grids show them.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy import ndimage
from torch.nn import functional

from topomerge.datasets.pairs.plan_examples import PlanExample, PlanRecipe, build_plans, load_examples
from topomerge.datasets.pairs.plan_truth import TRUE_CLASSES
from topomerge.datasets.pairs.scan_items import FLAT_SENSOR_SHARES
from topomerge.errors import InputError
from topomerge.extraction.plans.plan_network import (
    EVIDENCE_CHANNELS,
    PLAN_SIGNATURE,
    column_probabilities,
    evidence,
    read_weights,
)
from topomerge.extraction.plans.storey_plan import COLUMN_CLASSES
from topomerge.models.plan_unet import PlanProbabilities, PlanUNet
from topomerge.networks.network import Run
from topomerge.training.grid_noise import with_grid_noise
from topomerge.training.loop import Say, State, made_beside, mixed
from topomerge.training.networks import Exported, ExportedJob, run_network
from topomerge.training.scan_settings import GridSegmentation, PlanAugment, PlanLoss, PlanSegmentation
from topomerge.training.splits import mark_watched, read_scan_building
from topomerge.types import Array

LEAST_COLUMNS = 100  # inside of a plan that trains
BARE_EVERY = 4  # plans that are shown as grids: one without furniture
LASER_HEIGHTS, RAISED_HEIGHTS, FLOOR_HEIGHTS = (0.2, 0.5), (0.0, 2.4), (-0.1, 0.1)  # m: robots look there; walls of grids; floors
UPPER_CHANNELS, FLOOR_CHANNEL = (5, 7, 8, 9), (6,)  # of `evidence`
FLOOR_LOST = 0.3  # share of the crops without an upper half that lose their floor instead
PlanTensors = tuple[Array, Array, Array]  # evidence, truth and weight of each column


def fit(settings: PlanSegmentation, say: Say) -> dict[str, float]:
    """Train; the scores of the best epoch.

    Raises:
        InputError: no scan to train on or to watch.
    """
    paths, _ = build_plans(settings.data, settings, say)
    scans = [load_examples(path) for path in paths]
    watches = mark_watched([read_scan_building(path) for path in paths], settings.hold_out)
    learned, watched = ([e for s, w in zip(scans, watches, strict=True) if w == which for e in s] for which in (False, True))
    learned = [e for e in learned if e.plan.inside.sum() > LEAST_COLUMNS]
    if isinstance(settings, GridSegmentation):
        learned, watched = ([as_grid(e, k % BARE_EVERY > 0) for k, e in enumerate(some)] for some in (learned, watched))
    if not learned or not watched:
        raise InputError(f"data.scans={settings.data.scans}: too few scans to train on some and watch others")
    torch.manual_seed(mixed(settings.seed))
    job = PlanJob(settings, learned, watched)
    say(f"{len(learned)} plans, {sum(p.numel() for p in job.network.parameters())} weights")
    return run_network(job, settings, settings.steps, say)


class PlanJob(ExportedJob):
    """Crops of plans, larger plans more often."""

    def __init__(self, settings: PlanSegmentation, learned: Sequence[PlanExample], watched: Sequence[PlanExample]) -> None:
        origin = {"set": settings.data.name, "split": settings.data.split, "plans": len(learned), "watched": len(watched)}
        super().__init__(settings, PlanUNet(settings.widths), origin)
        self.options, self.watched = settings, watched
        self.plans = [plan_tensors(e, settings.loss) for e in learned]
        chance = np.sqrt([float(e.room.size) for e in learned])
        self.chance = chance / chance.sum()

    def batches(self, state: State) -> Generator[tuple[torch.Tensor, ...], None, None]:
        """Crops."""
        self.network.train()
        yield from made_beside(self.crops(state))

    def crops(self, state: State) -> Iterator[tuple[torch.Tensor, ...]]:
        """Those of the state's epoch from its step on, from a generator of each step."""
        options = self.options
        for step in range(state.step, options.steps):
            rng = np.random.default_rng([options.seed, 1, state.epoch, step])
            rows = rng.choice(len(self.plans), options.batch, p=self.chance)
            crops = [crop(self.plans[row], options.crop, options.augment, rng) for row in rows]
            x, truth, weight = (np.stack(arrays) for arrays in zip(*crops, strict=True))
            labels = torch.from_numpy(truth.astype(np.int64))
            yield torch.from_numpy(x).permute(0, 3, 1, 2), labels, torch.from_numpy(weight.astype(np.float32))

    def step(self, batch: tuple[torch.Tensor, ...], state: State) -> dict[str, float]:
        """One step of the optimizer."""
        options, (x, truth, weight) = self.options, self.there(batch)
        each = functional.cross_entropy(self.network(x), truth, reduction="none")
        loss = (each * weight).sum() / weight.sum()
        return self.descend(loss, options, state)

    def size(self, batch: tuple[torch.Tensor, ...]) -> int:
        """Crops."""
        return len(batch[0])

    def exported(self) -> Exported:
        """The network with probabilities for scores."""
        assert isinstance(self.network, PlanUNet)
        return Exported(PlanProbabilities(self.network), PLAN_SIGNATURE, [torch.rand(2, EVIDENCE_CHANNELS, 64, 48)])

    def scores(self) -> dict[str, float]:
        """Of the scans that are watched."""
        return class_scores(confusion(self.watched, self.run()))


def as_grid(example: PlanExample, furnished: bool) -> PlanExample:
    """The plan of a scan as a robot would leave it, or a draughtsman: walls alone, all raised alike. Grids stay as they are.

    Args:
        furnished: with what a laser meets near the floor as walls.
    """
    plan = example.plan
    if example.source.split("/")[0] in FLAT_SENSOR_SHARES:
        return example
    standing = plan.occupied(*LASER_HEIGHTS) & plan.inside if furnished else np.zeros_like(plan.wall)
    wall, inside = plan.wall | standing, plan.inside & ~standing
    full, floor = (plan.profile.dtype.type(plan.bands.mask(*heights)) for heights in (RAISED_HEIGHTS, FLOOR_HEIGHTS))
    profile = np.where(wall, full | floor, np.where(inside, floor, plan.profile.dtype.type(0)))
    ceiling = np.full(wall.shape, np.nan)
    return replace(example, plan=replace(plan, wall=wall, inside=inside, profile=profile, ceiling=ceiling))


def plan_tensors(example: PlanExample, loss: PlanLoss) -> PlanTensors:
    """Evidence, truth and weight of each column."""
    seen = ndimage.binary_dilation(example.plan.inside | example.plan.wall, np.ones((3, 3)))
    weight = np.array(loss.classes, np.float32)[example.truth] * np.where(seen, 1.0, loss.unseen)
    return evidence(example.plan).astype(np.float16), example.truth, weight.astype(np.float16)


def crop(plan: PlanTensors, side: int, augment: PlanAugment, rng: np.random.Generator) -> PlanTensors:
    """A square of a plan, turned by quarters, mirrored or not, with some of the evidence taken away."""
    x, truth, weight = plan
    inside = np.argwhere(x[..., 0] > 0)
    i, j = (inside[rng.integers(len(inside))] - rng.integers(side // 4, 3 * side // 4, 2)).tolist()
    box = tuple(slice(max(k, 0), max(k + side, 0)) for k in (i, j))
    pad = [(max(-k, 0), side - max(-k, 0) - (min(k + side, n) - max(k, 0))) for k, n in zip((i, j), truth.shape, strict=True)]
    x = np.pad(x[box], [*pad, (0, 0)])
    truth = np.pad(truth[box], pad, constant_values=TRUE_CLASSES.index("outside"))
    weight = np.pad(weight[box], pad)
    turn, mirror = int(rng.integers(4)), rng.random() < 0.5
    x, truth, weight = (np.rot90(array, turn)[:: -1 if mirror else 1] for array in (x, truth, weight))
    x = np.array(x, np.float32)
    if rng.random() < augment.upper:
        x[..., list(FLOOR_CHANNEL if rng.random() < FLOOR_LOST else UPPER_CHANNELS)] = 0
    if augment.grid_noise and rng.random() < augment.grid_noise:
        x = with_grid_noise(x, truth == TRUE_CLASSES.index("inside"), rng)
    if rng.random() < augment.columns:
        x[..., 1:10] *= rng.random((side, side, 1)) > rng.uniform(0, augment.lost)
    return x, truth, weight


def confusion(examples: Sequence[PlanExample], network: Run) -> Array:
    """(5, 5) columns by true and by said class, of those of which something is known."""
    table = np.zeros((len(COLUMN_CLASSES), len(COLUMN_CLASSES)), np.int64)
    for example in examples:
        seen = example.plan.inside | example.plan.wall
        said = column_probabilities(example.plan, network).argmax(axis=-1)
        np.add.at(table, (example.truth[seen], said[seen]), 1)
    return table


def class_scores(table: Array) -> dict[str, float]:
    """IoU and F1 of each class, their means over the classes that there are, and the share of columns that are right."""
    right, true, said = np.diag(table), table.sum(axis=1), table.sum(axis=0)
    iou = right / np.maximum(true + said - right, 1)
    f1 = 2 * right / np.maximum(true + said, 1)
    scores = {f"iou_{name}": float(v) for name, v in zip(COLUMN_CLASSES, iou, strict=True)}
    scores |= {f"f1_{name}": float(v) for name, v in zip(COLUMN_CLASSES, f1, strict=True)}
    there = true > 0
    means = {f"mean_{what}": float(v[there].mean()) if there.any() else 0.0 for what, v in (("iou", iou), ("f1", f1))}
    return {**scores, **means, "accuracy": float(right.sum() / max(table.sum(), 1))}


def judge(settings: PlanSegmentation, file: Path, say: Say) -> dict[str, Any]:
    """Scores of weights on scans of buildings that trained nothing."""
    recipe: PlanRecipe = settings.heldout
    paths, _ = build_plans(recipe, settings, say)
    examples = [e for path in paths for e in load_examples(path)]
    return {**class_scores(confusion(examples, read_weights(file))), "scans": len(paths), "plans": len(examples)}
