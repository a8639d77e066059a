"""What speaks for and against a pose, counted on the bent maps; the bending itself is evidence, too."""

from __future__ import annotations

from topomerge.fusion.bend.bend import Bend, bend
from topomerge.fusion.judge import Judge
from topomerge.fusion.prepared import Prepared
from topomerge.fusion.winner_features import winner_features
from topomerge.types import Sim3

RIGID_FEATURES = {"strain": 0.0, "bent": 0.0, "farthest": 0.0, "doubted": 0.0, "bent_pieces": 0.0, "rmse": float("nan")}


def judged_as_bent(a: Prepared, b: Prepared, pose: Sim3, scaled: bool) -> tuple[Bend, dict[str, float]]:
    """Both maps bent onto each other near a pose T_ab, and what the bent maps are judged by: features of `Judge`, of
    `winner_features` and of `Bend`."""
    bent = bend(a, b, pose, scaled=scaled)
    judge = Judge(a.storeys, bent.storeys(b.storeys))
    return bent, {**judge(bent.transform), **winner_features(judge, bent.transform), **RIGID_FEATURES, **bent.features}
