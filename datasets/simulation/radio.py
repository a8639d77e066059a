"""Access points in a building and what phones hear of them: the law of distance, walls and floors on the way, shadows, noise.

Strength falls with the logarithm of the distance (ITU-R P.1238), by a loss for each wall that the ray crosses on the plan of its
storey and for each floor, and by shadows that are alike nearby. Phones miss weak readings. Off unless it is asked for
(`RadioSettings.density`), and drawn from a generator of its own, so that nothing else changes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from topomerge.datasets.core.building import Building
from topomerge.datasets.simulation.floor_truth import rasterize_floors

from topomerge.errors import InputError
from topomerge.types import Array, Landmarks, build_landmarks

RADIO_CELL = 0.1  # m, of plans
AT_ONE_METRE = -40.0  # dBm
HUNG = 2.5  # m above the floor, access point
HELD = 1.2  # m above the floor, phone
SHADOW_REACH = 4.0  # m, over which shadows are alike
WEAK = 5.0  # dB above the sensitivity, where half of the readings are missed as often
RADIO_STREAM = 51  # of the generator, beside the seed


@dataclass(frozen=True)
class RadioSettings:
    """Access points and phones.

    Args:
        density: access points for 100 m2 of floor; 0: no radio.
        exponent: of the fall with distance.
        wall, floor: dB lost in each.
        shadow, noise: dB, standard deviations: of what stands in the way, the same at every visit; of each reading.
        gain: dB, standard deviation between phones.
        sensitivity: dBm, of the weakest readings.
        missed: share of the readings that a phone misses, of strong ones; of weak ones more.
        moved: share of the access points that stand elsewhere at another session.
    """

    density: float = 0.0
    exponent: float = 2.8
    wall: float = 4.0
    floor: float = 16.0
    shadow: float = 4.0
    noise: float = 3.0
    gain: float = 3.0
    sensitivity: float = -92.0
    missed: float = 0.1
    moved: float = 0.05

    def __post_init__(self) -> None:
        limits = {"density": 20.0, "exponent": 6.0, "missed": 1.0, "moved": 1.0, "sensitivity": 0.0}
        for name in (f.name for f in fields(self)):
            value, limit = getattr(self, name), limits.get(name, 100.0)
            least = -120.0 if name == "sensitivity" else 0.0
            if not least <= value <= limit:
                raise InputError(f"radio {name} must be {least:g} to {limit:g}, not {value}")


@dataclass(frozen=True, eq=False)
class RadioPlan:
    """Walls of one storey.

    Args:
        wall: (rows, columns) bool, x along columns.
        free: (k, 2) m, where an access point may hang.
        origin: (2,) m, of the raster.
        floor: m, height of the floor; level: number of the storey.
    """

    wall: Array
    free: Array
    origin: Array
    floor: float
    level: int = 0

    def count_walls(self, start: Array, end: Array) -> Array:
        """Count the walls between (n, 2) places and (m, 2) others: (n, m); a run of cells of wall is one."""
        out = np.zeros((len(start), len(end)), np.int64)
        for j, to in enumerate(end):
            steps = int(np.ceil(np.hypot(*(start - to).T).max(initial=0.0) / RADIO_CELL)) + 1
            share = np.linspace(0.0, 1.0, steps)[None, :, None]
            points = start[:, None] + (to - start)[:, None] * share
            cell = np.floor((points - self.origin) / RADIO_CELL).astype(np.int64)
            inside = ((cell >= 0) & (cell < self.wall.shape[::-1])).all(axis=2)
            x, y = np.moveaxis(np.where(inside[..., None], cell, 0), -1, 0)
            solid = self.wall[y, x] & inside
            out[:, j] = (solid[:, 1:] & ~solid[:, :-1]).sum(axis=1)
        return out


@dataclass(frozen=True, eq=False)
class AccessPoints:
    """Access points of a building: (n, 3) positions, m, and the level of each; `seed` of their shadows."""

    position: Array
    level: Array
    seed: int

    @property
    def addresses(self) -> list[str]:
        """Address of each, that no other seed has."""
        return [
            f"02:{self.seed >> 8 & 255:02x}:{self.seed & 255:02x}:00:{k >> 8:02x}:{k & 255:02x}" for k in range(len(self.level))
        ]


def build_radio_plans(building: Building) -> list[RadioPlan]:
    """Build the plans of a building's storeys; doorways count as walls."""
    floors = rasterize_floors(building, RADIO_CELL)
    plans = []
    for level, room in enumerate(floors.room):
        cells = np.argwhere(room >= 0)[:: max(int(1 / RADIO_CELL**2), 1)]
        free = floors.origin + (cells[:, ::-1] + 0.5) * RADIO_CELL
        plans.append(RadioPlan(room < 0, free, floors.origin, float(building.storeys["floor"][level]), level))
    return plans


def place_access_points(plans: Sequence[RadioPlan], settings: RadioSettings, seed: int) -> AccessPoints:
    """Place the access points of a building; `free` has a row for each m2."""
    rng = np.random.default_rng([seed, RADIO_STREAM])
    position, level = [], []
    for plan in plans:
        count = round(settings.density * len(plan.free) / 100)
        count = min(max(count, 1), len(plan.free)) if settings.density > 0 and len(plan.free) else 0
        at = plan.free[rng.choice(len(plan.free), count, replace=False)] if count else np.zeros((0, 2))
        position.append(np.column_stack([at, np.full(count, plan.floor + HUNG)]))
        level += [plan.level] * count
    return AccessPoints(np.concatenate(position), np.array(level, int), seed)


def simulate_readings(
    plans: Sequence[RadioPlan], points: AccessPoints, track: Array, level: int, settings: RadioSettings, session: int
) -> Landmarks:
    """Simulate what one phone hears at the places of a track on one storey.

    Args:
        track: (n, 2) m.
        session: number of the session: of its phone, its noise, and the access points that were moved.
    """
    rng = np.random.default_rng([points.seed, RADIO_STREAM, 1 + session])
    points = _move_points(plans, points, settings, rng) if session else points
    plan = next(p for p in plans if p.level == level)
    own = {p.level: p for p in plans}
    height = plan.floor + HELD
    gap = np.linalg.norm(track[:, None] - points.position[None, :, :2], axis=2)
    distance = np.maximum(np.hypot(gap, points.position[None, :, 2] - height), 1.0)
    walls = np.zeros(gap.shape)
    for other in np.unique(points.level).tolist():
        some = points.level == other
        walls[:, some] = own[other].count_walls(track, points.position[some, :2])
    strength = AT_ONE_METRE - 10 * settings.exponent * np.log10(distance) - settings.wall * walls
    strength -= settings.floor * np.abs(points.level - level)[None]
    strength += settings.shadow * _compute_shadows(track, points, level) + settings.gain * rng.normal()
    strength += settings.noise * rng.normal(size=strength.shape)
    probability = (1 - settings.missed) * np.clip((strength - settings.sensitivity) / WEAK, 0.0, 1.0)
    scan, readings = np.nonzero(rng.random(strength.shape) < probability)
    names = points.addresses
    position = np.column_stack([track, np.full(len(track), height)])[scan]
    number = np.round(strength[scan, readings])
    return build_landmarks("radio", [names[k] for k in readings], "simulated", position, sigma=0.3, number=number, group=scan)


def _compute_shadows(track: Array, points: AccessPoints, level: int) -> Array:
    """Return (n, m) standard normal shadows, alike over `SHADOW_REACH` and the same at every visit: sums of waves."""
    out = np.zeros((len(track), len(points.level)))
    waves = 24
    for j in range(len(points.level)):
        rng = np.random.default_rng([points.seed, RADIO_STREAM, 7, level + 100, j])
        wave, phase = rng.normal(0, 1 / SHADOW_REACH, (waves, 2)), rng.uniform(0, 2 * np.pi, waves)
        out[:, j] = np.sqrt(2 / waves) * np.cos(track @ wave.T + phase).sum(axis=1)
    return out


def _move_points(
    plans: Sequence[RadioPlan], points: AccessPoints, settings: RadioSettings, rng: np.random.Generator
) -> AccessPoints:
    position = points.position.copy()
    for k in np.flatnonzero(rng.random(len(position)) < settings.moved).tolist():
        plan = next(p for p in plans if p.level == points.level[k])
        position[k, :2] = plan.free[rng.integers(len(plan.free))]
    return replace(points, position=position)
