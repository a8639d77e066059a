"""Loops that an extraction and a merge need, compiled before their first use by one process for each core.

What is done is noted beside numba's files: a process that imports the loops afterwards looks at the note only. While one process
has them compiled, others that need them wait. Without this the loops are compiled one after the other, at their first calls.
"""

from __future__ import annotations

import gc
import hashlib
import logging
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

import llvmlite.binding
import numba

try:  # parts of numba that it does not promise to keep: without them loops load as it loads them
    from numba.core.caching import FunctionCache
    from numba.core.runtime import rtsys

    class _Cache(FunctionCache):  # type: ignore[misc]
        """Numba's cache of a loop, which sets up the compiler, for .3 s, before it loads what is compiled. This one does not: the
        compiler sets itself up where it is needed after all."""

        def load_overload(self, sig: Any, target_context: Any) -> Any:
            rtsys.initialize(target_context)  # of what is set up, all that loaded code calls
            with self._guard_against_spurious_io_errors():
                return self._load_overload(sig, target_context)

except ImportError:
    _Cache = None  # type: ignore[assignment, misc]

MODULES = ("bend", "graphs", "images", "meshes", "occupied_cells", "rasters", "rays", "registration", "stencil", "voxels")
SWITCH = "TOPOMERGE_COMPILE_AHEAD"  # environment variable: 0 compiles nothing ahead
NOTE = "ahead"
AHEAD: dict[Any, tuple[str, ...]] = {}  # loops, each with the types of its arguments
_log = logging.getLogger("topomerge")


def compile_ahead(*signatures: str, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Compile a loop as `numba.njit` does, kept on disk, for these types of arguments ahead of its first call.

    Args:
        signatures: types of all arguments, in numba's words: "i8[:,::1], f8".
        options: of `numba.njit`.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        loop = numba.njit(cache=True, nogil=True, **options)(function)
        if _Cache is not None and not numba.config.DISABLE_JIT:  # type: ignore[attr-defined]
            loop._cache = _Cache(function)
        AHEAD[loop] = signatures
        return loop

    return decorate


def compile_missing(cache: Path, processes: int) -> None:
    """Compile the loops, unless that is noted already; say so in one line.

    Args:
        cache: folder in which numba keeps what it compiles of this package.
        processes: how many, at most.
    """
    if os.environ.get(SWITCH) == "0" or numba.config.DISABLE_JIT:  # type: ignore[attr-defined]
        return
    cpu = f"{llvmlite.binding.get_host_cpu_name()} {llvmlite.binding.get_host_cpu_features().flatten()}"
    machine = hashlib.sha256(f"{platform.python_version()} {numba.__version__} {cpu}".encode()).hexdigest()[:12]
    note, state = cache / f"{NOTE}-{machine}", _describe_sources()
    try:
        if _read(note) == state:
            return
        cache.mkdir(parents=True, exist_ok=True)
        with _lock(cache / f"{NOTE}.lock"):
            if _read(note) == state:
                return
            _log.warning("compiling the inner loops, once on this machine: about 25 s of a core")
            if _run_workers(processes):
                note.write_text(state, encoding="ascii")
    except OSError:
        return  # they are compiled when they are called


def _describe_sources() -> str:
    """Describe the sources as numba checks them: a change of a file's date or size compiles it again."""
    files = [Path(__file__).with_name(f"{name}.py").stat() for name in MODULES]
    return " ".join(f"{file.st_mtime_ns}:{file.st_size}" for file in files)


def _read(path: Path) -> str:
    return path.read_text(encoding="ascii") if path.is_file() else ""


def _run_workers(count: int) -> bool:
    """Compile in so many processes; return whether all succeeded."""
    # Else each worker, which imports this package, would start workers of its own.
    environment = {**os.environ, SWITCH: "0"}
    environment["PYTHONPATH"] = os.pathsep.join(path for path in sys.path if path)
    with tempfile.TemporaryDirectory(prefix="topomerge-") as folder:
        arguments = [sys.executable, "-c", "import sys; from topomerge.kernels.ahead import work; work(sys.argv[1])", folder]
        workers = [subprocess.Popen(arguments, env=environment, stderr=subprocess.DEVNULL) for _ in range(max(count, 1))]
        try:
            statuses = [worker.wait() for worker in workers]
            return not any(statuses)
        except BaseException:
            for worker in workers:
                worker.kill()
                worker.wait()
            raise


def work(folder: str) -> None:
    """Compile what no other process does, the longest first.

    Args:
        folder: in which the processes tell each other what they do.
    """
    gc.disable()  # it would be busy with what the compiler keeps
    loops = load_loops()
    for loop in sorted(loops, key=lambda loop: -len(loop.py_func.__code__.co_code)):
        try:
            Path(folder, f"{loop.py_func.__module__}.{loop.__name__}.taken").touch(exist_ok=False)
        except FileExistsError:
            continue
        _compile(loop, loops, Path(folder))


def load_loops() -> dict[Any, tuple[str, ...]]:
    """Return the loops that are compiled ahead, with the types of their arguments."""
    for name in MODULES:
        import_module(f"topomerge.kernels.{name}")
    return AHEAD


def _compile(loop: Any, loops: dict[Any, tuple[str, ...]], folder: Path) -> None:
    """Compile a loop and those that it calls, unless numba keeps them already."""
    from numba.core.sigutils import normalize_signature

    called = [loop.py_func.__globals__.get(name) for name in loop.py_func.__code__.co_names]
    for other in called:
        if any(other is known for known in loops):
            _compile(other, loops, folder)
    with _lock(folder / f"{loop.py_func.__module__}.{loop.__name__}"):
        for signature in loops[loop]:
            loop.compile(normalize_signature(f"({signature},)")[0])


@contextmanager
def _lock(path: Path) -> Iterator[None]:
    """Wait until no other process is in here."""
    try:
        import fcntl
    except ImportError:  # Windows: two processes may do the same
        yield
        return
    with open(path, "w", encoding="ascii") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield
