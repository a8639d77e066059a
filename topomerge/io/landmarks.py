"""Landmarks in files: tables beside a scan (`a.landmarks.csv`), and rows of JSON, that come back as they were written.

The columns of a table are `COLUMNS`; its first line names those that it has, in any order. What is empty is not known. Positions
are those of the file beside which the table lies, in its unit: docs/landmarks.md.

Readings of radio beside a trajectory are lines with time, address and dBm each. Times are seconds of the trajectory's clock.
Columns are found by their names in the first line, where it has any (`RADIO_COLUMNS`), else they are the first three. Commas,
semicolons or tabs part them.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from topomerge.archive import refuse_pointer
from topomerge.errors import InputError
from topomerge.types import LANDMARK_DTYPE, LANDMARK_KINDS, MOST_LANDMARKS, Array, Landmarks, build_landmarks, clean_landmarks

if TYPE_CHECKING:  # it imports SciPy, which few files need
    from topomerge.io.trajectory import Trajectory

COLUMNS = ("kind", "value", "x", "y", "z", "sigma", "room", "storey", "confidence", "number", "group", "time")
WHOLE = ("room", "storey", "group")  # columns of whole numbers, -1 where nothing is known
REAL = ("x", "y", "z", "sigma", "number", "time")  # columns of numbers, nan where nothing is known
NUMERIC = (*REAL, *WHOLE, "confidence")
RADIO_TABLE = "radio.csv"  # `io.landmarks`
TABLE_NAME = "landmarks.csv"  # in a folder of scans; beside a file its stem and a dot stand before it
LARGEST_TABLE = 1 << 28  # bytes: two million lines
DELIMITERS = ",;\t"
MOST_WHOLE = 2**31 - 1


def is_landmark_file(path: Path) -> bool:
    """Return whether a file is a table of landmarks, or of readings of radio, by its name."""
    return any(path.name == name or path.name.endswith(f".{name}") for name in (TABLE_NAME, RADIO_TABLE))


def find_landmark_file(path: Path) -> Path | None:
    """Find the table of landmarks beside a file, or in a folder of scans; None where there is none."""
    return _find_table(path, TABLE_NAME)


def _find_table(path: Path, name: str) -> Path | None:
    places = [path / name] if path.is_dir() else [path.with_name(f"{start}.{name}") for start in (path.stem, path.name)]
    return next((place for place in places if place.is_file() and place != path), None)


def read_tables_beside(path: Path, poses: str | None, suffixes: Sequence[str]) -> tuple[list[Landmarks], list[str]]:
    """Read the tables beside a scan: of landmarks, and of readings of radio. One that is named as in a folder of scans belongs to
    the only file of its folder.

    Args:
        poses: the trajectory that the user names, for radio.
        suffixes: of files that can be read.

    Returns:
        What the tables hold, and warnings of those that may belong to another file.

    Raises:
        InputError: as `read_landmark_file` and `read_radio_beside`.
    """

    readers = {TABLE_NAME: read_landmark_file, RADIO_TABLE: lambda table: read_radio_beside(table, path, poses)}
    found, warnings = [], []
    for name, read in readers.items():
        table, shared = _find_table(path, name), _find_shared_table(path, name)
        if table is None and shared is not None:
            if _is_alone(path, suffixes):
                table = shared
            else:
                warnings.append(
                    f"{shared}: lies beside several files and was not read; name it {path.stem}.{name} if it is this one's"
                )
        if table is not None:
            found.append(read(table))
            if lost := count_lost(found[-1]):
                warnings.append(f"{table}: {lost} landmark{'s' * (lost != 1)} without a place, a room and a storey; say where")
    return found, warnings


def _find_shared_table(path: Path, name: str) -> Path | None:
    """Return the table beside a file that is named as in a folder of scans."""
    shared = path.with_name(name)
    return shared if shared.is_file() and shared != path and not path.is_dir() else None


def list_companions(path: Path, suffixes: Sequence[str]) -> list[Path]:
    """List what is read with a file: the tables beside it, as of `read_tables_beside`, and the trajectory of the radio's.

    Args:
        suffixes: of files that can be read.
    """

    found: list[Path] = []
    for name in (TABLE_NAME, RADIO_TABLE):
        table, shared = _find_table(path, name), _find_shared_table(path, name)
        if table is None and shared is not None and _is_alone(path, suffixes):
            table = shared
        if table is not None:
            trajectory = find_trajectory(table, path) if name == RADIO_TABLE else None
            found += [table] if trajectory is None else [table, trajectory]
    return found


def count_lost(landmarks: Landmarks) -> int:
    """Count the signs, tags, objects and names that have neither a place nor a room nor a storey."""
    table = landmarks.table[landmarks.is_kind("text", "tag", "object", "name")]
    return int((np.isnan(table["position"]).any(axis=1) & (table["room"] < 0) & (table["storey"] < 0)).sum())


def _is_alone(path: Path, suffixes: Sequence[str]) -> bool:
    """Return whether nothing else in its folder can be read, but for its companions and texts."""
    others = [p for p in path.parent.iterdir() if p.suffix.lower() in suffixes and p.suffix.lower() != ".txt"]
    return all(p.stem == path.stem or is_landmark_file(p) for p in others)


def read_landmark_file(path: Path) -> Landmarks:
    """Read a table of landmarks; its name is their source.

    Raises:
        InputError: it can't be read, a column is missing or unknown, or a line is wrong, which is named.
    """
    try:
        refuse_pointer(path)
        if path.stat().st_size > LARGEST_TABLE:
            raise InputError(f"{path}: has more than {LARGEST_TABLE >> 20} MB, too many for landmarks; take a part of them")
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is no text in UTF-8; save it as CSV in UTF-8") from error
    except OSError as error:
        raise InputError(f"{path}: can't be read ({error.strerror or error}); check its permissions") from error
    head, _, _ = text.partition("\n")
    reader = csv.reader(io.StringIO(text), delimiter=max(DELIMITERS, key=head.count))
    try:
        names = [name.strip().lower() for name in next(reader, [])]
        _check_names(path, names)
        numbered = [(reader.line_num, row) for row in reader if any(map(str.strip, row))]
    except csv.Error as error:
        raise InputError(f"{path}, line {reader.line_num}: is no line of a table ({error}); save it as CSV again") from error
    if len(numbered) > MOST_LANDMARKS:
        raise InputError(f"{path}: has {len(numbered):,} landmarks, more than {MOST_LANDMARKS:,}; take a part of them")
    for line, row in numbered:
        if len(row) != len(names):
            raise InputError(f"{path}, line {line}: has {len(row)} columns, not {len(names)} as the first line; correct it")
    lines, rows = [line for line, _ in numbered], [row for _, row in numbered]
    columns: dict[str, Sequence[str]] = dict(zip(names, zip(*rows, strict=True), strict=True)) if rows else {}
    if reader.dialect.delimiter != ",":  # decimal commas
        columns |= {name: [text.replace(",", ".") for text in columns[name]] for name in NUMERIC if name in columns}
    return _build_table(path, lines, columns)


def _check_names(path: Path, names: Sequence[str]) -> None:
    known = f"the columns are {', '.join(COLUMNS)}"
    wrong = [name for name in names if name not in COLUMNS or names.count(name) > 1]
    if wrong:
        raise InputError(f"{path}, line 1: {wrong[0][:40]!r} is no column, or is there twice; {known}")
    if not {"kind", "value"} <= set(names):
        raise InputError(f"{path}, line 1: kind and value must be among the columns; {known}")


def _build_table(path: Path, lines: Sequence[int], columns: Mapping[str, Sequence[str]]) -> Landmarks:
    count = len(lines)
    table = np.zeros(count, LANDMARK_DTYPE)
    numbers = {name: _parse_reals(path, lines, name, columns.get(name, ())) for name in NUMERIC}
    kinds = [kind.strip().lower() for kind in columns.get("kind", ())]
    numbered = {kind: k for k, kind in enumerate(LANDMARK_KINDS)}
    _require(
        path, lines, np.array([kind in numbered for kind in kinds], bool), f"kind must be one of {', '.join(LANDMARK_KINDS)}"
    )
    table["kind"] = [numbered[kind] for kind in kinds]
    values = [value.strip() for value in columns.get("value", ())]
    bare = np.isin(table["kind"], [numbered["pressure"]]) | np.array([bool(value) for value in values], bool)
    _require(path, lines, bare, "value is empty; write the text, the tag, the address, the class or the name")
    position = np.column_stack([numbers[name] for name in "xyz"])
    known = np.isfinite(position)
    _require(path, lines, known.all(axis=1) | ~known.any(axis=1), "x, y and z belong together; give all of them, or none")
    confidence = np.where(np.isnan(numbers["confidence"]), 1.0, numbers["confidence"])
    _require(path, lines, (confidence >= 0) & (confidence <= 1), "confidence must be 0 to 1")
    _require(path, lines, ~(numbers["sigma"] < 0), "sigma must not be below 0")
    table["position"], table["confidence"] = position, confidence
    for name in ("sigma", "number", "time"):
        table[name] = numbers[name]
    for name in WHOLE:
        whole = np.where(np.isnan(numbers[name]), -1, numbers[name])
        _require(path, lines, (whole >= -1) & (whole <= MOST_WHOLE) & (whole == np.rint(whole)), f"{name} must be 0, 1, 2 …")
        table[name] = whole
    strings = {value: k for k, value in enumerate(dict.fromkeys(values))}
    table["value"] = [strings[value] for value in values]
    return clean_landmarks(Landmarks(table, tuple(strings), (path.name,)))


def _parse_reals(path: Path, lines: Sequence[int], name: str, texts: Sequence[str]) -> Array:
    """Return (n,) float64, nan where nothing stands."""
    if not texts:
        return np.full(len(lines), np.nan)
    stripped = [text.strip() for text in texts]
    try:
        numbers = np.array([float(text) if text else math.nan for text in stripped])
    except ValueError:
        numbers = np.array([_parse_real(text) for text in stripped])
    empty = np.array([not text for text in stripped], bool)
    _require(path, lines, np.isfinite(numbers) | empty, f"{name} is no finite number; write it as 12.5, or leave it empty")
    return numbers


def _parse_real(text: str) -> float:
    try:
        return float(text) if text else math.nan
    except ValueError:
        return math.inf


def _require(path: Path, lines: Sequence[int], holds: Array, advice: str) -> None:
    """Refuse the first line for which something does not hold."""
    if not holds.all():
        raise InputError(f"{path}, line {lines[int(np.argmin(holds))]}: {advice}")


def format_landmark_table(landmarks: Landmarks) -> str:
    """Format landmarks as a table that `read_landmark_file` reads."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(COLUMNS)
    for row in serialise_landmarks(landmarks):
        x, y, z = row["position"] or (None, None, None)
        cells = {**row, "x": x, "y": y, "z": z}
        writer.writerow(["" if cells[name] is None else cells[name] for name in COLUMNS])
    return out.getvalue()


def serialise_landmarks(landmarks: Landmarks) -> list[dict[str, Any]]:
    """Serialise landmarks as rows of plain values; what is not known is None. `parse_landmarks` reads them."""
    table = landmarks.table
    reals = {name: _list_known(table[name], np.isfinite(table[name])) for name in ("sigma", "number", "time")}
    whole = {name: _list_known(table[name], table[name] >= 0) for name in WHOLE}
    position = _list_known(table["position"], np.isfinite(table["position"]).all(axis=1))
    return [
        {
            "kind": LANDMARK_KINDS[table["kind"][k]],
            "value": landmarks.values[table["value"][k]],
            "position": position[k],
            **{name: column[k] for name, column in (whole | reals).items()},
            "confidence": float(table["confidence"][k]),
            "source": landmarks.sources[table["source"][k]],
        }
        for k in range(len(table))
    ]


def _list_known(values: Array, known: Array) -> list[Any]:
    return [value if is_known else None for value, is_known in zip(values.tolist(), known.tolist(), strict=True)]


def parse_landmarks(rows: Iterable[Mapping[str, Any]], source: str) -> Landmarks:
    """Parse rows of `serialise_landmarks`; what they leave out is not known, and the source is `source`.

    Raises:
        InputError: a row is no landmark; the line names `source`.
    """
    columns: dict[str, list[Any]] = {name: [] for name in LANDMARK_DTYPE.names or ()}
    values: dict[str, int] = {}
    sources: dict[str, int] = {}
    try:
        for row in rows:
            columns["kind"].append(LANDMARK_KINDS.index(row["kind"]))
            columns["value"].append(values.setdefault(str(row["value"]), len(values)))
            columns["source"].append(sources.setdefault(str(row.get("source") or source), len(sources)))
            columns["position"].append([np.nan] * 3 if row.get("position") is None else [float(v) for v in row["position"]])
            columns["confidence"].append(1.0 if row.get("confidence") is None else float(row["confidence"]))
            for name in WHOLE:
                columns[name].append(-1 if row.get(name) is None else int(row[name]))
            for name in ("sigma", "number", "time"):
                columns[name].append(np.nan if row.get(name) is None else float(row[name]))
        table = np.zeros(len(columns["kind"]), LANDMARK_DTYPE)
        for name, column in columns.items():
            if column:
                table[name] = column
    except InputError:  # of what makes the rows
        raise
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        reason = " ".join(str(error).split())[:100]
        raise InputError(f"{source}: landmark {len(columns['kind'])} is damaged ({reason}); write it again") from error
    return clean_landmarks(Landmarks(table, tuple(values), tuple(sources)))


RADIO_COLUMNS = {
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
    from topomerge.io.trajectory import read_trajectory

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
    from topomerge.io.trajectory import LONGEST_GAP

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
    """Return the columns of time, address and dBm by their names; empty where one of them is not named."""
    names = [word.lower() for word in header]
    found = [next((names.index(n) for n in possible if n in names), -1) for possible in RADIO_COLUMNS.values()]
    return found if min(found) >= 0 else []
