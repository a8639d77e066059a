"""Maps -> one map, or an honest refusal: rooms matched, poses judged on the whole maps, cells fused (seeds 3.3; method.md, 3)."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from topomerge.embedding.embedders import DEFAULT, descriptor_name
from topomerge.embedding.embedders import embedder as make_embedder
from topomerge.embedding.room_cells import Descriptor
from topomerge.errors import InputError
from topomerge.fusion.atlas.join import join_many
from topomerge.fusion.explanation import why
from topomerge.fusion.fuse import rooms_in_common
from topomerge.fusion.registration import Registration, _order, register
from topomerge.fusion.result import STEPS, MergeResult, RoomMatch
from topomerge.fusion.thesis.room_poses import room_poses
from topomerge.fusion.verify import model
from topomerge.matching.match import match
from topomerge.matching.odds import match_probability
from topomerge.matching.result import Matching
from topomerge.types import Array, Sim3, TopometricMap

POSES = ("search", "rooms")
TOO_WIDE, WIDER = 300.0, 30.0  # m, and times the other map: a map that spans this is in another unit
HIGHER = 2.2  # times the height of the other's storeys: the same, or a hall


def merge(
    maps: Sequence[TopometricMap],
    *,
    scale: str = "fixed",
    force: bool = False,
    threshold: float | None = None,
    embedder: str | Descriptor = DEFAULT,
    poses: str = "search",
) -> MergeResult:
    """Bring maps together, or say why not. `merge([b, a])` gives the inverse transform.

    Args:
        maps: two topometric maps or more; `atlas` brings more than two together, as many as belong to the first one.
        scale: "fixed", or "free" where the scale of the second map is unknown.
        force: give the best transform and its joined map, too, where it is not believed; the status stays "abstained".
        threshold: probability from which a merge is believed; that of the calibration if None.
        embedder: "learned" (default), "engineered", "shapedna", "feather", the folder of a trained one, or a callable
            map -> (R, D), for the matching of rooms.
        poses: "search": of walls and of matched rooms (default); "rooms": of each matched pair of rooms by its surfaces alone, as
            the thesis does (two maps of one scale; with `embedder="shapedna"` its whole way).

    Raises:
        InputError: fewer than two maps, one map twice, a map without cells, maps in different units, another word for the scale
            or the poses.
    """
    if poses not in POSES:
        raise InputError(f"poses must be {' or '.join(POSES)}, not {poses!r}")
    if poses == "rooms" and (len(maps) > 2 or scale != "fixed"):
        raise InputError("poses of rooms alone are for two maps of one scale; leave them out (--poses search)")
    if len(maps) > 2:
        from topomerge.fusion.atlas.merge import merge_many  # it stands above this file

        return merge_many(maps, scale=scale, force=force, threshold=threshold, embedder=embedder)
    a, b = _checked(maps, scale)
    limit = float(model()["threshold"]) if threshold is None else float(threshold)
    if not 0 <= limit <= 1:
        raise InputError(f"threshold must be a probability between 0 and 1, not {threshold}")
    clock = _Clock()
    known = _hypotheses(a, b, embedder, scale, poses, clock)
    found = register(a, b, scale=scale, hypotheses=known, searched=poses == "search")
    believed = found.transform is not None and found.probability >= limit
    result = MergeResult(
        "merged" if believed else "abstained",
        found.probability,
        why(found, limit, force),
        maps=(a, b),
        registration=found,
        warnings=tuple(_warnings(a, b, scale)),
        descriptor=descriptor_name(embedder),
    )
    pose = found.transform
    if pose is None or not (believed or force):
        return replace(result, seconds=clock.all())
    joined = join_many((a, b), [(0, Sim3()), (1, pose)])
    matches = tuple(_matches(a, b, found))
    return replace(result, transforms={1: pose}, matches=matches, map=joined, seconds=clock.all())


class _Clock:
    """Seconds of embedding and matching; fusing is the rest."""

    def __init__(self) -> None:
        self.seconds = dict.fromkeys(STEPS, 0.0)
        self.began = time.perf_counter()

    @contextmanager
    def __call__(self, step: str) -> Iterator[None]:
        began = time.perf_counter()
        yield
        self.seconds[step] += time.perf_counter() - began

    def all(self) -> dict[str, float]:
        """Of each step; embedding is part of no other."""
        s = self.seconds
        s["match"] = max(s["match"] - s["embed"], 0.0)
        s["fuse"] = max(time.perf_counter() - self.began - s["match"] - s["embed"], 0.0)
        return s


def _checked(maps: Sequence[TopometricMap], scale: str) -> tuple[TopometricMap, TopometricMap]:
    if len(maps) != 2:
        raise InputError(f"merge takes two maps or more, {len(maps)} given; give another one")
    if scale not in ("fixed", "free"):
        raise InputError(f"scale must be fixed or free, not {scale!r}")
    a, b = maps
    for which, m in (("the first map", a), ("the second map", b)):
        if not len(m.grid):
            raise InputError(f"{m.source or which}: has no occupied cells, nothing can be merged")
    same = len(a.grid) == len(b.grid) and np.array_equal(a.grid.cells, b.grid.cells)
    if a is b or (same and np.allclose(a.grid.origin, b.grid.origin) and a.grid.edge == b.grid.edge):
        name = b.source or "the second map"
        raise InputError(f"{name}: is the same map as {a.source or 'the first'}; give two different maps")
    if scale == "fixed":
        _check_units(a, b)
    return a, b


def _check_units(a: TopometricMap, b: TopometricMap) -> None:
    """A map that is far larger than any neighbour of the other is in centimetres or millimetres."""
    wide = [float(np.hypot(*np.ptp(m.grid.cells[:, :2], axis=0))) * m.grid.edge for m in (a, b)]
    big, small = (a, b) if wide[0] >= wide[1] else (b, a)
    ratio = max(wide) / max(min(wide), small.grid.edge)
    if max(wide) > TOO_WIDE and ratio > WIDER:
        unit = "mm" if ratio > 300 else "cm"
        spans = f"{big.source or 'one map'}: spans {max(wide):,.0f} m, {small.source or 'the other'} {min(wide):,.0f} m"
        raise InputError(f"{spans}: the units seem to differ; extract it with --unit {unit}")


def _warnings(a: TopometricMap, b: TopometricMap, scale: str) -> Iterator[str]:
    for which, m in (("the first map", a), ("the second map", b)):
        if len(m.rooms) == 0:
            yield f"{m.source or which}: has no rooms: only walls and empty space can be compared"
        elif len(m.rooms) == 1:
            yield f"{m.source or which}: has one room: little can be compared"
    high = [_storey_height(m) for m in (a, b)]
    if scale == "fixed" and min(high) > 0 and max(high) > HIGHER * min(high):
        tall, low = (a, b) if high[0] >= high[1] else (b, a)
        names = tall.source or "one map", low.source or "the other"
        yield f"{names[0]}: storeys are {max(high):.1f} m high, in {names[1]} {min(high):.1f} m: the units may differ"


def _storey_height(m: TopometricMap) -> float:
    """m, median floor to ceiling; 0 where none was seen."""
    height = m.storeys["ceiling"] - m.storeys["floor"]
    height = height[np.isfinite(height)]
    return float(np.median(height)) if len(height) else 0.0


def _hypotheses(
    a: TopometricMap, b: TopometricMap, embedder: str | Descriptor, scale: str, poses: str, clock: _Clock
) -> list[Sim3]:
    """Poses T_ab of matched rooms: under which sets of them lie on each other, or (`poses` "rooms") of each by its surfaces."""
    if not len(a.rooms) or not len(b.rooms):
        return []
    if _order(b) < _order(a):  # as registration: nothing may depend on which comes first
        return [h.inverse() for h in _hypotheses(b, a, embedder, scale, poses, clock)]
    describe = _timed(embedder, clock)
    with clock("match"):
        if poses == "rooms":
            return _of_rooms(a, b, match(a, b, describe, "growing"))
        return [h.transform for h in match(a, b, describe, scale_free=scale == "free").alternatives]


def _of_rooms(a: TopometricMap, b: TopometricMap, found: Matching) -> list[Sim3]:
    """Poses of the pairs of rooms that any hypothesis holds, each pair by its surfaces."""
    likely: dict[tuple[int, ...], float] = {}
    for h in found.alternatives:
        for pair in h.rooms.tolist():
            likely[tuple(pair)] = likely.get(tuple(pair), 0.0) + h.probability
    rooms = np.array(sorted(likely), np.int64).reshape(-1, 2)
    weights = np.array([likely[i, j] for i, j in rooms.tolist()])
    return [pose for pose, _ in room_poses(a, b, rooms, weights)]


def _timed(embedder: str | Descriptor, clock: _Clock) -> Descriptor:
    describe = make_embedder(embedder)

    def timed(m: TopometricMap) -> Array:
        with clock("embed"):
            return describe(m)

    return timed


def _matches(a: TopometricMap, b: TopometricMap, found: Registration) -> Iterator[RoomMatch]:
    """Rooms that lie in each other; a match is as probable as the merge times `match_probability`."""
    assert found.transform is not None
    rooms, fit = rooms_in_common(a, b, found.transform)
    chance = found.probability * match_probability(a, b, rooms, fit)
    for (i, j), p in zip(rooms.tolist(), chance.tolist(), strict=True):
        yield RoomMatch((0, 1), (i, j), p)
