"""The plan of a bent map, drawn back column by column: what a pose is judged by once the maps are bent."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from topomerge.extraction.plans.storey_plan import StoreyPlan
from topomerge.types import Array


def bent_plan(plan: StoreyPlan, forward: Callable[[Array], Array], back: Callable[[Array], Array]) -> StoreyPlan:
    """The plan after its columns were moved.

    Args:
        forward, back: places (n, 2) -> where they are moved to, and from where; inverses of each other.
    """
    nx, ny = plan.wall.shape
    rim = np.concatenate([_line((0, 0), (nx, 0)), _line((nx, 0), (nx, ny)), _line((nx, ny), (0, ny)), _line((0, ny), (0, 0))])
    rim = forward(plan.origin + rim * plan.edge)
    low = np.floor((rim.min(axis=0) - plan.origin) / plan.edge).astype(np.int64)
    high = np.ceil((rim.max(axis=0) - plan.origin) / plan.edge).astype(np.int64)
    shape = np.maximum(high - low, 1)
    origin = plan.origin + low * plan.edge
    columns = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), axis=-1).reshape(-1, 2)
    middles = origin + (columns + 0.5) * plan.edge
    source = np.floor((back(middles) - plan.origin) / plan.edge).astype(np.int64)
    inside = np.asarray(((source >= 0) & (source < (nx, ny))).all(axis=1))
    i, j = np.where(inside[:, None], source, 0).T

    def drawn(raster: Array, outside: float | bool | int) -> Array:
        return np.where(inside, raster[i, j], np.asarray(outside, raster.dtype)).reshape(shape)

    base = float(np.nanmedian(plan.floor)) if np.isfinite(plan.floor).any() else 0.0
    top = drawn(plan.top, np.inf) if isinstance(plan.top, np.ndarray) else plan.top
    return replace(
        plan, origin=origin, wall=drawn(plan.wall, False), inside=drawn(plan.inside, False), profile=drawn(plan.profile, 0),
        floor=drawn(plan.floor, base), ceiling=drawn(plan.ceiling, np.nan), top=top,
    )  # fmt: skip


def _line(begin: tuple[int, int], end: tuple[int, int]) -> Array:
    """Points every column from a corner to the next one."""
    many = max(abs(end[0] - begin[0]), abs(end[1] - begin[1]), 1)
    out: Array = np.linspace(begin, end, many + 1)
    return out
