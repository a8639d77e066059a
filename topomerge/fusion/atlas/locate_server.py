"""A server that tells robots where they are, and its client: a line of JSON asks, a line of JSON answers.

| line | answer |
|---|---|
| `{"points": [[x, y, z], …], "place": [x, y, z], "id": …}` | `{"id": …, "status": "located", …}` (`Location.serialise`) |
| `{"ranges": […], "angle_min": …, "angle_increment": …, "height": …}` | the same, of a slice of a laser |
| either, and `"landmarks": [{"kind": "text", "value": "2.113", "position": [x, y, z]}, …]` | the same, by these, too |
| anything else | `{"id": …, "error": "…"}`; the connection stays open unless a line is too long |
"""

from __future__ import annotations

import json
import selectors
import socket
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.errors import InputError
from topomerge.fusion.atlas.locate import LOCATE, LocateSettings, locate
from topomerge.fusion.atlas.place_index import PlaceIndex, open_index
from topomerge.io.landmarks import parse_landmarks
from topomerge.types import Array, Landmarks, PointCloud

LONGEST_LINE = 16 << 20  # bytes
MOST_CLIENTS = 32
MOST_POINTS = 400_000
IDLE_SECONDS = 60.0  # after which a silent client is let go
SEND_SECONDS = 10.0  # that a client may take to read its answer
BLOCK = 1 << 16  # bytes that are read at once
FARTHEST = 1e5  # m
BACK_OFF = 0.2  # s, at most, until a stop is heard


class LocateServer:
    """Serves an atlas until it is stopped; one scan is located at a time, so that memory and cores stay bounded.

    Args:
        atlas: a folder, or an index.
        host, port: where it listens; port 0: any free one.
        settings: of `locate`.

    Raises:
        InputError: no atlas, or the address is taken.
    """

    def __init__(
        self, atlas: str | Path | PlaceIndex, host: str = "127.0.0.1", port: int = 0, settings: LocateSettings = LOCATE
    ) -> None:
        self.index = atlas if isinstance(atlas, PlaceIndex) else open_index(atlas)
        self.settings = settings
        self.answered = 0
        self._stopped = threading.Event()
        self._clients: dict[socket.socket, tuple[bytearray, float]] = {}
        try:
            self._listener = socket.create_server((host, port))
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or error
            raise InputError(f"{host}:{port}: can't listen there ({reason}); give another --port") from error
        self._listener.setblocking(False)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)

    def __enter__(self) -> LocateServer:
        return self

    def __exit__(self, *_: object) -> None:
        for client in list(self._clients):
            self._drop(client)
        self._selector.close()
        self._listener.close()

    @property
    def address(self) -> tuple[str, int]:
        """Host and port."""
        host, port = self._listener.getsockname()[:2]
        return str(host), int(port)

    def stop(self) -> None:
        """End `serve`, from another thread."""
        self._stopped.set()

    def serve(self) -> None:
        """Answer until `stop`."""
        while not self._stopped.is_set():
            for key, _ in self._selector.select(BACK_OFF):
                if key.fileobj is self._listener:
                    self._accept()
                elif isinstance(key.fileobj, socket.socket):
                    self._hear(key.fileobj)
            now = time.monotonic()
            for client in [c for c, (_, last) in self._clients.items() if now - last > IDLE_SECONDS]:
                self._drop(client)

    def _accept(self) -> None:
        try:
            client, _ = self._listener.accept()
        except OSError:  # it went away again
            return
        if len(self._clients) >= MOST_CLIENTS:
            self._send(client, {"error": f"{MOST_CLIENTS} clients are connected already; try again later"})
            client.close()
            return
        client.settimeout(SEND_SECONDS)
        self._clients[client] = bytearray(), time.monotonic()
        self._selector.register(client, selectors.EVENT_READ)

    def _hear(self, client: socket.socket) -> None:
        held, _ = self._clients[client]
        try:
            block = client.recv(BLOCK)
        except OSError:
            block = b""
        if not block:
            self._drop(client)
            return
        held += block
        while (end := held.find(b"\n")) >= 0 and client in self._clients:
            line = bytes(held[:end])
            del held[: end + 1]
            if line.strip() and not self._send(client, self._answer(line)):
                self._drop(client)
        if client in self._clients:
            self._clients[client] = held, time.monotonic()
            if len(held) > LONGEST_LINE:
                self._send(client, {"error": f"a line may have {LONGEST_LINE} bytes; send fewer points"})
                self._drop(client)

    def _answer(self, line: bytes) -> dict[str, Any]:
        if len(line) > LONGEST_LINE:
            return {"error": f"a line may have {LONGEST_LINE} bytes; send fewer points"}
        name: Any = None
        try:
            asked = json.loads(line)
            if not isinstance(asked, dict):
                raise InputError("a line must be a JSON object with points or ranges")
            name = asked.get("id") if isinstance(asked.get("id"), str | int) else None
            answer = locate(self.index, read_request(asked), self.settings).serialise()
            self.answered += 1
        except InputError as error:
            answer = {"error": str(error)[:500]}
        except (ValueError, RecursionError):
            answer = {"error": "the line is no JSON; send an object with points or ranges, and a line end"}
        return answer if name is None else {"id": name, **answer}

    def _send(self, client: socket.socket, answer: Mapping[str, Any]) -> bool:
        try:
            client.sendall(json.dumps(answer).encode() + b"\n")
        except OSError:
            return False
        return True

    def _drop(self, client: socket.socket) -> None:
        del self._clients[client]
        self._selector.unregister(client)
        client.close()


def read_request(asked: Mapping[str, Any]) -> PointCloud:
    """Read the scan of a request.

    Raises:
        InputError: names the key.
    """
    wrong = [key for key in asked if key not in (*KEYS, *LASER, *UNUSED_OF_ROS)]
    if wrong:
        raise InputError(f"{wrong[0][:40]}: is no key; the keys are {', '.join((*KEYS, *LASER))}")
    if not isinstance(asked.get("id"), str | int | None):
        raise InputError("id: must be a whole number or a string")
    if "ranges" in asked:
        points, place = read_laser(asked), np.zeros(3)
        place[2] = points[0, 2] if len(points) else 0.0
    else:
        points, place = _read_numbers(asked, "points", 3), None
        if "place" in asked:
            place = _read_numbers({"place": [asked["place"]]}, "place", 3)[0]
    if len(points) > MOST_POINTS:
        raise InputError(f"points: {len(points)} are too many; send at most {MOST_POINTS}")
    if not len(points):
        raise InputError("points: there are none; send x, y, z of each, m, z up")
    poses = None if place is None else np.eye(4)[None].copy()
    if poses is not None:
        poses[0, :3, 3] = place
    of = None if poses is None else np.zeros(len(points), np.int32)
    return PointCloud(points.astype(np.float32), poses=poses, pose_of=of, upright=True, landmarks=read_landmarks(asked))


def read_landmarks(asked: Mapping[str, Any]) -> Landmarks | None:
    """Read the landmarks of a request; None of one that has none.

    Raises:
        InputError: names the key.
    """
    rows = asked.get("landmarks", [])
    if not isinstance(rows, list):
        raise InputError('landmarks: must be a list such as [{"kind": "text", "value": "2.113", "position": [x, y, z]}]')
    found = parse_landmarks(rows, "landmarks")
    if (np.abs(found.table["position"]) >= FARTHEST).any():
        raise InputError(f"landmarks: a position lies {FARTHEST:g} m away or more; send m in the frame of the points")
    return found if len(found) else None


def read_laser(asked: Mapping[str, Any]) -> Array:
    """Read the (n, 3) points of a laser scan as ROS writes it: ranges from angle_min on, those of nothing are left out.

    Raises:
        InputError: names the key.
    """
    ranges = asked["ranges"]
    if not isinstance(ranges, list) or len(ranges) > MOST_POINTS:
        raise InputError(f"ranges: must be a list of at most {MOST_POINTS} numbers, m")
    try:
        values = np.array([np.nan if r is None else float(r) for r in ranges])
        numbers = [float(asked.get(name, usual)) for name, usual in LASER.items()]
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError("ranges, angle_min, angle_increment, range_max, height: must be numbers") from error
    first, step, least, most, height = numbers
    if not np.isfinite([first, step, height]).all():
        raise InputError("angle_min, angle_increment, height: must be finite")
    angle = first + step * np.arange(len(values))
    seen = np.isfinite(values) & (values > least) & (values < min(most, FARTHEST))
    x, y = values[seen] * np.cos(angle[seen]), values[seen] * np.sin(angle[seen])
    return np.column_stack([x, y, np.full(int(seen.sum()), height)])


KEYS = ("points", "place", "landmarks", "id", "ranges")
UNUSED_OF_ROS = ("header", "angle_max", "time_increment", "scan_time", "intensities")  # of a LaserScan as it comes
LASER = {"angle_min": 0.0, "angle_increment": np.pi / 180, "range_min": 0.05, "range_max": 60.0, "height": 0.3}


def _read_numbers(asked: Mapping[str, Any], key: str, columns: int) -> Array:
    try:
        array = np.array(asked[key], np.float64)
    except KeyError as error:
        raise InputError(f"{key}: is missing; send x, y, z of each point, m, or the ranges of a laser") from error
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{key}: must be a list of [x, y, z], m") from error
    if array.ndim != 2 or array.shape[1] != columns:
        raise InputError(f"{key}: must be a list of [x, y, z], m, not of shape {array.shape}")
    near = (np.abs(array) < FARTHEST).all(axis=1)  # not nan, either
    if key == "place" and not near.all():
        raise InputError("place: must be finite, m")
    return array[near]


def ask_server(
    host: str, port: int, points: Array, place: Array | None = None, seconds: float = 30.0, **words: Any
) -> dict[str, Any]:
    """Ask a server where points (n, 3) were seen.

    Args:
        place: (3,) of the sensor, in their frame.
        seconds: to wait for the answer.

    Raises:
        InputError: nobody answers, or the answer is an error.
    """
    asked = {"points": np.asarray(points, float).round(4).tolist(), **words}
    if place is not None:
        asked["place"] = np.asarray(place, float).tolist()
    try:
        with socket.create_connection((host, port), timeout=seconds) as link, link.makefile("rb") as lines:
            link.sendall(json.dumps(asked).encode() + b"\n")
            answer = json.loads(lines.readline(LONGEST_LINE) or b"null")
    except (OSError, ValueError) as error:
        raise InputError(f"{host}:{port}: no answer ({error}); is `topomerge serve-locate` running there?") from error
    if not isinstance(answer, dict) or "error" in answer:
        raise InputError(f"{host}:{port}: {answer.get('error') if isinstance(answer, dict) else 'the connection was closed'}")
    return answer
