"""A matching as JSON and as a table."""

from __future__ import annotations

import math
from typing import Any

from topomerge.io.listing import plain
from topomerge.matching.poses import PoseHypothesis
from topomerge.matching.result import Matching
from topomerge.types import LEVELLED, Array, TopometricMap, between_files, is_level

MATCHING_FORMAT = 1


def matching_to_json(matching: Matching, a: TopometricMap, b: TopometricMap) -> dict[str, Any]:
    """Rooms with their probabilities and all hypotheses; matrices are row-major and map points of the file of b into
    the frame of that of a."""
    rows = zip(matching.rooms.tolist(), matching.probability.tolist(), strict=True)
    listing = {
        "format": MATCHING_FORMAT,
        "maps": [map_to_entry(m) for m in (a, b)],
        "matches": [{"rooms": rooms, "probability": round(p, 4)} for rooms, p in rows],
        "hypotheses": [_hypothesis(h, between_files(h.transform, b.levelling, a.levelling)) for h in matching.alternatives],
        "statistics": dict(matching.statistics),
    }
    out: dict[str, Any] = plain(listing)
    return out


def map_to_entry(map: TopometricMap) -> dict[str, Any]:
    """What a listing of several maps says of each: its file, how many rooms and storeys it has, and how it was levelled."""
    levelled = {} if is_level(map.levelling) else {LEVELLED: map.levelling.tolist()}
    return {"source": map.source, "rooms": len(map.rooms), "storeys": len(map.storeys), **levelled}


def _hypothesis(h: PoseHypothesis, matrix: Array) -> dict[str, Any]:
    return {
        "probability": round(h.probability, 4),
        "score": round(h.score, 3),
        "transform": {"matrix": matrix.tolist(), "scale": h.transform.scale, "yaw": h.transform.yaw},
        "rooms": h.rooms.tolist(),
        "evidence": dict(h.features),
    }


def matching_to_text(matching: Matching, a: TopometricMap, b: TopometricMap) -> str:
    """The table that `topomerge match` prints."""
    lines = [f"{len(matching.rooms)} matches of {len(a.rooms)} and {len(b.rooms)} rooms"]
    if len(matching.rooms):
        lines += ["", "room a  area m2   room b  area m2   probability"]
    for (i, j), p in zip(matching.rooms.tolist(), matching.probability.tolist(), strict=True):
        lines.append(f"{i:>6}  {a.rooms['area'][i]:>7.1f}   {j:>6}  {b.rooms['area'][j]:>7.1f}   {p:>11.2f}")
    if matching.alternatives:
        lines += ["", "hypothesis  probability  matches  yaw deg        x        y        z  scale"]
    for k, h in enumerate(matching.alternatives[:5]):
        numbers = "  ".join(f"{v:>7.2f}" for v in h.transform.translation)
        yaw = math.degrees(h.transform.yaw)
        lines.append(f"{k:>10}  {h.probability:>11.2f}  {len(h.rooms):>7}  {yaw:>7.1f}  {numbers}  {h.transform.scale:>5.3f}")
    return "\n".join(lines)
