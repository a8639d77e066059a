"""The result of an atlas: which maps belong together, where they lie, and the links that hold them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from topomerge.errors import InputError
from topomerge.fusion.atlas.link_evidence import Link
from topomerge.fusion.atlas.maps import Maps
from topomerge.fusion.atlas.pairs import Contradiction
from topomerge.fusion.fuse import fuse
from topomerge.types import Deformation, Sim3, TopometricMap


@dataclass(frozen=True, eq=False)
class AtlasResult:
    """Maps brought together as far as they can be believed to belong together.

    Args:
        maps: what was put in.
        names: of the maps, for messages.
        components: maps that lie in one frame, by their place in `maps`, each ascending; those with more than one map first. The
            frame is that of the first map, or of the one that the first map replaced (`transform_components`).
        transforms: k -> its pose in the frame of its component; of all maps, the first ones' is the identity as a rule.
        links: hypotheses that hold the components together.
        rejected: hypotheses that were believed by themselves and thrown out, as others contradict them.
        bends: k -> how map k is bent in its own frame, before it is posed; rigid ones are left out.
        residuals: k -> root mean square, m, by which the measured poses of map k miss the solution.
        registered: pairs that were searched in each other, of all.
        seconds: of the whole.
        warnings: what the user should know.
        complete: was everything registered that could change it?
        contradictions: places at which maps of one component contradict each other; both versions are kept.
    """

    maps: Maps
    names: tuple[str, ...]
    components: tuple[tuple[int, ...], ...]
    transforms: dict[int, Sim3]
    links: tuple[Link, ...] = ()
    rejected: tuple[Link, ...] = ()
    residuals: dict[int, float] = field(default_factory=dict)
    bends: dict[int, Deformation] = field(default_factory=dict)
    registered: tuple[int, int] = (0, 0)
    seconds: float = 0.0
    warnings: tuple[str, ...] = ()
    complete: bool = True
    contradictions: tuple[Contradiction, ...] = ()

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

    def find_component(self, k: int) -> int:
        """Return the component of a map."""
        return next(n for n, members in enumerate(self.components) if k in members)

    def get_probability(self, component: int) -> float:
        """Return the probability of the weakest link of a component; 0 for a map alone."""
        probabilities = [link.probability for link in self.links if link.maps[0] in self.components[component]]
        return min(probabilities, default=0.0)

    def transform_components(self, frames: Mapping[int, Sim3]) -> AtlasResult:
        """Return the same where components lie in other frames.

        Args:
            frames: k -> pose of map k in the frame of its component, where it is the first map of one; identities are left out.
        """
        first = {k: members[0] for members in self.components for k in members}
        moved = {k: frames[first[k]] @ pose for k, pose in self.transforms.items() if first[k] in frames}
        return replace(self, transforms=self.transforms | moved)

    def join_component(self, component: int) -> TopometricMap:
        """Return the joined map of a component in its frame; made anew at each call.

        Raises:
            InputError: no such component, or more maps together than provenance can tell apart.
        """
        count = len(self.components)
        if component not in range(-count, count):
            valid = f"{count} component{'s' * (count != 1)}, counted from 0"
            raise InputError(f"there is no component {component!r}: the atlas has {valid}")
        return fuse(self.maps, [(k, self.transforms[k]) for k in self.components[component]], self.bends)

    def format_summary(self) -> str:
        """Summarise the result in a sentence or two."""
        return "; ".join(_iter_sentences(self))


def _iter_sentences(atlas: AtlasResult) -> Iterator[str]:
    def names(members: Iterable[int]) -> str:
        return ", ".join(Path(atlas.names[k]).name for k in members)

    joined = [c for c in atlas.components if len(c) > 1]
    if len(atlas.names) < 2:
        yield "one map, nothing to connect it with yet" if atlas.names else "no map"
    elif not joined:
        yield f"nothing could be connected: all {len(atlas.names)} maps stand apart"
    for n, members in enumerate(joined):
        yield f"{len(members)} maps belong together ({names(members)}), weakest link {atlas.get_probability(n):.2f}"
    if joined and atlas.alone:
        several = len(atlas.alone) > 1
        yield f"{names(atlas.alone)} {'stand' if several else 'stands'} apart: nothing connects {'them' if several else 'it'}"
    for link in atlas.rejected:
        who = "other maps contradict" if link.against is None else f"{names(link.against)} contradict"
        match = f"{names(link.maps)}: a match of probability {link.hypothesis.probability:.2f} by itself"
        yield f"{match} was thrown out, {who} it"
    for pair in sorted({c.maps for c in atlas.contradictions}):
        places = [c for c in atlas.contradictions if c.maps == pair]
        rooms = [_format_rooms(sorted({room for c in places for room in c.rooms[k]}), names((pair[k],))) for k in (0, 1)]
        area = sum(c.area for c in places)
        yield (
            f"{names(pair)} contradict each other in {' and '.join(rooms)}: {area:.1f} m2 of walls of the one stand on free "
            "floor of the other; both versions are kept, with their source"
        )


def _format_rooms(rooms: Sequence[int], name: str) -> str:
    """Return the rooms of a map in words."""
    if not rooms:
        return f"no room of {name}"
    return f"room{'s' * (len(rooms) > 1)} {', '.join(map(str, rooms))} of {name}"
