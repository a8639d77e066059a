"""Which maps of a set each is registered with: all others where they are few, else those on which it lies best, coarsely, of
those that its rooms look most like. Pairs can be laid coarsely, and registered, by workers."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.embedding.quarter_turns import QUARTERS, Descriptor, Rows, TurnedRows
from topomerge.errors import InputError
from topomerge.fusion.atlas.maps import Maps, Memory
from topomerge.fusion.atlas.pairs import find_hypotheses
from topomerge.fusion.inputs import FEW_MAPS
from topomerge.landmarks.map_search import build_landmark_index
from topomerge.matching.poses import PoseHypothesis
from topomerge.registration.judge import Judge
from topomerge.registration.search import search, search_scaled
from topomerge.registration.verify import rank
from topomerge.types import Array, Sim3

VOTE_SHARPNESS = 25.0  # that a cosine is multiplied with: a room that is more alike by .1 gets twelve times the vote
ROOM_NEIGHBOURS = 64  # rooms of the atlas that each room votes for, at each turn
QUERIES_AT_ONCE, VECTORS_AT_ONCE = 256, 1 << 15  # that are compared at once, so that memory stays bounded: 32 MB
NO_POSE = -30.0  # log odds where nothing can be laid on each other
CONNECTING = 20  # s that a cluster may take to answer
TRIES = 4  # of a pair, whose worker may die of something else

Workers = Callable[[Callable[[Any], Any], Sequence[Any]], Iterator[tuple[int, Any]]]
"""Calls a function with each task: the numbers of the tasks and what came out, as they end."""
# 18 % of the pairs that share a place are not among forty, 12 % not among eighty, and each costs a coarse pose (docs/adr/0019).
COARSE_PARTNERS = 40  # maps that a map's rooms look most like, on which it is laid coarsely
# Four of five pairs that share a place are among these; ten by looks alone had two of three (docs/adr/0019).
MOST_PARTNERS = 5  # of these and of those that name it, the ones on which it lies best
LIKELY_PARTNERS = 2  # that its rooms look most like, however it lies: drift spoils a coarse pose
NAMED_PARTNERS = 2  # that its signs, tags and radio speak of, however it lies


def compute_vectors(rows: Rows, turns: int = 0) -> Array:
    """Compute (R, D), or (R, 4 D) of turned rows, in single precision and of length 1: the rooms of a map that is turned so
    often."""
    flat = rows.flatten(turns) if isinstance(rows, TurnedRows) else rows
    out: Array = (flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-12)).astype(np.float32)
    return out


def compute_queries(rows: Rows) -> Array:
    """Return (T, R, ·) vectors (`compute_vectors`) of a map at each turn, T of 4 of turned rows and else 1."""
    return np.stack([compute_vectors(rows, k) for k in range(QUARTERS if isinstance(rows, TurnedRows) else 1)])


def find_nearest(table: Array, asked: Array, count: int = ROOM_NEIGHBOURS, but: tuple[int, int] = (0, 0)) -> tuple[Array, Array]:
    """Find the rows of a table (N, D) that are most alike to each of (Q, D), and their cosines: (Q, n) each, n of count and N the
    less.

    Exact, by products of matrices; most alike first, of equal ones the first.

    Args:
        but: first and last + 1 of rows that come after all others: those of the map that is asked for.
    """
    parts = [_search_blocks(table, asked[k : k + QUERIES_AT_ONCE], count, but) for k in range(0, len(asked), QUERIES_AT_ONCE)]
    return np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts])


def _search_blocks(table: Array, asked: Array, count: int, but: tuple[int, int]) -> tuple[Array, Array]:
    rooms: Array = np.zeros((len(asked), 0), np.int64)
    cosine: Array = np.zeros((len(asked), 0), np.float32)
    for first in range(0, len(table), VECTORS_AT_ONCE):
        block = asked @ table[first : first + VECTORS_AT_ONCE].T
        block[:, max(but[0] - first, 0) : max(but[1] - first, 0)] = -2.0
        best = _find_highest(block, count)
        rooms = np.concatenate([rooms, best + first], axis=1)
        cosine = np.concatenate([cosine, np.take_along_axis(block, best, axis=1)], axis=1)
        best = _find_highest(cosine, count)
        rooms, cosine = (np.take_along_axis(values, best, axis=1) for values in (rooms, cosine))
    return rooms, cosine


def _find_highest(values: Array, count: int) -> Array:
    """Return the places of the highest values of each row, highest first."""
    if count < values.shape[1]:
        best = np.sort(np.argpartition(-values, count - 1, axis=1)[:, :count], axis=1)
    else:
        best = np.broadcast_to(np.arange(values.shape[1]), values.shape)
    order = np.argsort(-np.take_along_axis(values, best, axis=1), axis=1, kind="stable")
    return np.take_along_axis(best, order, axis=1)


def count_votes(rooms: Array, cosine: Array, turns: int, owner: Array, maps: int) -> Array:
    """Return (maps,) of the votes of a map's rooms; each has one, shared among its neighbours by how alike they are.

    Args:
        rooms: (turns * R, n) neighbours of `compute_queries`, one turn after the other.
        cosine: of them.
        owner: (N,) map of each row of the table; -1: of none that counts.
        maps: their number. A map gets the votes at the turn that gives it the most.
    """
    whose = owner[rooms].reshape(turns, -1, rooms.shape[1])
    weight = np.where(whose >= 0, np.exp(VOTE_SHARPNESS * (cosine.reshape(whose.shape).astype(float) - 1)), 0.0)
    share = weight / np.maximum(weight.sum(axis=(0, 2), keepdims=True), 1e-300)
    out: Array = np.max([np.bincount(w[w >= 0], s[w >= 0], maps) for w, s in zip(whose, share, strict=True)], axis=0)
    return out


def list_owners(counts: Sequence[int]) -> Array:
    """Return (N,) map of each room, of maps with so many rooms."""
    return np.repeat(np.arange(len(counts)), counts)


def iter_most_similar(rows: Sequence[Rows], number: int) -> Iterator[tuple[int, ...]]:
    """Yield for each map those of the others that its rooms look most like, at most `number`, most alike first; exact.

    None for a map without rooms, and none that has no room among the neighbours.
    """
    table = np.concatenate([compute_vectors(of) for of in rows if len(of)] or [np.zeros((0, 1), np.float32)])
    counts = [len(of) for of in rows]
    owner, last = list_owners(counts), np.cumsum(counts).tolist()
    for k, of in enumerate(rows):
        if not counts[k]:
            yield ()
            continue
        asked = compute_queries(of)
        rooms, cosine = find_nearest(table, asked.reshape(-1, asked.shape[2]), but=(last[k] - counts[k], last[k]))
        score = count_votes(rooms, cosine, len(asked), np.where(owner == k, -1, owner), len(rows))
        best = np.argsort(-score, kind="stable")[:number].tolist()
        yield tuple(m for m in best if score[m] > 0)


def build_coarse_key(maps: Maps, i: int, j: int) -> tuple[str, str]:
    """Build the key under which `Memory.coarse` holds two maps."""
    return min(maps.keys[i], maps.keys[j]), max(maps.keys[i], maps.keys[j])


def compute_coarse_log_odds(maps: Maps, i: int, j: int, scale: str = "fixed") -> float:
    """Compute the log odds that the best rigid pose of two maps is right, seen by itself; what is in `Memory.coarse` is not made
    again.

    Drift lowers them: of a real floor some right pairs have -7, as strangers of few rooms have.
    """
    pair, coarse = build_coarse_key(maps, i, j), maps.memory.coarse
    if pair not in coarse:
        first, second = sorted((maps.get_prepared(i), maps.get_prepared(j)), key=lambda m: m.order)
        hypotheses = (search_scaled if scale == "free" else search)(first.storeys, second.storeys)
        ranked = rank(hypotheses, Judge(first.storeys, second.storeys))
        coarse[pair] = ranked[0].score if ranked else NO_POSE
    return coarse[pair]


@dataclass(frozen=True)
class CoarseTask:
    """Maps that shall be laid coarsely on the first of them.

    Args:
        files: `.tmap` files, that every worker can read.
        keys: of the maps.
        scale: as of `atlas`.
    """

    files: tuple[Path, ...]
    keys: tuple[str, ...]
    scale: str


@dataclass(frozen=True)
class PairTask:
    """Two maps that shall be registered.

    Args:
        files, keys: as of `CoarseTask`.
        embedder: of rooms, a name or what can be sent to another process; None where only geometry shall propose poses.
        scale, same: as of `atlas`.
        proposed: poses T_ij that are tried, too.
    """

    files: tuple[Path, Path]
    keys: tuple[str, str]
    embedder: str | Descriptor | None
    scale: str
    same: str
    proposed: tuple[Sim3, ...] = ()


@cache
def _get_memory() -> Memory:
    """Return the memory of this process: a map that comes in many pairs is prepared once."""
    return Memory()


def score_coarsely(task: CoarseTask) -> tuple[float, ...]:
    """Compute the log odds that each map but the first lies on the first one (`compute_coarse_log_odds`)."""
    memory = _get_memory()
    memory.coarse = {}  # what an earlier task found may be of another scale
    maps = Maps(task.files, None, memory, task.keys)
    return tuple(compute_coarse_log_odds(maps, 0, k, task.scale) for k in range(1, len(maps)))


def register_pair(task: PairTask) -> tuple[PoseHypothesis, ...]:
    """Register the second map in the first one (`pairs.find_hypotheses`)."""
    return find_hypotheses(Maps(task.files, task.embedder, _get_memory(), task.keys), 0, 1, task.scale, task.same, task.proposed)


def start_processes(jobs: int) -> Workers:
    """Start so many processes of this machine."""
    from joblib import Parallel, delayed

    def run(work: Callable[[Any], Any], tasks: Sequence[Any]) -> Iterator[tuple[int, Any]]:
        parallel = Parallel(min(jobs, len(tasks)), return_as="generator_unordered", batch_size=1)
        yield from parallel(delayed(_run_numbered)(work, k, task) for k, task in enumerate(tasks))

    return run


def _run_numbered(work: Callable[[Any], Any], number: int, task: Any) -> tuple[int, Any]:
    return number, work(task)


def connect_cluster(address: str) -> Workers:
    """Yield the workers of a Dask scheduler, e.g. ``tcp://host:8786``. Pairs of a worker that dies are given to another one.

    Raises:
        InputError: Dask is missing, or nobody answers there.
    """
    try:
        from distributed import Client, as_completed
    except ImportError as error:
        raise InputError("--cluster: needs Dask: pip install 'topomerge[cluster]'") from error

    def run(work: Callable[[Any], Any], tasks: Sequence[Any]) -> Iterator[tuple[int, Any]]:
        try:
            client = Client(address, timeout=CONNECTING, set_as_default=False)
        except (OSError, ValueError) as error:
            reason = " ".join(str(error).split())[:200]
            raise InputError(
                f"--cluster {address}: no scheduler answers there ({reason}); start one with `dask scheduler`"
            ) from error
        with client:
            futures = client.map(work, tasks, pure=False, retries=TRIES)
            number = {future.key: k for k, future in enumerate(futures)}
            for future in as_completed(futures, loop=client.loop):
                yield number[future.key], future.result()

    return run


def find_partners(
    maps: Maps,
    linked: Iterable[tuple[int, int]] = (),
    scale: str = "fixed",
    end: float = np.inf,
    workers: Workers | None = None,
) -> tuple[list[list[int]], bool]:
    """Find for each map those that it may be registered with, best first, and whether all was looked at. A map without rooms
    names the largest ones.

    Args:
        linked: pairs that may be registered however they look.
        end: `time.perf_counter` after which nothing is laid coarsely any more; pairs that were not come last.
        workers: lay maps that are files; None: this process does.
    """
    count = len(maps)
    named = _list_similar_maps(maps)
    testified = _list_named_maps(maps)
    sets = [set(of) for of in named]
    for k, of in enumerate(named):
        for m in of:
            sets[m].add(k)
    if workers is not None and count > 2:
        _score_in_workers(maps, named, scale, workers)
    odds, complete = _score_partners(maps, named, scale, end)
    chosen = {_order_pair(*pair) for pair in linked} | {_order_pair(k, m) for k, of in enumerate(testified) for m in of}
    for k in range(count):
        # By rank, with no limit of log odds: right pairs of the real floor go down to -7, as strangers do (docs/adr/0019).
        best = sorted(sets[k], key=lambda m, k=k: (-odds.get(_order_pair(k, m), -np.inf), m))  # type: ignore[misc]
        chosen |= {_order_pair(k, m) for m in (best if count <= FEW_MAPS else best[:MOST_PARTNERS] + named[k][:LIKELY_PARTNERS])}
    partners: list[dict[int, float]] = [{} for _ in range(count)]
    for i, j in sorted(chosen):
        partners[i][j] = partners[j][i] = odds.get((i, j), -np.inf)
    return [[m for _, m in sorted((-likely, m) for m, likely in of.items())] for of in partners], complete


def _list_similar_maps(maps: Maps) -> list[list[int]]:
    """List for each map those that its rooms look most like, most alike first; all others where they are few."""
    count = len(maps)
    if count <= FEW_MAPS:
        return [[m for m in range(count) if m != k] for k in range(count)]
    largest = sorted(range(count), key=lambda k: -maps.get_area(k))
    named = iter_most_similar([maps.get_rows(k) for k in range(count)], COARSE_PARTNERS)
    return [list(of) or [m for m in largest if m != k][:COARSE_PARTNERS] for k, of in enumerate(named)]


def _list_named_maps(maps: Maps) -> list[list[int]]:
    """List for each map those that its landmarks speak of most; none where all maps are registered with each other anyway."""
    readings = [k for k in range(len(maps)) if len(maps) > FEW_MAPS and maps.has_landmarks(k)]
    out: list[list[int]] = [[] for _ in range(len(maps))]
    if len(readings) > 1:
        index = build_landmark_index(maps[k] for k in readings)
        for n, k in enumerate(readings):
            out[k] = [readings[m] for m, _ in index.rank(maps[k], but=n)[:NAMED_PARTNERS]]
    return out


def _score_partners(maps: Maps, named: list[list[int]], scale: str, end: float) -> tuple[dict[tuple[int, int], float], bool]:
    """Return the log odds of the pairs; those are all, if time allowed and there is a choice. Map by map, so that few are in
    memory; those that look most alike first, if time may end."""
    ranks: dict[tuple[int, int], int] = {}
    for k, of in enumerate(named):
        for place, m in enumerate(of):
            ranks[_order_pair(k, m)] = min(place, ranks.get(_order_pair(k, m), place))
    odds: dict[tuple[int, int], float] = {}
    for i, j in sorted(ranks, key=lambda pair: ranks[pair] if np.isfinite(end) else 0) if len(maps) > 2 else ():
        if time.perf_counter() >= end:
            return odds, False
        odds[i, j] = compute_coarse_log_odds(maps, i, j, scale)
    return odds, True


def _score_in_workers(maps: Maps, named: list[list[int]], scale: str, workers: Workers) -> None:
    """Let workers lay maps that are files on each other, where that was not done before: each on all later ones at once."""
    files = [maps.get_file(k) for k in range(len(maps))]
    later: dict[int, list[int]] = {}
    for i, j in sorted({_order_pair(k, m) for k, of in enumerate(named) for m in of}):
        if files[i] and files[j] and build_coarse_key(maps, i, j) not in maps.memory.coarse:
            later.setdefault(i, [i]).append(j)
    placed = list(later.values())
    tasks = [CoarseTask(tuple(filter(None, (files[k] for k in of))), tuple(maps.keys[k] for k in of), scale) for of in placed]
    for number, odds in workers(score_coarsely, tasks) if tasks else ():
        for k, log_odds in zip(placed[number][1:], odds, strict=True):
            maps.memory.coarse[build_coarse_key(maps, placed[number][0], k)] = log_odds


def _order_pair(i: int, j: int) -> tuple[int, int]:
    return min(i, j), max(i, j)
