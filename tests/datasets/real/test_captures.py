"""Two maps are independent evidence only where nobody drew the one from what the other was drawn from.

Real pairs that are extracted once belong to their files and to the code that extracted them.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import pytest
from topomerge.datasets.real import maps
from topomerge.datasets.real.sources import REAL_FOLDERS, REAL_SOURCES, find_captures, iter_pair_makers

from tests.package_copy import edited_kernel
from topomerge.code_digest import compute_code_digest
from topomerge.errors import InputError


@pytest.mark.parametrize(
    ("source", "title", "expected"),
    [
        ("halmstad", "HIH_01-HIH_02", ("HIH_01", "HIH_02")),
        ("halmstad", "KPT4A_03-KPT4A_layout", ("KPT4A_03", "KPT4A_layout")),
        ("utexas", "gdc1-lines", ("gdc1 grid", "gdc1 lines")),
        ("utexas", "gdc3-3ne", ("gdc3 grid", "gdc3 grid")),
        ("strands", "tsc-2015-2016", ("tsc 2015", "tsc 2016")),
        ("strands", "tsc-2015-2017", ("tsc 2015", "tsc 2016")),
        ("strands", "tsc-2016-2017", ("tsc 2016", "tsc 2016")),
        ("carmen", "freiburg-101-first-last", ("freiburg-101", "freiburg-101")),
        ("ifc", "Office_A_20110811-scan", ("Office_A_20110811", "Office_A_20110811")),
    ],
)
def test_captures_by_hand(source: str, title: str, expected: tuple[str, str]) -> None:
    assert find_captures(source, title) == expected


@pytest.mark.parametrize(("source", "title"), [("strands", "tsc-2015"), ("r2v", "a-b"), ("halmstad", "HIH_01")])
def test_other_titles_are_refused(source: str, title: str) -> None:
    with pytest.raises(InputError, match=f"{source}/{title}: no such real pair"):
        find_captures(source, title)


@pytest.mark.data
def test_the_independent_pairs_of_each_source(data_dir: Path) -> None:
    titles = {source: [title for title, _ in iter_pair_makers(source, data_dir)] for source in REAL_SOURCES}
    pairs = {source: [find_captures(source, title) for title in names] for source, names in titles.items()}
    assert {source: (len(p), sum(a != b for a, b in p)) for source, p in pairs.items()} == {
        "halmstad": (20, 20),
        "utexas": (7, 4),
        "strands": (3, 2),
        "carmen": (15, 0),
        "ifc": (2, 0),
    }


def test_maps_of_other_code_or_files_are_refused(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    file = tmp_path / REAL_FOLDERS["strands"] / "a.yaml"
    file.parent.mkdir()
    file.write_text("one")
    before = maps.compute_source_digest(tmp_path, "strands", 0.1)
    assert before == maps.compute_source_digest(tmp_path, "strands", 0.1) != maps.compute_source_digest(tmp_path, "strands", 0.2)
    file.write_text("two")
    assert maps.compute_source_digest(tmp_path, "strands", 0.1) != before
    file.write_text("one")
    monkeypatch.setattr(
        maps, "compute_code_digest", partial(compute_code_digest, package=edited_kernel(tmp_path / "package", "ANOTHER = 1"))
    )
    assert maps.compute_source_digest(tmp_path, "strands", 0.1) != before
