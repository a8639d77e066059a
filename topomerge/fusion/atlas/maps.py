"""The maps of a set: what is made of them is kept while it is needed, from one solve to the next, so that many maps take no more
memory than some. Nothing of it changes what comes out."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, MutableMapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from topomerge.edits.apply import load_corrected_map
from topomerge.edits.journal import find_journal
from topomerge.embedding.learned import DEFAULT
from topomerge.embedding.learned import build_embedder as make_embedder
from topomerge.embedding.quarter_turns import Descriptor, Rows
from topomerge.fusion.inputs import Extent
from topomerge.matching.match import embed_rooms
from topomerge.registration.bend.bend import bend_together
from topomerge.registration.prepared import Prepared, prepare
from topomerge.registration.refine import build_surface
from topomerge.types import EDITED, Array, Deformation, Sim3, TopometricMap

LOADED_AT_ONCE = 3  # maps in memory, of those that are files
PREPARED_AT_ONCE = 64  # maps whose plans are in memory
SURFACES_AT_ONCE = 8  # surfaces in memory, for the fine registration
Made = TypeVar("Made")


@dataclass(frozen=True)
class MapSummary:
    """A summary of a map, read before it is put together with others.

    Args:
        key: `hash_map`.
        rooms: their number.
    """

    key: str
    rooms: int
    extent: Extent


class Memory:
    """Maps by their keys, and answers to questions about them.

    Args:
        coarse: by the keys of two maps, ascending, how likely they lie on each other (`partners.compute_coarse_log_odds`).
    """

    def __init__(self, coarse: MutableMapping[tuple[str, str], float] | None = None) -> None:
        self.coarse = {} if coarse is None else coarse
        self._summaries: dict[Path, tuple[tuple[int, ...], MapSummary]] = {}  # of files, with what tells whether they changed
        self._sources: dict[str, TopometricMap | str | Path] = {}
        self._loaded: OrderedDict[str, TopometricMap] = OrderedDict()
        self._prepared: OrderedDict[str, Any] = OrderedDict()
        self._surfaces: OrderedDict[str, Any] = OrderedDict()
        self._answers: dict[tuple[Hashable, ...], Any] = {}  # that were asked for since the maps were named
        self._before: dict[tuple[Hashable, ...], Any] = {}  # … between that and the time before

    def keep(self, sources: Mapping[str, TopometricMap | str | Path]) -> None:
        """Keep these maps, which are asked about from now on; drop answers that were not asked for since the last time.

        Args:
            sources: key -> map or `.tmap` file.
        """
        self._sources = dict(sources)
        self._before, self._answers = self._answers, {}

    def summarise(self, source: TopometricMap | str | Path) -> MapSummary:
        """Summarise a map; the summary of a file that has not changed is remembered.

        Raises:
            InputError: the file can't be read.
        """
        if isinstance(source, TopometricMap):
            return _summarise_map(source)
        path = Path(source)
        try:
            stat = path.stat()
        except OSError:
            return _summarise_map(load_corrected_map(path))  # says what is wrong with it
        journal = find_journal(path)
        edited = journal.stat().st_size if journal.exists() else 0  # a journal only grows
        stamp = (stat.st_ino, stat.st_size, stat.st_mtime_ns, edited)
        if path not in self._summaries or self._summaries[path][0] != stamp:
            self._summaries[path] = (stamp, _summarise_map(load_corrected_map(path)))
        return self._summaries[path][1]

    def load(self, key: str) -> TopometricMap:
        """Return a map; files are loaded when they are needed."""
        source = self._sources[key]
        if isinstance(source, TopometricMap):
            return source
        return _get_recent(self._loaded, key, LOADED_AT_ONCE, lambda: load_corrected_map(source))

    def get_file(self, key: str) -> Path | None:
        """Return the file that a map is loaded from; None of one that is given as it is."""
        source = self._sources[key]
        return None if isinstance(source, TopometricMap) else Path(source)

    def get_prepared(self, key: str, make: Callable[[], Made]) -> Made:
        """Return the plans of a map, one of the last that were asked for or made now."""
        out: Made = _get_recent(self._prepared, key, PREPARED_AT_ONCE, make)
        return out

    def get_surface(self, key: str, make: Callable[[], Made]) -> Made:
        """Return the surface of a map, one of the last that were asked for or made now."""
        out: Made = _get_recent(self._surfaces, key, SURFACES_AT_ONCE, make)
        return out

    def answer(self, question: tuple[Hashable, ...], make: Callable[[], Made]) -> Made:
        """Return the remembered answer to a question, or compute it.

        Args:
            question: all that the answer depends on; of maps their keys.
        """
        if question not in self._answers:
            self._answers[question] = self._before.pop(question) if question in self._before else make()
        out: Made = self._answers[question]
        return out


def _summarise_map(map: TopometricMap) -> MapSummary:
    return MapSummary(hash_map(map), len(map.rooms), Extent.from_map(map))


def hash_map(map: TopometricMap) -> str:
    """Compute the 16 hexadecimal digits of a hash of cells, rooms, free space and landmarks; of a corrected map of its doors,
    too."""
    digest = hashlib.sha256()
    for grid in (map.grid, map.navigable, map.free):
        if grid is not None:
            digest.update(np.ascontiguousarray(grid.cells).tobytes() + grid.origin.tobytes() + np.float64(grid.edge).tobytes())
    digest.update(map.room.tobytes() + map.navigable_room.tobytes() + map.rooms.tobytes())
    if len(map.landmarks):
        digest.update(map.landmarks.table.tobytes() + repr(map.landmarks.values).encode(errors="replace"))
    if EDITED in map.parameters:
        digest.update(map.edges.tobytes() + map.windows.tobytes())
    return digest.hexdigest()[:16]


def _get_recent(memory: OrderedDict[str, Made], key: str, capacity: int, make: Callable[[], Made]) -> Made:
    """Get what was made of a map, from the memory of those that were used last, or make it."""
    if key not in memory:
        memory[key] = make()
        while len(memory) > capacity:
            memory.popitem(last=False)
    memory.move_to_end(key)
    return memory[key]


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
        return self.memory.load(self.keys[k])

    def get_file(self, k: int) -> Path | None:
        """Return the file of a map; None of one in memory."""
        return self.memory.get_file(self.keys[k])

    def get_prepared(self, k: int) -> Prepared:
        """Return plans, for registration."""
        memory, key = self.memory, self.keys[k]

        def make() -> Prepared:
            make_surface = partial(memory.get_surface, key, lambda: build_surface(memory.load(key).grid))
            return replace(prepare(memory.load(key)), load=lambda: memory.load(key), make_surface=make_surface)

        return memory.get_prepared(key, make)

    def answer(self, question: tuple[Hashable, ...], maps: Iterable[int], make: Callable[[], Made]) -> Made:
        """Return `Memory.answer` to a question about some of the maps."""
        return self.memory.answer((*question, *(self.keys[k] for k in maps)), make)

    def get_area(self, k: int) -> float:
        """Floor area, m2, of what is known from above."""

        def make() -> float:
            return float(sum(v.plan.explored.sum() * v.plan.edge**2 for v in self.get_prepared(k).storeys))

        return self.answer(("area",), (k,), make)

    def get_middle(self, k: int) -> Array:
        """Return (3,) of its cells, m."""
        return self.answer(("middle",), (k,), lambda: self.get_prepared(k).middle)

    def is_sliced(self, k: int) -> bool:
        """Return whether a storey is a slice, which has no planes."""
        return self.answer(("sliced",), (k,), lambda: any(v.plan.sliced for v in self.get_prepared(k).storeys))

    def has_landmarks(self, k: int) -> bool:
        """Return whether it holds landmarks that testify."""
        return self.answer(("landmarks",), (k,), lambda: self.get_prepared(k).has_landmarks)

    def get_rows(self, k: int) -> Rows:
        """Return descriptors of the rooms."""
        return self.memory.answer(("rows", self.embedder, self.keys[k]), lambda: embed_rooms(self._describe, self[k]))


class MapFiles(Mapping[int, TopometricMap]):
    """Maps by their numbers, read from their files whenever they are asked for."""

    def __init__(self, files: Mapping[int, Path]) -> None:
        self._files = dict(files)

    def __getitem__(self, n: int) -> TopometricMap:
        return load_corrected_map(self._files[n])

    def __iter__(self) -> Iterator[int]:
        return iter(self._files)

    def __len__(self) -> int:
        return len(self._files)


def bend_maps(
    maps: Maps, poses: Mapping[int, Sim3], pairs: Sequence[tuple[int, int]], scaled: bool
) -> tuple[dict[int, Sim3], dict[int, Deformation], str]:
    """Run `bend_together` on some maps, by their numbers."""
    names = sorted(poses)
    places = tuple((names.index(i), names.index(j)) for i, j in pairs)

    def make() -> tuple[dict[int, Sim3], dict[int, Deformation], str]:
        return bend_together({n: maps.get_prepared(k) for n, k in enumerate(names)}, dict(enumerate(lying)), places, scaled)

    lying = tuple(poses[k] for k in names)
    moved, deformations, reason = maps.answer(("bent", lying, places, scaled), names, make)
    return {names[n]: p for n, p in moved.items()}, {names[n]: d for n, d in deformations.items()}, reason
