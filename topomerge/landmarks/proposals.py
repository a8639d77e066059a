"""Poses that landmarks propose: of two rare strings that both maps read, of one tag or sign that faces a known way.

They are tried beside what walls propose, and judged by walls as all others are. A pose of two strings is as right as their places
are sure; the registration of walls moves it by a metre at most.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from topomerge.landmarks.evidence import LandmarkScorer
from topomerge.landmarks.likelihood import DRIFT_SIGMA
from topomerge.landmarks.radio_search import propose_radio_poses
from topomerge.landmarks.sightings import Sightings, transform_places
from topomerge.types import Array, Sim3

PROPOSING = ("tag", "text")  # kinds, the surest first
MOST_MATCHES = 60  # strings of both maps that propose; the rarest
MOST_PROPOSED = 12  # poses
MOST_FACED = 6  # of them by one sign that faces a known way
SUREST_SIGMA = 4.0  # m: less sure places propose nothing
RARE_SHARE = 0.02  # of the signs, from which on a string stands in too many places
LEAST_BASE = 1.5  # m between two signs of which the yaw is taken
STRETCHED = 0.06  # of the distance of two signs, by which drift may change it
SAME_POSE = (1.0, np.radians(8.0))  # m, rad
SCALES = (0.4, 2.5)
UNKNOWN = 1e6  # m: the height of a pose that nothing tells
WAYS_TRIED = 4  # yaws of the walls under which a sign is tried, if its way is not known
STOREYS_APART = 1.5  # m: floors that are farther from where signs put them are of another storey


def propose_poses(
    scorer: LandmarkScorer, scaled: bool = False, yaws: Sequence[float] = (), heights: Sequence[float] = ()
) -> list[Sim3]:
    """Propose poses T_ab, those that most landmarks agree with first.

    Args:
        scorer: of both maps.
        scaled: is the scale free? Then two strings give it, too.
        yaws: of T_ab that the walls of the rooms suggest, rad, best first: a sign whose way is not known is tried under these.
        heights: of T_ab that the floors suggest, m; poses are put on the nearest one.
    """
    poses: list[Sim3] = []
    for kind in PROPOSING:
        if kind in scorer.sightings:
            a, b = scorer.sightings[kind]
            matches = match_values(a, b)
            poses += _propose_by_two(a, b, matches, scaled)
            poses += [] if scaled else _propose_by_one(a, b, matches, yaws)[:MOST_FACED]
    if "radio" in scorer.kinds and not scaled:
        poses += [found.pose for found in propose_radio_poses(scorer.a, scorer.b) if found.is_worth_trying]
    middle = scorer.b.grid.compute_centroids()[:: max(len(scorer.b.grid) // 1000, 1)].mean(axis=0)
    out: list[Sim3] = []
    for pose in (_snap_height(pose, heights) for pose in poses):
        if len(out) < MOST_PROPOSED and not any(_is_near(pose, other, middle) for other in out):
            out.append(pose)
    return out


def match_values(a: Sightings, b: Sightings) -> Array:
    """Return (p, 2) numbers of sightings that say the same rare thing and whose places are sure, the rarest first."""
    of_b: dict[str, list[int]] = {}
    for j, key in enumerate(b.keys):
        if b.sigma[j] <= SUREST_SIGMA:
            of_b.setdefault(key, []).append(j)
    count: dict[str, int] = {}
    for key in a.keys:
        count[key] = count.get(key, 0) + 1
    rows = []
    for i, key in enumerate(a.keys):
        others = of_b.get(key, [])
        if a.sigma[i] <= SUREST_SIGMA and a.share[i] < RARE_SHARE + (not a.numbered[i]) * 0.01 and len(others) * count[key] <= 4:
            rows += [(len(others) * count[key], float(a.share[i]), i, j) for j in others]
    rows.sort(key=lambda row: (row[0], row[1], row[2], row[3]))
    return np.array([(i, j) for _, _, i, j in rows[:MOST_MATCHES]], np.int64).reshape(-1, 2)


def _propose_by_two(a: Sightings, b: Sightings, matches: Array, scaled: bool) -> list[Sim3]:
    """Propose poses under which two matches lie on each other, by how many others do."""
    if len(matches) < 2:
        return []
    p, q = a.position[matches[:, 0]], b.position[matches[:, 1]]
    sigma = np.sqrt(a.sigma[matches[:, 0]] ** 2 + b.sigma[matches[:, 1]] ** 2 + DRIFT_SIGMA**2)
    first, second = np.triu_indices(len(matches), 1)
    apart = [np.hypot(*(of[second] - of[first])[:, :2].T) for of in (p, q)]
    unsure = 2 * (sigma[first] + sigma[second])
    fits = (apart[0] > LEAST_BASE) & (apart[1] > LEAST_BASE) & (apart[0] > unsure / 3)
    ratio = apart[0] / np.maximum(apart[1], 1e-9)
    fits &= (ratio > SCALES[0]) & (ratio < SCALES[1]) if scaled else np.abs(apart[0] - apart[1]) < unsure + STRETCHED * apart[0]
    scored = []
    for k in np.flatnonzero(fits).tolist():
        pair = np.array([first[k], second[k]])
        pose = _fit_pose(p[pair], q[pair], float(ratio[k]) if scaled else 1.0)
        away = np.hypot(*(p - transform_places(pose.apply, q))[:, :2].T)
        near = away < 2.5 * sigma + STRETCHED * float(np.median(apart[0]))
        chosen = _fit_pose(p[near], q[near], pose.scale) if near.sum() > 2 else pose
        scored.append((-int(near.sum()), float(np.median(away[near])) if near.any() else np.inf, k, chosen))
    scored.sort(key=lambda entry: entry[:3])
    return [pose for *_, pose in scored[: 4 * MOST_PROPOSED]]


def _fit_pose(p: Array, q: Array, scale: float) -> Sim3:
    """Fit the pose of a scale that lays points q (n, 3) onto p best (least squares); heights that are not known say nothing."""
    mean = p[:, :2].mean(axis=0), q[:, :2].mean(axis=0)
    one, other = ((of[:, :2] - m) @ (1, 1j) for of, m in zip((p, q), mean, strict=True))
    yaw = float(np.angle((one * np.conj(other)).sum()))
    turned = scale * np.exp(1j * yaw) * complex(*mean[1])
    up = p[:, 2] - scale * q[:, 2]
    height = float(np.median(up[np.isfinite(up)])) if np.isfinite(up).any() else UNKNOWN
    return Sim3(yaw, (float(mean[0][0] - turned.real), float(mean[0][1] - turned.imag), height), scale)


def _propose_by_one(a: Sightings, b: Sightings, matches: Array, yaws: Sequence[float]) -> list[Sim3]:
    """Propose poses of single matches: by the ways that they face, or in line with the walls."""
    poses = []
    for i, j in matches.tolist():
        faced = float(a.heading[i] - b.heading[j])
        for yaw in [faced] if np.isfinite(faced) else yaws[:WAYS_TRIED]:
            turn = Sim3(float(np.angle(np.exp(1j * yaw))))
            x, y, z = (a.position[i] - transform_places(turn.apply, b.position[j][None])[0]).tolist()
            poses.append(Sim3(turn.yaw, (x, y, z if np.isfinite(z) else UNKNOWN)))
    return poses


def _snap_height(pose: Sim3, heights: Sequence[float]) -> Sim3:
    """Return the pose on the floors that are nearest to where it has them; on the first ones where nothing tells."""
    x, y, z = pose.translation
    if z == UNKNOWN:
        return replace(pose, translation=(x, y, heights[0] if len(heights) else 0.0))
    nearest = min(heights, key=lambda h: abs(h - z), default=z)
    return replace(pose, translation=(x, y, nearest if abs(nearest - z) < STOREYS_APART else z))


def _is_near(one: Sim3, other: Sim3, middle: Array) -> bool:
    away = float(np.hypot(*(one.apply(middle[None]) - other.apply(middle[None]))[0, :2]))
    turn = abs(float(np.angle(np.exp(1j * (one.yaw - other.yaw)))))
    return away < SAME_POSE[0] and turn < SAME_POSE[1] and abs(np.log(one.scale / other.scale)) < 0.05
