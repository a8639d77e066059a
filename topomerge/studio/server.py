"""The server of the studio: what the page asks for, and the events that it is told."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import socket
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from contextlib import asynccontextmanager
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs

import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, RedirectResponse, Response, StreamingResponse
from starlette.routing import Route

from topomerge.edits.journal import ConflictError
from topomerge.errors import InputError, make_printable
from topomerge.studio.folder import DIFF_PAGE, StudioFolder, UploadError, UploadLimits
from topomerge.studio.guard import REPORT_POLICY, Access, Guard
from topomerge.studio.maps import OpenMaps
from topomerge.studio.merges import Job, JobError, JobQueue, accept_placed, decide, describe_merge, place_pair

LARGEST_REQUEST = 1 << 20  # bytes of JSON
LOOK_EVERY = 2.0  # s between two looks at the folder
BEAT = 15.0  # s after which a silent stream of events says that it is there
MOST_WAITING = 1000  # events that a page may be behind
LOGIN_DELAY = 1.0  # s after a wrong password
SHUTDOWN = 2  # s that requests have to end
PAGE_FILES = {
    **dict.fromkeys(("studio.css", "studio.js", "api.js", "canvas.js", "editor.js", "tools.js"), "topomerge.studio.page"),
    **dict.fromkeys(("folder.js", "merge.js", "dom.js", "geometry.js"), "topomerge.studio.page"),
    **dict.fromkeys(("report.css", "plan.js", "camera.js", "cells.js", "scene.js"), "topomerge.viz.template"),
}
TYPES = {".js": "text/javascript", ".css": "text/css", ".html": "text/html"}
log = logging.getLogger(__name__)
Answer = Callable[[Request], Awaitable[Response]]


class Hub:
    """Events for the pages that are open."""

    def __init__(self) -> None:
        self._queues: set[asyncio.Queue[bytes | None]] = set()

    def publish(self, kind: str, **values: Any) -> None:
        """Tell all pages. One that is far behind is cut off: it connects and asks anew."""
        data = f"data: {json.dumps({'kind': kind, **values})}\n\n".encode()
        for queue in list(self._queues):
            if queue.qsize() >= MOST_WAITING:
                self._queues.discard(queue)
                queue.put_nowait(None)
            else:
                queue.put_nowait(data)

    def close(self) -> None:
        """End all streams."""
        for queue in list(self._queues):
            queue.put_nowait(None)

    @property
    def pages(self) -> int:
        """Number of pages that listen."""
        return len(self._queues)

    async def stream(self) -> AsyncIterator[bytes]:
        """Yield the events from now on."""
        queue: asyncio.Queue[bytes | None] = asyncio.Queue()
        self._queues.add(queue)
        try:
            yield b"retry: 1000\n\n"
            while True:
                try:
                    data = await asyncio.wait_for(queue.get(), BEAT)
                except TimeoutError:
                    data = b": still here\n\n"
                if data is None:
                    return
                yield data
        finally:
            self._queues.discard(queue)


class Studio:
    """The application: a folder, its open maps, its jobs and its pages."""

    def __init__(self, root: str | Path, access: Access | None = None, limits: UploadLimits | None = None) -> None:
        self.folder, self.access = StudioFolder(root, limits), access or Access()
        self.hub, self.maps = Hub(), OpenMaps()
        self.jobs = JobQueue(self.folder.root, self._tell_job)
        self._login = asyncio.Lock()
        routes: list[tuple[str, str, Answer]] = [
            ("/", "GET", self.show_page),
            ("/login", "GET", self.show_login),
            ("/login", "POST", self.log_in),
            ("/page/{name}", "GET", self.send_page_file),
            ("/api/folder", "GET", self.list_folder),
            ("/api/events", "GET", self.send_events),
            ("/api/files/{name}", "PUT", self.receive_file),
            ("/api/jobs", "POST", self.add_job),
            ("/api/jobs/{number:int}", "DELETE", self.cancel_job),
            ("/api/plan/{path:path}", "GET", self.send_plan),
            ("/api/scene/{path:path}", "GET", self.send_scene),
            ("/api/report/{path:path}", "GET", self.send_report),
            ("/api/edits/{path:path}", "POST", self.edit_map),
            ("/api/merge/{path:path}", "GET", self.send_merge),
            ("/api/decide/{path:path}", "POST", self.decide_merge),
            ("/api/place", "POST", self.place_maps),
            ("/files/{path:path}", "GET", self.send_file),
        ]
        app = Starlette(
            routes=[Route(path, _catch(answer), methods=[method]) for path, method, answer in routes], lifespan=self._live
        )
        self.app = Guard(app, self.access)

    @asynccontextmanager
    async def _live(self, _: Starlette) -> AsyncIterator[None]:
        watcher = asyncio.create_task(self._watch())
        try:
            yield
        finally:
            self.hub.close()
            watcher.cancel()
            await self.jobs.close()

    async def _watch(self) -> None:
        """Tell the pages what changes in the folder, whoever changes it."""
        last = await run_in_threadpool(self.folder.compute_signature)
        while True:
            await asyncio.sleep(LOOK_EVERY)
            if not self.hub.pages:
                continue
            now = await run_in_threadpool(self.folder.compute_signature)
            if now != last:
                last = now
                self.hub.publish("folder")

    def _tell_job(self, job: Job) -> None:
        self.hub.publish("job", job=job.describe())
        if job.state in ("done", "failed", "cancelled"):
            self.hub.publish("folder")

    # The page.

    async def show_page(self, _: Request) -> Response:
        """Send the page itself."""
        return _send_package_file("topomerge.studio.page", "studio.html")

    async def show_login(self, _: Request) -> Response:
        """Send the page that asks for the password."""
        return _send_package_file("topomerge.studio.page", "login.html")

    async def log_in(self, request: Request) -> Response:
        """Let in who knows the password; those who guess wait."""
        given = (await _read_body(request)).decode("utf-8", "replace")
        async with self._login:
            if self.access.is_password(parse_qs(given).get("password", [""])[0]):
                return self.access.grant()
            await asyncio.sleep(LOGIN_DELAY)
        return RedirectResponse("/login?wrong", status_code=303)

    async def send_page_file(self, request: Request) -> Response:
        """Send a script or style sheet of the page."""
        name = request.path_params["name"]
        if name not in PAGE_FILES:
            return JSONResponse({"error": "no such file"}, 404)
        return _send_package_file(PAGE_FILES[name], name)

    async def send_events(self, _: Request) -> Response:
        """Stream the events from now on."""
        return StreamingResponse(self.hub.stream(), media_type="text/event-stream")

    # The folder.

    async def list_folder(self, _: Request) -> Response:
        """List the entries of the folder, and the jobs."""
        entries = await run_in_threadpool(self.folder.list_entries)
        return JSONResponse(
            {"name": self.folder.root.name, "entries": entries, "jobs": [job.describe() for job in self.jobs.jobs.values()]}
        )

    async def receive_file(self, request: Request) -> Response:
        """Add a file."""
        length = request.headers.get("content-length", "")
        number = int(length) if length.isdecimal() else None
        path = await self.folder.receive(request.path_params["name"], number, request.stream())
        self.hub.publish("folder")
        return JSONResponse({"path": self.folder.name(path)}, 201)

    async def send_file(self, request: Request) -> Response:
        """Send a page of the folder, in an origin of its own; or a map, to be saved."""
        path = self.folder.resolve(request.path_params["path"])
        if path.suffix.lower() in (".html", ".htm"):
            return FileResponse(path, media_type="text/html", headers={"content-security-policy": REPORT_POLICY})
        if path.suffix.lower() in (".tmap", ".json", ".jsonl") and path.is_file():
            return FileResponse(path, media_type="application/octet-stream", filename=path.name)
        raise InputError(f"{request.path_params['path']}: no such page in the folder")

    # Jobs.

    async def add_job(self, request: Request) -> Response:
        """Extract, merge or compare."""
        wish = await _read_json(request)
        paths = [self.folder.resolve(path) for path in _check_paths(wish.get("paths"))]
        kind, place = str(wish.get("kind")), self.folder.find_free(" + ".join(path.stem for path in paths)[:100])
        if kind == "merge" and "matrix" in wish:
            await run_in_threadpool(accept_placed, self.maps, paths, place, wish)
        return JSONResponse({"job": self._add_job(kind, paths, place).describe()}, 202)

    def _add_job(self, kind: str, paths: list[Path], place: Path) -> Job:
        names = [self.folder.format_word(path) for path in paths]
        title = " + ".join(path.name for path in paths)
        if kind == "extract" and len(paths) == 1:
            output = self.folder.find_map_path(paths[0])
            extracting = ("extract", names[0], "-o", self.folder.format_word(output))
            return self.jobs.add(kind, title, extracting, self.folder.name(output))
        if kind == "merge" and len(paths) > 1:
            return self.jobs.add(kind, title, ("merge", *names, "-o", self.folder.format_word(place)), place.name, (0, 2))
        if kind == "compare" and len(paths) == 2:
            output = self.folder.find_free(f"{paths[0].stem[:50]} to {paths[1].stem[:50]}")
            comparing = ("diff", *names, "-o", self.folder.format_word(output))
            return self.jobs.add(kind, title, comparing, f"{output.name}/{DIFF_PAGE}")
        raise InputError(f"{kind[:40]}: of {len(paths)} files can't be done; choose others")

    async def cancel_job(self, request: Request) -> Response:
        """End a job."""
        return JSONResponse({"cancelled": await self.jobs.cancel(request.path_params["number"])})

    # Maps.

    def _resolve_map(self, request: Request) -> Path:
        path = self.folder.resolve(request.path_params["path"])
        if path.suffix.lower() != ".tmap" or not path.is_file():
            raise InputError(f"{request.path_params['path']}: is no map; choose a .tmap")
        return path

    async def send_plan(self, request: Request) -> Response:
        """Send the plans of a map, corrected; with `?quick` perhaps only that of the lowest storey."""
        held = await run_in_threadpool(self.maps.load, self._resolve_map(request), "quick" in request.query_params)
        return Response(held.plan, media_type="application/json")

    async def send_scene(self, request: Request) -> Response:
        """Send the cells of a map, for the 3D view."""
        return Response(
            await run_in_threadpool(self.maps.render_scene, self._resolve_map(request)), media_type="application/json"
        )

    async def send_report(self, request: Request) -> Response:
        """Send the page of a map, to be sent to others."""
        path = self._resolve_map(request)
        page = await run_in_threadpool(self.maps.render_report, path)
        answer = Response(page, media_type="application/octet-stream")
        answer.headers["content-disposition"] = f'attachment; filename="{path.stem.encode("ascii", "replace").decode()}.html"'
        return answer

    async def edit_map(self, request: Request) -> Response:
        """Make one correction. Another page that shows the map is told."""
        path, wish = self._resolve_map(request), await _read_json(request)
        version = wish.get("version")
        if not isinstance(version, int) or not isinstance(wish.get("edit"), dict):
            raise InputError("an edit needs the version of the journal that it is made for")
        held = await run_in_threadpool(self.maps.edit, path, wish["edit"], version)
        self.hub.publish("map", path=self.folder.name(path), version=held.version)
        return Response(held.plan, media_type="application/json")

    # Merges.

    def _resolve_merge(self, request: Request) -> Path:
        path = self.folder.resolve(request.path_params["path"])
        if not (path / "merge.json").is_file():
            raise InputError(f"{request.path_params['path']}: is no folder of a merge")
        return path

    async def send_merge(self, request: Request) -> Response:
        """Send the verdict of a merge with its evidence, and how its maps lie."""
        path = self._resolve_merge(request)
        return JSONResponse(await run_in_threadpool(describe_merge, self.folder, self.maps, path))

    async def decide_merge(self, request: Request) -> Response:
        """Accept or reject a merge, or place a map of it: a line of its journal; then it is merged anew."""
        path, wish = self._resolve_merge(request), await _read_json(request)
        arguments = await run_in_threadpool(decide, self.folder, path, wish)
        self.hub.publish("merge", path=self.folder.name(path))
        job = self.jobs.add("merge", path.name, arguments, self.folder.name(path), (0, 2)) if arguments else None
        return JSONResponse({"job": job.describe() if job else None}, 202)

    async def place_maps(self, request: Request) -> Response:
        """Send where a map lies on another, from pairs of places or a pose, refined by their walls."""
        wish = await _read_json(request)
        paths = [self.folder.resolve(path) for path in _check_paths(wish.get("paths"))]
        return JSONResponse(await run_in_threadpool(place_pair, self.maps, paths, wish))


def _catch(answer: Answer) -> Answer:
    """Answer what goes wrong in one line."""

    async def answer_guarded(request: Request) -> Response:
        try:
            return await answer(request)
        except ConflictError as error:
            return JSONResponse({"error": str(error), "version": error.version}, 409)
        except UploadError as error:
            return JSONResponse({"error": make_printable(str(error))}, error.status)
        except (InputError, JobError) as error:
            return JSONResponse({"error": make_printable(str(error))}, 400)
        except Exception as error:
            log.exception("the studio could not answer %s", request.url.path)
            return JSONResponse({"error": f"unexpected {type(error).__name__}: see the terminal"}, 500)

    return answer_guarded


def _send_package_file(package: str, name: str) -> Response:
    text = files(package).joinpath(name).read_bytes()
    return Response(text, media_type=TYPES[Path(name).suffix])


async def _read_body(request: Request) -> bytes:
    body = b""
    async for block in request.stream():
        body += block
        if len(body) > LARGEST_REQUEST:
            raise UploadError("the request is too large", 413)
    return body


async def _read_json(request: Request) -> Mapping[str, Any]:
    body = await _read_body(request)
    try:
        wish = json.loads(body)
    except (ValueError, RecursionError) as error:
        raise InputError(f"the request is no JSON ({str(error)[:80]})") from error
    if not isinstance(wish, dict):
        raise InputError("the request is no table")
    return wish


def _check_paths(paths: Any) -> list[str]:
    if not isinstance(paths, list) or not 0 < len(paths) <= 100 or not all(isinstance(path, str) for path in paths):
        raise InputError("the request names no files")
    return paths


def serve_studio(studio: Studio, port: int, tell: Callable[[str], object]) -> None:
    """Serve until Ctrl-C. Jobs that run are ended.

    Args:
        studio: what is served.
        port: 0 for any that is free.
        tell: is called with the address once it can be opened.

    Raises:
        InputError: the port is taken or not allowed, or the host is none of this machine's.
    """
    host = studio.access.host
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        listening = socket.socket(family)
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind((host, port))
        listening.listen(128)
    except OSError as error:
        raise InputError(
            f"--port {port}: {host} can't be used ({error.strerror or error}); leave it out for a free one"
        ) from error
    settings = uvicorn.Config(
        studio.app, log_level="error", access_log=False, server_header=False, timeout_graceful_shutdown=SHUTDOWN, lifespan="on"
    )
    with listening, contextlib.suppress(KeyboardInterrupt):
        tell(studio.access.format_address(listening.getsockname()[1]))
        _Server(settings, studio.hub).run(sockets=[listening])


class _Server(uvicorn.Server):
    """Streams of events would keep it from ending: they are ended first."""

    def __init__(self, config: uvicorn.Config, hub: Hub) -> None:
        super().__init__(config)
        self.hub = hub

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """End the streams, then the server."""
        self.hub.close()
        await super().shutdown(sockets)
