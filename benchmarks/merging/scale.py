"""Atlases of 10, 100 and 1,000 maps: what comes out rightly, and what it takes.

``python -m benchmarks.merging.scale 10`` (or 100, 1000) puts the first maps that `benchmarks/merging/scale_maps.py` made into an
atlas in ``cache/scale/atlas_10``, in a process of its own, and prints a Markdown row; what was measured is in
``cache/scale/results.jsonl``. It may be stopped at any moment: the registrations that were made stand in the atlas, their seconds
beside it, and the same command goes on with them; the seconds of laying maps coarsely are those of the last run.

``--drawn`` makes no registrations: pairs of one building lie where the truth says, strangers anywhere, each with the
probabilities that the registrations of the atlas of 100 gave such pairs. ``--at-once`` assembles all maps at once, not by sets.
A map is placed rightly within 0.5 m and 5 degrees of where it lies in the first map of its component; a link by its own pose.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.merging.atlas import RIGHT
from benchmarks.merging.scale_maps import SCALE_CACHE, ScaleMap, scale_maps
from topomerge.fusion.atlas import partners, store
from topomerge.fusion.atlas import solve as solver
from topomerge.fusion.atlas.maps import Maps
from topomerge.fusion.atlas.result import AtlasResult
from topomerge.fusion.pose_graph import Assembler
from topomerge.io.maps import load_map
from topomerge.matching.poses import PoseHypothesis, pose_difference
from topomerge.types import Sim3, TopometricMap
from topomerge.viz.atlas_report import atlas_html

RESULTS = SCALE_CACHE / "results.jsonl"
DRAWN_FROM = 100  # maps of the atlas whose registrations the drawn ones are like
SCALE_COLUMNS = (
    *("maps", "buildings", "registrations", "pairs a map", "right links", "wrong links", "placed right", "of", "wrong", "alone"),
    *(
        "s laying",
        "s registering",
        "s assembling",
        "s settling",
        "s writing",
        "s of a core in all",
        "peak MiB",
        "report MB",
        "largest page MB",
    ),
)


class Spent:
    """Seconds of a core in functions, by what they are for."""

    def __init__(self) -> None:
        self.seconds: Counter[str] = Counter()

    def watch(self, owner: Any, name: str, label: str) -> None:
        """Count the time that a function takes from now on."""
        usual: Callable[..., Any] = getattr(owner, name)

        def counted(*args: Any, **words: Any) -> Any:
            began = time.process_time()
            try:
                return usual(*args, **words)
            finally:
                self.seconds[label] += time.process_time() - began

        setattr(owner, name, counted)


def chosen(count: int) -> list[ScaleMap]:
    """The first maps that were made."""
    return list(islice(scale_maps(sum(1 for _ in SCALE_CACHE.glob("b*.json"))), count))


def named_maps(maps: list[ScaleMap]) -> Iterator[tuple[str, TopometricMap]]:
    """One after the other, so that only one is in memory."""
    for m in maps:
        yield m.file.stem, load_map(m.file)


def noting(folder: Path) -> None:
    """Note the seconds of each registration beside the atlas."""
    usual = solver.hypotheses

    def noted(*args: Any) -> tuple[PoseHypothesis, ...]:
        began = time.process_time()
        out = usual(*args)
        with folder.with_suffix(".seconds").open("a") as file:
            file.write(f"{time.process_time() - began:.3f}\n")
        return out

    solver.hypotheses = noted


def probabilities(folder: Path, maps: list[ScaleMap]) -> tuple[list[float], list[float]]:
    """Of the best hypotheses of an atlas: of pairs of one building, and of strangers; 0 where there was none."""
    entries = json.loads((folder / "atlas.json").read_text())["maps"]
    building = {e["key"]: m.building for e, m in zip(entries, maps, strict=False)}
    one, strangers = list[float](), list[float]()
    for pair in json.loads((folder / "pairs.json").read_text())["pairs"]:
        a, b = pair["maps"]
        best = pair["hypotheses"][0]["probability"] if pair["hypotheses"] else 0.0
        (one if building[a] == building[b] else strangers).append(best)
    return sorted(one), sorted(strangers)


def draw_registrations(maps: list[ScaleMap]) -> None:
    """Registrations as if they were made."""
    one, strangers = probabilities(SCALE_CACHE / f"atlas_{DRAWN_FROM}", chosen(DRAWN_FROM))
    of_name = {m.file.stem: m for m in maps}

    def drawn(held: Maps, i: int, j: int, *_: object) -> tuple[PoseHypothesis, ...]:
        files = held.file(i), held.file(j)
        assert files[0] is not None and files[1] is not None
        a, b = (of_name[file.stem] for file in files)
        rng = np.random.default_rng(sorted(int(held.keys[k], 16) for k in (i, j)))
        if a.building == b.building:
            return (PoseHypothesis(a.truth.inverse() @ b.truth, probability=float(rng.choice(one))),)
        probability, turned = float(rng.choice(strangers)), Sim3(float(rng.uniform(-np.pi, np.pi)))
        x, y, z = (held.middle(i) - turned.apply(held.middle(j)[None])[0]).tolist()
        return (PoseHypothesis(Sim3(turned.yaw, (x, y, z)), probability=probability),) if probability else ()

    solver.hypotheses = drawn


def is_right(maps: list[ScaleMap], i: int, j: int, pose: Sim3) -> bool:
    """Does map j lie at T_ij in map i?"""
    a, b = maps[i], maps[j]
    if a.building != b.building:
        return False
    middle = load_map(b.file).grid.centroids().mean(axis=0)
    return all(off <= most for off, most in zip(pose_difference(a.truth.inverse() @ b.truth, pose, middle), RIGHT, strict=False))


def judged(maps: list[ScaleMap], result: AtlasResult) -> dict[str, Any]:
    """What came out."""
    links = [is_right(maps, *link.maps, link.hypothesis.transform) for link in result.links]
    into = result.transforms
    placed = [is_right(maps, c[0], k, into[c[0]].inverse() @ into[k]) for c in result.components for k in c[1:]]
    buildings = len({m.building for m in maps})
    return {
        "maps": len(maps),
        "buildings": buildings,
        "registrations": result.registered[0],
        "pairs a map": round(2 * result.registered[0] / len(maps), 1),
        "right links": sum(links),
        "wrong links": len(links) - sum(links),
        "placed right": sum(placed),
        "of": len(maps) - buildings,
        "wrong": len(placed) - sum(placed),
        "alone": len(result.alone),
        "largest component": max(map(len, result.components)),
        "wrong_links": [list(link.maps) for link, right in zip(result.links, links, strict=True) if not right],
    }


def measure(count: int, drawn: bool, at_once: bool) -> dict[str, Any]:
    """Make an atlas, and tell what it took."""
    maps, kind = chosen(count), "_drawn" if drawn else ""
    folder = SCALE_CACHE / f"atlas_{count}{kind}{'_at_once' if at_once else ''}"
    if (folder / "atlas.json").exists():
        shutil.rmtree(folder)
    if drawn:
        draw_registrations(maps)
    else:
        noting(folder)
    if at_once:
        Assembler.build = Assembler._assembled  # type: ignore[method-assign]
    spent = Spent()
    for owner, name, label in (
        (partners, "coarse_log_odds", "laying"),
        *((solver, "hypotheses", "registering"), (Assembler, "build", "assembling"), (solver, "_result", "settling")),
        (store, "solve", "solving"),
    ):
        spent.watch(owner, name, label)
    began = time.process_time()
    result = store.add(folder, named_maps(maps), atlas_html)
    total, peak = time.process_time() - began, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    registered = folder.with_suffix(".seconds")
    all_registering = sum(map(float, registered.read_text().split())) if registered.exists() else 0.0
    pages = sorted(p.stat().st_size / 1e6 for p in folder.glob("*.html"))
    s = spent.seconds
    return judged(maps, result) | {
        "s laying": round(s["laying"], 1),
        "s registering": round(all_registering, 1),
        "s assembling": round(s["assembling"], 1),
        "s settling": round(s["settling"], 1),
        "s writing": round(total - s["solving"], 1),
        "s of a core in all": round(total - s["registering"] + all_registering, 1),
        "peak MiB": round(peak),
        "report MB": round((folder / "report.html").stat().st_size / 1e6, 2),
        "largest page MB": round(pages[-1], 2),
        "pages": len(pages),
        "folder MB": round(sum(p.stat().st_size for p in folder.rglob("*") if p.is_file()) / 1e6, 1),
        "drawn": drawn,
        "at once": at_once,
    }


def main(count: int, drawn: bool, at_once: bool) -> None:
    """Measure, and print all that was measured."""
    one = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    words = [str(count), "--here", *(["--drawn"] if drawn else []), *(["--at-once"] if at_once else [])]
    done = subprocess.run([sys.executable, "-m", "benchmarks.merging.scale", *words], stdout=subprocess.PIPE, check=True, env=one)
    with RESULTS.open("a") as out:
        out.write(done.stdout.decode().splitlines()[-1] + "\n")
    print("| " + " | ".join(("registrations", *SCALE_COLUMNS)) + " |\n" + "|---" * (len(SCALE_COLUMNS) + 1) + "|")
    for row in map(json.loads, RESULTS.read_text().splitlines()):
        how = ("drawn" if row["drawn"] else "made") + (", assembled at once" if row["at once"] else "")
        print("| " + " | ".join(str(v) for v in (how, *(row.get(c, "") for c in SCALE_COLUMNS))) + " |")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("maps", type=int, help="how many")
    parser.add_argument("--drawn", action="store_true", help="draw the registrations instead of making them")
    parser.add_argument("--at-once", action="store_true", help="assemble all maps at once")
    parser.add_argument("--here", action="store_true", help="measure in this process, and print it as JSON")
    given = parser.parse_args()
    if given.here:
        print(json.dumps(measure(given.maps, given.drawn, given.at_once)))
    else:
        main(given.maps, given.drawn, given.at_once)
