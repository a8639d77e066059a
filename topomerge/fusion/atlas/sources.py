"""watch.json of an atlas: which files of watched folders gave which maps, so that a watch that was stopped goes on.

It is written together with the maps. Without it all files are read again, and those whose maps are in the atlas only noted.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from topomerge.io.listing import json_text

SOURCES_FILE, SOURCES_FORMAT = "watch.json", 1
TRUTH = '{"format":1,"building":'  # that truth.json of `simulate` begins with, but for blanks
HASHED_AT_ONCE = 1 << 20  # bytes


@dataclass(frozen=True)
class Source:
    """A file, or a folder of scans, that was read.

    Args:
        stamp: hash of the sizes and times of its files, and of the options that they were read with.
        digest: hash of their contents, and of the options that they were read with.
        map: name of the map that it gave; empty where it gave none.
        error: why it gave none.
    """

    stamp: str
    digest: str
    map: str = ""
    error: str = ""


def read_sources(folder: Path) -> dict[str, Source]:
    """Path -> what it gave; nothing where the file is missing, damaged or of another format."""
    try:
        listing = json.loads((folder / SOURCES_FILE).read_text(encoding="utf-8"))
        if listing["format"] != SOURCES_FORMAT:
            return {}
        return {str(path): _source(listed) for path, listed in listing["files"].items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return {}


def _source(listed: Mapping[str, Any]) -> Source:
    words = [listed[name] for name in ("stamp", "digest", "map", "error")]
    if not all(isinstance(word, str) for word in words):
        raise ValueError("no source")
    return Source(*words)


def sources_to_json(sources: Mapping[str, Source]) -> str:
    """What `read_sources` reads."""
    return json_text({"format": SOURCES_FORMAT, "files": {path: asdict(sources[path]) for path in sorted(sources)}})


def beside_clouds(folder: Path) -> tuple[str, ...]:
    """The files that `simulate` wrote beside its clouds, if its truth.json is in the folder."""
    try:
        with (folder / "truth.json").open("rb") as file:
            start = "".join(file.read(200).decode(errors="replace").split())
    except OSError:
        return ()
    return ("truth.json", "plan.png") if start.startswith(TRUTH) else ()


def stamp_of(path: Path, options: str) -> str:
    """Hash of the names, sizes and times of change of a file, or of all files of a folder, and of the options that it is read
    with; empty where it is gone."""
    try:
        of = [(str(p.relative_to(path)), p.stat().st_size, p.stat().st_mtime_ns) for p in files_of(path)]
    except OSError:
        return ""
    return hashlib.sha256(repr((of, options)).encode()).hexdigest()[:16] if of else ""


def digest_of(path: Path, options: str) -> str:
    """Hash of the content of a file, or of all files of a folder, and of the options that it is read with.

    Raises:
        OSError: it can't be read.
    """
    digest = hashlib.sha256(f"{options}\0{path.suffix.lower()}\0".encode())
    for file in files_of(path):
        digest.update(f"{file.relative_to(path)}\0{file.stat().st_size}\0".encode())
        with file.open("rb") as stream:
            while block := stream.read(HASHED_AT_ONCE):
                digest.update(block)
    return digest.hexdigest()[:32]


def files_of(path: Path) -> list[Path]:
    """The file itself, or all files in a folder, in their order; without hidden ones."""
    if not path.is_dir():
        return [path]
    inside = (p for p in path.rglob("*") if not any(part.startswith(".") for part in p.relative_to(path).parts))
    return sorted(p for p in inside if p.is_file())
