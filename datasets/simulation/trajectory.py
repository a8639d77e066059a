"""Where a sensor is carried along a walk, and where odometry believes that it was."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation
from topomerge.datasets.simulation.sensors import Sensor
from topomerge.datasets.simulation.walk import Walk

from topomerge.types import Array, Sim3


def sensor_poses(walk: Walk, sensor: Sensor, visited: Sequence[int], rng: np.random.Generator) -> tuple[Array, Array]:
    """(K, 4, 4) true poses of the sensor, in the order of the walk, and metres walked to each; only in the rooms asked for."""
    along = walk.along
    at = list(walk.stops) * sensor.turns
    turn = [k * 2 * np.pi * sensor.look / sensor.turns for k in range(sensor.turns) for _ in walk.stops]
    turn = [t + o for t, o in zip(turn, np.tile(rng.uniform(0, 2 * np.pi, len(walk.stops)), sensor.turns), strict=True)]
    heading = _heading(walk.points)
    if sensor.step:
        marks = np.searchsorted(along, np.arange(0, along[-1], sensor.step))
        marks = marks[walk.free[marks] & (np.isin(walk.room[marks], list(visited)) | (walk.room[marks] < 0))]
        at += marks.tolist()
        sway = np.radians(sensor.swing) * 2 * np.sin(np.arange(len(marks)) * 0.9 + rng.uniform(0, 6))
        turn += (heading[marks] + sway).tolist()
    order = np.argsort(along[at], kind="stable")
    index, yaw = np.array(at)[order], np.array(turn)[order]
    count = len(index)
    pitch = -np.radians(sensor.pitch + sensor.swing * np.sin(np.arange(count) * 2.4 + rng.uniform(0, 6)))
    pitch = pitch if sensor.beams != 1 else np.zeros(count)
    poses = np.tile(np.eye(4), (count, 1, 1))
    c, s, cp, sp = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch)
    poses[:, :3, :3] = np.moveaxis(np.array([[c * cp, -s, c * sp], [s * cp, c, s * sp], [-sp, 0 * s, cp]]), 2, 0)
    poses[:, :3, 3] = walk.points[index] + [0, 0, sensor.height]
    if sensor.step and sensor.beams != 1:
        poses[:, 2, 3] += rng.normal(0, 0.03, count)
    return poses, along[index]


def _heading(points: Array) -> Array:
    """rad, the way the walk goes at each point, looking 0.5 m ahead."""
    ahead = np.roll(points, -5, axis=0)[:, :2] - points[:, :2]
    ahead[-5:] = ahead[-6] if len(points) > 5 else (1.0, 0.0)
    return np.arctan2(ahead[:, 1], ahead[:, 0])


def drifted(poses: Array, walk: Walk, along: Array, sensor: Sensor, rng: np.random.Generator) -> Array:
    """The poses as odometry has them: the heading wanders, and the way bends with it; gravity is a little off."""
    out = _jittered(poses, sensor, rng)
    if sensor.drift:
        total = walk.along[-1]
        knots = np.arange(0, total + 30.0, 15.0)
        error = np.interp(walk.along, knots, np.radians(sensor.drift) * rng.normal(size=len(knots)))
        climb = np.interp(walk.along, knots, 0.002 * sensor.drift * rng.normal(size=len(knots)))
        step = np.diff(walk.points, axis=0)
        c, s = np.cos(error[1:]), np.sin(error[1:])
        flat = np.hypot(step[:, 0], step[:, 1])
        bent = np.stack([c * step[:, 0] - s * step[:, 1], s * step[:, 0] + c * step[:, 1], step[:, 2] + climb[1:] * flat], axis=1)
        moved = np.concatenate([[walk.points[0]], walk.points[0] + np.cumsum(bent, axis=0)]) - walk.points
        at = np.searchsorted(walk.along, along)
        for k, i in enumerate(np.clip(at, 0, len(moved) - 1)):
            out[k, :3, :3] = Sim3(float(error[i])).matrix[:3, :3] @ out[k, :3, :3]
            out[k, :3, 3] += moved[i]
    if sensor.tilt:
        a, b = np.radians(sensor.tilt) * rng.normal(size=2)
        lean = np.array([[1, 0, b], [0, 1, -a], [-b, a, 1]])
        lean = np.linalg.qr(lean)[0] * np.sign(np.diag(np.linalg.qr(lean)[1]))
        centre = out[:, :3, 3].mean(axis=0)
        out[:, :3, 3] = (out[:, :3, 3] - centre) @ lean.T + centre
        out[:, :3, :3] = lean @ out[:, :3, :3]
    return out


def _jittered(poses: Array, sensor: Sensor, rng: np.random.Generator) -> Array:
    """The poses, each off by itself: what is left of the errors when a map has been put together."""
    out = poses.copy()
    shift, turn = rng.normal(0, sensor.jitter[0], (len(poses), 3)), np.radians(rng.normal(0, sensor.jitter[1], (len(poses), 3)))
    flat = sensor.beams == 1
    out[:, :3, 3] += shift * [1, 1, 0 if flat else 1]
    out[:, :3, :3] = Rotation.from_rotvec(turn * [not flat, not flat, 1]).as_matrix() @ out[:, :3, :3]
    return out
