"""What a map holds beside its walls: signs, tags, readings of radio and pressure, objects and names of rooms."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from topomerge.types.grid import Array, Sim3, require

LANDMARK_KINDS = ("text", "tag", "radio", "pressure", "object", "name")
LEVEL = 0.5  # of a unit vector: its part along z up to which it has a heading
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


def transform_landmarks(landmarks: Landmarks, matrix: Array, scale: float = 1.0) -> Landmarks:
    """Carry landmarks into another frame by a motion (4, 4), which may also tilt them; a heading that is no longer level is lost.

    Args:
        landmarks: any.
        matrix: p -> R p + t; R may be `scale` times a rotation.
        scale: of lengths.
    """
    table = landmarks.table.copy()
    table["position"] = table["position"] @ matrix[:3, :3].T + matrix[:3, 3]
    table["sigma"] *= scale
    turned = landmarks.is_kind("tag", "text")
    heading = table["number"][turned]
    x, y, z = (np.stack([np.cos(heading), np.sin(heading), np.zeros(len(heading))], axis=1) @ matrix[:3, :3].T / scale).T
    table["number"][turned] = np.where(np.abs(z) <= LEVEL, np.arctan2(y, x), np.nan)
    return replace(landmarks, table=table)


def move_landmarks(landmarks: Landmarks, pose: Sim3) -> Landmarks:
    """Carry landmarks into another frame: positions, their uncertainty, and headings of tags and signs."""
    return transform_landmarks(landmarks, pose.matrix, pose.scale)
