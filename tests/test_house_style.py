"""Rules of the house about size and language that a machine can hold."""

from __future__ import annotations

import ast
import inspect
import re
import tokenize
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import topomerge
from tests.test_house import list_statements, tree_of

ROOT = Path(__file__).parent.parent
LONGEST_FILE, LONGEST_FUNCTION, MOST_PARAMETERS = 500, 60, 8
REPEATED = 6  # lines: a run of so many stands in one place only


def product_files() -> list[Path]:
    """Every Python file but the tests."""
    folders = [ROOT / name for name in ("topomerge", "models", "datasets", "benchmarks")]
    return sorted(path for folder in folders for path in folder.rglob("*.py")) + [ROOT / "train.py", ROOT / "evaluate.py"]


def identify(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def find_long(path: Path) -> Iterator[str]:
    """Yield what of a file is longer, or takes more parameters, than the house allows."""
    text = path.read_text()
    if text.count("\n") > LONGEST_FILE:
        yield f"{identify(path)} has {text.count(chr(10))} lines: split it by what it does"
    if path.parent.name == "kernels":  # compiled loops take plain arrays, many of them
        return
    for node in list_statements(tree_of(path)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            where = f"{identify(path)}:{node.lineno}: {node.name}"
            assert node.end_lineno is not None
            if node.end_lineno - node.lineno + 1 > LONGEST_FUNCTION:
                yield f"{where} is longer than {LONGEST_FUNCTION} lines"
            names = [a.arg for a in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)]
            count = len(names) - (names[:1] in (["self"], ["cls"]))
            if count > MOST_PARAMETERS and not any("jit" in ast.unparse(d) for d in node.decorator_list):
                yield f"{where} has {count} parameters"


def test_files_and_functions_are_short() -> None:
    long = [fault for path in product_files() for fault in find_long(path)]
    assert not long, "\n".join(long)


def lines_of(path: Path) -> list[tuple[int, str]]:
    """(number, text) of the lines that do something: no blank ones, comments, imports or lone brackets."""
    skipped: set[int] = set()
    for node in list_statements(tree_of(path)):
        text = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        if isinstance(node, ast.Import | ast.ImportFrom) or text:
            skipped |= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    numbered = enumerate(path.read_text().splitlines(), 1)
    return [(k, s) for k, line in numbered if k not in skipped and len(s := line.strip()) > 2 and not s.startswith("#")]


def test_nothing_is_written_twice() -> None:
    places: dict[tuple[str, ...], list[str]] = defaultdict(list)
    for path in product_files():
        lines, name = lines_of(path), identify(path)
        for at in range(len(lines) - REPEATED + 1):
            run = tuple(text for _, text in lines[at : at + REPEATED])
            places[run].append(f"{name}:{lines[at][0]}")
    repeated = sorted({" = ".join(where) for where in places.values() if len(where) > 1})
    assert not repeated, "\n".join(repeated)


def test_the_api_is_explained() -> None:
    """Every public name stands in the glossary or in a docstring; every parameter and field in the docstring of its owner."""
    glossary = (ROOT / "docs" / "glossary.md").read_text()
    unexplained = []
    for name in topomerge.__all__:
        thing = getattr(topomerge, name)
        text = inspect.getdoc(thing) or ""
        if not callable(thing):
            unexplained += [name] if not re.search(rf"`{name}`", glossary) and name != "__version__" else []
            continue
        unexplained += [] if len(text) > 20 else [name]
        words = set(re.findall(r"\w+", text + glossary))
        if not (inspect.isclass(thing) and issubclass(thing, Exception)):
            unexplained += [f"{name}({p})" for p in inspect.signature(thing).parameters if p not in words]
        if inspect.isclass(thing):
            members = [a for a in vars(thing) if not a.startswith("_")]
            unexplained += [f"{name}.{a}" for a in members if a not in words and not inspect.getdoc(getattr(thing, a, None))]
    assert not unexplained, unexplained


def test_docstrings_tell_what_a_thing_does() -> None:
    """Not "What a pair shares", but "Return the rooms that both maps of a pair share"."""
    opened = [
        f"{identify(path)}:{node.body[0].lineno}: opens with 'What': say what it does, or is"
        for path in product_files()
        for node in [tree_of(path), *list_statements(tree_of(path))]
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
        and (ast.get_docstring(node, clean=False) or "").startswith("What ")
    ]
    assert not opened, "\n".join(opened)


# Names in single backticks are of code; double ones hold what somebody types, such as groups of entry points.
PACKAGES = ("models", "datasets", "benchmarks")  # at the top of a checkout; all others stand below `topomerge`
DOTTED = re.compile(r"(?<!`)`((?:[A-Za-z_]\w*\.)+[A-Za-z_]\w*)(?:\([^`]*\))?`")
DATA_SUFFIXES = ("py", "csv", "json", "onnx")  # `landmarks.csv` is a file, not a name


def iter_prose(path: Path) -> Iterator[tuple[int, str]]:
    """Yield (line, text) of the docstrings and comments of a file."""
    for node in list_statements(tree_of(path)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            yield node.lineno, node.value.value
    if not re.search("#.*`", path.read_text()):  # comments are read by a tokenizer in Python, which takes most of the time
        return
    with path.open("rb") as file:
        yield from ((t.start[0], t.string) for t in tokenize.tokenize(file.readline) if t.type == tokenize.COMMENT)


@cache
def list_names(path: Path) -> frozenset[str]:
    """List the names that a module defines: of itself, of its classes, and what its lazy face gives."""
    names: set[str] = set()
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            names.add(node.name)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            names.add(node.id)
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            names.add(node.attr)
        elif isinstance(node, ast.alias):
            names.add(node.asname or node.name)
        elif isinstance(node, ast.Dict) and path.name == "__init__.py":
            names |= {key.value for key in node.keys if isinstance(key, ast.Constant)}
    return frozenset(names)


def resolve_name(name: str) -> bool | None:
    """Tell whether a dotted name is a module of ours, or stands in one; None where it begins with no package of ours."""
    first, *parts = name.removeprefix("topomerge.").split(".")
    place = ROOT / first if first in PACKAGES else ROOT / "topomerge" / first
    if not place.is_dir() and not name.startswith("topomerge."):
        return None
    if not place.is_dir():
        place, parts = place.parent, [first, *parts]
    while place.is_dir():
        if parts and ((place / parts[0]).is_dir() or (place / f"{parts[0]}.py").is_file()):
            place, parts = place / parts[0], parts[1:]
            place = place if place.is_dir() else place.with_suffix(".py")
        elif parts:
            place = place / "__init__.py"
        else:
            return True
    return set(parts) <= list_names(place)


def test_names_in_prose_exist() -> None:
    stale = []
    for path in product_files():
        for line, text in iter_prose(path):
            names = [n for n in DOTTED.findall(text) if n.rpartition(".")[2] not in DATA_SUFFIXES]
            stale += [f"{identify(path)}:{line}: `{n}` is gone" for n in names if resolve_name(n) is False]
    assert not stale, "\n".join(stale)
