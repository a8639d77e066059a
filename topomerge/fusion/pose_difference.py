"""How far two poses are apart."""

from __future__ import annotations

import numpy as np

from topomerge.types import Array, Sim3


def pose_difference(p: Sim3, q: Sim3, anchor: Array) -> tuple[float, float, float]:
    """How far two poses are apart: m at the anchor, rad, log scale.

    Args:
        anchor: (3,) m, a point of the moved map: the frame's origin may lie far away, where a small turn is a long way.
    """
    moved = float(np.linalg.norm(p.apply(anchor[None])[0] - q.apply(anchor[None])[0]))
    turned = abs(float((p.yaw - q.yaw + np.pi) % (2 * np.pi) - np.pi))
    return moved, turned, abs(float(np.log(p.scale / q.scale)))
