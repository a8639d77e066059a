"""The maps of an atlas: plans of all stay in memory, the cells of those that are files only while they are needed."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from topomerge.embedding.embedders import DEFAULT
from topomerge.embedding.embedders import embedder as make_embedder
from topomerge.embedding.room_cells import Descriptor
from topomerge.embedding.turns import Rows
from topomerge.fusion.prepared import Prepared, prepare
from topomerge.fusion.refine import Surface, surface
from topomerge.io.maps import load_map
from topomerge.matching.match import checked
from topomerge.types import TopometricMap

LOADED_AT_ONCE = 3  # maps in memory, of those that are files
SURFACES_AT_ONCE = 8  # surfaces in memory, for the fine registration
T = TypeVar("T")


class Maps:
    """A sequence of maps with what is made of them once.

    Args:
        maps: topometric maps, or `.tmap` files.
        embedder: of rooms; None where only geometry shall propose poses.
    """

    def __init__(self, maps: Sequence[TopometricMap | str | Path], embedder: str | Descriptor | None = None) -> None:
        self._maps = list(maps)
        self.matched = embedder is not None
        self._describe = make_embedder(embedder or DEFAULT)
        self._loaded: OrderedDict[int, TopometricMap] = OrderedDict()
        self._surfaces: OrderedDict[int, Surface] = OrderedDict()
        self._rows: dict[int, Rows] = {}
        self._prepared: dict[int, Prepared] = {}

    def __len__(self) -> int:
        return len(self._maps)

    def __getitem__(self, k: int) -> TopometricMap:
        source = self._maps[k]
        if isinstance(source, TopometricMap):
            return source
        return _recent(self._loaded, k, LOADED_AT_ONCE, lambda: load_map(source))

    def prepared(self, k: int) -> Prepared:
        """Plans, for registration."""
        if k not in self._prepared:
            self._prepared[k] = replace(prepare(self[k]), load=lambda: self[k], make_surface=lambda: self.surface(k))
        return self._prepared[k]

    def surface(self, k: int) -> Surface:
        """Points and normals, for the fine registration."""
        return _recent(self._surfaces, k, SURFACES_AT_ONCE, lambda: surface(self[k].grid))

    def area(self, k: int) -> float:
        """Floor area, m2, of what is known from above."""
        return float(sum(v.plan.explored.sum() * v.plan.edge**2 for v in self.prepared(k).storeys))

    def rows(self, k: int) -> Rows:
        """Descriptors of the rooms."""
        if k not in self._rows:
            self._rows[k] = checked(self._describe, self[k])
        return self._rows[k]


def _recent(memory: OrderedDict[int, T], k: int, capacity: int, make: Callable[[], T]) -> T:
    """What was made of the kth map, from the memory of those that were used last."""
    if k not in memory:
        memory[k] = make()
        while len(memory) > capacity:
            memory.popitem(last=False)
    memory.move_to_end(k)
    return memory[k]


def map_key(map: TopometricMap) -> str:
    """16 hexadecimal digits of a hash of cells, rooms and free space."""
    digest = hashlib.sha256()
    for grid in (map.grid, map.navigable, map.free):
        if grid is not None:
            digest.update(np.ascontiguousarray(grid.cells).tobytes() + grid.origin.tobytes() + np.float64(grid.edge).tobytes())
    digest.update(map.room.tobytes() + map.navigable_room.tobytes() + map.rooms.tobytes())
    return digest.hexdigest()[:16]
