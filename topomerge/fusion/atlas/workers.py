"""Maps laid on each other coarsely, and pairs registered, in other processes: of this machine, or of a Dask cluster that sees the
same folder.

What comes out is the same as in one process: each pair is looked at by itself, and is heard in its turn.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from topomerge.embedding.room_cells import Descriptor
from topomerge.errors import InputError
from topomerge.fusion.atlas.coarse import coarse_log_odds
from topomerge.fusion.atlas.maps import Maps
from topomerge.fusion.atlas.memory import Memory
from topomerge.fusion.atlas.pairs import hypotheses
from topomerge.matching.poses import PoseHypothesis
from topomerge.types import Sim3

CONNECTING = 20  # s that a cluster may take to answer
TRIES = 4  # of a pair, whose worker may die of something else

Workers = Callable[[Callable[[Any], Any], Sequence[Any]], Iterator[tuple[int, Any]]]
"""Calls a function with each task: the numbers of the tasks and what came out, as they end."""


@dataclass(frozen=True)
class CoarseTask:
    """Maps that shall be laid coarsely on the first of them.

    Args:
        files: `.tmap` files, that every worker can read.
        keys: of the maps.
        scale: as of `atlas`.
    """

    files: tuple[Path, ...]
    keys: tuple[str, ...]
    scale: str


@dataclass(frozen=True)
class PairTask:
    """Two maps that shall be registered.

    Args:
        files, keys: as of `CoarseTask`.
        embedder: of rooms, a name or what can be sent to another process; None where only geometry shall propose poses.
        scale, same: as of `atlas`.
        proposed: poses T_ij that are tried, too.
    """

    files: tuple[Path, Path]
    keys: tuple[str, str]
    embedder: str | Descriptor | None
    scale: str
    same: str
    proposed: tuple[Sim3, ...] = ()


@cache
def _memory() -> Memory:
    """Of this process: a map that comes in many pairs is prepared once."""
    return Memory()


def lay_coarsely(task: CoarseTask) -> tuple[float, ...]:
    """How likely each map but the first lies on the first one (`coarse.coarse_log_odds`)."""
    memory = _memory()
    memory.coarse = {}  # what an earlier task found may be of another scale
    maps = Maps(task.files, None, memory, task.keys)
    return tuple(coarse_log_odds(maps, 0, k, task.scale) for k in range(1, len(maps)))


def register_pair(task: PairTask) -> tuple[PoseHypothesis, ...]:
    """Where the second map may lie in the first one (`pairs.hypotheses`)."""
    return hypotheses(Maps(task.files, task.embedder, _memory(), task.keys), 0, 1, task.scale, task.same, task.proposed)


def processes(jobs: int) -> Workers:
    """So many processes of this machine."""
    from joblib import Parallel, delayed

    def run(work: Callable[[Any], Any], tasks: Sequence[Any]) -> Iterator[tuple[int, Any]]:
        parallel = Parallel(min(jobs, len(tasks)), return_as="generator_unordered", batch_size=1)
        yield from parallel(delayed(_numbered)(work, k, task) for k, task in enumerate(tasks))

    return run


def _numbered(work: Callable[[Any], Any], number: int, task: Any) -> tuple[int, Any]:
    return number, work(task)


def cluster(address: str) -> Workers:
    """The workers of a Dask scheduler, e.g. ``tcp://host:8786``. Pairs of a worker that dies are given to another one.

    Raises:
        InputError: Dask is missing, or nobody answers there.
    """
    try:
        from distributed import Client, as_completed
    except ImportError as error:
        raise InputError("--cluster: needs Dask: pip install 'topomerge[cluster]'") from error

    def run(work: Callable[[Any], Any], tasks: Sequence[Any]) -> Iterator[tuple[int, Any]]:
        try:
            client = Client(address, timeout=CONNECTING, set_as_default=False)
        except (OSError, ValueError) as error:
            reason = " ".join(str(error).split())[:200]
            raise InputError(
                f"--cluster {address}: no scheduler answers there ({reason}); start one with `dask scheduler`"
            ) from error
        with client:
            futures = client.map(work, tasks, pure=False, retries=TRIES)
            number = {future.key: k for k, future in enumerate(futures)}
            for future in as_completed(futures, loop=client.loop):
                yield number[future.key], future.result()

    return run
