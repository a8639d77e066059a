"""Nearest rooms among many: exact search beside the index of a large atlas (`fusion.atlas.partners`, `prepare_rooms_index`).

``python -m benchmarks.speed.room_search [ROOMS ...]``: vectors of length 1 as of the embedder that ships (256
numbers), noisy copies of a twentieth as many looks; what is looked for are noisy copies of some of them, as many as a map of 30
rooms has at four turns. Seconds are of the processor: run it on one core. It prints a table, and a line a
size as `bench.print_line` does.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from time import process_time

import numpy as np

from benchmarks.speed.bench import print_line
from topomerge.fusion.atlas.partners import find_nearest
from topomerge.fusion.atlas.rooms_index import RoomsIndex
from topomerge.types import Array

ROOMS = (10_000, 100_000, 1_000_000)
VECTOR, ALIKE, ASKED = 256, 20, 120  # numbers of a vector, rooms of one look, vectors that are looked for
LOOK_NOISE, SEEN_NOISE = 0.6, 0.4  # length of what is added to a look, and to a room that is seen again
BATCH_ROOMS = 50_000
SEARCH_COLUMNS = (
    "| rooms | exact, ms per query | index, ms per query | exact / index | room itself first: exact, index "
    "| recall of the 10 nearest | memory, MB: exact, index | file, MB | build, s | load, s |\n"
    "|---|---|---|---|---|---|---|---|---|---|"
)


def add_noise(rng: np.random.Generator, vectors: Array, noise: float) -> Array:
    """Add noise of such a length to vectors; the result is of length 1, in single precision."""
    other = vectors + np.float32(noise / np.sqrt(VECTOR)) * rng.standard_normal(vectors.shape, dtype=np.float32)
    out: Array = other / np.linalg.norm(other, axis=1, keepdims=True)
    return out


def draw_table(rng: np.random.Generator, rooms: int) -> Array:
    """Return (rooms, VECTOR) vectors."""
    looks = add_noise(rng, np.zeros((max(rooms // ALIKE, 1), VECTOR), np.float32), 1.0)
    table = np.empty((rooms, VECTOR), np.float32)
    for k in range(0, rooms, BATCH_ROOMS):
        part = table[k : k + BATCH_ROOMS]
        part[:] = add_noise(rng, looks[rng.integers(0, len(looks), len(part))], LOOK_NOISE)
    return table


def time_query(search: Callable[..., object], *inputs: Array) -> float:
    """Return the seconds of the processor a query; the best of three runs."""
    spent = []
    for _ in range(3):
        began = process_time()
        search(*inputs)
        spent.append(process_time() - began)
    return min(spent) / ASKED


def measure(rooms: int) -> str:
    """Measure one size: a row of the table."""
    rng = np.random.default_rng(rooms)
    table = draw_table(rng, rooms)
    itself = rng.integers(0, rooms, ASKED)
    asked = add_noise(rng, table[itself], SEEN_NOISE)
    index = RoomsIndex(VECTOR)
    began = process_time()
    index.add(["all"], [rooms], table)
    build_seconds = process_time() - began
    exact, by_index = find_nearest(table, asked)[0], index.find_nearest(asked)[0]
    slow, fast = time_query(find_nearest, table, asked), time_query(index.find_nearest, asked)
    print_line(f"room_search_{rooms}", fast, slow)
    recall = np.mean([len(set(a[:10]) & set(b[:10])) / 10 for a, b in zip(exact.tolist(), by_index.tolist(), strict=True)])
    first = [float((hits[:, 0] == itself).mean()) for hits in (exact, by_index)]
    memory = [size / 1e6 for size in (table.nbytes, index.memory)]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "rooms_index.npz"
        index.write(path, "")
        size = path.stat().st_size / 1e6
        began = process_time()
        RoomsIndex.read(path, VECTOR, "", {"all": rooms})
        read = process_time() - began
    searches = (
        f"{rooms:,} | {slow * 1e3:.2f} | {fast * 1e3:.2f} | {slow / fast:.1f} | {first[0]:.2f}, {first[1]:.2f} | {recall:.2f}"
    )
    return f"| {searches} | {memory[0]:,.0f}, {memory[1]:,.0f} | {size:,.0f} | {build_seconds:,.0f} | {read:.1f} |"


def main(rooms: Sequence[int] = ROOMS) -> None:
    """Measure and print a table."""
    print("\n".join([SEARCH_COLUMNS, *(measure(count) for count in rooms)]))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m benchmarks.speed.room_search", description=__doc__)
    parser.add_argument("rooms", nargs="*", type=int, help=f"sizes, instead of {ROOMS}")
    main(parser.parse_args().rooms or ROOMS)
