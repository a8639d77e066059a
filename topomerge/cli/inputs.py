"""The maps that the inputs of a command stand for: read from a .tmap, or extracted from anything else, large ones side by side.

Extraction holds the interpreter's lock for most of its time, so that threads gain nothing: each core has a process of its own.
On Linux they are forked, before a thread or a network is started here, as these do not survive a fork: what this process has
imported and loaded is theirs, too. Elsewhere they are spawned, and import for about a second. Either way they start before
anything else is done (`InputMaps`). Very small clouds are extracted here.
"""

from __future__ import annotations

import argparse
import itertools
import os
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from topomerge.cli.console import ProgressBars, Report, exit_on_signals, format_failure, show_log, warn
from topomerge.cli.options import SELECTIVE, collect_given, collect_reading_options, is_map
from topomerge.errors import InputError
from topomerge.progress import Stopwatch

if TYPE_CHECKING:
    from multiprocessing.connection import Connection
    from multiprocessing.process import BaseProcess

    from topomerge.types import TopometricMap

# Advice of the readers that only `extract` can take: --scale and --poses of `merge` are others.
EXTRACT_ADVICE = ("--poses", "--scale", "--spacing")
LEAST_SIZE = {"fork": 2_000_000, "spawn": 5_000_000}  # bytes of a cloud, from which a process is worth it (docs/benchmarks.md)
COMPRESSION = {".laz": 6, ".e57": 2}  # of the bytes of a point, against PLY and LAS
MEMORY_START, MEMORY_GROWTH = 600_000_000, 8  # bytes that extraction takes at most: to start with, and for each byte of the cloud
WORKER_OPTIONS = ("voxel_size", "up", "unit", "sensor", "text", "tag_size", *SELECTIVE, "verbose", "prepares")
EXTRACTION_MODULES = ("topomerge.extraction.extract", "topomerge.io.points")
PREPARATION_MODULE = "topomerge.registration.prepared"
EXTRACTION_LOOPS = ("images", "rasters", "rays", "stencil", "voxels")  # of `topomerge.kernels`
GRACE = 2.0  # s that a process has to end by itself
Starter = Callable[[str], Report | None]  # title of a task -> what moves its bar


@dataclass(frozen=True)
class LoadedMap:
    """A map, the seconds that reading (or loading) and extracting it took, and what registration needs of it, where that was
    drawn at once (`Prepared.pack`)."""

    map: TopometricMap
    read_seconds: float
    extract_seconds: float = 0.0
    parts: Mapping[str, Any] | None = None


def load_stored_map(path: str | Path, args: argparse.Namespace) -> TopometricMap:
    """Load a `.tmap` with its corrections, unless `NO_EDITS` was given.

    Raises:
        InputError: it can't be read.
    """
    from topomerge.edits.journal import find_journal, read_journal
    from topomerge.io.maps import load_map

    topomap = load_map(path)
    if getattr(args, "edits", None) == 0 or not find_journal(path).exists():
        return topomap
    from topomerge.edits.apply import correct_map  # here: what is not corrected needs nothing of the extraction

    return correct_map(topomap, read_journal(find_journal(path)))


def load_input_map(path: str, args: argparse.Namespace) -> TopometricMap:
    """Load the map of one input (`iter_input_maps`)."""
    return next(iter_input_maps([path], args)).map


def iter_input_maps(paths: Sequence[str], args: argparse.Namespace) -> Generator[LoadedMap, None, None]:
    """Yield the maps of the inputs in their order (`InputMaps`).

    Raises:
        InputError: one can't be read or extracted; the line names the file.
    """
    with InputMaps(paths, args) as maps:
        yield from maps


class InputMaps:
    """The maps of the inputs in their order: of a .tmap, or extracted with the `CLOUD_OPTIONS` that were given. They do not
    depend on the number of processes.

    Processes start with the context, so that they import while a command checks what it was given; all end with it.

    Args:
        paths: of the inputs.
        args: of the command.
        ahead: modules that the command needs afterwards; they are imported while another process works.
        prepares: let each process draw what registration needs of the map that it extracted (`LoadedMap.parts`).

    Raises:
        InputError: a cloud can't be opened.
    """

    def __init__(self, paths: Sequence[str], args: argparse.Namespace, ahead: Sequence[str] = (), prepares: bool = False) -> None:
        self._paths, self._ahead = list(paths), list(ahead)
        self._args = argparse.Namespace(**{**vars(args), "prepares": prepares})
        clouds = [path for path in paths if not is_map(path)]
        _open_clouds(clouds)
        sizes = {path: measure_input(path) for path in clouds}
        self._large = {path for path, size in sizes.items() if size >= LEAST_SIZE[choose_start()]}
        large = [sizes[path] for path in self._large]
        self._processes = count_processes(large, getattr(args, "jobs", None)) if len(large) > 1 else 1
        self._stack = ExitStack()
        self._begun: dict[int, Future[LoadedMap]] = {}
        self._first = 0  # input that is not begun

    def __enter__(self) -> InputMaps:
        if self._processes > 1:
            with ExitStack() as stack:
                bars = ProgressBars(enabled=not getattr(self._args, "quiet", False))
                self._others = stack.enter_context(_Processes(self._processes - 1, self._args, bars))
                stack.enter_context(bars)  # not before: they start a thread
                self._begin(self._processes)
                self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def __iter__(self) -> Iterator[LoadedMap]:
        """Yield the maps, once; the processes end with the last one.

        Raises:
            InputError: as `iter_input_maps`.
        """
        for loaded in self._iter_shared() if self._processes > 1 else self._iter_alone():
            warn(loaded.map.warnings)
            yield loaded
        self._stack.close()

    def _begin(self, last: int) -> None:
        """Hand the inputs before `last` to the processes; what is small is left to this one."""
        for path in self._paths[self._first : last]:
            self._begun[self._first] = self._others.submit(path) if path in self._large else Future()
            self._first += 1

    def _iter_alone(self) -> Iterator[LoadedMap]:
        for path in self._paths:
            with ProgressBars(enabled=not getattr(self._args, "quiet", False)) as bars:
                loaded = _load_map(path, self._args, bars.start_task)
            yield loaded

    def _iter_shared(self) -> Iterator[LoadedMap]:
        begun, others = self._begun, self._others
        for k in range(len(self._paths)):
            self._begin(k + self._processes + 1)  # more maps are never in memory
            while not begun[k].done():
                here = next((n for n in sorted(begun) if begun[n].cancel()), None)  # the first that no process has taken
                if here is not None:
                    with others.share_cores():
                        begun[here] = _load_future(self._paths[here], self._args, others.name_bars(self._paths[here]))
                elif self._ahead:
                    import_module(self._ahead.pop(0))
                else:
                    break
            yield begun.pop(k).result()


def _open_clouds(paths: Sequence[str]) -> None:
    """Open each cloud, before anything heavy is imported or compiled.

    Raises:
        InputError: one can't be opened, or its suffix is that of no format.
    """
    if paths:
        from topomerge.io.points import detect_format

        for path in paths:
            detect_format(Path(path))


def _load_future(path: str, args: argparse.Namespace, start_task: Starter) -> Future[LoadedMap]:
    """Load a map here and now; an error is kept until its turn, so that the first input that is wrong is named."""
    done: Future[LoadedMap] = Future()
    try:
        done.set_result(_load_map(path, args, start_task))
    except Exception as error:
        done.set_exception(error)
    return done


def _load_map(path: str, args: argparse.Namespace, start_task: Starter) -> LoadedMap:
    """Load the map of one input.

    Raises:
        InputError: as `iter_input_maps`.
    """
    watch = Stopwatch()
    try:
        if is_map(path):
            topomap = _load_corrected_map(path, getattr(args, "edits", None))
        else:
            from topomerge.extraction.extract import extract
            from topomerge.io.points import read_chunks

            chunks = read_chunks(path, **collect_reading_options(path, args), progress=start_task("read"))
            topomap = extract(chunks, **collect_given(args, "voxel_size"), name=path, progress=start_task("extract"))
        topomap = replace(topomap, parameters={**topomap.parameters, **collect_given(args, "sensor")})
        seconds = watch.elapsed
        parts = _prepare_map(topomap) if getattr(args, "prepares", False) and not is_map(path) else None
    except InputError as error:
        text = str(error) if path in str(error) else f"{path}: {error}"
        if advised := [name for name in EXTRACT_ADVICE if name in text]:
            text += f" ({', '.join(advised)}: of `topomerge extract`, whose .tmap can be given here)"
        raise InputError(text) from error
    extracting, preparing = 0.0, watch.elapsed - seconds
    if not is_map(path):
        extracting = min(sum(s for step, s in topomap.seconds.items() if not step.startswith("read")), seconds)
    return LoadedMap(topomap, seconds - extracting, extracting + preparing, parts)


def _load_corrected_map(path: str, lines: int | None) -> TopometricMap:
    """Load a stored map with what lies beside it; where nothing does, nothing of the extraction is imported."""
    from topomerge.edits.journal import find_journal
    from topomerge.io.landmarks import find_landmark_file
    from topomerge.io.maps import load_map

    if find_landmark_file(Path(path)) is None and (lines == 0 or not find_journal(path).exists()):
        return load_map(path)
    from topomerge.edits.apply import load_corrected_map

    return load_corrected_map(path, lines)


def _prepare_map(topomap: TopometricMap) -> Mapping[str, Any] | None:
    """Prepare a map for registration; None of one that has nothing to register, which registration says."""
    from topomerge.registration.prepared import prepare

    return prepare(topomap).pack() if len(topomap.grid) else None


def measure_input(path: str) -> int:
    """Return the bytes of a cloud, of a folder those of its files, as if they were not compressed."""
    place = Path(path)
    files = [file for file in place.rglob("*") if file.is_file()] if place.is_dir() else [place]
    size = 0
    for file in files:
        with suppress(OSError):  # the reader says what is wrong with it
            size += file.stat().st_size * COMPRESSION.get(file.suffix.lower(), 1)
    return size


def count_processes(sizes: Sequence[int], limit: int | None = None) -> int:
    """Return how many clouds are extracted at once, of those of the given bytes: no more than cores, nor than memory is free for.

    Args:
        limit: of the number; as many as this process may use cores, if None.
    """
    if limit is None:
        limit = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    free, taken = estimate_free_memory(), 0
    for count, size in enumerate(sorted(sizes, reverse=True)[:limit]):
        taken += MEMORY_START + MEMORY_GROWTH * size
        if taken > free:
            return max(count, 1)
    return max(min(limit, len(sizes)), 1)


def estimate_free_memory(root: Path = Path("/")) -> int:
    """Return the bytes that are free on this machine and, within a container, in it; half of all where neither says so.

    Args:
        root: folder of the machine's files, for tests.
    """
    free = []
    with suppress(OSError, ValueError, StopIteration):
        lines = (root / "proc/meminfo").read_text(encoding="ascii").splitlines()
        free.append(int(next(line.split()[1] for line in lines if line.startswith("MemAvailable:"))) * 1024)
    with suppress(OSError, ValueError, StopIteration):
        most = int((root / "sys/fs/cgroup/memory.max").read_text(encoding="ascii"))
        lines = (root / "sys/fs/cgroup/memory.stat").read_text(encoding="ascii").splitlines()
        free.append(most - int(next(line.split()[1] for line in lines if line.startswith("anon "))))
    if free:
        return max(min(free), 0)
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2
    except (AttributeError, ValueError, OSError):  # Windows does not say
        return 2 * MEMORY_START


def choose_start() -> str:
    """Return how processes are started: forked, where that is safe."""
    safe = sys.platform == "linux" and threading.active_count() == 1 and "onnxruntime" not in sys.modules
    return "fork" if safe else "spawn"


class _Processes:
    """Processes that extract clouds, each with a thread here that gives it work and passes on what it tells. All start with the
    context and end with it, however it is left.

    Args:
        count: of processes.
    """

    def __init__(self, count: int, args: argparse.Namespace, bars: ProgressBars) -> None:
        self._options = argparse.Namespace(**{"verbose": 0, **collect_given(args, *WORKER_OPTIONS)})
        self._bars = bars
        self._local = threading.local()
        self._started: list[tuple[BaseProcess, Connection[Any, Any]]] = []
        self._count, self._numbers = count, itertools.count()
        self._working: Any = bytearray(count + 1)  # 1 of each process that extracts, this one last; shared once they start
        self._threads = ThreadPoolExecutor(count, "extract")

    def __enter__(self) -> _Processes:
        method = choose_start()
        if method == "fork":
            _load_extraction(getattr(self._options, "prepares", False))
        from multiprocessing import get_context

        self._working = get_context(method).RawArray("B", self._count + 1)
        with _hold_interrupts(method), warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of forks beside threads: those of BLAS, which ends them before
            for _ in range(self._count):
                self._start_process(method)
        return self

    def _start_process(self, method: str) -> None:
        from multiprocessing import get_context

        ours, theirs = get_context(method).Pipe()
        inherited = [ours, *(other for _, other in self._started)] if method == "fork" else []
        about = (theirs, inherited, self._options, self._bars.enabled, self._working, len(self._started))
        process: BaseProcess = get_context(method).Process(target=_work, args=about, daemon=True)  # type: ignore[attr-defined]
        process.start()
        theirs.close()  # so that its end is seen
        self._started.append((process, ours))

    def __exit__(self, *_: object) -> None:
        for process, _connection in self._started:
            process.terminate()
        for process, _connection in self._started:
            process.join(GRACE)
            process.kill()  # of one that has ended, nothing is left to kill
            process.join()
        self._threads.shutdown(cancel_futures=True)

    def submit(self, path: str) -> Future[LoadedMap]:
        """Return the map of an input to come; cancelled is what this process takes before another one does."""
        return self._threads.submit(self._load, path)

    def share_cores(self) -> AbstractContextManager[None]:
        """Share the cores with the others that extract, while this process does."""
        return _share_cores(self._working, self._count)

    def name_bars(self, path: str) -> Starter:
        """Return what starts the bars of an input, whose texts name it."""

        def start_task(title: str) -> Report | None:
            move = self._bars.start_task(f"{path} {title}")

            def report(fraction: float, text: str = "") -> None:
                if move is not None:
                    move(fraction, f"{Path(path).name}: {text or title}")

            return move and report

        return start_task

    def _load(self, path: str) -> LoadedMap:
        """Let the process of this thread load a map.

        Raises:
            InputError: as `iter_input_maps`.
        """
        process, connection = self._get_process()
        reports: dict[str, Report | None] = {}
        try:
            connection.send(path)
            while isinstance(message := connection.recv(), tuple):
                title, done, text = message
                if title not in reports:
                    reports[title] = self.name_bars(path)(title)
                if (report := reports[title]) is not None:
                    report(done, text)
        except (EOFError, OSError):
            process.join(GRACE)
            status = process.exitcode or 0
            code = f"signal {-status}" if status < 0 else f"status {status}"
            raise InputError(f"{path}: the process that extracted it ended ({code}); if memory is short, give --jobs 1") from None
        if isinstance(message, str):
            raise InputError(message)
        return message  # type: ignore[no-any-return]

    def _get_process(self) -> tuple[BaseProcess, Connection[Any, Any]]:
        """Return the process of this thread."""
        if not hasattr(self._local, "number"):
            self._local.number = next(self._numbers)
        return self._started[self._local.number]


@contextmanager
def _hold_interrupts(method: str) -> Iterator[None]:
    """Hold Ctrl-C, which a terminal sends to all processes. Those that are started meanwhile do not hear it: this one answers
    later, and ends them."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows has none
        yield
        return
    if method == "spawn":
        from multiprocessing import resource_tracker

        resource_tracker.ensure_running()  # its start would let them in again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _load_extraction(prepares: bool = False) -> None:
    """Import what extraction needs (and drawing what registration needs), and load its loops, which takes half as long again."""
    from numba.core.sigutils import normalize_signature

    for name in (*EXTRACTION_MODULES, *([PREPARATION_MODULE] if prepares else [])):
        import_module(name)
    from topomerge.kernels.ahead import load_loops

    for loop, signatures in load_loops().items():
        if loop.py_func.__module__.rpartition(".")[2] in EXTRACTION_LOOPS:
            for signature in signatures:
                loop.compile(normalize_signature(f"({signature},)")[0])


def _work(
    connection: Connection[Any, Any],
    inherited: Sequence[Connection[Any, Any]],
    options: argparse.Namespace,
    shows_progress: bool,
    working: Any,
    number: int,
) -> None:
    """Load the maps of the paths that come, until none comes. Back go tuples of progress, then the map or a line of error.

    Args:
        inherited: ends of the other process, closed here, so that its end is seen.
        working, number: as of `_share_cores`.
    """
    for other in inherited:
        other.close()
    exit_on_signals()
    debug = options.verbose > 1 or os.environ.get("TOPOMERGE_DEBUG", "") not in ("", "0")
    show_log(options.verbose, debug)
    for name in EXTRACTION_MODULES:  # before there is work
        import_module(name)

    def start_task(title: str) -> Report | None:
        def report(fraction: float, text: str = "") -> None:
            connection.send((title, fraction, text))

        return report if shows_progress else None

    with suppress(EOFError, BrokenPipeError):  # the first process has ended
        while True:
            path = connection.recv()
            try:
                with _share_cores(working, number):
                    outcome: LoadedMap | str = _load_map(path, options, start_task)
            except BrokenPipeError:
                raise
            except Exception as error:
                if debug:
                    traceback.print_exc()
                outcome = format_failure(error, [path])
            connection.send(outcome)


@contextmanager
def _share_cores(working: Any, number: int) -> Iterator[None]:
    """Leave the other processes that extract their shares of the cores; what the first of them to end leaves is the others'.

    Args:
        working: shared, 1 of each process that extracts.
        number: of this process in it.
    """
    from topomerge.kernels import share_threads

    working[number] = 1
    share_threads(working)
    try:
        yield
    finally:
        working[number] = 0
        share_threads(None)
