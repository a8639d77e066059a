"""Edits, and the journal that holds them: one line of JSON each, in a file beside the map (`a.tmap`: `a.edits.jsonl`).

Places are in metres in the frame of the map, so that edits can be replayed on a map that was extracted again. A journal only
grows: taking back an edit is a line, too.
"""

from __future__ import annotations

import json
import logging
import math
import os
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any

import numpy as np

from topomerge.archive import convert_to_plain
from topomerge.errors import InputError
from topomerge.types import LANDMARK_KINDS, LONGEST_VALUE, Sim3

JOURNAL_SUFFIX = ".edits.jsonl"
MOST_EDITS, LONGEST_LINE = 100_000, 1 << 16  # lines of a journal, bytes of a line
MOST_PLACES = 1000  # of one edit
FARTHEST = 1e9  # m, of a coordinate
WIDEST = 1000.0  # m, of a door
LONGEST_PATH = 4096  # characters
LONGEST_WORD = 64  # characters of an id, a time or a name of an author
log = logging.getLogger(__name__)

Check = Callable[[Any], bool]


def _is_number(value: Any, low: float = -FARTHEST, high: float = FARTHEST) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value) and low <= value <= high


def _is_place(value: Any, size: int = 3) -> bool:
    return isinstance(value, list) and len(value) == size and all(map(_is_number, value))


def _are_places(value: Any, least: int = 2, size: int = 3) -> bool:
    return isinstance(value, list) and least <= len(value) <= MOST_PLACES and all(_is_place(place, size) for place in value)


def _is_text(value: Any, longest: int = LONGEST_VALUE, least: int = 1) -> bool:
    return isinstance(value, str) and least <= len(value.strip()) == len(value) <= longest and value.isprintable()


def _is_pair(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(map(_is_index, value)) and value[0] < value[1]


def _is_index(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < MOST_EDITS


def _is_pose(value: Any) -> bool:
    if not (isinstance(value, list) and len(value) == 4 and all(_is_place(row, 4) for row in value)):
        return False
    try:
        Sim3.from_matrix(np.array(value, float))
    except ValueError:
        return False
    return True


# What a field may hold: how it is checked, and what is said of it.
PLACE: tuple[Check, str] = (_is_place, "[x, y, z] in m")
PLACES: tuple[Check, str] = (_are_places, "two or more [x, y, z] in m")
ANY_PLACES: tuple[Check, str] = (lambda v: _are_places(v, 1), "one or more [x, y, z] in m")
TWO_PLACES: tuple[Check, str] = (lambda v: _are_places(v) and len(v) == 2, "two [x, y, z] in m")
LINE: tuple[Check, str] = (lambda v: _are_places(v, 2, 2), "two or more [x, y] in m")
WIDTH: tuple[Check, str] = (lambda v: _is_number(v, 1e-3, WIDEST), "m above 0")
HEIGHT: tuple[Check, str] = (lambda v: _is_number(v, -WIDEST, WIDEST), "m above the floor")
FLAG: tuple[Check, str] = (lambda v: isinstance(v, bool), "true or false")
STATE: tuple[Check, str] = (lambda v: v is None or isinstance(v, bool), "true, false or null")
TEXT: tuple[Check, str] = (_is_text, f"a line of 1 to {LONGEST_VALUE} characters")
NAME: tuple[Check, str] = (lambda v: _is_text(v, least=0), f"a line of at most {LONGEST_VALUE} characters")
KIND: tuple[Check, str] = (lambda v: v in LANDMARK_KINDS, f"one of {', '.join(LANDMARK_KINDS)}")
WORD: tuple[Check, str] = (lambda v: _is_text(v, LONGEST_WORD), f"a word of 1 to {LONGEST_WORD} characters")
PAIR: tuple[Check, str] = (_is_pair, "two numbers of maps, the smaller first")
INDEX: tuple[Check, str] = (_is_index, "the number of a map")
POSE: tuple[Check, str] = (_is_pose, "a 4x4 matrix that keeps the vertical")
SOURCES: tuple[Check, str] = (
    lambda v: isinstance(v, list) and len(v) == 2 and all(isinstance(name, str) and len(name) <= LONGEST_PATH for name in v),
    "the names of both files",
)
# The vocabulary: op -> its fields; a question mark stands after those that may be left out.
MAP_OPS: dict[str, dict[str, tuple[Check, str]]] = {
    "split_room": {"at": PLACE, "line": LINE},
    "join_rooms": {"at": PLACES},
    "add_door": {"at": PLACE, "width?": WIDTH, "open?": STATE, "between?": TWO_PLACES},
    "delete_door": {"at": PLACE},
    "move_door": {"at": PLACE, "to": PLACE, "between?": TWO_PLACES},
    "set_door": {"at": PLACE, "width?": WIDTH, "open?": STATE},
    "move_opening": {"at": PLACE, "to": PLACE},
    "set_opening": {"at": PLACE, "width?": WIDTH, "sill?": HEIGHT, "head?": HEIGHT},
    "delete_opening": {"at": PLACE},
    "rename_room": {"at": PLACE, "name": NAME},
    "set_room": {"at": PLACE, "kind?": NAME, "outside?": FLAG, "looked_into?": FLAG},
    "assign_area": {"at": ANY_PLACES, "area": NAME},
    "add_landmark": {"at": PLACE, "kind": KIND, "value": TEXT},
    "delete_landmark": {"at": PLACE, "kind?": KIND, "value?": TEXT},
}
MERGE_OPS: dict[str, dict[str, tuple[Check, str]]] = {  # of a folder of a merge
    "match_rooms": {"maps": PAIR, "at": TWO_PLACES, "sources?": SOURCES},
    "accept_merge": {"maps": PAIR, "matrix": POSE, "sources?": SOURCES},
    "reject_merge": {"maps": PAIR, "sources?": SOURCES},
    "place_map": {"map": INDEX, "matrix": POSE},
}
TAKE_BACK = ("undo", "redo")
OPS = {**MAP_OPS, **MERGE_OPS, **{op: {"edit": WORD} for op in TAKE_BACK}}
COMMON = {
    "id": WORD,
    "time": WORD,
    "by": (lambda v: _is_text(v, LONGEST_WORD, 0), f"at most {LONGEST_WORD} characters"),
    "op": WORD,
}


class ConflictError(InputError):
    """Somebody else has changed the journal since it was read; nothing was written.

    Args:
        path: of the journal.
        expected: version that the new edits were made for.
        version: that it has.
    """

    def __init__(self, path: str | Path, expected: int, version: int) -> None:
        self.expected, self.version = expected, version
        super().__init__(
            f"{path}: has {version} lines, and the edits were made when it had {expected}: somebody else has edited the map; "
            "read it again, and repeat what is missing"
        )


@dataclass(frozen=True)
class Edit:
    """One correction, a line of a journal.

    Args:
        op: what is done, one of `OPS`.
        values: the fields of the op.
        id: names the edit in the journal.
        time: when it was made, ISO 8601.
        by: who made it.

    Raises:
        InputError: an unknown op, or a field that is missing, unknown or none of its kind.
    """

    op: str
    values: Mapping[str, Any] = field(default_factory=dict)
    id: str = ""
    time: str = ""
    by: str = ""

    def __post_init__(self) -> None:
        if self.op not in OPS:
            raise InputError(f"op {str(self.op)[:40]!r}: is none; take one of {', '.join(OPS)}")
        fields = {name.removesuffix("?"): check for name, check in OPS[self.op].items()}
        for name in self.values:
            if name not in fields:
                raise InputError(f"{self.op} has no {str(name)[:40]!r}; it has {', '.join(fields)}")
        missing = [name for name in OPS[self.op] if not name.endswith("?") and name not in self.values]
        if missing:
            raise InputError(f"{self.op} lacks {missing[0]!r}: give {fields[missing[0]][1]}")
        common = {name: getattr(self, name) for name in ("id", "time") if getattr(self, name)} | {"by": self.by}
        for name, value in {**common, **self.values}.items():
            check, requirement = fields[name] if name in self.values else COMMON[name]
            if not check(value):
                raise InputError(f"{self.op}: {name} must be {requirement}, not {json.dumps(value, default=str)[:60]}")

    def to_json(self) -> dict[str, Any]:
        """Return plain values, in the order of a line."""
        return {"id": self.id, "time": self.time, "by": self.by, "op": self.op, **self.values}

    @staticmethod
    def from_json(listed: Any) -> Edit:
        """Read an edit of plain values.

        Raises:
            InputError: it is none.
        """
        if not isinstance(listed, dict) or not isinstance(listed.get("op"), str):
            raise InputError("is no edit: give an object with an op")
        values = {name: value for name, value in listed.items() if name not in COMMON}
        return Edit(listed["op"], values, *(listed.get(name, "") for name in ("id", "time", "by")))


def build_edit(op: str, by: str = "", **values: Any) -> Edit:
    """Build an edit of now, with a new id.

    Args:
        op: one of `OPS`.
        by: who makes it.
        values: the fields of the op; places as lists or arrays.

    Raises:
        InputError: as `Edit`.
    """
    return Edit(op, convert_to_plain(values), uuid.uuid4().hex[:16], datetime.now(UTC).isoformat(timespec="seconds"), by)


@dataclass(frozen=True)
class Journal:
    """The edits of a file.

    Args:
        path: of the file, which need not exist.
        edits: its lines.
        warnings: what was odd about it.
    """

    path: Path
    edits: tuple[Edit, ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def version(self) -> int:
        """Number of lines: two people who read the same one have read the same edits."""
        return len(self.edits)


def find_journal(path: str | Path) -> Path:
    """Find the journal of a map (`a.tmap`: `a.edits.jsonl` beside it) or of the folder of a merge (`merge.edits.jsonl` in it)."""
    place = Path(path)
    return place / f"merge{JOURNAL_SUFFIX}" if place.is_dir() else place.with_name(place.stem + JOURNAL_SUFFIX)


def read_journal(path: str | Path) -> Journal:
    """Read a journal; an empty one where there is no such file.

    A last line that a crash has cut off is left out, and told.

    Raises:
        InputError: a line is no edit; the line names it.
    """
    place = Path(path)
    try:
        data = place.read_bytes()
    except FileNotFoundError:
        return Journal(place)
    except OSError as error:
        raise InputError(f"{place}: can't be read ({error.strerror or error}); give the journal of a map") from error
    return _parse_journal(place, data)[0]


def _parse_journal(path: Path, data: bytes) -> tuple[Journal, int]:
    """Return a journal, and how many of its bytes are whole lines."""
    whole = data.rfind(b"\n") + 1
    lines, rest = data[:whole].splitlines(), data[whole:]
    if len(lines) > MOST_EDITS:
        raise InputError(f"{path}: has {len(lines):,} lines, more than {MOST_EDITS:,}; save the corrected map and begin anew")
    edits = [_parse_line(path, number, line) for number, line in enumerate(lines, 1)]
    warnings = []
    if rest.strip():
        warnings.append(f"{path}: line {len(lines) + 1} was cut off and is left out")
        log.warning("%s", warnings[0])
    ids: dict[str, int] = {}
    for number, edit in enumerate(edits, 1):
        if edit.id in ids:
            raise InputError(f"{path}: line {number}: has the id of line {ids[edit.id]}; give it another one")
        if edit.id:
            ids[edit.id] = number
    return Journal(path, tuple(edits), tuple(warnings)), whole


def _parse_line(path: Path, number: int, line: bytes) -> Edit:
    try:
        if len(line) > LONGEST_LINE:
            raise InputError(f"is longer than {LONGEST_LINE} bytes; leave it out")
        return Edit.from_json(json.loads(line))
    except InputError as error:
        raise InputError(f"{path}: line {number}: {error}") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: line {number}: is no JSON ({str(error)[:60]}); correct or remove it") from error


def append_edits(path: str | Path, edits: Sequence[Edit], expected_version: int | None = None) -> int:
    """Append edits to a journal: all of them, on the disk, or none.

    Others may append at the same time: a lock keeps them apart.

    Args:
        path: of the journal; it is made where there is none.
        edits: new ones.
        expected_version: of the journal that they were made for; None: any.

    Returns:
        The new version.

    Raises:
        ConflictError: the journal has another version.
        InputError: it is damaged, has one of the ids already, or can't be written.
    """
    place = Path(path)
    text = "".join(json.dumps(edit.to_json(), ensure_ascii=False, separators=(",", ":")) + "\n" for edit in edits).encode()
    try:
        with open(place, "a+b") as file, _lock(file):
            file.seek(0)
            journal, whole = _parse_journal(place, file.read())
            if expected_version is not None and expected_version != journal.version:
                raise ConflictError(place, expected_version, journal.version)
            if known := {edit.id for edit in edits if edit.id} & {edit.id for edit in journal.edits}:
                raise InputError(f"{place}: has the edit {min(known)} already; give each edit its own id")
            file.truncate(whole)
            try:
                file.write(text)
                file.flush()
                os.fsync(file.fileno())
            except OSError:
                file.truncate(whole)
                raise
            return journal.version + len(edits)
    except OSError as error:
        raise InputError(
            f"{place}: can't be written ({error.strerror or error}); give a folder that exists and is yours"
        ) from error


@contextmanager
def _lock(file: IO[bytes]) -> Iterator[None]:
    """Wait until no other process writes the file."""
    try:
        import fcntl
    except ImportError:  # Windows
        import msvcrt

        file.seek(0)
        msvcrt.locking(file.fileno(), msvcrt.LK_LOCK, 1)  # type: ignore[attr-defined]
        try:
            yield
        finally:
            file.seek(0)
            msvcrt.locking(file.fileno(), msvcrt.LK_UNLCK, 1)  # type: ignore[attr-defined]
        return
    fcntl.flock(file, fcntl.LOCK_EX)
    try:
        yield
    finally:
        fcntl.flock(file, fcntl.LOCK_UN)


def select_effective(edits: Iterable[Edit]) -> list[Edit]:
    """Return the edits that hold: those that were not taken back, in their order; without lines that take back."""
    edits = list(edits)
    undone = _find_undone(edits)
    return [edit for edit in edits if edit.op not in TAKE_BACK and edit.id not in undone]


def _find_undone(edits: Iterable[Edit]) -> dict[str, None]:
    """Return the ids of the edits that are taken back, in the order in which they were."""
    undone: dict[str, None] = {}
    for edit in edits:
        if edit.op == "undo":
            undone[edit.values["edit"]] = None
        elif edit.op == "redo":
            undone.pop(edit.values["edit"], None)
    return undone


def build_undo(edits: Sequence[Edit], by: str = "") -> Edit:
    """Build the line that takes back the last edit that holds.

    Raises:
        InputError: there is none.
    """
    held = [edit for edit in select_effective(edits) if edit.id]
    if not held:
        raise InputError("there is nothing to undo: no edit holds")
    return build_edit("undo", by, edit=held[-1].id)


def build_redo(edits: Sequence[Edit], by: str = "") -> Edit:
    """Build the line that restores the edit that was taken back last, if nothing was edited since.

    Raises:
        InputError: there is none.
    """
    since = 0
    for edit in reversed(edits):
        if edit.op not in TAKE_BACK:
            break
        since += 1
    undone = _find_undone(edits)
    recent = [edit.values["edit"] for edit in edits[len(edits) - since :] if edit.op == "undo" and edit.values["edit"] in undone]
    if not recent:
        raise InputError("there is nothing to redo: no edit was taken back last")
    return build_edit("redo", by, edit=list(undone)[-1])
