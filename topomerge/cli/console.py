"""The terminal: tables, progress, errors of one line, signals."""

from __future__ import annotations

import argparse
import logging
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import FrameType, ModuleType
from typing import TYPE_CHECKING, Any, TextIO

from topomerge.errors import InputError, is_memory_short, make_printable
from topomerge.progress import build_progress_teller, is_progress_asked

if TYPE_CHECKING:
    from rich.progress import Progress


NEAR_LIMIT = 0.8  # of the memory that a process may take
LEAST_MEMORY = 550_000_000  # bytes of address space that the libraries alone take, with a small map
PAGE_SUFFIXES = (".html", ".htm")
Report = Callable[[float, str], None]  # fraction done in 0..1, what is being done


class ProgressBars:
    """Progress bars on stderr, one a task, that appear once the work has taken over two seconds and vanish at its end.

    Args:
        enabled: False for no bars at all. They are also left out where stderr is not a terminal.
        delay: seconds before they appear.
    """

    def __init__(self, enabled: bool = True, delay: float = 2.0) -> None:
        self.enabled = enabled and sys.stderr is not None and sys.stderr.isatty()
        self._lock = threading.Lock()
        self._state: dict[str, tuple[float, str]] = {}
        self._rows: dict[str, Any] = {}
        self._shown: Progress | None = None
        self._timer = threading.Timer(delay, self._show)
        self._timer.daemon = True

    def __enter__(self) -> ProgressBars:
        if self.enabled:
            self._timer.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._timer.cancel()
        with self._lock:
            self.enabled = False
            if self._shown is not None:
                self._shown.stop()

    def start_task(self, title: str) -> Report | None:
        """Return a callable that moves the bar of one task, or tells who started this process; None where nobody will see it."""
        if is_progress_asked():
            return build_progress_teller(title)
        if not self.enabled:
            return None

        def report(fraction: float, text: str = "") -> None:
            with self._lock:
                self._state[title] = (min(max(float(fraction), 0.0), 1.0), make_printable(text))
                self._draw()

        return report

    def _show(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

        text = TextColumn("{task.description}", markup=False)
        columns = (text, BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
        with self._lock:
            if self.enabled:  # the work may have ended while rich was being imported
                self._shown = Progress(*columns, console=Console(stderr=True), transient=True)
                self._shown.start()
                self._draw()

    def _draw(self) -> None:
        if self._shown is None:
            return
        for title, (fraction, text) in self._state.items():
            if title not in self._rows:
                self._rows[title] = self._shown.add_task(title, total=1.0)
            self._shown.update(self._rows[title], completed=fraction, description=text or title)


class PrintError(Exception):
    """Standard output can't be written to: no file's fault."""


@contextmanager
def guard_printing() -> Iterator[None]:
    """Convert errors of printing within the context into `PrintError`.

    Raises:
        PrintError: the disk is full, for example.
        BrokenPipeError: what read it has gone away.
    """
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        raise PrintError(f"what is printed can't be written ({error.strerror or error})") from error


def write_out(text: str) -> None:
    """Write to stdout as it is."""
    with guard_printing():
        sys.stdout.write(text)


def print_text(text: str, stream: TextIO | None = None) -> None:
    """Print what may quote a stranger's file; to stdout by default."""
    with guard_printing():
        print(make_printable(text), file=stream)


def print_line(text: str, stream: TextIO | None = None) -> None:
    """Print one line, though names of files may hold line breaks; to stdout by default."""
    print_text(" ".join(text.splitlines()), stream)


def warn(messages: Iterable[str]) -> None:
    """Print warnings to stderr, one line each."""
    for message in messages:
        print_text(f"topomerge: warning: {' '.join(message.split())}", sys.stderr)


def show_log(verbose: int, debug: bool) -> None:
    """Show what this package logs; what libraries log or warn of, in words of theirs, only to those who look for a fault."""
    if not logging.getLogger().handlers:
        handler = logging.StreamHandler()
        handler.setFormatter(logging.Formatter("topomerge: %(message)s"))
        if not debug:
            handler.addFilter(logging.Filter("topomerge"))
        logging.getLogger().addHandler(handler)
    level = (logging.WARNING, logging.INFO, logging.DEBUG)[min(verbose, 2)]
    logging.getLogger("topomerge").setLevel(level)
    if not debug and not sys.warnoptions:
        warnings.simplefilter("ignore")


def _is_at_memory_limit() -> bool:
    """Return whether this process has taken nearly as much memory as it may. Then an odd error is most likely a failed
    allocation."""
    try:
        import resource

        status = Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
        peak = next((int(line.split()[1]) for line in status.splitlines() if line.startswith("VmPeak:")), 0)
    except (ImportError, OSError, MemoryError):
        return False
    most, _ = resource.getrlimit(resource.RLIMIT_AS)
    return most != resource.RLIM_INFINITY and peak * 1024 > NEAR_LIMIT * most


def _format_memory_limit() -> str:
    """Tell how much memory this process may take, if that is limited."""
    try:
        import resource
    except ImportError:  # Windows has no such limits
        return ""
    most, _ = resource.getrlimit(resource.RLIMIT_AS)
    return "" if most == resource.RLIM_INFINITY else f" (ulimit -v allows {most / 2**30:.2g} GB)"


def check_memory_limit() -> None:
    """Refuse to start where the process may take less memory than its libraries do: OpenBLAS then ends it with words of its own.

    Raises:
        InputError: the address space is limited to less than `LEAST_MEMORY`.
    """
    try:
        import resource
    except ImportError:  # Windows has no such limits
        return
    most, _ = resource.getrlimit(resource.RLIMIT_AS)
    if most != resource.RLIM_INFINITY and most < LEAST_MEMORY:
        raise InputError(
            f"not enough memory{_format_memory_limit()}: at least {LEAST_MEMORY / 2**30:.2g} GB are needed; raise the limit"
        )


def format_failure(error: BaseException, paths: Sequence[str], outputs: Sequence[str] = ()) -> str:
    """Return one line about an error that names the file it is about, of those that were read the first."""
    if not isinstance(error, InputError) and (is_memory_short(error) or _is_at_memory_limit()):
        text = f"not enough memory{_format_memory_limit()}; take larger voxels or a part of the input"
    elif isinstance(error, OSError) and error.strerror:
        text = f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    elif isinstance(error, ImportError):
        text = f"this needs the Python package {error.name or error}, which is not installed"
    elif isinstance(error, ValueError):
        text = str(error)
    else:
        text = f"unexpected {type(error).__name__}: {error} (a fault in topomerge: run again with -v -v and report it)"
    text = " ".join(text.split()) or type(error).__name__
    named = any(" ".join(path.split()) in text for path in (*paths, *outputs))
    if paths and not text.startswith("--") and not named:  # an option is no file's fault
        text = f"{paths[0]}: {text}"
    return " ".join(text.split())


def find_signal(error: BaseException | None) -> BaseException | None:
    """Find the Ctrl-C or SIGTERM that an error comes from, if any: one during compiled code comes out as a SystemError."""
    seen: set[int] = set()
    while error is not None and not isinstance(error, KeyboardInterrupt | SystemExit):
        if id(error) in seen:  # errors can come from each other
            return None
        seen.add(id(error))
        error = error.__cause__ or error.__context__
    return error


class _WriteProbe(Exception):
    """Ends a trial of writing."""


def _resolve_path(path: str | Path) -> Path:
    """Return where a path leads, through all links; one that leads round in a circle, at which `Path.resolve` fails, to
    itself."""
    return Path(os.path.realpath(path))


def check_inputs(paths: Sequence[str]) -> None:
    """Find out before the work starts whether its files are there, each of them once.

    Raises:
        InputError: one is missing, or two names mean the same file.
    """
    seen: set[Path] = set()
    for path in paths:
        place = _resolve_path(path)
        if not place.exists():
            raise InputError(f"{path}: no such file; check the path")
        if place in seen:
            raise InputError(f"{path}: is given twice; give each file once")
        seen.add(place)


@contextmanager
def open_output_folder(path: str | Path) -> Iterator[Path]:
    """Open a folder to write into, made with those above it where they are missing. What stays empty is taken away again.

    Raises:
        InputError: it is a file, or can't be made.
    """
    folder = Path(path)
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is a file; give the name of a folder")
    missing = [place for place in (folder, *folder.parents) if not place.exists()]
    try:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{folder}: can't be made ({error.strerror or error}); give another folder") from error
        yield folder
    finally:
        for empty in missing:
            with suppress(OSError):  # what is written stays
                empty.rmdir()


def check_suffix(name: str, path: str, suffixes: Sequence[str]) -> None:
    """Refuse an output whose name promises another format.

    Args:
        name: of the option, with its dashes.
        suffixes: in small letters; the first is the usual one.

    Raises:
        InputError: its suffix is none of them.
    """
    if Path(path).suffix.lower() not in suffixes:
        raise InputError(f"{path}: {name} writes {suffixes[0]}; end its name with {' or '.join(suffixes)}")


def check_outputs(outputs: Sequence[str | Path], inputs: Sequence[str | Path] = ()) -> None:
    """Find out before the work starts whether its results can be written.

    Raises:
        InputError: a folder is missing or can't be written, a path is a folder, is an input or is given twice.
    """
    from topomerge.archive import replace_on_success  # here, because topomerge.io imports NumPy

    taken = {_resolve_path(path): "is the input: it would be overwritten; give another name" for path in inputs}
    for path in map(Path, outputs):
        if path.is_dir():
            raise InputError(f"{path}: is a folder; give the name of a file in it")
        place = _resolve_path(path)
        if place in taken:
            raise InputError(f"{path}: {taken[place]}")
        taken[place] = "is named for two outputs; give each its own name"
        with suppress(_WriteProbe), replace_on_success(path):
            raise _WriteProbe


def write_all(outputs: Sequence[tuple[str | Path, Callable[[Path], None]]]) -> None:
    """Write every output beside its place and rename them once all are whole: either all appear or none.

    Args:
        outputs: where, and what writes a file to the path that it is given.

    Raises:
        InputError: one can't be written.
    """
    from topomerge.archive import replace_on_success

    with ExitStack() as stack:
        for path, save in outputs:
            temporary = stack.enter_context(replace_on_success(path))
            try:
                save(temporary)
            except OSError as error:
                raise InputError(f"{path}: can't be written ({error.strerror or error}); give another place") from error
        if len(outputs) > 1:  # a kill between two renames must not leave one file of this run beside one of an earlier run
            for path, _ in outputs:
                _resolve_path(path).unlink(missing_ok=True)


# But imported by SciPy, with all that they import. None that is used may stand here: two threads that use a late module for the
# first time at once see half of it.
NEVER_USED = ("numpy.f2py", "numpy.testing")


class _LateFinder:
    """Lets modules run when something of them is used, not when they are imported."""

    @staticmethod
    def find_spec(name: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        if name not in NEVER_USED:
            return None
        from importlib.util import LazyLoader

        spec = PathFinder.find_spec(name, path, target)
        if spec is not None and spec.loader is not None:
            spec.loader = LazyLoader(spec.loader)
        return spec


def postpone_imports() -> None:
    """Let this process run `NEVER_USED` when something of them is used, and find no documentation, as with `python -OO`: SciPy
    parses its own when it is imported, for a tenth of a second."""
    import inspect

    sys.meta_path.insert(0, _LateFinder)
    inspect.getdoc = lambda object: None


COMPILER = f"{os.sep}llvmlite{os.sep}"
IMPORTER, CALLBACK = "<frozen importlib._bootstrap>", "cb"  # of its locks: what is raised in there is printed and lost
ASK_AGAIN = 0.1  # s


def exit_on_signals() -> None:
    """Exit on signals from now on: SIGINT raises KeyboardInterrupt, SIGTERM SystemExit(143).

    Neither within the compiler nor within a callback of imports, where it would be lost: a moment later.
    """
    asked: list[int] = []

    def leave(number: int, frame: FrameType | None) -> None:
        asked.append(number)
        if hasattr(signal, "setitimer") and _is_deaf(frame):
            signal.setitimer(signal.ITIMER_REAL, ASK_AGAIN)
        elif asked[0] == signal.SIGINT:
            raise KeyboardInterrupt
        else:
            raise SystemExit(143)

    for name in ("SIGINT", "SIGTERM", "SIGALRM"):
        if hasattr(signal, name):  # Windows has no alarm
            signal.signal(getattr(signal, name), leave)


def _is_deaf(frame: FrameType | None) -> bool:
    """Return whether an exception would be lost here: whether any function on the stack is the compiler's, or a callback of the
    importer's locks."""
    while frame is not None:
        code = frame.f_code
        if COMPILER in code.co_filename or (code.co_filename == IMPORTER and code.co_name == CALLBACK):
            return True
        frame = frame.f_back
    return False


Argument = tuple[tuple[str, ...], dict[str, Any]]


@dataclass(frozen=True)
class Command:
    """One command: its function, its words for the help and its arguments.

    `run` takes the parsed arguments and returns the exit status; `paths` are the arguments that name files, the input first:
    an error that names no file is reported under the first of them. `one_input` is said of words too many.
    """

    name: str
    run: Callable[[argparse.Namespace], int]
    summary: str
    example: str
    arguments: tuple[Argument, ...]
    paths: tuple[str, ...] = ()
    description: str = ""
    one_input: str = ""


def build_option(*flags: str, **settings: Any) -> Argument:
    """Build one argument, as argparse's `add_argument` takes it.

    An option without `default` is absent from the namespace unless it was given: its default has one home, the function
    that takes it (see `topomerge.cli.options.collect_given`).
    """
    if flags[0].startswith("-"):
        settings.setdefault("default", argparse.SUPPRESS)
    return flags, settings
