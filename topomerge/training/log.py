"""What a run reports: `metrics.jsonl`, TensorBoard, and a line an epoch with the time that is left."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.io.atomic import replacing


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

    def close(self) -> None:
        """Write what is left."""
        if self.board is not None:
            self.board.close()


class Clock:
    """Seconds since it was made, and how many are left at the pace so far."""

    def __init__(self, done: int, total: int) -> None:
        self.began, self.first, self.total = time.monotonic(), done, total

    def left(self, done: int) -> str:
        """hh:mm:ss that remain when `done` of the total are done."""
        pace = (time.monotonic() - self.began) / max(done - self.first, 1)
        return time.strftime("%H:%M:%S", time.gmtime(pace * (self.total - done)))
