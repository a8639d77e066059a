"""How well a network finds the rooms of one map in another, on pairs of which the truth is known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from topomerge.embedding.graph import is_door_edge
from topomerge.embedding.quarter_turns import Rows, TurnedRows, estimate_turns, rotate_to_walls
from topomerge.matching.assignment import assign_certain, compute_certainty, count_pairs, has_twin, rank_partners
from topomerge.models.embedder import Embedder, match_scores
from topomerge.training.batches import find_well_seen_rooms, make_batch
from topomerge.training.packed_pairs import GraphPair
from topomerge.training.success import estimate_pose, is_pose_right
from topomerge.types import Array

SIZE_COLUMNS = (0, 3, 4)  # area, length, width: columns of x
PAIRS_AT_ONCE = 8  # pairs
LEAST_CERTAINTIES = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5)  # certainty of a match: the best of these is reported


@torch.no_grad()
def embed(network: Embedder, pairs: Sequence[GraphPair], device: Any = "cpu") -> list[tuple[Tensor, Tensor]]:
    """Return (embedding, dustbin) of each map, a0 b0 a1 b1 ..., on the CPU; where turns matter, that of b is the mean over its
    turns, each as likely as it is (`estimate_turns`)."""
    training = network.training
    network.eval()
    out: list[tuple[Tensor, Tensor]] = []
    for start in range(0, len(pairs), PAIRS_AT_ONCE):
        batch = make_batch(pairs[start : start + PAIRS_AT_ONCE], network.tensors).to(device)
        embedding, dustbin = network.embed_rotations(batch.tensors)
        rows, bins = (part.float().cpu().split(batch.rooms) for part in (embedding, dustbin))
        for k, pair in zip(range(0, len(rows), 2), pairs[start : start + PAIRS_AT_ONCE], strict=True):
            sides = _align_rows(
                *(_build_rows(of.numpy(), graph) for of, graph in zip(rows[k : k + 2], (pair.a, pair.b), strict=True))
            )
            out += [(torch.from_numpy(of), bins[k + i]) for i, of in enumerate(sides)]
    network.train(training)
    return out


def _align_rows(a: Rows, b: Rows) -> tuple[Array, Array]:
    """Rows of two maps of which the products are the mean cosines over turns (`compute_similarity`)."""
    if not isinstance(a, TurnedRows) or not isinstance(b, TurnedRows):
        return np.asarray(a), np.asarray(b)
    mean: Array = np.sum([turn.probability * b.flatten(turn.quarters) for turn in estimate_turns(a, b)], axis=0)
    return a.flatten(), mean


def _build_rows(rows: Array, graph: Mapping[str, Tensor]) -> Rows:
    """Of a map, with where its rooms are if they tell turns apart."""
    if rows.ndim == 2:
        return rows
    return TurnedRows(rows, rotate_to_walls({name: graph[name].numpy() for name in ("pos", "turn")}))


@dataclass(frozen=True, eq=False)
class PairScores:
    """How well the rooms of a pair were found.

    Args:
        ranks: (n,) of the true partner of each room that has one, of both maps.
        twins, clear: (n,) has the partner a near-identical twin, and did both maps see the room well?
        counts: (L, 4) of `count_pairs`, for each of `LEAST_CERTAINTIES`.
        right: is the transform that the matches give right? Empty where it cannot be told.
    """

    ranks: Array
    twins: Array
    clear: Array
    counts: Array
    right: list[bool]


def score_pairs(network: Embedder, pairs: Sequence[GraphPair], device: Any = "cpu") -> list[PairScores]:
    """Score each pair by itself; of none, nothing."""
    embeddings, temperature = embed(network, pairs, device), float(network.temperature.detach())
    scores = []
    for pair, (a, bin_a), (b, bin_b) in zip(pairs, embeddings[::2], embeddings[1::2], strict=True):
        similarity, matches = (a @ b.T).numpy(), pair.matches.numpy()
        links = torch.zeros(similarity.shape, dtype=torch.bool)
        links[pair.matches[:, 0], pair.matches[:, 1]] = True
        good = [which.numpy() for which in find_well_seen_rooms(links, pair.a["x"], pair.b["x"])]
        sides = ((similarity, matches, pair.b), (similarity.T, matches[:, ::-1], pair.a))
        ranks, twins, clear = [], [], []
        for (one, truth, other), well in zip(sides, good, strict=True):
            rooms, rank = rank_partners(one, truth)
            ranks.append(rank)
            clear.append(well[rooms])
            twins.append(has_twin(other["x"][:, SIZE_COLUMNS].numpy(), truth, rooms))
        rows, columns = match_scores(a, b, bin_a, bin_b, temperature)
        certain = compute_certainty(rows.exp().numpy(), columns.exp().numpy())
        counts = np.array([count_pairs(assign_certain(certain, least), matches) for least in LEAST_CERTAINTIES])
        r, t, c = (np.concatenate(values) for values in (ranks, twins, clear))
        scores.append(PairScores(r, t, c, counts, _evaluate_merge(pair, certain)))
    return scores


def validate(network: Embedder, pairs: Sequence[GraphPair], device: Any = "cpu") -> dict[str, float]:
    """Scores over all rooms with a partner, of both maps: recall@1, recall@5 and MRR, apart for those with and without a
    near-identical twin; precision, recall and F1 of the assignment in which a room may stay alone, at the certainty
    (`least`) that is best; and of the pairs with rooms in common (`mergeable`) the share whose matches give the true transform
    within 0.5 m and 5 degrees (`merged`: `training.success`)."""
    each = score_pairs(network, pairs, device)
    right = [good for one in each for good in one.right]
    merged = {"merged": float(np.mean(right)) if right else 0.0, "mergeable": float(len(right))}
    ranks, twins, clear = (np.concatenate([getattr(one, of) for one in each]) for of in ("ranks", "twins", "clear"))
    return score_matches(ranks, twins, clear, np.sum([one.counts for one in each], axis=0)) | merged


def _evaluate_merge(pair: GraphPair, certain: Array) -> list[bool]:
    """Whether the matches of a pair give its true transform; empty where it has none or rooms in common, or scales differ."""
    truth = pair.transform.numpy()
    if not len(pair.matches) or not abs(truth[2, 2] - 1) < 1e-6:
        return []
    a, b = (_collect_places(graph) for graph in (pair.a, pair.b))
    pose = estimate_pose(a, b, certain)
    return [is_pose_right(pose, truth, b["pos"][pair.matches[:, 1].numpy()].mean(axis=0))]


def _collect_places(graph: Mapping[str, Tensor]) -> dict[str, Array]:
    """Where rooms and doors are; rooms that are neighbours by distance only have none."""
    arrays = {name: graph[name].numpy() for name in ("pos", "edge_pos", "edge_index", "edge_attr")}
    doors = is_door_edge(arrays)
    return {"pos": arrays["pos"], "edge_pos": arrays["edge_pos"][doors], "edge_index": arrays["edge_index"][:, doors]}


def score_matches(ranks: Array, twins: Array, clear: Array, counts: Array) -> dict[str, float]:
    """Ranks (n,), whether each room has a twin (n,), and whether both maps saw it well (n,); the sums of `count_pairs`
    for each of `LEAST_CERTAINTIES`."""
    matched, right, requested, got = counts.T
    precision, recall = right / np.maximum(matched, 1), got / np.maximum(requested, 1)
    f1 = 2 * precision * recall / np.maximum(precision + recall, 1e-9)
    best = int(f1.argmax())

    def share(of: Array, most: int) -> float:
        return float((of <= most).mean()) if len(of) else 0.0

    return {
        "recall@1": share(ranks, 1),
        "recall@5": share(ranks, 5),
        "mrr": float((1 / ranks).mean()) if len(ranks) else 0.0,
        "recall@1_twin": share(ranks[twins], 1),
        "recall@1_single": share(ranks[~twins], 1),
        "recall@1_clear": share(ranks[clear], 1),
        "recall@5_clear": share(ranks[clear], 5),
        "recall@1_clear_single": share(ranks[clear & ~twins], 1),
        "recall@5_twin": share(ranks[twins], 5),
        "recall@5_single": share(ranks[~twins], 5),
        "twins": float(twins.mean()) if len(twins) else 0.0,
        "clear": float(clear.mean()) if len(clear) else 0.0,
        "precision": float(precision[best]),
        "recall": float(recall[best]),
        "f1": float(f1[best]),
        "least": LEAST_CERTAINTIES[best],
        "rooms": float(len(ranks)),
    }
