"""What a run tells: `metrics.jsonl`, TensorBoard, and a line an epoch with the time that is left."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.io.atomic import replacing
from topomerge.models.embedder import Embedder
from topomerge.training.packed import GraphPair
from topomerge.training.validate import embed

SHOWN = 12  # pairs in the embedding projector


class Log:
    """Metrics of a run.

    Args:
        folder: of the run.
        tensorboard: write events, too.
        epoch: rows of this and later epochs, of a run that goes on, are dropped.
    """

    def __init__(self, folder: Path, tensorboard: bool, epoch: int = 0) -> None:
        self.path, self.rows = folder / "metrics.jsonl", list[dict[str, Any]]()
        if epoch and self.path.exists():
            rows = [json.loads(line) for line in self.path.read_text(encoding="utf-8").splitlines()]
            self.rows = [row for row in rows if row["epoch"] < epoch]
        self._write()
        self.board: Any = None
        if tensorboard:
            from torch.utils.tensorboard import SummaryWriter

            self.board = SummaryWriter(folder / "tb", purge_step=epoch)  # type: ignore[no-untyped-call]

    def row(self, values: Mapping[str, Any]) -> None:
        """Keep the metrics of an epoch."""
        self.rows.append(dict(values))
        self._write()
        if self.board is not None:
            for name, value in values.items():
                if isinstance(value, float) and np.isfinite(value):
                    self.board.add_scalar(name, value, values["epoch"])
            self.board.flush()

    def _write(self) -> None:
        with replacing(self.path) as beside:
            beside.write_text("".join(json.dumps(row) + "\n" for row in self.rows), encoding="utf-8")

    def show(self, network: Embedder, pairs: Sequence[GraphPair], epoch: int, least: float, device: Any) -> None:
        """Embedding projector and a figure of matched rooms, of the best network so far."""
        if self.board is None:
            return
        some = [pair for pair in pairs if len(pair.matches)][:SHOWN]
        if not some:
            return
        found = embed(network, some, device)
        labels = [f"{k // 2}{'ab'[k % 2]} {int(t)}" for k, p in enumerate(_sides(some)) for t in p]
        self.board.add_embedding(np.concatenate([e.numpy() for e, _ in found]), labels, global_step=epoch, tag="rooms")
        self.board.add_figure("matched rooms", figure(network, some[0], found[0], found[1], least), epoch)

    def close(self) -> None:
        """Write what is left."""
        if self.board is not None:
            self.board.close()


def _sides(pairs: Sequence[GraphPair]) -> list[Any]:
    return [true.tolist() for pair in pairs for true in pair.true]


def figure(network: Embedder, pair: GraphPair, a: tuple[Any, Any], b: tuple[Any, Any], least: float) -> Any:
    """Two maps beside each other with the matches that were found: right ones green, wrong ones red, missing ones grey."""
    from matplotlib.figure import Figure

    from topomerge.matching.scores import assign_certain, certainty
    from topomerge.models.embedder import match_scores

    rows, columns = match_scores(a[0], b[0], a[1], b[1], float(network.temperature.detach()))
    found = {(i, j) for i, j in assign_certain(certainty(rows.exp().numpy(), columns.exp().numpy()), least).tolist()}
    true = {(i, j) for i, j in pair.matches.tolist()}
    places = [graph["pos"][:, :2].numpy() for graph in (pair.a, pair.b)]
    places = [p - p.min(axis=0) for p in places]
    places[1] = places[1] + [places[0][:, 0].max() + 8, 0]
    out = Figure(figsize=(9, 4), layout="constrained")
    axes = out.add_subplot()
    for graph, place in zip((pair.a, pair.b), places, strict=True):
        for i, j in graph["edge_index"].T.tolist():
            axes.plot(*place[[i, j]].T, color="0.8", lw=1, zorder=0)
        axes.scatter(place[:, 0], place[:, 1], s=4 * graph["x"][:, 0].numpy(), color="0.6", zorder=1)
    for i, j in found | true:
        color = "tab:green" if (i, j) in found & true else "tab:red" if (i, j) in found else "0.6"
        axes.plot(*np.stack([places[0][i], places[1][j]]).T, color=color, lw=1.2, ls="-" if (i, j) in found else ":", zorder=2)
    axes.set_aspect("equal")
    axes.set_axis_off()
    counts = f"{len(found & true)} right, {len(found - true)} wrong, {len(true - found)} missing"
    axes.set_title(f"{pair.about.get('building', '')}: {counts}")
    return out


class Clock:
    """Seconds since it was made, and how many are left at the pace so far."""

    def __init__(self, done: int, total: int) -> None:
        self.began, self.first, self.total = time.monotonic(), done, total

    def left(self, done: int) -> str:
        """hh:mm:ss that remain when `done` of the total are done."""
        pace = (time.monotonic() - self.began) / max(done - self.first, 1)
        return time.strftime("%H:%M:%S", time.gmtime(pace * (self.total - done)))
