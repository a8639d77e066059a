"""The wheel: it holds everything, and it works outside the checkout, without the learned part's libraries, and typed."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = ("topomerge", "models", "datasets", "configs")
pytestmark = pytest.mark.slow

NO_TORCH = """
import sys
class Refuse:
    def find_spec(self, name, *_):
        heavy = ("torch", "torch_geometric", "lightning_fabric", "hydra", "omegaconf", "open3d", "laspy", "pye57")
        if name.split(".")[0] in heavy:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Refuse())
from topomerge.cli.main import main
sys.exit(main(sys.argv[1:]))
"""


def tracked() -> list[str]:
    """Files of the packages that git does not ignore."""
    if shutil.which("git") is None or not (ROOT / ".git").exists():
        pytest.skip("no git checkout")
    words = ["git", "ls-files", "--cached", "--others", "--exclude-standard", *PACKAGES]
    return subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split("\n")[:-1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wheel built from a copy: a build must not leave anything in the checkout."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for name in [*tracked(), "pyproject.toml", "README.md", "LICENSE"]:
        if (ROOT / name).exists():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, source / name)
    words = ["pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "--wheel-dir", str(out), str(source)]
    subprocess.run([sys.executable, "-m", *words], check=True, timeout=300)
    (built,) = out.glob("topomerge-*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel in a folder of its own."""
    folder = tmp_path_factory.mktemp("installed")
    words = ["pip", "install", "--quiet", "--no-deps", "--target", str(folder), str(wheel)]
    subprocess.run([sys.executable, "-m", *words], check=True, timeout=300)
    return folder


def test_the_wheel_holds_every_file(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        inside = set(archive.namelist())
    requested = {name if name.startswith("topomerge/") else f"topomerge/{name}" for name in tracked() if (ROOT / name).exists()}
    assert requested <= inside, f"not in the wheel: {sorted(requested - inside)}"
    others = {name for name in inside if not name.startswith("topomerge/") and ".dist-info/" not in name}
    assert not others, f"installed beside topomerge: {sorted(others)}"
    assert "topomerge/py.typed" in inside


def test_two_clouds_are_merged_without_the_learned_part(installed: Path, tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(installed), "PYTHONSAFEPATH": "1"}

    def call(*words: str) -> None:
        done = subprocess.run(
            [sys.executable, "-c", NO_TORCH, *words], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr

    where = [sys.executable, "-c", "import topomerge; print(topomerge.__file__)"]
    assert subprocess.run(where, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True).stdout.startswith(
        str(installed)
    )
    call("simulate", "--building", "office", "--seed", "5", "--rooms", "8", "--overlap", "0.7", "-o", "pair")
    call("extract", "pair/a.ply", "-o", "a.tmap", "--report", "a.html")
    call("merge", "a.tmap", "pair/b.ply", "-o", "merged")
    assert sorted(p.name for p in (tmp_path / "merged").iterdir()) == ["map.tmap", "merge.json", "merged.ply", "report.html"]


def test_types_are_shipped(installed: Path, tmp_path: Path) -> None:
    pytest.importorskip("mypy")
    right = 'import topomerge as tm\n\nfound: tm.TopometricMap = tm.load_map("a.tmap")\nprint(found.rooms["area"])\n'
    (tmp_path / "right.py").write_text(right + "print(tm.merge([found, found]).probability + 1.0)\n")
    (tmp_path / "wrong.py").write_text(right + 'tm.merge("a.tmap").nothing\n')
    environment = {**os.environ, "MYPYPATH": str(installed)}
    for name, status in (("right", 0), ("wrong", 1)):
        words = [sys.executable, "-m", "mypy", "--strict", "--follow-imports=silent", f"{name}.py"]
        done = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == status, done.stdout
