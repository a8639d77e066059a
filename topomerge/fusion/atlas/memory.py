"""What was made of the maps of an atlas, kept from one solve to the next in a process that adds maps again and again.

Nothing of it changes what comes out: each answer is that of a question that was asked before, to the last bit.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping, MutableMapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from topomerge.fusion.inputs import Extent
from topomerge.io.maps import load_map
from topomerge.types import TopometricMap

LOADED_AT_ONCE = 3  # maps in memory, of those that are files
PREPARED_AT_ONCE = 64  # maps whose plans are in memory
SURFACES_AT_ONCE = 8  # surfaces in memory, for the fine registration
Made = TypeVar("Made")


@dataclass(frozen=True)
class Facts:
    """What is asked of a map before it is put together with others.

    Args:
        key: `map_key`.
        rooms: their number.
    """

    key: str
    rooms: int
    extent: Extent


class Memory:
    """Maps by their keys, and answers to questions about them.

    Args:
        coarse: by the keys of two maps, ascending, how likely they lie on each other (`coarse.coarse_log_odds`).
    """

    def __init__(self, coarse: MutableMapping[tuple[str, str], float] | None = None) -> None:
        self.coarse = {} if coarse is None else coarse
        self._facts: dict[Path, tuple[tuple[int, int, int], Facts]] = {}  # of files, with what tells whether they changed
        self._sources: dict[str, TopometricMap | str | Path] = {}
        self._loaded: OrderedDict[str, TopometricMap] = OrderedDict()
        self._prepared: OrderedDict[str, Any] = OrderedDict()
        self._surfaces: OrderedDict[str, Any] = OrderedDict()
        self._answers: dict[tuple[Hashable, ...], Any] = {}  # that were asked for since the maps were named
        self._before: dict[tuple[Hashable, ...], Any] = {}  # … between that and the time before

    def keep(self, sources: Mapping[str, TopometricMap | str | Path]) -> None:
        """These maps are asked about from now on; answers that were not asked for since the last time are dropped.

        Args:
            sources: key -> map or `.tmap` file.
        """
        self._sources = dict(sources)
        self._before, self._answers = self._answers, {}

    def facts(self, source: TopometricMap | str | Path) -> Facts:
        """What is asked of a map first; of a file that has not changed it is remembered.

        Raises:
            InputError: the file can't be read.
        """
        if isinstance(source, TopometricMap):
            return _facts(source)
        path = Path(source)
        try:
            stat = path.stat()
        except OSError:
            return _facts(load_map(path))  # says what is wrong with it
        stamp = (stat.st_ino, stat.st_size, stat.st_mtime_ns)
        if path not in self._facts or self._facts[path][0] != stamp:
            self._facts[path] = (stamp, _facts(load_map(path)))
        return self._facts[path][1]

    def map(self, key: str) -> TopometricMap:
        """A map; files are loaded when they are needed."""
        source = self._sources[key]
        if isinstance(source, TopometricMap):
            return source
        return _recent(self._loaded, key, LOADED_AT_ONCE, lambda: load_map(source))

    def file(self, key: str) -> Path | None:
        """Where a map is loaded from; None of one that is given as it is."""
        source = self._sources[key]
        return None if isinstance(source, TopometricMap) else Path(source)

    def prepared(self, key: str, make: Callable[[], Made]) -> Made:
        """The plans of a map, one of the last that were asked for or made now."""
        out: Made = _recent(self._prepared, key, PREPARED_AT_ONCE, make)
        return out

    def surface(self, key: str, make: Callable[[], Made]) -> Made:
        """The surface of a map, one of the last that were asked for or made now."""
        out: Made = _recent(self._surfaces, key, SURFACES_AT_ONCE, make)
        return out

    def answer(self, question: tuple[Hashable, ...], make: Callable[[], Made]) -> Made:
        """What was answered before to a question, or is answered now.

        Args:
            question: all that the answer depends on; of maps their keys.
        """
        if question not in self._answers:
            self._answers[question] = self._before.pop(question) if question in self._before else make()
        out: Made = self._answers[question]
        return out


def _facts(map: TopometricMap) -> Facts:
    return Facts(map_key(map), len(map.rooms), Extent.of(map))


def map_key(map: TopometricMap) -> str:
    """16 hexadecimal digits of a hash of cells, rooms and free space."""
    digest = hashlib.sha256()
    for grid in (map.grid, map.navigable, map.free):
        if grid is not None:
            digest.update(np.ascontiguousarray(grid.cells).tobytes() + grid.origin.tobytes() + np.float64(grid.edge).tobytes())
    digest.update(map.room.tobytes() + map.navigable_room.tobytes() + map.rooms.tobytes())
    return digest.hexdigest()[:16]


def _recent(memory: OrderedDict[str, Made], key: str, capacity: int, make: Callable[[], Made]) -> Made:
    """What was made of a map, from the memory of those that were used last."""
    if key not in memory:
        memory[key] = make()
        while len(memory) > capacity:
            memory.popitem(last=False)
    memory.move_to_end(key)
    return memory[key]
