"""What the places that two maps share say of a pose, one by one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from topomerge.matching.plan_fields import PlanFields
from topomerge.registration.evidence.crops import Crops, crops
from topomerge.registration.evidence.network import place_log_odds
from topomerge.types import Array, Sim3

MOST_ODDS = 4.0  # log odds: one place never says more
WORST = 1 / 3  # of the places: the worst ones


@dataclass(frozen=True, eq=False)
class Places:
    """Squares of two maps under a pose, k of them, and what each says.

    Args:
        crops: what both maps show; middles in the frame of map a.
        log_odds: (k,) that it is one place and no look-alike, before any prior.
    """

    crops: Crops
    log_odds: Array

    def __len__(self) -> int:
        return len(self.log_odds)

    def inverse(self, pose: Sim3) -> Places:
        """The same places seen from b; `pose` is T_ab."""
        c = self.crops
        exchanged = (c.parts[:, ::-1], c.ceiling[:, ::-1], c.looked[:, ::-1], pose.inverse().apply(c.middle), c.area)
        return replace(self, crops=Crops(*exchanged))

    @property
    def features(self) -> dict[str, float]:
        """For the whole-map models: mean of the log odds, that of the worst ones, and the m2 of floor that they are of. Large
        places count more, none more than a full tile."""
        odds = np.clip(self.log_odds, -MOST_ODDS, MOST_ODDS)
        area, total = self.crops.area, float(self.crops.area.sum())
        if not len(odds):
            return {"place_mean": 0.0, "place_worst": 0.0, "place_area": 0.0}
        order = np.argsort(odds, kind="stable")
        share = np.cumsum(area[order]) / total
        worst = order[: max(int(np.searchsorted(share, WORST)) + 1, 1)]
        mean, low = (float(np.average(odds[k], weights=area[k])) for k in (slice(None), worst))
        return {"place_mean": mean, "place_worst": low, "place_area": total}


def places(a: Sequence[PlanFields], b: Sequence[PlanFields], pose: Sim3) -> Places:
    """What the storeys of two maps show of the same places under a pose T_ab."""
    seen = crops(a, b, pose)
    return Places(seen, place_log_odds(seen))
