"""Which way is up in a cloud: the normals of its floors and ceilings say so, and its walls are the witnesses (beyond the thesis).

A laser that is mounted askew, or photogrammetry without gravity, tilts a whole map. Small planes are fitted to the points; the
direction along which most of them lie flat or stand upright is up. A ramp, a sloping roof or a stairway turns floors or ceilings,
but no walls: a cloud is tilted only where its walls, too, lean by as much and to the same side.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from topomerge.types import Array

LEAST_TILT = 1.0  # degrees: of real scans that are level 0.7 at most were found; from there on merges suffer
LARGEST_TILT = 25.0  # degrees: beyond, another axis is up, of which `io.checks` warns
SAMPLE = 300_000  # points that are looked at
PATCH_EDGES = (0.4, 0.8)  # m, of the cubes in which planes are fitted; the larger ones where the smaller ones show too few
LEAST_POINTS = 8  # of a patch
FLATNESS = 0.075  # of a patch: rms of its points about its plane, by the edge of its cube
ROUNDNESS, THINNESS = 0.3, 0.33  # of a patch: its width by its length, and its thickness by its width; else a line or a ball
ENOUGH_PATCHES, LEAST_PATCHES = 480, 120  # some 40 and 10 m2 of floors, ceilings and walls in cubes of 0.4 m, seen twice
SEARCH_STEP = 1.0  # degrees
SEARCHED_PATCHES = 2000
SEARCH_WIDTH = 2.0  # degrees (standard deviation) within which a patch agrees with a direction
REACHES = (6.0, 4.5, 3.0, 3.0, 3.0, 3.0)  # degrees, from where a patch has no say in each round of the least squares
WALL_REACH = 6.0  # degrees by which a wall may miss what is upright, in the file or along the direction found
ACROSS = 0.7  # cosine between the normal of a wall and the side to which a cloud leans: the walls that would lean, too
LEAST_WITNESSES = 40  # such walls
WITNESSED = 0.5  # of the tilt, by which the median of them leans
SURE = 6.0  # times its standard error
LEAST_AGREEMENT = 0.2  # of all patches that agree with the direction found; of clouds of a building 0.3 to 0.85 do


class _Wall(NamedTuple):
    """By how many degrees walls lean to one side: the median, its standard error, and how many walls say so."""

    lean: float
    error: float
    number: int


def find_up(points: Array, normals: Array | None = None) -> Array | None:
    """Find the direction that is up in a tilted cloud.

    Args:
        points: (N, 3) m, z roughly up.
        normals: (n, 3), `fit_patches` of them, where that is known.

    Returns:
        (3,) float64 unit vector, `LEAST_TILT` to `LARGEST_TILT` from z; None where the cloud is level, or nothing says it is not.
    """
    normals = fit_patches(points) if normals is None else normals
    if len(normals) < LEAST_PATCHES:
        return None
    up = _refined(normals, _most_agreed(normals))
    tilt = degrees_from_z(up)
    if not LEAST_TILT <= tilt <= LARGEST_TILT or _agreement(normals, up[None])[0] < LEAST_AGREEMENT * len(normals):
        return None
    walls = _walls_across(normals, up, tilt)
    witnessed = walls.number >= LEAST_WITNESSES and walls.lean >= max(WITNESSED * tilt, SURE * walls.error)
    if not witnessed:
        return None
    rotation = rotation_to_z(up)  # borders of cubes that cut noisy planes askew draw their normals to the axes: look once more
    return np.asarray(_refined(fit_patches(_sample(points) @ rotation.T), np.array([0.0, 0.0, 1.0])) @ rotation)


def degrees_from_z(up: Array) -> float:
    """The angle between a unit vector (3,) and z."""
    return float(np.degrees(np.arctan2(np.hypot(up[0], up[1]), up[2])))


def rotation_to_z(up: Array) -> Array:
    """(3, 3) float64, the shortest rotation that brings a unit vector above the horizon to z."""
    x, y, z = np.asarray(up, np.float64)
    return np.array([[1 - x * x / (1 + z), -x * y / (1 + z), -x], [-x * y / (1 + z), 1 - y * y / (1 + z), -y], [x, y, z]])


def fit_patches(points: Array) -> Array:
    """(n, 3) float64 unit normals, of either sign, of the cubes of space whose points (N, 3) lie on a plane.

    Space is cut twice, half an edge apart: a cube that holds both faces of a wall shows no plane.
    """
    sample, normals = _sample(points), np.zeros((0, 3))
    for edge in PATCH_EDGES:
        if len(normals) < ENOUGH_PATCHES and len(sample):
            local = sample - np.median(sample, axis=0)
            both = np.concatenate([_fit(local, edge), _fit(local + edge / 2, edge)])
            normals = max(normals, both, key=len)
    return normals


def _sample(points: Array) -> Array:
    """Every n-th point, float64, without what is not finite."""
    sample = np.asarray(points[:: max(len(points) // SAMPLE, 1)], np.float64)
    return sample[np.isfinite(sample).all(axis=1)]


def _fit(points: Array, edge: float) -> Array:
    """The normals of the planes in cubes of one edge length, m; points lie around the origin."""
    cells = np.floor(points / edge)
    near = (np.abs(cells) < 1 << 20).all(axis=1)
    local = points[near] - (cells[near] + 0.5) * edge
    x, y, z = (cells[near].astype(np.int64) + (1 << 20)).T
    codes, of_cube, count = np.unique((x << 42) | (y << 21) | z, return_inverse=True, return_counts=True)
    of_cube, number = of_cube.ravel(), len(codes)
    mean = np.column_stack([np.bincount(of_cube, v, number) for v in local.T]) / count[:, None]
    covariance = np.empty((number, 3, 3))
    for i in range(3):
        for j in range(i, 3):
            product = np.bincount(of_cube, local[:, i] * local[:, j], number) / count
            covariance[:, i, j] = covariance[:, j, i] = product - mean[:, i] * mean[:, j]
    values, vectors = np.linalg.eigh(covariance[count >= LEAST_POINTS])
    thick, wide, long = np.sqrt(np.maximum(values, 0)).T
    is_plane = (thick <= FLATNESS * edge) & (thick < THINNESS * wide) & (wide >= ROUNDNESS * long)
    return np.asarray(vectors[is_plane][:, :, 0])


def _agreement(normals: Array, ups: Array) -> Array:
    """(k,) how many patches lie flat or stand upright along each of the directions (k, 3)."""
    square = (normals @ ups.T) ** 2
    off = np.minimum(square, 1 - square)  # squared sines of the angles of walls from upright, of floors from flat
    return np.asarray(np.exp(off * (-0.5 / np.radians(SEARCH_WIDTH) ** 2)).sum(axis=0))


def _most_agreed(normals: Array) -> Array:
    """(3,) the direction within `LARGEST_TILT` of z with which most patches agree."""
    steps = np.tan(np.radians(np.arange(-LARGEST_TILT, LARGEST_TILT + SEARCH_STEP, SEARCH_STEP)))
    x, y = (v.ravel() for v in np.meshgrid(steps, steps))
    ups = np.column_stack([x, y, np.ones(len(x))])
    ups /= np.linalg.norm(ups, axis=1)[:, None]
    ups = ups[ups[:, 2] >= np.cos(np.radians(LARGEST_TILT + SEARCH_STEP))]
    some = normals[:: -(-len(normals) // SEARCHED_PATCHES)]
    return np.asarray(ups[np.argmax(_agreement(some, ups))])


def _refined(normals: Array, up: Array) -> Array:
    """(3,) the direction to which the normals of floors are parallel and those of walls perpendicular: least squares in which
    what is far off has no say."""
    for reach in REACHES:
        sine = np.clip(np.abs(normals @ up), 0, 1)
        off = np.degrees(np.arcsin(sine))
        flat = off > 45
        weight = np.clip(1 - (np.where(flat, 90 - off, off) / reach) ** 2, 0, None) ** 2
        signed = np.where(flat, -weight, weight)  # the sine of what is flat is to be large, that of what is upright small
        up = np.linalg.eigh((normals * signed[:, None]).T @ normals)[1][:, 0]
        up = up if up[2] > 0 else -up
    return up


def _walls_across(normals: Array, up: Array, tilt: float) -> _Wall:
    """How far the walls lean that would lean with a cloud that is tilted to a direction."""
    side = up[:2] / np.linalg.norm(up[:2])
    towards = normals[:, :2] @ side
    steep = np.sin(np.radians(WALL_REACH + tilt))
    is_wall = (np.abs(normals[:, 2]) < steep) & (np.abs(normals @ up) < steep) & (np.abs(towards) > ACROSS)
    leans = -np.degrees(np.arcsin(normals[is_wall, 2] * np.sign(towards[is_wall])))
    if not len(leans):
        return _Wall(0.0, np.inf, 0)
    return _Wall(float(np.median(leans)), float(1.25 * np.std(leans) / np.sqrt(len(leans))), len(leans))
