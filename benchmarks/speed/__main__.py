"""All benchmarks of speed, one after the other: ``python -m benchmarks.speed [--small] [NAME ...]`` (``make bench``).

``--small`` runs each on so little that it takes seconds: whether they still run is all that tells.
"""

from __future__ import annotations

import sys
from importlib import import_module
from typing import Any

SMALL: dict[str, dict[str, Any]] = {
    "start": {"repeat": 1, "commands": 1},
    "first_merge": {},
    "whole": {"pairs": 1, "repeat": 1},
    "voxelise": {"points": 200_000},
    "visibility": {"points": 200_000, "views": 5},
    "octree_queries": {"queries": 50, "radii": (0.2,)},
    "extract_floor": {"points": 300_000, "most": 2},
    "merge_growth": {"rooms": [10]},
    "growth": {"rooms": [5]},
    "room_search": {"rooms": [2000]},
    "networks": {"sides": (64,), "strip": 40, "squares": 2},
    "build_pairs": {"pairs": 2, "rooms": 4},
    "training": {"batches": (2,), "steps": 1},
    "studio": {"rooms": [10]},
    "bags": {"gigabytes": [0.02], "spacing": 0.1},
}


def main(words: list[str]) -> None:
    """Run the benchmarks that are named, or all.

    Raises:
        SystemExit: a name that there is none of.
    """
    small = "--small" in words
    names = [word for word in words if word != "--small"] or list(SMALL)
    for name in names:
        if name not in SMALL:
            raise SystemExit(f"benchmark {name!r}: {', '.join(SMALL)} are possible")
        print(f"# {name}", flush=True)
        import_module(f"benchmarks.speed.{name}").main(**SMALL[name] if small else {})


if __name__ == "__main__":
    main(sys.argv[1:])
