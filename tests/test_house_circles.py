"""Imports run in no circle: between files, also inside functions and through the package's face, and between folders."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

import topomerge
from tests.test_house import ROOT, imports, sources, tree_of


def module_of(path: Path) -> str:
    """Name under which a file is imported."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    parts = parts if parts[0] in ("topomerge", "benchmarks") else ("topomerge", *parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@cache
def import_graph() -> dict[str, set[str]]:
    """Module -> the modules of the house that it imports, at its top, inside functions, or through the package's face."""
    files = {
        module_of(path): path for path in [*(path for _, _, path in sources()), *sorted((ROOT / "benchmarks").rglob("*.py"))]
    }
    graph: dict[str, set[str]] = {}
    for module, path in files.items():
        if module == "topomerge":
            continue
        graph[module] = set()
        for name, _, _ in imports(path):
            parts = name.split(".")
            homes = (".".join(parts[:k]) for k in range(len(parts), 1, -1))
            home = next((h for h in homes if h in files), topomerge._HOMES.get(name.removeprefix("topomerge.")))
            graph[module] |= {home} if home and home != module else set()
        for node in ast.walk(tree_of(path)):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "topomerge":
                home = topomerge._HOMES.get(node.attr)
                graph[module] |= {home} if home and home != module else set()
    return graph


def circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Nodes that reach themselves, those that reach each other together (Tarjan 1972)."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    names = sorted(graph)
    row = {name: k for k, name in enumerate(names)}
    pairs = [(row[a], row[b]) for a, others in graph.items() for b in others if b in row]
    ones = coo_array(([1] * len(pairs), tuple(zip(*pairs, strict=True))), (len(names),) * 2)
    _, component = connected_components(ones, connection="strong")
    groups: dict[int, list[str]] = {}
    for name, k in zip(names, component.tolist(), strict=True):
        groups.setdefault(k, []).append(name)
    return [group for group in groups.values() if len(group) > 1]


def test_no_file_imports_itself_by_a_detour():
    assert not circles(import_graph())


def test_no_folder_imports_another_both_ways():
    """Of folders beside each other; a folder and the one it lies in share their files' order instead."""
    graph = import_graph()
    folders = {module: module if (ROOT / path_of(module)).is_dir() else module.rpartition(".")[0] for module in graph}
    arrows: dict[tuple[str, str], str] = {}
    for module, others in graph.items():
        for other in others:
            a, b = folders[module].split("."), folders.get(other, other.rpartition(".")[0]).split(".")
            shared = next((k for k, (x, y) in enumerate(zip(a, b, strict=False)) if x != y), min(len(a), len(b)))
            if len(a) > shared and len(b) > shared:
                arrows[".".join(a[: shared + 1]), ".".join(b[: shared + 1])] = f"{module} -> {other}"
    both = [(arrow, arrows[b, a]) for (a, b), arrow in arrows.items() if a < b and (b, a) in arrows]
    assert not both, both


def path_of(module: str) -> Path:
    """Folder of a package, or file without its ending."""
    if module.startswith("benchmarks"):
        return Path(*module.split("."))
    parts = module.split(".")[1:]
    return Path(*parts) if parts[:1] in (["models"], ["datasets"], ["configs"]) else Path("topomerge", *parts)


def test_nothing_that_is_installed_imports_benchmarks():
    assert not [(a, b) for a, others in import_graph().items() for b in others if b.startswith("benchmarks") and a[:10] != b[:10]]


def test_circles_are_seen():
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == [["a", "b", "c"]]
