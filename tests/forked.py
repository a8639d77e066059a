"""Readers of files of strangers in a fork of the tests' process: as apart from it as in the product, and started sooner."""

from __future__ import annotations

import faulthandler
import gc
import os
import signal
import sys
from typing import NoReturn

from topomerge.io import piece

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
