"""How fast networks train: rooms or examples a second, share of the time that waits for batches, and how busy the card is.

``python -m benchmarks.speed.training MANIFEST --accelerator cuda --batches 32 128`` trains the embedder that ships for some steps
on a set of pairs (`topomerge.datasets.pairs.build`): with batches made on the host, on the device, and with steps as CUDA graphs.
Then it trains the networks of plans, grids, walls, places and drawings, as large as they ship, on tiny sets: how large a batch is
depends on no set. ``--ways host compiled`` takes steps of all networks with and without `compile`.
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
from contextlib import ExitStack
from importlib import import_module
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from topomerge.datasets.pairs.build import Build, build
from topomerge.models.embedder import Embedder

from tests.training import tiny
from topomerge.config import compose
from topomerge.embedding.network import Geometry, Network, Node
from topomerge.training.captured_step import CapturedStep
from topomerge.training.compilation import choose_step_context
from topomerge.training.descent import build_optimizer
from topomerge.training.embedding import EmbeddingJob, start_fabric
from topomerge.training.loop import State
from topomerge.training.packed_pairs import GraphPair, load_pairs
from topomerge.training.settings import Training
from topomerge.training.tasks import compose_settings

SURROUNDINGS = Network(
    Geometry(["scalars", "surroundings", "wide_surroundings", "door_surroundings"], width=96),
    Node("gat", 2, around=10.0, ways=True),
)
WARM_UP, GRAPHS_WARM_UP = 5, 80  # steps; the shapes that come are captured meanwhile
NETWORKS = {
    "plan_segmentation": "plan_segmentation",
    "grid_segmentation": "plan_segmentation",
    "wall_segmentation": "wall_segmentation",
    "place_evidence": "place_evidence",
    "drawing_segmentation": "drawing_segmentation",
}  # tasks, and their modules
TINY = {
    "place_evidence": ["hold_out=2", "lookalikes=false"],
    "drawing_segmentation": [  # its pages are drawn while it trains, the first ones before
        *("pages=16", "watched_pages=1", "data.procedural=4", "data.folder=", "watched.procedural=2", "watched.folder="),
    ],
}
TINY_SETS = {"build_plans": "plans", "build_walls": "walls", "build_hypothesis_files": "places"}  # and what tasks get them from
WAYS = {  # `batches`, `graphs` and `compile`
    "host": ("host", False, False),
    "device": ("device", False, False),
    "graphs": ("device", True, False),
    "compiled": ("host", False, True),
}
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
    captures = isinstance(job.take_step, CapturedStep)
    way = "graphs" if captures else settings.batches
    return f"batch {settings.batch}, {way}{measure_steps(job, settings, steps, GRAPHS_WARM_UP if captures else WARM_UP)}"


def measure_steps(job: Any, settings: Any, steps: int, warm_up: int) -> str:
    """Take some steps of a job and return what is to be said of them."""
    batches, state = job.iter_batches(State()), State()
    context = choose_step_context(settings, job.network)
    with context():
        take_steps(job, batches, state, warm_up)
        synchronize(job.fabric.device)
        with CardMonitor() as card:
            began = time.perf_counter()
            items, waited = take_steps(job, batches, state, steps)
            synchronize(job.fabric.device)
            seconds = time.perf_counter() - began
    batches.close()
    busy = f"{statistics.mean(card.percent):.0f} % busy (most {max(card.percent):.0f} %)" if card.percent else "no card"
    text = (
        f"{', compiled' if settings.compile else ''}: {items / seconds:.0f} {job.unit}/s, {1000 * seconds / steps:.1f} ms a step"
    )
    return f"{text}, {100 * waited / seconds:.0f} % of it waiting for batches, {busy}"


def measure_network(task: str, folder: Path, words: Sequence[str], steps: int) -> str:
    """Train the network of a task for some steps and return a line about it.

    Args:
        folder: of the sets of `build_tiny_sets`.
    """
    module = import_module(f"topomerge.training.{NETWORKS[task]}")
    settings = compose_settings([f"task={task}", f"runs={folder}", f"cache={folder}", *TINY.get(task, ["hold_out=2"]), *words])
    paths = {name: sorted((folder / of).glob("*.npz")) for name, of in TINY_SETS.items()}
    with ExitStack() as replaced:
        for name in [name for name in TINY_SETS if hasattr(module, name)]:
            result = paths[name] if name == "build_hypothesis_files" else (paths[name], None)
            replaced.enter_context(patch.object(module, name, lambda *_, result=result: result))
        replaced.enter_context(patch.object(module, "run_network", lambda job, *_: measure_steps(job, settings, steps, 1)))
        line: str = module.fit(settings, lambda text: None)
    return f"{task}, batch {settings.batch}{line}"


def build_tiny_sets(folder: Path) -> None:
    """Write sets of `tests.training.tiny`."""
    tiny.plan_files(folder / "plans", 8)
    tiny.wall_files(folder / "walls", 8)
    tiny.place_files(folder / "places")


def take_steps(job: Any, batches: Iterator[Any], state: State, steps: int) -> tuple[int, float]:
    """Take so many steps; return the rooms or examples in them, and the seconds that the steps waited for batches."""
    items, waited = 0, 0.0
    for _ in range(steps):
        before = time.perf_counter()
        batch = next(batches)
        waited += time.perf_counter() - before
        items += job.count_items(batch)
        job.train_step(batch, state)
        state.step += 1
    return items, waited


def synchronize(device: torch.device) -> None:
    """Wait for what is under way on a card."""
    if device.type == "cuda":
        torch.cuda.synchronize()


def main(
    manifest: str = "", accelerator: str = "cpu", batches: Sequence[int] = (32, 128), steps: int = 20, threads: int = 1,
    ways: Sequence[str] = ("host", "device", "graphs"), networks: Sequence[str] = tuple(NETWORKS), examples: int = 0,
) -> None:  # fmt: skip
    """Measure.

    Args:
        manifest: of a set of pairs; empty: four small procedural ones are made.
        batches: pairs a step of the embedder; empty: it is left out.
        threads: that make batches on the host.
        ways: of `WAYS`; graphs need a card.
        networks: other tasks, of `NETWORKS`; examples: of their batches; 0: as they ship.
    """
    with tempfile.TemporaryDirectory() as folder:
        if batches:
            path = Path(manifest) if manifest else build_small_set(Path(folder))
            pairs = load_pairs(path, ["sheet"], around=SURROUNDINGS.node.around)
            print(f"{len(pairs)} pairs, {sum(len(t) for p in pairs for t in p.true) / len(pairs):.1f} rooms each")
        for batch, way in itertools.product(batches, [way for way in ways if accelerator != "cpu" or not WAYS[way][1]]):
            where, graphs, compiles = WAYS[way]
            common = {"accelerator": accelerator, "threads": threads, "network": SURROUNDINGS, "compile": compiles}
            settings = Training(**common, batch=batch, batches=where, graphs=graphs, epochs=1)
            repeated = list(pairs) * ((GRAPHS_WARM_UP + steps) * batch // len(pairs) + 1)
            print(measure_training(repeated, settings, steps), flush=True)
        build_tiny_sets(Path(folder))
        for task, compiles in itertools.product(networks, (False, True) if "compiled" in ways else (False,)):
            words = [f"accelerator={accelerator}", f"compile={compiles}", *([f"batch={examples}"] if examples else [])]
            print(measure_network(task, Path(folder), words, steps), flush=True)


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
    parser.add_argument("--batches", nargs="*", type=int, default=[32, 128], metavar="PAIRS")
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=["host", "device", "graphs"])
    parser.add_argument("--networks", nargs="*", choices=NETWORKS, default=list(NETWORKS), metavar="TASK")
    parser.add_argument("--examples", type=int, default=0)
    return vars(parser.parse_args(words))


if __name__ == "__main__":
    main(**parse_words(sys.argv[1:]))
