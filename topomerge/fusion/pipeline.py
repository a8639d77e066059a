"""Maps -> one map, or an honest refusal: poses of walls and of matched rooms judged on the whole maps, cells fused (seeds 3.3;
method 4)."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.blas import one_blas_thread
from topomerge.embedding.embedders import DEFAULT, descriptor_name
from topomerge.embedding.embedders import embedder as make_embedder
from topomerge.embedding.room_cells import Descriptor
from topomerge.embedding.turns import Rows
from topomerge.extraction.stopwatch import Stopwatch
from topomerge.fusion.atlas.solve import AtlasSettings, RegistrationsByPair, solve
from topomerge.fusion.explanation import why
from topomerge.fusion.fuse import fuse, rooms_in_common
from topomerge.fusion.inputs import check_list, check_pair, check_poses, check_scale, checked_threshold, loaded, pair_warnings
from topomerge.fusion.result import MERGE_STEPS, MergeResult, RoomMatch
from topomerge.matching.match import match
from topomerge.matching.odds import match_probability
from topomerge.matching.result import Matching
from topomerge.registration.bend.bend import NEITHER_BENDS
from topomerge.registration.pipeline import FallbackProposals, Registration, register
from topomerge.registration.posterior import check_same
from topomerge.registration.prepared import registration_order
from topomerge.registration.surfaces import check_open3d, room_poses
from topomerge.types import Deformation, Sim3, TopometricMap


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
    check_scale(scale)
    check_same(same)
    config = MergeConfig(scale, threshold, embedder, rigid, same, force, poses)
    loaded_maps = [loaded(map) for map in maps]
    began = time.perf_counter()
    placed = (_place_pair if len(loaded_maps) == 2 else _place_set)(loaded_maps, config)
    result = replace(_join(placed), descriptor=descriptor_name(embedder))
    return replace(result, seconds=_split_seconds(placed.seconds, time.perf_counter() - began))


@dataclass(frozen=True)
class MergeConfig(AtlasSettings):
    """The keywords of `merge`."""

    force: bool = False
    poses: str = "search"


def _place_pair(maps: Sequence[TopometricMap], config: MergeConfig) -> MergeResult:
    """Register two maps; where nothing is believed, matched rooms propose poses, too."""
    a, b = maps
    check_pair(a, b, config.scale)
    threshold = checked_threshold(config.threshold)
    watch = Stopwatch()
    describe = _TimedDescriptor(config.embedder or DEFAULT, watch, config.poses == "rooms")
    searched = config.poses == "search"
    proposals = FallbackProposals(partial(_room_hypotheses, a, b, config, describe), threshold if searched else np.inf)
    choices: dict[str, Any] = {"rigid": config.rigid, "same": config.same}
    registration = register(a, b, scale=config.scale, proposed=proposals, searched=searched, **choices)
    accepted = registration.transform is not None and registration.probability >= threshold
    transforms = {1: registration.transform} if registration.transform and (accepted or config.force) else {}
    deformations = registration.bend.deformations if registration.bend and transforms else ()
    return MergeResult(
        "merged" if accepted else "abstained",
        registration.probability,
        why(registration, threshold, config.force),
        transforms=transforms,
        bends={k: d for k, d in enumerate(deformations) if len(d)},
        seconds=watch.seconds,
        maps=(a, b),
        registration=registration,
        warnings=(*pair_warnings(a, b, config.scale), *_not_bent(registration)),
    )


def _not_bent(registration: Registration) -> Iterator[str]:
    """Why maps that could have been bent were not."""
    if registration.bend is not None and registration.bend.reason not in ("", NEITHER_BENDS):
        yield f"the maps were not bent: {registration.bend.reason}"


def _place_set(maps: Sequence[TopometricMap], config: MergeConfig) -> MergeResult:
    """Bring together with the first map what belongs to it; the reason names the maps that stand apart."""
    registrations: RegistrationsByPair = {}
    if config.embedder == DEFAULT:  # of sets, the default only says which pairs to try first
        config = replace(config, embedder=None)
    atlas = solve(maps, config, registrations)
    members, reason = atlas.components[atlas.component_of(0)], atlas.words()
    status = "merged" if members[1:] else "abstained"
    if status == "abstained" and atlas.status != "abstained":
        reason = f"not merged: {atlas.names[0]} stands apart; {reason}"
    if config.force and atlas.status != "merged":
        reason += "; joined anyway (--force)"
        atlas = solve(maps, replace(config, threshold=0.0), registrations)
        members = atlas.components[atlas.component_of(0)]
    return MergeResult(
        status,
        atlas.probability(atlas.component_of(0)),
        reason,
        transforms={k: atlas.transforms[k] for k in members[1:]},
        bends={k: atlas.bends[k] for k in members if k in atlas.bends},
        maps=tuple(maps),
        atlas=atlas,
        warnings=atlas.warnings,
    )


def _join(result: MergeResult) -> MergeResult:
    """Fuse the maps that have a place, and match their rooms."""
    if not result.transforms:
        return result
    poses = {0: Sim3(), **result.transforms}
    joined = fuse(result.maps, list(poses.items()), result.bends)
    matches: list[RoomMatch] = []
    for k, m in combinations(poses, 2):
        pose = poses[m] if k == 0 else poses[k].inverse() @ poses[m]
        matches += _room_matches(result.maps, (k, m), pose, result.probability, result.bends)
    return replace(result, matches=tuple(matches), map=joined)


def _room_matches(
    maps: Sequence[TopometricMap], pair: tuple[int, int], pose: Sim3, merge_probability: float, bends: Mapping[int, Deformation]
) -> Iterator[RoomMatch]:
    """Rooms of two maps that lie in each other; a match is as probable as the merge times `match_probability`."""
    a, b = maps[pair[0]], maps[pair[1]]
    rooms, shared_floor = rooms_in_common(a, b, pose, (bends.get(pair[0]), bends.get(pair[1])))
    probabilities = merge_probability * match_probability(a, b, rooms, shared_floor)
    for (i, j), p in zip(rooms.tolist(), probabilities.tolist(), strict=True):
        yield RoomMatch(pair, (i, j), p)


def _split_seconds(seconds: Mapping[str, float], total: float) -> dict[str, float]:
    """Split the seconds of a merge: embedding is part of no other step, and fusing is the rest."""
    split = {step: seconds.get(step, 0.0) for step in MERGE_STEPS}
    split["match"] = max(split["match"] - split["embed"], 0.0)
    split["fuse"] = max(total - split["match"] - split["embed"], 0.0)
    return split


def _room_hypotheses(a: TopometricMap, b: TopometricMap, config: MergeConfig, describe: _TimedDescriptor) -> list[Sim3]:
    """Poses T_ab of matched rooms: under which sets of them lie on each other, or (`poses` "surfaces") of each by itself."""
    if not len(a.rooms) or not len(b.rooms):
        return []
    if registration_order(b) < registration_order(a):  # as registration: nothing may depend on which comes first
        return [h.inverse() for h in _room_hypotheses(b, a, config, describe)]
    with describe.watch.measure("match"):
        if config.poses == "surfaces":
            return _surface_hypotheses(a, b, match(a, b, describe, "growing"))
        return [h.transform for h in match(a, b, describe, scale_free=config.scale == "free").alternatives]


def _surface_hypotheses(a: TopometricMap, b: TopometricMap, matching: Matching) -> list[Sim3]:
    """Poses T_ab of the pairs of rooms that any hypothesis holds, each pair by its surfaces."""
    probabilities: dict[tuple[int, ...], float] = {}
    for h in matching.alternatives:
        for pair in h.rooms.tolist():
            probabilities[tuple(pair)] = probabilities.get(tuple(pair), 0.0) + h.probability
    rooms = np.array(sorted(probabilities), np.int64).reshape(-1, 2)
    weights = np.array([probabilities[i, j] for i, j in rooms.tolist()])
    return [pose for pose, _ in room_poses(a, b, rooms, weights)]


class _TimedDescriptor:
    """A descriptor whose seconds are those of embedding.

    Args:
        scales: offer rows at other scales; where walls are searched, they find the scale in a tenth of the time.
    """

    def __init__(self, embedder: str | Descriptor, watch: Stopwatch, scales: bool) -> None:
        self.describe, self.watch = make_embedder(embedder), watch
        if scales and hasattr(self.describe, "at_scales"):
            self.at_scales = self._at_scales

    def __call__(self, map: TopometricMap) -> Rows:
        with self.watch.measure("embed"):
            return self.describe(map)

    def _at_scales(self, map: TopometricMap) -> Callable[[float], Rows]:
        rows_at: Callable[[float], Rows] = self.describe.at_scales(map)  # type: ignore[attr-defined]

        def timed(scale: float) -> Rows:
            with self.watch.measure("embed"):
                return rows_at(scale)

        return timed
