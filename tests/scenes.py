"""Tiny analytic buildings with known answers, as points. z is up, metres; nothing is random unless noise is asked for."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

SPACING = 0.04
THICK = 0.15  # m, walls
HEIGHT = 2.7  # m, floor to ceiling
DOOR = (0.9, 2.05)  # m, width and height


def rectangle(corner, u, v, spacing: float = SPACING) -> np.ndarray:
    """Points on the parallelogram corner + s u + t v, at most `spacing` apart."""
    corner, u, v = (np.asarray(a, float) for a in (corner, u, v))
    n, m = (max(int(np.ceil(np.linalg.norm(a) / spacing)), 1) for a in (u, v))
    s, t = np.meshgrid((np.arange(n) + 0.5) / n, (np.arange(m) + 0.5) / m)
    return corner + s.reshape(-1, 1) * u + t.reshape(-1, 1) * v


@dataclass
class Scene:
    """Points that grow by floors, walls and boxes."""

    parts: list[np.ndarray] = field(default_factory=list)

    def floor(self, x0, y0, x1, y1, z=0.0, hole=None) -> Scene:
        points = rectangle((x0, y0, z), (x1 - x0, 0, 0), (0, y1 - y0, 0))
        if hole is not None:
            a, b, c, d = hole
            inside = (points[:, 0] > a) & (points[:, 0] < c) & (points[:, 1] > b) & (points[:, 1] < d)
            points = points[~inside]
        self.parts.append(points)
        return self

    def wall(self, a, b, z=0.0, height=HEIGHT, doors=(), lintel=True, thick=THICK) -> Scene:
        """Both faces of a wall from a to b; `doors` are distances of door centres from a. Jambs are faces, too."""
        a, b = np.asarray(a, float), np.asarray(b, float)
        length = float(np.linalg.norm(b - a))
        along = (b - a) / length
        across = np.array([-along[1], along[0]]) * thick / 2
        for side in (-1, 1):
            at = np.append(a + side * across, z)
            points = rectangle(at, (*(along * length), 0), (0, 0, height))
            s = (points[:, :2] - at[:2]) @ along
            for door in doors:
                inside = np.abs(s - door) < DOOR[0] / 2
                if lintel:
                    inside &= points[:, 2] - z < DOOR[1]
                points, s = points[~inside], s[~inside]
            self.parts.append(points)
        for door in doors:
            for end in (door - DOOR[0] / 2, door + DOOR[0] / 2):
                jamb = np.append(a + along * end - across, z)
                self.parts.append(rectangle(jamb, (*(2 * across), 0), (0, 0, DOOR[1] if lintel else height)))
        return self

    def box(self, x0, y0, z0, x1, y1, z1) -> Scene:
        """All six faces."""
        dx, dy, dz = x1 - x0, y1 - y0, z1 - z0
        for corner, u, v in (
            ((x0, y0, z0), (dx, 0, 0), (0, dy, 0)),
            ((x0, y0, z1), (dx, 0, 0), (0, dy, 0)),
            ((x0, y0, z0), (dx, 0, 0), (0, 0, dz)),
            ((x0, y1, z0), (dx, 0, 0), (0, 0, dz)),
            ((x0, y0, z0), (0, dy, 0), (0, 0, dz)),
            ((x1, y0, z0), (0, dy, 0), (0, 0, dz)),
        ):
            self.parts.append(rectangle(corner, u, v))
        return self

    def shell(self, x0, y0, x1, y1, z=0.0, height=HEIGHT, ceiling=True) -> Scene:
        """Floor, four walls around it (their inner faces on the given lines) and a ceiling."""
        t = THICK / 2
        self.floor(x0, y0, x1, y1, z)
        if ceiling:
            self.floor(x0, y0, x1, y1, z + height)
        for a, b in (
            ((x0 - t, y0 - t), (x1 + t, y0 - t)),
            ((x0 - t, y1 + t), (x1 + t, y1 + t)),
            ((x0 - t, y0 - t), (x0 - t, y1 + t)),
            ((x1 + t, y0 - t), (x1 + t, y1 + t)),
        ):
            self.wall(a, b, z, height)
        return self

    def points(self, noise: float = 0.0, seed: int = 0) -> np.ndarray:
        """(N, 3) float32, moved off the lattice of the voxels."""
        points = np.concatenate(self.parts) + (0.013, 0.017, 0.021)
        if noise:
            points = points + np.random.default_rng(seed).normal(0, noise, points.shape)
        return points.astype(np.float32)


def two_rooms(ceiling: bool = True) -> Scene:
    """4 x 5 m and 3 x 5 m, a door of 0.9 m at (4, 2)."""
    return Scene().shell(0, 0, 7, 5, ceiling=ceiling).wall((4, 0), (4, 5), doors=(2.0,))


def corridor() -> Scene:
    """A corridor of 16 x 2 m along x between two rows of four rooms of 4 x 4 m, each with a door to it: y from 0 to 10."""
    scene = Scene().shell(0, 0, 16, 10)
    for y in (4, 6):
        scene.wall((0, y), (16, y), doors=(2.0, 6.0, 10.0, 14.0))
    for x in (4, 8, 12):
        scene.wall((x, 0), (x, 4)).wall((x, 6), (x, 10))
    return scene


def stair(scene: Scene, x0: float, y0: float, y1: float, z0: float, z1: float, tread: float = 0.29) -> float:
    """Steps up along +x between y0 and y1; returns the x where it arrives."""
    n = int(np.ceil((z1 - z0) / 0.18))
    rise = (z1 - z0) / n
    for i in range(n):
        x = x0 + i * tread
        scene.parts.append(rectangle((x, y0, z0 + i * rise), (0, y1 - y0, 0), (0, 0, rise)))
        scene.parts.append(rectangle((x, y0, z0 + (i + 1) * rise), (tread, 0, 0), (0, y1 - y0, 0)))
    return x0 + n * tread


def two_storeys() -> Scene:
    """A hall of 9 x 5 m below and one above; a straight stair of 1.2 m along the wall y = 5 through a hole in the slab."""
    scene = Scene()
    z = 3.0
    end = 1.0 + 0.29 * int(np.ceil(z / 0.18))
    hole = (1.0, 3.8, end, 5.0)
    for level in (0.0, z):
        for a, b in (((0, 0), (9, 0)), ((0, 5), (9, 5)), ((0, 0), (0, 5)), ((9, 0), (9, 5))):
            scene.wall(a, b, level, HEIGHT if level else z)
    scene.floor(0, 0, 9, 5).floor(0, 0, 9, 5, z, hole).floor(0, 0, 9, 5, HEIGHT, hole).floor(0, 0, 9, 5, z + HEIGHT)
    stair(scene, 1.0, 3.8, 5.0, 0.0, z)
    return scene


def ramp() -> Scene:
    """A corridor of 16 x 2 m that climbs 0.8 m over its middle 10 m: one storey, one way through."""
    scene = Scene().floor(0, 0, 3, 2).floor(13, 0, 16, 2, 0.8).floor(0, 0, 16, 2, 3.4)
    scene.parts.append(rectangle((3, 0, 0), (10, 0, 0.8), (0, 2, 0)))
    for a, b in (((0, 0), (16, 0)), ((0, 2), (16, 2)), ((0, 0), (0, 2)), ((16, 0), (16, 2))):
        scene.wall(a, b, height=3.4)
    return scene


def table() -> Scene:
    """A room of 5 x 4 m with a table of 2 x 1 m, 0.75 m high."""
    scene = Scene().shell(0, 0, 5, 4)
    scene.box(1.5, 1.5, 0.71, 3.5, 2.5, 0.75)
    for x in (1.55, 3.4):
        for y in (1.55, 2.4):
            scene.box(x, y, 0, x + 0.05, y + 0.05, 0.71)
    return scene


def mezzanine() -> Scene:
    """A hall of 12 x 6 m and 5.6 m high, a gallery of 4 x 6 m at 2.8 m over its end, a stair up to it."""
    scene = Scene().shell(0, 0, 12, 6, height=5.6)
    scene.floor(8, 0, 12, 6, 2.6).floor(8, 0, 12, 6, 2.8)
    stair(scene, 8.0 - 0.29 * 16, 0.2, 1.6, 0.0, 2.8)
    return scene


def single_wall() -> Scene:
    return Scene().wall((0, 0), (6, 0))


def isolated_rooms(n: int = 10) -> Scene:
    """n rooms of 3 x 3 m, 5 m apart, without any connection."""
    scene = Scene()
    for i in range(n):
        x, y = 8.0 * (i % 5), 8.0 * (i // 5)
        scene.shell(x, y, x + 3, y + 3)
    return scene
