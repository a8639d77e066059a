"""An index of the rooms of a large atlas: neighbours without looking at all rooms (Malkov & Yashunin 2018, by `usearch`).

It needs the extra `index` and stands in `rooms_index.npz` of the atlas' folder; the file may be deleted, then it is made again.
Maps that are added to the atlas are added to the index; when half of its rooms are of maps that are gone, it is made anew.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.errors import InputError
from topomerge.fusion.atlas.index_check import check_graph
from topomerge.fusion.atlas.neighbours import ROOM_NEIGHBOURS, owners
from topomerge.fusion.atlas.room_rows import ADVICE, RoomRows, check_made_for, signed
from topomerge.fusion.atlas.stored import Stored
from topomerge.io import archive
from topomerge.types import Array

INDEX_FILE = "rooms_index.npz"
INDEX_FROM = 100_000  # rooms of an atlas, below which all are compared: that takes 1.5 ms a room and turn
LINKS = 16  # of a room to others
ADDING, SEARCHING = 64, 128  # rooms looked at on the way when one is added and when one is looked up


@dataclass(eq=False)
class RoomsIndex:
    """Vectors of rooms, eight bits a number, in a graph of neighbours.

    Args:
        size: numbers of a vector.
        keys: of the maps whose rooms are in it, in their order.
        counts: rooms of each.
        owner: (N,) number of each room's map in the atlas, -1 of a map that is gone.

    Raises:
        InputError: `usearch` is missing.
    """

    size: int
    keys: list[str] = field(default_factory=list)
    counts: list[int] = field(default_factory=list)
    owner: Array = field(default_factory=lambda: np.zeros(0, np.int64))

    def __post_init__(self) -> None:
        try:
            from usearch.index import Index
        except ImportError as error:
            raise InputError("an index of rooms needs usearch: pip install 'topomerge[index]'") from error
        self._graph: Any = Index(
            ndim=self.size, metric="ip", dtype="i8", connectivity=LINKS, expansion_add=ADDING, expansion_search=SEARCHING
        )

    @property
    def memory(self) -> int:
        """Bytes that the graph takes."""
        return int(self._graph.memory_usage)

    def add(self, keys: Sequence[str], counts: Sequence[int], vectors: Array) -> None:
        """Add the rooms (N, D) of some maps. The same ones in the same order give the same bytes."""
        first = sum(self.counts)
        self._graph.add(np.arange(first, first + len(vectors), dtype=np.uint64), self._bytes(vectors), threads=1)
        self.keys, self.counts = [*self.keys, *keys], [*self.counts, *counts]

    def nearest(self, asked: Array, count: int = ROOM_NEIGHBOURS) -> tuple[Array, Array]:
        """`neighbours.nearest` by the index: most of them, and cosines to about .01."""
        hits = self._graph.search(self._bytes(np.concatenate([asked, asked[:1]])), count)  # one alone has another kind of answer
        reached = np.arange(hits.keys.shape[1]) < np.asarray(hits.counts)[:, None]
        product = 1 - np.where(reached, hits.distances, np.inf)
        rooms, cosine = np.where(reached, hits.keys, 0).astype(np.int64), product / self._unit**2
        return rooms[: len(asked)], cosine[: len(asked)]

    @property
    def _unit(self) -> float:
        """What a number of 1 is in eight bits: numbers up to six times the usual one have room."""
        return float(127 / min(1.0, 6 / np.sqrt(self.size)))

    def _bytes(self, vectors: Array) -> Array:
        out: Array = np.clip(np.rint(vectors * self._unit), -127, 127).astype(np.int8)
        return out

    def write(self, path: Path, signature: str) -> None:
        """Write it; `read` reads it.

        Raises:
            InputError: the path can't be written.
        """
        graph = np.frombuffer(self._graph.save(), np.uint8)
        keys = np.array([key.encode() for key in self.keys])
        arrays = {"embedder": signed(signature), "keys": keys, "counts": np.array(self.counts), "graph": graph}
        archive.write(arrays, path, effort=0)

    @classmethod
    def read(cls, path: Path, size: int, signature: str, rooms: dict[str, int]) -> RoomsIndex:
        """Read one.

        Args:
            size: numbers of a vector.
            signature: of the embedder.
            rooms: of the maps of the atlas, by their keys.

        Raises:
            InputError: it is damaged, of another embedder, or for another atlas.
        """
        arrays = archive.read(path, "index of rooms")
        try:
            keys = [bytes(key).decode() for key in arrays.get("keys", np.zeros(0))]
            check_made_for(path, arrays, signature, set(rooms), keys)
            counts = [int(count) for count in arrays["counts"]]
            if len(set(keys)) < len(keys) or any(rooms.get(k, n) != n or n < 1 for k, n in zip(keys, counts, strict=True)):
                raise ValueError("rooms of a map are missing")
            graph = arrays["graph"].tobytes()
            check_graph(graph, sum(counts), size, LINKS)
            index = cls(size, keys, counts)
            index._graph.load(graph)
        except InputError:
            raise
        except Exception as error:  # whatever the library says of what it can't read
            reason = " ".join(str(error).split())[:120] or type(error).__name__
            raise InputError(f"{path}: damaged ({reason}); {ADVICE}") from error
        return index


def rooms_index(stored: Stored, rows: RoomRows, signature: str, size: int) -> RoomsIndex | None:
    """The index of an atlas, made or completed where it is not; None where exact search is better, or `usearch` is missing.

    Args:
        rows: of its maps.
        signature: of the embedder.
        size: numbers of a vector.

    Raises:
        InputError: its file is damaged, of another embedder, or for another atlas.
    """
    rooms = {e.key: e.rooms for e in stored.entries if e.rooms}
    path = stored.folder / INDEX_FILE
    if sum(rooms.values()) < INDEX_FROM or find_spec("usearch") is None:
        return None
    if not path.exists() and not os.access(stored.folder, os.W_OK):
        return None  # to make one takes longer than to look for one map without
    index = RoomsIndex.read(path, size, signature, rooms) if path.exists() else RoomsIndex(size)
    gone = sum(n for key, n in zip(index.keys, index.counts, strict=True) if key not in rooms)
    if 2 * gone > sum(index.counts):
        index = RoomsIndex(size)
    indexed = set(index.keys)
    new = [k for k, e in enumerate(stored.entries) if e.rooms and e.key not in indexed]
    if new:
        index.add([stored.entries[k].key for k in new], [stored.entries[k].rooms for k in new], rows.vectors(new))
        with suppress(InputError):  # an atlas that may only be read is looked through all the same
            index.write(path, signature)
    numbers = {e.key: k for k, e in enumerate(stored.entries)}
    index.owner = np.array([numbers.get(key, -1) for key in index.keys])[owners(index.counts)]
    return index
