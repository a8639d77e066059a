"""`topomerge merge --points`: the points of the inputs themselves, bent and posed as the merge says."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from topomerge.cli.console import Bars, say, warn
from topomerge.cli.options import given

if TYPE_CHECKING:
    import numpy as np

    from topomerge.fusion.result import MergeResult


def point_files(inputs: Sequence[str], folder: Path) -> dict[int, Path]:
    """Number of an input -> the file for its points; a number stands in the name where two inputs are called alike. Of maps,
    which have none, there is none."""
    from topomerge.io.moved_points import moved_suffix

    files: dict[int, Path] = {}
    taken: set[str] = set()
    for k, source in enumerate(map(Path, inputs)):
        if source.suffix.lower() == ".tmap":
            continue
        names = (f"{source.stem}{f'_{n}' if n > 1 else ''}_merged{moved_suffix(source)}" for n in range(1, len(inputs) + 1))
        name = next(name for name in names if name.lower() not in taken)  # some file systems take A for a
        taken.add(name.lower())
        files[k] = folder / name
    return files


@contextmanager
def points_written(result: MergeResult, files: Mapping[int, Path], args: argparse.Namespace) -> Iterator[None]:
    """Write the points of each input that is part of the joined map beside their places, and rename them on success, when what
    else belongs to the merge is written; files of an earlier merge that nothing takes the place of are removed."""
    from topomerge.io.atomic import replacing

    placed = result.placements
    with ExitStack() as stack:
        for k, path in files.items():
            if k in placed:
                _write(result, k, stack.enter_context(replacing(path)), args)
        for k, source in enumerate(args.inputs if placed else ()):
            if k not in files:
                warn([f"{source}: is a map, which has no points; give the scan that it was made of for --points"])
            elif k not in placed:
                warn([f"{source}: stands apart, its points are not written"])
        for path in files.values():  # a kill leaves no points of another merge beside this one
            path.resolve().unlink(missing_ok=True)
        yield


def _write(result: MergeResult, k: int, path: Path, args: argparse.Namespace) -> None:
    from topomerge.io.moved_points import save_moved
    from topomerge.types import Sim3

    place, options = result.placements[k], given(args, "up", "unit")
    with Bars(enabled=not args.quiet) as bars:
        own_frame, progress = place.pose == Sim3(), bars.task("points")
        done = save_moved(
            args.inputs[k], path, place.apply, _middle(result, k), same_frame=own_frame, progress=progress, **options
        )
    if done.beyond:
        warn([f"{args.inputs[k]}: {done.beyond:,} points are too far from all others for LAS and are left out"])
    if not args.quiet:
        say(f"{done.written:,} points of {args.inputs[k]} -> {path.name}")


def _middle(result: MergeResult, k: int) -> np.ndarray:
    """(3,) m, of map k in the joined frame."""
    low, high = result.maps[k].grid.bounds
    middle: np.ndarray = result.placements[k].pose.apply((low + high)[None] / 2)[0]
    return middle
