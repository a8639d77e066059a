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
from topomerge.training.hashed_random import draw_words
from topomerge.training.loop import Exported, ExportedJob, State, derive_seed, run_network
from topomerge.training.packed_pairs import mark_watched, read_scan_building
from topomerge.training.plan_segmentation import compute_log_loss
from topomerge.training.processes import let_main_process_first
from topomerge.training.scan_settings import WallSegmentation
from topomerge.training.tasks import Task
from topomerge.types import Array, LogFn

COARSE_CLASSES = ("wall", "open", "shut", "window")
# Index of each of `WALL_CLASSES` among them: half-open doors are open, niches and cupboards are wall.
COARSE_CLASS = np.array([0, 1, 2, 3, 1, 0, 0])
ScanT = TypeVar("ScanT")
Stretches = tuple[torch.Tensor, torch.Tensor, torch.Tensor]  # (n, 17, length, 32) strips, (n, length / 2) truth and weight
LOST_ELEMENTS = 1  # stream of random numbers of a stretch


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
        self.walls = PackedWalls(learned, settings, self.device)

    def iter_batches(self, state: State) -> Generator[Stretches, None, None]:
        """Yield stretches, by a generator of each step."""
        self.network.train()
        for step in range(state.step, self.options.steps):
            yield self.walls.sample_stretches(self.options.batch, self.start_generator(1, state.epoch, step))

    def train_step(self, batch: Stretches, state: State) -> dict[str, float]:
        """Take one step of the optimizer."""
        x, truth, weight = batch
        each = functional.cross_entropy(self.network(x), truth, reduction="none")
        return self.optimize((each * weight).sum() / weight.sum(), self.options, state)

    def count_items(self, batch: Stretches) -> int:
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


class PackedWalls:
    """The walls of all scans in one table on a device, out of which stretches are gathered and changed there.

    Args:
        options: of the stretches.
    """

    def __init__(self, scans: Sequence[WallExample], options: WallSegmentation, device: torch.device) -> None:
        self.options, self.device = options, device
        nothing = np.zeros((1, DEPTHS, STRIP_CHANNELS), np.uint8)
        strips = torch.from_numpy(np.concatenate([*(scan.strips for scan in scans), nothing]))  # the last place is of no wall
        self.rows = strips.view(-1, STRIP_CHANNELS).to(device)  # one of each depth of each place
        self.present = (strips.flatten(1) > 0).any(dim=1).to(device)
        self.truth = torch.from_numpy(np.concatenate([*(scan.truth for scan in scans), [0]]).astype(np.int64)).to(device)
        self.classes = torch.tensor(options.classes, device=device)
        self.lengths = np.array([len(scan.truth) for scan in scans])
        self.first = np.cumsum([0, *self.lengths])
        starts = list(zip(scans, self.first, strict=False))
        self.low = np.concatenate([first + scan.first[:-1] for scan, first in starts])
        self.high = np.concatenate([first + scan.first[1:] for scan, first in starts])
        self.first_wall = np.cumsum([0, *(len(scan.first) - 1 for scan in scans)])
        holes = [np.flatnonzero(np.diff(scan.truth.astype(int)) != 0) for scan in scans]
        self.holes, self.first_hole = np.concatenate(holes), np.cumsum([0, *map(len, holes)])

    def sample_stretches(self, count: int, rng: np.random.Generator) -> Stretches:
        """Sample so many stretches of walls, mirrored, nearer or farther, and changed as other scans might show them."""
        length, most, pairs = self.options.length, self.options.augment.shift, self.options.length // PLACES
        start, stop = self._draw_ends(count, rng)
        numbers = np.stack([start, stop, rng.random(count) < 0.5, rng.integers(-most, most + 1, count)])
        low, high, mirrored, shift = torch.from_numpy(numbers).to(self.device)[..., None]
        pair = torch.arange(pairs, device=self.device)
        first = low + PLACES * torch.where(mirrored > 0, pairs - 1 - pair, pair)
        both = first[..., None] + torch.arange(PLACES, device=self.device)
        both = torch.where(both < high[..., None], both, len(self.truth) - 1)
        truth, seen = self.truth[both[..., 0]], self.present[both].any(dim=2)
        weight = self.classes[truth] * torch.where(seen, 1.0, self.options.unseen) * (first + PLACES <= high)
        places = torch.where(mirrored[..., None] > 0, both.flip(2), both).view(count, length)
        depths = (torch.arange(DEPTHS, device=self.device) - shift) % DEPTHS
        rows = places[..., None] * DEPTHS + depths[:, None]
        x = self.rows.index_select(0, rows.flatten()).view(*rows.shape, STRIP_CHANNELS)
        return self._corrupt(x, rng).permute(0, 3, 1, 2), truth, weight

    def _draw_ends(self, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """Draw where stretches of walls begin and end, many of them about the side of a door or window."""
        length, scans = self.options.length, rng.integers(len(self.lengths), size=count)
        middle = self.first[scans] + (rng.random(count) * self.lengths[scans]).astype(np.int64)
        holes = np.diff(self.first_hole)[scans]
        at_hole = (rng.random(count) < self.options.at_holes) & (holes > 0)
        chosen = (self.first_hole[scans] + (rng.random(count) * holes).astype(np.int64))[at_hole]
        off = rng.integers(-length // 3, length // 3 + 1, count)[at_hole]
        middle[at_hole] = self.first[scans][at_hole] + self.holes[chosen] + off
        wall = np.searchsorted(self.low, middle, "right") - 1
        wall = np.clip(wall, self.first_wall[scans], self.first_wall[scans + 1] - 1)
        low, high = self.low[wall], self.high[wall]
        start = np.maximum(np.minimum(middle - rng.integers(length, size=count), high - length), low)
        start = np.maximum(start - (start - self.first[scans]) % PLACES, low)
        return start, np.minimum(start + length, high)

    def _corrupt(self, x: torch.Tensor, rng: np.random.Generator) -> torch.Tensor:
        """Return (n, length, 32, 17) strips, 0 to 1, without some of their points, and with what stands before them hidden."""
        count, length, augment = len(x), x.shape[1], self.options.augment
        sparse = np.flatnonzero(rng.random(count) < augment.sparse)
        least = rng.uniform(0, augment.lost * (1 << 16), count).astype(np.int32)[sparse]
        seed = rng.integers(0, 1 << 62, count)[sparse]
        chosen, key, lowest = (torch.from_numpy(numbers).to(self.device) for numbers in (sparse, seed, least))
        words = draw_words(key, LOST_ELEMENTS, x[0].numel()).view(-1, *x.shape[1:])
        x[chosen] *= words >= lowest[:, None, None, None]
        begin, size = rng.integers(length, size=count), rng.integers(4, max(length // 2, 5), count)
        top = np.where(rng.random(count) < augment.hidden, rng.integers(1, BANDS, count), 0)
        blind = [rng.random(count) < share for share in (augment.walk, augment.rays)]
        numbers = torch.from_numpy(np.stack([begin, begin + size, top, *blind])).to(self.device)
        first, end, channels, walk, rays = numbers[..., None, None]
        at = torch.arange(length, device=self.device)[:, None]
        channel = torch.arange(STRIP_CHANNELS, device=self.device)
        lost = (at >= first) & (at < end) & (channel < channels)
        lost |= ((channel == BANDS) & (walk > 0)) | ((channel > BANDS) & (rays > 0))
        x *= ~lost[:, :, None]
        return x.float() / 255


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
