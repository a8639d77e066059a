"""Work that takes long: commands of topomerge in processes of their own, one after the other, with progress, to be cancelled."""

from __future__ import annotations

import asyncio
import itertools
import json
import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from topomerge.progress import PROGRESS_MARK, PROGRESS_VARIABLE

GRACE = 3.0  # s that a process has to end by itself
MOST_WAITING, MOST_KEPT = 200, 50  # jobs
MOST_LINES, LONGEST_LINE = 50, 1000  # that a job said, and characters of one
ENDED = ("done", "failed", "cancelled")


class JobError(ValueError):
    """There are too many jobs."""


@dataclass
class Job:
    """One command.

    Args:
        id: number.
        kind: "extract", "merge" or "compare".
        title: what the page shows.
        words: of the command line after `topomerge`.
        result: the path that it writes, as the page knows it.
        accepted: exit statuses that are no failure.
        state: "waiting", "running", "done", "failed" or "cancelled".
        steps: title of a task -> [share done, what is being done].
        lines: what it said: warnings and the error.
    """

    id: int
    kind: str
    title: str
    words: tuple[str, ...]
    result: str
    accepted: tuple[int, ...] = (0,)
    state: str = "waiting"
    steps: dict[str, list[Any]] = field(default_factory=dict)
    lines: list[str] = field(default_factory=list)
    began: float = 0.0
    ended: float = 0.0
    status: int | None = None
    process: asyncio.subprocess.Process | None = field(default=None, repr=False)

    def describe(self) -> dict[str, Any]:
        """Describe it to the page."""
        seconds = round((self.ended or time.time()) - self.began, 1) if self.began else 0.0
        names = ("id", "kind", "title", "result", "state", "steps", "lines", "status")
        return {**{name: getattr(self, name) for name in names}, "seconds": seconds}


class JobQueue:
    """Jobs in the order in which they were asked for; one at a time, as each uses all cores.

    Args:
        folder: in which the commands run.
        tell: is called with a job whenever something changes.
    """

    def __init__(self, folder: Path, tell: Callable[[Job], None]) -> None:
        self.folder, self.tell = folder, tell
        self.jobs: dict[int, Job] = {}
        self._numbers = itertools.count(1)
        self._worker: asyncio.Task[None] | None = None

    def add(self, kind: str, title: str, words: Sequence[str], result: str, accepted: tuple[int, ...] = (0,)) -> Job:
        """Add a job, which begins when those before it have ended.

        Raises:
            JobError: too many are waiting.
        """
        if sum(job.state == "waiting" for job in self.jobs.values()) >= MOST_WAITING:
            raise JobError(f"{MOST_WAITING} jobs are waiting; wait until some have ended")
        job = Job(next(self._numbers), kind, title, tuple(words), result, accepted)
        self.jobs[job.id] = job
        for old in [j.id for j in self.jobs.values() if j.state in ENDED][:-MOST_KEPT]:
            del self.jobs[old]
        self.tell(job)
        if self._worker is None or self._worker.done():
            self._worker = asyncio.create_task(self._work())
        return job

    async def cancel(self, number: int) -> bool:
        """End a job that waits or runs; False where there is none."""
        job = self.jobs.get(number)
        if job is None or job.state in ENDED:
            return False
        job.state, job.ended = "cancelled", time.time()
        self.tell(job)
        if job.process is not None:
            await _end(job.process)
        return True

    async def close(self) -> None:
        """End all jobs."""
        for number in list(self.jobs):
            await self.cancel(number)
        if self._worker is not None:
            self._worker.cancel()
            with suppress(asyncio.CancelledError):
                await self._worker

    async def _work(self) -> None:
        while (job := next((j for j in self.jobs.values() if j.state == "waiting"), None)) is not None:
            job.state, job.began = "running", time.time()
            self.tell(job)
            try:
                await self._run(job)
            except OSError as error:
                job.state, job.lines = "failed", [*job.lines, f"can't be started ({error.strerror or error})"]
            job.ended = job.ended or time.time()
            self.tell(job)

    async def _run(self, job: Job) -> None:
        environment = {**os.environ, PROGRESS_VARIABLE: "lines", "PYTHONUNBUFFERED": "1"}
        command = [sys.executable, "-m", "topomerge", *job.words]
        pipe, null = asyncio.subprocess.PIPE, asyncio.subprocess.DEVNULL
        job.process = await asyncio.create_subprocess_exec(
            *command, cwd=self.folder, env=environment, stdin=null, stdout=null, stderr=pipe, start_new_session=True
        )
        assert job.process.stderr is not None
        try:
            while line := await _read_line(job.process.stderr):
                if self._note(job, line.decode("utf-8", "replace").rstrip()):
                    self.tell(job)
            job.status = await job.process.wait()
        finally:
            await _end(job.process)
        if job.state == "running":
            job.state = "done" if job.status in job.accepted else "failed"

    @staticmethod
    def _note(job: Job, line: str) -> bool:
        """Keep what a job says; was it anything?"""
        if line.startswith(PROGRESS_MARK):
            with suppress(ValueError, TypeError, KeyError):
                message = json.loads(line.removeprefix(PROGRESS_MARK))
                job.steps[str(message["task"])[:80]] = [float(message["share"]), str(message["text"])[:200]]
                return True
        elif line:
            job.lines = [*job.lines, line[:LONGEST_LINE].removeprefix("topomerge: ")][-MOST_LINES:]
            return True
        return False


async def _read_line(stream: asyncio.StreamReader) -> bytes:
    """The next line, or part of one that is longer than any should be; nothing at the end."""
    try:
        return await stream.readuntil()
    except asyncio.IncompleteReadError as rest:
        return rest.partial
    except asyncio.LimitOverrunError as long:
        return await stream.read(long.consumed)


async def _end(process: asyncio.subprocess.Process) -> None:
    """End a process and those that it started: kindly, then not."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        if process.returncode is not None:
            return
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, number)
        with suppress(TimeoutError):
            await asyncio.wait_for(process.wait(), GRACE)
