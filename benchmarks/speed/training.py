"""How fast the embedder trains: rooms a second, share of the time that goes into making batches, and how busy the card is.

``python -m benchmarks.speed.training MANIFEST --accelerator cuda --batches 32 128`` trains the network that ships for some steps
on a set of pairs (`topomerge.datasets.pairs.build`): with batches made on the host, on the device, and with steps as CUDA graphs.
"""

from __future__ import annotations

import argparse
import itertools
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from topomerge.datasets.pairs.build import Build, build
from topomerge.models.embedder import Embedder

from topomerge.config import compose
from topomerge.embedding.network import Geometry, Network, Node
from topomerge.training.batches import MapPair
from topomerge.training.captured_step import CapturedStep
from topomerge.training.descent import build_optimizer
from topomerge.training.embedding import EmbeddingJob, start_fabric
from topomerge.training.loop import State
from topomerge.training.packed_pairs import GraphPair, load_pairs
from topomerge.training.settings import Training

SURROUNDINGS = Network(
    Geometry(["scalars", "surroundings", "wide_surroundings", "door_surroundings"], width=96),
    Node("gat", 2, around=10.0, ways=True),
)
WARM_UP, GRAPHS_WARM_UP = 5, 80  # steps; the shapes that come are captured meanwhile
WAYS = {"host": ("host", False), "device": ("device", False), "graphs": ("device", True)}  # `batches` and `graphs`
SAMPLE_MS = 100  # between two looks at the card


class CardMonitor:
    """Reads how busy the card is while it is entered; empty where there is no ``nvidia-smi``."""

    def __init__(self) -> None:
        self.percent: list[float] = []

    def __enter__(self) -> CardMonitor:
        words = ["nvidia-smi", "--query-gpu=utilization.gpu", "--format=csv,noheader,nounits", "-lms", str(SAMPLE_MS)]
        try:
            self.process: subprocess.Popen[str] | None = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
        except OSError:
            self.process = None
        return self

    def __exit__(self, *error: object) -> None:
        if self.process is not None:
            self.process.terminate()
            output = self.process.communicate()[0]
            self.percent = [float(line) for line in output.split() if line.replace(".", "").isdigit()]


def measure_training(pairs: Sequence[GraphPair], settings: Training, steps: int) -> str:
    """Train for some steps and return a line about it."""
    fabric = start_fabric(settings)
    torch.manual_seed(0)
    network = Embedder(settings.network)
    network.fit_scales([graph for pair in pairs[:200] for graph in (pair.a, pair.b)])
    on_cuda = fabric.device.type == "cuda"
    optimizer = build_optimizer(settings, network, fused=on_cuda, capturable=on_cuda)
    job = EmbeddingJob(settings, fabric, network, optimizer, (pairs, []))
    batches, state = job.iter_batches(State()), State()
    captures = isinstance(job.take_step, CapturedStep)
    take_steps(job, batches, state, GRAPHS_WARM_UP if captures else WARM_UP)
    synchronize(fabric.device)
    with CardMonitor() as card:
        began = time.perf_counter()
        rooms, waited = take_steps(job, batches, state, steps)
        synchronize(fabric.device)
        seconds = time.perf_counter() - began
    batches.close()
    busy = f"{statistics.mean(card.percent):.0f} % busy (most {max(card.percent):.0f} %)" if card.percent else "no card"
    way = "graphs" if captures else settings.batches
    text = f"batch {settings.batch}, {way}: {rooms / seconds:.0f} rooms/s, {1000 * seconds / steps:.1f} ms a step"
    return f"{text}, {100 * waited / seconds:.0f} % of it for batches, {busy}"


def take_steps(job: EmbeddingJob, batches: Iterator[MapPair], state: State, steps: int) -> tuple[int, float]:
    """Take so many steps; return the rooms in them, and the seconds that the host was making batches."""
    rooms, waited = 0, 0.0
    for _ in range(steps):
        before = time.perf_counter()
        batch = next(batches)
        waited += time.perf_counter() - before
        rooms += job.count_items(batch)
        job.train_step(batch, state)
        state.step += 1
    return rooms, waited


def synchronize(device: torch.device) -> None:
    """Wait for what is under way on a card."""
    if device.type == "cuda":
        torch.cuda.synchronize()


def main(
    manifest: str = "", accelerator: str = "cpu", batches: Sequence[int] = (32, 128), steps: int = 20, threads: int = 1,
    ways: Sequence[str] = tuple(WAYS),
) -> None:  # fmt: skip
    """Measure.

    Args:
        manifest: of a set of pairs; empty: four small procedural ones are made.
        batches: pairs a step.
        threads: that make batches on the host.
        ways: of `WAYS`; graphs need a card.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(manifest) if manifest else build_small_set(Path(folder))
        pairs = load_pairs(path, ["sheet"], around=SURROUNDINGS.node.around)
    print(f"{len(pairs)} pairs, {sum(len(t) for p in pairs for t in p.true) / len(pairs):.1f} rooms each")
    for batch, way in itertools.product(batches, [way for way in ways if accelerator != "cpu" or not WAYS[way][1]]):
        where, graphs = WAYS[way]
        common = {"accelerator": accelerator, "threads": threads, "network": SURROUNDINGS}
        settings = Training(**common, batch=batch, batches=where, graphs=graphs, epochs=1)
        repeated = list(pairs) * ((GRAPHS_WARM_UP + steps) * batch // len(pairs) + 1)
        print(measure_training(repeated, settings, steps), flush=True)


def build_small_set(folder: Path) -> Path:
    """Build four procedural pairs and return their manifest."""
    words = ["data=procedural", "data.pairs=4", "data.rooms=[4,5]", f"cache={folder}", "jobs=1"]
    build(compose("build", Build, words), lambda text: None)
    return folder / "procedural.jsonl"


def parse_words(words: Sequence[str]) -> dict[str, Any]:
    """Return the arguments of `main`."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.speed.training", description=__doc__)
    parser.add_argument("manifest", nargs="?", default="")
    parser.add_argument("--accelerator", default="cpu")
    parser.add_argument("--batches", nargs="+", type=int, default=[32, 128], metavar="PAIRS")
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=list(WAYS))
    return vars(parser.parse_args(words))


if __name__ == "__main__":
    main(**parse_words(sys.argv[1:]))
