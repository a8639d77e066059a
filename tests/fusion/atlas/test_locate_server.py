"""The server of places: it answers as `locate` does, and hostile lines and clients do it no harm."""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Iterator

import numpy as np
import pytest

from tests.fusion.atlas.test_locate import SENSOR, index, scan_part
from topomerge.errors import InputError
from topomerge.fusion.atlas import locate_server
from topomerge.fusion.atlas.locate import locate
from topomerge.fusion.atlas.locate_server import LocateServer, ask_server, read_request


@pytest.fixture
def server() -> Iterator[LocateServer]:
    with LocateServer(index()) as made:
        thread = threading.Thread(target=made.serve)
        thread.start()
        yield made
        made.stop()
        thread.join(10)
        assert not thread.is_alive()


def talk(server: LocateServer, *lines: bytes, answers: int = 1) -> list[dict[str, object]]:
    """What the server says to lines; an answer that does not come is left out."""
    with socket.create_connection(server.address, timeout=20) as link, link.makefile("rb") as told:
        for line in lines:
            link.sendall(line)
        return [json.loads(line) for line in (told.readline() for _ in range(answers)) if line]


def test_it_answers_as_locate_does(server: LocateServer) -> None:
    scan = scan_part()
    answer = ask_server(*server.address, scan.points[::3], SENSOR, id="robot 7")
    alone = locate(index(), read_request({"points": scan.points[::3].tolist(), "place": SENSOR.tolist()}))
    assert answer["id"] == "robot 7" and answer["status"] == alone.status == "located"
    assert np.allclose(answer["places"][0]["pose"], alone.places[0].pose.matrix, atol=1e-3)
    assert server.answered == 1 and server.address[0] == "127.0.0.1"


def test_a_laser_is_read_as_ros_writes_it() -> None:
    cloud = read_request({"ranges": [1.0, None, 2.0, 99.0], "angle_min": 0.0, "angle_increment": np.pi / 2, "height": 0.4})
    assert np.allclose(cloud.points, [[1, 0, 0.4], [-2, 0, 0.4]], atol=1e-6)
    assert cloud.poses is not None and np.allclose(cloud.poses[0, :3, 3], [0, 0, 0.4])


def test_landmarks_come_with_the_points() -> None:
    sign = {"kind": "text", "value": "2.113", "position": [1, 2, 1.5]}
    cloud = read_request({"points": [[0, 0, 0]], "landmarks": [sign, {"kind": "radio", "value": "aa:bb", "number": -60}]})
    assert cloud.landmarks is not None and cloud.landmarks.get_values().tolist() == ["2.113", "aa:bb"]
    assert cloud.landmarks.table["position"][0].tolist() == [1, 2, 1.5] and cloud.landmarks.table["number"][1] == -60
    laser = {"ranges": [1.0], "angle_max": 3.0, "intensities": [], "header": {}}  # a LaserScan as it comes
    assert read_request(laser).landmarks is None


HOSTILE = [
    b"\xff\xfe\x00 no json\n",
    b"[1, 2]\n",
    b"null\n",
    b'{"points": "many"}\n',
    b'{"points": [[1, 2], [3]]}\n',
    b'{"points": [[NaN, 1, 2]]}\n',
    b'{"points": []}\n',
    b'{"points": [[1, 2, 3]], "place": [Infinity, 0, 0]}\n',
    b'{"ranges": {"a": 1}}\n',
    b'{"ranges": ["x"]}\n',
    b'{"ranges": [1, 2], "angle_min": null}\n',
    b'{"id": {"deep": 1}}\n',
    b"[" * 5000 + b"\n",
    b'{"points": [[1e300, 1e300, 1e300]]}\n',
    b'{"points": [[1, 2, 3]], "unit": "mm"}\n',
    b'{"points": [[1, 2, 3]], "id": 1.5}\n',
    b'{"points": [[1, 2, 3]], "landmarks": {"kind": "text"}}\n',
    b'{"points": [[1, 2, 3]], "landmarks": [{"kind": "smell", "value": "x"}]}\n',
    b'{"points": [[1, 2, 3]], "landmarks": [{"kind": "text", "value": "x", "position": [1e300, 0, 0]}]}\n',
]


def test_hostile_lines_get_one_line_back_and_the_connection_stays(server: LocateServer) -> None:
    answers = talk(server, *HOSTILE, answers=len(HOSTILE))
    assert len(answers) == len(HOSTILE) and all("error" in a and "Traceback" not in str(a) for a in answers)
    assert ask_server(*server.address, scan_part().points[::3], SENSOR)["status"] == "located"


def test_lines_and_clients_are_limited(server: LocateServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(locate_server, "LONGEST_LINE", 1000)
    assert "a line may have" in str(talk(server, b"x" * 5000))
    monkeypatch.setattr(locate_server, "MOST_CLIENTS", 1)
    with socket.create_connection(server.address) as first:
        first.sendall(b"{}\n")
        assert first.recv(100)
        assert "clients are connected" in str(talk(server, b""))
    monkeypatch.setattr(locate_server, "MOST_POINTS", 2)
    with pytest.raises(InputError, match="at most 2"):
        read_request({"points": [[0, 0, 0]] * 3})


def test_a_silent_client_is_let_go(server: LocateServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(locate_server, "IDLE_SECONDS", 0.1)
    with socket.create_connection(server.address, timeout=20) as link:
        assert link.recv(10) == b""


def test_a_port_that_is_taken_and_a_server_that_is_not_there_are_told(server: LocateServer) -> None:
    with pytest.raises(InputError, match="give another --port"):
        LocateServer(index(), port=server.address[1])
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with pytest.raises(InputError, match="no answer"):
        ask_server("127.0.0.1", port, np.zeros((3, 3)))
