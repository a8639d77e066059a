"""Which captures the two maps of a real pair come from: two halves of one log are one capture, told twice.

Nothing that makes pairs imports this, so that what is known here changes no file of a cache.
"""

from __future__ import annotations

from topomerge.datasets.real.sources import REAL_SOURCES

from topomerge.errors import InputError

PROLONGED = {"2017": "2016"}  # session -> the one whose map it goes on from, and whose pixels it repeats where nothing moved


def captures(source: str, title: str) -> tuple[str, str]:
    """Names of the captures, within the source, that map a and map b of a real pair come from; equal ones are one capture.

    Halmstad: each walk with a phone, and each drawing, is a capture of its own. UTexas: the robot grid and the line map of a
    floor are two surveys, while the partial grids hold the very pixels of the whole ones. STRANDS: a session each, but for that
    of 2017. CARMEN: the log. IFC: the model, as the rays of its scan are cast at the model's own walls.

    Args:
        title: of the pair, as `pairs` of the source's module names it.

    Raises:
        InputError: another source, or a title that its module does not give.
    """
    words = title.split("-")
    if source == "halmstad" and len(words) == 2:
        return words[0], words[1]
    if source == "utexas" and len(words) == 2:
        return f"{words[0]} grid", f"{words[0]} {'lines' if words[1] == 'lines' else 'grid'}"
    if source == "strands" and len(words) == 3:
        first, second = (PROLONGED.get(year, year) for year in words[1:])
        return f"{words[0]} {first}", f"{words[0]} {second}"
    if source == "carmen" and len(words) >= 3:
        log = "-".join(words[:-2])
        return log, log
    if source == "ifc" and len(words) >= 2:
        model = title.removesuffix("-scan")
        return model, model
    raise InputError(f"{source}/{title}: no such real pair; its source is one of {', '.join(REAL_SOURCES)}")
