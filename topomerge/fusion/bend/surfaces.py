"""Each piece registered by its surfaces, once it lies within decimetres: point to plane, level and upright (method 4).

Columns of a plan are a decimetre wide; the middles of the points of cells know walls to a centimetre.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from topomerge.fusion.bend.pieces import Pieces
from topomerge.fusion.refine import LEAST_FLATNESS, Surface
from topomerge.kernels import icp
from topomerge.types import Array, Sim3

SURFACE_REACH, SURFACE_SIGMA = 1, 0.06  # blocks in which partners are looked for, and m of the robust weights
PIECE_SURFACE = 500  # points of a piece at most
LEAST_UPRIGHT = 0.7  # points of planes that are less upright tell nothing of shifts
INDEPENDENT = 25.0  # points of a wall whose errors are one: noise is not, but how a sensor sees a wall is
PLANE_NOISE = 0.02  # m
LEAST_PARTNERS = 12  # points of a piece, below which nothing is measured
FINE_FLOOR = (0.004, float(np.radians(0.05)))  # m, rad: no move is known better
AT = np.array([0, 1, 3])  # x, y and yaw of the five unknowns of `icp.gather`


class PieceSurfaces:
    """The upright surface points of each piece of a map."""

    def __init__(self, pieces: Pieces, surface: Surface, storey_of: Array) -> None:
        """`storey_of`: (n,) storey of each point of the surface, -1 none."""
        rows = np.flatnonzero(
            (surface.flat >= LEAST_FLATNESS) & (np.abs(surface.normals[:, 2]) < LEAST_UPRIGHT) & (storey_of >= 0)
        )
        rng = np.random.default_rng(0)
        self.rows: list[Array] = [np.zeros(0, np.int64)] * len(pieces)
        for s in np.unique(pieces.storey):
            numbers = np.flatnonzero(pieces.storey[pieces.owner] == s)
            here = rows[storey_of[rows] == s]
            if not len(here):
                continue
            owner = pieces.owner[numbers][cKDTree(pieces.walls[numbers]).query(surface.points[here, :2])[1]]
            for k in np.unique(owner):
                own = here[owner == k]
                self.rows[k] = own if len(own) <= PIECE_SURFACE else np.sort(rng.permutation(own)[:PIECE_SURFACE])
        self.surface, self.pieces = surface, pieces

    def measure(self, moves: Array, into: Sim3, target: Surface) -> tuple[Array, Array, Array]:
        """The pieces that found partners (k,), their moves (k, 3) in their own frame, and the information (k, 3, 3).

        Args:
            moves: (n, 3) shift and turn from which to start.
            into: the pieces' frame -> that of the target.
        """
        fixed = (*target.grid._bricks, target.grid.origin, target.grid.edge, target.points, target.normals)
        own = np.eye(3)  # target's frame -> that of the pieces
        own[:2, :2] = into.inverse().matrix[:2, :2]
        there = np.linalg.inv(own)
        numbers, means, informations = [], [], []
        for k, rows in enumerate(self.rows):
            if len(rows) < LEAST_PARTNERS:
                continue
            points = self.surface.points[rows]
            middle = np.append(self.pieces.anchors[k], points[:, 2].mean())
            place = into.apply((middle + np.append(moves[k, :2], 0.0))[None])[0]
            pose = np.array([*place, into.yaw + moves[k, 2], np.log(into.scale)])
            h, g, partners, _, _ = icp.gather(
                *fixed, points - middle, self.surface.normals[rows], pose, SURFACE_REACH, SURFACE_SIGMA, False
            )
            if partners < LEAST_PARTNERS:
                continue
            h, g = h[np.ix_(AT, AT)], g[AT]
            step = -np.linalg.pinv(h, rcond=1e-4, hermitian=True) @ g
            numbers.append(k)
            means.append(moves[k] + own @ step)
            informations.append(there.T @ _bounded(h / (INDEPENDENT * PLANE_NOISE**2)) @ there)
        if not numbers:
            return np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3))
        return np.array(numbers), np.array(means), np.array(informations)


def _bounded(information: Array) -> Array:
    """Information after the floor of what can be known is added to its covariance, in each of its own directions."""
    unit = np.diag([FINE_FLOOR[0], FINE_FLOOR[0], FINE_FLOOR[1]])
    values, vectors = np.linalg.eigh(unit @ information @ unit)
    values = np.maximum(values, 0)
    bounded = (vectors * (values / (1 + values))) @ vectors.T
    back = np.linalg.inv(unit)
    out: Array = back @ bounded @ back
    return out
