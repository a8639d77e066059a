"""Checks of the maps that are to be merged, two or many, and warnings for the user."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from topomerge.edits.apply import load_corrected_map
from topomerge.errors import InputError
from topomerge.registration.posterior import find_threshold
from topomerge.registration.verify import load_model
from topomerge.types import TopometricMap

MERGE_SCALES = ("fixed", "free")
POSE_SOURCES = ("search", "rooms", "surfaces")
FEW_MAPS = 11  # of which each is registered with all others
# Among many strangers those that lie best lie well by chance (docs/adr/0019).
LINK_BELIEVED = (0.8, 0.9)  # of few maps; of more, where those that look most alike are sought out among many strangers
UNIT_SPAN = 300.0  # m, and
UNIT_RATIO = 30.0  # times the other map: a map that spans this is in another unit
UNIT_RATIO_MM = 300.0  # times the other map: in millimetres rather than centimetres
TALL_RATIO = 2.2  # times the height of the other's storeys: another unit, or a hall


def check_list(maps: object, taker: str) -> None:
    """Raise InputError for no list of two maps or more, as one map or a generator; `taker` is the function that was called."""
    if isinstance(maps, str) or not isinstance(maps, Sequence):
        raise InputError(f"{taker} takes a list of maps, not a {type(maps).__name__}; give it as {taker}([a, b])")
    if len(maps) < 2:
        raise InputError(f"{taker} takes two maps or more, {len(maps)} given; give another one")


def load_input(map: object) -> TopometricMap:
    """Return a map, read where it is a `.tmap` file.

    Raises:
        InputError: the file can't be read, or it is no map, as a cloud or the file of one.
    """
    if isinstance(map, str | Path) and Path(map).suffix.lower() == ".tmap":
        return load_corrected_map(map)
    if not isinstance(map, TopometricMap):
        name = str(map) if isinstance(map, str | Path) else type(map).__name__
        raise InputError(f"{name}: merge takes maps and .tmap files; make a map of points with extract")
    return map


def check_scale(scale: str) -> None:
    """Raise InputError for another word than those of `MERGE_SCALES`."""
    if scale not in MERGE_SCALES:
        raise InputError(f"scale must be {' or '.join(MERGE_SCALES)}, not {scale!r}")


def resolve_threshold(threshold: float | None) -> float:
    """Return the probability from which a merge is believed; that of the calibration if None.

    Raises:
        InputError: not between 0 and 1.
    """
    share = float(load_model()["threshold"]) if threshold is None else float(threshold)
    if not 0 <= share <= 1:
        raise InputError(f"threshold must be a probability between 0 and 1, not {threshold}")
    return share


def resolve_link_threshold(threshold: float | None, maps: int = 2) -> float:
    """Return the probability from which a link of an atlas is believed: at least `LINK_BELIEVED` where none is asked for, as a
    wrong link drags all that hangs on it.

    Args:
        maps: how many the atlas holds.

    Raises:
        InputError: not between 0 and 1.
    """
    accepted = LINK_BELIEVED[maps > FEW_MAPS]
    return max(resolve_threshold(None), accepted) if threshold is None else resolve_threshold(threshold)


def find_risk_threshold(risk: float) -> float:
    """Return the probability from which a merge is believed so that at most `risk` of a thousand pairs, drawn by the stated
    priors (docs/method.md), are merged falsely, as left-out training pairs show it.

    Raises:
        InputError: a risk that no threshold can promise.
    """
    return find_threshold(float(risk), load_model()["risk"])


def check_poses(poses: str, count: int, scale: str) -> None:
    """Raise InputError for another word than those of `POSE_SOURCES`; without the search, there are two maps, and those whose
    surfaces are aligned are of one scale."""
    if poses not in POSE_SOURCES:
        raise InputError(f"poses must be {', '.join(POSE_SOURCES[:-1])} or {POSE_SOURCES[-1]}, not {poses!r}")
    if poses != "search" and count > 2:
        raise InputError("poses of rooms alone are for two maps; leave them out (--poses search)")
    if poses == "surfaces" and scale != "fixed":
        raise InputError("poses of surfaces are for two maps of one scale; take those of rooms (--poses rooms)")


@dataclass(frozen=True)
class Extent:
    """How large a map is.

    Args:
        source: of the map.
        cells: that are occupied.
        span: their diagonal seen from above, m.
        edge: of a cell, m.
    """

    source: str
    cells: int
    span: float
    edge: float

    @classmethod
    def from_map(cls, map: TopometricMap) -> Extent:
        """Return the extent of a map."""
        cells, edge = map.grid.cells, map.grid.edge
        return cls(map.source, len(cells), float(np.hypot(*np.ptp(cells[:, :2], axis=0))) * edge if len(cells) else 0.0, edge)


def check_cells(cells: int, name: str) -> None:
    """Raise InputError for a map without cells."""
    if not cells:
        raise InputError(f"{name}: has no occupied cells, nothing can be merged; extract it from another scan")


def is_same_scan(a: TopometricMap, b: TopometricMap) -> bool:
    """Tell whether two maps are of one scan: their cells are the same, whatever was corrected in them."""
    same = len(a.grid) == len(b.grid) and np.array_equal(a.grid.cells, b.grid.cells)
    return a is b or bool(same and np.allclose(a.grid.origin, b.grid.origin) and a.grid.edge == b.grid.edge)


def check_different(a: TopometricMap, b: TopometricMap) -> None:
    """Raise InputError where two maps are one."""
    if is_same_scan(a, b):
        name = b.source or "the second map"
        raise InputError(f"{name}: is the same map as {a.source or 'the first'}; give two different maps")


def check_units(one: TopometricMap | Extent, other: TopometricMap | Extent) -> None:
    """Raise InputError where a map is far larger than any neighbour of the other: it is in centimetres or millimetres."""
    a, b = (m if isinstance(m, Extent) else Extent.from_map(m) for m in (one, other))
    spans = [a.span, b.span]
    large, small = (a, b) if a.span >= b.span else (b, a)
    ratio = max(spans) / max(min(spans), small.edge)
    if max(spans) > UNIT_SPAN and ratio > UNIT_RATIO:
        unit = "mm" if ratio > UNIT_RATIO_MM else "cm"
        wide = f"{large.source or 'one map'}: spans {max(spans):,.0f} m, {small.source or 'the other'} {min(spans):,.0f} m"
        raise InputError(f"{wide}: the units seem to differ; extract it with --unit {unit}")


def check_pair(a: TopometricMap, b: TopometricMap, scale: str) -> None:
    """Check all that is asked of two maps.

    Raises:
        InputError: a map without cells, one map twice, maps in different units.
    """
    for map, name in ((a, "the first map"), (b, "the second map")):
        check_cells(len(map.grid), map.source or name)
    check_different(a, b)
    if scale == "fixed":
        check_units(a, b)


def iter_pair_warnings(a: TopometricMap, b: TopometricMap, scale: str) -> Iterator[str]:
    """Yield warnings about two maps that are to be merged."""
    for map, name in ((a, "the first map"), (b, "the second map")):
        if len(map.rooms) == 0:
            yield format_no_rooms_warning(map.source or name)
        elif len(map.rooms) == 1:
            yield f"{map.source or name}: has one room: little can be compared"
    heights = [_estimate_storey_height(m) for m in (a, b)]
    if scale == "fixed" and min(heights) > 0 and max(heights) > TALL_RATIO * min(heights):
        tall, low = (a, b) if heights[0] >= heights[1] else (b, a)
        names = tall.source or "one map", low.source or "the other"
        yield f"{names[0]}: storeys are {max(heights):.1f} m high, in {names[1]} {min(heights):.1f} m: the units may differ"


def format_no_rooms_warning(name: str) -> str:
    """Return the warning about a map without rooms."""
    return f"{name}: has no rooms: only walls and empty space can be compared"


def _estimate_storey_height(map: TopometricMap) -> float:
    """Estimate the median floor to ceiling, m; 0 where none was seen."""
    heights = map.storeys["ceiling"] - map.storeys["floor"]
    heights = heights[np.isfinite(heights)]
    return float(np.median(heights)) if len(heights) else 0.0
