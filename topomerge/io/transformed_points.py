"""The points of a file written to another one, each at another place: LAS and LAZ stay what they are, all else becomes PLY."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from topomerge.archive import replace_on_success
from topomerge.io import frame
from topomerge.io.piece import BLOCK_POINTS, build_damage_error, read_options
from topomerge.io.points import detect_format, iter_guarded, read_chunks
from topomerge.progress import Progress
from topomerge.types import Array, PointCloud

Move = Callable[[Array], Array]  # (n, 3) float64 points in metres, z up -> (n, 3)
LAS_STEP = 1e-4  # m, of the coordinates in LAS; with 32 bits they reach 214 km from their offset
FLOAT32_WITHIN = 1e4  # m from the origin: float32 keeps half a millimetre
LONGEST_COUNT = 20  # digits of a number of points; the head is written before it is known
PROJECTION = "LASF_Projection"  # records of a LAS file that name the coordinate system
OCTREE = "copc"  # a record that says where the nodes of an octree lie in the file


@dataclass(frozen=True)
class SavedPoints:
    """Counts of what was written: the number of points, and of those that lie too far from all others for LAS."""

    written: int
    beyond: int = 0


def choose_suffix(source: str | Path) -> str:
    """Return the suffix of the file into which the points of `source` are written."""
    suffix = Path(source).suffix.lower()
    return suffix if suffix in (".las", ".laz") else ".ply"


def save_transformed_points(
    source: str | Path,
    target: str | Path,
    move: Move,
    near: Array,
    *,
    same_frame: bool = False,
    progress: Progress | None = None,
    **options: Any,
) -> SavedPoints:
    """Write every point of a file to where `move` brings it, a block at a time, in metres with z up.

    LAS and LAZ keep all dimensions of their points (intensity, classes, time, extra bytes), in steps of 0.1 mm; the records that
    name the coordinate system stay only if it is still that of the file. PLY (binary, little endian) has x y z, as double far
    from the origin, and red green blue where the file has colours.

    Args:
        source: what `read_points` reads.
        target: its suffix is `choose_suffix(source)`.
        move: takes (n, 3) float64 points as `read_points` gives them.
        near: (3,) m, a place near which most of them come to lie.
        same_frame: points are moved within the frame of the file, not into another one.
        progress: called now and then with the share done and a text.
        options: as of `read_points`.

    Raises:
        InputError: the source can't be read, or the target not be written.
    """
    source, target = Path(source), Path(target)
    if choose_suffix(target) != ".ply":
        with replace_on_success(target) as temporary:
            return _save_las(
                source, temporary, move, _Frame(np.floor(np.asarray(near, np.float64)), same_frame), progress, options
            )
    real = "f8" if np.abs(near).max() > FLOAT32_WITHIN else "f4"
    with replace_on_success(target) as temporary:
        written = _save_ply(source, temporary, move, (real, False), progress, options)
        if written is None:  # rare: the first block had no colours, a later one has
            written = _save_ply(source, temporary, move, (real, True), progress, options)
    assert written is not None
    return SavedPoints(written)


def _save_ply(
    source: Path, target: Path, move: Move, layout: tuple[str, bool], progress: Progress | None, options: dict[str, Any]
) -> int | None:
    """Write the points, and return how many; None where colours came after a block without."""
    real, colored = layout
    count = 0
    with target.open("wb") as stream:
        for cloud in read_chunks(source, chunk=BLOCK_POINTS, progress=progress, **options):
            if count == 0:
                colored = colored or cloud.colors is not None
                _write_head(stream, real, colored, count)
            elif cloud.colors is not None and not colored:
                return None
            stream.write(_build_vertices(cloud, move, real, colored).tobytes())
            count += len(cloud)
        stream.seek(0)
        _write_head(stream, real, colored, count)
    return count


def _write_head(stream: BinaryIO, real: str, colored: bool, count: int) -> None:
    """Write the header; of one length, whatever the count."""
    number = str(count)
    names = {"f4": "float", "f8": "double"}
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment topomerge points, metres, z up{'.' * (LONGEST_COUNT - len(number))}",
    ]
    lines += [f"element vertex {number}", *(f"property {names[real]} {axis}" for axis in "xyz")]
    lines += [f"property uchar {name}" for name in ("red", "green", "blue") if colored]
    stream.write(("\n".join([*lines, "end_header"]) + "\n").encode("ascii"))


def _build_vertices(cloud: PointCloud, move: Move, real: str, colored: bool) -> Array:
    layout = [("xyz", f"<{real}", 3)] + ([("rgb", "u1", 3)] if colored else [])
    rows = np.zeros(len(cloud), layout)
    rows["xyz"] = move(cloud.points.astype(np.float64) + cloud.shift)
    if colored and cloud.colors is not None:
        rows["rgb"] = cloud.colors
    return rows


@dataclass(frozen=True, eq=False)
class _Frame:
    """Of the coordinates in a LAS file: their offset (3,), m, and is the coordinate system still that of the source?"""

    offset: Array
    same: bool


def _save_las(
    source: Path, target: Path, move: Move, to: _Frame, progress: Progress | None, options: dict[str, Any]
) -> SavedPoints:
    import laspy

    reading = read_options(source, options)
    turning = frame.get_axis_rotation(reading.up or "z")
    written = beyond = 0
    writer = None
    try:
        for header, rows, done in _iter_las_blocks(source):
            points = move(frame.transform_points(_get_las_coordinates(rows), turning, reading.factor))
            steps = np.rint((points - to.offset) / LAS_STEP)
            near = (np.abs(steps) < 2**31 - 1).all(axis=1)
            if writer is None:
                head = _build_las_header(
                    header, to.offset, to.same and reading.factor == 1.0 and np.array_equal(turning, np.eye(3))
                )
                packed, backend = target.suffix.lower() == ".laz", [laspy.LazBackend.Lazrs]
                writer = laspy.open(target, "w", header=head, do_compress=packed, laz_backend=backend)
            array = rows.array[near].copy()
            for k, axis in enumerate("XYZ"):
                array[axis] = steps[near, k]
            writer.write_points(laspy.ScaleAwarePointRecord(array, rows.point_format, head.scales, head.offsets))
            written, beyond = written + int(near.sum()), beyond + int((~near).sum())
            if progress is not None:
                progress(min(done, 1.0), f"writing {target.name}")
    except (laspy.errors.LaspyException, UnicodeError) as error:  # it reads what it can't write
        raise build_damage_error(source, "a LAS file", error) from error
    finally:
        if writer is not None:
            writer.close()
    return SavedPoints(written, beyond)


def _iter_las_blocks(source: Path) -> Iterator[tuple[Any, Any, float]]:
    return iter_guarded(source, detect_format(source), lambda reader: reader.records(source))


def _get_las_coordinates(rows: Any) -> Array:
    from topomerge.io.las import get_coordinates

    return get_coordinates(rows)


def _build_las_header(header: Any, offset: Array, same: bool) -> Any:
    """Return the header of the source for moved points, without what holds no longer: an octree, and the name of a coordinate
    system."""
    out = copy.deepcopy(header)
    out.offsets, out.scales = offset, np.full(3, LAS_STEP)
    out.generating_software = "topomerge"
    dropped = {OCTREE} if same else {OCTREE, PROJECTION}
    out.vlrs = type(out.vlrs)([record for record in out.vlrs if record.user_id not in dropped])
    out.evlrs = None
    return out
