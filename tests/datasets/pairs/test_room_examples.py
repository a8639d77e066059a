"""Rooms of a scan with what is true about them: made once, under the name that is looked for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from topomerge.datasets.pairs.plan_examples import PlanRecipe, draw_item

from topomerge.training import room_odds
from topomerge.training.room_odds import ANSWERS, build_rooms, draw_room_item
from topomerge.training.settings import TaskSettings


def test_files_are_made_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[str] = []

    def rows(item, plan):
        made.append(item.name)
        return {"x": np.zeros((2, 3)), "about": np.frombuffer(b"{}", np.uint8), **dict.fromkeys(ANSWERS, np.ones(2))}

    monkeypatch.setattr(room_odds, "build_room_rows", rows)
    recipe, sharing = PlanRecipe("room_scans", scans=3, seed=5), TaskSettings(cache=str(tmp_path))
    paths = build_rooms(recipe, sharing)
    assert [path.stem for path in paths] == made and len(made) == 3
    assert build_rooms(recipe, sharing) == paths and len(made) == 3
    assert not {draw_room_item(n, {}).name for n in range(9)} & {draw_item(n, {}).name for n in range(9)}
