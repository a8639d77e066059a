"""How long until the program answers: `python -m benchmarks.speed.start` prints the best of five runs of each, s.

`python -c pass` is what Python itself takes.
"""

from __future__ import annotations

import subprocess
import sys

from benchmarks.speed.bench import best
from topomerge.cli.commands import COMMANDS


def run(*words: str) -> float:
    """Seconds of a process, the least disturbed of five."""
    return best(lambda: subprocess.run([sys.executable, *words], stdout=subprocess.DEVNULL, check=True))


def main() -> None:
    """Print a table."""
    print("| command | s |\n|---|---|")
    print(f"| `python -c pass` | {run('-c', 'pass'):.3f} |")
    print(f"| `python -c 'import topomerge'` | {run('-c', 'import topomerge'):.3f} |")
    print(f"| `topomerge --help` | {run('-m', 'topomerge', '--help'):.3f} |", flush=True)
    for command in COMMANDS:
        print(f"| `topomerge {command.name} --help` | {run('-m', 'topomerge', command.name, '--help'):.3f} |", flush=True)


if __name__ == "__main__":
    main()
