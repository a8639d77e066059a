"""Real pairs that are extracted once belong to their files and to the code that extracted them."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import pytest
from topomerge.datasets.real import maps
from topomerge.datasets.real.sources import REAL_FOLDERS

from tests.package_copy import edited_kernel
from topomerge.code_digest import compute_code_digest


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
