"""Forks of the tests' process: as apart from it as processes of their own, without seconds of imports.

Readers of files of strangers are such forks, and commands and scripts whose own start is tried elsewhere.
"""

from __future__ import annotations

import atexit
import faulthandler
import functools
import gc
import importlib
import logging
import os
import runpy
import signal
import socket
import subprocess
import sys
import tempfile
import traceback
import warnings
from collections.abc import Callable, Iterable
from importlib.util import find_spec
from pathlib import Path
from typing import IO, NoReturn

from tests.exporting import build_registry
from topomerge.io import piece

ROOT = Path(__file__).parent.parent
start_fresh_child = piece.start_child  # as in the product


class ForkedChild:
    """What `topomerge.io.piece.start_child` returns, as far as `read_in_subprocess` uses it."""

    def __init__(self, task: str) -> None:
        receiving, sending = os.pipe()
        self.ended: int | None = None
        self.pid = os.fork()
        if self.pid == 0:
            os.close(receiving)
            _read(task, sending)
        os.close(sending)
        self.stdout = os.fdopen(receiving, "rb")

    def wait(self) -> int:
        if self.ended is None:
            self.ended = os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])
        return self.ended

    def kill(self) -> None:
        if self.ended is None:
            os.kill(self.pid, signal.SIGKILL)

    def communicate(self) -> None:
        self.stdout.close()
        self.wait()


def _read(task: str, sending: int) -> NoReturn:
    """Read, send, and never return to the tests."""
    try:
        gc.disable()  # it would write to, and so copy, every page of the tests
        faulthandler.disable()
        nowhere = os.open(os.devnull, os.O_RDWR)
        for given, standard in ((nowhere, 0), (sending, 1), (nowhere, 2)):
            os.dup2(given, standard)
        sys.argv = ["-c", task]
        piece.main()
    finally:
        os._exit(0)


def run_words(words: Iterable[str | Path], folder: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run `python SCRIPT …`, `python -m MODULE …` or `topomerge …`, without the word `python`, in a fork that begins in a folder.

    Args:
        words: a script's path, `-m` and a module, or `topomerge`; and what follows it.
        folder: the current folder of the fork.
        environment: variables of the fork beside those of the tests.
    """
    return start_words(words, folder, **environment)()


def start_words(words: Iterable[str | Path], folder: Path, **environment: str) -> Callable[[], subprocess.CompletedProcess[str]]:
    """Start what `run_words` runs; what is returned waits for it."""
    first, *rest = map(str, words)
    if first in ("topomerge", "-m"):
        name, rest = (first, rest) if first == "topomerge" else (rest[0], rest[1:])
        here = importlib.import_module(name)
        if hasattr(here, "__path__"):
            importlib.import_module(f"{name}.__main__")
        run = functools.partial(_run_module, name, rest)
    else:
        script = str((folder / first).resolve())
        _import_what_it_needs(Path(script).name)
        run = functools.partial(_run_script, script, rest)
    files: tuple[IO[str], IO[str]] = tempfile.TemporaryFile("w+"), tempfile.TemporaryFile("w+")  # noqa: SIM115 (read by `wait`)
    pid = os.fork()
    if pid == 0:
        _run(run, folder, environment, files[0].fileno(), files[1].fileno())

    def wait() -> subprocess.CompletedProcess[str]:
        status, told = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), []
        for file in files:
            file.seek(0)
            told.append(file.read())
            file.close()
        return subprocess.CompletedProcess([first, *rest], status, *told)

    return wait


def run_two(words: Iterable[str | Path], folder: Path) -> list[subprocess.CompletedProcess[str]]:
    """Run what `torchrun --nproc-per-node 2` runs, in two forks."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    common = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "TORCHELASTIC_RUN_ID": "two", "GROUP_RANK": "0"}
    common |= {"WORLD_SIZE": "2", "LOCAL_WORLD_SIZE": "2"}
    words = list(words)
    return [wait() for wait in [start_words(words, folder, **common, RANK=k, LOCAL_RANK=k) for k in "01"]]


@functools.cache
def _import_what_it_needs(script: str) -> None:
    """Import in this process what a script of the repository imports at its top, and an export needs: each fork finds it."""
    if (ROOT / script).is_file():
        runpy.run_path(str(ROOT / script), run_name="imported")
    if script == "train.py" and find_spec("onnxscript"):
        build_registry()


def _run_script(script: str, words: list[str]) -> None:
    sys.path.insert(0, str(Path(script).parent))
    sys.argv, sys.orig_argv = [script, *words], [sys.executable, script, *words]
    runpy.run_path(script, run_name="__main__")


def _run_module(module: str, words: list[str]) -> None:
    sys.path.insert(0, os.getcwd())
    sys.argv, sys.orig_argv = [module, *words], [sys.executable, "-m", module, *words]
    runpy.run_module(module, run_name="__main__", alter_sys=True)


def _run(run: Callable[[], None], folder: Path, environment: dict[str, str], out: int, err: int) -> NoReturn:
    """Run it as a process of its own would, and never return to the tests."""
    status = 1
    try:
        signal.alarm(300)  # which ends it
        gc.freeze()  # else it would write to, and so copy, every page of the tests
        atexit._clear()  # what the tests do at their end
        faulthandler.disable()
        for given, standard in ((os.open(os.devnull, os.O_RDONLY), 0), (out, 1), (err, 2)):
            os.dup2(given, standard)
        sys.stdin, sys.stdout, sys.stderr = open(0), open(1, "w"), open(2, "w", buffering=1)  # noqa: SIM115
        logging.root.handlers.clear()
        warnings.resetwarnings()
        warnings.simplefilter("ignore", DeprecationWarning)
        warnings.filterwarnings("ignore", module="runpy")  # the module is imported already: that is what a fork is for
        warnings.simplefilter("error", UserWarning)
        os.environ.update(environment)
        os.chdir(folder)
        try:
            run()
            status = 0
        except SystemExit as end:
            status = end.code if isinstance(end.code, int) else int(end.code is not None)
            if isinstance(end.code, str):
                print(end.code, file=sys.stderr)
        except BaseException:
            traceback.print_exc()
        atexit._run_exitfuncs()
        sys.stdout.flush()
        sys.stderr.flush()
    finally:
        os._exit(status)
