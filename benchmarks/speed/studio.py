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

import psutil

from tests.scenes_map import building
from tests.studio.browser import MapPage, open_context, run_studio, start_browser
from topomerge.io.maps import save_map
from topomerge.progress import Stopwatch

SIZES = (10, 1000)  # rooms
PAIRS = 50  # of rooms along a corridor of a large building
PANNED = 3.0  # s
PAN = """async (seconds) => {
  const { canvas } = studio, target = canvas.canvas, box = target.getBoundingClientRect();
  const next = () => new Promise(requestAnimationFrame), pointer = { bubbles: true, pointerId: 7, button: 0 };
  const at = (type, x, y) => target.dispatchEvent(new PointerEvent(type, { ...pointer, clientX: x, clientY: y }));
  target.setPointerCapture = () => {};
  const [cx, cy] = [box.x + box.width / 2, box.y + box.height / 2];
  at("pointerdown", cx, cy);
  const began = performance.now(), first = canvas.frames;
  let last = began;
  for (let k = 0; last - began < 1000 * seconds; k++) {
    at("pointermove", cx + 300 * Math.sin(k / 20), cy + 150 * Math.sin(k / 13));
    await next();
    last = performance.now();
  }
  at("pointerup", cx, cy);
  return { frames: canvas.frames - first, rate: (1000 * (canvas.frames - first)) / (last - began) };
}"""


def measure(rooms: int) -> dict[str, float]:
    """Measure the page of a building with about so many rooms: s, frames a second, and ms of CPU a frame."""
    pairs = min(PAIRS, max((rooms - 1) // 2, 1))
    with tempfile.TemporaryDirectory() as folder:
        save_map(building(pairs, max(round(rooms / (2 * pairs + 1)), 1)), Path(folder) / "large.tmap")
        with run_studio(Path(folder)) as (address, server), start_browser() as chromium, open_context(chromium) as context:
            page = context.new_page()
            page.goto(address)
            page.wait_for_selector("li[data-path]")
            page.close()
            process, watch = psutil.Process(server.pid), Stopwatch()
            used = _sum_cpu([process])
            one = MapPage(context, address, "large.tmap")
            took = {"first plan": watch.elapsed, "first plan, CPU": _sum_cpu([process]) - used}
            one.page.wait_for_function("() => studio.plan.whole")
            count = {"rooms": one.page.evaluate("() => studio.plan.rooms")}
            return {**count, **took, **_pan(one), **_edit(one, process)}


def _sum_cpu(processes: Sequence[psutil.Process]) -> float:
    """Sum the seconds of CPU that processes have used."""
    return sum(t.user + t.system for t in (p.cpu_times() for p in processes if p.is_running()))


def _pan(one: MapPage) -> dict[str, float]:
    """Measure frames a second with all rooms in view and near, and ms of CPU of the whole browser for one."""
    browser = [p for p in psutil.Process().children(recursive=True) if "chrom" in p.name()]
    used, rows = _sum_cpu(browser), []
    for zoom in (1, 4):
        one.page.evaluate("k => { studio.canvas.zoom(k); }", zoom)
        time.sleep(1)
        rows.append(one.page.evaluate(PAN, PANNED))
    one.page.evaluate("() => studio.canvas.fit()")
    total = sum(row["frames"] for row in rows)
    return {
        "frames/s, all": rows[0]["rate"],
        "frames/s, near": rows[1]["rate"],
        "CPU ms a frame": 1000 * (_sum_cpu(browser) - used) / total,
    }


def _edit(one: MapPage, server: psutil.Process) -> dict[str, float]:
    """Measure the seconds from sending an edit until it is drawn, and of the server's CPU."""
    took: dict[str, float] = {}
    room = one.room(2)
    middle, (left, top, right, bottom) = [room["x"], room["y"]], room["box"]
    line = [[(left + right) / 2, top], [(left + right) / 2, bottom]]
    edits: list[tuple[str, dict[str, Any]]] = [
        ("rename", {"op": "rename_room", "at": middle, "name": "Office"}),
        ("split", {"op": "split_room", "at": [middle[0] + 40, middle[1]], "line": line}),
        ("undo", {"op": "undo"}),
    ]
    for version, (name, wish) in enumerate(edits, 1):
        used = _sum_cpu([server])
        one.page.evaluate("wish => wish.op === 'undo' ? studio.undo() : studio.edit(wish)", wish)
        one.wait_version(version)
        took[name] = int(one.page.evaluate("() => document.getElementById('view').dataset.took")) / 1000
        took[f"{name}, CPU"] = _sum_cpu([server]) - used
    return took


def main(rooms: Sequence[int] = SIZES) -> None:
    """Print a column of the table for each size."""
    columns = [measure(count) for count in rooms]
    print("| |" + "".join(f" {column['rooms']:,} rooms |" for column in columns) + f"\n|---{'|---' * len(columns)}|")
    for name in list(columns[0])[1:]:
        values = [column[name] for column in columns]
        print(f"| {name} | " + " | ".join(f"{v:,.0f}" if v >= 10 else f"{v:.2f}" for v in values) + " |")


if __name__ == "__main__":
    main([int(word) for word in sys.argv[1:]] or SIZES)
