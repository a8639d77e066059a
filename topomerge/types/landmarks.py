"""Landmarks of a map, beside its walls: signs, tags, readings of radio and pressure, objects and names of rooms."""

from __future__ import annotations

import unicodedata
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from topomerge.types.grid import Array, Sim3, require

LANDMARK_KINDS = ("text", "tag", "radio", "pressure", "object", "name", "use", "area")  # of a room: what it is for, its area
MOST_LANDMARKS = 2_000_000  # of a map: a walk of a day reads radio a million times
LONGEST_VALUE = 200  # characters of a text, a tag, an address, a class or a name
FARTHEST = 1e9  # m, of a coordinate
LANDMARK_DTYPE = np.dtype(
    [
        ("kind", "u1"),  # index into LANDMARK_KINDS
        ("value", "i4"),  # index into `values`: the text, the tag, the address of an access point, the class, the name
        ("position", "f8", 3),  # in the input's frame; nan: not known
        ("sigma", "f8"),  # m, of the position in the plane; nan: not known
        ("room", "i4"),  # in which it is, whose door it is at, or that bears the name; -1: not known
        ("storey", "i4"),  # -1: not known
        ("confidence", "f8"),  # that it was read right: 0..1
        ("number", "f8"),  # dBm of radio, hPa of pressure; heading of a tag or sign, rad; nan: none
        ("group", "i4"),  # readings of one moment have one number; -1: none
        ("time", "f8"),  # s, of the source's clock; nan: not known
        ("source", "i4"),  # index into `sources`
    ]
)


@dataclass(frozen=True, eq=False)
class Landmarks:
    """Landmarks of a map.

    Args:
        table: (n,) LANDMARK_DTYPE.
        values: the strings that `table["value"]` counts.
        sources: where they come from, that `table["source"]` counts: a reader, a file or "by hand".
    """

    table: Array = field(default_factory=lambda: np.zeros(0, LANDMARK_DTYPE))
    values: tuple[str, ...] = ()
    sources: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        require(self.table.dtype == LANDMARK_DTYPE and self.table.ndim == 1, "landmarks must have LANDMARK_DTYPE")
        for column, most in (("kind", len(LANDMARK_KINDS)), ("value", len(self.values)), ("source", len(self.sources))):
            number = self.table[column]
            require(not len(number) or (number.min() >= 0 and int(number.max()) < most), f"a landmark's {column} does not exist")

    def __len__(self) -> int:
        return len(self.table)

    def is_kind(self, *kinds: str) -> Array:
        """Return (n,) bool: is it of one of these kinds?"""
        return np.isin(self.table["kind"], [LANDMARK_KINDS.index(kind) for kind in kinds])

    def get_values(self) -> Array:
        """Return (n,) object array: the string of each."""
        return np.array([*self.values, ""], object)[self.table["value"]]

    def select(self, rows: Array) -> Landmarks:
        """Return some of them, by an index or a mask (n,); strings stay as they are counted."""
        return replace(self, table=self.table[rows])


def build_landmarks(
    kind: str,
    values: Sequence[str],
    source: str,
    position: Array | None = None,
    **columns: Array | float | int,
) -> Landmarks:
    """Build landmarks of one kind.

    Args:
        kind: one of LANDMARK_KINDS.
        values: (n) strings.
        source: where they come from.
        position: (n, 3) m, or None: not known.
        columns: others of LANDMARK_DTYPE, one value or (n,); what is left out is not known, and confidence 1.

    Raises:
        ValueError: an unknown kind.
    """
    require(kind in LANDMARK_KINDS, f"kind must be one of {', '.join(LANDMARK_KINDS)}, not {kind!r}")
    table = np.zeros(len(values), LANDMARK_DTYPE)
    names = tuple(dict.fromkeys(values))
    number = {name: i for i, name in enumerate(names)}
    table["kind"] = LANDMARK_KINDS.index(kind)
    table["value"] = [number[value] for value in values]
    table["position"] = np.nan if position is None else position
    for column in ("room", "storey", "group"):
        table[column] = -1
    for column in ("sigma", "number", "time"):
        table[column] = np.nan
    table["confidence"] = 1.0
    for column, value in columns.items():
        table[column] = value
    return Landmarks(table, names, (source,))


def join_landmarks(parts: Iterable[Landmarks]) -> Landmarks:
    """Join landmarks of one frame into one list, in their order; equal strings are counted once."""
    values: dict[str, int] = {}
    sources: dict[str, int] = {}
    tables = [np.zeros(0, LANDMARK_DTYPE)]
    for part in parts:
        if not len(part):
            continue
        table = part.table.copy()
        table["value"] = np.array([values.setdefault(v, len(values)) for v in part.values], np.int32)[table["value"]]
        table["source"] = np.array([sources.setdefault(s, len(sources)) for s in part.sources], np.int32)[table["source"]]
        tables.append(table)
    return Landmarks(np.concatenate(tables), tuple(values), tuple(sources))


def move_landmarks(landmarks: Landmarks, pose: Sim3) -> Landmarks:
    """Carry landmarks into another frame: positions, their uncertainty, and headings of tags and signs."""
    return transform_landmarks(landmarks, pose.apply, pose.yaw, pose.scale)


def transform_landmarks(
    landmarks: Landmarks, transform: Callable[[Array], Array], yaw: float = 0.0, scale: float = 1.0
) -> Landmarks:
    """Carry landmarks into another frame by a function of positions.

    Args:
        landmarks: any.
        transform: (n, 3) m -> (n, 3) m; is given the positions that are known.
        yaw: rad, by which headings of tags and signs turn.
        scale: of the uncertainty of positions.
    """
    table = landmarks.table.copy()
    known = np.isfinite(table["position"][:, :2]).all(axis=1)  # some readers know no heights: these stay unknown
    flat = known & np.isnan(table["position"][:, 2])
    places = table["position"].copy()
    places[flat, 2] = 0.0
    table["position"][known] = transform(places[known])
    table["position"][flat, 2] = np.nan
    table["sigma"] *= scale
    turned = landmarks.is_kind("tag", "text")
    table["number"][turned] = (table["number"][turned] + yaw + np.pi) % (2 * np.pi) - np.pi
    return replace(landmarks, table=table)


def clean_landmarks(landmarks: Landmarks) -> Landmarks:
    """Return landmarks that a map can keep: what a stranger's file says is bounded, and what is no number is not known.

    Strings are one printable line of `LONGEST_VALUE` characters at most. A position of which a coordinate is not finite or beyond
    `FARTHEST` is not known. Confidences are 0 to 1. Signs, tags, objects and names without a string are left out.
    """
    values, sources = (tuple(map(_clean_string, strings)) for strings in (landmarks.values, landmarks.sources))
    table = landmarks.table.copy()
    table["position"][~(np.abs(table["position"]) <= FARTHEST).all(axis=1)] = np.nan
    table["sigma"][~((table["sigma"] >= 0) & (table["sigma"] <= FARTHEST))] = np.nan
    for column in ("number", "time"):
        table[column][~np.isfinite(table[column])] = np.nan
    table["confidence"] = np.clip(np.nan_to_num(table["confidence"], nan=0.0), 0, 1)
    for column in ("room", "storey", "group"):
        table[column] = np.maximum(table[column], -1)
    empty = np.array([not value for value in (*values, "")])[table["value"]]
    kept = ~empty | landmarks.is_kind("radio", "pressure")
    return Landmarks(table if kept.all() else table[kept], values, sources)


def _clean_string(value: str) -> str:
    if value.isprintable() and len(value) <= LONGEST_VALUE and value == value.strip():
        return value
    printable = "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in " ".join(value.split()))
    return printable[:LONGEST_VALUE].strip()


SHAPES = str.maketrans({"o": "0", "q": "0", "d": "0", "i": "1", "l": "1", "j": "1", "z": "2", "s": "5", "b": "8", "g": "9"})
LONGEST_FOLDED = 32  # characters that are compared


@lru_cache(maxsize=65536)
def fold_text(text: str) -> str:
    """Fold a string to what any reader should give: letters and digits alone, one character a class of shapes."""
    plain = unicodedata.normalize("NFKD", text[: 4 * LONGEST_FOLDED]).casefold()
    return "".join(c for c in plain if c.isalnum())[:LONGEST_FOLDED].translate(SHAPES)


def find_room_names(landmarks: Landmarks, rooms: int) -> list[str]:
    """Return (rooms) the name of each room: the surest of its names, without any its surest sign with a digit; "" without."""
    table, out = landmarks.table, [""] * rooms
    digit = np.array([*(any(c.isdigit() for c in value) for value in landmarks.values), False], bool)[table["value"]]
    rank = np.select([landmarks.is_kind("name"), landmarks.is_kind("text") & digit], [0, 1], 2)
    rows = np.flatnonzero((table["room"] >= 0) & (table["room"] < rooms) & (rank < 2))
    rows = rows[np.lexsort((rows, -table["confidence"][rows], rank[rows], table["room"][rows]))]
    named, first = np.unique(table["room"][rows], return_index=True)
    for room, value in zip(named.tolist(), table["value"][rows[first]].tolist(), strict=True):
        out[room] = landmarks.values[value]
    return out
