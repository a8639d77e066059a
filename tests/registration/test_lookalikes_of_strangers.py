"""Places of strangers' worlds that look alike: none is one place under the pose that is found, and none may be believed."""

from __future__ import annotations

from pathlib import Path

import pytest

from topomerge.io.maps import load_map
from topomerge.registration.pipeline import register


@pytest.mark.data
@pytest.mark.parametrize("name", ["storeys_0", "storeys_1", "point_sym_3", "hotel_moved_1", "row_same_over_2"])
def test_a_look_alike_is_refused(case_dir: Path, name: str) -> None:
    a, b = (load_map(case_dir / "lookalikes" / f"{name}_{side}.tmap") for side in "ab")
    seen = register(a, b)
    assert not seen.accepted
    if name.startswith(("storeys", "point_sym")):  # told by furniture, and named
        assert seen.probability < 0.3 and seen.posterior["storey"] + seen.posterior["half"] > 0.6
