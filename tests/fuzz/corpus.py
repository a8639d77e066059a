"""Small valid files of every format that a stranger may hand us, and what reads each."""

from __future__ import annotations

import io
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np

from tests import samples
from tests.scenes_map import building

MOST = 5_000_000  # points that are taken of a file; the rest of a large surface is no danger, as it comes in portions


def read_cloud(path: Path) -> int:
    """Read points as a command does, portion by portion."""
    from topomerge.io import read_chunks

    image = path.suffix in (".pgm", ".png", ".jpg", ".tif", ".bmp")
    found = 0
    for chunk in read_chunks(path, resolution=0.1 if image else None, spacing=2.0, chunk=1 << 19):
        found += len(chunk)
        if found > MOST:
            break
    return found


def read_map(path: Path) -> int:
    """Read a map and what `topomerge info` prints of it."""
    from topomerge.io.listing import json_text, map_to_json, map_to_text
    from topomerge.io.maps import load_map

    found = load_map(path)
    map_to_text(found)
    json_text(map_to_json(found))
    return len(found.rooms)


READERS: dict[str, Callable[[Path], int]] = {".tmap": read_map}  # by suffix; all others are clouds


def reader(path: Path) -> Callable[[Path], int]:
    """What reads a file of this name."""
    return READERS.get(path.suffix, read_cloud)


def write_corpus(folder: Path) -> dict[str, Path]:
    """Name -> file, in a folder: those of `samples`, and pictures, a map and a folded scene."""
    from PIL import Image

    from topomerge.io.maps import save_map

    found = samples.write_all(folder)
    pgm = found["plan.yaml"].with_suffix(".pgm")
    found["plan.pgm"] = pgm
    pixels = Image.open(io.BytesIO(pgm.read_bytes()))
    for suffix in ("png", "jpg", "tif", "bmp"):
        found[f"image.{suffix}"] = folder / f"image.{suffix}"
        pixels.save(found[f"image.{suffix}"])
    found["text.pgm"] = folder / "text.pgm"
    found["text.pgm"].write_text("P2\n8 6\n255\n" + " ".join(str(v) for v in np.tile([0, 205, 254], 16)) + "\n")
    found["map.tmap"] = folder / "map.tmap"
    save_map(building(2, 2), found["map.tmap"])
    found["plain.npz"] = folder / "plain.npz"
    np.savez(found["plain.npz"], points=samples.box_points(50), poses=np.eye(4)[None], pose_of=np.zeros(50, np.int32))
    return found


def beside(name: str, corpus: Path, folder: Path) -> None:
    """Put what a file of this name needs into the folder where its mutants are written."""
    if name == "plan.yaml":
        shutil.copy(corpus / "plan.pgm", folder / "plan.pgm")
