"""Laser logs of robots in five buildings (Radish; poses corrected by mapping, published with Schaefer et al. 2019), cut by time.

Each log gives three partial maps: the first half of its scans, the middle and the last. Where two overlap in time, they take
turns, so that no scan is in both. The poses tell how the parts lie to each other, exactly; each part is drawn into a raster of
its own frame. The first and the last share only what the robot came back to, sometimes nothing.
"""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
from topomerge.datasets.pairs.flat_maps import FlatMap, build_flat_pair
from topomerge.datasets.pairs.pairs import Pair, draw_frames

from topomerge.errors import InputError
from topomerge.types import Array, Sim3

SPANS = {"first": (0.0, 0.5), "middle": (0.25, 0.75), "last": (0.5, 1.0)}  # shares of the log
PAIRS = (("first", "middle"), ("middle", "last"), ("first", "last"))
LOG_CELL = 0.05  # m
LASER_REACH = 15.0  # m; farther returns of a sweep of 1° lie too far apart to draw a wall
NEAREST, FAILED = 0.1, 40.0  # m; ranges beyond are what a laser says when nothing comes back: nothing is known then
SCAN_BLOCK = 64  # scans at a time
SOLID = 0.25  # share of the rays into a cell that must end there for it to be a wall
LARGEST_LOG = 200 << 20  # bytes of an unpacked log
FEWEST_SCANS = 20  # scans of a part
LOG_CELLS = 200_000_000  # of a raster


def iter_pairs(folder: Path) -> Iterator[tuple[str, Callable[[], Pair]]]:
    """Yield the name and maker of each of three pairs a log.

    Raises:
        InputError: the folder has no log.
    """
    logs = sorted(folder.glob("*.log.gz"))
    if not logs:
        raise InputError(f"{folder}: has no *.log.gz; check the folder")
    for path in logs:
        for a, b in PAIRS:
            yield f"{_parse_site(path)}-{a}-{b}", partial(_load_pair, path, a, b)


def _parse_site(path: Path) -> str:
    return path.name.removesuffix(".log.gz").removesuffix("-corrected")


def _load_pair(path: Path, a: str, b: str) -> Pair:
    name = f"{_parse_site(path)}-{a}-{b}"
    poses, ranges = read_log(path)
    seed = zlib.crc32(name.encode())
    frames = [Sim3(f.yaw, (*f.translation[:2], 0.0)) for f in draw_frames(2, False, np.random.default_rng(seed))]
    maps = [
        draw_map(poses[rows], ranges[rows], frame, name) for rows, frame in zip(split_log(len(poses), a, b), frames, strict=True)
    ]
    truth = frames[0] @ frames[1].inverse()
    return build_flat_pair(name, maps[0], maps[1], truth, ("laser2d", "laser2d"), "carmen", _parse_site(path))


def split_log(count: int, a: str, b: str) -> tuple[Array, Array]:
    """Return scans of two parts of a log; of the span that is in both, they take every other scan.

    Raises:
        InputError: the log is too short.
    """
    first, second = (np.arange(*(round(end * count) for end in SPANS[part])) for part in (a, b))
    both = np.intersect1d(first, second)
    rows = np.setdiff1d(first, both[1::2]), np.setdiff1d(second, both[::2])
    if min(map(len, rows)) < FEWEST_SCANS:
        raise InputError(f"a log of {count} scans is too short: {FEWEST_SCANS} a part are needed")
    return rows


def read_log(path: Path) -> tuple[Array, Array]:
    """Read poses (n, 3) of the laser in m and rad, and ranges (n, k) in m, of the FLASER lines of a packed CARMEN log.

    Raises:
        InputError: no gzip, cut short, far too large, a damaged line, or no scans.
    """
    try:
        with gzip.open(path) as stream:
            text = stream.read(LARGEST_LOG + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise InputError(f"{path}: can't be unpacked ({error}); copy it again") from error
    if len(text) > LARGEST_LOG:
        raise InputError(f"{path}: unpacks to more than {LARGEST_LOG >> 20} MB; is it a log?")
    poses: list[Array] = []
    ranges: list[Array] = []
    for number, line in enumerate(text.splitlines(), 1):
        if line.startswith(b"FLASER "):
            fields = line.split()
            try:
                beams = int(fields[1])
                values = np.array(fields[2 : beams + 5], float)
            except (ValueError, IndexError) as error:
                raise InputError(f"{path}: line {number} is no scan ({error}); copy it again") from error
            if (
                beams < 2
                or len(values) < beams + 3
                or not np.isfinite(values[beams:]).all()
                or (ranges and beams != len(ranges[0]))
            ):
                raise InputError(f"{path}: line {number} has {len(values)} values for {beams} beams; copy it again")
            ranges.append(values[:beams])
            poses.append(values[beams:])
    if not poses:
        raise InputError(f"{path}: has no FLASER line; is it a CARMEN log?")
    return np.array(poses), np.array(ranges)


def draw_map(poses: Array, ranges: Array, frame: Sim3, source: str = "") -> FlatMap:
    """Draw the map that scans give: what rays ended at is wall, what they crossed is free.

    Args:
        poses: (n, 3) of the laser, m and rad.
        ranges: (n, k) m, from right to left; 180 or 181 beams are 1° apart, 360 or 361 half a degree.
        frame: log -> map.

    Raises:
        InputError: poses that are too far apart.
    """
    beams = ranges.shape[1]
    angles = np.radians(np.arange(beams) * (180.0 / (beams - beams % 2)) - 90.0)
    x, y = frame.apply(np.column_stack([poses[:, :2], np.zeros(len(poses))]))[:, :2].T
    yaw = poses[:, 2] + frame.yaw
    low = np.array([x.min(), y.min()]) - LASER_REACH - 1.0
    wide, high = np.ceil((np.array([x.max(), y.max()]) + LASER_REACH + 1.0 - low) / LOG_CELL).astype(int)
    if not float(wide) * float(high) < LOG_CELLS:
        raise InputError(
            f"{source}: its poses span {wide * LOG_CELL:.0f} by {high * LOG_CELL:.0f} m; is it a log of one building?"
        )
    ended, crossed = (np.zeros(wide * high, np.int32) for _ in range(2))
    for start in range(0, len(poses), SCAN_BLOCK):
        block = slice(start, start + SCAN_BLOCK)
        origins = np.stack([x[block], y[block]], axis=1) - low
        for counts, points in zip((ended, crossed), _cast_rays(origins, yaw[block, None] + angles, ranges[block]), strict=True):
            cells = np.floor(points / LOG_CELL).astype(np.int64)
            counts += np.bincount(cells[:, 1] * wide + cells[:, 0], minlength=wide * high).astype(np.int32)
    wall = (ended > 0) & (ended >= SOLID * (ended + crossed))
    at = [np.stack(np.divmod(np.flatnonzero(m), wide)[::-1], axis=1) for m in (wall, (crossed > 0) & ~wall)]
    walls, free = ((cells + 0.5) * LOG_CELL + low for cells in at)
    return FlatMap(walls, free, LOG_CELL, poses=np.column_stack([x, y, yaw]), source=source)


def _cast_rays(origins: Array, headings: Array, ranges: Array) -> tuple[Array, Array]:
    """Return where the rays (n, k) of n scans ended within `LASER_REACH`, and points on the way there, one a cell: (m, 2)
    each."""
    good = (ranges > NEAREST) & (ranges < FAILED)
    scan = np.nonzero(good)[0]
    far, ray = ranges[good], np.stack([np.cos(headings[good]), np.sin(headings[good])], axis=1)
    hit = far < LASER_REACH
    steps = np.arange(0.0, LASER_REACH, LOG_CELL)
    row, step = np.nonzero(steps < np.minimum(far, LASER_REACH)[:, None] - 1.5 * LOG_CELL)
    return origins[scan[hit]] + ray[hit] * far[hit, None], origins[scan[row]] + ray[row] * steps[step, None]
