"""Task `plan_segmentation`: the network that labels each column of a plan."""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy import ndimage
from torch.nn import functional

from topomerge.datasets.pairs.drawing import TRUE_CLASSES
from topomerge.datasets.pairs.plan_examples import FLAT_SENSOR_SHARES, PlanExample, PlanRecipe, build_plans, load_examples
from topomerge.datasets.real.home_plans import UNTOLD, load_home_examples
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
from topomerge.training.grid_noise import add_grid_noise
from topomerge.training.hashed_random import draw_uniforms
from topomerge.training.loop import Exported, ExportedJob, State, derive_seed, prefetch_batches, run_network
from topomerge.training.packed_pairs import mark_watched, read_scan_building
from topomerge.training.processes import let_main_process_first
from topomerge.training.scan_settings import GridSegmentation, PlanAugment, PlanLoss, PlanSegmentation
from topomerge.training.tasks import Task
from topomerge.types import Array, LogFn

LEAST_PROBABILITY = 1e-6  # of which a logarithm is taken
LEAST_COLUMNS = 100  # inside of a plan that trains
BARE_EVERY = 4  # plans that are shown as grids: one without furniture
LASER_HEIGHTS, RAISED_HEIGHTS, FLOOR_HEIGHTS = (0.2, 0.5), (0.0, 2.4), (-0.1, 0.1)  # m: robots look there; walls of grids; floors
UPPER_CHANNELS, FLOOR_CHANNEL = (5, 7, 8, 9), (6,)  # of `evidence`
LOST_CHANNELS = slice(1, 10)  # of columns that are lost: all but whether they are known and how large they are
FLOOR_LOST = 0.3  # share of the crops without an upper half that lose their floor instead
OUTSIDE, INSIDE = (TRUE_CLASSES.index(name) for name in ("outside", "inside"))
QUARTER_TURNS = np.array([[[1, 0, 0], [0, 1, 0]], [[0, 1, 0], [-1, 0, 1]], [[-1, 0, 1], [0, -1, 1]], [[0, -1, 1], [1, 0, 0]]])
LOST_COLUMNS = 1  # stream of random numbers of a crop
PlanTensors = tuple[Array, Array, Array]  # evidence, truth and weight of each column
Crops = tuple[torch.Tensor, torch.Tensor, torch.Tensor]  # (n, 11, side, side) evidence, (n, side, side) truth and weight


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
    homes = load_homes(settings.homes) if isinstance(settings, GridSegmentation) else []
    torch.manual_seed(derive_seed(settings.seed))
    job = PlanJob(settings, learned, watched, homes)
    log_line(f"{len(learned) + len(homes)} plans, {sum(p.numel() for p in job.network.parameters())} weights")
    return run_network(job, settings, settings.steps, log_line)


def load_homes(paths: Sequence[str]) -> list[PlanExample]:
    """Load the plans of real homes.

    Args:
        paths: files of vacuum robots, or folders of them, of which those are left out that tell no rooms apart.

    Raises:
        InputError: a file is none, or none of a folder's is any use.
    """
    examples = []
    for path in map(Path, paths):
        if not path.is_dir():
            examples += load_home_examples(path)
            continue
        found = []
        for file in sorted(path.glob("*.json")):
            with suppress(InputError):
                found += load_home_examples(file)
        if not found:
            raise InputError(f"homes: {path} holds no robot's map with two rooms or more")
        examples += found
    return examples


class PlanJob(ExportedJob):
    """Crops of plans, larger plans more often."""

    unit = "crops"

    def __init__(
        self,
        settings: PlanSegmentation,
        learned: Sequence[PlanExample],
        watched: Sequence[PlanExample],
        homes: Sequence[PlanExample] = (),
    ) -> None:
        origin = {"set": settings.data.name, "split": settings.data.split, "plans": len(learned), "watched": len(watched)}
        origin |= {"homes": len(homes)} if homes else {}
        super().__init__(settings, PlanUNet(settings.widths), origin)
        self.options, self.watched = settings, watched
        plans = [build_plan_tensors(e, settings.loss) for e in (*learned, *homes)]
        self.plans = PackedPlans(plans, settings.crop, settings.augment, self.device)
        probability = np.sqrt([float(e.room.size) for e in learned])
        self.probability = probability / probability.sum()
        if homes:
            share = settings.home_share if isinstance(settings, GridSegmentation) else 0.0
            self.probability = np.append(self.probability * (1 - share), np.full(len(homes), share / len(homes)))

    def iter_batches(self, state: State) -> Generator[Crops, None, None]:
        """Yield crops."""
        self.network.train()
        yield from prefetch_batches(self.iter_crops(state))

    def iter_crops(self, state: State) -> Iterator[Crops]:
        """Yield the crops of the state's epoch from its step on, by a generator of each step."""
        options = self.options
        for step in range(state.step, options.steps):
            rng = self.start_generator(1, state.epoch, step)
            yield self.plans.sample_crops(rng.choice(len(self.probability), options.batch, p=self.probability), rng)

    def train_step(self, batch: Crops, state: State) -> dict[str, float]:
        """Take one step of the optimizer."""
        options, (x, truth, weight) = self.options, batch
        each = functional.cross_entropy(self.network(x), truth, reduction="none")
        loss = (each * weight).sum() / weight.sum()
        return self.optimize(loss, options, state)

    def count_items(self, batch: Crops) -> int:
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
    told = example.truth != UNTOLD
    truth = np.where(told, example.truth, np.uint8(INSIDE))
    weight = np.array(loss.classes, np.float32)[truth] * np.where(seen, 1.0, loss.unseen) * told
    return compute_evidence(example.plan).astype(np.float16), truth, weight.astype(np.float16)


class PackedPlans:
    """The columns of all plans in one table on a device, out of which crops are gathered and changed there.

    Args:
        plans: as of `build_plan_tensors`; side: of a crop, columns.
    """

    def __init__(self, plans: Sequence[PlanTensors], side: int, augment: PlanAugment, device: torch.device) -> None:
        self.side, self.augment, self.device = side, augment, device
        self.shapes = np.array([truth.shape for _, truth, _ in plans])
        self.first = np.cumsum([0, *(truth.size for _, truth, _ in plans)])
        inside = [np.flatnonzero(x[..., 0] > 0).astype(np.int32) for x, _, _ in plans]
        self.inside, self.first_inside = np.concatenate(inside), np.cumsum([0, *map(len, inside)])
        around = np.zeros((1, EVIDENCE_CHANNELS), np.float16), np.full(1, OUTSIDE, np.uint8), np.zeros(1, np.float16)
        columns = [[array.reshape(plan[1].size, *array.shape[2:]) for array in plan] for plan in plans]
        self.evidence, self.truth, self.weight = (  # the last row is what lies around plans
            torch.from_numpy(np.concatenate(arrays)).to(device) for arrays in zip(*columns, around, strict=True)
        )

    def sample_crops(self, plans: Array, rng: np.random.Generator) -> Crops:
        """Sample a crop of each of (n,) plans about a place inside, turned, mirrored and changed."""
        rows, count, augment = self._gather_rows(plans, rng), len(plans), self.augment
        x = self.evidence.index_select(0, rows.flatten()).float().view(*rows.shape, -1)
        truth, weight = self.truth[rows].long(), self.weight[rows].float()
        blind, floor = rng.random(count) < augment.upper, rng.random(count) < FLOOR_LOST
        for lost, channels in ((blind & ~floor, UPPER_CHANNELS), (blind & floor, FLOOR_CHANNEL)):
            chosen = torch.from_numpy(np.flatnonzero(lost)).to(self.device)
            for channel in channels:
                x[chosen, :, :, channel] = 0
        noisy = np.flatnonzero(rng.random(count) < augment.grid_noise)
        if len(noisy):
            chosen = torch.from_numpy(noisy).to(self.device)
            x[chosen] = add_grid_noise(x[chosen], truth[chosen] == INSIDE, rng)
        sparse = np.flatnonzero(rng.random(count) < augment.columns)
        share, seed = rng.uniform(0, augment.lost, count)[sparse], rng.integers(0, 1 << 62, count)[sparse]
        chosen, least, key = (torch.from_numpy(a).to(self.device) for a in (sparse, share.astype(np.float32), seed))
        index = torch.arange(self.side**2, device=self.device).view(self.side, self.side)
        kept = draw_uniforms(key[:, None, None], LOST_COLUMNS, index) > least[:, None, None]
        x[chosen, :, :, LOST_CHANNELS] *= kept[..., None]
        return x.permute(0, 3, 1, 2), truth, weight

    def _gather_rows(self, plans: Array, rng: np.random.Generator) -> torch.Tensor:
        """Return (n, side, side) rows of the table, of crops about places inside of plans, turned by quarters and mirrored."""
        side, count, shape = self.side, len(plans), self.shapes[plans].T
        places = self.inside[self.first_inside[plans] + (rng.random(count) * np.diff(self.first_inside)[plans]).astype(np.int64)]
        start = np.stack([places // shape[1], places % shape[1]]) - rng.integers(side // 4, 3 * side // 4, (2, count))
        turn = QUARTER_TURNS[rng.integers(4, size=count)] * (1, 1, side - 1)
        mirror = rng.random(count) < 0.5
        turn[mirror, :, 2] += turn[mirror, :, 0] * (side - 1)
        turn[mirror, :, 0] *= -1
        turn[..., 2] += start.T
        down, across, corner = torch.from_numpy(turn.transpose(2, 1, 0).copy()).to(self.device)[..., None, None]
        size, first = (torch.from_numpy(of.copy()).to(self.device)[..., None, None] for of in (shape, self.first[plans]))
        at = torch.arange(side, device=self.device)
        i, j = down * at[:, None] + across * at + corner
        on_plan = (i >= 0) & (i < size[0]) & (j >= 0) & (j < size[1])
        return torch.where(on_plan, first + i * size[1] + j, len(self.truth) - 1)


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
