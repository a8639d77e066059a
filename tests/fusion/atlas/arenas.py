"""Grid maps of arenas whose walls repeat by half or quarter turns about the middle, and of ones that do not."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

import topomerge as tm
from topomerge.types import Sim3, TopometricMap

EDGE = 0.05  # m, of a cell
UNKNOWN, FREE, WALL = 205, 254, 0  # greys of a grid map
WALL_WIDTH = 0.2  # m


@dataclass(frozen=True)
class Arena:
    """A hall with short walls in it.

    Args:
        width, depth: of the hall, m.
        fold: how many turns lay the walls on themselves: 1 (none), 2 or 4.
        round: is the hall an ellipse?
        seed: of the walls.
        bars: number of walls.
        seen: how far each map sees beyond the middle towards what it misses, of the lesser side of the hall.
    """

    width: float = 11.0
    depth: float = 11.0
    fold: int = 2
    round: bool = False
    seed: int = 0
    bars: int = 24
    seen: float = 0.4

    def inside(self, at: np.ndarray, rim: float = 0.0) -> np.ndarray:
        """(...,) is a place (..., 2), m, in the hall, `rim` from its outer wall?"""
        half = np.array([self.width, self.depth]) / 2 - rim
        scaled = np.abs(at) / half
        return (scaled**2).sum(axis=-1) <= 1 if self.round else (scaled <= 1).all(axis=-1)

    def walls(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Low and high corners of the short walls, m; the copies of one wall follow each other."""
        rng = np.random.default_rng(self.seed)
        out: list[tuple[np.ndarray, np.ndarray]] = []
        while len(out) < self.bars:
            middle = rng.uniform(-0.5, 0.5, 2) * (self.width, self.depth)
            size = np.array([rng.uniform(0.8, 1.6), WALL_WIDTH])[:: rng.choice([1, -1])]
            if not self.inside(middle, 1.2):
                continue
            for turn in range(self.fold):
                c, s = np.round([np.cos(2 * np.pi * turn / self.fold), np.sin(2 * np.pi * turn / self.fold)])
                corners = np.array([middle - size / 2, middle + size / 2]) @ np.array([[c, s], [-s, c]])
                out.append((corners.min(axis=0), corners.max(axis=0)))
        return out


def save_grid(arena: Arena, folder: Path, k: int, count: int, yaw: float = 0.0) -> Path:
    """Write map k of `count`: all but a corner of the arena, which is another one for each map, with ragged walls."""
    rng = np.random.default_rng([arena.seed, k])
    reach = np.ceil((np.array([arena.width, arena.depth]) / 2 + 0.5) / EDGE).astype(int)
    axes = [(np.arange(-n, n) + 0.5) * EDGE for n in reach]
    at = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    grey = np.where(arena.inside(at, WALL_WIDTH), FREE, np.where(arena.inside(at), WALL, UNKNOWN))
    for low, high in arena.walls():
        ragged = (low + rng.integers(-1, 2, 2) * EDGE, high + rng.integers(-1, 2, 2) * EDGE)
        grey[((at >= ragged[0]) & (at <= ragged[1])).all(axis=-1)] = WALL
        if rng.random() < 0.3:  # of some walls only the faces were seen
            grey[((at >= ragged[0] + EDGE) & (at <= ragged[1] - EDGE)).all(axis=-1)] = UNKNOWN
    direction = 2 * np.pi * k / count + rng.uniform(-0.3, 0.3)
    unseen = at @ [np.cos(direction), np.sin(direction)] > arena.seen * min(arena.width, arena.depth)
    grey[unseen] = UNKNOWN
    path = folder / f"arena_{k}.pgm"
    image = np.flipud(grey.T).astype(np.uint8)
    path.write_bytes(f"P5\n{image.shape[1]} {image.shape[0]}\n255\n".encode() + image.tobytes())
    c, s = np.cos(yaw), np.sin(yaw)
    x, y = -reach * EDGE
    origin = f"origin: [{c * x - s * y}, {s * x + c * y}, {yaw}]"
    yaml = folder / f"arena_{k}.yaml"
    yaml.write_text(f"image: {path.name}\nresolution: {EDGE}\n{origin}\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n")
    return yaml


def arena_maps(arena: Arena, folder: Path, count: int) -> tuple[list[TopometricMap], list[Sim3]]:
    """Maps of an arena, each in a frame of its own, and T_0k of each."""
    yaws = np.random.default_rng(arena.seed).uniform(-3, 3, count)
    maps = [tm.extract(tm.read_points(save_grid(arena, folder, k, count, float(yaws[k])))) for k in range(count)]
    return maps, [Sim3(float(yaws[0] - yaws[k])) for k in range(count)]
