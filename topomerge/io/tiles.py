"""One cloud in several files of one frame: the tiles of CloudCompare, NavVis and LAStools, a folder of registered stations.

Each file is read by the reader of its format, one after the other, so that memory does not grow with their number. What only some
of them have is filled as everywhere (`gather`): colours are black there. Intensities are kept where all files count them alike,
that is, where all are of one format.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from topomerge.errors import InputError
from topomerge.io.landmarks import is_landmark_file
from topomerge.io.piece import Piece, ReadOptions
from topomerge.io.points import Format, detect_format, iter_guarded

CLOUD_MODULES = ("ply", "pcd", "las", "e57", "arrays", "text")  # readers of points that know their frame
NOTES = ("text",)  # in a folder with other files, a text is more likely about them
LAS_KEYS, LAS_WKT = 34735, 2112  # numbers of the records that name the coordinate system
PROJECTED, GEOGRAPHIC = 3072, 2048  # keys in the first of them
NO_CODE = (0, 32767)  # not said, or defined by its user
WKT_CODE = re.compile(r"(?:AUTHORITY|ID)\s*\[\s*\"EPSG\"\s*,\s*\"?(\d+)\"?\s*\]")


def read(path: Path, options: ReadOptions) -> Iterator[Piece]:
    """Read the points of all files of a folder as they are, in their common frame."""
    files = find_tiles(path)
    _check_systems(path, [file for file, form in files if form.module == "las"])
    alike = len({form.module for _, form in files}) == 1
    poses = 0
    for number, (file, form) in enumerate(files):
        before = poses
        for piece in _read_tile(file, form, replace(options, one_frame=False)):
            poses += 0 if piece.poses is None else len(piece.poses)
            yield replace(
                piece,
                pose_of=None
                if piece.pose_of is None
                else np.where(piece.pose_of >= 0, piece.pose_of + before, -1).astype(np.int32),
                intensities=piece.intensities if alike else None,
                done=(number + min(piece.done, 1.0)) / len(files),
            )


def find_tiles(folder: Path) -> list[tuple[Path, Format]]:
    """Return the files of points in a folder, or in the only folder below it that has some, in the order of their names and
    numbers.

    Raises:
        InputError: there are none, or one is empty or can't be opened.
    """
    names = _list_tiles(folder)
    if not names:
        below = {p.name: tiles for p in sorted(folder.iterdir()) if p.is_dir() and (tiles := _list_tiles(p))}
        if len(below) > 1:
            raise InputError(f"{folder}: holds several folders of files ({', '.join(below)[:200]}); give one of them")
        names = next(iter(below.values()), [])
    if not names:
        raise InputError(f"{folder}: holds no files of points (ply, pcd, las, laz, e57, npy, npz, tables); give their folder")
    files = [(file, detect_format(file)) for file in names]
    others = [(file, form) for file, form in files if form.module not in NOTES]
    return others or files


def list_tile_suffixes() -> tuple[str, ...]:
    """List the suffixes of files that may be parts of one cloud."""
    from topomerge.io.points import FORMATS

    return tuple(suffix for form in FORMATS if form.module in CLOUD_MODULES for suffix in form.suffixes)


def _list_tiles(folder: Path) -> list[Path]:
    able = list_tile_suffixes()
    files = [p for p in folder.iterdir() if p.suffix.lower() in able and not p.name.startswith(".") and p.is_file()]
    files = [p for p in files if not is_landmark_file(p)]
    return sorted(files, key=lambda p: ([int(n) for n in re.findall(r"\d+", p.stem)], p.name))


def _read_tile(file: Path, form: Format, options: ReadOptions) -> Iterator[Piece]:
    """Yield the pieces of one file, which an error names.

    Raises:
        InputError: it can't be read.
    """
    try:
        yield from iter_guarded(file, form, lambda reader: reader.read(file, options))
    except InputError as error:
        raise InputError(f"{error} (one of the files of --one-frame: mend it, or take it out of the folder)") from error


def _check_systems(folder: Path, files: list[Path]) -> None:
    """Refuse LAS files that name different coordinate systems: their points lie in different frames."""
    first: tuple[Path, str] | None = None
    for file in files:
        system = _read_coordinate_system(file)
        if first is None:
            first = (file, system) if system else None
        elif system and system != first[1]:
            raise InputError(
                f"{folder}: {first[0].name} is in {first[1]} and {file.name} in {system}; --one-frame needs one system: "
                f"convert one of them"
            )


def _read_coordinate_system(file: Path) -> str:
    """Return the coordinate system that a LAS file names, as "EPSG:1234" or by its name; "" for none."""
    import laspy

    try:
        with file.open("rb") as stream:
            records = laspy.LasHeader.read_from(stream).vlrs
    except Exception:  # whatever is wrong with the file, its reader tells better
        return ""
    for record in records:
        if record.record_id == LAS_KEYS:
            keys = np.frombuffer(record.record_data_bytes(), "<u2")
            keys = keys[4 : len(keys) // 4 * 4].reshape(-1, 4)
            codes = {int(key): int(value) for key, _, _, value in keys}
            code = next((c for c in (codes.get(PROJECTED, 0), codes.get(GEOGRAPHIC, 0)) if c not in NO_CODE), 0)
            if code:
                return f"EPSG:{code}"
        if record.record_id == LAS_WKT:
            text = record.record_data_bytes().decode("utf-8", errors="replace")
            codes_of_text = WKT_CODE.findall(text)
            if codes_of_text:
                return f"EPSG:{codes_of_text[-1]}"
            name = re.search(r"\"([^\"]*)\"", text)
            return name[1] if name else ""
    return ""
