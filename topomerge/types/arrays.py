"""What all types stand on: the type of an array, and the check of a condition."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

Array = NDArray[Any]


def require(condition: bool, message: str) -> None:
    """Refuse what a type can't hold.

    Raises:
        ValueError: the condition does not hold.
    """
    if not condition:
        raise ValueError(message)
