"""More than two maps: pairs are registered as far as needed, cycles must close, a pose graph settles the rest (method 4).

Nothing depends on the order of the maps, and little on how many pairs there are: maps that lie in one frame already are not
searched in each other again, they are only asked whether they agree. Maps that nothing connects stay apart, and are named.
Of more than eleven maps each is only registered with some that its rooms look most like (`partners`).
"""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, MutableMapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from topomerge import __version__
from topomerge.archive import convert_to_plain
from topomerge.embedding.quarter_turns import Descriptor
from topomerge.errors import InputError
from topomerge.fusion.atlas.link_evidence import Link
from topomerge.fusion.atlas.maps import Maps, MapSummary, Memory, bend_maps
from topomerge.fusion.atlas.pairs import Checks, Contradiction, find_conflict_columns, find_hypotheses, locate_contradiction
from topomerge.fusion.atlas.partners import PairTask, Workers, find_partners, register_pair
from topomerge.fusion.atlas.result import AtlasResult
from topomerge.fusion.inputs import (
    check_cells,
    check_list,
    check_scale,
    check_units,
    format_no_rooms_warning,
    resolve_link_threshold,
)
from topomerge.fusion.pose_graph import Assembler, Assembly, compute_residual
from topomerge.matching.poses import PoseHypothesis
from topomerge.progress import Stopwatch, report_steps, tell_step
from topomerge.registration.bend.bend import NEITHER_BENDS
from topomerge.registration.posterior import check_same
from topomerge.registration.verify import load_model
from topomerge.types import Array, Deformation, Sim3, TopometricMap

SURE_LINK = 4.0  # log odds of a link, above which no further ones are looked for within its component
ENOUGH_REGISTRATIONS = 3  # of a map, after which none within its component is made
RegistrationsByPair = MutableMapping[tuple[str, str], tuple[PoseHypothesis, ...]]  # by the keys of both maps
Proposed = Mapping[tuple[str, str], Sim3]  # T_ij by the keys of both maps, in any order


@dataclass(frozen=True)
class AtlasSettings:
    """How maps are brought together; see `atlas`."""

    scale: str = "fixed"
    threshold: float | None = None
    embedder: str | Descriptor | None = None
    rigid: bool = False
    same: str = "nothing"


@dataclass(frozen=True)
class SolvingSchedule:
    """When an answer is wanted, and who works on it.

    Args:
        seconds: after which no more pairs are registered; `AtlasResult.complete` says whether some are left.
        answered: is told how the maps lie before they are finely registered and bent.
        workers: register the pairs of maps that are files; None: this process does.
    """

    seconds: float = np.inf
    answered: Callable[[AtlasResult], None] | None = None
    workers: Workers | None = None


def build_atlas(
    maps: Sequence[TopometricMap | str | Path],
    *,
    scale: str = "fixed",
    threshold: float | None = None,
    embedder: str | Descriptor | None = None,
    rigid: bool = False,
    same: str = "nothing",
    registrations: RegistrationsByPair | None = None,
) -> AtlasResult:
    """Bring maps together, as many as belong together.

    Args:
        maps: topometric maps or `.tmap` files, two or more; of files only a few are in memory at once.
        scale: "fixed", or "free" where the scales of the maps differ in unknown ways.
        threshold: probability from which a link is believed; if None 0.8, of more than eleven maps 0.9: a wrong one does harm.
        embedder: "learned", "engineered", "shapedna", "feather", the run or file of a trained one, or a callable map -> (R, D):
            matched rooms propose poses, too. None: the learned descriptors only say which pairs to try first.
        rigid: leave the maps as they are? Else all that belong together are bent together, each by as much as its sensor drifts.
        same: "nothing", "building" or "storey": all maps are known to be of one.
        registrations: made before, by the keys of both maps; those made now are added.

    Raises:
        InputError: no list, fewer than two maps, one map twice, a map without cells, maps in different units, a wrong threshold,
            risk or scale, or another word for what is known.
    """
    check_list(maps, "build_atlas")
    return solve(maps, AtlasSettings(scale, threshold, embedder, rigid, same), registrations)


def solve(
    maps: Sequence[TopometricMap | str | Path],
    settings: AtlasSettings,
    registrations: RegistrationsByPair | None = None,
    names: Sequence[str] | None = None,
    keys: Sequence[str] | None = None,
    proposed: Proposed | None = None,
    memory: Memory | None = None,
    schedule: SolvingSchedule | None = None,
) -> AtlasResult:
    """Solve, as `atlas`, for any number of maps, one or none, too.

    Args:
        names: of the maps, for messages; their sources if None.
        keys: what `hash_map` should give for each map.
        proposed: poses of pairs, tried beside those that are looked for; these may be registered however alike the maps look.
        memory: of maps that were put together before; it changes how long it takes, not what comes out.
        schedule: of who waits for an answer.

    Raises:
        InputError: as `atlas`; and a map has another key.
    """
    watch = Stopwatch()
    check_scale(settings.scale)
    check_same(settings.same)
    threshold = _compute_log_odds(resolve_link_threshold(settings.threshold, len(maps)))
    memory = Memory() if memory is None else memory
    names, map_keys, warnings = _check_maps(maps, names, keys, settings.scale, memory)
    order = sorted(range(len(maps)), key=lambda k: map_keys[k])
    ordered = Maps([maps[k] for k in order], settings.embedder, memory, [map_keys[k] for k in order])
    explorer = _Explorer(ordered, settings, threshold, {} if registrations is None else registrations, proposed or {})
    schedule = schedule or SolvingSchedule()
    assembly = explorer.explore(time.perf_counter() + schedule.seconds, schedule.workers)
    if schedule.answered is not None:
        schedule.answered(_build_result(assembly, explorer, names, order, rigid=True, fine=False))
    result = _build_result(assembly, explorer, names, order, settings.rigid)
    return replace(result, maps=Maps(maps), seconds=watch.elapsed, warnings=(*warnings, *result.warnings))


def _check_maps(
    maps: Sequence[TopometricMap | str | Path],
    names: Sequence[str] | None,
    keys: Sequence[str] | None,
    scale: str,
    memory: Memory,
) -> tuple[list[str], list[str], list[str]]:
    """Return the names, keys and warnings of the maps, which are looked at one after the other."""
    map_names: list[str] = []
    map_keys: list[str] = []
    warnings: list[str] = []
    first: MapSummary | None = None
    for k, source in enumerate(maps):
        summary = memory.summarise(source)
        name = names[k] if names else summary.extent.source or f"map {k}"
        if keys and keys[k] != summary.key:
            raise InputError(f"{source}: is not the map that was added as {name}; take it out with `topomerge atlas remove`")
        check_cells(summary.extent.cells, name)
        if summary.key in map_keys:
            raise InputError(f"{name}: is the same map as {map_names[map_keys.index(summary.key)]}; give it once")
        if first is None:
            first = summary
        elif scale == "fixed":
            check_units(first.extent, summary.extent)
        if not summary.rooms:
            warnings.append(format_no_rooms_warning(name))
        map_names.append(name)
        map_keys.append(summary.key)
    return map_names, map_keys, warnings


def _compute_log_odds(probability: float) -> float:
    return float(np.log(max(probability, 1e-9) / max(1 - probability, 1e-9)))


class _Explorer:
    """Registers pairs until each map is surely connected, or nothing is left to try.

    Args:
        maps: in the order of their keys.
        threshold: log odds from which a link is believed.
    """

    def __init__(
        self, maps: Maps, settings: AtlasSettings, threshold: float, registrations: RegistrationsByPair, proposed: Proposed
    ) -> None:
        self.maps, self.scale, self.same, self.embedder = maps, settings.scale, settings.same, settings.embedder
        self.registrations, self.threshold = registrations, threshold
        self.proposed = {**proposed, **{(j, i): pose.inverse() for (i, j), pose in proposed.items()}}
        self.tried: dict[tuple[int, int], tuple[PoseHypothesis, ...]] = {}
        self.complete = True
        self._start_assembler()
        place = {key: k for k, key in enumerate(maps.keys)}
        self.linked = sorted((min(place[a], place[b]), max(place[a], place[b])) for a, b in proposed if {a, b} <= set(place))
        self.partners: list[list[int]] = []

    def _start_assembler(self) -> None:
        """Forget all that was judged, so that what is assembled depends on the registered pairs alone.

        Poses near each other are judged once, at the first one, and which that is depends on what was registered first.
        """
        scaled = self.scale == "free"
        self.tried = dict(sorted(self.tried.items()))
        self.checks = Checks(self.maps, scaled)
        self.assembler = Assembler(len(self.maps), self.tried, self.checks, self.threshold, scaled)
        self.rounds = 0  # of assembling since then

    def explore(self, end: float = np.inf, workers: Workers | None = None) -> Assembly:
        """Return the assembly that more registrations would not change; after the end of the time, that of those that were
        made."""
        self.partners, examined = find_partners(self.maps, self.linked, self.scale, (time.perf_counter() + end) / 2, workers)
        self.tried.update({pair: self._register(*pair) for pair in self.linked if self._is_registered(*pair)})
        while True:
            assembly = self.assembler.build()
            self.rounds += bool(self.tried)
            counts = np.bincount([k for pair in self.tried for k in pair], minlength=len(self.maps))
            pairs = set(self._iter_next_pairs(assembly, counts, time.perf_counter() >= end))
            if not pairs and self.rounds > 1:
                self._start_assembler()
                continue
            if not pairs:
                self.complete = examined and not any(self._iter_next_pairs(assembly, counts))
                return assembly
            in_turn = sorted(pairs, key=lambda pair: (counts[list(pair)].min(), pair))  # what nothing is known of comes first
            if workers is not None and time.perf_counter() < end:
                self._register_all(in_turn, workers)
            for i, j in in_turn:
                if self._is_registered(i, j) or time.perf_counter() < end:
                    self.tried[i, j] = self._register(i, j)

    def _iter_next_pairs(self, assembly: Assembly, counts: Array, late: bool = False) -> Iterator[tuple[int, int]]:
        """Yield for each map its most promising partner in another component, and where it is not surely connected one in its
        own.

        Args:
            counts: pairs that were tried, of each map.
            late: only pairs that are registered already.
        """
        lies_in = {k: n for n, component in enumerate(assembly.components) for k in component}
        sure = {k for link in assembly.links if link.log_odds >= SURE_LINK for k in link.maps}
        for k in range(len(self.maps)):
            pairs = [((min(k, m), max(k, m)), lies_in[k] == lies_in[m]) for m in self.partners[k]]
            pairs = [p for p in pairs if p[0] not in self.tried and not (late and not self._is_registered(*p[0]))]
            outside = [pair for pair, within in pairs if not within]
            inside = [pair for pair, within in pairs if within and k not in sure and counts[k] < ENOUGH_REGISTRATIONS]
            yield from (*outside[:1], *inside[:1])

    def _is_registered(self, i: int, j: int) -> bool:
        return (self.maps.keys[i], self.maps.keys[j]) in self.registrations

    def _register_all(self, pairs: Sequence[tuple[int, int]], workers: Workers) -> None:
        """Let workers register those pairs of files that were not yet."""
        todo, tasks = [], []
        for i, j in pairs:
            files, keys = (self.maps.get_file(i), self.maps.get_file(j)), (self.maps.keys[i], self.maps.keys[j])
            if not self._is_registered(i, j) and files[0] is not None and files[1] is not None:
                proposed = (self.proposed[keys],) if keys in self.proposed else ()
                tasks.append(PairTask((files[0], files[1]), keys, self.embedder, self.scale, self.same, proposed))
                todo.append(keys)
        for number, ranked in workers(register_pair, tasks) if tasks else ():
            self.registrations[todo[number]] = ranked

    def _register(self, i: int, j: int) -> tuple[PoseHypothesis, ...]:
        pair = (self.maps.keys[i], self.maps.keys[j])
        if pair not in self.registrations:
            tried = [self.proposed[pair]] if pair in self.proposed else []
            done = len(self.tried)
            tell_step(0.85 * min(done / (2 * len(self.maps)), 1.0), f"register pair {done + 1}")
            with report_steps(None):  # its own steps are shares of one pair
                self.registrations[pair] = find_hypotheses(self.maps, i, j, self.scale, self.same, tried)
        return self.registrations[pair]


def _build_result(
    assembly: Assembly, explorer: _Explorer, names: Sequence[str], order: Sequence[int], rigid: bool, fine: bool = True
) -> AtlasResult:
    """Return all by the places of the maps as they were given, in the frames of the first ones."""
    transforms: dict[int, Sim3] = {}
    residuals: dict[int, float] = {}
    bends: dict[int, Deformation] = {}
    warnings: list[str] = []
    contradictions: list[Contradiction] = []
    for component in assembly.components:
        poses, edges = explorer.assembler.settle(component, assembly.links, fine)
        rigid_poses = poses
        if not rigid and len(component) > 1:
            pairs = sorted({link.maps for link in assembly.links if link.maps[0] in component})
            poses, deformations, reason = bend_maps(explorer.maps, poses, pairs, explorer.scale == "free")
            if reason not in ("", NEITHER_BENDS):
                warnings.append(f"{', '.join(names[order[k]] for k in sorted(component))} were not bent: {reason}")
            bends |= {order[k]: d for k, d in deformations.items()}
        first = min(component, key=lambda k: order[k])
        back = poses[first].inverse()
        if fine:
            contradictions += _iter_contradictions(explorer, rigid_poses, order, rigid_poses[first].inverse())
        for k in component:
            transforms[order[k]] = Sim3() if k == first else back @ poses[k]
            gaps = [compute_residual(e, poses) for e in edges if k in e.maps]
            residuals[order[k]] = float(np.sqrt(np.mean(np.square(gaps)))) if gaps else float("nan")
    components = [tuple(sorted(order[k] for k in component)) for component in assembly.components]
    components.sort(key=lambda c: (len(c) == 1, c))
    return AtlasResult(
        explorer.maps,
        tuple(names),
        tuple(components),
        transforms,
        _reorder_links(assembly.links, order),
        _reorder_links(assembly.rejected, order),
        residuals,
        bends,
        (len(explorer.tried), len(names) * (len(names) - 1) // 2),
        warnings=tuple(warnings),
        complete=explorer.complete,
        contradictions=tuple(sorted(contradictions, key=lambda c: (c.maps, c.middle))),
    )


def _iter_contradictions(
    explorer: _Explorer, poses: Mapping[int, Sim3], order: Sequence[int], back: Sim3
) -> Iterator[Contradiction]:
    """Yield where maps of a component contradict each other, by the places of the maps as they were given.

    Args:
        poses: of the maps, in a frame that `back` takes to that of the component.
    """
    names = sorted(poses, key=lambda k: order[k])
    for n, i in enumerate(names):
        for j in names[n + 1 :]:
            check = explorer.checks(i, j, poses[i].inverse() @ poses[j])
            if check.conflicts:
                a, b = explorer.maps.get_prepared(i), explorer.maps.get_prepared(j)
                columns = find_conflict_columns(a.storeys, b.storeys, check.pose)
                pair, maps = (order[i], order[j]), (explorer.maps[i], explorer.maps[j])
                for conflict in check.conflicts:
                    yield locate_contradiction(pair, conflict, maps, check.pose, columns, back @ poses[i])


def _reorder_links(links: Iterable[Link], order: Sequence[int]) -> tuple[Link, ...]:
    """Return the links by the places of the maps as they were given, the lower one first."""
    return tuple(sorted((_renumber_link(link, order) for link in links), key=lambda link: link.maps))


def _renumber_link(link: Link, order: Sequence[int]) -> Link:
    i, j = (order[k] for k in link.maps)
    against = None if link.against is None else (order[link.against[0]], order[link.against[1]])
    h = link.hypothesis
    if j < i:
        i, j, h = j, i, replace(h, transform=h.transform.inverse())
    return Link((i, j), h, link.log_odds, against and (min(against), max(against)))


PAIRS_FILE, PAIRS_FORMAT = "pairs.json", 1
JOURNAL_FILE = ".registered.jsonl"
UNREADABLE = (ValueError, KeyError, TypeError, IndexError, AttributeError, OverflowError, RecursionError)
Pair = tuple[str, str]


class Journal(dict[Pair, tuple[PoseHypothesis, ...]]):
    """The registrations of an atlas, as its files hold them. Those that are added stand in `JOURNAL_FILE` at once, until the
    atlas itself is written.

    Args:
        folder: of the atlas, which exists.
        settings: of the atlas.

    Attributes:
        coarse: the coarse ones, log odds of pairs; written down, too (`partners.compute_coarse_log_odds`).
    """

    def __init__(self, folder: Path, settings: Mapping[str, Any]) -> None:
        listing = _read_listing(folder, settings)
        super().__init__(_parse_registrations(listing))
        self.coarse = _Coarse(self._write, _parse_coarse(listing))
        self._file, self._stamp = folder / JOURNAL_FILE, _compute_stamp(settings)
        if self._file.is_file():
            for line in self._file.read_text(encoding="utf-8", errors="replace").splitlines():
                self._take(line)

    def __setitem__(self, pair: Pair, hypotheses: tuple[PoseHypothesis, ...]) -> None:
        super().__setitem__(pair, hypotheses)
        self._write(_serialise_entry(pair, hypotheses))

    def _write(self, entry: Mapping[str, Any]) -> None:
        with self._file.open("a", encoding="utf-8") as out:
            out.write(json.dumps({"stamp": self._stamp, **entry}) + "\n")

    def _take(self, line: str) -> None:
        """Add the entry of a line; skip one that was cut, or is of other settings."""
        try:
            entry = json.loads(line)
            if entry["stamp"] == self._stamp and "coarse" in entry:
                self.coarse.update(_parse_coarse(entry))
            elif entry["stamp"] == self._stamp:
                super().__setitem__(*_parse_entry(entry))
        except UNREADABLE:
            return


class _Coarse(dict[Pair, float]):
    """Log odds of pairs; those that are added are written down."""

    def __init__(self, write: Callable[[Mapping[str, Any]], None], listed: Mapping[Pair, float]) -> None:
        super().__init__(listed)
        self._write_entry = write

    def __setitem__(self, pair: Pair, log_odds: float) -> None:
        super().__setitem__(pair, log_odds)
        self._write_entry({"coarse": [[*pair, log_odds]]})


def _read_listing(folder: Path, settings: Mapping[str, Any]) -> Mapping[str, Any]:
    """Read pairs.json; return nothing where the file is missing, damaged or of another version or other settings."""
    try:
        listing: Mapping[str, Any] = json.loads((folder / PAIRS_FILE).read_text(encoding="utf-8"))
        return listing if listing["format"] == PAIRS_FORMAT and listing["stamp"] == _compute_stamp(settings) else {}
    except (OSError, *UNREADABLE):
        return {}


def _parse_registrations(listing: Mapping[str, Any]) -> RegistrationsByPair:
    try:
        return dict(_parse_entry(entry) for entry in listing.get("pairs", ()))
    except UNREADABLE:
        return {}


def _parse_coarse(listing: Mapping[str, Any]) -> dict[Pair, float]:
    try:
        coarse = {(str(a), str(b)): float(log_odds) for a, b, log_odds in listing.get("coarse", ())}
    except UNREADABLE:
        return {}
    return {pair: log_odds for pair, log_odds in coarse.items() if math.isfinite(log_odds)}


def serialise_registrations(registrations: Journal, keys: Collection[str], settings: Mapping[str, Any]) -> dict[str, Any]:
    """Serialise the registrations of the maps with these keys; `Journal` reads them."""
    of = set(keys)
    pairs = [_serialise_entry(pair, hypotheses) for pair, hypotheses in sorted(registrations.items()) if of.issuperset(pair)]
    coarse = [[*pair, log_odds] for pair, log_odds in sorted(registrations.coarse.items()) if of.issuperset(pair)]
    return {"format": PAIRS_FORMAT, "stamp": _compute_stamp(settings), "pairs": pairs, "coarse": coarse}


def _serialise_entry(pair: Pair, hypotheses: Sequence[PoseHypothesis]) -> dict[str, Any]:
    return {"maps": list(pair), "hypotheses": [_serialise_hypothesis(h) for h in hypotheses]}


def _parse_entry(entry: Mapping[str, Any]) -> tuple[Pair, tuple[PoseHypothesis, ...]]:
    """Parse an entry of a line: the pair and its hypotheses."""
    return (entry["maps"][0], entry["maps"][1]), tuple(_parse_hypothesis(h) for h in entry["hypotheses"])


def _compute_stamp(settings: Mapping[str, Any]) -> str:
    """Hash all that registrations depend on beside the maps."""
    inputs = [__version__, load_model(), settings["scale"], str(settings["embedder"]), settings["same"]]
    return hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()[:16]


def _parse_hypothesis(listed: Mapping[str, Any]) -> PoseHypothesis:
    x, y, z = map(float, listed["translation"])
    p = float(listed["probability"])
    if not 0 <= p <= 1:
        raise ValueError(f"probability {p}")
    pose = Sim3(float(listed["yaw"]), (x, y, z), float(listed["scale"]))
    return PoseHypothesis(pose, probability=p, features={str(k): float(v) for k, v in listed["features"].items()})


def _serialise_hypothesis(hypothesis: PoseHypothesis) -> dict[str, Any]:
    pose = hypothesis.transform
    return {
        "yaw": pose.yaw,
        "translation": list(pose.translation),
        "scale": pose.scale,
        "probability": hypothesis.probability,
        "features": convert_to_plain(dict(hypothesis.features)),
    }
