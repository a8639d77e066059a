"""Real storeys to develop on: which pairs must not be merged, which may, and that their walls agree under the truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from topomerge.datasets.pairs.pairs import Pair
from topomerge.datasets.real import sources, storeys
from topomerge.datasets.real import sources as wall_fit


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Every map of the set, each a room of another size."""
    place = tmp_path / "storeys_jsk"
    place.mkdir()
    names = [f"{b}-{s}" for b, of in storeys.STOREYS.items() for s in of] + list(storeys.YEARS[:-1])
    for k, name in enumerate(names):
        image = np.full((120, 160), 205, np.uint8)
        image[20:90, 20 : 120 + 2 * k] = 0
        image[23:87, 23 : 117 + 2 * k] = 254
        Image.fromarray(image).save(place / f"{name}.png")
        (place / f"{name}.yaml").write_text(f"image: {name}.png\nresolution: 0.05\norigin: [0, 0, 0]\n")
    return place


def test_storeys_have_no_truth_and_years_of_one_storey_have(folder: Path) -> None:
    made = {name: make() for name, make in storeys.iter_pairs(folder)}
    apart = [p for p in made.values() if p.kind == "other-storey"]
    together = [p for p in made.values() if p.kind == "overlap"]
    assert len(apart) == 9 + 3 and len(together) == 6 and len(made) == 18
    assert all(p.truth is None and p.overlap == 0 for p in apart) and all(p.truth is not None for p in together)
    assert "eng2-7f-8f" not in made  # drawn over a copy: nobody could tell these apart
    assert {p.building for p in made.values()} == {"eng2", "eng8"}


def test_they_are_read_where_they_are_named_only(folder: Path) -> None:
    assert sum(isinstance(p, Pair) for _, p in sources.iter_real_pairs(folder.parent, ["storeys"])) == 18
    assert not any("eng2" in name for name, _ in sources.iter_real_pairs(folder.parent))


@pytest.mark.longer
@pytest.mark.data
def test_walls_of_one_storey_agree_over_the_years(data_dir: Path) -> None:
    makers = dict(storeys.iter_pairs(data_dir / sources.DEVELOPMENT_FOLDERS["storeys"]))
    assert wall_fit.measure_residual(makers["eng2-7f_2019-7f"]()).median < 0.05
