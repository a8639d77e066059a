"""How long until the program answers: `python -m benchmarks.speed.start` prints the best of five runs of each, s.

`python -c pass` is what Python itself takes; two lines `name ours peer ratio` (`bench.print_line`) compare with it.
"""

from __future__ import annotations

import subprocess
import sys

from benchmarks.speed.bench import print_line, time_best
from topomerge.cli.main import COMMANDS


def main(repeat: int = 5, commands: int | None = None) -> None:
    """Print a table of the least disturbed of `repeat` runs; of the first `commands` commands, or of all."""

    def run(*words: str) -> float:
        return time_best(lambda: subprocess.run([sys.executable, *words], stdout=subprocess.DEVNULL, check=True), repeat)

    bare, imported, told = run("-c", "pass"), run("-c", "import topomerge"), run("-m", "topomerge", "--help")
    print_line("start_import", imported, bare)
    print_line("start_help", told, bare)
    print("| command | s |\n|---|---|")
    print(f"| `python -c pass` | {bare:.3f} |")
    print(f"| `python -c 'import topomerge'` | {imported:.3f} |")
    print(f"| `topomerge --help` | {told:.3f} |", flush=True)
    for command in COMMANDS[:commands]:
        print(f"| `topomerge {command.name} --help` | {run('-m', 'topomerge', command.name, '--help'):.3f} |", flush=True)


if __name__ == "__main__":
    main()
