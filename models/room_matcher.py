"""The network that matches the rooms of two maps, in torch: attention within each map and across both, on rows of an embedder.
`matching.room_matcher` runs what is exported of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from topomerge.models.export import Branches
from torch import Tensor, nn

from topomerge.embedding.quarter_turns import FACTS
from topomerge.errors import InputError
from topomerge.matching.room_matcher import (
    AGREEMENT,
    ATTENTION_HEADS,
    CLIMB_UNIT,
    FIRST_SHARPNESS,
    LIKENESS_SCALE,
    RING_WIDTH,
    RINGS,
    UNUSUAL,
    WAY_FACTS,
    WAY_SOFT,
    RoomsSeen,
    compute_agreement,
)
from topomerge.types import Array

MATCHER_PARTS = {  # that an ablation leaves out, and the layers that tell of them
    "votes": ("votes", "agree"),
    "ways": ("way_out",),
    "facts": ("facts",),
    "within": ("join_within",),
    "across": ("join_across",),
}
WAY_HIDDEN = 32  # units between the way to a room and what is made of it
LEAST_SPREAD = 1e-3  # of a fact that says something
FAR_HEIGHT = 1e4  # m
RING_DISTANCES: list[float] = RINGS.tolist()


class Partners(NamedTuple):
    """Logarithms of the probabilities of each partner (R_a, R_b + 1) and (R_b, R_a + 1), in the last place of none."""

    rows: Tensor
    columns: Tensor


class Rooms(NamedTuple):
    """The rooms of a map as `RoomsSeen` has them."""

    rows: Tensor
    facts: Tensor
    places: Tensor
    heights: Tensor


class MatcherLayer(nn.Module):
    """Each room looks at the rooms of its own map, then at those of the other one."""

    def __init__(self, width: int, dropout: float) -> None:
        super().__init__()
        self.size = width // ATTENTION_HEADS
        self.norm_within, self.norm_across, self.norm_each = (nn.LayerNorm(width) for _ in range(3))
        self.within, self.join_within = nn.Linear(width, 3 * width), nn.Linear(width, width)
        self.way_in, self.way_out = nn.Linear(WAY_FACTS, WAY_HIDDEN), nn.Linear(WAY_HIDDEN, ATTENTION_HEADS + width)
        self.query, self.value, self.join_across = (nn.Linear(width, width) for _ in range(3))
        self.votes = nn.Linear(len(AGREEMENT), ATTENTION_HEADS)
        self.each_in, self.each_out = nn.Linear(width, 2 * width), nn.Linear(2 * width, width)
        self.drop = nn.Dropout(dropout)

    def forward(self, states: Sequence[Tensor], each_way: Sequence[Tensor], votes: Tensor) -> list[Tensor]:
        states = [self._attend_within(state, way) for state, way in zip(states, each_way, strict=True)]
        states = self._attend_across(states, votes)
        return [s + self.drop(self.each_out(torch.relu(self.each_in(self.norm_each(s))))) for s in states]

    def _attend_within(self, state: Tensor, way: Tensor) -> Tensor:
        query, key, value = (p.unflatten(1, (ATTENTION_HEADS, -1)) for p in self.within(self.norm_within(state)).chunk(3, dim=1))
        hidden = torch.relu(self.way_in(way))  # (R, R, WAY_HIDDEN)
        weight, bias = self.way_out.weight, self.way_out.bias
        score = torch.einsum("ihd,jhd->ijh", query, key) / math.sqrt(self.size)
        share = (score + nn.functional.linear(hidden, weight[:ATTENTION_HEADS], bias[:ATTENTION_HEADS])).softmax(dim=1)
        # What a way adds to the value of a room is linear in `hidden`: summed first, it needs a third of the memory.
        of_ways = torch.einsum("ijh,ijk->ihk", share, hidden)
        value_weight = weight[ATTENTION_HEADS:].unflatten(0, (ATTENTION_HEADS, -1))
        seen = torch.einsum("ijh,jhd->ihd", share, value) + torch.einsum("ihk,hdk->ihd", of_ways, value_weight)
        seen = seen.flatten(1) + bias[ATTENTION_HEADS:]
        out: Tensor = state + self.drop(self.join_within(seen))
        return out

    def _attend_across(self, states: Sequence[Tensor], votes: Tensor) -> list[Tensor]:
        normed = [self.norm_across(state) for state in states]
        query, value = ([of(s).unflatten(1, (ATTENTION_HEADS, -1)) for s in normed] for of in (self.query, self.value))
        score = torch.einsum("ihd,jhd->ijh", *query) / math.sqrt(self.size) + self.votes(votes)
        seen = (
            torch.einsum("ijh,jhd->ihd", score.softmax(dim=1), value[1]),
            torch.einsum("ijh,ihd->jhd", score.softmax(dim=0), value[0]),
        )
        return [s + self.drop(self.join_across(other.flatten(1))) for s, other in zip(states, seen, strict=True)]


class RoomMatcher(nn.Module):
    """Rooms of two maps (`RoomsSeen`) -> their partners, after each layer; the last ones are the answer.

    Args:
        rows: numbers of a room's row, 4 D.
    """

    def __init__(self, rows: int, width: int = 96, layers: int = 3, dropout: float = 0.1) -> None:
        super().__init__()
        self.rows, self.facts = nn.Linear(rows, width), nn.Linear(FACTS, width)
        self.layers = nn.ModuleList(MatcherLayer(width, dropout) for _ in range(layers))
        shapes = ((width, width), (width, 1), (len(AGREEMENT), 1))
        self.head, self.alone, self.agree = (nn.ModuleList(nn.Linear(*s) for _ in range(layers + 1)) for s in shapes)
        self.register_buffer("usual", torch.zeros(FACTS))
        self.register_buffer("spread", torch.ones(FACTS))
        self.sharpness, self.likeness = nn.Parameter(torch.tensor(1.0)), nn.Parameter(torch.tensor(0.5))

    def leave_out(self, parts: Sequence[str]) -> None:
        """Make parts (of `MATCHER_PARTS`) give 0 for good, for ablations: files of weights have the same shape.

        Raises:
            InputError: an unknown part.
        """
        for part in parts:
            if part not in MATCHER_PARTS:
                raise InputError(f"without: unknown {part!r}; {', '.join(MATCHER_PARTS)} are possible")
            for name, weights in self.named_parameters():
                if set(name.split(".")) & set(MATCHER_PARTS[part]):
                    torch.nn.init.zeros_(weights).requires_grad_(False)

    def fit_features(self, facts: Array) -> None:
        """Take what is usual from the facts (n, FACTS) of the training set; heights are told by the ways only."""
        usual, spread = facts.mean(axis=0), facts.std(axis=0)
        spread[spread < LEAST_SPREAD] = 1.0
        usual[-1], spread[-1] = 0.0, FAR_HEIGHT
        self.usual, self.spread = _convert_to_tensor(usual), _convert_to_tensor(spread)

    def forward(self, a: RoomsSeen, b: RoomsSeen) -> list[Partners]:
        maps = [Rooms(*(_convert_to_tensor(part) for part in (m.rows, m.facts, m.places, m.heights))) for m in (a, b)]
        likely = self.compute_first_guess(maps)
        states: list[Tensor] = []
        partners: list[Partners] = []
        for k in range(len(self.head)):
            votes = _convert_to_tensor(compute_agreement(likely.detach().numpy().astype(float), a, b))
            states, of_stage = self.stage(k, maps, states, votes)
            partners.append(of_stage)
            likely = (0.5 * (of_stage.rows[:, :-1] + of_stage.columns[:, :-1].T)).exp()
        return partners

    def compute_first_guess(self, maps: Sequence[Rooms]) -> Tensor:
        """Return how likely each pair of rooms is by their rows alone: what votes in the first stage."""
        cosine = FIRST_SHARPNESS * (maps[0].rows @ maps[1].rows.T)
        likely: Tensor = (cosine.softmax(dim=1) * cosine.softmax(dim=0)).sqrt()
        return likely

    def stage(self, k: int, maps: Sequence[Rooms], states: Sequence[Tensor], votes: Tensor) -> tuple[list[Tensor], Partners]:
        """Return the states of the rooms of both maps after a stage, and their partners by them. The first stage reads no
        states."""
        if k:
            after: list[Tensor] = self.layers[k - 1](
                states, [compute_relative_positions(m.places, m.heights) for m in maps], votes
            )
        else:
            properties = [((m.facts - self.usual) / self.spread).clamp(-UNUSUAL, UNUSUAL) for m in maps]
            after = [self.rows(m.rows) + self.facts(f) for m, f in zip(maps, properties, strict=True)]
        return after, self._compute_partners(k, after, nn.functional.linear(maps[0].rows, maps[1].rows), votes)

    def _compute_partners(self, k: int, states: Sequence[Tensor], cosine: Tensor, votes: Tensor) -> Partners:
        a, b = (nn.functional.normalize(self.head[k](state), dim=1) for state in states)
        logits = LIKENESS_SCALE * (self.sharpness * (a @ b.T) + self.likeness * (cosine - 1)) + self.agree[k](votes)[..., 0]
        alone = [self.alone[k](state) for state in states]
        rows, columns = torch.cat([logits, alone[0]], dim=1), torch.cat([logits.T, alone[1]], dim=1)
        return Partners(rows.log_softmax(dim=1), columns.log_softmax(dim=1))


class MatcherStage(nn.Module):
    """A stage of the network with inputs and outputs in the order of `matching.room_matcher.build_signature`, but which it is."""

    def __init__(self, network: RoomMatcher, k: int) -> None:
        super().__init__()
        self.network, self.k = network, k

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Return the states of the rooms after the stage, and probabilities of their partners."""
        (*a, state_a), (*b, state_b), votes = inputs[:5], inputs[5:10], inputs[10]
        states, partners = self.network.stage(self.k, [Rooms(*a), Rooms(*b)], [state_a, state_b], votes)
        return *states, partners.rows.exp(), partners.columns.exp()


def build_stages(network: RoomMatcher) -> Branches:
    """Make what is exported of a network: its stages, of which a call runs one."""
    return Branches(MatcherStage(network, k) for k in range(len(network.head)))


def compute_relative_positions(places: Tensor, heights: Tensor) -> Tensor:
    """Return (R, R, WAY_FACTS) from each room of a map to each of its rooms: direction, distance in rings, climb."""
    off = places[None] - places[:, None]
    far = (off**2).sum(dim=2, keepdim=True).sqrt()
    ring = [(-(((far - at) / (RING_WIDTH[0] + RING_WIDTH[1] * at)) ** 2)).exp() for at in RING_DISTANCES]
    climb = ((heights[None] - heights[:, None]) / CLIMB_UNIT).clamp(-2, 2)[..., None]
    return torch.cat([off / (far + WAY_SOFT), *ring, climb], dim=2)


def _convert_to_tensor(array: Array) -> Tensor:
    return torch.as_tensor(array, dtype=torch.float32)
