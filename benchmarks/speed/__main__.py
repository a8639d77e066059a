"""All benchmarks of speed, one after the other: ``python -m benchmarks.speed [--small] [NAME ...]`` (``make bench``).

``--small`` runs each on so little that it takes seconds: whether they still run is all that tells. ``--compare`` runs the small
forms of `COMPARED` and prints each ratio beside the recorded one, as CI does: it fails on none, machines are noisy. ``--record``
records today's.
"""

from __future__ import annotations

import contextlib
import io
import json
import platform
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

SMALL: dict[str, dict[str, Any]] = {
    "start": {"repeat": 1, "commands": 1},
    "first_merge": {},
    "whole": {"pairs": 1, "repeat": 1},
    "voxelise": {"points": 200_000},
    "visibility": {"points": 200_000, "views": 5},
    "octree_queries": {"queries": 50, "radii": (0.2,)},
    "extract_floor": {"points": 300_000, "most": 2, "repeat": 1},
    "merge_growth": {"rooms": [10]},
    "merge_floor": {"points": 600_000},
    "growth": {"rooms": [4, 8]},
    "room_search": {"rooms": [2000]},
    "networks": {"sides": (64,), "strip": 40, "squares": 2},
    "build_pairs": {"pairs": 2, "rooms": 4},
    "training": {"batches": (2,), "steps": 1, "examples": 2},
    "researcher": {"most": 1},
    "studio": {"rooms": [10]},
    "readers": {"most": 0, "repeat": 1},
    "bags": {"gigabytes": [0.02], "spacing": 0.1},
}
WHOLE_WAY = ("start", "first_merge", "whole", "extract_floor", "growth")
COMPARED: dict[str, dict[str, Any]] = {name: SMALL[name] for name in ("voxelise", "networks", "room_search", *WHOLE_WAY)}
RECORDED = Path(__file__).with_name("recorded.json")  # ratios of the small forms


def measure_ratios() -> dict[str, float]:
    """Measure the ratios of the small forms of `COMPARED`: how many times slower the peer was. What can't be run is left out."""
    ratios: dict[str, float] = {}
    for name, settings in COMPARED.items():
        printed = io.StringIO()
        try:
            with contextlib.redirect_stdout(printed):
                import_module(f"benchmarks.speed.{name}").main(**settings)
        except (Exception, SystemExit) as error:
            print(f"# {name}: {error}", flush=True)
        for line in printed.getvalue().splitlines():
            if not line.startswith(("#", "|")):
                word, *_, ratio = line.split()
                ratios[word] = float(ratio)
    return ratios


def compare_with_recorded(ratios: dict[str, float], recorded: dict[str, float]) -> list[str]:
    """Return a line for each ratio that was measured or recorded: today's, the recorded one, and the first by the second."""
    lines = [f"{'ratio to the peer':28}{'today':>8}{'recorded':>10}{'today by recorded':>19}"]
    for name in sorted({*ratios, *recorded}):
        now, then = ratios.get(name), recorded.get(name)
        share = f"{now / then:.2f}" if now and then else "-"
        lines.append(f"{name:28}{now or '-':>8}{then or '-':>10}{share:>19}")
    return lines


def main(words: list[str]) -> None:
    """Run the benchmarks that are named, or all; or compare with what is recorded.

    Raises:
        SystemExit: a name that there is none of.
    """
    if words[:1] in (["--compare"], ["--record"]):
        ratios = measure_ratios()
        recorded = json.loads(RECORDED.read_text(encoding="utf-8")) if RECORDED.is_file() else {"ratios": {}}
        print(*compare_with_recorded(ratios, recorded["ratios"]), sep="\n", flush=True)
        if words == ["--record"]:
            known = {"machine": platform.processor() or platform.machine(), "ratios": ratios}
            RECORDED.write_text(json.dumps(known, indent=1) + "\n", encoding="utf-8")
        return
    small = "--small" in words
    names = [word for word in words if word != "--small"] or list(SMALL)
    for name in names:
        if name not in SMALL:
            raise SystemExit(f"benchmark {name!r}: {', '.join(SMALL)} are possible")
        print(f"# {name}", flush=True)
        import_module(f"benchmarks.speed.{name}").main(**SMALL[name] if small else {})


if __name__ == "__main__":
    main(sys.argv[1:])
