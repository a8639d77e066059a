"""What all types stand on: the type of an array, and the check of a condition."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


def require(condition: bool, message: str) -> None:
    """Refuse what a type can't hold.

    Raises:
        ValueError: the condition does not hold.
    """
    if not condition:
        raise ValueError(message)


def within_turn(angle: Any, turn: float) -> Any:
    """The same angle, rad, in [0, turn): the remainder of next to nothing below 0 is `turn` itself by rounding, which is 0."""
    rest = np.asarray(angle, float) % turn
    return np.where(rest < turn, rest, 0.0)
