"""pairs.json of an atlas: the registrations of its maps, so that none is made twice. It may be deleted."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from topomerge import __version__
from topomerge.fusion.atlas.solve import RegistrationsByPair
from topomerge.fusion.verify import model
from topomerge.io.listing import plain
from topomerge.matching.poses import PoseHypothesis
from topomerge.types import Sim3

PAIRS_FILE, PAIRS_FORMAT = "pairs.json", 1


def read_registrations(folder: Path, settings: Mapping[str, Any]) -> RegistrationsByPair:
    """The registrations of an atlas; none where the file is missing, damaged or of another version.

    Args:
        settings: of the atlas.
    """
    try:
        listing = json.loads((folder / PAIRS_FILE).read_text(encoding="utf-8"))
        if listing["format"] != PAIRS_FORMAT or listing["stamp"] != _stamp(settings):
            return {}
        return {(p["maps"][0], p["maps"][1]): tuple(_hypothesis(h) for h in p["hypotheses"]) for p in listing["pairs"]}
    except (OSError, ValueError, KeyError, TypeError, IndexError, AttributeError, OverflowError, RecursionError):
        return {}


def registrations_to_json(
    registrations: RegistrationsByPair, keys: Collection[str], settings: Mapping[str, Any]
) -> dict[str, Any]:
    """What `read_registrations` reads, of the maps with these keys."""
    pairs = [
        {"maps": list(pair), "hypotheses": [_listed(h) for h in hypotheses]}
        for pair, hypotheses in sorted(registrations.items())
        if set(pair) <= set(keys)
    ]
    return {"format": PAIRS_FORMAT, "stamp": _stamp(settings), "pairs": pairs}


def _stamp(settings: Mapping[str, Any]) -> str:
    """What registrations depend on beside the maps."""
    inputs = [__version__, model(), settings["scale"], str(settings["embedder"]), settings["same"]]
    return hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()[:16]


def _hypothesis(listed: Mapping[str, Any]) -> PoseHypothesis:
    x, y, z = map(float, listed["translation"])
    p = float(listed["probability"])
    if not 0 <= p <= 1:
        raise ValueError(f"probability {p}")
    pose = Sim3(float(listed["yaw"]), (x, y, z), float(listed["scale"]))
    return PoseHypothesis(pose, probability=p, features={str(k): float(v) for k, v in listed["features"].items()})


def _listed(hypothesis: PoseHypothesis) -> dict[str, Any]:
    pose = hypothesis.transform
    return {
        "yaw": pose.yaw,
        "translation": list(pose.translation),
        "scale": pose.scale,
        "probability": hypothesis.probability,
        "features": plain(dict(hypothesis.features)),
    }
