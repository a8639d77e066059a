"""The folder of a studio: what lies in it, what may be read of it, and what is added to it."""

from __future__ import annotations

import json
import os
import re
import shutil
import tempfile
import unicodedata
from collections.abc import AsyncIterator, Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from topomerge.archive import PART_SUFFIX, read_array_headers
from topomerge.errors import InputError
from topomerge.io.points import detect_format, list_suffixes

LONGEST_NAME = 120  # characters of the name of a file that is added
MOST_ENTRIES = 5000  # of a folder, that are listed
KEPT_FREE = 1 << 30  # bytes of the disk that uploads leave
NOT_ALLOWED = re.compile(r"[^\w .()+=@-]")  # in names of files that are added; \w knows all alphabets
DIFF_PAGE = "diff.html"  # in the folder of a comparison
TABLES = (".json", ".csv", ".txt", ".yaml", ".yml")  # may be scans, but mostly lie beside one
PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm")


class UploadError(InputError):
    """A file that is not taken; `status` is that of HTTP."""

    def __init__(self, message: str, status: int = 400) -> None:
        super().__init__(message)
        self.status = status


@dataclass(frozen=True)
class UploadLimits:
    """Limits of uploads: bytes of a file, files in the folder, and files at a time."""

    file_bytes: int = 50 << 30
    files: int = 2000
    at_once: int = 4


class StudioFolder:
    """A folder and the limits of what is added to it."""

    def __init__(self, root: str | Path, limits: UploadLimits | None = None) -> None:
        self.root = Path(os.path.realpath(root))
        if not self.root.is_dir():
            raise InputError(f"{root}: is no folder; name the folder that holds the maps and scans")
        self.limits = limits or UploadLimits()
        self._receiving = 0

    def resolve(self, relative: str) -> Path:
        """Return the file of a path below the folder.

        Raises:
            InputError: it leads out of the folder, also by a link; it is hidden or is not there.
        """
        parts = relative.split("/")
        odd = any(part in ("", ".", "..") or part.startswith(".") or "\\" in part or "\0" in part for part in parts)
        place = None if odd else Path(os.path.realpath(self.root.joinpath(*parts)))
        if place is None or not place.is_relative_to(self.root) or not place.exists():
            raise InputError(f"{relative[:200]}: no such file in the folder; load the page again")
        return place

    def name(self, path: Path) -> str:
        """Return the path below the folder, as the page knows it."""
        return path.relative_to(self.root).as_posix()

    def format_word(self, path: Path) -> str:
        """Return the path as a word of a command that runs in the folder: it is no option, whatever it is called."""
        name = self.name(path)
        return f"./{name}" if name.startswith("-") else name

    def list_entries(self) -> list[dict[str, Any]]:
        """List what the page shows: maps, scans, merges, atlases, pages; sorted by name."""
        entries = []
        for path in self._iter_paths(self.root):
            entry = _describe_entry(path, self._get_stamp(path))
            if entry is not None:
                extracted = path.with_name(f"{path.stem}.tmap").is_file() or self.find_map_path(path).is_file()
                more = {"extracted": extracted} if entry["kind"] == "scan" else {}
                entries.append({"path": self.name(path), **entry, **more})
            if entry is not None and entry["kind"] in ("merge", "atlas"):
                entries += self._list_joined(path, entry["kind"])
        if (self.root / "atlas.json").is_file():  # the folder itself is an atlas
            entries += self._list_joined(self.root, "atlas")
        return entries[:MOST_ENTRIES]

    def find_map_path(self, scan: Path) -> Path:
        """Return where the map of a scan is written."""
        return scan.with_name(f"{scan.name}.tmap" if scan.is_dir() else f"{scan.stem}.tmap")

    def compute_signature(self) -> tuple[Any, ...]:
        """Compute what changes when the folder does."""
        inner = [p for p in self._iter_paths(self.root) if p.is_dir()]
        return tuple((str(p), self._get_stamp(p)) for folder in (self.root, *inner) for p in self._iter_paths(folder))

    def find_free(self, name: str) -> Path:
        """Return a path in the folder that is free: with a number behind the name where it is taken."""
        stem, suffix = Path(name).stem, Path(name).suffix
        names = (f"{stem}{f' ({n})' if n > 1 else ''}{suffix}" for n in range(1, 10_000))
        return next(self.root / one for one in names if not os.path.lexists(self.root / one))

    async def receive(self, name: str, length: int | None, blocks: AsyncIterator[bytes]) -> Path:
        """Write a file that is sent, under a clean name that is free, and return its path.

        Raises:
            UploadError: it is too large, of no known kind, or too many are sent.
        """
        clean = clean_name(name)
        if Path(clean).suffix.lower() not in (".tmap", *list_suffixes()):
            raise UploadError(f"{clean}: topomerge reads no such files; see the list of formats")
        most = min(self.limits.file_bytes, shutil.disk_usage(self.root).free - KEPT_FREE)
        if length is not None and length > most:
            raise UploadError(f"{clean}: is too large ({length:,} bytes); {max(most, 0):,} are allowed", 413)
        if self._receiving >= self.limits.at_once or sum(1 for _ in self.root.iterdir()) >= self.limits.files:
            raise UploadError(f"{clean}: too many files; send it later, or take some out of the folder", 429)
        self._receiving += 1
        place = Path(tempfile.mkdtemp(prefix=".upload.", suffix=PART_SUFFIX, dir=self.root))
        try:
            with (place / "file").open("wb") as file:
                size = 0
                async for block in blocks:
                    size += len(block)
                    if size > most:
                        raise UploadError(f"{clean}: is too large; {max(most, 0):,} bytes are allowed", 413)
                    file.write(block)
            if length is not None and size != length:
                raise UploadError(f"{clean}: was cut off; send it again")
            path = self.find_free(clean)
            (place / "file").rename(path)
            return path
        finally:
            self._receiving -= 1
            shutil.rmtree(place, ignore_errors=True)

    def _iter_paths(self, folder: Path) -> Iterator[Path]:
        """Yield the visible entries of a folder, without links that lead out of it."""
        try:
            names = sorted(entry.name for entry in os.scandir(folder) if not entry.name.startswith("."))
        except OSError:
            return
        for name in names[:MOST_ENTRIES]:
            path = folder / name
            if not path.is_symlink() or Path(os.path.realpath(path)).is_relative_to(self.root):
                yield path

    def _list_joined(self, folder: Path, kind: str) -> list[dict[str, Any]]:
        """Return the joined maps of a merge or an atlas, which are opened like any other."""
        maps = [p for p in self._iter_paths(folder) if re.fullmatch(r"map(_\d+)?\.tmap", p.name)]
        described = [(p, _describe_entry(p, self._get_stamp(p))) for p in maps]
        return [{"path": self.name(p), **d, "of": kind} for p, d in described if d is not None]

    @staticmethod
    def _get_stamp(path: Path) -> tuple[int, int]:
        try:
            status = (path / "merge.json" if (path / "merge.json").is_file() else path).stat()
        except OSError:
            return 0, 0
        return status.st_mtime_ns, status.st_size


def clean_name(name: str) -> str:
    """Return the name of a file that is added: no folders, nothing that a shell or a page could take for its own."""
    last = unicodedata.normalize("NFC", name).replace("\\", "/").split("/")[-1]
    stem, dot, suffix = NOT_ALLOWED.sub("_", last).strip(" .").rpartition(".")
    clean = f"{stem.strip(' .')[:LONGEST_NAME] or 'file'}{dot}{suffix[:12]}" if dot else suffix[:LONGEST_NAME]
    if not clean or clean.startswith("-"):
        clean = f"file{clean}"
    return clean


@lru_cache(maxsize=4 * MOST_ENTRIES)
def _describe_entry(path: Path, stamp: tuple[int, int]) -> dict[str, Any] | None:
    """Describe an entry of the folder; None where the page does not show it. It is read again when its stamp changes."""
    about = {"name": path.name, "bytes": stamp[1], "changed": stamp[0] // 1_000_000}
    suffix = path.suffix.lower()
    if path.is_dir():
        return _describe_folder(path, about)
    if suffix == ".tmap":
        try:
            heads = read_array_headers(path)
            counts = {name: heads[name].size for name in ("rooms", "storeys", "edges")}
            return {"kind": "map", **about, **counts}
        except (InputError, KeyError) as error:
            return {"kind": "map", **about, "error": str(error)}
    if suffix in (".html", ".htm"):
        return {"kind": "page", **about}
    companion = suffix in TABLES or (suffix in PICTURES and path.with_suffix(".yaml").exists())
    return {"kind": "scan", **about} if suffix in list_suffixes() and not companion else None


def _describe_folder(path: Path, about: dict[str, Any]) -> dict[str, Any] | None:
    for name, kind in (("merge.json", "merge"), ("atlas.json", "atlas")):
        if (path / name).is_file():
            listing = read_listing(path / name)
            listed = {key: listing.get(key) for key in ("status", "probability", "reason")}
            maps = [str(one.get("source", "")) for one in listing.get("maps", []) if isinstance(one, dict)]
            return {"kind": kind, **about, **listed, "maps": [Path(m).name for m in maps]}
    if (path / DIFF_PAGE).is_file():
        return {"kind": "page", **about, "page": DIFF_PAGE}
    try:
        if any(p.suffix.lower() in list_suffixes() and p.suffix.lower() not in TABLES for p in path.iterdir()):
            return {"kind": "scan", **about, "format": detect_format(path).name}
    except (InputError, OSError):
        pass
    return None


def read_listing(path: Path) -> dict[str, Any]:
    """Read merge.json or atlas.json; an empty table where it is damaged, which the page says."""
    try:
        listing = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {"status": "damaged"}
    return listing if isinstance(listing, dict) else {"status": "damaged"}
