"""A server of a report, for this machine only."""

from __future__ import annotations

import re
from collections.abc import Callable
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote, urlsplit

from topomerge.errors import InputError

HOME = "127.0.0.1"
ATLAS_REPORT = "report.html"
ATLAS_PAGES = re.compile(r"map_\d+(_tile_\d+)?\.html|report_stamp\.css")  # what the report of an atlas leads to, or looks for


class _Handler(SimpleHTTPRequestHandler):
    """Only the page, and of an atlas those that it leads to: what else lies beside it is nobody's business."""

    page: Path
    asked: Path

    def send_head(self) -> Any:
        host = (self.headers.get("Host") or "").rsplit(":", 1)[0]
        requested = unquote(urlsplit(self.path).path)
        if host not in (HOME, "localhost"):  # a page from elsewhere that had its own name lead here
            self.send_error(403)
            return None
        if requested == "/":
            self.send_response(302)
            self.send_header("Location", f"/{quote(self.page.name)}")
            self.send_header("Content-Length", "0")
            self.end_headers()
            return None
        name = requested.removeprefix("/")
        if name != self.page.name and not (ATLAS_PAGES.fullmatch(name) and self.page.name == ATLAS_REPORT):
            self.send_error(404)
            return None
        self.asked = self.page.with_name(name)
        return super().send_head()

    def translate_path(self, path: str) -> str:
        return str(self.asked)

    def log_message(self, format: str, *args: Any) -> None:
        pass


def serve(page: Path, port: int, tell: Callable[[str], object]) -> None:
    """Serve one page at http://127.0.0.1 until Ctrl-C.

    Args:
        page: an HTML file.
        port: 0 for any that is free.
        tell: is called with the address once it can be opened.

    Raises:
        InputError: the port is taken or not allowed.
    """
    handler = type("Handler", (_Handler,), {"page": page.resolve()})
    try:
        server = ThreadingHTTPServer((HOME, port), handler)
    except OSError as error:
        reason = error.strerror or str(error)
        raise InputError(f"--serve {port}: the port can't be used ({reason}); leave it out for a free one") from error
    with server:
        tell(f"http://{HOME}:{server.server_port}/{quote(page.name)}")
        try:
            server.serve_forever(poll_interval=0.2)
        except KeyboardInterrupt:
            return
