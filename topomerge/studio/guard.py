"""Who may use the studio, and for what: token, password, `Host`, `Origin` and the headers that keep scripts of strangers out."""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import secrets
import socket
from collections.abc import Mapping
from dataclasses import dataclass, field
from urllib.parse import parse_qs, urlencode, urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

LOOPBACK = "127.0.0.1"
LOOPBACK_NAMES = frozenset({LOOPBACK, "localhost", "[::1]"})
READING = ("GET", "HEAD")
OPENED = "/files/"  # pages, which have links to each other
PUBLIC = ("/login", "/page/report.css", "/page/studio.css")  # with a password: what the page that asks for it needs
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; connect-src 'self'; "
    "form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
)
# Pages of reports carry their scripts inside. They run in an origin of their own: they reach nothing of the studio.
REPORT_POLICY = (
    "sandbox allow-scripts allow-popups allow-downloads; default-src 'none'; style-src 'unsafe-inline'; "
    "script-src 'unsafe-inline'; img-src data:; base-uri 'none'; form-action 'none'"
)
NO_TOKEN = "Open the address that `topomerge studio` printed: it holds the token that this page asks for.\n"


@dataclass(frozen=True)
class Access:
    """Who is let in.

    Args:
        host: the address that the server is bound to.
        password: what a browser has to give; empty: the token of the address is enough, which only this machine sees.
        token: of the address that is printed.
        session: what the cookie holds once one is let in.
    """

    host: str = LOOPBACK
    password: str = ""
    token: str = field(default_factory=lambda: secrets.token_urlsafe(24))
    session: str = field(default_factory=lambda: secrets.token_urlsafe(32))

    @property
    def cookie(self) -> str:
        """Name of the cookie: two studios of one machine share their host, and must not share it."""
        return f"topomerge_{hashlib.sha256(self.session.encode()).hexdigest()[:12]}"

    def is_host_allowed(self, host: str) -> bool:
        """Return whether a name in `Host` is this machine's. A page from elsewhere could have its own name lead here."""
        name = (urlsplit(f"//{host}").hostname or "").lower() if host.isascii() else ""
        known = {urlsplit(f"//{n}").hostname for n in LOOPBACK_NAMES} | {self.host.lower()}
        if name in known:
            return True
        if self.host in (LOOPBACK, "localhost", "::1"):
            return False
        own = socket.gethostname().lower()
        return name in (own, f"{own}.local", socket.getfqdn().lower()) or _is_address(name)

    def is_password(self, given: str) -> bool:
        """Return whether it is the password. Takes as long whatever it is compared with."""
        digests = [hashlib.sha256(text.encode()).digest() for text in (given, self.password)]
        return bool(self.password) and hmac.compare_digest(*digests)

    def is_session(self, cookies: str) -> bool:
        """Return whether a `Cookie` header holds the session."""
        held = dict(part.strip().partition("=")[::2] for part in cookies.split(";"))
        return hmac.compare_digest(held.get(self.cookie, "").encode(), self.session.encode())

    def grant(self) -> Response:
        """Lead to the page, with the cookie: the token does not stay in the address bar."""
        answer = RedirectResponse("/", status_code=303)
        answer.set_cookie(self.cookie, self.session, httponly=True, samesite="lax", path="/")
        return answer

    def format_address(self, port: int) -> str:
        """Format the address that is opened in the browser."""
        host = LOOPBACK if self.host in ("0.0.0.0", "::") else self.host
        place = f"http://{f'[{host}]' if ':' in host else host}:{port}/"
        return place if self.password else f"{place}?{urlencode({'token': self.token})}"


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def find_refusal(access: Access, method: str, path: str, headers: Mapping[str, str]) -> tuple[int, str] | None:
    """Find why a request is refused: status and words; None where it may pass.

    Args:
        headers: of the request, with names in small letters.
    """
    host = headers.get("host", "")
    if not access.is_host_allowed(host):
        return 403, "This name is not one of the studio's machine.\n"
    origin = headers.get("origin")
    if method not in READING and origin is None:
        return 403, "A change needs an Origin.\n"
    if origin is not None and origin != f"http://{host}":
        return 403, "A page from elsewhere may not use the studio.\n"
    opened = path.startswith(OPENED) and headers.get("sec-fetch-mode") == "navigate"  # by a link elsewhere, which reads nothing
    if headers.get("sec-fetch-site", "none") == "cross-site" and path != "/" and not opened:
        return 403, "A page from elsewhere may not use the studio.\n"
    if not access.is_session(headers.get("cookie", "")) and not (access.password and path in PUBLIC):
        return 403, NO_TOKEN
    return None


class Guard:
    """Middleware around everything that the studio answers."""

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self.app, self.access = app, access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or refuse it."""
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        if scope["type"] != "http":  # there are no websockets
            return
        headers, path = Headers(scope=scope), scope["path"]

        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                _set_headers(MutableHeaders(scope=message))
            await send(message)

        refusal = find_refusal(self.access, scope["method"], path, headers)
        if refusal is not None and refusal[1] == NO_TOKEN and path == "/":
            given = parse_qs(scope["query_string"].decode("ascii", "replace")).get("token", [""])[0]
            if self.access.password:
                await RedirectResponse("/login", status_code=303)(scope, receive, send_guarded)
                return
            if hmac.compare_digest(given.encode(), self.access.token.encode()):
                await self.access.grant()(scope, receive, send_guarded)
                return
        if refusal is not None:
            await PlainTextResponse(refusal[1], status_code=refusal[0])(scope, receive, send_guarded)
            return
        await self.app(scope, receive, send_guarded)


def _set_headers(headers: MutableHeaders) -> None:
    headers.setdefault("content-security-policy", POLICY)
    headers["x-content-type-options"] = "nosniff"
    headers["referrer-policy"] = "no-referrer"
    headers["cross-origin-opener-policy"] = "same-origin"
    headers["cross-origin-resource-policy"] = "same-origin"
    headers.setdefault("cache-control", "no-store")
