"""Rules of the house that a machine can hold: imports go one way, every package is shipped, nothing is unpickled."""

from __future__ import annotations

import ast
import gc
import re
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
# Lower may not import higher. Names of the same rank may import each other within their package only.
RANKS = {
    "blas": 0,
    "errors": 0,
    "code_digest": 0,
    "registry": 0.5,
    "writers": 0,
    "progress": 0,
    "kernels": 0,
    "types": 1,
    "archive": 1.2,
    "structure": 1.5,  # what exports draw
    "io": 2,
    "numpy_nn": 2,
    "networks": 1.9,  # pictures of plans are read by one
    "extraction": 3,
    "edits": 3.5,  # maps as somebody corrected them: what all else reads
    "embedding": 4,
    "matching": 5,
    "landmarks": 5.2,  # testimony beyond walls
    "registration": 5.5,
    "fusion": 6,
    "changes": 6.5,  # between two maps that lie in one frame
    "viz": 7,
    "studio": 7.5,
    "models": 8,
    "configs": 8,
    "config": 8,
    "metrics": 8,
    "statistics": 8,
    "datasets": 9,
    "checkpoint": 9,
    "training": 10,
    "evaluation": 11,
    "cli": 13,
    "__main__": 15,
}
HEAVY = ("torch", "torch_geometric", "lightning_fabric", "hydra", "omegaconf", "open3d", "laspy", "pye57", "ifcopenshell", "bcf")
HEAVY += ("onnxruntime", "onnx")
HEAVY += ("trimesh", "rosbags", "rapidocr_onnxruntime", "pupil_apriltags", "cv2", "ezdxf", "pypdfium2", "resvg_py")


def sources() -> list[tuple[str, str, Path]]:
    """(package below topomerge, module, file) of every Python file that is installed."""
    found = []
    for folder in ("topomerge", "models", "datasets", "configs"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            name = parts[1] if folder == "topomerge" else folder
            found.append((name, ".".join(parts), path))
    return found


@cache
def tree_of(path: Path) -> ast.Module:
    """A file's syntax tree, parsed once for all rules."""
    gc.disable()  # it would look through all trees again and again, here and in each rule
    try:
        return ast.parse(path.read_text())
    finally:
        gc.freeze()
        gc.enable()


def iter_blocks(node: ast.AST) -> Iterator[ast.AST]:
    """The statements, handlers and cases right below a node, in their order: expressions, most of a tree, are not looked into."""
    for name in ("body", "cases", "handlers", "orelse", "finalbody"):
        yield from getattr(node, name, ())


def list_statements(tree: ast.AST) -> list[ast.AST]:
    """All statements below a node, in their order."""
    found: list[ast.AST] = []
    for child in iter_blocks(tree):
        found += [child, *list_statements(child)]
    return found


@cache
def imports(path: Path) -> list[tuple[str, bool, int]]:
    """(module, at the top level of the file?, line) of every import, leaving out those for type checkers."""
    found: list[tuple[str, bool, int]] = []

    def visit(node: ast.AST, top: bool) -> None:
        for child in iter_blocks(node):
            if isinstance(child, ast.Import):
                found.extend((a.name, top, child.lineno) for a in child.names)
            elif isinstance(child, ast.ImportFrom):
                assert child.level == 0, f"{path}:{child.lineno}: import absolutely"
                found.extend((f"{child.module}.{a.name}", top, child.lineno) for a in child.names)
            elif isinstance(child, ast.If) and getattr(child.test, "id", "") == "TYPE_CHECKING":
                continue
            else:
                visit(child, top and not isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef)))

    visit(tree_of(path), True)
    return found


def find_wrong_imports(package: str, path: Path) -> Iterator[str]:
    """Yield the imports of a file that lead up, to another name of the house, or are heavy at the top of the file."""
    if package not in RANKS:
        yield f"{path}: give {package} a rank in this test"
        return
    for name, top, line in imports(path):
        first, *rest = name.split(".")
        where = f"{path}:{line}: {name}"
        if first in ("models", "datasets", "configs"):
            yield f"{where}: import topomerge.{first}"
        if top and first in HEAVY and package not in ("models", "training", "checkpoint"):
            yield f"{where}: import it inside the function that needs it"
        other = rest[0] if first == "topomerge" and rest else package
        if other != package and other in RANKS and RANKS[other] >= RANKS[package]:
            yield f"{where}: {package} must not import {other}"


def test_imports_go_one_way():
    files = [(package, path) for package, _, path in sources() if package != "__init__"]  # the lazy face names everything
    wrong = [fault for package, path in files for fault in find_wrong_imports(package, path)]
    assert not wrong, "\n".join(wrong)


def test_every_package_is_shipped():
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    listed = set(settings["packages"])
    mapped = {"topomerge": "topomerge", **{n: f"topomerge.{n}" for n in ("models", "datasets", "configs")}}
    for folder, name in mapped.items():
        for init in (ROOT / folder).rglob("__init__.py"):
            parts = init.parent.relative_to(ROOT / folder).parts
            assert ".".join((name, *parts)) in listed, f"{init.parent} is not in pyproject's list of packages"
        for path in (ROOT / folder).rglob("*.py"):
            assert (path.parent / "__init__.py").exists(), f"{path.parent} has no __init__.py"
        for path in (ROOT / folder).rglob("*.*"):  # folders of data are packages to setuptools, too, and told apart by nothing
            parts = path.parent.relative_to(ROOT / folder).parts
            if path.is_file() and "__pycache__" not in parts:
                assert ".".join((name, *parts)) in listed, f"{path.parent} is not in pyproject's list of packages"


def test_nothing_is_unpickled():
    for _, _, path in sources():
        if not re.search(r"pickle|dill|joblib|load", path.read_text()):
            continue
        for node in ast.walk(tree_of(path)):
            if isinstance(node, ast.Call):
                called = ast.unparse(node.func)
                where = f"{path}:{node.lineno}"
                assert (
                    called.split(".")[0] not in ("pickle", "dill", "joblib")
                    or called.endswith(("Parallel", "delayed"))
                    or (not called.endswith(("load", "loads")))
                ), f"{where}: {called}"
                keywords = {k.arg: ast.unparse(k.value) for k in node.keywords}
                assert keywords.get("allow_pickle", "False") == "False", where
                if called in ("np.load", "numpy.load"):
                    assert keywords.get("allow_pickle") == "False", f"{where}: say allow_pickle=False"
                if called == "torch.load":
                    assert keywords.get("weights_only") == "True", f"{where}: say weights_only=True"


@pytest.mark.parametrize("name", ["datasets", "models"])
def test_a_second_copy_of_every_class_is_refused(name):
    import importlib
    import sys

    sys.path.insert(0, str(ROOT))
    try:
        spec = importlib.machinery.PathFinder.find_spec(name, [str(ROOT)])
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        with pytest.raises(ImportError, match=f"import topomerge.{name}"):
            spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(ROOT))
