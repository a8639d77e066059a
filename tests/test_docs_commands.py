"""Commands beside the tables of results: each module exists and takes the words that stand there. Nothing is measured."""

from __future__ import annotations

import argparse
import ast
import importlib
import inspect
import re
import shlex
import sys
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import pytest

ROOT = Path(__file__).parent.parent
# Blocks of the sealed page are never written again: their commands are those of their commit.
PAGES = (
    *(ROOT / "docs" / name for name in ("results.md", "training.md", "evaluation.md")),
    *(p for p in sorted((ROOT / "docs" / "results").glob("*.md")) if p.stem != "sealed"),
)
COMMAND = re.compile(r"(?<![\w-])python (?=-m |evaluate\.py|train\.py)([^`\n;|]*)")
FLAGS = {"--overfit": "overfit=true", "--resume": "resume=true", "--overwrite": "overwrite=true"}  # as train.py
PLACEHOLDERS = {"$n": "2 6"}  # of loops of the shell
INSTALLED = ("datasets", "models", "configs")  # that stand at the top of the repository


class ParsedError(Exception):
    """The words were taken; the work itself is left out."""


def written() -> list[tuple[str, str]]:
    """Page and words behind ``python`` of every command of the pages, once each."""
    out = {}
    for page in PAGES:
        for match in COMMAND.finditer(page.read_text(encoding="utf-8")):
            out.setdefault(match[1].split(" #")[0].split(" &&")[0].strip(), page.name)
    return [(page, words) for words, page in out.items()]


def source_of(module: str) -> Path:
    """The file that ``python -m`` runs."""
    parts = module.split(".")
    parts = parts[1:] if parts[0] == "topomerge" and parts[1] in INSTALLED else parts
    path = ROOT.joinpath(*parts)
    return path / "__main__.py" if path.is_dir() else path.with_suffix(".py")


def take(words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the script of a command take its words, without its work.

    Raises:
        Exception: it does not take them.
    """
    if words[0] == "train.py":
        from topomerge.training.search import compose_search
        from topomerge.training.tasks import compose_settings

        if any(w.startswith("search") for w in words):
            compose_search([FLAGS.get(w, w) for w in words[1:]])
        plain = [FLAGS.get(w, w) for w in words[1:] if w != "-m" and not w.startswith("hydra")]
        compose_settings([select_first(w) for w in plain] if "-m" in words else plain)  # of a sweep, its first run
        return
    if words[0] == "evaluate.py":
        from topomerge.config import compose
        from topomerge.evaluation.settings import Evaluation
        from topomerge.evaluation.tasks import MODULES, read_settings

        task = next((w.removeprefix("task=") for w in words if w.startswith("task=")), "")
        rest = [w for w in words[1:] if not w.startswith("task=")]
        if task in MODULES:
            read_settings(task, words[1:])
        elif task:
            from topomerge.training.tasks import compose_settings

            compose_settings([w for w in words[1:] if not w.startswith(("run=", "folder="))])
        else:
            compose("evaluate", Evaluation, [f"run=[{w[4:]}]" if re.match(r"run=[^\[]", w) else w for w in rest])
        return
    assert words[0] == "-m", words
    path = source_of(words[1])
    assert path.is_file(), f"{words[1]}: no such module"
    module: Any = importlib.import_module(words[1] if path.name != "__main__.py" else f"{words[1]}.__main__")
    tree = ast.parse(path.read_text(encoding="utf-8"))
    last = [node for node in tree.body if isinstance(node, ast.If) and "__main__" in ast.unparse(node.test)]
    assert last, f"{words[1]}: is no script"
    started = ast.Module(last[-1].body, [])
    monkeypatch.setattr(sys, "argv", [str(path), *words[2:]])
    if "ArgumentParser" in ast.unparse(tree):
        parse = argparse.ArgumentParser.parse_args

        def parsed(self: argparse.ArgumentParser, *rest: Any, **named: Any) -> None:
            parse(self, *rest, **named)
            raise ParsedError

        monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parsed)
        with pytest.raises(ParsedError):
            exec(compile(started, str(path), "exec"), vars(module))
        return
    calls: list[object] = []
    for name in {n.func.id for n in ast.walk(started) if isinstance(n, ast.Call) and isinstance(n.func, ast.Name)}:
        if inspect.isfunction(vars(module).get(name)):
            monkeypatch.setattr(module, name, partial(record, calls, inspect.signature(vars(module)[name])))
    with suppress(SystemExit):  # of ``sys.exit(main())``
        exec(compile(started, str(path), "exec"), vars(module))
    assert calls, f"{words[1]}: does not start with these words"


def select_first(word: str) -> str:
    """The first choice of a word of a sweep."""
    return word if "[" in word else word.split(",")[0]


def record(calls: list[object], signature: inspect.Signature, *given: Any, **named: Any) -> MagicMock:
    """Stand in for a function: its arguments must fit; what it returns takes everything."""
    calls.append(signature.bind(*given, **named))
    return MagicMock()


def words_of(text: str) -> list[str]:
    """As the shell splits them."""
    for name, words in PLACEHOLDERS.items():
        text = text.replace(name, words)
    return shlex.split(text)


def list_commands() -> list[Any]:
    """List the commands. Those of results stand there as they ran: the longer suite tries them again, the quick one of those that
    people type the first that begins as it does (``train.py task=room_odds``)."""
    seen, cases = set(), []
    for page, text in written():
        begins = page, *re.split(r"[ \[,]", text)[:2]
        longer = (ROOT / "docs" / "results" / page).is_file() or begins in seen
        seen.add(begins)
        cases.append(pytest.param(page, text, id=f"{page}-{text[:60]}", marks=[pytest.mark.longer] if longer else []))
    return cases


@pytest.mark.parametrize(("page", "text"), list_commands())
def test_commands_of_the_results_are_taken(page: str, text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("hydra")
    take(words_of(text), monkeypatch)


def test_there_are_commands() -> None:
    pages = {page for page, _ in written()}
    assert {"rooms.md", "merging.md", "peers.md", "learning.md", "ablation.md", "training.md"} <= pages | {"results.md"}
    assert len(written()) > 15


@pytest.mark.parametrize(
    "text",
    [
        "-m benchmarks.peers.nowhere test",
        "-m benchmarks.peers.run whole 9 what",
        "evaluate.py task=rooms data.sets=all",
        "evaluate.py data=heldout nothing=1",
        "evaluate.py data=heldout only=[engineered,shapedna surface]",
    ],
)
def test_a_command_that_is_not_taken_is_seen(text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("hydra")
    with pytest.raises((Exception, SystemExit)):  # whatever the script says
        take(words_of(text), monkeypatch)
