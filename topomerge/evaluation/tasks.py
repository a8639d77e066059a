"""Tasks of `evaluate.py` that measure what the library makes: rooms, doors, merges, joined maps, atlases, retrieval.

A task is a module of this package with `Settings`, `measure`, `tabulate`, `list_inputs` and `MAKERS`; `run_task` does the rest:
settings from the command line, rows kept beside a report in ``runs/eval/<task>-<set>``, and tables between the marks of a page.
"""

from __future__ import annotations

import json
import os
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol, cast

from topomerge.code_digest import code_digest
from topomerge.config import typed
from topomerge.errors import InputError
from topomerge.evaluation.documents import build_stamp, write_blocks
from topomerge.evaluation.headline import write_headline
from topomerge.io.atomic import replacing

Row = dict[str, Any]
Say = Callable[[str], None]
MODULES = {
    "rooms": "rooms",
    "doors": "doors",
    "windows": "windows",
    "walls": "walls",
    "merges": "merges",
    "joined": "joined",
    "bending": "bending",
    "atlases": "atlases",
    "retrieval": "retrieval",
}


@dataclass
class Data:
    """What is measured.

    Args:
        set: name of the set, or several with commas between them.
        limit: so many cases of each, or pairs; 0: all.
        only: those whose name contains this.
    """

    set: str = ""
    limit: int = 0
    only: str = ""


@dataclass
class TaskSettings:
    """Settings that every task has.

    Args:
        data: what is measured.
        jobs: processes.
        cache: folder of scans, maps and pairs, which are made once.
        folder: where rows and report go.
        write: a page whose marked blocks are written; empty: none.
        headline: a file of figures for the README whose entries of this task are written; empty: none.
        remake: measure again what is there.
    """

    data: Data = field(default_factory=Data)
    jobs: int = 1
    cache: str = "cache"
    folder: str = "runs/eval"
    write: str = ""
    headline: str = ""
    remake: bool = False


class EvaluationModule(Protocol):
    """What a module of a task has."""

    Settings: type[TaskSettings]
    MAKERS: tuple[str, ...]

    def measure(self, settings: Any, say: Say) -> list[Row]:
        """Measure what is missing; all rows."""

    def tabulate(self, rows: Sequence[Row], settings: Any) -> dict[str, str]:
        """Tables by the name of their block."""

    def list_inputs(self, settings: Any) -> list[str]:
        """Names of what is measured."""

    def compute_headline(self, rows: Sequence[Row], settings: Any) -> dict[str, tuple[str, str]]:
        """Figures for the README: name -> (value, of what)."""


@dataclass(frozen=True)
class Outcome:
    """What a task found."""

    rows: list[Row]
    summary: str
    folder: Path


def load_task(task: str) -> EvaluationModule:
    """Import the module of a task."""
    return cast(EvaluationModule, import_module(f"topomerge.evaluation.{MODULES[task]}"))


def read_settings(task: str, words: Sequence[str]) -> Any:
    """Read words like ``data=homes jobs=2 data.limit=3`` as the settings of a task.

    Raises:
        InputError: names the key that is wrong.
    """
    from omegaconf import OmegaConf

    plain = [f"data.set={w[5:]}" if w.startswith("data=") else w for w in words if not w.startswith("task=")]
    for word in plain:
        if "=" not in word:
            raise InputError(f"{word}: give KEY=VALUE, such as data=dev")
    quoted = [f"{key}='{value}'" if key in ("data.set", "data.only") else word
              for word in plain for key, _, value in [word.partition("=")]]  # fmt: skip
    return typed(OmegaConf.from_dotlist(quoted), load_task(task).Settings)


def run_task(task: str, words: Sequence[str], say: Say) -> Outcome:
    """Measure, tabulate, keep, and write where asked.

    Raises:
        InputError: settings that nothing can be made of, or data that is missing.
    """
    module, settings = load_task(task), read_settings(task, words)
    rows = module.measure(settings, say)
    blocks = module.tabulate(rows, settings)
    summary = "\n\n".join(blocks.values())
    folder = Path(settings.folder) / f"{task}-{(settings.data.set or 'default').replace(',', '-').replace('/', '-')}"
    folder.mkdir(parents=True, exist_ok=True)
    with replacing(folder / "report.md") as beside:
        beside.write_text(f"# {folder.name}\n\n{summary}\n", encoding="utf-8")
    stamp = build_stamp(
        shlex.join(["python", "evaluate.py", f"task={task}", *(w for w in words if not w.startswith("task="))]),
        module.MAKERS,
        module.list_inputs(settings),
    )
    if settings.write:
        write_blocks(Path(settings.write), blocks, stamp)
    if settings.headline:
        write_headline(Path(settings.headline), compute_figures(module, rows, settings), stamp)
    return Outcome(rows, summary, folder)


def compute_figures(module: EvaluationModule, rows: Sequence[Row], settings: Any) -> dict[str, tuple[str, str]]:
    """Compute a task's figures for the README.

    Raises:
        InputError: it has none.
    """
    if not hasattr(module, "compute_headline"):
        raise InputError("headline: this task has no figure in the README")
    return module.compute_headline(rows, settings)


def list_inputs_of(command: str) -> list[str] | None:
    """List the inputs of the command of a stamp; None where it is no task of this package.

    Raises:
        InputError: the command is not taken any more, or its data is not here.
    """
    words = shlex.split(command)
    task = next((w[5:] for w in words if w.startswith("task=")), "")
    if words[:2] != ["python", "evaluate.py"] or task not in MODULES:
        return None
    return load_task(task).list_inputs(read_settings(task, words[2:]))


def measure_missing(
    path: Path, items: Mapping[str, Any], work: Callable[..., Row], say: Say, settings: TaskSettings, code: str = ""
) -> list[Row]:
    """Measure the items that a file of rows does not have, one line of JSON each; the rows of all items.

    Args:
        items: name -> arguments of `work`, which can be sent to another process.
        code: digest of what makes a row; rows of another one are measured again. Empty: rows are kept, and it is told.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = {} if settings.remake else read_rows(path)
    now = code or code_digest(work.__module__)
    older = [name for name in items if name in rows and rows[name].get("code") != now]
    if code:
        rows = {name: row for name, row in rows.items() if name not in set(older)}
    elif older:
        say(f"{path}: {len(older)} of {len(items)} rows are of another state of the code; remake=true measures them again")
    missing = {name: arguments for name, arguments in items.items() if name not in rows}
    if settings.remake:
        path.unlink(missing_ok=True)
    with path.open("a", encoding="utf-8") as file:
        for done, row in enumerate(iterate_rows(missing, work, settings.jobs), 1):
            rows[row["name"]] = row | {"code": now}
            file.write(json.dumps(rows[row["name"]]) + "\n")
            file.flush()
            say(f"{done} of {len(missing)}: {row['name']}")
    return [rows[name] for name in items if name in rows]


def iterate_rows(items: Mapping[str, Any], work: Callable[..., Row], jobs: int) -> Iterator[Row]:
    """Iterate over the rows of items, each with its name, as they come."""
    if jobs == 1:
        yield from ({"name": name, **work(*arguments)} for name, arguments in items.items())
        return
    from joblib import Parallel, delayed

    calls = (delayed(name_row)(name, work, arguments) for name, arguments in items.items())
    yield from Parallel(jobs, return_as="generator_unordered", batch_size=1, pre_dispatch=jobs)(calls)


def name_row(name: str, work: Callable[..., Row], arguments: Sequence[Any]) -> Row:
    """Call `work`, and give its row the name."""
    return {"name": name, **work(*arguments)}


def read_rows(path: Path) -> dict[str, Row]:
    """Read the lines of a file of rows by their names, the last of each; none where there is no such file."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    return {row["name"]: row for row in map(json.loads, lines)}


def find_real_data() -> Path:
    """Find the folder of the real data, which TOPOMERGE_DATA names.

    Raises:
        InputError: it names none: without real plans, the same command would measure other pairs than those of the tables.
    """
    folder = os.environ.get("TOPOMERGE_DATA", "")
    if not folder or not Path(folder).is_dir():
        raise InputError(f"TOPOMERGE_DATA must name the folder of the real data (it is {folder or 'not set'})")
    return Path(folder)


def find_optional_data() -> Path | None:
    """Find the folder of the real data; None where TOPOMERGE_DATA is not set."""
    folder = os.environ.get("TOPOMERGE_DATA", "")
    return Path(folder) if folder else None


def limit_cases(cases: Sequence[Any], settings: TaskSettings) -> list[Any]:
    """Limit cases to those whose name is asked for, and to so many."""
    return [case for case in cases if settings.data.only in case.name][: settings.data.limit or None]
