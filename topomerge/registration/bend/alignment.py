"""Maps as pieces that are moved onto each other, step by step; all moves are in one common frame (method 4)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from topomerge.matching.poses import pair_storeys
from topomerge.registration.bend.graph import Joints, Measurements, SettledMoves, settle
from topomerge.registration.bend.measure import Window, measure, measure_lines
from topomerge.registration.bend.pieces import PIECE_SIZE, Drift, Pieces
from topomerge.registration.prepared import Prepared
from topomerge.types import Array, Deformation, Sim3

RIGID_PRIOR = (1.0, 1.0, float(np.radians(3.0)), 0.05)  # m, m, rad, logarithm of the scale: of a mended pose
PIECE_PRIOR = (1.0, 1.0, float(np.radians(3.0)), 0.02)
SCALE_DRIFT = 0.003  # logarithm of the scale per square root of a metre
LEAST_SHARE = 0.25  # of the usual drift, that a map is taken to have at least
LEAST_DRIFT = 1e-4  # m and rad, of a joint
NEIGHBOURS = 4  # pieces of the other map that say how it is bent at a place
REACH = 0.6 * PIECE_SIZE
Pair = tuple[int, int]


class Alignment:
    """Maps with their pieces, and the pairs of them that see each other.

    Args:
        poses: of the maps in the common frame.
        pairs: numbers of two maps; pieces of each are registered on the other one.
        scaled: are the scales of all but the first map free?
    """

    def __init__(self, maps: Sequence[Prepared], poses: Sequence[Sim3], pairs: Sequence[Pair], scaled: bool) -> None:
        self.maps, self.poses, self.scaled = tuple(maps), list(poses), scaled
        self.pairs = [pair for i, j in pairs for pair in ((i, j), (j, i))]
        self.moves = [np.zeros((len(m.pieces), 4)) for m in maps]
        self.drift_shares = [np.ones(2) for _ in self.maps]  # of shift and turn
        self.registered = [np.zeros(len(m.pieces)) for m in maps]  # weight of what was measured of each piece last
        self.misfit = np.zeros(2)  # sums of weights, and of weighted squared distances of walls, m2
        self.first = np.cumsum([0, *(len(m.pieces) for m in maps)])

    def compute_anchors(self, k: int) -> Array:
        """Return (n, 2) m of the pieces of a map, in the common frame."""
        return transform_flat(self.poses[k], self.maps[k].pieces.anchors)

    def match_storeys(self, i: int, j: int) -> list[Pair]:
        """Return storeys of two maps on one level."""
        a, b = self.maps[i].storeys, self.maps[j].storeys
        pose = self.poses[i].inverse() @ self.poses[j]
        places = [{id(s): k for k, s in enumerate(storeys)} for storeys in (a, b)]
        return [(places[0][id(v)], places[1][id(w)]) for v, w in pair_storeys(a, b, pose.translation[2], pose.scale)]

    def compute_shares(self, i: int, j: int, chosen: Array) -> tuple[Array, Array]:
        """Return (m, NEIGHBOURS) pieces of map j around the chosen ones of map i, and their shares."""
        here, targets = self.compute_anchors(i)[chosen], self.compute_anchors(j)
        out, shares = np.zeros((len(chosen), NEIGHBOURS), np.int64), np.zeros((len(chosen), NEIGHBOURS))
        for mine, theirs in self.match_storeys(i, j):
            rows = np.flatnonzero(self.maps[i].pieces.storey[chosen] == mine)
            near = np.flatnonzero(self.maps[j].pieces.storey == theirs)
            if not len(rows) or not len(near):
                continue
            many = min(NEIGHBOURS, len(near))
            distance, nearest = (x.reshape(len(rows), many) for x in cKDTree(targets[near]).query(here[rows], many))
            weight = np.exp(-(distance**2 - distance[:, :1] ** 2) / (2 * REACH**2))
            out[rows, :many], shares[rows, :many] = near[nearest], weight / weight.sum(axis=1, keepdims=True)
        return out, shares

    def compute_relative_moves(self, i: int, j: int) -> Array:
        """Return (n, 3) moves of the pieces of map i against map j."""
        others, shares = self.compute_shares(i, j, np.arange(len(self.maps[i].pieces)))
        here, targets = self.compute_anchors(i), self.compute_anchors(j)
        out = self.moves[i][:, :3].copy()
        for k in range(NEIGHBOURS if len(targets) else 0):
            move, gap = self.moves[j][others[:, k]], here - targets[others[:, k]]
            x = move[:, 0] - move[:, 2] * gap[:, 1] + move[:, 3] * gap[:, 0]
            y = move[:, 1] + move[:, 2] * gap[:, 0] + move[:, 3] * gap[:, 1]
            out -= shares[:, k : k + 1] * np.column_stack([x, y, move[:, 2]])
        return out

    def compute_own_frame(self, k: int) -> Array:
        """Return (3, 3) which brings moves in the common frame into that of a map."""
        out = np.eye(3)
        out[:2, :2] = self.poses[k].inverse().matrix[:2, :2]
        return out

    def measure_by_plan(self, i: int, j: int, window: Window) -> Measurements:
        """Register the pieces of map i on the plans of map j."""
        own = self.compute_own_frame(i)
        into, start = self.poses[j].inverse() @ self.poses[i], self.compute_relative_moves(i, j) @ own.T
        parts = []
        for _, theirs, chosen in self._iter_facing(i, j):
            target = self.maps[j].targets[theirs]
            parts.append((chosen, *measure(self.maps[i].pieces, self.maps[i].samples, chosen, start, into, target, window)))
        return self._convert_measurements((i, j), own, parts)

    def measure_by_lines(self, i: int, j: int, sigma: float) -> Measurements:
        """Register the pieces of map i on the walls' lines of map j."""
        own, maps = self.compute_own_frame(i), self.maps
        into, start = self.poses[j].inverse() @ self.poses[i], self.compute_relative_moves(i, j) @ own.T
        parts = []
        for mine, theirs, chosen in self._iter_facing(i, j):
            target = (maps[j].storeys[theirs], maps[j].lines[theirs])
            *part, misfit = measure_lines(maps[i].pieces, chosen, maps[i].lines[mine], start, into, target, sigma)
            self.misfit += misfit
            parts.append(tuple(part))
        return self._convert_measurements((i, j), own, parts)

    def _iter_facing(self, i: int, j: int) -> Iterator[tuple[int, int, Array]]:
        """Yield the storeys of two maps on one level, of i and of j, with the pieces of i there; those with walls in both."""
        for mine, theirs in self.match_storeys(i, j):
            chosen = np.flatnonzero(self.maps[i].pieces.storey == mine)
            if len(chosen) and len(self.maps[j].storeys[theirs].walls):
                yield mine, theirs, chosen

    @property
    def rmse(self) -> float:
        """Root mean square distance of the walls that met last, m; nan where none did."""
        weight, square = self.misfit
        return float(np.sqrt(square / weight)) if weight > 0 else float("nan")

    def _convert_measurements(self, pair: Pair, own: Array, parts: Sequence[tuple[Array, ...]]) -> Measurements:
        """Convert pieces, moves and information in a map's own frame to measurements in the common one. Information counts half:
        both maps see the same walls."""
        i, j = pair
        chosen = np.concatenate([np.zeros(0, np.int64), *(p[0] for p in parts)])
        others, shares = self.compute_shares(i, j, chosen)
        move = np.concatenate([np.zeros((0, 3)), *(p[1] for p in parts)]) @ np.linalg.inv(own).T
        certain = own.T @ np.concatenate([np.zeros((0, 3, 3)), *(p[2] for p in parts)]) @ own / 2
        places = self.compute_anchors(i)[chosen]
        return Measurements(chosen + self.first[i], places, others + self.first[j], shares, move, certain)

    def correct_pose(self, window: Window) -> None:
        """Set the rigid pose of the second of two maps to the one that the pieces agree on best."""
        parts = [self.measure_by_plan(*pair, window) for pair in self.pairs]
        sign = np.concatenate(
            [np.full(len(p.piece), 1.0 if i == 1 else -1.0) for p, (i, _) in zip(parts, self.pairs, strict=True)]
        )
        measured = stack_measurements(parts)
        if not len(sign):
            return
        nobody = np.zeros((len(sign), 0))
        one = np.zeros(len(sign), np.int64)
        moves = sign[:, None] * measured.moves
        whole = Measurements(one, measured.places, nobody.astype(np.int64), nobody, moves, measured.information)
        middle = measured.places.mean(axis=0, keepdims=True)
        prior = np.array([[*RIGID_PRIOR[:3], RIGID_PRIOR[3] if self.scaled else 0.0]])
        none = Joints(np.zeros((0, 2), np.int64), np.zeros((0, 4)))
        self._move_pose(1, middle[0], settle(middle, none, whole, prior).moves[0])

    def _move_pose(self, k: int, about: Array, move: Array) -> None:
        """Move the rigid pose of a map; heights stay."""
        x, y, turn, size = move.tolist()
        turned = Sim3(turn, (0.0, 0.0, 0.0), float(np.exp(size)))
        at = about + (x, y) - transform_flat(turned, about[None])[0]
        pose = replace(turned, translation=(float(at[0]), float(at[1]), 0.0)) @ self.poses[k]
        self.poses[k] = replace(pose, translation=(*pose.translation[:2], self.poses[k].translation[2]))

    def absorb_moves(self, shared: bool = False) -> None:
        """Let the poses of the maps take over what their pieces have moved alike; the first map stays where it is.

        Args:
            shared: take over what the pieces that were registered have moved alike, so that the poses by themselves lay on each
                other what several maps saw.
        """
        for k, (map, weights) in enumerate(zip(self.maps, self.registered, strict=True)):
            many = np.bincount(map.pieces.owner, minlength=len(map.pieces)).astype(float)
            self._absorb_map_moves(k, many * weights if shared and weights.any() else many)
        back = self.poses[0].inverse()
        self.poses = [back @ pose for pose in self.poses]

    def _absorb_map_moves(self, k: int, weights: Array) -> None:
        pieces, moves, many = self.maps[k].pieces, self.moves[k], weights[:, None]
        if not len(pieces):
            return
        anchors = self.compute_anchors(k)
        middle = (many * anchors).sum(axis=0) / many.sum()
        x, y = (anchors - middle).T
        rows = np.zeros((len(pieces), 2, 3))
        rows[:, 0, 0] = rows[:, 1, 1] = 1.0
        rows[:, 0, 2], rows[:, 1, 2] = -y, x
        root = np.sqrt(many)[:, :, None]
        alike = np.linalg.lstsq((root * rows).reshape(-1, 3), (root[:, :, 0] * moves[:, :2]).ravel(), rcond=None)[0]
        self.moves[k] = moves - np.column_stack([rows @ alike, np.full(len(moves), alike[2]), np.zeros(len(moves))])
        self._move_pose(k, middle, np.append(alike, 0.0))

    def settle(self, parts: Sequence[Measurements], drifts: Sequence[Drift], estimated: bool = False) -> SettledMoves:
        """Move all pieces by what was measured; and (`estimated`) find by how much less than usual each map drifts, a step of
        expectation maximisation, so that what needs no bending is not bent by noise."""
        anchors = np.concatenate([self.compute_anchors(k) for k in range(len(self.maps))])
        weaker = [Drift(s[0] * d.shift, s[1] * d.turn) for s, d in zip(self.drift_shares, drifts, strict=True)]
        each = list(enumerate(zip((m.pieces for m in self.maps), weaker, strict=True)))
        sigma = [_compute_joint_sigma(p, d, self.poses[k].scale, self.scaled) for k, (p, d) in each]
        prior = [_build_prior(p, d, self.scaled and k > 0) for k, (p, d) in each]
        ends = [m.pieces.joints + n for m, n in zip(self.maps, self.first, strict=False)]
        measured = stack_measurements(parts)
        settled = settle(anchors, Joints(np.concatenate(ends), np.concatenate(sigma)), measured, np.concatenate(prior))
        self.moves = np.split(settled.moves, self.first[1:-1])
        weights = np.bincount(measured.piece, settled.weights, minlength=len(anchors))
        self.registered = np.split(weights, self.first[1:-1])
        if estimated:
            self._estimate_drift(settled, np.repeat(np.arange(len(self.maps)), [len(e) for e in ends]))
        return settled

    def _estimate_drift(self, settled: SettledMoves, owner: Array) -> None:
        """Estimate, of each map, by how much less than usual its shifts and turns drift; `owner` (j,): the map of each joint."""
        expected_strain = settled.expected_strain
        for k in range(len(self.maps)):
            expected = expected_strain[owner == k]
            if np.isfinite(expected).any():
                x, y, turn, _ = np.nanmean(expected, axis=0)
                self.drift_shares[k] = np.clip(self.drift_shares[k] * np.sqrt([(x + y) / 2, turn]), LEAST_SHARE, 1.0)

    def build_deformations(self, settled: SettledMoves) -> tuple[Deformation, ...]:
        """Return the moves of all maps in their own frames."""
        return tuple(self._build_deformation(k, c) for k, c in enumerate(np.split(settled.covariance, self.first[1:-1])))

    def _build_deformation(self, k: int, covariance: Array) -> Deformation:
        pieces, own = self.maps[k].pieces, self.compute_own_frame(k)
        moves = self.moves[k].copy()
        moves[:, :2] = moves[:, :2] @ own[:2, :2].T
        floors = np.array([f.plan.floor_guess for f in self.maps[k].storeys])
        turned, room = own @ covariance @ own.T, pieces.room.astype(np.int32)
        return Deformation(pieces.anchors, pieces.storey, floors, moves, turned, room, REACH / self.poses[k].scale)


def stack_measurements(parts: Sequence[Measurements]) -> Measurements:
    """Return all measurements as one."""
    names = ("piece", "places", "others", "shares", "moves", "information")
    return Measurements(*(np.concatenate([getattr(p, name) for p in parts]) for name in names))


def _compute_joint_sigma(pieces: Pieces, drift: Drift, scale: float, scaled: bool) -> Array:
    root = np.sqrt(pieces.lengths * scale)[:, None]
    size = SCALE_DRIFT if scaled else LEAST_DRIFT
    return np.maximum(root * np.array([[drift.shift, drift.shift, drift.turn, size]]), LEAST_DRIFT)


def _build_prior(pieces: Pieces, drift: Drift, scaled: bool) -> Array:
    prior = np.array([0.0] * 4 if drift.rigid else [*PIECE_PRIOR[:3], PIECE_PRIOR[3] if scaled else 0.0])
    return np.tile(prior, (len(pieces), 1))


def transform_flat(pose: Sim3, points: Array) -> Array:
    """Return points (n, 2) under a pose, seen from above."""
    return pose.apply(np.column_stack([points, np.zeros(len(points))]))[:, :2]
