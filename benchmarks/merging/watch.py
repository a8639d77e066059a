"""How long it takes from a new map to the answer of a watched atlas: where it lies, and the page that shows it.

``python -m benchmarks.merging.watch --buildings 11 --folder cache/atlas/live`` makes small maps of procedural buildings, five of
each, puts all into an atlas but the last of the first building and all of the last one, and then adds one map of each of these:
one that belongs to the atlas and a stranger. The registrations of the maps that are there are those of the truth (to make them
would take hours and is not what is measured); all those of the new maps are made. What is printed: maps and rooms, seconds until
it is said where the map lies, until all is written, and until nothing is left to be registered.
"""

from __future__ import annotations

import argparse
import shutil
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.core.builder import one_thread
from topomerge.datasets.pairs.atlases import make_atlas
from topomerge.datasets.pairs.pairs import draw_frames

from topomerge.errors import InputError
from topomerge.extraction.extract import extract
from topomerge.fusion.atlas import solve as solver
from topomerge.fusion.atlas.maps import Maps, map_key
from topomerge.fusion.atlas.store import add
from topomerge.fusion.atlas.watch import Reader, Watch
from topomerge.io.maps import load_map, save_map
from topomerge.matching.poses import PoseHypothesis
from topomerge.types import Sim3
from topomerge.viz.atlas_report import atlas_html

LIVE_KINDS = ("office", "school", "hospital", "lab", "hotel")
LIVE_SENSORS = ("depth", "tablet", "depth", "depth", "tablet")
ROOMS_WALKED, ROOMS_WALKED_FIRST = 4, 7  # of a map, and of those of the first building; more are seen through doors
TRIES = 5
TRUE_LINK = 0.97  # probability of the registrations that are taken from the truth


def make(folder: Path, buildings: int) -> list[list[Path]]:
    """Maps of each building, unless they are there."""
    folder.mkdir(parents=True, exist_ok=True)
    for b in range(buildings):
        files = [folder / f"b{b}_m{k}.tmap" for k in range(len(LIVE_SENSORS))]
        for number in range(TRIES):
            if all(f.exists() for f in files):
                break
            try:
                with one_thread():
                    building = make_building(LIVE_KINDS[b % len(LIVE_KINDS)], 7000 + 10 * b + number)
                    rng = np.random.default_rng([b, 1])
                    made = make_atlas(building, LIVE_SENSORS, rng, ROOMS_WALKED if b else ROOMS_WALKED_FIRST)
                    for path, cloud in zip(files, made.maps, strict=True):
                        save_map(replace(extract(cloud), source=path.stem), path)
            except InputError:
                continue
    return [[folder / f"b{b}_m{k}.tmap" for k in range(len(LIVE_SENSORS))] for b in range(buildings)]


def truth(b: int) -> list[Sim3]:
    """T_0k of each map of a building: what `make` drew first."""
    frames = draw_frames(len(LIVE_SENSORS), False, np.random.default_rng([b, 1]))
    return [frames[0] @ frame.inverse() for frame in frames]


class Answers:
    """What a watch says, and when."""

    def __init__(self) -> None:
        self.lines: list[tuple[float, str]] = []

    def __call__(self, line: str, is_warning: bool) -> None:
        self.lines.append((time.perf_counter(), line))


def prepared_atlas(folder: Path, maps: list[list[Path]]) -> Path:
    """An atlas of all maps but the new ones, registered by the truth."""
    atlas = folder / "atlas"
    if (atlas / "atlas.json").exists():
        return atlas
    held = [(b, k) for b in range(len(maps) - 1) for k in range(len(LIVE_SENSORS)) if (b, k) != (0, len(LIVE_SENSORS) - 1)]
    loaded = {(b, k): load_map(maps[b][k]) for b, k in held}
    places = {map_key(m): place for place, m in loaded.items()}

    def of_truth(maps: Maps, i: int, j: int, *_: object) -> tuple[PoseHypothesis, ...]:
        (b, k), (c, m) = places[maps.keys[i]], places[maps.keys[j]]
        return (PoseHypothesis(truth(b)[k].inverse() @ truth(b)[m], probability=TRUE_LINK),) if b == c else ()

    usual, solver.hypotheses = solver.hypotheses, of_truth
    try:
        add(atlas, [(maps[b][k].stem, loaded[b, k]) for b, k in held], atlas_html)
    finally:
        solver.hypotheses = usual
    return atlas


def main(folder: Path, buildings: int) -> None:
    """Measure, and print."""
    maps = make(folder, buildings)
    began = time.perf_counter()
    base = prepared_atlas(folder, maps)
    print(f"atlas of {len(list((base / 'maps').glob('*.tmap')))} maps made in {time.perf_counter() - began:.0f} s", flush=True)
    site, scans = folder / "site", folder / "scans"
    for place in (site, scans):
        shutil.rmtree(place, ignore_errors=True)
    shutil.copytree(base, site)
    scans.mkdir()
    answers = Answers()
    watch = Watch(scans, site, Reader(load_map, "", lambda *_: None), atlas_html, answers, settle=0.0, warm=True)
    began = time.perf_counter()
    while watch.look():
        pass
    print(f"all maps looked at once in {time.perf_counter() - began:.0f} s", flush=True)
    for path in (maps[0][-1], maps[-1][0]):
        shutil.copy(path, scans / path.name)
        answers.lines.clear()
        began, cpu = time.perf_counter(), time.process_time()
        more = watch.look()
        written = time.perf_counter() - began
        said = answers.lines[0][0] - began
        spent = time.process_time() - cpu
        while more:
            more = watch.look()
        ended, all_spent = time.perf_counter() - began, time.process_time() - cpu
        took = f"said {said:.1f} s, written {written:.1f} s ({spent:.1f} s of a core), nothing left {ended:.1f} s"
        print(f"{took} ({all_spent:.1f} s of a core)", *(line for _, line in answers.lines), sep="\n  ", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--buildings", type=int, default=11, help="five maps each")
    parser.add_argument("--folder", type=Path, default=Path("cache/atlas/live"), help="of maps and atlases")
    given = parser.parse_args()
    main(given.folder, given.buildings)
