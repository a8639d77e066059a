"""How fast the embedder trains: rooms a second, share of the time that goes into making batches, and how busy the card is.

``python -m benchmarks.speed.training MANIFEST --accelerator cuda --batch 32 128`` trains the network that ships on a set of pairs
(`topomerge.datasets.pairs.build`), for some steps, with batches made on the host and on the device.
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from topomerge.models.embedder import Embedder

from topomerge.embedding.network import Geometry, Network, Node
from topomerge.training.embedding import EmbeddingJob, start_fabric
from topomerge.training.loop import State
from topomerge.training.packed import GraphPair, load_pairs
from topomerge.training.settings import Training

SURROUNDINGS = Network(
    Geometry(["scalars", "surroundings", "wide_surroundings", "door_surroundings"], width=96),
    Node("gat", 2, around=10.0, ways=True),
)
WARM_UP = 5  # steps
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
    fused = fabric.device.type == "cuda"
    optimizer = torch.optim.AdamW(network.parameters(), settings.rate, weight_decay=settings.decay, fused=fused)
    job = EmbeddingJob(settings, fabric, network, optimizer, (pairs, []))
    batches, state, rooms, waited, began = job.batches(State()), State(), 0, 0.0, 0.0
    with CardMonitor() as card:
        for k in range(WARM_UP + steps):
            if k == WARM_UP:
                synchronize(fabric.device)
                rooms, waited, began = 0, 0.0, time.perf_counter()
            before = time.perf_counter()
            batch = next(batches)
            waited += time.perf_counter() - before
            rooms += job.size(batch)
            job.step(batch, state)
            state.step += 1
        synchronize(fabric.device)
        seconds = time.perf_counter() - began
    batches.close()
    busy = f"{statistics.mean(card.percent):.0f} % busy (most {max(card.percent):.0f} %)" if card.percent else "no card"
    text = f"batch {settings.batch}, {settings.batches}: {rooms / seconds:.0f} rooms/s, {1000 * seconds / steps:.1f} ms a step"
    return f"{text}, {100 * waited / seconds:.0f} % of it for batches, {busy}"


def synchronize(device: torch.device) -> None:
    """Wait for what is under way on a card."""
    if device.type == "cuda":
        torch.cuda.synchronize()


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.speed.training", description=__doc__)
    parser.add_argument("manifest", type=Path)
    parser.add_argument("--accelerator", default="cpu")
    parser.add_argument("--precision", default="auto")
    parser.add_argument("--batch", nargs="+", type=int, default=[32])
    parser.add_argument("--batches", nargs="+", default=["host", "device"])
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--threads", type=int, default=1)
    args = parser.parse_args()
    pairs = load_pairs(args.manifest, ["sheet"], print, around=SURROUNDINGS.node.around)
    print(f"{len(pairs)} pairs, {sum(len(t) for p in pairs for t in p.true) / len(pairs):.1f} rooms each")
    for batch in args.batch:
        for where in args.batches:
            settings = Training(
                accelerator=args.accelerator, precision=args.precision, threads=args.threads, network=SURROUNDINGS, batch=batch,
                batches=where,
            )  # fmt: skip
            needed = (WARM_UP + args.steps) * batch
            repeated = list(pairs) * (needed // len(pairs) + 1)
            print(measure_training(repeated, replace(settings, epochs=1), args.steps), flush=True)


if __name__ == "__main__":
    main()
