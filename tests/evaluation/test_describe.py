"""Cached descriptors belong to the code and the data that made them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from tests.package_copy import copied, edit
from tests.scenes_map import building
from topomerge.code_digest import compute_code_digest
from topomerge.evaluation import predict
from topomerge.evaluation.predict import DescriptorCache


def other_scale(package: Path) -> None:
    with (package / "embedding" / "engineered.json").open("ab") as file:
        file.write(b" ")


def other_kernel(package: Path) -> None:
    edit(package / "kernels" / "voxels.py", "from __future__", "ANOTHER = 1\nfrom __future__")


def other_network(package: Path) -> None:
    edit(package / "embedding" / "network.py", "from __future__", "ANOTHER = 1\nfrom __future__")


@pytest.mark.parametrize(("change", "files"), [(other_scale, 2), (other_kernel, 2), (other_network, 1)])
def test_descriptors_of_other_code_are_refused(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, change: Callable[[Path], None], files: int
) -> None:
    package = copied(tmp_path / "package")
    change(package)
    source = tmp_path / "a.tmap"
    source.write_bytes(b"the map")
    shelf = DescriptorCache(tmp_path / "shelf", source)
    first, _ = shelf.get_rows(building(), {"name": "engineered"}, 0)
    monkeypatch.setattr(predict, "compute_code_digest", partial(compute_code_digest, package=package))
    again, _ = shelf.get_rows(building(), {"name": "engineered"}, 0)
    assert len(list(shelf.folder.iterdir())) == files and (first == again).all()
