"""Rows of the rooms of an atlas' maps: reckoned once, then in `rooms.npz` of its folder, by the keys of the maps.

The file may be deleted; it is made again.
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from topomerge.embedding.embedders import DEFAULT
from topomerge.embedding.room_cells import Descriptor
from topomerge.embedding.turns import Rows, TurnedRows, numbers
from topomerge.errors import InputError
from topomerge.fusion.atlas.neighbours import vectors
from topomerge.fusion.atlas.stored import Entry, Stored
from topomerge.io import archive
from topomerge.io.maps import load_map
from topomerge.matching.match import checked
from topomerge.types import Array

ROOMS_FILE, ROOMS_KIND = "rooms.npz", "file of rooms"
ADVICE = "delete it, it is made again"


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

    def __init__(self, stored: Stored, describe: Descriptor, signature: str, like: Rows) -> None:
        self.path, self.entries, self._like = stored.folder / ROOMS_FILE, stored.entries, numbers(like).shape[1:]
        self._arrays: Mapping[str, Array] | None = None  # None: they stay in the file
        written = archive.names(self.path, ROOMS_KIND) if self.path.exists() else []
        if written:
            embedder = archive.read(self.path, ROOMS_KIND, ["embedder"])
            check_made_for(self.path, embedder, signature, {e.key for e in stored.entries}, written)
        if {e.key for e in stored.entries} | {"embedder"} != {name.removesuffix(".places") for name in written}:
            self._arrays = self._completed(stored, describe, written)
            with suppress(InputError):  # an atlas that may only be read is looked through all the same
                archive.write({"embedder": signed(signature), **self._arrays}, self.path)

    def _completed(self, stored: Stored, describe: Descriptor, written: Collection[str]) -> dict[str, Array]:
        """What is written of the maps of the atlas, and what is missing."""
        arrays = archive.read(self.path, ROOMS_KIND, _of_maps(self.entries)) if written else {}
        made: dict[str, Array] = {}
        for entry in self.entries:
            places = f"{entry.key}.places"
            if entry.key in arrays:
                made |= {name: arrays[name] for name in (entry.key, places) if name in arrays}
            else:
                rows = checked(describe, load_map(stored.folder / entry.file))
                made[entry.key] = numbers(rows).astype(np.float32)
                made |= {places: rows.places} if isinstance(rows, TurnedRows) else {}
        return made

    def of(self, maps: Sequence[int]) -> list[Rows]:
        """Rows of some maps, by their numbers in the atlas.

        Raises:
            InputError: the file is damaged, or does not fit a map.
        """
        entries = [self.entries[k] for k in maps]
        arrays = self._read(entries)
        return [self._rows(arrays, entry, float) for entry in entries]

    def vectors(self, maps: Sequence[int]) -> Array:
        """(N, D) `neighbours.vectors` of all rooms of some maps, one map after the other.

        Raises:
            InputError: the file is damaged, or does not fit a map.
        """
        entries = [self.entries[k] for k in maps if self.entries[k].rooms]
        arrays = self._read(entries)
        each = [vectors(self._rows(arrays, entry, np.float32)) for entry in entries]
        return np.concatenate(each or [np.zeros((0, int(np.prod(self._like))), np.float32)])

    def _read(self, entries: Sequence[Entry]) -> Mapping[str, Array]:
        return archive.read(self.path, ROOMS_KIND, _of_maps(entries)) if self._arrays is None else self._arrays

    def _rows(self, arrays: Mapping[str, Array], entry: Entry, number: type) -> Rows:
        """What was written of a map."""
        of, places = arrays.get(entry.key, np.zeros(0)), arrays.get(f"{entry.key}.places")
        fits = of.ndim == (2 if places is None else 3) and len(of if places is None else places) == len(of) == entry.rooms
        fits &= not entry.rooms or of.shape[1:] == self._like
        if not fits or not np.isfinite(of).all() or not (places is None or np.isfinite(places).all()):
            raise InputError(f"{self.path}: does not fit the map {entry.name}; {ADVICE}")
        return of.astype(number) if places is None else TurnedRows(of.astype(number), places)


def _of_maps(entries: Iterable[Entry]) -> set[str]:
    """Names of the arrays of some maps."""
    return {name for e in entries for name in (e.key, f"{e.key}.places")}


def check_made_for(
    path: Path, arrays: Mapping[str, Array], signature: str, keys: Collection[str], written: Iterable[str]
) -> None:
    """Is a file of this embedder, and for some of the maps with these keys?

    Args:
        arrays: of the file, `embedder` among them.
        written: keys of the maps that it is for.

    Raises:
        InputError: it is not.
    """
    if not np.array_equal(arrays.get("embedder", np.zeros(0)), signed(signature)):
        raise InputError(f"{path}: holds rows of another embedder; {ADVICE}")
    if not set(keys) & set(written):
        raise InputError(f"{path}: is of another atlas; {ADVICE}")


def signed(signature: str) -> Array:
    """A signature as an array."""
    return np.frombuffer(signature.encode(), np.uint8)


def embedder_signature(name: str) -> str:
    """What tells rows of one embedder from those of another."""
    from topomerge.embedding.weights import SETTINGS_FILE, embedder_folder

    if name == DEFAULT:
        from importlib import resources

        settings = resources.files("topomerge.embedding").joinpath("pretrained", SETTINGS_FILE).read_bytes()
    elif Path(name).is_dir():
        settings = (embedder_folder(name) / SETTINGS_FILE).read_bytes()
    else:
        settings = name.encode()
    return hashlib.sha256(settings).hexdigest()
