"""Two maps of an atlas laid on each other coarsely: searched and judged as they are, not bent.

It takes a tenth of the time of a registration and tells which pairs are worth one: rooms of a small map look like those of many
others, but its walls seldom fit as well.
"""

from __future__ import annotations

from topomerge.fusion.atlas.maps import Maps
from topomerge.fusion.judge import Judge
from topomerge.fusion.scale import search_scaled
from topomerge.fusion.search import search
from topomerge.fusion.verify import rank

NO_POSE = -30.0  # log odds where nothing can be laid on each other


def coarse_key(maps: Maps, i: int, j: int) -> tuple[str, str]:
    """Under which `Memory.coarse` holds two maps."""
    return min(maps.keys[i], maps.keys[j]), max(maps.keys[i], maps.keys[j])


def coarse_log_odds(maps: Maps, i: int, j: int, scale: str = "fixed") -> float:
    """Log odds that the best rigid pose of two maps is right, seen by itself; what is in `Memory.coarse` is not made again.

    Drift lowers them: of a real floor some right pairs have -7, as strangers of few rooms have.
    """
    pair, coarse = coarse_key(maps, i, j), maps.memory.coarse
    if pair not in coarse:
        first, second = sorted((maps.prepared(i), maps.prepared(j)), key=lambda m: m.order)
        hypotheses = (search_scaled if scale == "free" else search)(first.storeys, second.storeys)
        ranked = rank(hypotheses, Judge(first.storeys, second.storeys))
        coarse[pair] = ranked[0].score if ranked else NO_POSE
    return coarse[pair]
