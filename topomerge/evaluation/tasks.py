"""Tasks of `evaluate.py` that measure what the library makes: rooms, doors, merges, joined maps, atlases, retrieval.

A task is a module of this package with `measure`, `tabulate`, `list_inputs` and `MAKERS`; `run_task` does the rest:
settings from the command line, rows kept beside a report in ``runs/eval/<task>-<set>``, and tables between the marks of a page.
"""

from __future__ import annotations

import gzip
import json
import os
import re
import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol, cast

import numpy as np

from topomerge.archive import replace_on_success
from topomerge.code_digest import compute_code_digest
from topomerge.config import compose, convert_to_dataclass
from topomerge.datasets.core.building import find_physical_building
from topomerge.datasets.pairs.build import Build
from topomerge.datasets.pairs.grid_drawings import build_drawings
from topomerge.datasets.pairs.grid_pairs import GridPair, build_grids, draw_grid_items
from topomerge.datasets.pairs.lookalikes import LookalikeRecipe, build_lookalikes
from topomerge.datasets.real.maps import iter_real_grid_pairs
from topomerge.errors import InputError
from topomerge.evaluation.documents import build_stamp, write_blocks, write_headline
from topomerge.training.tasks import compose_settings
from topomerge.types import Array, LogFn, Sim3

Row = dict[str, Any]
MODULES = {
    "rooms": "rooms",
    "doors": "doors",
    "windows": "windows",
    "walls": "walls",
    "drawings": "drawings",
    "drawn_merges": "drawn_merges",
    "merges": "merges",
    "joined": "joined",
    "bending": "bending",
    "atlases": "atlases",
    "retrieval": "retrieval",
    "radio": "radio",
    "locate": "locate",
    "live": "live",
    "landmarks": "landmarks",
    "edits": "edits",
    "changes": "changes",
}


@dataclass
class Data:
    """The data that a task measures.

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
        write: a page whose marked blocks are written; empty: none. The rows behind it lie in `rows` beside it, and are read
            there where the cache has none.
        headline: a file of figures for the README whose entries of this task are written; empty: none.
        remake: measure again what is there.
        confirm: rows of an older state of the code stay where so many of them, evenly spread, come out alike when they are
            measured again; 0: all of them are measured again.
    """

    data: Data = field(default_factory=Data)
    jobs: int = 1
    cache: str = "cache"
    folder: str = "runs/eval"
    write: str = ""
    headline: str = ""
    remake: bool = False
    confirm: int = 0


class EvaluationModule(Protocol):
    """The functions that the module of a task defines, and `Settings` where it has more than `TaskSettings`."""

    MAKERS: tuple[str, ...]

    def measure(self, settings: Any, log_line: LogFn) -> list[Row]:
        """Measure what is missing; all rows."""

    def tabulate(self, rows: Sequence[Row], settings: Any) -> dict[str, str]:
        """Return the tables by the name of their block."""

    def list_inputs(self, settings: Any) -> list[str]:
        """Return names of what is measured."""

    def compute_headline(self, rows: Sequence[Row], settings: Any) -> dict[str, tuple[str, str]]:
        """Compute the figures for the README: name -> (value, of what)."""


@dataclass(frozen=True)
class Outcome:
    """The outcome of a task."""

    rows: list[Row]
    summary: str
    folder: Path


def load_task(task: str) -> EvaluationModule:
    """Import the module of a task."""
    return cast(EvaluationModule, import_module(f"topomerge.evaluation.{MODULES[task]}"))


def read_settings(task: str, overrides: Sequence[str]) -> Any:
    """Read overrides like ``data=homes jobs=2 data.limit=3`` as the settings of a task.

    Raises:
        InputError: names the key that is wrong.
    """
    from omegaconf import OmegaConf

    plain = [f"data.set={w[5:]}" if w.startswith("data=") else w for w in overrides if not w.startswith("task=")]
    for word in plain:
        if "=" not in word:
            raise InputError(f"{word}: give KEY=VALUE, such as data=dev")
    quoted = [f"{key}='{value}'" if key in ("data.set", "data.only") else word
              for word in plain for key, _, value in [word.partition("=")]]  # fmt: skip
    return convert_to_dataclass(OmegaConf.from_dotlist(quoted), getattr(load_task(task), "Settings", TaskSettings))


def run_task(task: str, overrides: Sequence[str], log_line: LogFn) -> Outcome:
    """Measure, tabulate, keep, and write where asked.

    Raises:
        InputError: settings that nothing can be made of, or data that is missing.
    """
    module, settings = load_task(task), read_settings(task, overrides)
    rows = module.measure(settings, log_line)
    blocks = module.tabulate(rows, settings)
    summary = "\n\n".join(blocks.values())
    folder = Path(settings.folder) / f"{task}-{(settings.data.set or 'default').replace(',', '-').replace('/', '-')}"
    folder.mkdir(parents=True, exist_ok=True)
    with replace_on_success(folder / "report.md") as temporary:
        temporary.write_text(f"# {folder.name}\n\n{summary}\n", encoding="utf-8")
    stamp = build_stamp(
        shlex.join(["python", "evaluate.py", f"task={task}", *(w for w in overrides if not w.startswith("task="))]),
        module.MAKERS,
        module.list_inputs(settings),
        describe_confirmed(rows),
    )
    if settings.write:
        write_blocks(Path(settings.write), blocks, stamp)
    if settings.headline:
        write_headline(Path(settings.headline), compute_figures(module, rows, settings), stamp)
    return Outcome(rows, summary, folder)


def describe_confirmed(rows: Sequence[Row]) -> str:
    """Say how many rows are of older code, and how many of these were measured again; empty where none is."""
    kept = [row["confirmed"] for row in rows if row.get("confirmed")]
    return f"{len(kept)} of {len(rows)} rows are older, {min(kept)} others came out alike" if kept else ""


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
    arguments = shlex.split(command)
    task = next((w[5:] for w in arguments if w.startswith("task=")), "")
    if arguments[:2] != ["python", "evaluate.py"] or task not in MODULES:
        return None
    return load_task(task).list_inputs(read_settings(task, arguments[2:]))


def measure_missing(
    path: Path, items: Mapping[str, Any], work: Callable[..., Row], log_line: LogFn, settings: TaskSettings, code: str = ""
) -> list[Row]:
    """Measure the items that a file of rows does not have from this state of the code; the rows of all items.

    Args:
        path: one line of JSON a row, written as they come: what is stopped goes on where it was.
        items: name -> arguments of `work`, which can be sent to another process.
        settings: `remake` and `confirm` say what becomes of rows that are there.
        code: digest of what makes a row; empty: of the module of `work` and all that it imports.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    code = code or compute_code_digest(work.__module__)
    if settings.remake:
        path.unlink(missing_ok=True)
    kept = Path(settings.write).parent / KEPT_ROWS / f"{path.name}.gz" if settings.write else None
    published = {} if kept is None or settings.remake else read_rows(kept)
    rows = {name: row for name, row in (published | read_rows(path)).items() if name in items}
    older = {name: row for name, row in rows.items() if row["code"] != code}
    rows = {name: row for name, row in rows.items() if name not in older}
    sample = list(older)[:: -(-len(older) // settings.confirm)] if older and settings.confirm else []

    def measure(names: Iterable[str]) -> None:
        missing = {name: items[name] for name in names if name not in rows}
        for done, row in enumerate(iterate_rows(missing, work, settings.jobs), 1):
            keep(row | {"code": code})
            log_line(f"{done} of {len(missing)}: {row['name']}")

    def keep(row: Row) -> None:
        rows[row["name"]] = row
        file.write(json.dumps(row) + "\n")
        file.flush()

    with path.open("a", encoding="utf-8") as file:
        measure(sample)
        unlike = [name for name in sample if drop_costs(rows[name]) != drop_costs(older[name])]
        if sample and not unlike:
            log_line(f"{len(sample)} of {len(older)} older rows came out alike: the others stay")
            for name in [name for name in older if name not in rows]:
                keep(older[name] | {"code": code, "confirmed": len(sample)})
        elif older:
            unlike_row = f"; {unlike[0]} came out otherwise" if unlike else ""
            log_line(f"{len(older)} rows are of another state of the code and are measured again{unlike_row}")
        measure(items)
    if kept:
        write_rows(kept, read_rows(kept) | rows)
    return [rows[name] for name in items]


KEPT_ROWS = "rows"  # folder beside a page


COSTS = re.compile(r"code|confirmed|.*(seconds|_s|_mib|_mb)")


def drop_costs(value: Any) -> Any:
    """Drop from a row, at any depth, what two measurements of the same code do not share: seconds, memory, the code's digest."""
    if isinstance(value, dict):
        return {key: drop_costs(inner) for key, inner in value.items() if not COSTS.fullmatch(key)}
    if isinstance(value, list | tuple):
        return [drop_costs(inner) for inner in value]
    return str(value) if isinstance(value, float) else value  # not a number equals itself


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
    """Read the lines of a file of rows, packed or not, by their names, the last of each; none where there is no such file."""
    if not path.exists():
        return {}
    text = gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes()
    return {row["name"]: row for row in map(json.loads, text.decode().splitlines())}


def write_rows(path: Path, rows: Mapping[str, Row]) -> None:
    """Write rows into a packed file, one line each, in the order of their names: the same rows give the same bytes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [json.dumps(rows[name]) + "\n" for name in sorted(rows)]
    with replace_on_success(path) as temporary:
        temporary.write_bytes(gzip.compress("".join(lines).encode(), mtime=0))


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


SETS = {"train": "grids", "test": "grids_heldout"}
LOOKALIKE_SETS = {"train": "lookalikes", "test": "lookalikes_heldout"}
DRAWN = "_drawings"  # of the names of splits
SCALELESS = ("halmstad",)  # no metres per pixel are known
# Split -> sources of `datasets.real`; None: all that evaluate.
REAL_SPLITS = {"real": None, "development": ("office_floor",), "storeys": ("storeys",)}


@dataclass
class LookalikeBuild(Build):
    """Settings of the build of look-alikes."""

    data: LookalikeRecipe = field(default_factory=LookalikeRecipe)  # type: ignore[assignment]


def make_pair_files(split: str, cache: str, jobs: int, log_line: LogFn, limit: int = 0) -> list[Path]:
    """Make the files of a split, ``test_drawings`` among them, that are missing; all, or so many of them, in their order.

    Raises:
        InputError: nothing tells where the real plans are, of which many pairs are.
    """
    find_real_data()
    settings = read_recipe(split, (f"cache={cache}", f"jobs={jobs}", f"data.limit={limit}"))
    build = build_drawings if split.endswith(DRAWN) else build_grids
    return list(build(settings.data, settings, log_line)[0])


def make_lookalike_files(split: str, cache: str, jobs: int, log_line: LogFn, limit: int = 0) -> list[Path]:
    """Make the files of look-alikes of a split that are missing; all, or so many of them, in their order."""
    arguments = [f"data={LOOKALIKE_SETS[split]}", f"data.limit={limit}", f"cache={cache}", f"jobs={jobs}"]
    settings = compose("build", LookalikeBuild, arguments)
    paths, report = build_lookalikes(settings.data, settings, log_line)
    log_line(f"{report.items} pairs, {report.made} made now; refused: {report.refused}")
    return paths


def iterate_real_pairs(split: str = "real") -> Iterator[GridPair]:
    """Iterate over the real pairs, at 0.1 m; of splits ``development`` and ``storeys`` those that one may choose by."""
    return iter_real_grid_pairs(str(find_real_data()), REAL_SPLITS[split])


def convert_to_upright(matrix: Array, pair: GridPair) -> Sim3 | None:
    """Turn a pose into one under gravity that keeps the place where errors are measured; None where the map was turned over."""
    if not np.isfinite(matrix).all() or matrix[2, 2] < 0.9:
        return None
    yaw = float(np.arctan2(matrix[1, 0], matrix[0, 0]))
    placed = matrix[:3, :3] @ pair.anchor + matrix[:3, 3] - Sim3(yaw).apply(pair.anchor[None])[0]
    x, y, z = placed.tolist()
    return Sim3(yaw, (x, y, z))


@cache
def map_other_buildings(split: str) -> dict[tuple[int, int], str]:
    """Return, of pairs of two buildings, by set and number, the name of the second one, which the files do not tell."""
    items, _ = draw_grid_items(read_recipe(split).data)
    out = {}
    for k in items:
        if k.item.hard == "other-building":
            name = k.item.other[0]
            out[k.set, k.number] = f"{k.item.kind}-{name}-{k.item.storeys}" if k.item.source == "procedural" else name
    return out


def find_buildings(pair: GridPair, split: str) -> tuple[str, str]:
    """Return names of the buildings of a and of b of a cached pair."""
    about: dict[str, Any] = pair.about
    whole = str(about["building"])
    if about["kind"] != "other-building":
        return whole, whole
    if "item" in about:
        return whole, map_other_buildings(split.removesuffix(DRAWN))[about["set"], about["item"]]
    first, _, second = whole.rpartition(" + ")  # of a drawing; storeys of one building are joined so, too
    return first, second


def describe_places(names: tuple[str, str], sources: tuple[str, str] | None = None) -> dict[str, str]:
    """Return the columns of a row of results that tell where its maps are from: names, sources and physical buildings of a and of
    b.

    Args:
        sources: None: as the names of cached pairs tell them.
    """
    sources = sources or (find_source(names[0]), find_source(names[1]))
    physical = [find_physical_building(*of) for of in zip(sources, names, strict=True)]
    out = {"source": sources[0], "building": names[0], "physical": physical[0]}
    return out | {"other_source": sources[1], "other": names[1], "physical_other": physical[1]}


def list_difficulties(pair: GridPair) -> list[str]:
    """List the difficulties of a cached pair beside its kind (`grid_pairs`: every sixth, every eighth)."""
    difficulty: dict[str, float] = pair.about.get("difficulty", {})  # type: ignore[assignment]
    limits = {"much moved furniture": ("moved", 0.6), "glass walls": ("glass", 0.5)}
    return [title for title, (name, least) in limits.items() if difficulty.get(name, 0.0) >= least]


def find_source(name: str) -> str:
    """Find the source of a building, procedural, campus or r2v: what `grid_pairs.WEIGHTS` draws from."""
    if re.fullmatch(r"[a-z]+-\d+-\d+", name):
        return "procedural"
    return "campus" if name.startswith(("school/", "office/")) else "r2v"


def read_recipe(split: str, overrides: tuple[str, ...] = ()) -> Any:
    """Read the settings of the task that the pairs of a split are made with."""
    return compose_settings(["task=merge_belief", f"data={SETS[split.removesuffix(DRAWN)]}", *overrides])


def find_places(pair: GridPair, split: str) -> dict[str, str]:
    """Find source and buildings of a pair (`describe_places`)."""
    if split in REAL_SPLITS:
        name, source = str(pair.about["building"]), str(pair.about["source"])
        return describe_places((name, name), (source, source))
    return describe_places(find_buildings(pair, split))
