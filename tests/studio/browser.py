"""The studio in a real browser: a server of its own, Chromium driven by playwright, and where things lie on its plans."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.viz.chromium import browser

FLAGS = (
    "--no-sandbox",
    "--disable-gpu",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
)  # as on machines without a card
WAIT = 60_000  # ms, for a machine that does much else
STOREY = """() => {
  const { rooms, doors, windows, landmarks } = studio.canvas.data;
  return { rooms: rooms.map(({ path, rings, ...one }) => one), doors, windows, landmarks };
}"""
STORED = "document.getElementById('view').dataset"


@contextmanager
def run_studio(folder: Path, *words: str) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """The address of a studio of a folder, and its process."""
    command = [sys.executable, "-m", "topomerge", "studio", str(folder), "--no-browser", *words]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        yield process.stdout.readline().strip(), process
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        process.wait(60)


@contextmanager
def start_browser() -> Iterator[Any]:
    """A browser, which starts in a second or two; each test has a context of its own."""
    sync_api = pytest.importorskip("playwright.sync_api")
    program = browser()
    with sync_api.sync_playwright() as driver:
        chromium = driver.chromium.launch(executable_path=program, args=list(FLAGS))
        yield chromium
        chromium.close()


@contextmanager
def open_context(chromium: Any, **settings: Any) -> Iterator[Any]:
    """A context of a browser; what its pages complain of fails the test."""
    complaints: list[str] = []
    context = chromium.new_context(**{"viewport": {"width": 1280, "height": 800}, **settings})
    context.set_default_timeout(WAIT)
    context.on("weberror", lambda error: complaints.append(str(error.error)))
    context.on("console", lambda message: complaints.append(message.text) if message.type == "error" else None)
    try:
        yield context
    finally:
        context.close()
    expected = ("status of 409", "status of 400", "net::ERR_")  # that a test asks for, and a server that has ended
    assert not [line for line in complaints if not any(words in line for words in expected)], complaints


class MapPage:
    """A page that shows the editor of one map."""

    def __init__(self, context: Any, address: str, path: str) -> None:
        self.page = context.new_page()
        self.page.goto(address)
        self.page.evaluate("path => { location.hash = `#/map/${path}`; }", path)
        self.wait_version(None)

    def wait_version(self, version: int | None) -> None:
        """Until the page shows a version of the journal; None: any."""
        condition = f"{STORED}.version !== undefined" if version is None else f"{STORED}.version === '{version}'"
        self.page.wait_for_function(f"() => {condition} && !{STORED}.busy")

    def point(self, x: float, y: float) -> tuple[float, float]:
        """Where a place on the paper is on the screen."""
        box = self.page.locator(".plan-canvas").bounding_box()
        u, v = self.page.evaluate("p => studio.canvas.toScreen(p)", [x, y])
        return box["x"] + u, box["y"] + v

    def click(self, x: float, y: float, **options: Any) -> None:
        """Click a place on the paper."""
        self.page.mouse.move(*self.point(x, y))
        self.page.mouse.click(*self.point(x, y), **options)

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        """Drag from one place on the paper to another."""
        self.page.mouse.move(*self.point(*start))
        self.page.mouse.down()
        self.page.mouse.move(*self.point(*end), steps=5)
        self.page.mouse.up()

    def press(self, *keys: str) -> None:
        """Press keys, one after the other."""
        for key in keys:
            self.page.keyboard.press(key)

    @property
    def storey(self) -> dict[str, Any]:
        """What the page has of the storey that it shows."""
        listed: dict[str, Any] = self.page.evaluate(STOREY)
        return listed

    def room(self, i: int) -> dict[str, Any]:
        """A room, by its number."""
        return next(room for room in self.storey["rooms"] if room["i"] == i)
