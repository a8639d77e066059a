"""Task `drawing_segmentation`: the network that says what each pixel of a drawn floor plan shows."""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.nn import functional

from topomerge.datasets.drawings.page_stream import Page, PageStream
from topomerge.datasets.drawings.shapes import DrawingRecipe
from topomerge.errors import InputError
from topomerge.models.convolutional import DrawingProbabilities, DrawingUNet
from topomerge.networks.drawing import DRAWING_CLASSES, DRAWING_FILE, DRAWING_SIGNATURE
from topomerge.networks.network import Run, load_network
from topomerge.training.loop import Exported, ExportedJob, State, derive_seed, prefetch_batches, run_network
from topomerge.training.plan_segmentation import compute_log_loss
from topomerge.training.processes import let_main_process_first
from topomerge.training.scan_settings import DrawingSegmentation
from topomerge.training.tasks import Task
from topomerge.types import Array, LogFn

TRAINED, WATCHED, JUDGED = 1, 2, 3  # streams of random numbers: no page is in two
DARKER = 0.3  # by how much pages differ in brightness beyond what they are drawn with


def fit(settings: DrawingSegmentation, log_line: LogFn) -> dict[str, float]:
    """Train; the scores of the best epoch.

    Raises:
        InputError: no plan to draw.
    """
    with let_main_process_first(settings):
        stream = PageStream(settings.data, settings.cache, (settings.seed, TRAINED), settings.crop, settings.jobs, log_line)
    try:
        watched = draw_pages(settings.watched, settings, WATCHED, log_line)
        torch.manual_seed(derive_seed(settings.seed))
        job = DrawingJob(settings, stream, watched)
        log_line(f"{len(stream.shapes)} plans, {sum(p.numel() for p in job.network.parameters())} weights")
        return run_network(job, settings, settings.steps, log_line)
    finally:
        stream.close()


def draw_pages(recipe: DrawingRecipe, settings: DrawingSegmentation, number: int, log_line: LogFn) -> list[Page]:
    """Draw the pages that are watched, or judged, here: other processes would not have started by then."""
    stream = PageStream(recipe, settings.cache, (settings.seed, number), settings.crop, 1, log_line)
    return list(stream.iter_pages(0, settings.watched_pages))


class DrawingJob(ExportedJob):
    """Batches of the latest pages; in each step some are drawn anew and as many of the oldest go."""

    unit = "pages"

    def __init__(self, settings: DrawingSegmentation, stream: PageStream, watched: Sequence[Page]) -> None:
        origin = {"set": settings.data.name, "split": settings.data.split, "plans": len(stream.shapes), "watched": len(watched)}
        network = DrawingUNet(settings.widths).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        super().__init__(settings, network, origin)
        self.options, self.stream, self.watched = settings, stream, watched
        side = settings.crop
        self.pictures = torch.zeros((settings.pages, side, side, 3), dtype=torch.uint8, device=self.device)
        self.truths = torch.zeros((settings.pages, side, side), dtype=torch.uint8, device=self.device)
        self.weight = torch.tensor(settings.classes, device=self.device)
        self.drawn = 0  # pages so far
        self.pages: Iterator[Page] | None = None

    def iter_batches(self, state: State) -> Generator[tuple[Any, ...], None, None]:
        """Yield pages."""
        self.network.train()
        yield from prefetch_batches(self.iter_fresh(state))

    def iter_fresh(self, state: State) -> Iterator[tuple[list[Page], Array, int, Array]]:
        """Yield new pages and rows, turn and brightness of each step from the state's on, from a generator of each step."""
        options = self.options
        for step in range(state.step, options.steps):
            target = (state.epoch * options.steps + step) * options.fresh + options.pages
            start = max(self.drawn, target - options.pages)
            if self.pages is None or self.drawn < start:
                self.pages = self.stream.iter_pages(start)
                self.drawn = start
            fresh = [next(self.pages) for _ in range(target - self.drawn)]
            self.drawn = target
            rng = self.start_generator(4, state.epoch, step)
            rows = rng.choice(options.pages, options.batch, replace=options.batch > options.pages)
            yield fresh, rows, int(rng.integers(4)), rng.uniform(1 - DARKER, 1, options.batch).astype(np.float32)

    def train_step(self, batch: tuple[Any, ...], state: State) -> dict[str, float]:
        """Take one step of the optimizer."""
        options, (fresh, rows, turn, bright) = self.options, batch
        target = (state.epoch * options.steps + state.step) * options.fresh + options.pages
        for number, (picture, classes) in enumerate(fresh, target - len(fresh)):
            self.pictures[number % options.pages] = torch.tensor(picture, device=self.device)
            self.truths[number % options.pages] = torch.tensor(classes, device=self.device)
        chosen = torch.as_tensor(rows, device=self.device)
        x = (
            self.pictures[chosen].permute(0, 3, 1, 2).float()
            / 255
            * torch.as_tensor(bright, device=self.device)[:, None, None, None]
        )
        x, truth = torch.rot90(x, turn, (2, 3)), torch.rot90(self.truths[chosen].long(), turn, (1, 2))
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.device.type != "cpu" or has_bfloat_units()):
            scores = self.network(x.contiguous(memory_format=torch.channels_last))
        loss = functional.cross_entropy(scores.float(), truth, self.weight)
        if options.dice:
            loss = loss + options.dice * compute_dice_loss(scores.float(), truth)
        return self.optimize(loss, options, state)

    def count_items(self, batch: tuple[Any, ...]) -> int:
        """Count the pages of a batch."""
        return len(batch[1])

    def exported(self) -> Exported:
        """Return the network with probabilities for scores."""
        assert isinstance(self.network, DrawingUNet)
        return Exported(DrawingProbabilities(self.network), DRAWING_SIGNATURE, [torch.rand(2, 3, 96, 64)])

    def compute_scores(self) -> dict[str, float]:
        """Compute the scores of the watched pages."""
        return score_pages(self.watched, self.run())


def has_bfloat_units() -> bool:
    """Return whether the processor computes with numbers of 16 bits: without such units they take 2.3 times as long."""
    return bool(torch.cpu.get_capabilities().get("amx_bf16") or torch.cpu.get_capabilities().get("avx512_bf16"))


def compute_dice_loss(scores: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    """Compute 1 less the mean Dice coefficient of the classes that a batch shows, as many pixels as they may have
    (Milletari et al. 2016).

    Args:
        scores: (n, c, h, w), not normalised; truth: (n, h, w).
    """
    count = scores.shape[1]
    probability = scores.softmax(dim=1).movedim(1, -1).reshape(-1, count)
    flat = truth.reshape(-1)
    predicted, true = probability.sum(dim=0), torch.bincount(flat, minlength=count)
    both = probability.new_zeros(count).index_add(0, flat, probability.gather(1, flat[:, None])[:, 0])
    share = 2 * both / (predicted + true).clamp(min=1.0)
    return 1 - share[true > 0].mean()


def score_pages(pages: Sequence[Page], network: Run) -> dict[str, float]:
    """Score pages: IoU of each class, their mean over the classes that there are, the share of pixels that are right, and
    their log loss."""
    count = len(DRAWING_CLASSES)
    table, loss = np.zeros((count, count), np.int64), 0.0
    for picture, truth in pages:
        x = np.ascontiguousarray(picture.transpose(2, 0, 1)[None], np.float32) / np.float32(255)
        (probability,) = network(picture=x)
        prediction = np.asarray(probability[0]).argmax(axis=0)
        loss += compute_log_loss(np.asarray(probability[0]).reshape(count, -1).T, truth.ravel())
        table += np.bincount(truth.ravel().astype(np.int64) * count + prediction.ravel(), minlength=count**2).reshape(
            count, count
        )
    right, true, predicted = np.diag(table), table.sum(axis=1), table.sum(axis=0)
    iou = right / np.maximum(true + predicted - right, 1)
    scores = {f"iou_{name}": float(value) for name, value in zip(DRAWING_CLASSES, iou, strict=True)}
    present = true > 0
    pixels = max(int(table.sum()), 1)
    return {**scores, "mean_iou": float(iou[present].mean()), "accuracy": float(right.sum() / pixels), "loss": loss / pixels}


def judge(settings: DrawingSegmentation, file: Path, log_line: LogFn) -> dict[str, Any]:
    """Return scores of weights on pages of plans that trained nothing."""
    pages = draw_pages(settings.heldout, settings, JUDGED, log_line)
    if not pages:
        raise InputError("heldout: no page to judge")
    return {**score_pages(pages, load_network(file, DRAWING_SIGNATURE)), "pages": len(pages)}


SCORES = ("mean_iou", "accuracy", "loss", *(f"iou_{name}" for name in DRAWING_CLASSES))
TASK = Task(DrawingSegmentation, fit, SCORES, judge, "topomerge.networks", DRAWING_FILE, hours=0.8, lower=("loss",))
