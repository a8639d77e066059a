"""The paper that a plan is drawn on: turned so that the walls run along its sides, in centimetres, y down."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from topomerge.types import Array, TopometricMap
from topomerge.viz.plan import Frame, StoreyPlan, frame_of, storey_plans

UPRIGHT_ANGLE = np.radians(3.0)  # buildings that stand this nearly upright are drawn as they are
TALL = 1.15  # turned buildings that are taller than wide by this are laid down


@dataclass(frozen=True, eq=False)
class Sheet:
    """Where things stand on the paper.

    Args:
        frame: the pixels of the plan.
        key: what the page puts before the numbers of this map's rooms.
        turn: rad, by which the building is turned against the clock.
        corner: (2,) m, the upper left corner of what is drawn, in the turned frame.
        size: width and height of what is drawn, cm.
    """

    frame: Frame
    key: str
    turn: float
    corner: Array
    size: tuple[int, int]

    def cm(self, points: Array) -> Array:
        """(n, 2) int64 places on the paper of (n, 2+) points in the input's frame, m."""
        turned = np.asarray(points, np.float64).reshape(-1, np.shape(points)[-1])[:, :2] @ rotation(self.turn).T
        return np.round(100 * (turned - self.corner) * (1, -1)).astype(np.int64)

    def metres(self, places: Array) -> Array:
        """(n, 2) m in the input's frame, of places (n, 2) on the paper, cm."""
        back = np.array(self.back).reshape(2, 3)
        out: Array = places @ back[:, :2].T + back[:, 2]
        return out

    def at(self, point: Any) -> tuple[int, int]:
        """The place on the paper of one point."""
        x, y = self.cm(np.asarray([point]))[0].tolist()
        return x, y

    def id(self, room: int) -> str:
        """What a room is called in the page."""
        return f"{self.key}{room}"

    @property
    def back(self) -> list[float]:
        """a, b, c, d, e, f: the paper's (X, Y) cm are (a X + b Y + c, d X + e Y + f) m of the input."""
        undo = rotation(-self.turn)
        scaled = undo * (0.01, -0.01)
        x, y = undo @ self.corner
        return [*scaled[0].tolist(), float(x), *scaled[1].tolist(), float(y)]


def rotation(angle: float) -> Array:
    """(2, 2)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


def lay_out(map: TopometricMap, key: str = "", turn: float | None = None) -> tuple[Sheet, list[StoreyPlan]]:
    """The paper for a map and the plan of each storey, lowest first.

    Args:
        map: any map.
        key: stands before the numbers of its rooms, to tell the rooms of several maps on a page apart.
        turn: rad, by which the building is turned against the clock; None: so that its walls run along the paper.
    """
    frame = frame_of(map)
    plans = storey_plans(map, frame)
    return sheet_for(plans, frame, key, turn), plans


def sheet_for(plans: list[StoreyPlan], frame: Frame, key: str = "", turn: float | None = None) -> Sheet:
    """The paper for the plans of all storeys."""
    mask = np.any([plan.room >= 0 for plan in plans], axis=0)
    if not mask.any():
        mask = np.any([plan.floor for plan in plans], axis=0)
    pixels = np.argwhere(mask)
    points = frame.centre(pixels) if len(pixels) else frame.low[None]
    if turn is None:
        turn = -direction(np.any([plan.wall for plan in plans], axis=0))
        turn = 0.0 if abs(turn) < UPRIGHT_ANGLE else turn
        wide, high = np.ptp(points @ rotation(turn).T, axis=0)
        if turn and high > TALL * wide:
            turn -= np.copysign(np.pi / 2, turn)
    turned = points @ rotation(turn).T
    low, top = turned.min(axis=0) - frame.size, turned.max(axis=0) + frame.size
    width, height = np.round(100 * (top - low)).astype(int).tolist()
    return Sheet(frame, key, float(turn), np.array([low[0], top[1]]), (width, height))


def direction(mask: Array) -> float:
    """rad in (-pi/4, pi/4], in which most walls of a raster run; walls at a right angle count as one direction.

    The gradient of the blurred raster stands across walls; its angles are averaged fourfold, so that the four sides of a
    room are one.
    """
    from scipy import ndimage

    if mask.sum() < 3:
        return 0.0
    field = np.pad(mask, 4).astype(np.float32)
    dx, dy = (ndimage.gaussian_filter(field, 1.5, order=order) for order in ((1, 0), (0, 1)))
    fourfold = ((dx + 1j * dy) ** 4).sum() / max(float((np.hypot(dx, dy) ** 4).sum()), 1e-12)
    return float(np.angle(fourfold) / 4) if abs(fourfold) > 0.05 else 0.0
