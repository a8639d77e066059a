"""Two maps as pieces that are moved onto each other, step by step; all moves are in the frame of map a (method 4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from topomerge.fusion.bend.deformation import Deformation
from topomerge.fusion.bend.drift import Drift
from topomerge.fusion.bend.graph import Joints, Measurements, Settled, settle
from topomerge.fusion.bend.local import Target, Window, measure
from topomerge.fusion.bend.pieces import PIECE_SIZE, Pieces
from topomerge.fusion.prepared import Prepared
from topomerge.matching.refinement import storeys_at
from topomerge.types import Array, Sim3

RIGID_PRIOR = (1.0, 1.0, float(np.radians(3.0)), 0.05)  # m, m, rad, logarithm of the scale: of the mended pose
PIECE_PRIOR = (1.0, 1.0, float(np.radians(3.0)), 0.02)
SCALE_DRIFT = 0.003  # logarithm of the scale per square root of a metre
LEAST_DRIFT = 1e-4  # m and rad, of a joint
NEIGHBOURS = 4  # pieces of the other map that say how it is bent at a place
REACH = 0.6 * PIECE_SIZE


class Alignment:
    """Two maps with their pieces, moved onto each other step by step; all moves are in the frame of map a."""

    def __init__(self, a: Prepared, b: Prepared, pose: Sim3, scaled: bool) -> None:
        self.maps, self.pose, self.scaled = (a, b), pose, scaled
        self.pieces = (a.pieces, b.pieces)
        self.storeys = (a.storeys, b.storeys)
        self.targets: dict[int, Target] = {}
        self.moves = [np.zeros((len(p), 4)) for p in self.pieces]
        self.weights = np.zeros(0)

    def anchors(self, side: int) -> Array:
        """(n, 2) m, in the frame of a."""
        at = self.pieces[side].anchors
        return at if side == 0 else flat(self.pose, at)

    def matched(self) -> list[tuple[int, int]]:
        """Storeys of a and of b on one level."""
        pairs = storeys_at(*self.storeys, self.pose.translation[2], self.pose.scale)
        places = [{id(s): k for k, s in enumerate(storeys)} for storeys in self.storeys]
        return [(places[0][id(v)], places[1][id(w)]) for v, w in pairs]

    def shares(self, side: int, chosen: Array) -> tuple[Array, Array]:
        """(m, NEIGHBOURS) pieces of the other map around the chosen ones, and their shares."""
        other = self.pieces[1 - side]
        here, there = self.anchors(side)[chosen], self.anchors(1 - side)
        many = min(NEIGHBOURS, len(there))
        out, shares = np.zeros((len(chosen), many), np.int64), np.zeros((len(chosen), many))
        for i, j in self.matched():
            mine, theirs = (i, j) if side == 0 else (j, i)
            rows = np.flatnonzero(self.pieces[side].storey[chosen] == mine)
            near = np.flatnonzero(other.storey == theirs)
            if not len(rows) or not len(near):
                continue
            q = min(many, len(near))
            distance, nearest = cKDTree(there[near]).query(here[rows], q)
            distance, nearest = distance.reshape(len(rows), q), nearest.reshape(len(rows), q)
            weight = np.exp(-(distance**2 - distance[:, :1] ** 2) / (2 * REACH**2))
            out[rows, :q], shares[rows, :q] = near[nearest], weight / weight.sum(axis=1, keepdims=True)
        return out, shares

    def relative(self, side: int) -> Array:
        """(n, 3) moves of the pieces of a map against the other one, in the frame of a."""
        chosen = np.arange(len(self.pieces[side]))
        others, shares = self.shares(side, chosen)
        here, there = self.anchors(side), self.anchors(1 - side)
        out = self.moves[side][:, :3].copy()
        for k in range(others.shape[1]):
            move, gap = self.moves[1 - side][others[:, k]], here - there[others[:, k]]
            x = move[:, 0] - move[:, 2] * gap[:, 1] + move[:, 3] * gap[:, 0]
            y = move[:, 1] + move[:, 2] * gap[:, 0] + move[:, 3] * gap[:, 1]
            out -= shares[:, k : k + 1] * np.column_stack([x, y, move[:, 2]])
        return out

    def frames(self, side: int) -> tuple[Sim3, Array]:
        """The pose that brings a map into the frame of the other one, and the matrix (3, 3) that brings moves in the frame of a
        into its own."""
        into = self.pose.inverse() if side == 0 else self.pose
        own = np.eye(3)
        if side == 1:
            own[:2, :2] = self.pose.inverse().matrix[:2, :2]
        return into, own

    def by_plan(self, side: int, window: Window) -> Measurements:
        """The pieces of a map registered on the plan of the other one."""
        pieces, (into, own) = self.pieces[side], self.frames(side)
        start = self.relative(side) @ own.T
        numbers, moves, information = [], [], []
        for i, j in self.matched():
            mine, theirs = (i, j) if side == 0 else (j, i)
            chosen = np.flatnonzero(pieces.storey == mine)
            fields = self.storeys[1 - side][theirs]
            if not len(chosen) or not len(fields.walls):
                continue
            target = self.targets.setdefault(id(fields), Target(fields))
            mean, certain = measure(pieces, self.maps[side].samples, chosen, start, into, target, window)
            numbers.append(chosen)
            moves.append(mean)
            information.append(certain)
        return self._measurements(side, own, numbers, moves, information)

    def by_surfaces(self, side: int) -> Measurements:
        """The pieces of a map registered on the surfaces of the other one."""
        into, own = self.frames(side)
        start = self.relative(side) @ own.T
        parts = self.maps[side].piece_surfaces.measure(start, into, self.maps[1 - side].surface)
        numbers, moves, information = ([part] for part in parts)
        return self._measurements(side, own, numbers, moves, information)

    def _measurements(
        self, side: int, own: Array, numbers: Sequence[Array], moves: Sequence[Array], information: Sequence[Array]
    ) -> Measurements:
        """Moves in a map's own frame as measurements in that of a. Information counts half: both maps see the same walls."""
        common = np.linalg.inv(own)
        chosen = np.concatenate([np.zeros(0, np.int64), *numbers])
        others, shares = self.shares(side, chosen)
        move = np.concatenate([np.zeros((0, 3)), *moves]) @ common.T
        certain = own.T @ np.concatenate([np.zeros((0, 3, 3)), *information]) @ own / 2
        return Measurements(chosen, self.anchors(side)[chosen], others, shares, move, certain)

    def mend_pose(self, window: Window) -> None:
        """The rigid pose that the pieces agree on best."""
        parts = [self.by_plan(side, window) for side in (0, 1)]
        places = np.concatenate([p.places for p in parts])
        if not len(places):
            return
        moves = np.concatenate([-parts[0].moves, parts[1].moves])
        information = np.concatenate([p.information for p in parts])
        nobody = np.zeros((len(places), 0))
        whole = Measurements(np.zeros(len(places), np.int64), places, nobody.astype(np.int64), nobody, moves, information)
        middle = places.mean(axis=0, keepdims=True)
        prior = np.array([[*RIGID_PRIOR[:3], RIGID_PRIOR[3] if self.scaled else 0.0]])
        none = Joints(np.zeros((0, 2), np.int64), np.zeros((0, 4)))
        x, y, turn, size = settle(middle, none, whole, prior).moves[0].tolist()
        about = Sim3(turn, (0.0, 0.0, 0.0), float(np.exp(size)))
        at = middle[0] + (x, y) - flat(about, middle)[0]
        moved = Sim3(turn, (float(at[0]), float(at[1]), 0.0), float(np.exp(size))) @ self.pose
        self.pose = replace(moved, translation=(*moved.translation[:2], self.pose.translation[2]))

    def settle(self, parts: Sequence[Measurements], drift: tuple[Drift, Drift]) -> Settled:
        """Move all pieces by what was measured of those of both maps."""
        first = len(self.pieces[0])
        anchors = np.concatenate([self.anchors(0), self.anchors(1)])
        offset = (0, first)
        measured = Measurements(
            np.concatenate([p.piece + offset[k] for k, p in enumerate(parts)]),
            np.concatenate([p.places for p in parts]),
            _padded([p.others + offset[1 - k] for k, p in enumerate(parts)]),
            _padded([p.shares for p in parts]),
            np.concatenate([p.moves for p in parts]),
            np.concatenate([p.information for p in parts]),
        )
        sizes = (1.0, self.pose.scale)
        sigma = [_joint_sigma(p, d, s, self.scaled) for p, d, s in zip(self.pieces, drift, sizes, strict=True)]
        joints = Joints(np.concatenate([self.pieces[0].joints, self.pieces[1].joints + first]), np.concatenate(sigma))
        prior = [_prior(p, d, self.scaled and k == 1) for k, (p, d) in enumerate(zip(self.pieces, drift, strict=True))]
        settled = settle(anchors, joints, measured, np.concatenate(prior))
        self.moves = [settled.moves[:first], settled.moves[first:]]
        return settled

    def deformation(self, side: int, covariance: Array) -> Deformation:
        """The moves of one map in its own frame.

        Args:
            covariance: (n, 3, 3) in the frame of a.
        """
        pieces, moves, (_, own) = self.pieces[side], self.moves[side].copy(), self.frames(side)
        moves[:, :2] = moves[:, :2] @ own[:2, :2].T
        floors = np.array([f.plan.floor_guess for f in self.storeys[side]])
        return Deformation(
            pieces.anchors, pieces.storey, floors, moves, own @ covariance @ own.T, pieces.room.astype(np.int32), REACH
        )


def _padded(parts: list[Array]) -> Array:
    wide = max(p.shape[1] for p in parts)
    return np.concatenate([np.pad(p, ((0, 0), (0, wide - p.shape[1]))) for p in parts])


def _joint_sigma(pieces: Pieces, drift: Drift, scale: float, scaled: bool) -> Array:
    root = np.sqrt(pieces.lengths * scale)[:, None]
    size = SCALE_DRIFT if scaled else LEAST_DRIFT
    steps = np.array([[drift.shift, drift.shift, drift.turn, size]])
    return np.maximum(root * steps, LEAST_DRIFT)


def _prior(pieces: Pieces, drift: Drift, scaled: bool) -> Array:
    prior = np.array([0.0] * 4 if drift.rigid else [*PIECE_PRIOR[:3], PIECE_PRIOR[3] if scaled else 0.0])
    return np.tile(prior, (len(pieces), 1))


def flat(pose: Sim3, points: Array) -> Array:
    """Points (n, 2) under a pose, seen from above."""
    return pose.apply(np.column_stack([points, np.zeros(len(points))]))[:, :2]
