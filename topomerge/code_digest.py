"""Digest of all that a cache depends on, as one short hash: the code that made its files, and the data that this code reads.

    key = code_digest("topomerge.extraction.extract")     # of everything that `extract` may run
    key = data_digest("topomerge.extraction.extract")     # of its packaged weights and tables only

A cache whose files are cheap to make again puts `compute_code_digest` of the module that makes them into their names: no edit,
neither of
a kernel three imports away nor of `calibration.json`, can leave an old file in use. A cache whose files take hours puts a version
number of its steps there instead, which whoever changes their results raises, and `compute_data_digest`: packaged weights change
without
anyone reading code. Name the modules that *make* the files, not those that only score or print them.

The walk reads syntax trees and imports nothing, so that it needs no torch and costs a second or two, once a process. It follows

- imports, also within functions, but not those for type checkers;
- ``import_module("topomerge.…")``, and where the name is put together (``f"topomerge.io.{name}"``) all modules of that package;
- names of the library's lazy face (``topomerge.extract``, ``from topomerge import extract``) to their homes;
- the `__init__` of every package on the way but the face;
- data files: those beside a module, or in a folder beside it, whose name, or that of the folder, stands as a text in the module;
- networks that a module names (``"plan_network.onnx"``), and their cards: in `topomerge/networks`, wherever the module stands.

Comments, docstrings and the layout of lines do not count. Python's own version and that of other libraries do not either.
"""

from __future__ import annotations

import ast
import hashlib
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path

HERE = Path(__file__).parent
TOP = "topomerge"
DATA_BESIDE = ("models", "datasets", "configs")  # installed below topomerge; in a checkout they stand next to it
LENGTH = 16  # hexadecimal digits
SKIPPED = (".py", ".pyc", ".pyi")
NETWORKS, NETWORK, CARD = "networks", ".onnx", ".card.json"  # folder of the networks that ship; how they and their cards end


@cache
def compute_code_digest(*modules: str, package: Path = HERE) -> str:
    """Compute the hash of modules, of all that they import within the house, and of the data files that these read.

    Args:
        modules: full names, such as ``"topomerge.extraction.extract"``; their order counts for nothing.
        package: folder of the package; another one than that of this file is for tests.

    Raises:
        ModuleNotFoundError: no such module.
    """
    files = find_reached_modules(*modules, package=package)
    lines = [f"{name} {_read_source(path).hash}" for name, path in files.items()]
    return _compute_hash("\n".join([*lines, *_list_data_lines(files, package)]))


@cache
def compute_data_digest(*modules: str, package: Path = HERE) -> str:
    """Compute the digest of the data files alone (see `compute_code_digest`): weights and tables that were trained or
    measured."""
    return _compute_hash("\n".join(_list_data_lines(find_reached_modules(*modules, package=package), package)))


@cache
def find_reached_modules(*modules: str, package: Path = HERE) -> dict[str, Path]:
    """Map the names to the files of modules and of all that they import within the house, sorted by name."""
    files: dict[str, Path] = {}
    waiting = list(modules)
    for module in modules:
        if _find_module_file(module, package) is None:
            raise ModuleNotFoundError(f"{module}: no such module below {package}", name=module)
    while waiting:
        module = waiting.pop()
        path = _find_module_file(module, package)
        if path is None or module in files or module == TOP:
            continue
        files[module] = path
        waiting.append(module.rpartition(".")[0])
        waiting += _iter_imports(path, package)
    return dict(sorted(files.items()))


@cache
def find_data_files(path: Path, package: Path = HERE) -> list[Path]:
    """Find the data files that a module names, beside it, in a folder beside it, or among the networks; sorted."""
    texts = _read_source(path).texts
    files = []
    for entry in path.parent.iterdir():
        if entry.is_dir():
            inner = [p for p in entry.rglob("*") if p.is_file()]
            if not any(p.suffix in SKIPPED for p in inner):
                files += [p for p in inner if entry.name in texts or p.name in texts]
        elif entry.suffix not in SKIPPED and {entry.name, entry.name.replace(CARD, ".json")} & texts:  # with its card
            files.append(entry)
    for name in (text for text in texts if text.endswith(NETWORK)):
        network = package / NETWORKS / name
        files += [p for p in (network, network.with_name(f"{network.stem}{CARD}")) if p.is_file()]
    return sorted({*files})


def _list_data_lines(files: dict[str, Path], package: Path) -> list[str]:
    """Return a line for each data file: its place and its hash."""
    lines = set()
    for name, path in files.items():
        above = name if path.name == "__init__.py" else name.rpartition(".")[0]
        for file in find_data_files(path, package):
            inside = file.is_relative_to(path.parent)
            place = f"{above}/{file.relative_to(path.parent).as_posix()}" if inside else f"{TOP}.{NETWORKS}/{file.name}"
            lines.add(f"{place} {hashlib.sha256(file.read_bytes()).hexdigest()}")
    return sorted(lines)


def _compute_hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:LENGTH]


@cache
def _find_module_file(module: str, package: Path) -> Path | None:
    """Return the file of a module of the house; None of anything else, such as a function's name behind its module's."""
    top, *parts = module.split(".")
    if top != TOP:
        return None
    is_beside = parts and parts[0] in DATA_BESIDE and not (package / parts[0]).is_dir()
    path = (package.parent if is_beside else package).joinpath(*parts)
    candidates = (path.with_name(f"{path.name}.py"), path / "__init__.py") if parts else (path / "__init__.py",)
    return next((p for p in candidates if p.is_file()), None)


@dataclass(frozen=True)
class _Source:
    """A parsed file as the walk needs it: hash of its code, names that it takes from elsewhere, and its texts.

    Args:
        names: full names of modules, or of what stands in them; with ``*`` behind the dot: all modules of a package.
    """

    hash: str
    names: frozenset[str]
    texts: frozenset[str]


@cache
def _read_source(path: Path) -> _Source:
    return _parse_source(path.read_text(encoding="utf-8"))


@cache
def _parse_source(text: str) -> _Source:
    """Parse a file's text: the same file of another copy of the package is not read a second time."""
    reading = _SourceReader()
    reading.read(ast.parse(text))
    description = hashlib.sha256("\n".join(reading.tokens).encode())
    return _Source(description.hexdigest(), frozenset(reading.names), frozenset(reading.texts))


class _SourceReader:
    """One pass over a syntax tree, which is all that the walk costs."""

    def __init__(self) -> None:
        self.tokens: list[str] = []  # the code, without comments, docstrings and layout
        self.names: set[str] = set()
        self.texts: set[str] = set()

    def read(self, node: ast.AST, counts: bool = True) -> None:
        """Take in a node and all below it.

        Args:
            counts: do its imports? Those for type checkers do not run.
        """
        counts = counts and not (isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test))
        if counts:
            self.names.update(_iter_imported_names(node))
        self.tokens.append(node.__class__.__name__)
        for field in node._fields:
            value = getattr(node, field, None)
            if value is None or value == [] or isinstance(value, ast.expr_context):
                continue  # newer versions of Python have more fields that are empty
            self.tokens.append(field)
            for item in value if isinstance(value, list) else [value]:
                if not isinstance(item, ast.AST):
                    self.tokens.append(repr(item))
                    if isinstance(item, str):
                        self.texts.add(item)
                elif not (isinstance(item, ast.Expr) and isinstance(item.value, ast.Constant)):  # a docstring
                    self.read(item, counts)
        self.tokens.append("end")


def _iter_imported_names(node: ast.AST) -> Iterator[str]:
    """Yield the names that a node of a syntax tree imports, or takes from the library's face."""
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
        yield node.module
        yield from (f"{node.module}.{alias.name}" for alias in node.names)
    elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == TOP:
        yield f"{TOP}.{node.attr}"  # topomerge.extract
    elif isinstance(node, ast.Call) and node.args and ast.unparse(node.func).endswith("import_module"):
        name = node.args[0]
        if isinstance(name, ast.Constant):
            yield str(name.value)
        elif isinstance(name, ast.JoinedStr) and isinstance(name.values[0], ast.Constant):
            yield str(name.values[0].value).rpartition(".")[0] + ".*"


def _iter_imports(path: Path, package: Path) -> Iterator[str]:
    """Yield the names in the house that a file imports; those behind a module's name may be functions or classes of it."""
    homes = _read_homes(package)
    for name in _read_source(path).names:
        name = homes.get(name, name)
        if name.split(".")[0] != TOP:
            continue
        folder, _, last = name.rpartition(".")
        init = _find_module_file(folder, package) if last == "*" else None
        if init is None:
            yield name
        else:
            yield from (f"{folder}.{p.stem}" for p in init.parent.glob("*.py") if p != init)


@cache
def _read_homes(package: Path) -> dict[str, str]:
    """Map names such as ``topomerge.extract`` to the module that each comes from: `_HOMES` of the face."""
    for node in ast.parse((package / "__init__.py").read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and [ast.unparse(t) for t in node.targets] == ["_HOMES"]:
            homes: dict[str, str] = ast.literal_eval(node.value)
            return {f"{TOP}.{name}": home for name, home in homes.items()}
    return {}


def read_commit(package: Path = HERE) -> tuple[str, bool]:
    """Return the commit of the checkout that a package runs from, and do its sources differ from it? Empty outside a checkout."""

    def git(*arguments: str) -> str:
        try:
            done = subprocess.run(["git", "-C", str(package.parent), *arguments], capture_output=True, text=True, check=False)
        except OSError:  # no git here
            return ""
        return done.stdout.strip() if done.returncode == 0 else ""

    commit = git("rev-parse", "HEAD") if (package.parent / ".git").exists() else ""
    return commit, bool(commit and git("status", "--porcelain"))


def find_other_clone(script: Path) -> str:
    """Return one line where a script of a clone would run another clone's code, since they share an environment; else empty.

    Args:
        script: of the top folder of a checkout.
    """
    own = script.resolve().parent
    for name in (TOP, *(f"{TOP}.{part}" for part in DATA_BESIDE)):
        spec = find_spec(name)
        if spec is not None and spec.origin is not None and not Path(spec.origin).resolve().is_relative_to(own):
            where = Path(spec.origin).resolve().parent
            return f"warning: {own} would run the code of another clone: {name} comes from {where}; run make setup here"
    return ""
