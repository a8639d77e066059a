"""More than two maps: pairs are registered as far as needed, cycles must close, a pose graph settles the rest (method 3).

Nothing depends on the order of the maps, and little on how many pairs there are: maps that lie in one frame already are not
searched in each other again, they are only asked whether they agree. Maps that nothing connects stay apart, and are named.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, MutableMapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from topomerge.embedding.room_cells import Descriptor
from topomerge.errors import InputError
from topomerge.fusion.atlas.assembly import Assembler, Assembly, Link
from topomerge.fusion.atlas.join import join_many
from topomerge.fusion.atlas.maps import Maps, map_key
from topomerge.fusion.atlas.pairs import Checks, Hypothesis, hypotheses, promise
from topomerge.fusion.atlas.pose_graph import residual
from topomerge.fusion.merge import _check_units
from topomerge.fusion.verify import model
from topomerge.io.maps import load_map
from topomerge.types import Sim3, TopometricMap

SURE = 4.0  # log odds of a link, above which no further ones are looked for within its component
ENOUGH = 3  # registrations of a map, after which none within its component is made
Known = MutableMapping[tuple[str, str], tuple[Hypothesis, ...]]


@dataclass(frozen=True, eq=False)
class AtlasResult:
    """Maps brought together as far as they can be believed to belong together.

    Args:
        maps: what was put in.
        names: of the maps, for messages.
        components: maps that lie in one frame, by their place in `maps`, each ascending; those with more than one map first. The
            frame is that of the first map.
        transforms: k -> T_0k into the first map of its component; of all maps, the first ones' is the identity.
        links: hypotheses that hold the components together.
        thrown: hypotheses that were believed by themselves and thrown out, as others contradict them.
        residuals: k -> root mean square, m, by which the measured poses of map k miss the solution.
        registered: pairs that were searched in each other, of all.
        seconds: of the whole.
        warnings: what the user should know.
    """

    maps: Maps
    names: tuple[str, ...]
    components: tuple[tuple[int, ...], ...]
    transforms: dict[int, Sim3]
    links: tuple[Link, ...] = ()
    thrown: tuple[Link, ...] = ()
    residuals: dict[int, float] = field(default_factory=dict)
    registered: tuple[int, int] = (0, 0)
    seconds: float = 0.0
    warnings: tuple[str, ...] = ()

    @property
    def alone(self) -> tuple[int, ...]:
        """Maps that nothing connects."""
        return tuple(c[0] for c in self.components if len(c) == 1)

    @property
    def status(self) -> str:
        """merged (all in one), parted (several components), or abstained (nothing could be connected)."""
        if len(self.components) < 2:
            return "merged"
        return "parted" if len(self.components[0]) > 1 else "abstained"

    def component_of(self, k: int) -> int:
        """The component of a map."""
        return next(n for n, members in enumerate(self.components) if k in members)

    def probability(self, component: int) -> float:
        """Of the weakest link of a component; 0 for a map alone."""
        held = [link.probability for link in self.links if link.maps[0] in self.components[component]]
        return min(held, default=0.0)

    def joined(self, component: int) -> TopometricMap:
        """The joined map of a component in the frame of its first map; made anew at each call.

        Raises:
            InputError: more maps together than provenance can tell apart.
        """
        return join_many(self.maps, [(k, self.transforms[k]) for k in self.components[component]])

    def words(self) -> str:
        """What came out, in a sentence or two."""
        return "; ".join(_words(self))


def atlas(
    maps: Sequence[TopometricMap | str | Path],
    *,
    scale: str = "fixed",
    threshold: float | None = None,
    embedder: str | Descriptor | None = None,
    known: Known | None = None,
) -> AtlasResult:
    """Bring maps together, as many as belong together.

    Args:
        maps: topometric maps or `.tmap` files, two or more; of files only a few are in memory at once.
        scale: "fixed", or "free" where the scales of the maps differ in unknown ways.
        threshold: probability from which a link is believed; that of the calibration if None.
        embedder: "learned", "engineered", "shapedna", "feather", the folder of a trained one, or a callable map -> (R, D):
            matched rooms propose poses, too. None: the learned descriptors only say which pairs to try first.
        known: registrations made before, by the keys of both maps; those made now are added.

    Raises:
        InputError: fewer than two maps, one map twice, a map without cells, maps in different units, a wrong threshold or scale.
    """
    if len(maps) < 2:
        raise InputError(f"an atlas needs two or more maps, not {len(maps)}; give another one")
    return solve(maps, scale=scale, threshold=threshold, embedder=embedder, known=known)


def solve(
    maps: Sequence[TopometricMap | str | Path],
    names: Sequence[str] | None = None,
    keys: Sequence[str] | None = None,
    *,
    scale: str = "fixed",
    threshold: float | None = None,
    embedder: str | Descriptor | None = None,
    known: Known | None = None,
) -> AtlasResult:
    """As `atlas`, of any number of maps, one or none, too.

    Args:
        names: of the maps, for messages; their sources if None.
        keys: what `map_key` should give for each map.

    Raises:
        InputError: as `atlas`; and a map has another key.
    """
    began = time.perf_counter()
    limit = _limit(threshold, scale)
    told, found, warnings = _looked_at(maps, names, keys, scale)
    order = sorted(range(len(maps)), key=lambda k: found[k])
    inner = Maps([maps[k] for k in order], embedder)
    explorer = _Explorer(inner, [found[k] for k in order], scale, limit, {} if known is None else known)
    assembly = explorer.explored()
    result = _result(assembly, explorer, told, order)
    return replace(result, maps=Maps(maps), seconds=time.perf_counter() - began, warnings=tuple(warnings))


def _looked_at(
    maps: Sequence[TopometricMap | str | Path], names: Sequence[str] | None, keys: Sequence[str] | None, scale: str
) -> tuple[list[str], list[str], list[str]]:
    """Names, keys and warnings of the maps, one after the other."""
    told: list[str] = []
    found: list[str] = []
    warnings: list[str] = []
    first: TopometricMap | None = None
    for k, m in enumerate(maps):
        this = m if isinstance(m, TopometricMap) else load_map(m)
        first = this if first is None else first
        told.append(names[k] if names else this.source or f"map {k}")
        if keys and keys[k] != map_key(this):
            raise InputError(f"{m}: is not the map that was added as {told[k]}; take it out with `topomerge atlas remove`")
        found.append(_checked(this, told, found))
        if k and scale == "fixed":
            _check_units(first, this)
        if not len(this.rooms):
            warnings.append(f"{told[k]}: has no rooms: only walls and empty space can be compared")
    return told, found, warnings


def _limit(threshold: float | None, scale: str) -> float:
    """Log odds from which a link is believed."""
    if scale not in ("fixed", "free"):
        raise InputError(f"scale must be fixed or free, not {scale!r}")
    p = float(model()["threshold"]) if threshold is None else float(threshold)
    if not 0 <= p <= 1:
        raise InputError(f"threshold must be a probability between 0 and 1, not {threshold}")
    return float(np.log(max(p, 1e-9) / max(1 - p, 1e-9)))


def _checked(map: TopometricMap, names: Sequence[str], keys: Sequence[str]) -> str:
    """The key of a map that can be used and was not given before."""
    if not len(map.grid):
        raise InputError(f"{names[-1]}: has no occupied cells, nothing can be merged")
    key = map_key(map)
    if key in keys:
        raise InputError(f"{names[-1]}: is the same map as {names[list(keys).index(key)]}; give it once")
    return key


class _Explorer:
    """Registers pairs until every map is surely connected, or nothing is left to try."""

    def __init__(self, maps: Maps, keys: Sequence[str], scale: str, limit: float, known: Known) -> None:
        self.maps, self.keys, self.scale, self.known = maps, keys, scale, known
        self.tried: dict[tuple[int, int], tuple[Hypothesis, ...]] = {}
        self.checks = Checks(maps, scale == "free")
        self.assembler = Assembler(len(maps), self.tried, self.checks, limit, scale == "free")
        self.promise = np.zeros((len(maps), len(maps)))
        for i in range(len(maps)):
            for j in range(i):
                self.promise[i, j] = self.promise[j, i] = promise(maps, j, i)

    def explored(self) -> Assembly:
        """The assembly that more registrations would not change."""
        while True:
            found = self.assembler.build()
            pairs = sorted(set(self._next(found)))
            for i, j in pairs:
                self.tried[i, j] = self._registered(i, j)
            if not pairs:
                return found

    def _next(self, found: Assembly) -> Iterator[tuple[int, int]]:
        """For each map its most promising partner in another component, and where it is not surely connected one in its own."""
        many = np.bincount([k for pair in self.tried for k in pair], minlength=len(self.maps))
        for k in range(len(self.maps)):
            own = found.of(k)
            sure = any(link.log_odds >= SURE for link in found.links if k in link.maps)
            partners = [m for m in np.argsort(-self.promise[k], kind="stable").tolist() if m != k]
            partners = [m for m in partners if (min(k, m), max(k, m)) not in self.tried]
            outside = [m for m in partners if m not in own]
            inside = [m for m in partners if m in own and not sure and many[k] < ENOUGH]
            for m in (*outside[:1], *inside[:1]):
                yield min(k, m), max(k, m)

    def _registered(self, i: int, j: int) -> tuple[Hypothesis, ...]:
        pair = (self.keys[i], self.keys[j])
        if pair not in self.known:
            self.known[pair] = hypotheses(self.maps, i, j, self.scale)
        return self.known[pair]


def _result(found: Assembly, explorer: _Explorer, names: Sequence[str], order: Sequence[int]) -> AtlasResult:
    """Everything by the places of the maps as they were given, in the frames of the first ones."""
    transforms: dict[int, Sim3] = {}
    residuals: dict[int, float] = {}
    for own in found.components:
        poses, edges = explorer.assembler.settled(own, found.links, fine=True)
        first = min(own, key=lambda k: order[k])
        back = poses[first].inverse()
        for k in own:
            transforms[order[k]] = Sim3() if k == first else back @ poses[k]
            near = [residual(e, poses) for e in edges if k in e.maps]
            residuals[order[k]] = float(np.sqrt(np.mean(np.square(near)))) if near else float("nan")
    components = [tuple(sorted(order[k] for k in own)) for own in found.components]
    components.sort(key=lambda c: (len(c) == 1, c))
    named = [sorted((_renamed(x, order) for x in some), key=lambda x: x.maps) for some in (found.links, found.thrown)]
    return AtlasResult(
        explorer.maps,
        tuple(names),
        tuple(components),
        transforms,
        tuple(named[0]),
        tuple(named[1]),
        residuals,
        (len(explorer.tried), len(names) * (len(names) - 1) // 2),
    )


def _renamed(link: Link, order: Sequence[int]) -> Link:
    """A link by the places of the maps as they were given, the lower one first."""
    i, j = (order[k] for k in link.maps)
    against = None if link.against is None else tuple(sorted(order[k] for k in link.against))
    h = link.hypothesis
    if j < i:
        i, j, h = j, i, Hypothesis(h.pose.inverse(), h.probability, h.features)
    return Link((i, j), h, link.log_odds, against)  # type: ignore[arg-type]


def _words(found: AtlasResult) -> Iterator[str]:
    def names(members: Iterable[int]) -> str:
        return ", ".join(Path(found.names[k]).name for k in members)

    joined = [c for c in found.components if len(c) > 1]
    if len(found.names) < 2:
        yield "one map, nothing to connect it with yet" if found.names else "no map"
    elif not joined:
        yield f"nothing could be connected: all {len(found.names)} maps stand apart"
    for n, members in enumerate(joined):
        yield f"{len(members)} maps belong together ({names(members)}), weakest link {found.probability(n):.2f}"
    if joined and found.alone:
        many = len(found.alone) > 1
        yield f"{names(found.alone)} {'stand' if many else 'stands'} apart: nothing connects {'them' if many else 'it'}"
    for link in found.thrown:
        who = "other maps contradict" if link.against is None else f"{names(link.against)} contradict"
        own = f"{names(link.maps)}: a match of probability {link.hypothesis.probability:.2f} by itself"
        yield f"{own} was thrown out, {who} it"
