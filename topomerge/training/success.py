"""Merge success of a network while it is trained: do the rooms that it matches put one map where it belongs in the other?

A cheap stand-in for `merge` (`matching.pose_of_matches`): good to compare epochs and networks.
"""

from __future__ import annotations

import numpy as np

from topomerge.types import Array, Sim3

RIGHT_WITHIN = (0.5, 5.0)  # m, degrees


def merged_right(pose: Sim3 | None, truth: Array, at: Array) -> bool:
    """Is a pose right within 0.5 m and 5 degrees?

    Args:
        truth: (4, 4) T_ab.
        at: (3,) a point of b, where the error is measured.
    """
    if pose is None:
        return False
    off = pose.apply(at[None])[0] - (truth[:3, :3] @ at + truth[:3, 3])
    turned = pose.yaw - np.arctan2(truth[1, 0], truth[0, 0])
    turned = abs(np.degrees((turned + np.pi) % (2 * np.pi) - np.pi))
    return bool(np.linalg.norm(off) <= RIGHT_WITHIN[0] and turned <= RIGHT_WITHIN[1])
