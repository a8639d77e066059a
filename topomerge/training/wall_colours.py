"""Task `wall_colours`: what colours tell of each place along a wall (`extraction.elevations.colour_network`).

Stretches of the walls of painted scans, with what the network of elevations that ships says of them; mirrored, paler, grey or
with fewer colours now and then. Every n-th scan is watched.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.nn import functional

from topomerge.datasets.pairs.plan_examples import PlanRecipe
from topomerge.datasets.pairs.wall_examples import WallExample, build_walls, load_walls
from topomerge.extraction.elevations.colour_network import (
    COLOUR_CLASSES,
    LEAST_CHANCE,
    coarse_classes,
    colour_inputs,
    read_network,
    with_colours,
)
from topomerge.extraction.elevations.doorways import read_both_ways
from topomerge.extraction.elevations.wall_network import PLACES
from topomerge.io import archive
from topomerge.models.colour_network import ColourNetwork, exported_colours
from topomerge.training.loop import Say, State, mixed
from topomerge.training.networks import NetworkJob, run_network
from topomerge.training.scan_settings import ColourAugment, WallColours
from topomerge.training.wall_segmentation import COARSE_CLASS, class_scores, learned_and_watched
from topomerge.types import Array

Weights = dict[str, Array]


@dataclass(frozen=True, eq=False)
class ColouredWalls:
    """The walls of a painted scan.

    Args:
        first: (F + 1,) the first place of each wall.
        colours: (n, 13, 4) float16.
        classes: (n / 2, 4) what their shape says.
        truth: (n / 2,) index into `COLOUR_CLASSES`.
    """

    first: Array
    colours: Array
    classes: Array
    truth: Array


def fit(settings: WallColours, say: Say) -> dict[str, float]:
    """Train; the scores of the best epoch.

    Raises:
        InputError: no scan to train on or to watch.
    """
    scans = coloured_walls(settings.data, settings, say)
    learned, watched = learned_and_watched(scans, settings)
    torch.manual_seed(mixed(settings.seed))
    job = ColourJob(settings, learned, watched)
    say(f"{len(learned)} scans, {sum(p.numel() for p in job.network.parameters())} weights")
    return run_network(job, settings, settings.steps, say)


def coloured_walls(recipe: PlanRecipe, settings: WallColours, say: Say) -> list[ColouredWalls]:
    """The scans of a set that have colours."""
    paths, _ = build_walls(recipe, settings, say)
    scans = []
    for path in paths:
        example = load_walls(path)
        if example.colours is not None and len(example.truth):
            truth = COARSE_CLASS[example.truth[::PLACES]]
            scans.append(ColouredWalls(example.first, example.colours, shape_classes(example), truth))
    return scans


def shape_classes(example: WallExample) -> Array:
    """(n / 2, 4) float32 what the network of elevations says."""
    ends = zip(example.first[:-1].tolist(), example.first[1:].tolist(), strict=True)
    return np.concatenate([coarse_classes(read_both_ways(example.strips[low:high] / np.float32(255))) for low, high in ends])


class ColourJob(NetworkJob):
    """Stretches of walls, most of them about a door or a window."""

    def __init__(self, settings: WallColours, learned: Sequence[ColouredWalls], watched: Sequence[ColouredWalls]) -> None:
        origin = {"set": settings.data.name, "split": settings.data.split, "scans": len(learned), "watched": len(watched)}
        super().__init__(settings, ColourNetwork(settings.width, settings.dropout), origin)
        self.options, self.learned, self.watched = settings, learned, watched
        self.holes = [np.flatnonzero(np.diff(scan.truth.astype(int)) != 0) for scan in learned]

    def batches(self, state: State) -> Generator[tuple[torch.Tensor, ...], None, None]:
        """Stretches, from a generator of each step."""
        self.network.train()
        options, half = self.options, self.options.length // PLACES
        for step in range(state.step, options.steps):
            rng = np.random.default_rng([options.seed, 1, state.epoch, step])
            torch.manual_seed(mixed(options.seed, state.epoch, step))  # of the dropout
            stretches = []
            for row in rng.integers(len(self.learned), size=options.batch).tolist():
                scan, holes = self.learned[row], self.holes[row]
                middle = int(rng.integers(len(scan.truth)))
                if len(holes) and rng.random() < options.at_holes:
                    middle = int(np.clip(rng.choice(holes) + rng.integers(-half // 3, half // 3 + 1), 0, len(scan.truth) - 1))
                stretches.append(stretch(scan, middle, options, rng))
            yield tuple(torch.from_numpy(np.stack(arrays)) for arrays in zip(*stretches, strict=True))

    def step(self, batch: tuple[torch.Tensor, ...], state: State) -> dict[str, float]:
        """One step of the optimizer."""
        x, scores, truth, weight = self.there(batch)
        each = functional.cross_entropy(self.network(x, scores), truth, reduction="none")
        return self.descend((each * weight).sum() / weight.sum().clamp(min=1), self.options, state)

    def size(self, batch: tuple[torch.Tensor, ...]) -> int:
        """Stretches."""
        return len(batch[0])

    def weights(self) -> Weights:
        """As the package reads them: half precision."""
        assert isinstance(self.network, ColourNetwork)
        self.network.eval()
        return {name: values.astype(np.float16) for name, values in exported_colours(self.network).items()}

    def scores(self) -> dict[str, float]:
        """Of the scans that are watched."""
        weights = {name: values.astype(np.float32) for name, values in self.weights().items()}
        return colour_scores(self.watched, weights, self.options.classes)

    def write_weights(self, path: Path) -> None:
        """An archive of arrays."""
        archive.write(self.weights(), path)


def stretch(scan: ColouredWalls, middle: int, options: WallColours, rng: np.random.Generator) -> tuple[Array, ...]:
    """What the network reads of a stretch of the wall that holds a place, the scores that it changes, truth and weight of each
    place; changed as other scans might show it.

    Args:
        middle: a place, of those that have one answer.
    """
    half = options.length // PLACES
    wall = int(np.clip(np.searchsorted(scan.first // PLACES, middle, "right") - 1, 0, len(scan.first) - 2))
    low, high = (int(v) // PLACES for v in scan.first[wall : wall + 2])
    start = max(min(middle - int(rng.integers(half)), high - half), low)
    stop = min(start + half, high)
    colours = scan.colours[start * PLACES : stop * PLACES].astype(np.float32)
    seen = np.asarray(colours[..., 0].reshape(stop - start, -1).any(axis=1))
    classes, truth = scan.classes[start:stop], scan.truth[start:stop].astype(np.int64)
    if rng.random() < 0.5:
        colours, classes, truth, seen = colours[::-1], classes[::-1], truth[::-1], seen[::-1]
    x, scores = colour_inputs(_spoilt(colours, options.augment, rng), classes)
    weight = np.array(options.classes, np.float32)[truth] * seen
    rest = half - (stop - start)
    return tuple(np.pad(v, [(0, rest)] + [(0, 0)] * (v.ndim - 1)) for v in (x, scores, truth, weight))


def _spoilt(colours: Array, augment: ColourAugment, rng: np.random.Generator) -> Array:
    """Paler, noisier, without some of the elements or all hues; mirrored hues are as good."""
    seen = colours[..., :1] * (rng.random((*colours.shape[:2], 1)) >= rng.uniform(0, augment.lost))
    scale = rng.uniform(augment.faint, 1.2) * rng.choice([-1.0, 1.0], 3) * [1, 1, 1]
    if rng.random() < augment.grey:
        scale[1:] = 0
    values = colours[..., 1:] * scale + rng.normal(0, 1, colours[..., 1:].shape) * rng.uniform(0, augment.noise)
    return np.asarray(np.concatenate([seen, seen * values], axis=-1), np.float32)


def colour_scores(scans: Sequence[ColouredWalls], weights: Weights, classes: Sequence[float]) -> dict[str, float]:
    """Over the places where a colour was seen, by shape and colours, and by shape alone (``shape_``): F1 of each class, and the
    mean logarithm of the probability of what is true, weighted by classes."""
    table = np.zeros((2, len(COLOUR_CLASSES), len(COLOUR_CLASSES)), np.int64)
    sums, total = np.zeros(2), 0.0
    for scan in scans:
        for low, high in zip(scan.first[:-1].tolist(), scan.first[1:].tolist(), strict=True):
            there = scan.colours[low:high, :, 0].reshape((high - low) // PLACES, -1).any(axis=1)
            some = slice(low // PLACES, high // PLACES)
            both = with_colours(scan.colours[low:high].astype(np.float32), scan.classes[some], weights)
            truth, share = scan.truth[some][there], np.array(classes)[scan.truth[some][there]]
            total += float(share.sum())
            for k, chance in enumerate((both[there], scan.classes[some][there])):
                np.add.at(table[k], (truth, chance.argmax(axis=1)), 1)
                sums[k] += share @ np.log(np.maximum(chance[np.arange(len(truth)), truth], LEAST_CHANCE))
    scores = [{**class_scores(t), "log_chance": float(s / max(total, 1.0))} for t, s in zip(table, sums, strict=True)]
    return {**scores[0], **{f"shape_{name}": value for name, value in scores[1].items()}}


def judge(settings: WallColours, file: Path, say: Say) -> dict[str, Any]:
    """Scores of weights on scans of buildings that trained nothing."""
    scans = coloured_walls(settings.heldout, settings, say)
    return {**colour_scores(scans, read_network(file), settings.classes), "scans": len(scans)}
