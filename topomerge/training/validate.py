"""How well a network finds the rooms of one map in another, on pairs of which the truth is known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from topomerge.embedding.graph import is_door_edge
from topomerge.embedding.quarter_turns import Rows, TurnedRows, estimate_turns, rotate_to_walls
from topomerge.matching.assignment import align, assign_certain, compute_certainty, count_pairs, has_twin, rank_partners
from topomerge.models.embedder import Embedder, match_scores
from topomerge.training.batches import find_well_seen_rooms, make_batch
from topomerge.training.packed_pairs import GraphPair
from topomerge.types import Array, Sim3

LEAST_CERTAINTY = 0.05  # certainty of a match that is looked at
MOST_PLACES = 100  # places
PLACES_APART = 1.0  # m between two places that tell a direction
LARGEST_STRETCH = 0.5  # m by which two places may be farther apart in one map than in the other
DOOR_OFF, MIDDLE_OFF = 0.5, 1.5  # m by which one door, and the middle of one room may be off: a map may have seen a part
LEVEL_OFF = 0.7  # m
REFINEMENT_ROUNDS = 3
RIGHT_WITHIN = (0.5, 5.0)  # m, degrees


class MatchedPlaces(NamedTuple):
    """Places (P,) of both maps that are one if a match is right: middles of its rooms, and their doors with each other."""

    to: Array  # (P, 3) in a
    of: Array  # (P, 3) in b
    match: Array  # (P,) ascending
    off: Array  # (P,) m by which they may differ


def estimate_pose(a: Mapping[str, Array], b: Mapping[str, Array], certain: Array) -> Sim3 | None:
    """Return T_ab under which the most matches, by their certainty, agree; None where no two places tell one.

    Args:
        a, b: `pos`, `edge_pos` and `edge_index` of both graphs (`embedding.graph`).
        certain: (R_a, R_b) `matching.assignment.compute_certainty`.
    """
    pairs = assign_certain(certain, LEAST_CERTAINTY)
    pairs = pairs[np.argsort(-certain[tuple(pairs.T)], kind="stable")]
    places = _pair_places(a, b, pairs)
    turn, move, rise = _compute_candidates(places)
    if not len(turn):
        return None
    flat = [x[:, 0] + 1j * x[:, 1] for x in (places.to, places.of)]
    away = abs(turn[:, None] * flat[1] + move[:, None] - flat[0])
    level = abs(places.of[:, 2] + rise[:, None] - places.to[:, 2]) <= LEVEL_OFF
    fit = np.maximum(1 - away / places.off, 0) * level
    first = np.flatnonzero(np.diff(places.match, prepend=-1))
    score = np.maximum.reduceat(fit, first, axis=1) @ certain[tuple(pairs[places.match[first]].T)]
    best = int(score.argmax())
    agreeing = fit[best] > 0
    for _ in range(REFINEMENT_ROUNDS):
        pose, _ = align(places.to[agreeing], places.of[agreeing], weight=1 / places.off[agreeing] ** 2)
        agreeing = np.linalg.norm(pose.apply(places.of) - places.to, axis=1) <= places.off
        if agreeing.sum() < 2:
            break
    return pose


def _pair_places(a: Mapping[str, Array], b: Mapping[str, Array], pairs: Array) -> MatchedPlaces:
    to: list[Array] = []
    of: list[Array] = []
    match: list[int] = []
    off: list[float] = []
    for k, (i, j) in enumerate(pairs.tolist()):
        if len(to) > MOST_PLACES:
            break
        doors = [g["edge_pos"][g["edge_index"][0] == room] for g, room in ((a, i), (b, j))]
        doors_a, doors_b = (n.ravel() for n in np.meshgrid(*(np.arange(len(d)) for d in doors), indexing="ij"))
        to += [a["pos"][i], *doors[0][doors_a]]
        of += [b["pos"][j], *doors[1][doors_b]]
        match += [k] * (len(doors_a) + 1)
        off += [MIDDLE_OFF, *[DOOR_OFF] * len(doors_a)]
    return MatchedPlaces(np.array(to).reshape(-1, 3), np.array(of).reshape(-1, 3), np.array(match, int), np.array(off))


def _compute_candidates(places: MatchedPlaces) -> tuple[Array, Array, Array]:
    """Return (C,) turn and move as complex numbers, and rise, m, of every two places that are as far apart in both maps."""
    far = [np.linalg.norm(x[:, None, :2] - x[None, :, :2], axis=2) for x in (places.to, places.of)]
    alike = (np.minimum(*far) >= PLACES_APART) & (abs(far[0] - far[1]) <= LARGEST_STRETCH)
    p, q = np.nonzero(np.triu(alike, 1))
    to, of = (x[:, 0] + 1j * x[:, 1] for x in (places.to, places.of))
    turn = (to[q] - to[p]) / (of[q] - of[p])
    turn = turn / abs(turn)
    rise = (places.to[p, 2] + places.to[q, 2] - places.of[p, 2] - places.of[q, 2]) / 2
    return turn, (to[p] + to[q] - turn * (of[p] + of[q])) / 2, rise


def is_pose_right(pose: Sim3 | None, truth: Array, at: Array) -> bool:
    """Return whether a pose is right within 0.5 m and 5 degrees.

    Args:
        truth: (4, 4) T_ab.
        at: (3,) a point of b, where the error is measured.
    """
    if pose is None:
        return False
    off = pose.apply(at[None])[0] - (truth[:3, :3] @ at + truth[:3, 3])
    turned = pose.yaw - np.arctan2(truth[1, 0], truth[0, 0])
    turned = abs(np.degrees((turned + np.pi) % (2 * np.pi) - np.pi))
    return bool(np.linalg.norm(off) <= RIGHT_WITHIN[0] and turned <= RIGHT_WITHIN[1])


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
    """Return the rows of two maps of which the products are the mean cosines over turns (`compute_similarity`)."""
    if not isinstance(a, TurnedRows) or not isinstance(b, TurnedRows):
        return np.asarray(a), np.asarray(b)
    mean: Array = np.sum([turn.probability * b.flatten(turn.quarters) for turn in estimate_turns(a, b)], axis=0)
    return a.flatten(), mean


def _build_rows(rows: Array, graph: Mapping[str, Tensor]) -> Rows:
    """Return the rows of a map, with where its rooms are if they tell turns apart."""
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
    """Return scores over all rooms with a partner, of both maps: recall@1, recall@5 and MRR, apart for those with and without a
    near-identical twin; precision, recall and F1 of the assignment in which a room may stay alone, at the certainty (`least`)
    that is best; and of the pairs with rooms in common (`mergeable`) the share whose matches give the true transform within 0.5 m
    and 5 degrees (`merged`: `is_pose_right`)."""
    each = score_pairs(network, pairs, device)
    right = [good for one in each for good in one.right]
    merged = {"merged": float(np.mean(right)) if right else 0.0, "mergeable": float(len(right))}
    ranks, twins, clear = (np.concatenate([getattr(one, of) for one in each]) for of in ("ranks", "twins", "clear"))
    return score_matches(ranks, twins, clear, np.sum([one.counts for one in each], axis=0)) | merged


def _evaluate_merge(pair: GraphPair, certain: Array) -> list[bool]:
    """Return whether the matches of a pair give its true transform; empty where it has none or rooms in common, or scales
    differ."""
    truth = pair.transform.numpy()
    if not len(pair.matches) or not abs(truth[2, 2] - 1) < 1e-6:
        return []
    a, b = (_collect_places(graph) for graph in (pair.a, pair.b))
    pose = estimate_pose(a, b, certain)
    return [is_pose_right(pose, truth, b["pos"][pair.matches[:, 1].numpy()].mean(axis=0))]


def _collect_places(graph: Mapping[str, Tensor]) -> dict[str, Array]:
    """Return where rooms and doors are; rooms that are neighbours by distance only have none."""
    arrays = {name: graph[name].numpy() for name in ("pos", "edge_pos", "edge_index", "edge_attr")}
    doors = is_door_edge(arrays)
    return {"pos": arrays["pos"], "edge_pos": arrays["edge_pos"][doors], "edge_index": arrays["edge_index"][:, doors]}


def score_matches(ranks: Array, twins: Array, clear: Array, counts: Array) -> dict[str, float]:
    """Score matches by their ranks (n,), whether each room has a twin (n,), and whether both maps saw it well (n,); and by the
    sums of `count_pairs` for each of `LEAST_CERTAINTIES`."""
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
