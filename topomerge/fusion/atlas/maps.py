"""The maps of an atlas: what is made of them stays in memory while it is needed, so that many maps take no more than some."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TypeVar

from topomerge.embedding.embedders import DEFAULT
from topomerge.embedding.embedders import embedder as make_embedder
from topomerge.embedding.room_cells import Descriptor
from topomerge.embedding.turns import Rows
from topomerge.fusion.atlas.memory import Memory
from topomerge.fusion.bend.bend import bend_together
from topomerge.fusion.bend.deformation import Deformation
from topomerge.fusion.prepared import Prepared, prepare
from topomerge.fusion.refine import surface
from topomerge.io.maps import load_map
from topomerge.matching.match import checked
from topomerge.types import Array, Sim3, TopometricMap

Made = TypeVar("Made")


class Maps:
    """A sequence of maps with what is made of them once.

    Args:
        maps: topometric maps, or `.tmap` files.
        embedder: of rooms; None where only geometry shall propose poses.
        memory: of what was made of maps with these keys before.
        keys: of the maps, where there is a memory.
    """

    def __init__(
        self,
        maps: Sequence[TopometricMap | str | Path],
        embedder: str | Descriptor | None = None,
        memory: Memory | None = None,
        keys: Sequence[str] = (),
    ) -> None:
        self.matched, self.memory = embedder is not None, memory or Memory()
        self.embedder = embedder or DEFAULT
        self._describe = make_embedder(self.embedder)
        self.keys = tuple(keys) if memory is not None else tuple(map(str, range(len(maps))))
        self.memory.keep(dict(zip(self.keys, maps, strict=True)))

    def __len__(self) -> int:
        return len(self.keys)

    def __getitem__(self, k: int) -> TopometricMap:
        return self.memory.map(self.keys[k])

    def file(self, k: int) -> Path | None:
        """The file of a map; None of one in memory."""
        return self.memory.file(self.keys[k])

    def prepared(self, k: int) -> Prepared:
        """Plans, for registration."""
        memory, key = self.memory, self.keys[k]

        def make() -> Prepared:
            make_surface = partial(memory.surface, key, lambda: surface(memory.map(key).grid))
            return replace(prepare(memory.map(key)), load=lambda: memory.map(key), make_surface=make_surface)

        return memory.prepared(key, make)

    def answer(self, question: tuple[Hashable, ...], maps: Iterable[int], make: Callable[[], Made]) -> Made:
        """`Memory.answer` to a question about some of the maps."""
        return self.memory.answer((*question, *(self.keys[k] for k in maps)), make)

    def area(self, k: int) -> float:
        """Floor area, m2, of what is known from above."""

        def make() -> float:
            return float(sum(v.plan.explored.sum() * v.plan.edge**2 for v in self.prepared(k).storeys))

        return self.answer(("area",), (k,), make)

    def middle(self, k: int) -> Array:
        """(3,) of its cells, m."""
        return self.answer(("middle",), (k,), lambda: self.prepared(k).middle)

    def sliced(self, k: int) -> bool:
        """Is a storey a slice, which has no planes?"""
        return self.answer(("sliced",), (k,), lambda: any(v.plan.sliced for v in self.prepared(k).storeys))

    def rows(self, k: int) -> Rows:
        """Descriptors of the rooms."""
        return self.memory.answer(("rows", self.embedder, self.keys[k]), lambda: checked(self._describe, self[k]))


class MapFiles(Mapping[int, TopometricMap]):
    """Maps by their numbers, read from their files whenever they are asked for."""

    def __init__(self, files: Mapping[int, Path]) -> None:
        self._files = dict(files)

    def __getitem__(self, n: int) -> TopometricMap:
        return load_map(self._files[n])

    def __iter__(self) -> Iterator[int]:
        return iter(self._files)

    def __len__(self) -> int:
        return len(self._files)


def bent_together(
    maps: Maps, poses: Mapping[int, Sim3], pairs: Sequence[tuple[int, int]], scaled: bool
) -> tuple[dict[int, Sim3], dict[int, Deformation], str]:
    """`bend_together` of some maps, by their numbers."""
    names = sorted(poses)
    places = tuple((names.index(i), names.index(j)) for i, j in pairs)

    def make() -> tuple[dict[int, Sim3], dict[int, Deformation], str]:
        return bend_together({n: maps.prepared(k) for n, k in enumerate(names)}, dict(enumerate(lying)), places, scaled)

    lying = tuple(poses[k] for k in names)
    moved, deformations, reason = maps.answer(("bent", lying, places, scaled), names, make)
    return {names[n]: p for n, p in moved.items()}, {names[n]: d for n, d in deformations.items()}, reason
