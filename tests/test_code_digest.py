"""What a cache depends on: code at any distance and the data files that it reads, but no comments."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.cases import list_longer
from tests.package_copy import ROOT, copied, edit, edited_kernel
from topomerge.code_digest import compute_code_digest, compute_data_digest, find_data_files, find_reached_modules

EXTRACT = "topomerge.extraction.extract"


@pytest.fixture(scope="module")
def before(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return copied(tmp_path_factory.mktemp("before"))


@pytest.fixture
def after(tmp_path: Path) -> Path:
    return copied(tmp_path)


def test_the_same_files_in_another_folder_have_the_same_digest(before, after):
    assert compute_code_digest(EXTRACT, package=before) == compute_code_digest(EXTRACT, package=after)
    assert compute_data_digest(EXTRACT, package=before) == compute_data_digest(EXTRACT, package=after)


def test_a_kernel_changes_the_digest_of_all_that_reach_it(before, tmp_path):
    after = edited_kernel(tmp_path, "ANOTHER = 1")
    pairs = "topomerge.datasets.pairs.example"
    assert "topomerge.kernels.voxels" in find_reached_modules(EXTRACT, package=before)
    assert compute_code_digest(EXTRACT, package=before) != compute_code_digest(EXTRACT, package=after)
    assert compute_code_digest(pairs, package=before) != compute_code_digest(pairs, package=after)
    assert compute_code_digest("topomerge.errors", package=before) == compute_code_digest("topomerge.errors", package=after)
    assert compute_data_digest(EXTRACT, package=before) == compute_data_digest(EXTRACT, package=after)


def test_comments_docstrings_and_layout_keep_the_digest(before, after):
    kernel = after / "kernels" / "voxels.py"
    edit(kernel, '"""', '"""Other words. ')
    edit(kernel, "from __future__ import annotations", "# why\n\n\n\nfrom __future__ import annotations  # so")
    assert compute_code_digest(EXTRACT, package=before) == compute_code_digest(EXTRACT, package=after)


@pytest.mark.parametrize(
    ("module", "name"),
    [
        ("topomerge.fusion.pipeline", "registration/calibration.json"),
        (EXTRACT, "networks/plan_network.onnx"),
        ("topomerge.matching.match", "networks/room_matcher.card.json"),
        (EXTRACT, "extraction/passages.json"),
        *list_longer(
            ("topomerge.embedding.engineered", "embedding/engineered.json"),
            ("topomerge.embedding.learned", "networks/embedder.onnx"),
            (EXTRACT, "networks/grid_network.onnx"),
            (EXTRACT, "networks/wall_network.onnx"),
            ("topomerge.matching.match", "networks/room_matcher.onnx"),
            ("topomerge.fusion.pipeline", "networks/place_network.onnx"),
            (EXTRACT, "extraction/elevations/wall_doors.json"),
            (EXTRACT, "extraction/room_odds.json"),
            ("topomerge.datasets.pairs.example", "extraction/plans/door_classifier.json"),
        ),
    ],
)
def test_packaged_data_changes_the_digest_of_its_readers(before, after, module, name):
    with (after / name).open("ab") as file:
        file.write(b" ")
    assert compute_code_digest(module, package=before) != compute_code_digest(module, package=after)
    assert compute_data_digest(module, package=before) != compute_data_digest(module, package=after)
    assert compute_code_digest("topomerge.kernels.voxels", package=before) == compute_code_digest(
        "topomerge.kernels.voxels", package=after
    )


@pytest.mark.longer
def test_every_packaged_weight_and_table_is_seen(before):
    modules = [p for folder in ("topomerge", "datasets", "models") for p in (before.parent / folder).rglob("*.py")]
    seen = {file for path in modules for file in find_data_files(path, before)}
    packaged = {p for s in ("json", "npz", "onnx", "safetensors", "txt") for p in before.parent.rglob(f"*.{s}")}
    assert packaged and packaged <= seen, sorted(packaged - seen)


def small_package(folder: Path, **files: str) -> Path:
    """A package `topomerge` of a few modules; `__` in their names parts folders."""
    package = folder / "topomerge"
    for name, text in files.items():
        path = package / (name.replace("__", "/") + ".py")
        path.parent.mkdir(parents=True, exist_ok=True)
        (path.parent / "__init__.py").touch()
        path.write_text(text, encoding="utf-8")
    (package / "__init__.py").write_text(json.dumps({}) + '\n_HOMES = {"extract": "topomerge.home"}\n', encoding="utf-8")
    return package


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("import topomerge.home", {"home"}),
        ("from topomerge.home import thing", {"home"}),
        ("from topomerge import home", {"home"}),
        ("def f():\n    from topomerge import extract\n", {"home"}),
        ("import topomerge\ntopomerge.extract()", {"home"}),
        ("import importlib\nimportlib.import_module('topomerge.home')", {"home"}),
        ("from importlib import import_module\nimport_module(f'topomerge.io.{x}')", {"io.a", "io.b", "io", "home"}),
        ("from topomerge.io.b import b", {"io.b", "io", "home"}),
        ("if TYPE_CHECKING:\n    from topomerge.home import thing\n", set()),
        ("import numpy", set()),
    ],
)
def test_what_is_followed(tmp_path, text, names):
    package = small_package(tmp_path, start=text, home="thing = 1", io__a="", io__b="from topomerge.home import thing")
    assert set(find_reached_modules("topomerge.start", package=package)) == {
        "topomerge.start",
        *(f"topomerge.{n}" for n in names),
    }


def test_circles_end(tmp_path):
    package = small_package(tmp_path, a="import topomerge.b", b="import topomerge.a")
    assert len(find_reached_modules("topomerge.a", package=package)) == 2


def test_a_module_that_does_not_exist(before):
    with pytest.raises(ModuleNotFoundError, match=r"topomerge\.nothing"):
        compute_code_digest("topomerge.nothing", package=before)


def test_nothing_is_imported():
    code = (
        "import sys; from topomerge.code_digest import compute_code_digest as d; d('topomerge.kernels.voxels'); "
        "print(*sys.modules)"
    )
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT).stdout.split()
    assert not {"numpy", "numba", "torch", "topomerge.kernels.voxels"} & set(loaded)
