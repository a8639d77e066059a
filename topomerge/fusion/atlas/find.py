"""Which maps and rooms of an atlas does a new map show? The rows of all rooms are compared; nothing is registered.

Each room of the new map has one vote. It goes to the rooms of the atlas that look most like it, shared by how alike they are; a
map is turned by the one quarter turn at which all of it is most alike. A map's share is that of the votes that its rooms
got: it says where to look first, not whether the place is there at all. That is what `merge` is for.

Rows are kept in `rooms.npz` of the atlas' folder, by the keys of the maps; the file may be deleted.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from topomerge.embedding.embedders import DEFAULT
from topomerge.embedding.embedders import embedder as make_embedder
from topomerge.embedding.room_cells import Descriptor
from topomerge.embedding.turns import Rows, TurnedRows, aligned, numbers
from topomerge.errors import InputError
from topomerge.fusion.atlas.store import Stored, read_atlas
from topomerge.io import archive
from topomerge.io.maps import load_map
from topomerge.matching.match import checked
from topomerge.types import Array, TopometricMap

ROOMS_FILE = "rooms.npz"
SHARPNESS = 25.0  # that a cosine is multiplied with: a room that is more alike by .1 gets twelve times the vote


@dataclass(frozen=True)
class Sighting:
    """A map of an atlas that a new one may show.

    Args:
        name: of the map in the atlas.
        share: of the votes of the new map's rooms; over all maps of the atlas they sum to 1.
        rooms: (room of the new map, room of this one, cosine of their rows), most alike first: rooms that are each other's most
            alike one in the other map.
    """

    name: str
    share: float
    rooms: tuple[tuple[int, int, float], ...]


def find(folder: str | Path, map: TopometricMap, number: int = 5) -> tuple[Sighting, ...]:
    """The maps of an atlas that a new one most likely shows, best first.

    Args:
        number: of maps, at most.

    Raises:
        InputError: no atlas, one without maps or whose `rooms.npz` is damaged or of another embedder, a map without rooms, or a
            number below 1.
    """
    if number < 1:
        raise InputError(f"the number of maps to name must be 1 or more, not {number}")
    stored = read_atlas(folder)
    if not stored.entries:
        raise InputError(f"{folder}: holds no maps yet; add some with `topomerge atlas add {folder} MAP ...`")
    if not len(map.rooms):
        raise InputError(f"{map.source or 'the map'}: no rooms in it, nothing can be looked for")
    embedder = str(stored.settings.get("embedder") or DEFAULT)
    describe = make_embedder(embedder)
    rows = _rows(stored, describe, _signature(embedder))
    return ranked([e.name for e in stored.entries], rows, checked(describe, map), number)


def ranked(names: Sequence[str], rows: Sequence[Rows], new: Rows, number: int) -> tuple[Sighting, ...]:
    """`find` with rows of length 1 of each map and of the new one."""
    alike = [_cosines(new, of) for of in rows]
    weight = [np.exp(SHARPNESS * (cosine - 1)) for cosine in alike]
    total = np.maximum(np.sum([w.sum(axis=1) for w in weight], axis=0), 1e-300)
    sightings = []
    for name, w, cosine in zip(names, weight, alike, strict=True):
        sightings.append(Sighting(name, float((w / total[:, None]).sum() / len(new)), _mutual(cosine)))
    return tuple(sorted(sightings, key=lambda s: -s.share)[:number])


def _mutual(cosine: Array) -> tuple[tuple[int, int, float], ...]:
    """Rooms (R_new, R) that are each other's most alike one, and how alike; most alike first."""
    if not cosine.size:
        return ()
    best, back = cosine.argmax(axis=1), cosine.argmax(axis=0)
    pairs = [(i, j, float(cosine[i, j])) for i, j in enumerate(best.tolist()) if back[j] == i]
    return tuple(sorted(pairs, key=lambda pair: -pair[2]))


def _cosines(new: Rows, rows: Rows) -> Array:
    """(R_new, R) how alike rooms are."""
    a, b = (side / np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-12) for side in aligned(new, rows))
    out: Array = a @ b.T
    return out


def _rows(stored: Stored, describe: Descriptor, embedder: str) -> list[Rows]:
    """Rows of all maps of an atlas, from its file of rooms; what is missing there is reckoned and added.

    Raises:
        InputError: the file is damaged, or of another embedder or atlas.
    """
    path = stored.folder / ROOMS_FILE
    advice = "delete it, it is made again"
    written = archive.read(path, "file of rooms") if path.exists() else {}
    signature = np.frombuffer(embedder.encode(), np.uint8)
    if written and not np.array_equal(written.pop("embedder", np.zeros(0)), signature):
        raise InputError(f"{path}: holds rows of another embedder; {advice}")
    if written and not any(e.key in written for e in stored.entries):
        raise InputError(f"{path}: is of another atlas; {advice}")
    rows: dict[str, Array] = {}
    for entry in stored.entries:
        places = f"{entry.key}.places"
        if entry.key in written:
            rows |= {n: written[n] for n in (entry.key, places) if n in written}
        else:
            made = checked(describe, load_map(stored.folder / entry.file))
            rows[entry.key] = numbers(made).astype(np.float32)
            rows |= {places: made.places} if isinstance(made, TurnedRows) else {}
        fits = rows[entry.key].ndim == (3 if places in rows else 2) and len(rows.get(places, rows[entry.key])) == entry.rooms
        if not fits or len(rows[entry.key]) != entry.rooms or not all(np.isfinite(of).all() for of in rows.values()):
            raise InputError(f"{path}: does not fit the map {entry.name}; {advice}")
    if set(rows) != set(written):
        with suppress(InputError):  # an atlas that may only be read is looked through all the same
            archive.write({"embedder": signature, **rows}, path)
    return [_read(rows, e.key) for e in stored.entries]


def _read(rows: Mapping[str, Array], key: str) -> Rows:
    """What was written of a map."""
    of, places = rows[key].astype(np.float64), rows.get(f"{key}.places")
    return of if places is None else TurnedRows(of, places)


def _signature(name: str) -> str:
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
