"""Losses that bring the views of one room together: InfoNCE with a dustbin, NT-Xent and triplets.

A batch holds several pairs of maps. For a room of a, the rooms of the other map that are the same true room are its partners
(several, where one of the maps has it in pieces). The other rooms of both maps are hard negatives: they stand in the same
building. The rooms of the other pairs are easy ones. Rooms of one true room are no negatives of each other, nor are rooms of two
pairs that show one building: they may be one room.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import torch
from topomerge.models.embedder import Embedder
from torch import Tensor, nn

from topomerge.errors import InputError
from topomerge.registry import LOSSES

NEVER_LOGIT = -1e4  # a logit that is never chosen; minus infinity would make gradients of rows without a partner nan


@dataclass
class LossSettings:
    """Settings of the loss of matching rooms.

    Args:
        kind: of `topomerge.registry.LOSSES`.
        easy: weight of the other buildings' rooms among the negatives.
        dustbin: weight of the choice between the other map's rooms and no partner at all.
        margin: of the triplets, in distances between unit vectors.
        temperature: of NT-Xent; that of InfoNCE is learned.
        faint: weight of rooms of which one of the maps has a part only (not `Truth.clear`).
        options: numbers that a loss of one's own takes, by name.
    """

    kind: str = "infonce"
    easy: float = 0.3
    dustbin: float = 1.0
    margin: float = 0.3
    temperature: float = 0.1
    faint: float = 0.5
    options: dict[str, float] = field(default_factory=dict)


@dataclass(eq=False)  # not frozen: fabric fills a copy of it in half precision
class Truth:
    """Rooms that belong together in a batch of N rooms.

    Args:
        pair: (N,) which pair of maps a room is of; -1: of none, but there to fill a batch up, without a say in any loss.
        side: (N,) 0 for a, 1 for b.
        same: (N, N) bool, the two are one true room, in the two maps of a pair.
        piece: (N, N) bool, the two are of one true room in one map.
        clear: (N,) bool, both maps have most of the room; or it has no partner, and its map has most of it.
        building: (N,) int64, a number of the physical building that a room is in.
    """

    pair: Tensor
    side: Tensor
    same: Tensor
    piece: Tensor
    clear: Tensor
    building: Tensor


@dataclass(eq=False)
class Others:
    """Rooms of the batches of other processes.

    Args:
        embedding: (M, D) of length 1; building: (M,), as of `Truth`.
    """

    embedding: Tensor
    building: Tensor


class RoomLosses(NamedTuple):
    """The values of a loss.

    Args:
        values: (N,) of each room.
        counts: (N,) bool, which rooms have one.
        joint: the choice between the other map's rooms and no partner shapes the embedding, too; else only the dustbins and the
            temperature are fitted to it.
    """

    values: Tensor
    counts: Tensor
    joint: bool = False


@dataclass(eq=False)
class RoomBatch:
    """The inputs of a loss.

    Args:
        embedding: (N, D) of length 1.
        temperature: the learned one.
        gather: returns the rooms of other processes; None where there are none.
    """

    embedding: Tensor
    temperature: Tensor
    truth: Truth
    gather: Callable[[], Others | None]


class Processes(Protocol):
    """Collective operations of the processes that train together, as losses use them."""

    def gather_others(self, rows: Tensor) -> Tensor:
        """Return the rows (M, ...) of all other processes; gradients flow back to where they come from."""

    def average(self, value: Tensor) -> Tensor:
        """Return the mean of a value over the processes, without a gradient."""


def check(settings: LossSettings) -> None:
    """Refuse what makes no sense.

    Raises:
        InputError: names the key.
    """
    LOSSES.check(settings.kind)
    for key in ("easy", "dustbin", "margin", "faint"):
        if getattr(settings, key) < 0:
            raise InputError(f"loss.{key} must be 0 or more, not {getattr(settings, key)}")
    if settings.temperature <= 0:
        raise InputError(f"loss.temperature must be above 0, not {settings.temperature}")


def compute_matching_loss(
    settings: LossSettings,
    embedding: Tensor,
    dustbin: Tensor,
    temperature: Tensor,
    truth: Truth,
    processes: Processes | None = None,
) -> dict[str, Tensor]:
    """Compute the losses by name; `loss` is their weighted sum. Each is the mean over rooms, the faint ones weighing less.

    The mean of the losses of several processes, and of their gradients, is that of one process with all their pairs.

    Args:
        embedding: (N, D) of length 1.
        dustbin: (N,) logits.
        temperature: learned one.
        processes: that train together; None: this one alone.
    """

    def gather() -> Others | None:
        if processes is None:
            return None
        return Others(processes.gather_others(embedding), processes.gather_others(truth.building))

    main = RoomLosses(*LOSSES[settings.kind](settings, RoomBatch(embedding, temperature, truth, gather)))
    fixed = embedding if main.joint else embedding.detach()
    weight = torch.where(truth.clear, 1.0, settings.faint) * (truth.pair >= 0)
    first = _compute_weighted_mean(main.values, weight * main.counts, processes)
    second = _compute_weighted_mean(compute_dustbin_loss(fixed, dustbin, temperature, truth), weight, processes)
    return {"loss": first + settings.dustbin * second, settings.kind: first.detach(), "dustbin": second.detach()}


def _compute_weighted_mean(values: Tensor, weight: Tensor, processes: Processes | None) -> Tensor:
    total = weight.sum() if processes is None else processes.average(weight.sum())
    return (values * weight).sum() / total.clamp(min=1e-6)


def score_info_nce(settings: LossSettings, batch: RoomBatch) -> RoomLosses:
    """Compute InfoNCE at the learned temperature."""
    return RoomLosses(*compute_info_nce(batch.embedding, batch.temperature, batch.truth, settings.easy, batch.gather()), True)


def score_nt_xent(settings: LossSettings, batch: RoomBatch) -> RoomLosses:
    """Compute NT-Xent: at a temperature that stays, and all negatives count alike."""
    temperature = batch.embedding.new_tensor(settings.temperature)
    return RoomLosses(*compute_info_nce(batch.embedding, temperature, batch.truth, 1.0, batch.gather()))


def score_triplets(settings: LossSettings, batch: RoomBatch) -> RoomLosses:
    """Compute the triplet loss, whose negatives are of the same pair."""
    return RoomLosses(*compute_triplet_loss(batch.embedding, batch.truth, settings.margin))


def compute_info_nce(
    embedding: Tensor, temperature: Tensor, truth: Truth, easy: float = 1.0, others: Others | None = None
) -> tuple[Tensor, Tensor]:
    """Return (N,) -log(sum of exp(s) of partners / sum of exp(s) of partners and negatives), s being the cosine over the
    temperature; and (N,) bool, which rooms have a partner; negatives of other pairs count `easy` times, and not at all where they
    are of the same building (van den Oord et al. 2018)."""
    logits = embedding @ embedding.T / temperature
    same_pair = truth.pair[:, None] == truth.pair[None]
    weight = torch.where(same_pair, 1.0, easy * (truth.building[:, None] != truth.building[None]))
    weight = weight * ~(truth.piece | torch.eye(len(logits), dtype=torch.bool, device=logits.device)) * (truth.pair >= 0)
    all_logits = logits
    if others is not None:
        all_logits = torch.cat([logits, embedding @ others.embedding.T / temperature], dim=1)
        weight = torch.cat([weight, easy * (truth.building[:, None] != others.building[None])], dim=1)
    candidates = (all_logits + weight.clamp(min=1e-30).log()).masked_fill(weight == 0, NEVER_LOGIT).logsumexp(dim=1)
    partners = logits.masked_fill(~truth.same, NEVER_LOGIT).logsumexp(dim=1)
    has = truth.same.any(dim=1)
    return torch.where(has, candidates - partners, 0.0), has


def compute_triplet_loss(embedding: Tensor, truth: Truth, margin: float) -> tuple[Tensor, Tensor]:
    """Return (N,) mean over a room's partners of the mean of d(partner) - d(negative) + margin over the negatives of the same
    pair of maps for which it is above 0; and (N,) bool, which rooms have both (Hermans et al. 2017, "batch all").

    With the hardest triplets alone all rooms come to one point: partners of which one map has a sliver are farther than the
    nearest others.
    """
    # Distances of unit vectors; the root needs a gradient at 0.
    apart = (2 - 2 * embedding @ embedding.T).clamp(min=0).add(1e-6).sqrt()
    same_pair = truth.pair[:, None] == truth.pair[None]
    negative = same_pair & ~truth.same & ~truth.piece
    negative &= ~torch.eye(len(negative), dtype=torch.bool, device=negative.device)
    room, partner = truth.same.nonzero(as_tuple=True)
    wrong = (apart[room, partner, None] - apart[room] + margin).relu() * negative[room]
    each = wrong.sum(dim=1) / (wrong > 0).sum(dim=1).clamp(min=1)
    total = torch.zeros_like(embedding[:, 0]).index_add(0, room, each)
    return total / truth.same.sum(dim=1).clamp(min=1), truth.same.any(dim=1) & negative.any(dim=1)


def compute_dustbin_loss(embedding: Tensor, dustbin: Tensor, temperature: Tensor, truth: Truth) -> Tensor:
    """Return (N,) -log(probability of its partners, or of having none where it has none), among the rooms of the other map of the
    pair and the dustbin."""
    logits = embedding @ embedding.T / temperature
    other = (truth.pair[:, None] == truth.pair[None]) & (truth.side[:, None] != truth.side[None])
    candidates = torch.cat([logits.masked_fill(~other, NEVER_LOGIT), dustbin[:, None]], dim=1).logsumexp(dim=1)
    partners = logits.masked_fill(~truth.same, NEVER_LOGIT).logsumexp(dim=1)
    return candidates - torch.where(truth.same.any(dim=1), partners, dustbin)


class Objective(nn.Module):
    """Network and loss in one module, so that a training step is one call of it (as several processes need).

    Args:
        network: an `Embedder`.
        processes: that train together, whose rooms are negatives, too; None: this one alone.
    """

    def __init__(self, network: Embedder, settings: LossSettings, processes: Processes | None = None) -> None:
        super().__init__()
        check(settings)
        self.network, self.settings, self.processes = network, settings, processes

    def forward(self, tensors: dict[str, Tensor], truth: Truth) -> dict[str, Tensor]:
        embedding, dustbin = self.network(tensors)
        with torch.autocast(embedding.device.type, enabled=False):  # a small temperature magnifies what 8 bits leave out
            rows, bins = embedding.float(), dustbin.float()
            return compute_matching_loss(self.settings, rows, bins, self.network.temperature, truth, self.processes)
