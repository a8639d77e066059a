"""Calls of peers in processes of their own, with caps of seconds and memory: one that takes too long, or dies, is a miss.

A process for each kind of call also keeps KISS-Matcher's Quatro from using the noise bound of another voxel (`peer_methods`).
"""

from __future__ import annotations

import multiprocessing
import resource
import signal
import time
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from typing import Any

CALL_SECONDS = 60.0  # of processor, for each answer of a call
CALL_BYTES = 12 * 2**30  # of address space
WALL_FACTOR = 10  # of the seconds of processor: nothing waits forever for a process that hangs
TOO_LONG, CALL_FAILED = "over the cap", "failed"
Work = Callable[..., Iterator[tuple[str, Any]]]


class GuardedWork:
    """A generator of (name, answer) that is called in a process of its own, which is started anew when it was ended.

    Args:
        work: a function of a module; its arguments and answers are sent from process to process.
        seconds: of processor that each answer may take, rounded up.
    """

    def __init__(self, work: Work, seconds: float = CALL_SECONDS) -> None:
        self.work, self.seconds = work, seconds
        self.process: Any = None
        self.pipe: Any = None

    def __call__(self, *args: Any) -> tuple[dict[str, Any], str, float]:
        """The answers; why there are no more (empty, `TOO_LONG` or `CALL_FAILED`); the seconds of processor that it took."""
        if self.process is None:
            context = multiprocessing.get_context("spawn")
            self.pipe, theirs = context.Pipe()
            self.process = context.Process(target=_answer_calls, args=(theirs, self.work, self.seconds), daemon=True)
            self.process.start()
            theirs.close()
        self.pipe.send(args)
        answers: dict[str, Any] = {}
        used, why = 0.0, TOO_LONG
        try:
            while self.pipe.poll(WALL_FACTOR * self.seconds):
                name, answer, used = self.pipe.recv()
                if name is None:
                    return answers, "" if answer is None else CALL_FAILED, used
                answers[name] = answer
        except (EOFError, ConnectionError):  # the process was ended
            self.process.join()
            why = TOO_LONG if self.process.exitcode == -signal.SIGXCPU else CALL_FAILED
        self.close()
        return answers, why, used + self.seconds * (why == TOO_LONG)

    def close(self) -> None:
        """End the process."""
        if self.process is not None:
            self.process.kill()
            self.process.join()
            self.pipe.close()
            self.process = None


def _answer_calls(pipe: Connection, work: Work, seconds: float) -> None:
    """In the process: the answers of each call, each under its cap; then why there are no more, None if that was all."""
    resource.setrlimit(resource.RLIMIT_AS, (CALL_BYTES, CALL_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    while True:
        args = pipe.recv()
        begun = time.process_time()
        try:
            _cap(seconds)
            for name, answer in work(*args):
                pipe.send((name, answer, time.process_time() - begun))
                _cap(seconds)
            pipe.send((None, None, time.process_time() - begun))
        except Exception as failure:  # a peer that fails has not merged
            pipe.send((None, repr(failure), time.process_time() - begun))


def _cap(seconds: float) -> None:
    """From now on so many seconds of processor, rounded up, before the system ends the process."""
    hard = resource.getrlimit(resource.RLIMIT_CPU)[1]
    resource.setrlimit(resource.RLIMIT_CPU, (int(time.process_time() + seconds) + 1, hard))
