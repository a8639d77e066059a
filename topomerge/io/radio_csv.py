"""Readings of radio in a text file beside a trajectory: a line with time, address and dBm each.

Times are seconds of the trajectory's clock. Columns are found by their names in the first line, where it has any (time, timestamp
or t; address, bssid or mac; dbm, rssi, level or signal), else they are the first three. Commas, semicolons or tabs part them.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from topomerge.archive import refuse_pointer
from topomerge.errors import InputError
from topomerge.io.trajectory import LONGEST_GAP, Trajectory, read_trajectory
from topomerge.types import Landmarks, build_landmarks

COLUMNS = {
    "time": ("time", "timestamp", "t", "seconds", "#time"),
    "address": ("address", "bssid", "mac", "addr"),
    "dBm": ("dbm", "rssi", "level", "signal", "power"),
}
TRAJECTORIES = ("poses.txt", "traj_lidar.txt", "groundtruth.txt", "trajectory.txt", "poses_tum.txt")
SAME_SCAN = 0.5  # s between readings of one scan
POSSIBLE = (-130.0, 20.0)  # dBm
POSE_GAP = 5.0  # s from the nearest pose, up to which a reading has a place
POSITION_SIGMA = 0.5  # m


def read_radio_beside(table: Path, path: Path, poses: str | None = None) -> Landmarks:
    """Read a table of readings beside a scan, with the trajectory that lies there.

    Args:
        path: the scan, or the folder of scans.
        poses: the trajectory that the user names; else the first of `TRAJECTORIES` is taken.

    Raises:
        InputError: there is no trajectory, or as `read_radio_csv`.
    """
    trajectory = find_trajectory(table, path, poses)
    if trajectory is None:
        first = _list_trajectories(path)[0]
        raise InputError(f"{table}: has no trajectory; put {first} (time tx ty tz qx qy qz qw) beside it, or take it away")
    return read_radio_csv(table, read_trajectory(trajectory))


def find_trajectory(table: Path, path: Path, poses: str | None = None) -> Path | None:
    """Find the trajectory of a table of readings beside a scan, as of `read_radio_beside`; None where there is none."""
    places = [Path(poses)] if poses else [table.parent / name for name in _list_trajectories(path)]
    return next((place for place in places if place.is_file()), None)


def _list_trajectories(path: Path) -> tuple[str, ...]:
    return TRAJECTORIES if path.is_dir() else tuple(f"{path.stem}.{name}" for name in TRAJECTORIES) + TRAJECTORIES


def read_radio_csv(path: Path, trajectory: Trajectory) -> Landmarks:
    """Read readings, each at the place where the trajectory was at its time.

    Readings that lie `SAME_SCAN` or less behind the first of a scan are of that scan. Those further than `POSE_GAP` from any pose
    have no place.

    Raises:
        InputError: a trajectory without times, no such file, or a line that holds no reading; with its number.
    """
    if trajectory.times is None or not len(trajectory):
        raise InputError(f"{path}: its trajectory has no times; give one in the format of TUM (time tx ty tz qx qy qz qw)")
    rows = _read_rows(path)
    if not rows:
        return Landmarks()
    order = sorted(range(len(rows)), key=lambda k: rows[k][0])
    times = np.array([rows[k][0] for k in order])
    position = trajectory.interpolate(times)[:, :3, 3]
    position[trajectory.measure_gap(times) > max(POSE_GAP, LONGEST_GAP)] = np.nan
    group, start = np.zeros(len(times), np.int64), times[0]
    for k in range(1, len(times)):
        new = times[k] - start > SAME_SCAN
        start = times[k] if new else start
        group[k] = group[k - 1] + new
    addresses, strength = [rows[k][1] for k in order], [rows[k][2] for k in order]
    return build_landmarks(
        "radio", addresses, path.name, position, sigma=POSITION_SIGMA, number=np.array(strength), group=group, time=times
    )


def _read_rows(path: Path) -> list[tuple[float, str, float]]:
    try:
        refuse_pointer(path)
        with path.open(encoding="utf-8-sig", errors="replace", newline="") as stream:
            first = stream.readline()
            mark = next((m for m in (";", "\t") if m in first), ",")
            stream.seek(0)
            return _parse_rows(path, csv.reader(stream, delimiter=mark))
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; give a CSV of time, address and dBm") from None
    except IsADirectoryError:
        raise InputError(f"{path}: is a folder; give a CSV of time, address and dBm") from None
    except csv.Error as error:
        raise InputError(f"{path}: is no CSV ({error}); give lines of time, address and dBm") from error
    except OSError as error:
        raise InputError(f"{path}: can't be read ({error.strerror or error}); check its permissions") from error


def _parse_rows(path: Path, lines) -> list[tuple[float, str, float]]:  # type: ignore[no-untyped-def]
    where = [0, 1, 2]
    rows: list[tuple[float, str, float]] = []
    for fields in lines:
        number, fields = lines.line_num, [word.strip() for word in fields]
        if not any(fields) or (fields[0].startswith("#") and rows):
            continue
        if not rows and (named := _find_columns(fields)):
            where = named
            continue
        if len(fields) <= max(where):
            raise InputError(f"{path}: line {number} has {len(fields)} columns; give time, address and dBm")
        time, address, strength = (fields[k] for k in where)
        try:
            values = float(time), float(strength)
        except ValueError:
            raise InputError(f"{path}: line {number} has no number for time or dBm; mend or remove it") from None
        if not all(map(math.isfinite, values)) or not POSSIBLE[0] < values[1] < POSSIBLE[1]:
            raise InputError(f"{path}: line {number} holds {strength[:20]} dBm at {time[:20]} s: no reading; mend or remove it")
        if not address:
            raise InputError(f"{path}: line {number} has no address; mend or remove it")
        rows.append((values[0], address.lower(), values[1]))
    return rows


def _find_columns(header: Sequence[str]) -> list[int]:
    """Columns of time, address and dBm by their names; empty where one of them is not named."""
    names = [word.lower() for word in header]
    found = [next((names.index(n) for n in possible if n in names), -1) for possible in COLUMNS.values()]
    return found if min(found) >= 0 else []
