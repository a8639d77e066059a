"""An index of the rooms of a large atlas: neighbours without looking at all rooms (Malkov & Yashunin 2018, by `usearch`).

It needs the extra `index` and stands in `rooms_index.npz` of the atlas' folder; the file may be deleted, then it is made again.
Maps that are added to the atlas are added to the index; when half of its rooms are of maps that are gone, it is made anew.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from topomerge import archive
from topomerge.edits.apply import load_corrected_map
from topomerge.embedding.learned import DEFAULT, read_embedder_card
from topomerge.embedding.quarter_turns import Descriptor, Rows, TurnedRows, get_rows
from topomerge.errors import InputError
from topomerge.fusion.atlas.folder import Entry, StoredAtlas
from topomerge.fusion.atlas.partners import ROOM_NEIGHBOURS, compute_vectors, list_owners
from topomerge.matching.match import embed_rooms
from topomerge.types import Array

INDEX_HEAD, GRAPH_HEAD = (
    64,
    40,
)  # bytes: of the file, and of the graph: rooms, links, links at the lowest level, levels, first room
KINDS = b"i\x17\x0e\x0f"  # inner product, eight bits a number, keys of 64 bits, links of 32 bits
NODE = 10  # bytes of a room's key and level
HIGHEST_LEVEL = 64
LISTS_AT_ONCE = 1 << 14
ROOMS_FILE, ROOMS_KIND = "rooms.npz", "file of rooms"
ADVICE = "delete it, it is made again"
INDEX_FILE = "rooms_index.npz"
INDEX_FROM = 100_000  # rooms of an atlas, below which all are compared: that takes 1.5 ms a room and turn
LINKS = 16  # of a room to others
ADDING, SEARCHING = 64, 128  # rooms looked at on the way when one is added and when one is looked up


def check_graph(graph: bytes, count: int, size: int, links: int) -> None:
    """Check that a graph holds vectors (count, size), and that every link leads to one of them.

    Args:
        links: most of a room at each level; at the lowest twice as many.

    Raises:
        ValueError: it does not.
    """
    whole = np.frombuffer(graph, np.uint8)
    start = 8 + count * size
    if len(whole) < start + INDEX_HEAD + GRAPH_HEAD + 2 * count or tuple(_read_integers(whole, [0], 2)[0]) != (count, size):
        raise ValueError("cut off, or of other vectors")
    head = graph[start : start + INDEX_HEAD]
    if head[:7] != b"usearch" or head[13:17] != KINDS:
        raise ValueError("of another version; update topomerge or usearch")
    if tuple(np.frombuffer(head[17:41], np.uint64)) != (count, 0, size) or head[41]:
        raise ValueError("rooms are missing")
    start += INDEX_HEAD
    levels = np.frombuffer(graph[start + GRAPH_HEAD : start + GRAPH_HEAD + 2 * count], np.int16).astype(np.int64)
    rooms, upper, lowest, highest, first = (int(n) for n in np.frombuffer(graph[start : start + GRAPH_HEAD], np.uint64))
    if not count or (rooms, upper, lowest) != (count, links, 2 * links) or first >= count:
        raise ValueError("its head is wrong")
    if levels.min() < 0 or levels.max() > HIGHEST_LEVEL or levels[first] != highest or highest != levels.max():
        raise ValueError("its levels are wrong")
    sizes = NODE + 4 * (1 + lowest) + levels * 4 * (1 + upper)
    ends = start + GRAPH_HEAD + 2 * count + np.cumsum(sizes)
    if ends[-1] != len(whole):
        raise ValueError("cut off")
    nodes = ends - sizes
    keys = _read_integers(whole, nodes, 2)
    if (keys[:, 1] != 0).any() or len(np.unique(keys[:, 0])) < count or keys[:, 0].max() >= count:
        raise ValueError("keys are wrong")
    if not np.array_equal(_read_integers(whole, nodes + NODE - 4, 1)[:, 0] >> 16, levels):
        raise ValueError("its levels are wrong")
    _check_links(whole, nodes + NODE, lowest, np.ones(count, bool))
    for level in range(1, highest + 1):
        at = nodes[levels >= level] + NODE + 4 * (1 + lowest) + (level - 1) * 4 * (1 + upper)
        _check_links(whole, at, upper, levels >= level)


def _check_links(whole: Array, places: Array, most: int, present: Array) -> None:
    """Check the lists at these bytes, each the number of links and then so many rooms, which must be `present` at this level."""
    for k in range(0, len(places), LISTS_AT_ONCE):
        lists = _read_integers(whole, places[k : k + LISTS_AT_ONCE], 1 + most)
        to = lists[:, 1:][np.arange(most) < lists[:, :1]]
        if lists[:, 0].max() > most or to.max(initial=0) >= len(present) or not present[to].all():
            raise ValueError("links lead nowhere")


def _read_integers(whole: Array, places: Array | list[int], count: int) -> Array:
    """Return (n, count) whole numbers of 32 bits that begin at these bytes."""
    at = np.asarray(places)[:, None] + np.arange(4 * count)
    return np.ascontiguousarray(whole[at]).view("<u4").astype(np.int64)


class RoomRows:
    """Rows of all maps of an atlas. Those that the file of rooms lacks are reckoned and added to it.

    Args:
        stored: the atlas.
        describe: its embedder.
        signature: of the embedder.
        like: rows of another map by the same embedder.

    Raises:
        InputError: the file is damaged, or of another embedder or atlas.
    """

    def __init__(self, stored: StoredAtlas, describe: Descriptor, signature: str, like: Rows) -> None:
        self.path, self.entries, self._like = stored.folder / ROOMS_FILE, stored.entries, get_rows(like).shape[1:]
        self._arrays: Mapping[str, Array] | None = None  # None: they stay in the file
        written = archive.list_arrays(self.path, ROOMS_KIND) if self.path.exists() else []
        if written:
            embedder = archive.read(self.path, ROOMS_KIND, ["embedder"])
            check_made_for(self.path, embedder, signature, {e.key for e in stored.entries}, written)
        if {e.key for e in stored.entries} | {"embedder"} != {name.removesuffix(".places") for name in written}:
            self._arrays = self._complete_rows(stored, describe, written)
            with suppress(InputError):  # an atlas that may only be read is looked through all the same
                archive.write({"embedder": encode_signature(signature), **self._arrays}, self.path)

    def _complete_rows(self, stored: StoredAtlas, describe: Descriptor, written: Collection[str]) -> dict[str, Array]:
        """Collect the rows of all maps of the atlas: those that are written are read, missing ones are computed."""
        arrays = archive.read(self.path, ROOMS_KIND, _list_array_names(self.entries)) if written else {}
        completed: dict[str, Array] = {}
        for entry in self.entries:
            places = f"{entry.key}.places"
            if entry.key in arrays:
                completed |= {name: arrays[name] for name in (entry.key, places) if name in arrays}
            else:
                rows = embed_rooms(describe, load_corrected_map(stored.folder / entry.file, entry.edits))
                completed[entry.key] = get_rows(rows).astype(np.float32)
                completed |= {places: rows.places} if isinstance(rows, TurnedRows) else {}
        return completed

    def get_rows(self, maps: Sequence[int]) -> list[Rows]:
        """Return rows of some maps, by their numbers in the atlas.

        Raises:
            InputError: the file is damaged, or does not fit a map.
        """
        entries = [self.entries[k] for k in maps]
        arrays = self._read(entries)
        return [self._parse_rows(arrays, entry, float) for entry in entries]

    def compute_vectors(self, maps: Sequence[int]) -> Array:
        """Return (N, D) vectors (`partners.compute_vectors`) of all rooms of some maps, one map after the other.

        Raises:
            InputError: the file is damaged, or does not fit a map.
        """
        entries = [self.entries[k] for k in maps if self.entries[k].rooms]
        arrays = self._read(entries)
        each = [compute_vectors(self._parse_rows(arrays, entry, np.float32)) for entry in entries]
        return np.concatenate(each or [np.zeros((0, int(np.prod(self._like))), np.float32)])

    def _read(self, entries: Sequence[Entry]) -> Mapping[str, Array]:
        return archive.read(self.path, ROOMS_KIND, _list_array_names(entries)) if self._arrays is None else self._arrays

    def _parse_rows(self, arrays: Mapping[str, Array], entry: Entry, number: type) -> Rows:
        """Parse the rows that were written of a map."""
        of, places = arrays.get(entry.key, np.zeros(0)), arrays.get(f"{entry.key}.places")
        fits = of.ndim == (2 if places is None else 3) and len(of if places is None else places) == len(of) == entry.rooms
        fits &= not entry.rooms or of.shape[1:] == self._like
        if not fits or not np.isfinite(of).all() or not (places is None or np.isfinite(places).all()):
            raise InputError(f"{self.path}: does not fit the map {entry.name}; {ADVICE}")
        return of.astype(number) if places is None else TurnedRows(of.astype(number), places)


def _list_array_names(entries: Iterable[Entry]) -> set[str]:
    """List the names of the arrays of some maps."""
    return {name for e in entries for name in (e.key, f"{e.key}.places")}


def check_made_for(
    path: Path, arrays: Mapping[str, Array], signature: str, keys: Collection[str], written: Iterable[str]
) -> None:
    """Check that a file is of this embedder, and for some of the maps with these keys.

    Args:
        arrays: of the file, `embedder` among them.
        written: keys of the maps that it is for.

    Raises:
        InputError: it is not.
    """
    if not np.array_equal(arrays.get("embedder", np.zeros(0)), encode_signature(signature)):
        raise InputError(f"{path}: holds rows of another embedder; {ADVICE}")
    if not set(keys) & set(written):
        raise InputError(f"{path}: is of another atlas; {ADVICE}")


def encode_signature(signature: str) -> Array:
    """Return a signature as an array."""
    return np.frombuffer(signature.encode(), np.uint8)


def compute_embedder_signature(name: str) -> str:
    """Compute a signature that tells the rows of one embedder from those of another."""
    if name == DEFAULT or Path(name).is_dir():
        return read_embedder_card(None if name == DEFAULT else name).digest
    return hashlib.sha256(name.encode()).hexdigest()


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
        self._graph.add(np.arange(first, first + len(vectors), dtype=np.uint64), self._quantise(vectors), threads=1)
        self.keys, self.counts = [*self.keys, *keys], [*self.counts, *counts]

    def find_nearest(self, asked: Array, count: int = ROOM_NEIGHBOURS) -> tuple[Array, Array]:
        """Find the rows of `partners.find_nearest` by the index: most of them, and cosines to about .01."""
        hits = self._graph.search(
            self._quantise(np.concatenate([asked, asked[:1]])), count
        )  # one alone has another kind of answer
        reached = np.arange(hits.keys.shape[1]) < np.asarray(hits.counts)[:, None]
        product = 1 - np.where(reached, hits.distances, np.inf)
        rooms, cosine = np.where(reached, hits.keys, 0).astype(np.int64), product / self._unit**2
        return rooms[: len(asked)], cosine[: len(asked)]

    @property
    def _unit(self) -> float:
        """Return the value that stands for 1 in eight bits: numbers up to six times the usual one have room."""
        return float(127 / min(1.0, 6 / np.sqrt(self.size)))

    def _quantise(self, vectors: Array) -> Array:
        out: Array = np.clip(np.rint(vectors * self._unit), -127, 127).astype(np.int8)
        return out

    def write(self, path: Path, signature: str) -> None:
        """Write it; `read` reads it.

        Raises:
            InputError: the path can't be written.
        """
        graph = np.frombuffer(self._graph.save(), np.uint8)
        keys = np.array([key.encode() for key in self.keys])
        arrays = {"embedder": encode_signature(signature), "keys": keys, "counts": np.array(self.counts), "graph": graph}
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


def prepare_rooms_index(stored: StoredAtlas, rows: RoomRows, signature: str, size: int) -> RoomsIndex | None:
    """Return the index of an atlas, made or completed where it is not; None where exact search is better, or `usearch` is
    missing.

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
        index.add([stored.entries[k].key for k in new], [stored.entries[k].rooms for k in new], rows.compute_vectors(new))
        with suppress(InputError):  # an atlas that may only be read is looked through all the same
            index.write(path, signature)
    numbers = {e.key: k for k, e in enumerate(stored.entries)}
    index.owner = np.array([numbers.get(key, -1) for key in index.keys])[list_owners(index.counts)]
    return index
