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
from collections.abc import Iterator
from pathlib import Path

from tests.fuzz.corpus import write_corpus

ROOT = Path(__file__).parent.parent.parent
PATIENCE = 20.0  # s for one input
SLOW = 8.0  # s that are a fault


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

    def ask(self, name: str, seed: int) -> tuple[str, str]:
        """(read | refused | fault, message)."""
        assert self.process.stdin is not None
        self.process.stdin.write(f"{name} {seed}\n")
        self.process.stdin.flush()
        answer = self._answer(PATIENCE)
        if answer is None:
            died = self.process.poll() if self.process.poll() is not None else self._ended()
            self.stop()
            self.start()
            return "fault", f"the process died with {died}" if died is not None else f"took more than {PATIENCE:g} s"
        _, _, state, message, seconds = answer
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


def run(folder: Path, seeds: range, only: list[str] | None = None) -> Iterator[tuple[str, int, str, str]]:
    """(name, seed, state, message) of a mutant of every file, or of those named, for every seed."""
    corpus, place = folder / "corpus", folder / "mutants"
    corpus.mkdir(parents=True)
    place.mkdir()
    files = {name: str(path) for name, path in write_corpus(corpus).items()}
    (corpus / "names.json").write_text(json.dumps({"files": files, "tried": only or list(files)}))
    worker = Worker(corpus, place)
    try:
        for name in only or files:
            for seed in seeds:
                yield (name, seed, *worker.ask(name, seed))
    finally:
        worker.stop()


def main() -> None:
    """Count what happens to many mutants and show what went wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--each", type=int, default=100)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--only", action="append")
    args = parser.parse_args()
    seeds = range(args.first, args.first + args.each)
    counts: Counter[tuple[str, str]] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        for name, seed, state, message in run(Path(folder), seeds, args.only):
            counts[name, state] += 1
            if state == "fault":
                print(f"{name} {seed}: {message}", flush=True)
    for name in sorted({n for n, _ in counts}):
        print(name, {state: counts[name, state] for state in ("read", "refused", "fault")})
    print("all", {state: sum(c for (_, s), c in counts.items() if s == state) for state in ("read", "refused", "fault")})


if __name__ == "__main__":
    main()
