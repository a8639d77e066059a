"""Build a cached set of extracted pairs: ``python -m topomerge.datasets.pairs.build data=train_small``.

The cache holds `pairs/<hash of the inputs>.npz`, or `.refused` with the reason, and a manifest `<name>.jsonl`. A build that
was killed goes on where it was; the result has the same bytes. Work is shared out by joblib: over processes of this machine
(``jobs=2``), or over a Dask cluster (``cluster=tcp://host:8786``), whose workers must see the cache under the same path.
Machines that share nothing make a part each (``part=[1,2]`` and ``part=[2,2]``); with the files of all parts in one cache, the
build without a part writes the whole manifest.
"""

from __future__ import annotations

import json
import re
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from topomerge.datasets.core.plan import Plan
from topomerge.datasets.core.script import exit_status
from topomerge.datasets.pairs.example import Row, about, make_file, refusal
from topomerge.datasets.pairs.items import Item, draw_items, plans_of
from topomerge.datasets.pairs.recipe import Recipe, check, library

from topomerge.errors import InputError
from topomerge.io.atomic import replacing

PATIENCE = 20.0  # s to wait for the scheduler of a cluster
OLD = 3600.0  # s; half-written files of a build that was killed are deleted when they are older
Plans = list[tuple[Plan, ...]]
Task = tuple[Item, Plans, str]
Work = Callable[[Item, Plans, str], Row]


@dataclass
class Build:
    """Settings of a build; `part` [k, n] makes every n-th pair from the k-th on."""

    data: Recipe = field(default_factory=Recipe)
    cache: str = "cache"
    jobs: int = 1
    cluster: str | None = None
    part: list[int] = field(default_factory=lambda: [1, 1])


@dataclass(frozen=True)
class Report:
    """What a build did; `refused` counts reasons."""

    manifest: Path
    pairs: int
    made: int
    seconds: float  # of work, of the pairs made now
    refused: dict[str, int]


def build(settings: Build, say: Callable[[str], None] = lambda text: None, every: float = 10.0) -> Report:
    """Make what is missing of a set, then write its manifest.

    Args:
        say: is told the progress, a line each `every` seconds.

    Raises:
        InputError: a recipe that nothing can be made of, or a cluster that can't be reached.
    """
    check(settings.data)
    if settings.jobs < 1:
        raise InputError(f"jobs must be 1 or more, not {settings.jobs}")
    if len(settings.part) != 2 or not 1 <= settings.part[0] <= settings.part[1]:
        raise InputError(f"part must be [k, n] with 1 <= k <= n, not {settings.part}")
    folder = Path(settings.cache).resolve() / "pairs"
    folder.mkdir(parents=True, exist_ok=True)
    _tidy(folder)
    say("reading plans")
    plans = library(settings.data)
    first, step = settings.part
    items = {item.name: item for item in draw_items(settings.data, plans)[first - 1 :: step]}
    known = {name: told for name in items if (told := _kept(folder / f"{name}.npz")) is not None}
    refusals = {n: reason for n in items if n not in known and (reason := refusal(folder, n))}
    tasks = [(items[n], list(plans_of(items[n], plans)), str(folder)) for n in items if n not in known and n not in refusals]
    tasks.sort(key=lambda task: -task[0].rooms)  # the longest first, so that all workers end at about the same time
    say(f"{len(known)} of {len(items)} pairs are in the cache, {len(refusals)} are known to be refused")
    rows = _run(tasks, settings, Progress(len(tasks), say, every))
    made = sum(not row.reason for row in rows)
    known |= {row.name: about(folder / f"{row.name}.npz") for row in rows if not row.reason}
    manifest = folder.parent / f"{settings.data.name}.jsonl"
    with replacing(manifest) as beside:
        lines = [json.dumps(known[name], sort_keys=True, ensure_ascii=False) for name in sorted(known)]
        beside.write_text("".join(line + "\n" for line in lines), encoding="utf-8")
    refused = Counter(_kind(reason) for reason in (*refusals.values(), *(row.reason for row in rows)) if reason)
    seconds = sum(row.seconds for row in rows if not row.reason)
    return Report(manifest, len(known), made, seconds, dict(refused.most_common()))


def _tidy(folder: Path) -> None:
    for path in (p for ending in ("npz", "refused") for p in folder.glob(f".*.{ending}")):
        if time.time() - path.stat().st_mtime > OLD:
            path.unlink(missing_ok=True)


def _kept(path: Path) -> dict[str, Any] | None:
    """What a file of the cache is; a damaged one is made again."""
    try:
        return about(path) if path.exists() else None
    except InputError:
        return None


def _kind(reason: str) -> str:
    """A reason without the names and numbers, to be counted."""
    return re.sub(r"\S*\d\S*", "#", reason)


class Progress:
    """Tells now and then how far a build is."""

    def __init__(self, total: int, say: Callable[[str], None], every: float) -> None:
        self.total, self.say, self.every = total, say, every
        self.done = self.refused = 0
        self.began = self.last = time.monotonic()

    def __call__(self, row: Row) -> None:
        self.done += 1
        if row.reason:
            self.refused += 1
            self.say(f"refused {row.name}: {row.reason}")
        now = time.monotonic()
        if now - self.last >= self.every or self.done == self.total:
            self.last = now
            each = (now - self.began) / self.done
            left = time.strftime("%H:%M:%S", time.gmtime(each * (self.total - self.done)))
            self.say(f"{self.done} of {self.total} pairs, {self.refused} refused, {each:.2f} s a pair, {left} left")


def _run(tasks: list[Task], settings: Build, note: Callable[[Row], None], work: Work = make_file) -> list[Row]:
    """Rows of all tasks. A task that kills its worker is found by running those that were under way one by one."""
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    rows: dict[str, Row] = {}
    while pending := [task for task in tasks if task[0].name not in rows]:
        try:
            for row in _parallel(pending, settings, work):
                rows[row.name] = row
                note(row)
        except TerminatedWorkerError:
            left = [task for task in pending if task[0].name not in rows]
            for row in (_alone(task, settings, work) for task in left[: 2 * settings.jobs]):
                rows[row.name] = row
                note(row)
    return list(rows.values())


def _alone(task: Task, settings: Build, work: Work) -> Row:
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    try:
        return next(iter(list(_parallel([task], settings, work))))
    except TerminatedWorkerError:
        return Row(task[0].name, "killed its worker (out of memory?)", 0.0)


def _parallel(tasks: Iterable[Task], settings: Build, work: Work) -> Iterator[Row]:
    from joblib import Parallel, delayed

    with _backend(settings):
        parallel = Parallel(return_as="generator_unordered", batch_size=1, pre_dispatch="2 * n_jobs")
        yield from parallel(delayed(work)(*task) for task in tasks)


@contextmanager
def _backend(settings: Build) -> Iterator[None]:
    """Where joblib works: processes started afresh (never forked: numba's threads don't survive that), or a cluster."""
    from joblib import parallel_config

    if settings.cluster is None:
        with parallel_config(backend="loky", n_jobs=settings.jobs, inner_max_num_threads=1):
            yield
        return
    try:
        from dask.distributed import Client
    except ImportError as error:
        raise InputError("a cluster needs Dask: pip install topomerge[cluster]") from error
    try:
        client = Client(settings.cluster, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(f"cluster: no scheduler answers at {settings.cluster}") from error
    with client, parallel_config(backend="dask", client=client, n_jobs=-1):
        yield


def main(words: list[str] | None = None) -> int:
    """Read the settings with Hydra, build, and print what came of it."""
    words = sys.argv[1:] if words is None else words
    if {"-h", "--help"} & set(words):
        print(f"{__doc__}\nKeys: configs/build.yaml and configs/data/*.yaml; for example data.pairs=100 cache=/tmp/cache jobs=2")
        return 0
    return exit_status("build", lambda: _build_and_print(words))


def _build_and_print(words: list[str]) -> None:
    from topomerge.config import compose

    settings = compose("build", Build, words)
    report = build(settings, lambda text: print(f"build: {text}", file=sys.stderr, flush=True))
    each = f", {report.seconds / report.made:.2f} s of work each" if report.made else ""
    print(f"{report.manifest}: {report.pairs} pairs, {report.made} made now{each}, {sum(report.refused.values())} refused")
    for reason, count in report.refused.items():
        print(f"  {count} times: {reason}")


if __name__ == "__main__":
    sys.exit(main())
