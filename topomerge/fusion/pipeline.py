"""Maps -> one map, or an honest refusal: poses of walls and of matched rooms judged on the whole maps, cells fused (seeds 3.3;
method 4).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.blas import limit_blas_threads
from topomerge.embedding.learned import DEFAULT, get_descriptor_name
from topomerge.embedding.learned import build_embedder as make_embedder
from topomerge.embedding.quarter_turns import Descriptor, Rows
from topomerge.fusion.atlas.maps import hash_map
from topomerge.fusion.atlas.solve import AtlasSettings, RegistrationsByPair, solve
from topomerge.fusion.fuse import fuse, match_common_rooms
from topomerge.fusion.inputs import (
    check_list,
    check_pair,
    check_poses,
    check_scale,
    iter_pair_warnings,
    load_input,
    resolve_threshold,
)
from topomerge.fusion.result import MERGE_STEPS, MergeResult, RoomMatch
from topomerge.landmarks.fuse import CONTRADICTING
from topomerge.landmarks.likelihood import WORDS
from topomerge.landmarks.settle import Observation, find_observations
from topomerge.matching.consistency import compute_match_probability
from topomerge.matching.match import Matching, match
from topomerge.matching.poses import PoseHypothesis
from topomerge.progress import Stopwatch, tell_step
from topomerge.registration.bend.bend import NEITHER_BENDS
from topomerge.registration.pipeline import FallbackProposals, Registration, register
from topomerge.registration.posterior import POSTERIOR, check_same, compute_evidence_limit, describe_posterior
from topomerge.registration.prepared import Prepared, compute_registration_order
from topomerge.registration.surfaces import check_open3d, estimate_room_poses
from topomerge.types import Deformation, Sim3, TopometricMap

Row = tuple[str, str, str]  # evidence, value, meaning
BY_HAND = 1 - 1e-6  # probability of a pose that somebody decided
LEFT_OPEN = 0.15  # probability of another alternative, from which on it is told what would rule it out


def explain_verdict(registration: Registration, threshold: float, force: bool = False) -> str:
    """Return one sentence: the verdict, what speaks for it and what against."""
    if registration.transform is None:
        return f"not merged: {registration.reason}"
    accepted = registration.probability >= threshold
    f = registration.features
    sign = "reaches" if accepted else "is below"
    parts = [
        f"{'merged' if accepted else 'not merged'}: probability {format_probability(registration.probability)} {sign} "
        f"{threshold:.2f}"
    ]
    parts.append(f"{f['walls']:.0f} m2 of walls agree, {f['free']:.0f} m2 of free floor seen by both")
    parts.append(f"{100 * f['conflict_share']:.1f} % of the walls stand on free floor of the other map")
    parts += registration.landmarks.list_sentences()
    if registration.landmarks.factors and accepted != (registration.walls >= threshold):
        alone = f"the walls alone would {'not ' * accepted}be believed ({format_probability(registration.walls)})"
        parts.append(alone)
    if not accepted:
        if compute_evidence_limit(f) < 1:
            parts.append("the maps share too little area for a verdict")
        elif registration.posterior and (alternatives := describe_posterior(registration.posterior, threshold)):
            parts.append(alternatives)
    if force and not accepted:
        parts.append("joined anyway (--force)")
    return "; ".join(parts)


def format_probability(probability: float) -> str:
    """Return a probability as text that never says that something is certain."""
    return "over 0.99" if probability > 0.99 else "below 0.01" if probability < 0.01 else f"{probability:.2f}"


def list_evidence(registration: Registration) -> list[Row]:
    """List the evidence for the best hypothesis: (evidence, value, meaning)."""
    if registration.transform is None:
        return []
    f = registration.features
    conflicts = (
        f"{_format_percent(f['conflict_share'])} of the walls compared, {_format_percent(f['worst_conflict'])} in the worse map"
    )
    furniture = (
        f"{_format_percent(f['met'])} of it matches furniture of the other map; expected by chance: "
        f"{_format_percent(f['chance'])}"
    )
    rows = [
        (
            "matching walls",
            f"{f['walls']:.1f} m²",
            f"{_format_percent(f['ratio'])} of the walls both could have seen; evidence for",
        ),
        ("shared free floor", f"{f['free']:.0f} m²", "seen empty by both maps; evidence for"),
        ("walls on free floor", f"{f['conflict']:.1f} m²", f"{conflicts}; evidence against"),
        (
            "walls back to back",
            _format_percent(f["opposed"]),
            "of the matching walls face opposite ways, as between neighbouring rooms",
        ),
        ("furniture", f"{f['clutter']:.1f} m²", furniture),
        ("floors", f"{f['level']:.2f} m", "largest step between floors or ceilings that should coincide"),
    ]
    if f.get("ceiling_area", 0) > 0:
        text = f"difference over {f['ceiling_area']:.0f} m²; storeys with the same plan often differ here"
        rows.append(("ceilings", f"{f['ceilings']:.2f} m", text))
    rows += _list_winner_evidence(f)
    if np.isfinite(f.get("rmse", np.nan)):
        rows.append(("surfaces", f"{100 * f['rmse']:.1f} cm", "RMS distance of matching surfaces"))
    if registration.places is not None and len(registration.places):
        odds = registration.places.log_odds
        text = f"{(odds > 0).sum()} look like the same place, {(odds <= 0).sum()} more like another one; coloured on the plan"
        rows.append(("places compared", f"{len(odds)}", text))
    for kind, factor in registration.landmarks.factors.items():
        ahead, nearest = min((factor["here"] - factor[name], name) for name in POSTERIOR if name != "here")
        times = np.exp(min(abs(ahead), 15.0))
        text = f"{times:,.0f} times as likely as of" if ahead > 0 else f"{times:,.0f} times less likely than of"
        rows.append((f"landmarks: {kind}", f"{ahead:+.1f}", f"log odds: {text} {WORDS[nearest]}"))
    if len(registration.alternatives) > 1:
        times = np.exp(min(f["margin"], 15.0))
        text = f"{times:,.0f} times as probable" if times >= 1.5 else "about as probable"
        rows.append(("lead over the next pose", text, "the best hypothesis against the next one, each judged alone"))
    return rows


def list_posterior(registration: Registration) -> list[tuple[str, str]]:
    """List the alternatives in words with their probabilities; most probable first."""
    each = registration.posterior
    names = sorted((n for n in POSTERIOR if each.get(n, 0.0) > 0), key=lambda n: -each[n])
    return [(WORDS[n], format_probability(each[n])) for n in names]


def _list_winner_evidence(f: Mapping[str, float]) -> list[Row]:
    """List the evidence that is computed for the best hypothesis only (`compute_winner_features`); joined maps of older versions
    do not have it."""
    if "moved_walls" not in f:
        return []
    rows = [
        (
            "walls in one direction",
            _format_percent(f["worst_ratio"]),
            "of the walls match along the worse of the two main directions",
        ),
        (
            "squares of 3 m",
            f"{f['squares']:.0f}",
            f"with matching walls; {_format_percent(f['bad_squares'])} of all match poorly",
        ),
        ("local misfit", _format_percent(f["moved_walls"]), "more walls match if squares of 6 m are moved separately"),
    ]
    if f["tall_conflict"] > 0:
        rows.append(("high walls on free floor", f"{f['tall_conflict']:.1f} m²", "higher than furniture; evidence against"))
    if f["hanging"] >= 1:
        text = f"of {f['hanging']:.0f} pieces of lamps, beams and ducts match; storeys do not share theirs"
        rows.append(("under the ceiling", f"{f['hanging_met']:.0f}", text))
    return rows


def format_hypothesis(
    rank: int, other: PoseHypothesis, best: PoseHypothesis, middle: Mapping[str, float] | np.ndarray
) -> list[str]:
    """Return a hypothesis as text: rank, turn, distance from the best one, odds against it, walls, conflict."""
    at = np.asarray(middle, float)[None]
    away = float(np.linalg.norm(other.transform.apply(at) - best.transform.apply(at)))
    turn = (np.degrees(other.transform.yaw) + 180) % 360 - 180
    odds = np.exp(np.clip(other.score - best.score, -15, 15))
    f = other.features
    share = f"{100 * f['conflict_share']:.1f} %"
    return [str(rank), f"{turn:.1f}", f"{away:.1f}", f"{odds:.2g}", f"{f['walls']:.1f}", f"{f['free']:.0f}", share]


def _format_percent(share: float) -> str:
    return f"{100 * share:.0f} %"


@limit_blas_threads
def merge(
    maps: Sequence[TopometricMap | str | Path | Prepared],
    *,
    scale: str = "fixed",
    force: bool = False,
    threshold: float | None = None,
    embedder: str | Descriptor = DEFAULT,
    poses: str | Mapping[tuple[int, int], Sim3 | None] = "search",
    rigid: bool = False,
    same: str = "nothing",
) -> MergeResult:
    """Bring maps together, or say why not. `merge([b, a])` gives the inverse transform.

    Args:
        maps: topometric maps, `.tmap` files, or what `registration.prepared.prepare` made of maps, two or more; `atlas` brings
            more than two together, as many as belong to the first one.
        scale: "fixed", or "free" where the scale of the second map is unknown.
        force: give the best transform and its joined map, too, where it is not believed; the status stays "abstained".
        threshold: probability from which a merge is believed; that of the calibration if None;
        `fusion.inputs.find_risk_threshold`
            gives that of a stated risk.
        embedder: "learned" (default), "engineered", "shapedna", "feather", the run or file of a trained one, or a callable
            map -> (R, D), for the matching of rooms.
        poses: "search": of walls and, where the best one is not believed, of matched rooms (default); "rooms": of matched rooms
            alone; "surfaces": of each matched pair of rooms by its surfaces, as the thesis does (with `embedder="shapedna"` its
            whole way). The last two are for two maps, the last one for maps of one scale. Or what somebody decided: pairs i < j
            of maps with the pose T_ij that is fixed, or None where they do not belong together; others are searched.
        rigid: do not bend the maps.
        same: "nothing", "building" or "storey": all maps are known to be of one, so that nothing else has to be ruled out.

    Raises:
        InputError: no list, fewer than two maps, something that is no map, one map twice, a map without cells, maps in different
            units, another word for the scale, the poses or what the maps are of, or poses of surfaces without Open3D (`pip
            install topomerge[open3d]`).
    """
    check_list(maps, "merge")
    decided = {} if isinstance(poses, str) else dict(poses)
    poses = poses if isinstance(poses, str) else "search"
    check_poses(poses, len(maps), scale)
    if poses == "surfaces":
        check_open3d()
    check_scale(scale)
    check_same(same)
    config = MergeConfig(scale, threshold, embedder, rigid, same, force, poses, decided)
    prepared = [map if isinstance(map, Prepared) else None for map in maps]
    loaded_maps = [load_input(map.load() if isinstance(map, Prepared) else map) for map in maps]
    watch = Stopwatch()
    placed = place_pair(loaded_maps, config, prepared) if len(loaded_maps) == 2 else _place_set(loaded_maps, config)
    result = replace(_join(replace(placed, decided=decided)), descriptor=get_descriptor_name(embedder))
    return replace(result, seconds=_split_seconds(placed.seconds, watch.elapsed))


@dataclass(frozen=True)
class MergeConfig(AtlasSettings):
    """The keywords of `merge`."""

    force: bool = False
    poses: str = "search"
    decided: Mapping[tuple[int, int], Sim3 | None] = field(default_factory=dict)


def place_pair(maps: Sequence[TopometricMap], config: MergeConfig, prepared: Sequence[Prepared | None] = ()) -> MergeResult:
    """Register two maps; where nothing is believed, matched rooms propose poses, too. Of those that are `prepared`, nothing is
    drawn again."""
    a, b = maps
    check_pair(a, b, config.scale)
    threshold = resolve_threshold(config.threshold)
    watch = Stopwatch()
    describe = _TimedDescriptor(config.embedder or DEFAULT, watch, config.poses == "rooms")
    fixed = config.decided.get((0, 1))
    searched = config.poses == "search" and fixed is None
    # Rooms are matched only where walls do not suffice (docs/adr/0021).
    proposals = FallbackProposals(partial(_propose_room_poses, a, b, config, describe), threshold if searched else np.inf)
    choices: dict[str, Any] = {"rigid": config.rigid or fixed is not None, "same": config.same}
    tried = proposals if fixed is None else [fixed]
    first, second = (known or map for map, known in zip(maps, prepared or (None, None), strict=True))
    registration = register(first, second, scale=config.scale, proposed=tried, searched=searched, **choices)
    accepted = registration.transform is not None and registration.probability >= threshold
    if (0, 1) in config.decided:
        accepted = fixed is not None
        registration = registration if fixed is None else replace(registration, transform=fixed)
    transforms = {1: registration.transform} if registration.transform and (accepted or config.force) else {}
    deformations = registration.bend.deformations if registration.bend and transforms else ()
    return MergeResult(
        "merged" if accepted else "abstained",
        registration.probability,
        _explain_pair(registration, threshold, config),
        transforms=transforms,
        bends={k: d for k, d in enumerate(deformations) if len(d)},
        seconds=watch.seconds,
        maps=(a, b),
        registration=registration,
        warnings=(*iter_pair_warnings(a, b, config.scale), *_iter_rigid_reasons(registration)),
        settle=tuple(_find_observations(a, b, registration, accepted)),
    )


def _explain_pair(registration: Registration, threshold: float, config: MergeConfig) -> str:
    """Say in one sentence what was decided by hand, or the verdict."""
    if (0, 1) not in config.decided:
        return explain_verdict(registration, threshold, config.force)
    text = "not merged: rejected by hand" if config.decided[0, 1] is None else "merged: accepted by hand"
    forced = "; joined anyway (--force)" if config.decided[0, 1] is None and config.force else ""
    return f"{text}; by what the maps show, the probability is {format_probability(registration.probability)}{forced}"


def _find_observations(a: TopometricMap, b: TopometricMap, registration: Registration, accepted: bool) -> list[Observation]:
    """Find observations that would settle a merge that is refused, or of which another alternative is left."""
    each = registration.posterior
    left = max((p for name, p in each.items() if name != "here"), default=0.0)
    if registration.transform is None or not registration.posterior or (accepted and left < LEFT_OPEN):
        return []
    if compute_registration_order(b) < compute_registration_order(a):  # as registration: nothing may depend on which comes first
        turned = find_observations(b, a, registration.transform.inverse(), each, registration.landmarks.inverse().witnesses)
        return [o.inverse() for o in turned]
    return find_observations(a, b, registration.transform, each, registration.landmarks.witnesses)


def _iter_rigid_reasons(registration: Registration) -> Iterator[str]:
    """Yield why maps that could have been bent were not."""
    if registration.bend is not None and registration.bend.reason not in ("", NEITHER_BENDS):
        yield f"the maps were not bent: {registration.bend.reason}"


def _place_set(maps: Sequence[TopometricMap], config: MergeConfig) -> MergeResult:
    """Bring together with the first map what belongs to it; the reason names the maps that stand apart."""
    registrations = _list_decided(maps, config)
    if config.embedder == DEFAULT:  # of sets, the default only says which pairs to try first
        config = replace(config, embedder=None)
    atlas = solve(maps, config, registrations)
    members, reason = atlas.components[atlas.find_component(0)], atlas.format_summary()
    status = "merged" if members[1:] else "abstained"
    if status == "abstained" and atlas.status != "abstained":
        reason = f"not merged: {atlas.names[0]} stands apart; {reason}"
    if config.force and atlas.status != "merged":
        reason += "; joined anyway (--force)"
        atlas = solve(maps, replace(config, threshold=0.0), registrations)
        members = atlas.components[atlas.find_component(0)]
    return MergeResult(
        status,
        atlas.get_probability(atlas.find_component(0)),
        reason,
        transforms={k: atlas.transforms[k] for k in members[1:]},
        bends={k: atlas.bends[k] for k in members if k in atlas.bends},
        maps=tuple(maps),
        atlas=atlas,
        warnings=atlas.warnings,
    )


def _list_decided(maps: Sequence[TopometricMap], config: MergeConfig) -> RegistrationsByPair:
    """List the registrations of the pairs that somebody decided: one certain hypothesis, or none."""
    keys = [hash_map(map) for map in maps] if config.decided else []
    registrations: RegistrationsByPair = {}
    for (i, j), pose in config.decided.items():
        pair = (keys[i], keys[j]) if keys[i] < keys[j] else (keys[j], keys[i])
        turned = pose if pose is None or keys[i] < keys[j] else pose.inverse()
        registrations[pair] = () if turned is None else (PoseHypothesis(turned, probability=BY_HAND),)
    return registrations


def _join(result: MergeResult) -> MergeResult:
    """Fuse the maps that have a place, and match their rooms."""
    if not result.transforms:
        return result
    tell_step(0.9, "join the maps")
    poses = {0: Sim3(), **result.transforms}
    joined = fuse(result.maps, list(poses.items()), result.bends)
    matches: list[RoomMatch] = []
    for k, m in combinations(poses, 2):
        pose = poses[m] if k == 0 else poses[k].inverse() @ poses[m]
        sure = 1.0 if result.decided.get((k, m)) is not None else result.probability
        matches += _iter_room_matches(result.maps, (k, m), pose, sure, result.bends)
    contradictions = tuple(w for w in joined.warnings if w.startswith(CONTRADICTING))
    return replace(result, matches=tuple(matches), map=joined, warnings=(*result.warnings, *contradictions))


def _iter_room_matches(
    maps: Sequence[TopometricMap], pair: tuple[int, int], pose: Sim3, merge_probability: float, bends: Mapping[int, Deformation]
) -> Iterator[RoomMatch]:
    """Yield the rooms of two maps that lie in each other; a match is as probable as the merge times
    `compute_match_probability`."""
    a, b = maps[pair[0]], maps[pair[1]]
    rooms, shared_floor = match_common_rooms(a, b, pose, (bends.get(pair[0]), bends.get(pair[1])))
    probabilities = merge_probability * compute_match_probability(a, b, rooms, shared_floor)
    for (i, j), p in zip(rooms.tolist(), probabilities.tolist(), strict=True):
        yield RoomMatch(pair, (i, j), p)


def _split_seconds(seconds: Mapping[str, float], total: float) -> dict[str, float]:
    """Split the seconds of a merge: embedding is part of no other step, and fusing is the rest."""
    split = {step: seconds.get(step, 0.0) for step in MERGE_STEPS}
    split["match"] = max(split["match"] - split["embed"], 0.0)
    split["fuse"] = max(total - split["match"] - split["embed"], 0.0)
    return split


def _propose_room_poses(a: TopometricMap, b: TopometricMap, config: MergeConfig, describe: _TimedDescriptor) -> list[Sim3]:
    """Propose the poses T_ab of matched rooms: under which sets of them lie on each other, or (`poses` "surfaces") of each by
    itself."""
    if not len(a.rooms) or not len(b.rooms):
        return []
    if compute_registration_order(b) < compute_registration_order(a):  # as registration: nothing may depend on which comes first
        return [h.inverse() for h in _propose_room_poses(b, a, config, describe)]
    with describe.watch.measure("match"):
        if config.poses == "surfaces":
            return _propose_surface_poses(a, b, match(a, b, describe, "growing"))
        return [h.transform for h in match(a, b, describe, scale_free=config.scale == "free").alternatives]


def _propose_surface_poses(a: TopometricMap, b: TopometricMap, matching: Matching) -> list[Sim3]:
    """Propose the poses T_ab of the pairs of rooms that any hypothesis holds, each pair by its surfaces."""
    probabilities: dict[tuple[int, ...], float] = {}
    for h in matching.alternatives:
        for pair in h.rooms.tolist():
            probabilities[tuple(pair)] = probabilities.get(tuple(pair), 0.0) + h.probability
    rooms = np.array(sorted(probabilities), np.int64).reshape(-1, 2)
    weights = np.array([probabilities[i, j] for i, j in rooms.tolist()])
    return [pose for pose, _ in estimate_room_poses(a, b, rooms, weights)]


class _TimedDescriptor:
    """A descriptor whose seconds are those of embedding. The one that ships is loaded when it is first asked.

    Args:
        scales: offer rows at other scales; where walls are searched, they find the scale in a tenth of the time.
    """

    def __init__(self, embedder: str | Descriptor, watch: Stopwatch, scales: bool) -> None:
        self.embedder, self.watch = embedder, watch
        # The one that ships is opened when rooms are asked for, not before each merge (docs/adr/0050).
        if embedder != DEFAULT or scales:
            _ = self.describe  # says at once what is wrong with it
        if scales and hasattr(self.describe, "at_scales"):
            self.at_scales = self._at_scales

    @cached_property
    def describe(self) -> Descriptor:
        """The descriptor itself."""
        return make_embedder(self.embedder)

    def __call__(self, map: TopometricMap) -> Rows:
        with self.watch.measure("embed"):
            return self.describe(map)

    def _at_scales(self, map: TopometricMap) -> Callable[[float], Rows]:
        rows_at: Callable[[float], Rows] = self.describe.at_scales(map)  # type: ignore[attr-defined]

        def timed(scale: float) -> Rows:
            with self.watch.measure("embed"):
                return rows_at(scale)

        return timed
