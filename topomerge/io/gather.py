"""From the pieces of a reader to clouds of a wanted size: placed, cleaned, judged."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from topomerge.errors import InputError
from topomerge.io import frame
from topomerge.io.checks import Sample, warn_about
from topomerge.io.piece import Piece
from topomerge.types import Array, PointCloud, TrueRoom, VoxelGrid

BEYOND = 1e30  # m; larger values are as good as infinite, and float32 ends at 3e38


@dataclass(frozen=True)
class _Part:
    """Placed points with what belongs to each."""

    points: Array
    colors: Array | None = None
    labels: Array | None = None
    pose_of: Array | None = None
    intensities: Array | None = None

    def at(self, rows: Array | slice) -> _Part:
        values = (self.points, self.colors, self.labels, self.pose_of, self.intensities)
        return _Part(*(None if v is None else v[rows] for v in values))  # type: ignore[arg-type]


def _join(parts: list[_Part]) -> _Part:
    """All parts as one and nothing left in the list. What a part lacks is black, without room, pose or intensity."""
    if len(parts) == 1:
        return parts.pop()
    rows = [len(p.points) for p in parts]
    columns: list[Array | None] = []
    for name, blank in (("points", 0), ("colors", 0), ("labels", -1), ("pose_of", -1), ("intensities", np.nan)):
        values = [getattr(p, name) for p in parts]
        present = next((v for v in values if v is not None), None)
        if present is None:
            columns.append(None)
            continue
        shape, kind = present.shape[1:], present.dtype
        full = (np.full((n, *shape), blank, kind) if v is None else v for v, n in zip(values, rows, strict=True))
        columns.append(np.concatenate(list(full)))
    parts.clear()
    return _Part(*columns)  # type: ignore[arg-type]


class Gatherer:
    """Collects pieces of one file and hands out clouds.

    Args:
        source: path of the file, for the clouds and for errors.
        up: axis of the file that points up; None: the format states its own unit and z is up.
        factor: metres per unit of the file.
        chunk: points a cloud.
        warnings: what is already known to be said about the file.
    """

    def __init__(self, source: str, up: str | None, factor: float, chunk: int, warnings: list[str]) -> None:
        self.source, self.up, self.factor, self.chunk = source, up, factor, chunk
        self.rotation = frame.turn(up or "z")
        self.shift: Array | None = None
        self.warnings = list(warnings)
        self.sample = Sample()
        self.dropped = 0
        self.parts: list[_Part] = []
        self.size = 0
        self.poses: Array | None = None
        self.free: VoxelGrid | None = None
        self.rooms: tuple[TrueRoom, ...] = ()
        self.pending: PointCloud | None = None  # the last full cloud, held back because the last one carries the warnings

    def add(self, piece: Piece) -> Iterator[PointCloud]:
        """Take a piece in; yields the clouds that are now complete."""
        self._note(piece)
        if len(piece.points):
            part = self._place(piece)
            self.parts.append(part)
            self.size += len(part.points)
        while self.size >= self.chunk:
            joined = _join(self.parts)
            if self.size > self.chunk:
                self.parts.append(joined.at(slice(self.chunk, None)))
            self.size -= self.chunk
            yield from self._hand_out(joined.at(slice(None, self.chunk)))

    def finish(self) -> Iterator[PointCloud]:
        """The clouds that are left; the last one carries all warnings."""
        if self.size:
            yield from self._hand_out(_join(self.parts))
        if self.pending is None:
            lost = f"; all {self.dropped:,} are not finite" if self.dropped else ""
            raise InputError(f"{self.source}: holds no points{lost}; export it again")
        if self.dropped:
            self.warnings.append(f"{self.dropped:,} points were not finite and are left out")
        self.warnings += warn_about(self.sample.points, self.up)
        yield replace(self.pending, warnings=tuple(dict.fromkeys(self.warnings)))

    def _note(self, piece: Piece) -> None:
        """Keep what a piece says about the whole file."""
        self.warnings += piece.warnings
        self.rooms += frame.place_rooms(piece.rooms, self.factor)
        if piece.poses is not None:
            placed = frame.place_poses(piece.poses, self.rotation, self.factor)
            self.poses = placed if self.poses is None else np.concatenate([self.poses, placed])
        if piece.free is not None and len(piece.free):
            self.free = frame.place_grid(piece.free, self.rotation, self.factor)

    def _place(self, piece: Piece) -> _Part:
        points = frame.place_points(piece.points, self.rotation, self.factor)
        part = _Part(points, piece.colors, piece.labels, piece.pose_of, piece.intensities)
        if not (points.min() > -BEYOND and points.max() < BEYOND):  # so of nan, too
            finite = np.asarray((np.abs(points) < BEYOND).all(axis=1))
            self.dropped += int(len(points) - finite.sum())
            part = part.at(finite)
        if self.shift is None and len(part.points):
            self.shift = frame.choose_shift(part.points)
        self.sample.add(part.points)
        shift = np.zeros(3) if self.shift is None else self.shift
        return replace(part, points=(part.points - shift).astype(np.float32))

    def _hand_out(self, part: _Part) -> Iterator[PointCloud]:
        assert self.shift is not None
        cloud = PointCloud(
            part.points, self.shift, part.colors, part.labels, self.poses, part.pose_of, self.free, self.rooms, self.source
        )
        cloud = replace(cloud, intensities=part.intensities, upright=self.up is None)
        self.free, self.rooms = None, ()
        if self.pending is not None:
            yield self.pending
        self.pending = cloud
