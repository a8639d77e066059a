"""The pictures of docs/studio.md, taken in a real browser: ``python -m tests.studio.pictures``, two minutes.

A surveyor's folder: two scans of an office, of which the hall of the first was cut in two.
"""

from __future__ import annotations

import io
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import topomerge as tm
from tests.studio.browser import WAIT, MapPage, open_context, run_studio, start_browser
from topomerge.cli.main import main as run_command
from topomerge.edits.journal import build_edit

IMAGES = Path(__file__).parents[2] / "docs" / "images"
WIDTH, QUALITY = 1000, 82  # pixels, of WebP
HALL = [[22.2, -17.0], [24.6, -17.0]]  # m, where the hall is cut


def prepare_folder(folder: Path) -> None:
    """Simulate, extract, and cut the hall of the first map in two."""
    words = ["simulate", "--building", "office", "--seed", "5", "--sensors", "tls,depth", "--rooms", "8", "--overlap", "0.7"]
    assert run_command([*words, "-o", str(folder), "--quiet"]) == 0
    names = {"a": "ground floor west", "b": "ground floor east"}
    for old, new in names.items():
        (folder / f"{old}.ply").rename(folder / f"{new}.ply")
        map = tm.extract(tm.read_points(folder / f"{new}.ply"), name=f"{new}.ply")
        if old == "a":
            at = [(HALL[0][0] + HALL[1][0]) / 2, HALL[0][1], float(map.storeys["floor"][0]) + 0.1]
            map = replace(tm.apply_edits(map, [build_edit("split_room", at=at, line=HALL)]).map, parameters=map.parameters)
        tm.save_map(map, folder / f"{new}.tmap")
    for name in ("truth.json", "plan.png"):
        (folder / name).unlink()
    (folder / "ground floor east.ply").rename(folder / "first floor.ply")  # not extracted yet


def take(page: Any, name: str, images: Path) -> None:
    """Write what a page shows."""
    from PIL import Image

    picture = Image.open(io.BytesIO(page.screenshot()))
    picture = picture.resize((WIDTH, round(WIDTH * picture.height / picture.width)), Image.Resampling.LANCZOS)
    picture.convert("RGB").save(images / f"studio_{name}.webp", quality=QUALITY, method=6)


def photograph(folder: Path, images: Path) -> None:
    """Go the way of docs/studio.md and take its pictures."""
    size = {"width": 1200, "height": 750}
    with run_studio(folder) as (address, _), start_browser() as chromium, open_context(chromium, viewport=size) as context:
        west, east = "ground floor west.tmap", "ground floor east.tmap"
        one = MapPage(context, address, west)
        page = one.page
        page.fill(".bar input", "Ada")
        page.keyboard.press("Enter")
        x = sum(p[0] for p in HALL) / 2
        halves = [page.evaluate("p => studio.canvas.roomAt(p)?.i", paper_of(page, x, HALL[0][1] + step)) for step in (-1.0, 1.0)]
        page.locator(".plan-canvas").focus()
        for k, i in enumerate(halves):
            page.keyboard.down("Shift") if k else None
            one.click(one.room(i)["x"], one.room(i)["y"])
        page.keyboard.up("Shift")
        take(page, "select", images)
        page.keyboard.press("j")
        one.wait_version(1)
        page.keyboard.press("r")
        page.fill("dialog input", "Hall")
        page.keyboard.press("Enter")
        one.wait_version(2)
        page.wait_for_timeout(500)
        take(page, "mended", images)
        page.emulate_media(color_scheme="dark")
        page.click("text=3D")
        page.wait_for_function("() => document.querySelector('.stage')?.dataset.whole === 'true'")
        page.emulate_media(color_scheme="light")
        page.click(".home")
        for name in (west, east):
            page.check(f'li[data-path="{name}"] input')
        page.wait_for_timeout(300)
        take(page, "folder", images)
        page.click(".actions >> text=Merge")
        page.wait_for_selector(".jobs li[data-state=done]", timeout=5 * WAIT)
        page.click(".jobs li[data-state=done] >> text=Open")
        page.wait_for_function("() => document.querySelector('.merge .plan-canvas')?.dataset.frames > 0")
        page.wait_for_timeout(500)
        take(page, "merge", images)


def paper_of(page: Any, x: float, y: float) -> list[float]:
    """A place in m on the paper of the plan."""
    [a, b, c, d, e, f] = page.evaluate("() => studio.plan.toPaper")
    return [a * x + b * y + c, d * x + e * y + f]


def main(words: Sequence[str]) -> None:
    """Take the pictures."""
    images = Path(words[0]) if words else IMAGES
    with tempfile.TemporaryDirectory() as folder:
        prepare_folder(Path(folder))
        photograph(Path(folder), images)


if __name__ == "__main__":
    main(sys.argv[1:])
