"""The builder of cached sets, what is derived from them, and its scripts."""

from __future__ import annotations

import hashlib
import json
import re
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn, Protocol, TypeVar

import numpy as np

from topomerge import archive
from topomerge.archive import convert_to_plain, replace_on_success
from topomerge.code_digest import compute_code_digest
from topomerge.errors import InputError
from topomerge.progress import Stopwatch
from topomerge.types import Array, LogFn

ItemType = TypeVar("ItemType")

PATIENCE = 20.0  # s to wait for the scheduler of a cluster
FAULT = re.compile(r"\w+(Error|Exception): ")  # a reason that is no refusal of an input
OLD = 3600.0  # s; half-written files of a build that was killed are deleted when they are older
Task = tuple[Any, Any, str]  # an item, which has a name; what it is made from; the folder of its file


class BuildSettings(Protocol):
    """How the work is shared out: the folder of the cache, processes, scheduler of a cluster, and [k, n]: every n-th item from
    the k-th on."""

    cache: str
    jobs: int
    cluster: str | None
    part: list[int]


class TooLongError(InputError):
    """An item took too long; on another machine it may not."""


@dataclass(frozen=True)
class BuildRow:
    """The outcome of an item: `reason` is empty where its file was made."""

    name: str
    reason: str
    seconds: float


Work = Callable[[Any, Any, str], BuildRow]


@dataclass(frozen=True)
class BuildReport:
    """The outcome of a build; `refused` counts reasons."""

    manifest: Path
    items: int
    made: int
    seconds: float  # of work, of the items made now
    refused: dict[str, int]


def check_sharing(sharing: BuildSettings) -> None:
    """Refuse what work can't be shared out by.

    Raises:
        InputError: names the key.
    """
    if sharing.jobs < 1:
        raise InputError(f"jobs must be 1 or more, not {sharing.jobs}")
    if len(sharing.part) != 2 or not 1 <= sharing.part[0] <= sharing.part[1]:
        raise InputError(f"part must be [k, n] with 1 <= k <= n, not {sharing.part}")


def select_items(items: Sequence[ItemType], limit: int) -> list[ItemType]:
    """Select so many of the items of a set, 0: all, at random and in their order; a larger selection holds a smaller one.

    Raises:
        InputError: a negative limit.
    """
    if limit < 0:
        raise InputError(f"data.limit must be 0 or more, not {limit}")
    if not limit or limit >= len(items):
        return list(items)
    return [items[k] for k in sorted(np.random.default_rng(0).permutation(len(items))[:limit].tolist())]


def build_set(
    manifest: Path, tasks: Sequence[Task], work: Work, sharing: BuildSettings, log_line: LogFn = lambda text: None,
    every: float = 10.0,
    unit: str = "pairs",
) -> BuildReport:  # fmt: skip
    """Make the files of a set that are missing, the first tasks first, then write its manifest.

    Args:
        manifest: file to write; the tasks name the folder of the files.
        work: makes the file of a task (`make_item`).
        log_line: is told the progress, a line each `every` seconds.
        unit: what the items are called there.

    Raises:
        InputError: all that was missing failed for other reasons than its inputs.
    """
    folders = {item.name: Path(folder) for item, _, folder in tasks}
    for folder in set(folders.values()):
        folder.mkdir(parents=True, exist_ok=True)
        _tidy(folder)
    rows = {n: row for n, folder in folders.items() if (row := _read_cached_row(folder / f"{n}.npz")) is not None}
    refusals = {n: reason for n, folder in folders.items() if n not in rows and (reason := read_refusal(folder, n))}
    missing = {task[0].name: task for task in tasks if task[0].name not in rows and task[0].name not in refusals}
    log_line(f"{len(rows)} of {len(folders)} {unit} are in the cache, {len(refusals)} are known to be refused")
    results = run_tasks(list(missing.values()), sharing, BuildProgress(len(missing), log_line, every, unit), work)
    if results and all(FAULT.match(row.reason) for row in results):
        raise InputError(f"{manifest.name}: none of {len(results)} {unit} could be made: {results[0].reason}")
    rows |= {row.name: read_about(folders[row.name] / f"{row.name}.npz") for row in results if not row.reason}
    with replace_on_success(manifest) as temporary:
        lines = [json.dumps(rows[name], sort_keys=True, ensure_ascii=False) for name in sorted(rows)]
        temporary.write_text("".join(line + "\n" for line in lines), encoding="utf-8")
    refused = Counter(_generalize_reason(reason) for reason in (*refusals.values(), *(row.reason for row in results)) if reason)
    seconds = sum(row.seconds for row in results if not row.reason)
    return BuildReport(manifest, len(rows), sum(not row.reason for row in results), seconds, dict(refused.most_common()))


def make_item(name: str, folder: str, make: Callable[[], Mapping[str, Array]], longest: float) -> BuildRow:
    """Make an item's file in a folder, or one that says why there is none. It never raises: what went wrong is in the row.

    One thread is used, so that as many workers as cores don't fight for them.

    Args:
        make: gives the arrays; among them `about`, the row of the manifest as JSON.
        longest: s of a processor that it may take.
    """
    watch = Stopwatch()
    try:
        with limit_threads(), limit_time(longest):
            archive.write(make(), Path(folder) / f"{name}.npz")
        reason = ""
    except Exception as error:  # one bad item must not end a build
        reason = " ".join(str(error).split())[:200]
        reason = reason if isinstance(error, InputError) else f"{type(error).__name__}: {reason}"
        if isinstance(error, InputError) and not isinstance(error, TooLongError):
            with replace_on_success(Path(folder) / f"{name}.refused") as temporary:  # the same inputs would be refused again
                temporary.write_text(reason + "\n", encoding="utf-8")
    return BuildRow(name, reason, watch.elapsed)


def read_refusal(folder: Path, name: str) -> str:
    """Read why an item was refused before; empty where it was not."""
    path = folder / f"{name}.refused"
    return path.read_text(encoding="utf-8").strip() if path.is_file() else ""


@contextmanager
def limit_threads() -> Iterator[None]:
    """Keep BLAS, OpenMP and the compiled loops to one thread."""
    from threadpoolctl import threadpool_limits

    from topomerge.kernels import count_threads, set_thread_count

    threads = count_threads()
    set_thread_count(1)
    try:
        with threadpool_limits(1):
            yield
    finally:
        set_thread_count(threads)


@contextmanager
def limit_time(seconds: float) -> Iterator[None]:
    """End what takes more than so many seconds of the processor with an `InputError`; without effect in threads, which get no
    signals."""
    # By the clock, a busy machine would leave out what a quiet one has: the same command, another data set.
    if threading.current_thread() is not threading.main_thread() or not hasattr(signal, "setitimer"):
        yield
        return

    def stop(*_: object) -> NoReturn:
        raise TooLongError(f"takes more than {seconds:g} s of a processor")

    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


def read_about(path: Path) -> dict[str, Any]:
    """Read the description in a cached file, after checking that the whole file can be read.

    Raises:
        InputError: it is damaged.
    """
    row: dict[str, Any] = json.loads(archive.read(path, "cached item")["about"].tobytes())
    return row


def _tidy(folder: Path) -> None:
    for path in (p for ending in ("npz", "refused") for p in folder.glob(f".*.{ending}")):
        if time.time() - path.stat().st_mtime > OLD:
            path.unlink(missing_ok=True)


def _read_cached_row(path: Path) -> dict[str, Any] | None:
    """Read the description of a cached file; None where it is missing or damaged and has to be made."""
    try:
        return read_about(path) if path.exists() else None
    except InputError:
        return None


def _generalize_reason(reason: str) -> str:
    """Return a reason without the names and numbers, to be counted."""
    return re.sub(r"\S*\d\S*", "#", reason)


class BuildProgress:
    """Tells now and then how far a build is."""

    def __init__(self, total: int, log_line: LogFn, every: float, unit: str = "pairs") -> None:
        self.total, self.log_line, self.every, self.unit = total, log_line, every, unit
        self.done = self.refused = 0
        self.last, self.watch = 0.0, Stopwatch()

    def __call__(self, row: BuildRow) -> None:
        self.done += 1
        if row.reason:
            self.refused += 1
            self.log_line(f"refused {row.name}: {row.reason}")
        now = self.watch.elapsed
        if now - self.last >= self.every or self.done == self.total:
            self.last = now
            each = now / self.done
            left = time.strftime("%H:%M:%S", time.gmtime(each * (self.total - self.done)))
            self.log_line(f"{self.done} of {self.total} {self.unit}, {self.refused} refused, {each:.2f} s each, {left} left")


def run_tasks(tasks: list[Task], sharing: BuildSettings, note: Callable[[BuildRow], None], work: Work) -> list[BuildRow]:
    """Return rows of all tasks. A task that kills its worker is found by running those that were under way one by one."""
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    rows: dict[str, BuildRow] = {}
    while pending := [task for task in tasks if task[0].name not in rows]:
        names = {task[0].name for task in pending}
        try:
            for row in _run_parallel(pending, sharing, work):
                if row.name not in names:  # it would be made for ever
                    raise ValueError(f"{row.name} was made, but no task has this name")
                rows[row.name] = row
                note(row)
        except TerminatedWorkerError:
            left = [task for task in pending if task[0].name not in rows]
            for row in (_run_alone(task, sharing, work) for task in left[: 2 * sharing.jobs]):
                rows[row.name] = row
                note(row)
    return list(rows.values())


def _run_alone(task: Task, sharing: BuildSettings, work: Work) -> BuildRow:
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    try:
        return next(iter(list(_run_parallel([task], sharing, work))))
    except TerminatedWorkerError:
        return BuildRow(task[0].name, "killed its worker (out of memory?)", 0.0)


def _run_parallel(tasks: Iterable[Task], sharing: BuildSettings, work: Work) -> Iterator[BuildRow]:
    from joblib import Parallel, delayed

    with _configure_backend(sharing):
        parallel = Parallel(return_as="generator_unordered", batch_size=1, pre_dispatch="2 * n_jobs")
        yield from parallel(delayed(work)(*task) for task in tasks)


@contextmanager
def _configure_backend(sharing: BuildSettings) -> Iterator[None]:
    """Set where joblib works: processes started afresh (never forked: threads and locks don't survive that), or a cluster."""
    from joblib import parallel_config

    if sharing.cluster is None:
        with parallel_config(backend="loky", n_jobs=sharing.jobs, inner_max_num_threads=1):
            yield
        return
    try:
        from dask.distributed import Client
    except ImportError as error:
        raise InputError("a cluster needs Dask: pip install topomerge[cluster]") from error
    try:
        client = Client(sharing.cluster, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(f"cluster: no scheduler answers at {sharing.cluster}") from error
    with client, parallel_config(backend="dask", client=client, n_jobs=-1):
        yield


LONGEST_STEP = 900.0  # s an item
Step = Callable[..., Mapping[str, Array]]  # of paths and options


@dataclass(frozen=True)
class DerivedItem:
    """Everything that the bytes of one file depend on."""

    step: str
    sources: tuple[str, ...]
    options: str
    code: str

    @property
    def name(self) -> str:
        """A hash of it."""
        return hashlib.sha256(json.dumps(convert_to_plain(vars(self)), sort_keys=True).encode()).hexdigest()[:24]


def make_derived(item: DerivedItem, given: tuple[Step, Sequence[Path]], folder: str) -> BuildRow:
    """Make one file of a step."""
    step, paths = given
    options = json.loads(item.options)

    def make() -> dict[str, Array]:
        arrays = dict(step(*paths, **options))
        about = json.dumps({"file": f"{item.name}.npz", "sources": list(item.sources)}, sort_keys=True)
        return {**arrays, "about": np.frombuffer(about.encode(), np.uint8)}

    return make_item(item.name, folder, make, LONGEST_STEP)


def derive(
    name: str, step: Step, sources: Sequence[Sequence[Path]], sharing: BuildSettings, options: Mapping[str, Any] | None = None,
    log_line: LogFn = lambda text: None,
) -> tuple[list[Path], BuildReport]:  # fmt: skip
    """Return files of a step, made where they are missing, in the order of their sources; those that were refused are left out.

    Args:
        name: of the manifest and of the folder.
        step: a function of a module, which other processes can import.
        sources: the paths that each file is made from, which are named by hashes themselves.
        options: more arguments, as JSON has them.
    """
    cache = Path(sharing.cache).resolve()
    folder, code = cache / name, compute_code_digest(step.__module__)
    text = json.dumps(convert_to_plain(dict(options or {})), sort_keys=True)
    items = [DerivedItem(step.__name__, tuple(p.stem for p in paths), text, code) for paths in sources]
    tasks = [(item, (step, list(paths)), str(folder)) for item, paths in zip(items, sources, strict=True)]
    report = build_set(cache / f"{name}.jsonl", tasks, make_derived, sharing, log_line, unit=name)
    return [path for item in items if (path := folder / f"{item.name}.npz").exists()], report


def read_sources(path: Path) -> list[str]:
    """Read the stems of the names of the files that a file was made from."""
    about: dict[str, Any] = json.loads(archive.read(path, "cached item", only=["about"])["about"].tobytes())
    sources: list[str] = about["sources"]
    return sources


def read_derived(path: Path) -> dict[str, Array]:
    """Read the arrays of a file, but for what it says about itself."""
    arrays = archive.read(path, "cached item")
    del arrays["about"]
    return arrays


def print_lines(lines: Iterable[object]) -> int:
    """Print lines as they are made; the exit status of the script."""
    try:
        for line in lines:
            print(line, flush=True)
    except InputError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


def run_script(name: str, work: Callable[[], None], after_interrupt: str = "start it again to go on") -> int:
    """Run a script and return the exit status: 0 done, 1 a fault of the input, 130 interrupted.

    Args:
        name: of the script, before what it says.
        work: prints its results by itself.
        after_interrupt: what one may do after Ctrl-C.
    """
    try:
        work()
    except InputError as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f"{name}: interrupted; {after_interrupt}", file=sys.stderr)
        return 130
    return 0
