"""Which maps of an atlas each is searched in: all others where they are few, else those that its rooms look most like."""

from __future__ import annotations

from collections.abc import Iterable

from topomerge.fusion.atlas.maps import Maps
from topomerge.fusion.atlas.neighbours import most_alike
from topomerge.fusion.atlas.pairs import promise

MOST_PARTNERS = 10  # maps that a map names to be searched in


def partners_of(maps: Maps, linked: Iterable[tuple[int, int]] = ()) -> list[list[int]]:
    """For each map those that it may be searched in, most promising first: all others where they are few, else the ten that its
    rooms look most like, those that name it and those that it is `linked` with. A map without rooms names the largest ones."""
    count = len(maps)
    if count <= MOST_PARTNERS + 1:
        pairs = {(i, j) for j in range(count) for i in range(j)}
    else:
        by_area = sorted(range(count), key=lambda k: -maps.area(k))
        named = enumerate(most_alike([maps.rows(k) for k in range(count)], MOST_PARTNERS))
        pairs = {(min(k, m), max(k, m)) for k, of in named for m in of or [m for m in by_area if m != k][:MOST_PARTNERS]}
    pairs |= {(min(pair), max(pair)) for pair in linked}
    partners: list[dict[int, float]] = [{} for _ in range(count)]
    for i, j in sorted(pairs):
        partners[i][j] = partners[j][i] = promise(maps, i, j)
    return [[m for _, m in sorted((-likely, m) for m, likely in of.items())] for of in partners]
