"""`topomerge merge --points`: the points of the inputs themselves, bent and posed as the merge says."""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from topomerge.cli.console import Bars, say_line, warn
from topomerge.cli.options import reading_choices

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


def with_points(result: MergeResult, files: Mapping[int, Path]) -> MergeResult:
    """The result that names the files of its points."""
    return replace(result, points={k: path.name for k, path in files.items() if k in result.placements})


@contextmanager
def points_written(result: MergeResult, folder: Path, args: argparse.Namespace) -> Iterator[None]:
    """Write the points of each input that the result names beside their places, and rename them on success, when what else
    belongs to the merge is written; those of an earlier merge in the folder are replaced or removed."""
    from topomerge.io.atomic import replacing

    earlier = _earlier_points(folder, args.inputs)
    with ExitStack() as stack:
        for k, name in result.points.items():
            _write(result, k, stack.enter_context(replacing(folder / name)), args)
        for k, source in enumerate(args.inputs if args.points and result.placements else ()):
            if Path(source).suffix.lower() == ".tmap":
                warn([f"{source}: is a map, which has no points; give the scan that it was made of for --points"])
            elif k not in result.placements:
                warn([f"{source}: stands apart, its points are not written"])
        written = {folder / name for name in result.points.values()}
        for path in [*(earlier - written), *(path.resolve() for path in written)]:
            path.unlink(missing_ok=True)  # a kill leaves no points of another merge beside this one
        yield


def _earlier_points(folder: Path, inputs: Sequence[str]) -> set[Path]:
    """The files of points that the merge in a folder names, but for those that are inputs now."""
    try:
        names = json.loads((folder / "merge.json").read_text(encoding="utf-8"))["points"].values()
        names = [name for name in names if re.fullmatch(r"[^/\\]*_merged\.(las|laz|ply)", name)]
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return set()  # no merge, or one that is damaged or older
    taken = {Path(path).resolve() for path in inputs}
    return {path for path in (folder / name for name in names) if path.is_file() and path.resolve() not in taken}


def _write(result: MergeResult, k: int, path: Path, args: argparse.Namespace) -> None:
    from topomerge.io.moved_points import save_moved
    from topomerge.types import Sim3, is_level, transformed

    place, levelling = result.placements[k], result.maps[k].levelling
    options = reading_choices(args.inputs[k], args)
    with Bars(enabled=not args.quiet) as bars:
        own_frame, progress = place.pose == Sim3() and is_level(levelling), bars.task("points")

        def move(points: np.ndarray) -> np.ndarray:
            moved: np.ndarray = place.transform_points(points if is_level(levelling) else transformed(levelling, points))
            return moved

        done = save_moved(args.inputs[k], path, move, _middle(result, k), same_frame=own_frame, progress=progress, **options)
    if done.beyond:
        warn([f"{args.inputs[k]}: {done.beyond:,} points are too far from all others for LAS and are left out"])
    if not args.quiet:
        say_line(f"{done.written:,} points of {args.inputs[k]} -> {path.name}")


def _middle(result: MergeResult, k: int) -> np.ndarray:
    """(3,) m, of map k in the joined frame."""
    low, high = result.maps[k].grid.bounds
    middle: np.ndarray = result.placements[k].pose.apply((low + high)[None] / 2)[0]
    return middle
