"""A Chromium without a window that is told what to do over its debugging port: for what only shows in real time."""

from __future__ import annotations

import asyncio
import base64
import json
import shutil
import subprocess
import time
import urllib.request
from pathlib import Path
from typing import Any

import pytest

BROWSER_NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    *("--remote-debugging-port=0", "--remote-allow-origins=*", "--window-size=1440,1500"),
)

LEFT = "Inspected target navigated or closed"  # what the browser says of it


def browser() -> str:
    """The program; the test is skipped where there is none."""
    for name in BROWSER_NAMES:
        path = shutil.which(name)
        if path:
            return path
    pytest.skip("no Chromium here: apt-get install chromium")


class Page:
    """A page in a browser of its own.

    Args:
        path: an HTML file.
        profile: a folder for the browser, which is made.
    """

    def __init__(self, path: Path, profile: Path, *flags: str) -> None:
        words = [browser(), *FLAGS, *flags, f"--user-data-dir={profile}", "about:blank"]
        self.console: list[str] = []  # errors and warnings
        self.loop = asyncio.new_event_loop()
        self.process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            self.socket = self.loop.run_until_complete(self._connected(profile / "DevToolsActivePort"))
            self.number = 0
            for what in ("Page", "Runtime", "Log"):
                self.call(f"{what}.enable")
            self.call("Page.navigate", url=path.as_uri())
            self.wait("document.readyState === 'complete'")
        except BaseException:
            self.close()
            raise

    async def _connected(self, port_file: Path) -> Any:
        from tornado.websocket import websocket_connect

        end = time.monotonic() + 60
        while not port_file.exists() or "\n" not in port_file.read_text():
            assert time.monotonic() < end, "the browser does not start"
            await asyncio.sleep(0.1)
        port = port_file.read_text().split("\n")[0]
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=60) as answer:
            (tab,) = (one for one in json.load(answer) if one["type"] == "page")
        return await websocket_connect(tab["webSocketDebuggerUrl"], max_message_size=1 << 28)

    def call(self, method: str, **words: Any) -> dict[str, Any]:
        """A command of the Chrome DevTools protocol and what it answers."""
        self.number += 1
        return self.loop.run_until_complete(asyncio.wait_for(self._answer(method, words), 120))

    async def _answer(self, method: str, words: dict[str, Any]) -> dict[str, Any]:
        await self.socket.write_message(json.dumps({"id": self.number, "method": method, "params": words}))
        while True:
            message = json.loads(await self.socket.read_message())
            self._note(message)
            if message.get("id") == self.number:
                assert "error" not in message, f"{method}: {message['error']}"
                return dict(message["result"])

    def _note(self, message: dict[str, Any]) -> None:
        words = message.get("params", {})
        if message.get("method") == "Runtime.consoleAPICalled" and words["type"] in ("error", "warning"):
            self.console.append(" ".join(str(a.get("value")) for a in words["args"]))
        elif message.get("method") == "Runtime.exceptionThrown":
            self.console.append(str(words["exceptionDetails"]))
        elif message.get("method") == "Log.entryAdded" and words["entry"]["level"] in ("error", "warning"):
            self.console.append(words["entry"]["text"])

    def run(self, script: str) -> Any:
        """The value of an expression, or what it promises."""
        reply = self.call("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in reply, reply["exceptionDetails"]
        return reply["result"].get("value")

    def wait(self, condition: str, seconds: float = 60.0) -> None:
        """Until an expression is true."""
        end = time.monotonic() + seconds
        while not self._holds(condition):
            assert time.monotonic() < end, f"not within {seconds:g} s: {condition}"
            time.sleep(0.1)

    def _holds(self, condition: str) -> bool:
        """Is an expression true? Of a page that loads itself anew meanwhile nothing is."""
        try:
            return bool(self.run(condition))
        except AssertionError as failure:
            if LEFT not in str(failure):
                raise
            return False

    def theme(self, name: str) -> None:
        """As if the machine's were "light" or "dark"."""
        self.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": name}])

    def picture(self, path: Path) -> None:
        """The whole page as PNG."""
        size = self.call("Page.getLayoutMetrics")["cssContentSize"]
        reply = self.call("Page.captureScreenshot", captureBeyondViewport=True, clip={**size, "scale": 1})
        path.write_bytes(base64.b64decode(reply["data"]))

    def printed(self, path: Path) -> None:
        """The page as PDF, on A4."""
        reply = self.call("Page.printToPDF", printBackground=False, paperWidth=8.27, paperHeight=11.69)
        path.write_bytes(base64.b64decode(reply["data"]))

    def close(self) -> None:
        """End the browser."""
        self.process.kill()
        self.process.wait()
        self.loop.close()

    def __enter__(self) -> Page:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
