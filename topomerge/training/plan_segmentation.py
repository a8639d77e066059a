"""Task `plan_segmentation`: the network that labels each column of a plan."""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy import ndimage
from torch.nn import functional

from topomerge.datasets.pairs.drawing import TRUE_CLASSES
from topomerge.datasets.pairs.plan_examples import FLAT_SENSOR_SHARES, PlanExample, PlanRecipe, build_plans, load_examples
from topomerge.errors import InputError
from topomerge.extraction.plans.plan_network import (
    EVIDENCE_CHANNELS,
    PLAN_SIGNATURE,
    compute_column_probabilities,
    compute_evidence,
    read_weights,
)
from topomerge.extraction.plans.storey_plan import COLUMN_CLASSES
from topomerge.models.convolutional import PlanProbabilities, PlanUNet
from topomerge.networks.network import Run
from topomerge.training.loop import Exported, ExportedJob, State, derive_seed, prefetch_batches, run_network
from topomerge.training.packed_pairs import mark_watched, read_scan_building
from topomerge.training.processes import let_main_process_first
from topomerge.training.scan_settings import GridSegmentation, PlanAugment, PlanLoss, PlanSegmentation
from topomerge.training.tasks import Task
from topomerge.types import Array, LogFn

SQUARE = np.ones((3, 3))
MOST_THINGS = 14
KNOWN_CHANNEL, WALL_CHANNEL, FULL_CHANNELS, GROUND_CHANNEL, TOP_CHANNEL = 0, 1, (2, 3, 4, 5, 8), 6, 9  # of `evidence`
WALL_TOP = -0.6  # of walls that are raised, in the last of these


def add_grid_noise(x: Array, room: Array, rng: np.random.Generator) -> Array:
    """Return (n, n, 11) evidence of a crop of a grid, changed.

    Args:
        x: as of `plan_network.compute_evidence`; room: (n, n) bool, truly inside of a room: things stand there.
    """
    inside, wall = x[..., KNOWN_CHANNEL] > 0, x[..., WALL_CHANNEL] > 0
    if rng.random() < 0.35:
        inside, wall = _warp_walls(inside, wall, rng)
    if rng.random() < 0.5:
        wall = wall & ndimage.binary_dilation(inside, SQUARE)  # the cells that a ray meets
    if rng.random() < 0.5:
        inside, wall = _add_furniture(inside, wall, room, rng)
    if rng.random() < 0.12:
        rows = _draw_seat_rows(inside & room, rng) & ndimage.binary_erosion(room, SQUARE, 2)
        inside, wall = inside & ~rows, wall | rows
    if rng.random() < 0.5:
        wall = wall & ~_sample_patches(wall.shape, rng.uniform(0.05, 0.5), rng)
    if rng.random() < 0.3:
        inside = inside & ~_sample_patches(wall.shape, rng.uniform(0.01, 0.15), rng)
    if rng.random() < 0.25:
        inside = inside & ndimage.binary_erosion(inside | wall, SQUARE)
    if rng.random() < 0.3:
        wall = wall | (inside & (rng.random(wall.shape) < rng.uniform(0.0005, 0.006)))
    return _convert_to_evidence(x, inside & ~wall, wall)


def _convert_to_evidence(x: Array, inside: Array, wall: Array) -> Array:
    out = x.copy()
    out[..., KNOWN_CHANNEL], out[..., WALL_CHANNEL], out[..., GROUND_CHANNEL] = inside, wall, inside | wall
    out[..., list(FULL_CHANNELS)] = wall[..., None]
    out[..., TOP_CHANNEL] = np.where(wall, WALL_TOP, 0.0)
    return out


def _sample_smooth_field(shape: tuple[int, ...], sigma: float, rng: np.random.Generator) -> Array:
    field = ndimage.gaussian_filter(rng.standard_normal(shape), sigma, mode="wrap")
    return np.asarray(field / field.std())


def _sample_patches(shape: tuple[int, ...], share: float, rng: np.random.Generator) -> Array:
    """Return (n, n) bool, smooth patches that cover a share of a crop."""
    field = _sample_smooth_field(shape, rng.uniform(1, 5), rng)
    return np.asarray(field > np.quantile(field, 1 - share))


def _warp_walls(inside: Array, wall: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Move walls by a column or so, differently from place to place."""
    at = np.indices(inside.shape)
    moved = [a + _sample_smooth_field(inside.shape, rng.uniform(1.5, 6), rng) * rng.uniform(0.2, 1.0) for a in at]
    i, j = (np.clip(np.rint(m), 0, n - 1).astype(int) for m, n in zip(moved, inside.shape, strict=True))
    return inside[i, j], wall[i, j]


def _add_furniture(inside: Array, wall: Array, room: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Add boxes on the floor, full, hollow, or unseen altogether."""
    inside, wall = inside.copy(), wall.copy()
    places = np.argwhere(ndimage.binary_erosion(inside & room, SQUARE))
    for _ in range(int(rng.integers(1, MOST_THINGS)) if len(places) else 0):
        middle = places[rng.integers(len(places))]
        size = rng.integers(1, 9, 2) if rng.random() < 0.6 else rng.integers(1, 3, 2)
        box = tuple(slice(max(int(m - s // 2), 0), int(m + s - s // 2)) for m, s in zip(middle, size, strict=True))
        floor, rim = room[box], np.ones(room[box].shape, bool)
        kind = int(rng.integers(3))
        rim[1:-1, 1:-1] = kind == 0
        inside[box] &= ~floor
        if kind < 2:
            wall[box] |= floor & rim
    return inside, wall


def _draw_seat_rows(floor: Array, rng: np.random.Generator) -> Array:
    """Return (n, n) bool, parallel rows, whole or of single seats, somewhere on a large floor."""
    places = np.argwhere(ndimage.binary_erosion(floor, SQUARE, 6))
    if not len(places):
        return np.zeros(floor.shape, bool)
    i, j = np.indices(floor.shape) - places[rng.integers(len(places))][:, None, None]
    turn = rng.uniform(0, np.pi) if rng.random() < 0.5 else 0.0
    u, v = i * np.cos(turn) + j * np.sin(turn), j * np.cos(turn) - i * np.sin(turn)
    rows = (np.abs(u) < rng.integers(10, 45) / 2) & (np.abs(v) < rng.integers(12, 50) / 2)
    rows &= u % rng.uniform(6, 12) < rng.uniform(1, 3)
    if rng.random() < 0.6:
        rows &= v % rng.uniform(5, 9) < rng.uniform(2, 5)
    return np.asarray(rows)


LEAST_PROBABILITY = 1e-6  # of which a logarithm is taken
LEAST_COLUMNS = 100  # inside of a plan that trains
BARE_EVERY = 4  # plans that are shown as grids: one without furniture
LASER_HEIGHTS, RAISED_HEIGHTS, FLOOR_HEIGHTS = (0.2, 0.5), (0.0, 2.4), (-0.1, 0.1)  # m: robots look there; walls of grids; floors
UPPER_CHANNELS, FLOOR_CHANNEL = (5, 7, 8, 9), (6,)  # of `evidence`
FLOOR_LOST = 0.3  # share of the crops without an upper half that lose their floor instead
PlanTensors = tuple[Array, Array, Array]  # evidence, truth and weight of each column


def fit(settings: PlanSegmentation, log_line: LogFn) -> dict[str, float]:
    """Train; the scores of the best epoch.

    Raises:
        InputError: no scan to train on or to watch.
    """
    with let_main_process_first(settings):
        paths, _ = build_plans(settings.data, settings, log_line)
    scans = [load_examples(path) for path in paths]
    watches = mark_watched([read_scan_building(path) for path in paths], settings.hold_out)
    learned, watched = ([e for s, w in zip(scans, watches, strict=True) if w == which for e in s] for which in (False, True))
    learned = [e for e in learned if e.plan.inside.sum() > LEAST_COLUMNS]
    if isinstance(settings, GridSegmentation):
        learned, watched = ([convert_to_grid(e, k % BARE_EVERY > 0) for k, e in enumerate(some)] for some in (learned, watched))
    if not learned or not watched:
        raise InputError(f"data.scans={settings.data.scans}: too few scans to train on some and watch others")
    torch.manual_seed(derive_seed(settings.seed))
    job = PlanJob(settings, learned, watched)
    log_line(f"{len(learned)} plans, {sum(p.numel() for p in job.network.parameters())} weights")
    return run_network(job, settings, settings.steps, log_line)


class PlanJob(ExportedJob):
    """Crops of plans, larger plans more often."""

    unit = "crops"

    def __init__(self, settings: PlanSegmentation, learned: Sequence[PlanExample], watched: Sequence[PlanExample]) -> None:
        origin = {"set": settings.data.name, "split": settings.data.split, "plans": len(learned), "watched": len(watched)}
        super().__init__(settings, PlanUNet(settings.widths), origin)
        self.options, self.watched = settings, watched
        self.plans = [build_plan_tensors(e, settings.loss) for e in learned]
        probability = np.sqrt([float(e.room.size) for e in learned])
        self.probability = probability / probability.sum()

    def iter_batches(self, state: State) -> Generator[tuple[torch.Tensor, ...], None, None]:
        """Yield crops."""
        self.network.train()
        yield from prefetch_batches(self.iter_crops(state))

    def iter_crops(self, state: State) -> Iterator[tuple[torch.Tensor, ...]]:
        """Yield the crops of the state's epoch from its step on, from a generator of each step."""
        options = self.options
        for step in range(state.step, options.steps):
            rng = self.start_generator(1, state.epoch, step)
            rows = rng.choice(len(self.plans), options.batch, p=self.probability)
            crops = [crop(self.plans[row], options.crop, options.augment, rng) for row in rows]
            x, truth, weight = (np.stack(arrays) for arrays in zip(*crops, strict=True))
            labels = torch.from_numpy(truth.astype(np.int64))
            yield torch.from_numpy(x).permute(0, 3, 1, 2), labels, torch.from_numpy(weight.astype(np.float32))

    def train_step(self, batch: tuple[torch.Tensor, ...], state: State) -> dict[str, float]:
        """Take one step of the optimizer."""
        options, (x, truth, weight) = self.options, self.move_to_device(batch)
        each = functional.cross_entropy(self.network(x), truth, reduction="none")
        loss = (each * weight).sum() / weight.sum()
        return self.optimize(loss, options, state)

    def count_items(self, batch: tuple[torch.Tensor, ...]) -> int:
        """Count the crops of a batch."""
        return len(batch[0])

    def exported(self) -> Exported:
        """Return the network with probabilities for scores."""
        assert isinstance(self.network, PlanUNet)
        return Exported(PlanProbabilities(self.network), PLAN_SIGNATURE, [torch.rand(2, EVIDENCE_CHANNELS, 64, 48)])

    def compute_scores(self) -> dict[str, float]:
        """Compute the scores of the validation scans."""
        return score_plans(self.watched, self.run())


def convert_to_grid(example: PlanExample, furnished: bool) -> PlanExample:
    """Return the plan of a scan as a robot would leave it, or a draughtsman: walls alone, all raised alike. Grids stay as they
    are.

    Args:
        furnished: with what a laser meets near the floor as walls.
    """
    plan = example.plan
    if example.source.split("/")[0] in FLAT_SENSOR_SHARES:
        return example
    standing = plan.is_occupied(*LASER_HEIGHTS) & plan.inside if furnished else np.zeros_like(plan.wall)
    wall, inside = plan.wall | standing, plan.inside & ~standing
    full, floor = (plan.profile.dtype.type(plan.bands.build_mask(*heights)) for heights in (RAISED_HEIGHTS, FLOOR_HEIGHTS))
    profile = np.where(wall, full | floor, np.where(inside, floor, plan.profile.dtype.type(0)))
    ceiling = np.full(wall.shape, np.nan)
    return replace(example, plan=replace(plan, wall=wall, inside=inside, profile=profile, ceiling=ceiling))


def build_plan_tensors(example: PlanExample, loss: PlanLoss) -> PlanTensors:
    """Build evidence, truth and weight of each column."""
    seen = ndimage.binary_dilation(example.plan.inside | example.plan.wall, np.ones((3, 3)))
    weight = np.array(loss.classes, np.float32)[example.truth] * np.where(seen, 1.0, loss.unseen)
    return compute_evidence(example.plan).astype(np.float16), example.truth, weight.astype(np.float16)


def crop(plan: PlanTensors, side: int, augment: PlanAugment, rng: np.random.Generator) -> PlanTensors:
    """Return (R, 1, 32, 32, 32), where cells with a point are 1, the others 0."""
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
        x = add_grid_noise(x, truth == TRUE_CLASSES.index("inside"), rng)
    if rng.random() < augment.columns:
        x[..., 1:10] *= rng.random((side, side, 1)) > rng.uniform(0, augment.lost)
    return x, truth, weight


def score_plans(examples: Sequence[PlanExample], network: Run) -> dict[str, float]:
    """Compute the scores of the columns of which something is known (`score_classes`), and their log loss."""
    table, loss = np.zeros((len(COLUMN_CLASSES), len(COLUMN_CLASSES)), np.int64), 0.0
    for example in examples:
        seen = example.plan.inside | example.plan.wall
        probability, truth = compute_column_probabilities(example.plan, network)[seen], example.truth[seen]
        np.add.at(table, (truth, probability.argmax(axis=-1)), 1)
        loss += compute_log_loss(probability, truth)
    return {**score_classes(table), "loss": loss / max(int(table.sum()), 1)}


def compute_log_loss(probability: Array, truth: Array) -> float:
    """Compute the sum of -log of the probabilities (n, k) of the true classes (n,)."""
    right = np.take_along_axis(probability, truth.astype(np.int64)[:, None], axis=1)
    return float(-np.log(np.maximum(right, LEAST_PROBABILITY)).sum())


def score_classes(table: Array) -> dict[str, float]:
    """Compute IoU and F1 of each class, their means over the classes that there are, and the share of columns that are right."""
    right, true, predicted = np.diag(table), table.sum(axis=1), table.sum(axis=0)
    iou = right / np.maximum(true + predicted - right, 1)
    f1 = 2 * right / np.maximum(true + predicted, 1)
    scores = {f"iou_{name}": float(v) for name, v in zip(COLUMN_CLASSES, iou, strict=True)}
    scores |= {f"f1_{name}": float(v) for name, v in zip(COLUMN_CLASSES, f1, strict=True)}
    present = true > 0
    means = {f"mean_{what}": float(v[present].mean()) if present.any() else 0.0 for what, v in (("iou", iou), ("f1", f1))}
    return {**scores, **means, "accuracy": float(right.sum() / max(table.sum(), 1))}


def judge(settings: PlanSegmentation, file: Path, log_line: LogFn) -> dict[str, Any]:
    """Return scores of weights on scans of buildings that trained nothing."""
    recipe: PlanRecipe = settings.heldout
    paths, _ = build_plans(recipe, settings, log_line)
    examples = [e for path in paths for e in load_examples(path)]
    return {**score_plans(examples, read_weights(file)), "scans": len(paths), "plans": len(examples)}


PLAN_SCORES = ("mean_iou", "mean_f1", "accuracy", "loss", *(f"{of}_{name}" for of in ("iou", "f1") for name in COLUMN_CLASSES))
PLAN_TASK = Task(PlanSegmentation, fit, PLAN_SCORES, judge, "topomerge.networks", "plan_network.onnx", hours=5.0, lower=("loss",))
GRID_TASK = Task(GridSegmentation, fit, PLAN_SCORES, judge, "topomerge.networks", "grid_network.onnx", hours=1.2, lower=("loss",))
