"""The page of `topomerge studio` in a browser: seconds to the first plan, frames a second while one pans, seconds of an edit.

``python -m benchmarks.speed.studio [rooms ...]``: storeys of a corridor between two rows of rooms, of so many rooms in all. The
browser draws without a graphics card, as on the machines that test.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tests.scenes_map import building
from tests.studio.browser import MapPage, open_browser, run_studio
from topomerge.io.maps import save_map

SIZES = (10, 1000)  # rooms
PAIRS = 50  # of rooms along a corridor of a large building
PANNED = 3.0  # s
PAN = """async (seconds) => {
  const { canvas } = studio, target = canvas.canvas, box = target.getBoundingClientRect();
  const next = () => new Promise(requestAnimationFrame), pointer = { bubbles: true, pointerId: 7, button: 0 };
  const at = (type, x, y) => target.dispatchEvent(new PointerEvent(type, { ...pointer, clientX: x, clientY: y }));
  target.setPointerCapture = () => {};
  const [cx, cy] = [box.x + box.width / 2, box.y + box.height / 2], took = [];
  at("pointerdown", cx, cy);
  const began = performance.now(), first = canvas.frames;
  let last = began;
  for (let k = 0; last - began < 1000 * seconds; k++) {
    at("pointermove", cx + 300 * Math.sin(k / 20), cy + 150 * Math.sin(k / 13));
    await next();
    const now = performance.now();
    took.push(now - last);
    last = now;
  }
  at("pointerup", cx, cy);
  took.sort((a, b) => a - b);
  return { frames: (1000 * (canvas.frames - first)) / (last - began), slow: took[Math.floor(0.95 * took.length)] };
}"""


def measure(rooms: int) -> dict[str, float]:
    """Measure the page of a building with about so many rooms: s, frames a second and ms."""
    pairs = min(PAIRS, max((rooms - 1) // 2, 1))
    with tempfile.TemporaryDirectory() as folder:
        save_map(building(pairs, max(round(rooms / (2 * pairs + 1)), 1)), Path(folder) / "large.tmap")
        with run_studio(Path(folder)) as (address, _), open_browser() as context:
            page = context.new_page()
            page.goto(address)
            page.wait_for_selector("li[data-path]")
            page.close()
            began = time.perf_counter()
            one = MapPage(context, address, "large.tmap")
            opened = time.perf_counter() - began
            return {"rooms": one.page.evaluate("() => studio.plan.rooms"), "first plan": opened, **_pan(one), **_edit(one)}


def _pan(one: MapPage) -> dict[str, float]:
    whole = one.page.evaluate(PAN, PANNED)
    one.page.evaluate("() => { studio.canvas.zoom(4); }")
    time.sleep(1)
    near = one.page.evaluate(PAN, PANNED)
    one.page.evaluate("() => studio.canvas.fit()")
    return {"frames, all": whole["frames"], "frames, near": near["frames"], "slowest 5 %, ms": max(whole["slow"], near["slow"])}


def _edit(one: MapPage) -> dict[str, float]:
    """Seconds from sending an edit until it is drawn."""
    took, wish = {}, "wish => studio.edit(wish)"
    room = one.room(2)
    middle, (left, top, right, bottom) = [room["x"], room["y"]], room["box"]
    line = [[(left + right) / 2, top], [(left + right) / 2, bottom]]
    edits: list[tuple[str, dict[str, Any]]] = [
        ("rename", {"op": "rename_room", "at": middle, "name": "Office"}),
        ("split", {"op": "split_room", "at": [middle[0] + 40, middle[1]], "line": line}),
    ]
    for version, (name, values) in enumerate(edits, 1):
        one.page.evaluate(wish, values)
        one.wait_version(version)
        took[name] = int(one.page.evaluate("() => document.getElementById('view').dataset.took")) / 1000
    one.page.evaluate("() => studio.undo()")
    one.wait_version(len(edits) + 1)
    took["undo"] = int(one.page.evaluate("() => document.getElementById('view').dataset.took")) / 1000
    return took


def main(rooms: Sequence[int] = SIZES) -> None:
    """Print a row of the table for each size."""
    rows = [measure(count) for count in rooms]
    print("| rooms | first plan, s | frames/s, all in view | frames/s, near | slowest 5 %, ms | rename, s | split, s | undo, s |")
    print("|---|---|---|---|---|---|---|---|")
    for row in rows:
        print("| " + " | ".join(f"{v:,.0f}" if v >= 10 else f"{v:.2f}" for v in row.values()) + " |")


if __name__ == "__main__":
    main([int(word) for word in sys.argv[1:]] or SIZES)
