"""Scans with the pose that each was taken from -> pieces of one cloud: points in the fixed frame, and whose ray met them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from topomerge.io.piece import BLOCK_POINTS, Piece
from topomerge.types import Array


@dataclass(frozen=True, eq=False)
class PosedScan:
    """What a sensor measured from one place.

    Args:
        points: (n, 3) in the sensor's frame, or in the fixed frame where they are `registered`.
        pose: (4, 4) of the sensor in the fixed frame; None: not known, and then the points are registered.
        colors: (n, 3) uint8.
        registered: the points stand in the fixed frame already; the pose only says where their rays start.
        done: share of all scans that are read.
    """

    points: Array
    pose: Array | None
    colors: Array | None = None
    registered: bool = False
    done: float = 0.0


def pieces(scans: Iterable[PosedScan], warnings: Iterable[str] = ()) -> Iterator[Piece]:
    """The scans as few large pieces, so that a long walk of small scans costs no more than one large one.

    Rays that met nothing (not finite, or at the sensor itself) are left out.

    Args:
        scans: in their order; read one at a time.
        warnings: what the user should know; asked for when all scans are read.
    """
    batch: list[PosedScan] = []
    size, before = 0, 0
    for scan in map(_placed, scans):
        batch.append(scan)
        size += len(scan.points)
        if size >= BLOCK_POINTS:
            yield _piece(batch, before)
            before += sum(s.pose is not None for s in batch)
            batch, size = [], 0
    if batch:
        yield _piece(batch, before)
    yield Piece(np.empty((0, 3)), warnings=tuple(warnings), done=1.0)


def _placed(scan: PosedScan) -> PosedScan:
    """The scan with its points in the fixed frame."""
    points = np.asarray(scan.points, np.float64)
    far = np.einsum("ij,ij->i", points, points)
    met = np.isfinite(far) & ((far > 0) | scan.registered)
    points, colors = (points, scan.colors) if met.all() else (points[met], None if scan.colors is None else scan.colors[met])
    if scan.pose is not None and not scan.registered:
        points = points @ scan.pose[:3, :3].T + scan.pose[:3, 3]
    return PosedScan(points, scan.pose, colors, True, scan.done)


def _piece(batch: list[PosedScan], before: int) -> Piece:
    """One piece of placed scans; `before` poses were handed over already."""
    poses = [s.pose for s in batch if s.pose is not None]
    numbers, number = [], before
    for scan in batch:
        numbers.append(np.full(len(scan.points), -1 if scan.pose is None else number, np.int32))
        number += scan.pose is not None
    colors = None
    if any(s.colors is not None for s in batch):
        colors = np.concatenate([np.zeros((len(s.points), 3), np.uint8) if s.colors is None else s.colors for s in batch])
    return Piece(
        np.concatenate([s.points for s in batch]),
        colors,
        poses=np.stack(poses) if poses else None,
        pose_of=np.concatenate(numbers) if poses or before else None,
        done=batch[-1].done,
    )
