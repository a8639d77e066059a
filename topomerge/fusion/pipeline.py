"""Maps -> one map, or an honest refusal: poses of walls and of matched rooms judged on the whole maps, cells fused (seeds 3.3;
method 4)."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.blas import one_blas_thread
from topomerge.embedding.embedders import DEFAULT, descriptor_name
from topomerge.embedding.embedders import embedder as make_embedder
from topomerge.embedding.room_cells import Descriptor
from topomerge.embedding.turns import Rows
from topomerge.fusion.atlas.result import AtlasResult
from topomerge.fusion.atlas.solve import AtlasSettings, RegistrationsByPair, solve
from topomerge.fusion.explanation import why
from topomerge.fusion.fuse import fuse, rooms_in_common
from topomerge.fusion.inputs import check_list, check_pair, check_poses, check_scale, checked_threshold, loaded, pair_warnings
from topomerge.fusion.result import MERGE_STEPS, MergeResult, RoomMatch
from topomerge.matching.match import match
from topomerge.matching.odds import match_probability
from topomerge.matching.result import Matching
from topomerge.registration.bend.bend import NEITHER_BENDS
from topomerge.registration.pipeline import Registration, Resort, register
from topomerge.registration.posterior import check_same
from topomerge.registration.prepared import registration_order
from topomerge.registration.surfaces import check_open3d, room_poses
from topomerge.types import Sim3, TopometricMap
from topomerge.types.deformation import Deformation


@one_blas_thread
def merge(
    maps: Sequence[TopometricMap | str | Path],
    *,
    scale: str = "fixed",
    force: bool = False,
    threshold: float | None = None,
    embedder: str | Descriptor = DEFAULT,
    poses: str = "search",
    rigid: bool = False,
    same: str = "nothing",
) -> MergeResult:
    """Bring maps together, or say why not. `merge([b, a])` gives the inverse transform.

    Args:
        maps: topometric maps or `.tmap` files, two or more; `atlas` brings more than two together, as many as belong to the first
            one.
        scale: "fixed", or "free" where the scale of the second map is unknown.
        force: give the best transform and its joined map, too, where it is not believed; the status stays "abstained".
        threshold: probability from which a merge is believed; that of the calibration if None; `fusion.inputs.risk_threshold`
            gives that of a stated risk.
        embedder: "learned" (default), "engineered", "shapedna", "feather", the folder of a trained one, or a callable
            map -> (R, D), for the matching of rooms.
        poses: "search": of walls and, where the best one is not believed, of matched rooms (default); "rooms": of matched rooms
            alone; "surfaces": of each matched pair of rooms by its surfaces, as the thesis does (with `embedder="shapedna"` its
            whole way). The last two are for two maps, the last one for maps of one scale.
        rigid: do not bend the maps.
        same: "nothing", "building" or "storey": all maps are known to be of one, so that nothing else has to be ruled out.

    Raises:
        InputError: no list, fewer than two maps, something that is no map, one map twice, a map without cells, maps in different
            units, another word for the scale, the poses or what the maps are of, or poses of surfaces without Open3D (`pip
            install topomerge[open3d]`).
    """
    check_list(maps, "merge")
    check_poses(poses, len(maps), scale)
    if poses == "surfaces":
        check_open3d()
    read = [loaded(map) for map in maps]
    check_scale(scale)
    check_same(same)
    settings = _Settings(scale, force, threshold, embedder, poses, rigid, same)
    return _merge_two(read[0], read[1], settings) if len(read) == 2 else _merge_several(read, settings)


@dataclass(frozen=True)
class _Settings:
    """The keywords of `merge`."""

    scale: str
    force: bool
    threshold: float | None
    embedder: str | Descriptor
    poses: str
    rigid: bool
    same: str


def _merge_two(a: TopometricMap, b: TopometricMap, settings: _Settings) -> MergeResult:
    check_pair(a, b, settings.scale)
    threshold = checked_threshold(settings.threshold)
    clock = _Clock()
    describe = _Timed(settings.embedder, clock, settings.poses == "rooms")
    searched = settings.poses == "search"
    hypotheses = Resort(partial(_room_hypotheses, a, b, settings, describe), threshold if searched else np.inf)
    choices: dict[str, Any] = {"rigid": settings.rigid, "same": settings.same}
    registration = register(a, b, scale=settings.scale, proposed=hypotheses, searched=searched, **choices)
    believed = registration.transform is not None and registration.probability >= threshold
    result = MergeResult(
        "merged" if believed else "abstained",
        registration.probability,
        why(registration, threshold, settings.force),
        maps=(a, b),
        registration=registration,
        warnings=(*pair_warnings(a, b, settings.scale), *_not_bent(registration)),
        descriptor=descriptor_name(settings.embedder),
    )
    pose = registration.transform
    if pose is None or not (believed or settings.force):
        return replace(result, seconds=clock.all())
    bends = {} if registration.bend is None else {k: d for k, d in enumerate(registration.bend.deformations) if len(d)}
    joined = fuse((a, b), [(0, Sim3()), (1, pose)], bends)
    matches = tuple(_room_matches((a, b), (0, 1), pose, registration.probability, bends))
    return replace(result, transforms={1: pose}, bends=bends, matches=matches, map=joined, seconds=clock.all())


def _not_bent(registration: Registration) -> Iterator[str]:
    """Why maps that could have been bent were not."""
    if registration.bend is not None and registration.bend.reason not in ("", NEITHER_BENDS):
        yield f"the maps were not bent: {registration.bend.reason}"


def _merge_several(maps: Sequence[TopometricMap], settings: _Settings) -> MergeResult:
    """What an atlas brings together with the first map is joined; the reason names the maps that stand apart."""
    began = time.perf_counter()
    registrations: RegistrationsByPair = {}
    descriptor = None if settings.embedder == DEFAULT else settings.embedder  # the default only says which pairs to try first
    atlas_settings = AtlasSettings(settings.scale, settings.threshold, descriptor, settings.rigid, settings.same)
    atlas = solve(maps, atlas_settings, registrations)
    reason, status = atlas.words(), "merged" if _with_first(atlas)[1:] else "abstained"
    if status == "abstained" and atlas.status != "abstained":
        reason = f"not merged: {atlas.names[0]} stands apart; {reason}"
    if settings.force and atlas.status != "merged":
        reason += "; joined anyway (--force)"
        atlas = solve(maps, replace(atlas_settings, threshold=0.0), registrations)
    members, component = _with_first(atlas), atlas.component_of(0)
    matches: list[RoomMatch] = []
    for n, k in enumerate(members):
        for m in members[n + 1 :]:
            pose = atlas.transforms[k].inverse() @ atlas.transforms[m]
            matches += _room_matches(maps, (k, m), pose, atlas.probability(component), atlas.bends)
    joined = atlas.joined(component) if len(members) > 1 else None
    return MergeResult(
        status,
        atlas.probability(component),
        reason,
        transforms={k: atlas.transforms[k] for k in members[1:]},
        bends={k: atlas.bends[k] for k in members if k in atlas.bends},
        matches=tuple(matches),
        seconds={**dict.fromkeys(MERGE_STEPS, 0.0), "fuse": time.perf_counter() - began},
        map=joined,
        maps=tuple(maps),
        atlas=atlas,
        warnings=atlas.warnings,
        descriptor=descriptor_name(settings.embedder),
    )


def _with_first(atlas: AtlasResult) -> tuple[int, ...]:
    """The maps that lie in the frame of the first one, itself included."""
    return atlas.components[atlas.component_of(0)]


def _room_matches(
    maps: Sequence[TopometricMap], pair: tuple[int, int], pose: Sim3, merge_probability: float, bends: Mapping[int, Deformation]
) -> Iterator[RoomMatch]:
    """Rooms of two maps that lie in each other; a match is as probable as the merge times `match_probability`."""
    a, b = maps[pair[0]], maps[pair[1]]
    rooms, shared_floor = rooms_in_common(a, b, pose, (bends.get(pair[0]), bends.get(pair[1])))
    probabilities = merge_probability * match_probability(a, b, rooms, shared_floor)
    for (i, j), p in zip(rooms.tolist(), probabilities.tolist(), strict=True):
        yield RoomMatch(pair, (i, j), p)


class _Clock:
    """Seconds of embedding and matching; fusing is the rest."""

    def __init__(self) -> None:
        self.seconds = dict.fromkeys(MERGE_STEPS, 0.0)
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


def _room_hypotheses(a: TopometricMap, b: TopometricMap, settings: _Settings, describe: _Timed) -> list[Sim3]:
    """Poses T_ab of matched rooms: under which sets of them lie on each other, or (`poses` "surfaces") of each by itself."""
    if not len(a.rooms) or not len(b.rooms):
        return []
    if registration_order(b) < registration_order(a):  # as registration: nothing may depend on which comes first
        return [h.inverse() for h in _room_hypotheses(b, a, settings, describe)]
    with describe.clock("match"):
        if settings.poses == "surfaces":
            return _surface_hypotheses(a, b, match(a, b, describe, "growing"))
        return [h.transform for h in match(a, b, describe, scale_free=settings.scale == "free").alternatives]


def _surface_hypotheses(a: TopometricMap, b: TopometricMap, matching: Matching) -> list[Sim3]:
    """Poses T_ab of the pairs of rooms that any hypothesis holds, each pair by its surfaces."""
    probabilities: dict[tuple[int, ...], float] = {}
    for h in matching.alternatives:
        for pair in h.rooms.tolist():
            probabilities[tuple(pair)] = probabilities.get(tuple(pair), 0.0) + h.probability
    rooms = np.array(sorted(probabilities), np.int64).reshape(-1, 2)
    weights = np.array([probabilities[i, j] for i, j in rooms.tolist()])
    return [pose for pose, _ in room_poses(a, b, rooms, weights)]


class _Timed:
    """A descriptor whose seconds are those of embedding.

    Args:
        scales: offer rows at other scales; where walls are searched, they find the scale in a tenth of the time.
    """

    def __init__(self, embedder: str | Descriptor, clock: _Clock, scales: bool) -> None:
        self.describe, self.clock = make_embedder(embedder), clock
        if scales and hasattr(self.describe, "at_scales"):
            self.at_scales = self._at_scales

    def __call__(self, map: TopometricMap) -> Rows:
        with self.clock("embed"):
            return self.describe(map)

    def _at_scales(self, map: TopometricMap) -> Callable[[float], Rows]:
        rows_at: Callable[[float], Rows] = self.describe.at_scales(map)  # type: ignore[attr-defined]

        def timed(scale: float) -> Rows:
            with self.clock("embed"):
                return rows_at(scale)

        return timed
