"""One office floor, captured fourteen times with a depth-sensing phone and drawn once (Halmstad Robot Maps; Shahbandi 2019): for
development, not for evaluation.

Format and truth are those of the two apartments (`halmstad`). Drift bends the captures: key points fit a similarity to 0.3–0.5 m,
and no pose is right everywhere. They differ in scale by up to 4 %, the drawing by about a fifth; several show a few rooms only.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

from topomerge.datasets.pairs.pairs import Pair
from topomerge.datasets.real import halmstad

OFFICE_PIXEL = 0.03  # m; not published: offices and doors are of a plausible size with it


def iter_pairs(folder: Path) -> Iterator[tuple[str, Callable[[], Pair]]]:
    """Yield the name and maker of every pair of maps of the floor; their source is halmstad, their building F5.

    Raises:
        InputError: the list of pairs is missing or damaged.
    """
    return halmstad.iter_pairs(folder, OFFICE_PIXEL)
