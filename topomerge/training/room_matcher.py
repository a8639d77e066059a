"""Task `room_matcher`: the network that says which rooms of two maps are one (`matching.room_matcher`), on rows of the embedder
that ships.

The embedder stays as it is. Each map is seen several times, as other sensors and walks might have left it, and mirrored; two
views of one building are laid out at the quarter turn that is true, where rooms have their partners, and at a wrong one, where
none has any. The turn is learned with it: matchings at the true turn are to be surer of themselves.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from topomerge.embedding.learned import find_embedder, read_embedder_card
from topomerge.embedding.quarter_turns import QUARTERS, TurnedRows, compute_room_features, rotate_to_walls
from topomerge.errors import InputError
from topomerge.matching.assignment import assign_certain, count_pairs, has_twin, rank_partners
from topomerge.matching.room_matcher import Matcher, RoomsSeen, build_rooms_seen, build_signature, match_turns, read_matcher
from topomerge.models.embedder import Embedder
from topomerge.models.export import build_sample
from topomerge.models.losses import NEVER_LOGIT
from topomerge.models.room_matcher import Partners, RoomMatcher, build_stages
from topomerge.models.weights import read_embedder
from topomerge.training.batches import add_views, augment_graph, augment_sheet, compute_quarter_turns, mirror_graph
from topomerge.training.loop import Exported, ExportedJob, State, derive_seed, run_network
from topomerge.training.packed_pairs import Graph, GraphPair, load_pairs
from topomerge.training.processes import let_main_process_first
from topomerge.training.settings import Augment
from topomerge.training.task_settings import RoomMatching
from topomerge.training.tasks import RANKINGS, Task
from topomerge.training.validate import LEAST_CERTAINTIES, SIZE_COLUMNS, score_matches
from topomerge.types import Array, LogFn

WRONG_TURNS = (1, 2, 2, 3)  # quarter turns off the true one: half a turn is the one that is mistaken most
LEAST_PROBABILITY = 1e-6  # of which a logarithm is taken
MIRROR = np.array([1.0, -1.0])


@dataclass(frozen=True, eq=False)
class MatcherView:
    """A map as the network sees it.

    Args:
        rows: of its rooms, with facts.
        present: (R,) which rooms of the map they are.
    """

    rows: TurnedRows
    present: Array

    def compute_rooms_seen(self, quarters: int) -> RoomsSeen:
        """Compute the rooms turned by so many quarter turns."""
        return build_rooms_seen(self.rows, quarters)


@dataclass(frozen=True, eq=False)
class MatcherExample:
    """Two maps of a building, each in several views: the odd ones are mirrored, the first one is as it is.

    Args:
        pair: what is true about them.
        quarters: by which b is to be turned to stand as a; None where no transform is true.
    """

    a: Sequence[MatcherView]
    b: Sequence[MatcherView]
    pair: GraphPair
    quarters: int | None

    def compute_links(self, view_a: MatcherView, view_b: MatcherView) -> Tensor:
        """Compute (R_a, R_b) bool, whether rooms of two views are one."""
        out = torch.zeros((len(self.pair.true[0]), len(self.pair.true[1])), dtype=torch.bool)
        if self.quarters is not None:
            out[self.pair.matches[:, 0], self.pair.matches[:, 1]] = True
        return out[view_a.present][:, view_b.present]


def build_examples(
    pairs: Sequence[GraphPair], network: Embedder, number: int, log_line: LogFn = lambda text: None
) -> list[MatcherExample]:
    """Build pairs with so many changed views of each of their maps beside the first one; a map of several pairs is seen once."""
    views: dict[tuple[str, str], list[MatcherView]] = {}
    out = []
    for pair in pairs:
        sides = [(str(pair.about["file"]), side) for side in pair.about["sides"]]
        for key, graph in zip(sides, (pair.a, pair.b), strict=True):
            if key not in views:
                views[key] = [build_view(graph, network, k, derive_seed(len(views), k)) for k in range(number + 1)]
                if not len(views) % 100:
                    log_line(f"{len(views)} maps seen")
        out.append(MatcherExample(views[sides[0]], views[sides[1]], pair, compute_quarter_turns(pair)))
    return out


@torch.no_grad()
def build_view(graph: Graph, network: Embedder, number: int, seed: int) -> MatcherView:
    """Build a map as it is (0), or changed; mirrored where the number is odd."""
    generator, augment = torch.Generator().manual_seed(seed), Augment()
    places = rotate_to_walls({name: graph[name].numpy() for name in ("pos", "turn")})
    seen = add_views(augment_sheet(graph, augment, generator) if number else graph, network.tensors)
    if number % 2:
        seen, places = mirror_graph(seen), places * MIRROR
    tensors, present = {name: seen[name] for name in {*network.tensors, "edge_index"}}, torch.arange(len(places))
    if number:
        tensors, present = augment_graph(tensors, len(places), augment, generator)
    rows, dustbin = (part.numpy() for part in network.embed_rotations(tensors))
    chosen = present.numpy()
    features = compute_room_features(graph["x"].numpy()[chosen], dustbin, graph["pos"].numpy()[chosen, 2])
    return MatcherView(TurnedRows(rows.astype(np.float32), places[chosen], "", features), chosen)


class MatcherJob(ExportedJob):
    """Pairs of maps, each at its true turn and at a wrong one.

    Args:
        embedder: hash of the embedder.
    """

    unit = "rooms"

    def __init__(
        self, settings: RoomMatching, learned: Sequence[MatcherExample], watched: Sequence[MatcherExample], embedder: str
    ) -> None:
        origin = {
            "set": settings.data.name,
            "split": settings.data.split,
            "validation": settings.validation,
            "embedder": embedder,
            "pairs": len(learned),
        }
        rows = int(np.prod(learned[0].a[0].rows.shape[1:]))
        network = RoomMatcher(rows, settings.width, settings.layers, settings.dropout)
        network.leave_out(settings.without)
        network.fit_features(np.concatenate([side[0].rows.facts for example in learned for side in (example.a, example.b)]))
        super().__init__(settings, network, origin)
        self.options, self.learned, self.watched, self.embedder = settings, learned, watched, embedder

    def iter_batches(self, state: State) -> Generator[list[tuple[MatcherExample, Array]], None, None]:
        """Yield pairs in the order of an epoch, each with random numbers of its own."""
        self.network.train()
        options = self.options
        order = np.random.default_rng([options.seed, 1, state.epoch]).permutation(len(self.learned))
        rank, world = self.fabric.global_rank, self.fabric.world_size
        order = np.resize(order, (options.steps, options.batch * world))[:, rank::world]
        for step, rows in enumerate(order[state.step :], state.step):
            torch.manual_seed(derive_seed(options.seed, state.epoch, step, *([rank] if rank else [])))  # of the dropout
            draws = self.start_generator(2, state.epoch, step).integers(0, 1 << 16, (len(rows), 4))
            yield [(self.learned[k], draw) for k, draw in zip(rows.tolist(), draws, strict=True)]

    def train_step(self, batch: list[tuple[MatcherExample, Array]], state: State) -> dict[str, float]:
        """Take one step of the optimizer."""
        loss = torch.stack([self._compute_loss(example, draw) for example, draw in batch]).mean()
        return self.optimize(loss, self.options, state)

    def _compute_loss(self, example: MatcherExample, draw: Array) -> Tensor:
        views = list(range(int(draw[0]) % 2, len(example.a), 2))  # all mirrored, or none
        of_a, of_b = example.a[views[draw[1] % len(views)]], example.b[views[draw[2] % len(views)]]
        true = 0 if example.quarters is None else -example.quarters if views[0] % 2 else example.quarters
        turn, wrong = int(draw[3]) % QUARTERS, WRONG_TURNS[int(draw[3]) // QUARTERS % len(WRONG_TURNS)]
        a, links = of_a.compute_rooms_seen(turn), example.compute_links(of_a, of_b)
        right = self.network(a, of_b.compute_rooms_seen((turn + true) % QUARTERS))
        other = self.network(a, of_b.compute_rooms_seen((turn + true + wrong) % QUARTERS))
        loss = compute_deep_loss(right, links) + self.options.wrong_turn * compute_deep_loss(other, torch.zeros_like(links))
        if links.any():
            lead = compute_confidence(right[-1]) - compute_confidence(other[-1])
            loss = loss + self.options.turn * functional.softplus(-lead)
        return loss

    def count_items(self, batch: list[tuple[MatcherExample, Array]]) -> int:
        """Count the rooms of a batch."""
        return sum(len(example.a[0].present) + len(example.b[0].present) for example, _ in batch)

    def exported(self) -> Exported:
        """Return all its stages."""
        assert isinstance(self.network, RoomMatcher)
        signature = build_signature(self.network.rows.in_features, self.options.width, self.options.layers + 1)
        return Exported(build_stages(self.network), signature, build_sample(signature))

    def compute_scores(self) -> dict[str, float]:
        """Compute the scores of the validation pairs."""
        matcher = Matcher(self.run(), self.options.width, self.options.layers + 1, self.embedder)
        return score_matcher(self.watched, matcher)


def compute_deep_loss(layers: Sequence[Partners], links: Tensor) -> Tensor:
    """Return -log(probability of a room's partners, or of having none), the mean over the rooms of both maps; after the last
    layer and, with less weight, after each one before."""
    total = torch.zeros(())
    for k, layer in enumerate(layers):
        weight = 1.0 if k == len(layers) - 1 else 0.3
        for probability, true in ((layer.rows, links), (layer.columns, links.T)):
            right = torch.cat([true, ~true.any(dim=1, keepdim=True)], dim=1)
            total = total - weight * probability.masked_fill(~right, NEVER_LOGIT).logsumexp(dim=1).mean()
    return total


def compute_confidence(partners: Partners) -> Tensor:
    """Compute the confidence of a matching, which is evidence of the turn (`RoomOdds.confidence`)."""
    return (partners.rows[:, :-1] + partners.columns[:, :-1].T).exp().sum()


def score_matcher(watched: Sequence[MatcherExample], matcher: Matcher) -> dict[str, float]:
    """Return the scores as of `training.validate`, and the share of pairs with rooms in common whose turn is right (`turn`)."""
    ranks, twins, turns, losses, counts = [], [], [], list[Array](), np.zeros((len(LEAST_CERTAINTIES), 4), int)
    for example in watched:
        a, b, matches = example.a[0], example.b[0], example.pair.matches.numpy()
        odds = max(match_turns(a.rows, b.rows, matcher), key=lambda turned: turned.probability)
        counts += [count_pairs(assign_certain(odds.certainty, least), matches) for least in LEAST_CERTAINTIES]
        if len(matches) and example.quarters is not None:
            turns.append(odds.quarters == example.quarters)
        for probability, truth, other in ((odds.rows, matches, example.pair.b), (odds.columns, matches[:, ::-1], example.pair.a)):
            losses.append(compute_room_losses(probability, truth))
            rooms, rank = rank_partners(probability[:, :-1], truth)
            ranks.append(rank)
            twins.append(has_twin(other["x"][:, SIZE_COLUMNS].numpy(), truth, rooms))
    every = np.concatenate(ranks)
    out = score_matches(every, np.concatenate(twins), np.ones(len(every), bool), counts)
    shares = {"turn": float(np.mean(turns)) if turns else 0.0, "loss": float(np.concatenate(losses).mean())}
    return {k: v for k, v in out.items() if "clear" not in k} | shares


def compute_room_losses(probability: Array, matches: Array) -> Array:
    """Compute (R,) -log(probability of a room's partners, or of having none).

    Args:
        probability: (R, S + 1) of each room of the other map, and of none; matches: (M, 2) rooms that are one.
    """
    right = np.zeros(probability.shape, bool)
    right[matches[:, 0], matches[:, 1]] = True
    right[:, -1] = ~right.any(axis=1)
    return np.asarray(-np.log(np.maximum((probability * right).sum(axis=1), LEAST_PROBABILITY)))


def fit(settings: RoomMatching, log_line: LogFn) -> dict[str, float]:
    """Train, and leave a run's folder; the scores of the best epoch.

    Raises:
        InputError: no pairs, or the embedder has no rows for turns.
    """
    with let_main_process_first(settings):
        settings = with_own_sets(settings, log_line)
    network, embedder = load_turned_embedder(settings.embedder)
    learned = read_examples(settings, settings.data.name, network, settings.views, log_line)
    watched = read_examples(settings, settings.validation, network, 0, log_line)
    torch.manual_seed(derive_seed(settings.seed))
    job = MatcherJob(settings, learned, watched, embedder)
    log_line(f"{len(learned)} pairs, {sum(p.numel() for p in job.network.parameters())} weights")
    return run_network(job, settings, settings.steps, log_line)


def judge(settings: RoomMatching, file: Path, log_line: LogFn) -> dict[str, Any]:
    """Return scores of weights on pairs of buildings that trained nothing."""
    settings = with_own_sets(settings, log_line)
    network, _ = load_turned_embedder(settings.embedder)
    watched = read_examples(settings, settings.heldout.name, network, 0, log_line)
    return {**score_matcher(watched, read_matcher(file)), "pairs": len(watched)}


def with_own_sets(settings: RoomMatching, log_line: LogFn) -> RoomMatching:
    """Name the sets of a folder of one's own captures, made where they are missing.

    Raises:
        InputError: whatever is wrong with the folder.
    """
    if not settings.path:
        return settings
    from topomerge.datasets.pairs.own_pairs import build_own_sets
    from topomerge.datasets.pairs.pairs_file import PARTS

    manifests = build_own_sets(settings.path, settings.cache, settings.jobs, log_line, settings.data.name).manifests
    train, val, test = (str(manifests[part]) for part in PARTS)
    data, heldout = replace(settings.data, name=train), replace(settings.heldout, name=test)
    return replace(settings, data=data, heldout=heldout, validation=val)


def load_turned_embedder(embedder: str) -> tuple[Embedder, str]:
    """Load an embedder, and its hash.

    Args:
        embedder: as of `embedding.learned.find_embedder`.

    Raises:
        InputError: there is none, or it has no rows for turns.
    """
    network, _ = read_embedder(find_embedder(embedder))
    if network.network.turns == 1:
        raise InputError(f"embedder={embedder}: tells no turns apart, as the matcher needs; train experiment=surroundings")
    return network, read_embedder_card(embedder).digest


def read_examples(settings: RoomMatching, name: str, network: Embedder, number: int, log_line: LogFn) -> list[MatcherExample]:
    """Read the pairs of a manifest, each map with so many changed views.

    Raises:
        InputError: no such manifest, or a file is damaged.
    """
    manifest = Path(name) if name.endswith(".jsonl") else Path(settings.cache) / f"{name}.jsonl"
    return build_examples(
        load_pairs(manifest, ["sheet"], log_line, around=network.network.node.around), network, number, log_line
    )


TASK = Task(
    RoomMatching,
    fit,
    (*RANKINGS, "mrr", "precision", "recall", "f1", "turn", "loss"),
    judge,
    "topomerge.networks",
    "room_matcher.onnx",
    hours=0.3,
    lower=("loss",),
)
