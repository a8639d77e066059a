"""The network that matches the rooms of two maps, in torch (`matching.room_matcher` runs it in NumPy): attention within each map
and across both, on the rows of an embedder."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from topomerge.embedding.turns import FACTS
from topomerge.errors import InputError
from topomerge.matching.room_matcher import (
    AGREEMENT,
    ATTENTION_HEADS,
    FIRST_SHARPNESS,
    LIKENESS_SCALE,
    UNUSUAL,
    WAY_FACTS,
    RoomsSeen,
    agreement,
    ways,
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


class Partners(NamedTuple):
    """Logarithms of the probabilities of each partner (R_a, R_b + 1) and (R_b, R_a + 1), in the last place of none."""

    rows: Tensor
    columns: Tensor


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
        states = [self._within(state, way) for state, way in zip(states, each_way, strict=True)]
        states = self._across(states, votes)
        return [s + self.drop(self.each_out(torch.relu(self.each_in(self.norm_each(s))))) for s in states]

    def _within(self, state: Tensor, way: Tensor) -> Tensor:
        count = len(state)
        query, key, value = self.within(self.norm_within(state)).chunk(3, dim=1)
        way = self.way_out(torch.relu(self.way_in(way)))
        query, key = (part.view(count, ATTENTION_HEADS, -1) for part in (query, key))
        score = torch.einsum("ihd,jhd->ijh", query, key) / math.sqrt(self.size)
        share = (score + way[..., :ATTENTION_HEADS]).softmax(dim=1)
        seen = (value[None] + way[..., ATTENTION_HEADS:]).view(count, count, ATTENTION_HEADS, -1)
        out: Tensor = state + self.drop(self.join_within((share[..., None] * seen).sum(dim=1).flatten(1)))
        return out

    def _across(self, states: Sequence[Tensor], votes: Tensor) -> list[Tensor]:
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

    def fit_facts(self, facts: Array) -> None:
        """Take what is usual from the facts (n, FACTS) of the training set; heights are told by the ways only."""
        usual, spread = facts.mean(axis=0), facts.std(axis=0)
        spread[spread < LEAST_SPREAD] = 1.0
        usual[-1], spread[-1] = 0.0, FAR_HEIGHT
        self.usual, self.spread = _tensor(usual), _tensor(spread)

    def forward(self, a: RoomsSeen, b: RoomsSeen) -> list[Partners]:
        rows, facts = [_tensor(m.rows) for m in (a, b)], [_tensor(m.facts) for m in (a, b)]
        each_way = [_tensor(ways(m.places, m.heights)) for m in (a, b)]
        cosine = rows[0] @ rows[1].T
        facts = [((f - self.usual) / self.spread).clamp(-UNUSUAL, UNUSUAL) for f in facts]
        states = [self.rows(r) + self.facts(f) for r, f in zip(rows, facts, strict=True)]
        likely = ((FIRST_SHARPNESS * cosine).softmax(dim=1) * (FIRST_SHARPNESS * cosine).softmax(dim=0)).sqrt()
        partners = [self._partners(0, states, cosine, _votes(likely, a, b))]
        for k, layer in enumerate(self.layers):
            votes = _votes((0.5 * (partners[-1].rows[:, :-1] + partners[-1].columns[:, :-1].T)).exp(), a, b)
            states = layer(states, each_way, votes)
            partners.append(self._partners(k + 1, states, cosine, votes))
        return partners

    def _partners(self, k: int, states: Sequence[Tensor], cosine: Tensor, votes: Tensor) -> Partners:
        a, b = (nn.functional.normalize(self.head[k](state), dim=1) for state in states)
        logits = LIKENESS_SCALE * (self.sharpness * (a @ b.T) + self.likeness * (cosine - 1)) + self.agree[k](votes)[..., 0]
        alone = [self.alone[k](state) for state in states]
        rows, columns = torch.cat([logits, alone[0]], dim=1), torch.cat([logits.T, alone[1]], dim=1)
        return Partners(rows.log_softmax(dim=1), columns.log_softmax(dim=1))


def exported_matcher(network: RoomMatcher, embedder: str) -> dict[str, Array]:
    """Weights for `matching.room_matcher`, and the hash of the embedder whose rows it takes."""
    out: dict[str, Array] = {}
    for name, tensor in network.state_dict().items():
        parts = name.split(".")
        if parts[0] == "layers":  # layers.0.query.weight -> 1.query.w
            parts = [str(int(parts[1]) + 1), *parts[2:]]
        elif parts[0] in ("head", "alone", "agree"):  # head.0.weight -> 0.head.w
            parts = [parts[1], parts[0], *parts[2:]]
        array = tensor.detach().cpu().numpy()
        parts = [{"weight": "w", "bias": "b"}.get(part, part) for part in parts]
        out[".".join(parts)] = array.T if array.ndim == 2 else array
    return out | {"embedder": np.frombuffer(embedder.encode(), np.uint8)}


def _tensor(array: Array) -> Tensor:
    return torch.as_tensor(array, dtype=torch.float32)


def _votes(likely: Tensor, a: RoomsSeen, b: RoomsSeen) -> Tensor:
    return _tensor(agreement(likely.detach().numpy().astype(float), a, b))
