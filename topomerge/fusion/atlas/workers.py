"""Pairs of maps registered in other processes: of this machine, or of a Dask cluster that sees the same folder.

What comes out is the same as in one process: each pair is registered by itself, and is heard in its turn.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from topomerge.embedding.room_cells import Descriptor
from topomerge.errors import InputError
from topomerge.fusion.atlas.maps import Maps
from topomerge.fusion.atlas.pairs import hypotheses
from topomerge.matching.poses import PoseHypothesis
from topomerge.types import Sim3

CONNECTING = 20  # s that a cluster may take to answer
TRIES = 4  # of a pair, whose worker may die of something else

Numbered = tuple[int, tuple[PoseHypothesis, ...]]


@dataclass(frozen=True)
class PairTask:
    """Two maps that shall be registered.

    Args:
        files: `.tmap` files, that every worker can read.
        embedder: of rooms, a name or what can be sent to another process; None where only geometry shall propose poses.
        scale, same: as of `atlas`.
        proposed: poses T_ij that are tried, too.
    """

    files: tuple[Path, Path]
    embedder: str | Descriptor | None
    scale: str
    same: str
    proposed: tuple[Sim3, ...] = ()


Workers = Callable[[Sequence[PairTask]], Iterator[Numbered]]  # numbers of tasks and what they gave, as they end


def register_pair(task: PairTask) -> tuple[PoseHypothesis, ...]:
    """Where the second map may lie in the first one (`pairs.hypotheses`)."""
    return hypotheses(Maps(task.files, task.embedder), 0, 1, task.scale, task.same, task.proposed)


def processes(jobs: int) -> Workers:
    """So many processes of this machine."""
    from joblib import Parallel, delayed

    def run(tasks: Sequence[PairTask]) -> Iterator[Numbered]:
        parallel = Parallel(min(jobs, len(tasks)), return_as="generator_unordered", batch_size=1)
        yield from parallel(delayed(_numbered)(k, task) for k, task in enumerate(tasks))

    return run


def _numbered(number: int, task: PairTask) -> Numbered:
    return number, register_pair(task)


def cluster(address: str) -> Workers:
    """The workers of a Dask scheduler, e.g. ``tcp://host:8786``. Pairs of a worker that dies are given to another one.

    Raises:
        InputError: Dask is missing, or nobody answers there.
    """
    try:
        from distributed import Client, as_completed
    except ImportError as error:
        raise InputError("--cluster: needs Dask: pip install 'topomerge[cluster]'") from error

    def run(tasks: Sequence[PairTask]) -> Iterator[Numbered]:
        try:
            client = Client(address, timeout=CONNECTING, set_as_default=False)
        except (OSError, ValueError) as error:
            reason = " ".join(str(error).split())[:200]
            raise InputError(
                f"--cluster {address}: no scheduler answers there ({reason}); start one with `dask scheduler`"
            ) from error
        with client:
            futures = client.map(register_pair, tasks, pure=False, retries=TRIES)
            number = {future.key: k for k, future in enumerate(futures)}
            for future in as_completed(futures, loop=client.loop):
                yield number[future.key], future.result()

    return run
