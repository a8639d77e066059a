"""A folder that changes as a whole: whatever moment a change is killed at, the folder is as before or as after.

A change is written into `.new`, which becomes `.next` by one renaming: that is the moment at which it counts. Then its files are
moved to their places; who finds a `.next` finishes the moving first. Changes of several processes come one after the other: the
lock is the system's, which frees that of a killed process; where a file system has none, it is a file that names its owner.
"""

from __future__ import annotations

import json
import logging
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout

from topomerge.edits.journal import find_journal
from topomerge.errors import InputError
from topomerge.fusion.atlas.solve import AtlasSettings
from topomerge.types import EDITED, Array, Sim3, convert_pose_to_maps, read_levelling

NEW, NEXT, LOCK, GONE = ".new", ".next", ".lock", "gone.json"
BUSY = "is being changed by another process; wait for it"
LOCK_POLL = 0.1  # s between two looks at a lock that another process holds
log = logging.getLogger(__name__)
ATLAS_FORMAT = 1


@contextmanager
def change_folder(folder: Path, gone: list[str], patience: float | None = None) -> Iterator[Path]:
    """Yield an empty folder for files that replace those of the same names if all goes well; on any error nothing changes.

    No other process changes the folder meanwhile: what is read of it within stays so.

    Args:
        folder: created if it is not there.
        gone: names of files that shall be deleted; read at the end.
        patience: s to wait at most for the changes of other processes to end; None: as long as they take.

    Raises:
        InputError: the folder can't be written, or another change takes too long.
    """
    created = not folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with lock_folder(folder, patience):
            try:
                _finish(folder)
                shutil.rmtree(folder / NEW, ignore_errors=True)
                (folder / NEW).mkdir()
                yield folder / NEW
                (folder / NEW / GONE).write_text(json.dumps(gone), encoding="utf-8")
                (folder / NEW).replace(folder / NEXT)
            except BaseException:
                shutil.rmtree(folder / NEW, ignore_errors=True)
                _restore_folder(folder, created)
                raise
            _finish(folder)
    except OSError as error:
        _restore_folder(folder, created)
        reason = error.strerror or error
        raise InputError(f"{folder}: can't be written ({reason}); make room there, or give another folder") from error


def _restore_folder(folder: Path, created: bool) -> None:
    """Take away the lock of a folder that did not become an atlas, and the folder if it is new."""
    with suppress(OSError):  # what stays is in nobody's way
        if {p.name for p in folder.iterdir()} <= {LOCK}:
            (folder / LOCK).unlink(missing_ok=True)
            if created:
                folder.rmdir()


def finish_change(folder: Path) -> None:
    """Finish a change that was interrupted after it began to count, if there is one.

    Raises:
        InputError: it can't be finished.
    """
    if (folder / NEXT).is_dir():
        try:
            with lock_folder(folder, None):
                _finish(folder)
        except OSError as error:
            raise InputError(f"{folder}: can't be locked ({error.strerror or error}); is it writable?") from error


def _resolve_inside(folder: Path, name: str) -> Path:
    """Return a file of the atlas; an atlas of a stranger must not reach for files elsewhere, by its names or by links."""
    path = folder / name
    if not path.parent.resolve().is_relative_to(folder.resolve()):
        raise ValueError(f"{name[:100]!r} lies elsewhere")
    return path


def _finish(folder: Path) -> None:
    """Move the files of a change that counts to their places, and delete those that it has no more."""
    source = folder / NEXT
    if not source.is_dir():
        return
    try:
        listed = source / GONE
        gone: Sequence[str] = json.loads(listed.read_text(encoding="utf-8")) if listed.exists() else []
        for path in sorted(p for p in source.rglob("*") if p.is_file() and p != listed):
            target = _resolve_inside(folder, str(path.relative_to(source)))
            target.parent.mkdir(parents=True, exist_ok=True)
            path.replace(target)
        for name in gone:
            _resolve_inside(folder, name).unlink(missing_ok=True)
        shutil.rmtree(source)
    except (OSError, ValueError, TypeError, RecursionError) as error:
        raise InputError(f"{folder}: a change that was interrupted can't be finished ({error}); is it writable?") from error


@contextmanager
def hold_folder(folder: Path, refusal: str) -> Iterator[None]:
    """Keep a folder for this process while it writes into it now and then; nothing is left of a folder that stays empty.

    Args:
        refusal: what to do where another process keeps it, in words.

    Raises:
        InputError: another process keeps it, or it can't be written.
    """
    created = not folder.exists()
    with ExitStack() as held:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            held.enter_context(lock_folder(folder, 0, refusal))
        except OSError as error:
            raise InputError(f"{folder}: can't be written ({error.strerror or error}); give another folder") from error
        held.callback(_restore_folder, folder, created)
        yield


@contextmanager
def lock_folder(folder: Path, patience: float | None, refusal: str = BUSY) -> Iterator[None]:
    """Lock a folder: one process at a time, the others wait. The lock of a process that is killed goes with it.

    Raises:
        InputError: it takes longer than `patience`, s, which is told by `refusal`.
    """
    lock, waits = FileLock(folder / LOCK, poll_interval=LOCK_POLL), False
    while not lock.is_locked:
        try:
            lock.acquire(timeout=0 if not waits else -1 if patience is None else patience)
        except FileNotFoundError:  # who made the folder gave up, and took it away
            folder.mkdir(parents=True, exist_ok=True)
        except Timeout:
            if waits or patience == 0:
                raise InputError(f"{folder}: {refusal}") from None
            log.warning("%s: is being changed by another process; waiting for it", folder)
            waits = True
    try:
        yield
    finally:
        lock.release()


def link_or_copy(source: Path, target: Path) -> None:
    """Give a file another name, by a link or as a copy."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)


@dataclass(frozen=True)
class Entry:
    """A map of the atlas.

    Args:
        key: hash of its content (`hash_map`).
        source: the file that it came from.
        frame: its pose in the frame of the map that it replaced, for good.
        levelling: (4, 4) that takes points of its file into its frame (`read_levelling`).
        edits: lines of its journal that the key and the rooms are of.
    """

    name: str
    key: str
    source: str
    rooms: int
    storeys: int
    frame: Sim3 = field(default_factory=Sim3)
    levelling: Array = field(default_factory=lambda: np.eye(4), compare=False)
    edits: int = 0

    @property
    def file(self) -> str:
        """Where its copy is, in the atlas."""
        return f"maps/{self.name}.tmap"


@dataclass(frozen=True, eq=False)
class StoredAtlas:
    """The content of atlas.json.

    Args:
        listing: all of it; None of an atlas that is not there yet.
    """

    folder: Path
    entries: tuple[Entry, ...] = ()
    settings: Mapping[str, Any] = field(default_factory=lambda: asdict(AtlasSettings()))
    listing: Mapping[str, Any] | None = None

    def list_files(self) -> list[str]:
        """Return all that belongs to the atlas but atlas.json."""
        kinds, components = ("map", "ply", "page", "tiles"), (self.listing or {}).get("components", [])
        journals = [find_journal(e.file).as_posix() for e in self.entries if e.edits]
        stored = [name for component in components for name in files_of(component, kinds)]
        return [e.file for e in self.entries] + journals + stored

    def find_name(self, key: str) -> str | None:
        """Return the name of the map with this content, None if there is none."""
        return next((e.name for e in self.entries if e.key == key), None)

    @property
    def complete(self) -> bool:
        """Was everything registered that could change where maps lie?"""
        registered = (self.listing or {}).get("registered")
        return not isinstance(registered, dict) or registered.get("complete", True) is not False

    def list_linked_pairs(self) -> list[tuple[int, int]]:
        """Return pairs of maps, by their numbers, that hold the components together.

        Raises:
            InputError: atlas.json is damaged.
        """
        try:
            pairs = [(int(i), int(j)) for i, j in (link["maps"] for link in (self.listing or {}).get("links", []))]
            if any(not 0 <= k < len(self.entries) for pair in pairs for k in pair):
                raise IndexError(pairs)
        except (ValueError, KeyError, TypeError, AttributeError, IndexError) as error:
            raise self._build_error() from error
        return pairs

    def compute_relative_poses(self) -> dict[tuple[str, str], Sim3]:
        """Return the T_ij of the pairs that hold the components together, as they lie now, by the keys of both maps.

        Raises:
            InputError: atlas.json is damaged.
        """
        poses = self.get_poses()
        pairs = ((self.entries[i], self.entries[j]) for i, j in self.list_linked_pairs())
        is_occupied = ((a, b) for a, b in pairs if a.name in poses and b.name in poses)
        return {(a.key, b.key): poses[a.name][1].inverse() @ poses[b.name][1] for a, b in is_occupied}

    def _build_error(self) -> InputError:
        return InputError(f"{self.folder / 'atlas.json'}: damaged; make the atlas again from its maps")

    def get_poses(self) -> dict[str, tuple[int, Sim3]]:
        """Map the name of each map to its component and its pose there.

        Raises:
            InputError: atlas.json is damaged.
        """
        listing = self.listing or {}
        try:
            matrices = {int(k): np.array(t["matrix"], np.float64) for k, t in listing.get("transforms", {}).items()}
            out = {}
            for n, component in enumerate(listing.get("components", [])):
                into = self.entries[component["maps"][0]].levelling
                for k in component["maps"]:
                    entry = self.entries[k]
                    lying = convert_pose_to_maps(matrices[k], entry.levelling, into) if k in matrices else None
                    out[entry.name] = (n, Sim3() if lying is None else Sim3.from_matrix(lying))
        except (ValueError, KeyError, TypeError, AttributeError, IndexError) as error:
            raise self._build_error() from error
        return out


def read_atlas(folder: str | Path) -> StoredAtlas:
    """Read an atlas; a change that was interrupted is finished first.

    Raises:
        InputError: no such folder, no atlas, or damaged.
    """
    folder = Path(folder)
    if folder.is_file():
        raise InputError(f"{folder}: is a file; give the folder of an atlas, and before other files")
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; make an atlas with `topomerge atlas add {folder} MAP ...`")
    finish_change(folder)
    return read_finished(folder)


def read_finished(folder: Path) -> StoredAtlas:
    """Read, as `read_atlas`, a folder in which no change was interrupted.

    Raises:
        InputError: no atlas, or damaged.
    """
    path = folder / "atlas.json"
    if not path.exists():
        raise InputError(f"{folder}: is no atlas (atlas.json is missing); `topomerge atlas add` makes one in a new folder")
    try:
        listing = json.loads(path.read_text(encoding="utf-8"))
        if listing["format"] != ATLAS_FORMAT:
            written = f"is of format {listing['format']!r}, this topomerge reads format {ATLAS_FORMAT}"
            raise InputError(f"{path}: {written}; update topomerge")
        entries = tuple(map(_entry, listing["maps"]))
        settings = {name: listing["settings"].get(name, usual) for name, usual in asdict(AtlasSettings()).items()}
        if any(Path(e.file).parent != Path("maps") or not isinstance(e.key, str) for e in entries):
            raise ValueError("a map lies elsewhere")
        stored = StoredAtlas(folder, entries, settings, listing)
        if any(Path(name).is_absolute() or ".." in Path(name).parts for name in stored.list_files()):
            raise ValueError("a file lies elsewhere")
    except InputError:
        raise
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:120]
        raise InputError(f"{path}: damaged ({reason}); make the atlas again from the maps in {folder / 'maps'}") from error
    return stored


def _entry(listed: Mapping[str, Any]) -> Entry:
    frame = Sim3.from_matrix(np.array(listed["frame"], np.float64)) if "frame" in listed else Sim3()
    counts = int(listed["rooms"]), int(listed["storeys"])
    levelling, edits = read_levelling(listed), int(listed.get(EDITED, 0))
    return Entry(listed["name"], listed["key"], listed["source"], *counts, frame, levelling, edits)


def files_of(component: Mapping[str, Any], kinds: Sequence[str]) -> list[str]:
    """Return the files of some kinds that a component of the listing names."""
    named = [component[kind] for kind in kinds if kind in component]
    return [name for one in named for name in ([one] if isinstance(one, str) else one)]


def read_folder(folder: str | Path) -> StoredAtlas:
    """Read the atlas in a folder; a new one is empty.

    Raises:
        InputError: a file, or a folder with other things in it.
    """
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is a file; give the name of a folder")
    if folder.is_dir():
        finish_change(folder)
    return read_finished_folder(folder)


def read_finished_folder(folder: Path) -> StoredAtlas:
    """Read the atlas in a folder in which no change was interrupted; a new one is empty.

    Raises:
        InputError: a folder with other things in it.
    """
    is_occupied = folder.is_dir() and any(not p.name.startswith(".") for p in folder.iterdir())
    return read_finished(folder) if is_occupied else StoredAtlas(folder)
