"""Run many mutants and count: `python -m tests.fuzz.drive --each 500 [--only NAME] [--first SEED]`.

Each format has a worker of its own that is started again when a mutant ends it.
"""

from __future__ import annotations

import argparse
import json
import selectors
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path

from tests.fuzz.corpus import write_corpus, write_plain

ROOT = Path(__file__).parent.parent.parent
PATIENCE = 60.0  # s for one input, by the clock: others may want the processor, too
SLOW = 6.0  # s of the processor that are a fault


class Worker:
    """The process that reads."""

    def __init__(self, corpus: Path, folder: Path) -> None:
        self.words = [sys.executable, "-m", "tests.fuzz.worker", str(corpus), str(folder)]
        self.log = (folder / "log.txt").open("wb")
        self.start()

    def start(self) -> None:
        self.process = subprocess.Popen(
            self.words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self.log, text=True, cwd=ROOT
        )
        if self._answer(300.0) != ["ready"]:
            raise RuntimeError(f"the worker does not start: {(Path(self.log.name)).read_text()[-2000:]}")

    def _answer(self, patience: float) -> list | None:
        """What it says; None where it died or is too slow."""
        assert self.process.stdout is not None
        with selectors.DefaultSelector() as waiting:
            waiting.register(self.process.stdout, selectors.EVENT_READ)
            if not waiting.select(patience):
                return None
        line = self.process.stdout.readline()
        return json.loads(line) if line else None

    def ask(self, *case: str | int) -> tuple[str, str]:
        """(read | refused | fault, message) of a mutant (name, seed) or of a file (path)."""
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(case) + "\n")
        self.process.stdin.flush()
        answer = self._answer(PATIENCE)
        if answer is None:
            died = self.process.poll() if self.process.poll() is not None else self._ended()
            self.stop()
            self.start()
            return "fault", f"the process died with {died}" if died is not None else f"took more than {PATIENCE:g} s"
        state, message, seconds = answer
        return ("fault", f"took {seconds:.1f} s ({state}: {message})") if seconds > SLOW else (state, message)

    def _ended(self) -> int | None:
        try:
            return self.process.wait(0.5)
        except subprocess.TimeoutExpired:
            return None

    def stop(self) -> None:
        """End the process."""
        self.process.kill()
        self.process.communicate()


@cache
def valid_files(write: Callable[[Path], dict[str, Path]]) -> tuple[tempfile.TemporaryDirectory[str], dict[str, str]]:
    """The corpus, or a part of it, in a folder that this process keeps, and its files by name."""
    folder = tempfile.TemporaryDirectory()
    return folder, {name: str(path) for name, path in write(Path(folder.name)).items()}


@contextmanager
def started(folder: Path, only: Sequence[str] = ()) -> Iterator[tuple[Worker, list[str]]]:
    """A worker that has read the valid files, or those named; and their names."""
    corpus, files = valid_files(write_plain if only else write_corpus)
    if not set(only) <= set(files):
        corpus, files = valid_files(write_corpus)
    folder.mkdir(parents=True)
    names = list(only or files)
    (folder / "names.json").write_text(json.dumps({"files": files, "tried": names}))
    worker = Worker(Path(corpus.name), folder)
    try:
        yield worker, names
    finally:
        worker.stop()


def run(folder: Path, seeds: range, only: Sequence[str] = ()) -> Iterator[tuple[str, int, str, str]]:
    """(name, seed, state, message) of a mutant of every file, or of those named, for every seed."""
    with started(folder, only) as (worker, names):
        for name in names:
            for seed in seeds[:: 1 if name in only or not name.endswith(".ifc") else 4]:  # each model takes a process
                yield (name, seed, *worker.ask(name, seed))


def main() -> None:
    """Count what happens to many mutants and show what went wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--each", type=int, default=100)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--only", action="append", default=[])
    args = parser.parse_args()
    seeds = range(args.first, args.first + args.each)
    counts: Counter[tuple[str, str]] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        for name, seed, state, message in run(Path(folder) / "mutants", seeds, args.only):
            counts[name, state] += 1
            if state == "fault":
                print(f"{name} {seed}: {message}", flush=True)
    for name in sorted({n for n, _ in counts}):
        print(name, {state: counts[name, state] for state in ("read", "refused", "fault")})
    print("all", {state: sum(c for (_, s), c in counts.items() if s == state) for state in ("read", "refused", "fault")})


if __name__ == "__main__":
    main()
