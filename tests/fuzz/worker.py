"""A process that reads files within limits, driven by lines of JSON on stdin; it answers each with one.

["plan.yaml", 7] is mutant 7 of that file of the corpus, ["/a/b.ply"] a file as it is.

It may die: of a fault in a native library, or by the hand of the driver, which waits only so long.
"""

from __future__ import annotations

import json
import logging
import os
import resource
import sys
import time
import warnings
from pathlib import Path

from tests.fuzz.corpus import beside, reader
from tests.fuzz.mutate import mutant
from topomerge.errors import InputError

READER_MEMORY = 1 << 30  # bytes that reading a small file may take beyond what the libraries hold


def _size() -> int:
    """Bytes of address space of this process."""
    return int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")


class Records(logging.Handler):
    """The lines that libraries log: none may reach a terminal before the one that explains."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        """Keep what is not of this package."""
        if not record.name.startswith("topomerge"):
            self.lines.append(f"{record.name}: {record.getMessage()}")


def attempt(path: Path) -> tuple[str, str]:
    """(read | refused | fault, message) of reading a file; a fault, too, where a warning or a library's log line gets out."""
    records = Records()
    logging.getLogger().addHandler(records)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        answer = _read(path)
    logging.getLogger().removeHandler(records)
    said = [f"{w.category.__name__} at {Path(w.filename).name}:{w.lineno}: {w.message}" for w in caught] + records.lines
    return ("fault", f"{said[0]} ({answer[0]})"[:500]) if said and answer[0] != "fault" else answer


def _read(path: Path) -> tuple[str, str]:
    """(read | refused | fault, message) of reading a file."""
    try:
        return "read", str(reader(path)(path))
    except InputError as error:
        message = str(error)
    except BaseException as error:
        return "fault", f"{type(error).__name__}: {error}"[:500]
    if "does not fit into memory" in message:
        return "fault", message
    if "\n" in message or str(path.parent) not in message or len(message) > 1000:
        return "fault", f"a poor message: {message[:300]!r}"
    return "refused", message


def main(corpus: Path, folder: Path) -> None:
    """Warm up on the valid files, limit the memory, then do what is asked for."""
    told = json.loads((folder / "names.json").read_text())
    data = {name: Path(path).read_bytes() for name, path in told["files"].items()}
    for name in told["tried"]:
        state = attempt(Path(told["files"][name]))
        assert state[0] == "read", (name, state)
    limit = _size() + READER_MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    print(json.dumps(["ready"]), flush=True)
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what libraries print is no answer
    for line in sys.stdin:
        name, *seed = json.loads(line)
        path = folder / name
        if seed:
            beside(name, corpus, folder)
            path.write_bytes(mutant(name, data, seed[0]))
        before = time.process_time()
        state, message = attempt(path)
        print(json.dumps([state, message, time.process_time() - before]), file=answers, flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
