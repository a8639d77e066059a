"""Task `wall_segmentation`: the network that says what is in each place along a wall (`extraction.elevations.elevation`).

Stretches of the walls of simulated scans, mirrored, seen from a little nearer or farther, with points taken away now and then.
Those of every n-th building are watched.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from torch.nn import functional

from topomerge.datasets.pairs.wall_examples import WallExample, build_walls, load_walls
from topomerge.errors import InputError
from topomerge.extraction.elevations.elevation import (
    BANDS,
    DEPTHS,
    PLACES,
    STRIP_CHANNELS,
    WALL_CLASSES,
    WALL_SIGNATURE,
    compute_place_probabilities,
    read_network,
)
from topomerge.models.convolutional import WallNetwork, WallProbabilities
from topomerge.networks.network import Run
from topomerge.training.loop import Exported, ExportedJob, State, derive_seed, run_network
from topomerge.training.packed_pairs import mark_watched, read_scan_building
from topomerge.training.plan_segmentation import compute_log_loss
from topomerge.training.processes import let_main_process_first
from topomerge.training.scan_settings import WallAugment, WallSegmentation
from topomerge.training.tasks import Task
from topomerge.types import Array, LogFn

COARSE_CLASSES = ("wall", "open", "shut", "window")
# Index of each of `WALL_CLASSES` among them: half-open doors are open, niches and cupboards are wall.
COARSE_CLASS = np.array([0, 1, 2, 3, 1, 0, 0])
ScanT = TypeVar("ScanT")
Stretch = tuple[Array, Array, Array]  # strip, truth and weight of each place


def fit(settings: WallSegmentation, log_line: LogFn) -> dict[str, float]:
    """Train; the scores of the best epoch.

    Raises:
        InputError: no scan to train on or to watch.
    """
    with let_main_process_first(settings):
        paths, _ = build_walls(settings.data, settings, log_line)
    scans = [load_walls(path) for path in paths]
    learned, watched = split_train_val(scans, [read_scan_building(path) for path in paths], settings)
    torch.manual_seed(derive_seed(settings.seed))
    job = WallJob(settings, learned, watched)
    log_line(f"{len(learned)} scans, {sum(p.numel() for p in job.network.parameters())} weights")
    return run_network(job, settings, settings.steps, log_line)


def split_train_val(
    scans: Sequence[ScanT], buildings: Sequence[str], settings: WallSegmentation
) -> tuple[list[ScanT], list[ScanT]]:
    """Return the scans to train on, and those of every n-th building, which are watched.

    Raises:
        InputError: too few for both.
    """
    watches = mark_watched(buildings, settings.hold_out)
    learned, watched = ([s for s, w in zip(scans, watches, strict=True) if w == which] for which in (False, True))
    if not learned or not watched:
        raise InputError(f"data.scans={settings.data.scans}: too few scans to train on some and watch others")
    return learned, watched


class WallJob(ExportedJob):
    """Stretches of walls, most of them about a door or a window."""

    unit = "stretches"

    def __init__(self, settings: WallSegmentation, learned: Sequence[WallExample], watched: Sequence[WallExample]) -> None:
        origin = {"set": settings.data.name, "split": settings.data.split, "scans": len(learned), "watched": len(watched)}
        super().__init__(settings, WallNetwork(settings.widths), origin)
        self.options, self.learned, self.watched = settings, learned, watched
        self.holes = [np.flatnonzero(np.diff(scan.truth.astype(int)) != 0) for scan in learned]

    def iter_batches(self, state: State) -> Generator[tuple[torch.Tensor, ...], None, None]:
        """Yield stretches, from a generator of each step."""
        self.network.train()
        options = self.options
        for step in range(state.step, options.steps):
            rng = self.start_generator(1, state.epoch, step)
            stretches = []
            for row in rng.integers(len(self.learned), size=options.batch).tolist():
                scan, holes = self.learned[row], self.holes[row]
                middle = int(rng.integers(len(scan.truth)))
                if len(holes) and rng.random() < options.at_holes:
                    middle = int(rng.choice(holes) + rng.integers(-options.length // 3, options.length // 3 + 1))
                stretches.append(sample_stretch(scan, middle, options, rng))
            x, truth, weight = (np.stack(arrays) for arrays in zip(*stretches, strict=True))
            yield torch.from_numpy(x).permute(0, 3, 1, 2), torch.from_numpy(truth), torch.from_numpy(weight)

    def train_step(self, batch: tuple[torch.Tensor, ...], state: State) -> dict[str, float]:
        """Take one step of the optimizer."""
        x, truth, weight = self.move_to_device(batch)
        each = functional.cross_entropy(self.network(x), truth, reduction="none")
        return self.optimize((each * weight).sum() / weight.sum(), self.options, state)

    def count_items(self, batch: tuple[torch.Tensor, ...]) -> int:
        """Count the stretches of a batch."""
        return len(batch[0])

    def exported(self) -> Exported:
        """Return the network with probabilities for scores."""
        assert isinstance(self.network, WallNetwork)
        return Exported(WallProbabilities(self.network), WALL_SIGNATURE, [torch.rand(2, 8, DEPTHS, STRIP_CHANNELS)])

    def compute_scores(self) -> dict[str, float]:
        """Compute the scores of the validation scans."""
        return score_walls(self.watched, self.run())


def downsample_truth(truth: Array, strips: Array) -> tuple[Array, Array]:
    """Return the (n / 2,) class of each answer, that of its first element, and (n / 2,) bool, whether anything was seen."""
    present: Array = np.asarray(strips.reshape(len(strips) // PLACES, -1).any(axis=1))
    return truth[::PLACES].astype(np.int64), present


def sample_stretch(scan: WallExample, middle: int, options: WallSegmentation, rng: np.random.Generator) -> Stretch:
    """Sample a stretch of the wall that holds a place, changed as other scans might show it.

    Args:
        middle: a place of the scan's strips.
    """
    wall = int(np.clip(np.searchsorted(scan.first, middle, "right") - 1, 0, len(scan.first) - 2))
    low, high = int(scan.first[wall]), int(scan.first[wall + 1])
    start = max(min(middle - int(rng.integers(options.length)), high - options.length), low) & ~1
    start = max(start, low)
    stop = min(start + options.length, high)
    x = np.zeros((options.length, DEPTHS, STRIP_CHANNELS), np.float32)
    truth, weight = np.zeros(options.length, np.uint8), np.zeros(options.length // PLACES, np.float32)
    x[: stop - start], truth[: stop - start] = scan.strips[start:stop] / np.float32(255), scan.truth[start:stop]
    right, present = downsample_truth(truth, x)
    weight[: (stop - start) // PLACES] = 1.0
    weight *= np.array(options.classes, np.float32)[right] * np.where(present, 1.0, options.unseen)
    if rng.random() < 0.5:
        x, right, weight = x[::-1], right[::-1], weight[::-1]
    return _corrupt_strip(x, options.augment, rng), np.ascontiguousarray(right), np.ascontiguousarray(weight, np.float32)


def _corrupt_strip(x: Array, augment: WallAugment, rng: np.random.Generator) -> Array:
    """Return a strip with its face somewhat nearer or farther, without some of its points, and with what stands before it
    hidden."""
    x = np.roll(x, int(rng.integers(-augment.shift, augment.shift + 1)), axis=1)
    if rng.random() < augment.sparse:
        x = x * (rng.random(x.shape) > rng.uniform(0, augment.lost)).astype(np.float32)
    if rng.random() < augment.hidden:
        start, length = int(rng.integers(len(x))), int(rng.integers(4, len(x) // 2))
        x = x.copy()
        x[start : start + length, :, : int(rng.integers(1, BANDS))] = 0
    for share, channels in ((augment.walk, slice(BANDS, BANDS + 1)), (augment.rays, slice(BANDS + 1, None))):
        if rng.random() < share:
            x = x.copy()
            x[..., channels] = 0
    return np.ascontiguousarray(x)


def score_walls(examples: Sequence[WallExample], network: Run) -> dict[str, float]:
    """Return the F1 of each class over the places where anything was seen, the mean of those of doors, open or half open, and
    shut, and log loss."""
    loss, table = 0.0, np.zeros((len(WALL_CLASSES), len(WALL_CLASSES)), np.int64)
    for scan in examples:
        for low, high in zip(scan.first[:-1], scan.first[1:], strict=True):
            strip = scan.strips[low:high] / np.float32(255)
            right, present = downsample_truth(scan.truth[low:high], strip)
            probability = compute_place_probabilities(strip, network)[present]
            np.add.at(table, (right[present], probability.argmax(axis=1)), 1)
            loss += compute_log_loss(probability, right[present])
    coarse = np.zeros((len(COARSE_CLASSES), len(COARSE_CLASSES)), np.int64)
    np.add.at(coarse, np.ix_(COARSE_CLASS, COARSE_CLASS), table)
    scores = {**compute_f1_scores(table, WALL_CLASSES), **score_colour_classes(coarse)}
    return {**scores, "loss": loss / max(int(table.sum()), 1)}


def score_colour_classes(table: Array) -> dict[str, float]:
    """Return the F1 of each of `COARSE_CLASSES`, and the mean of those of doors.

    Args:
        table: (4, 4) how often each was taken for each.
    """
    scores = compute_f1_scores(table, COARSE_CLASSES)
    return {**scores, "f1_doors": float((scores["f1_open"] + scores["f1_shut"]) / 2)}


def compute_f1_scores(table: Array, names: Sequence[str]) -> dict[str, float]:
    """Compute F1 of each class.

    Args:
        table: (k, k) how often each was taken for each.
    """
    f1 = 2 * np.diag(table) / np.maximum(table.sum(axis=0) + table.sum(axis=1), 1)
    return {f"f1_{name}": float(v) for name, v in zip(names, f1, strict=True)}


def judge(settings: WallSegmentation, file: Path, log_line: LogFn) -> dict[str, Any]:
    """Return scores of weights on scans of buildings that trained nothing."""
    paths, _ = build_walls(settings.heldout, settings, log_line)
    return {**score_walls([load_walls(path) for path in paths], read_network(file)), "scans": len(paths)}


TASK = Task(
    WallSegmentation,
    fit,
    ("f1_doors", "f1_wall", "f1_open", "f1_shut", "f1_window", "f1_half", "f1_niche", "f1_cupboard", "loss"),
    judge,
    "topomerge.networks",
    "wall_network.onnx",
    hours=1.2,
    lower=("loss",),
)
