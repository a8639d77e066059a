"""`topomerge studio` on the command line: what it refuses before it serves anything."""

from __future__ import annotations

import io
import sys
from pathlib import Path

import pytest

from topomerge.cli.main import main

pytest.importorskip("starlette")


@pytest.fixture
def served(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Addresses that would have been served."""
    import topomerge.studio.server as server

    addresses: list[str] = []
    monkeypatch.setattr(server, "serve_studio", lambda studio, port, tell: addresses.append(studio.access.format_address(port)))
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    monkeypatch.delenv("TOPOMERGE_STUDIO_PASSWORD", raising=False)
    return addresses


def test_it_binds_this_machine_and_needs_no_password(tmp_path: Path, served: list[str]) -> None:
    assert main(["studio", str(tmp_path), "--port", "8123"]) == 0
    assert served[0].startswith("http://127.0.0.1:8123/?token=") and len(served[0]) > 55
    assert main(["studio", str(tmp_path)]) == 0
    assert served[0].split("token=")[1] != served[1].split("token=")[1]


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["nowhere"], "nowhere: is no folder"),
        ([".", "--host", "0.0.0.0"], "--host: needs a password, as other machines can reach the page"),
        ([".", "--host", "0.0.0.0", "--password", "short"], "--password: give one of 8 characters or more"),
        ([".", "--port", "70000"], "must be a port from 0 to 65535"),
    ],
)
def test_what_can_not_be_served_is_one_line(
    words: list[str], reason: str, served: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["studio", *words]) == 1
    assert reason in capsys.readouterr().err.splitlines()[-1] and not served


def test_others_are_let_in_with_a_warning_and_a_password(
    tmp_path: Path, served: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TOPOMERGE_STUDIO_PASSWORD", "correct horse")
    assert main(["studio", str(tmp_path), "--host", "0.0.0.0", "--port", "8123"]) == 0
    assert served == ["http://127.0.0.1:8123/"], "the token is not told where others could read it"
    assert "warning: --host 0.0.0.0: other machines can reach the folder, without encryption" in capsys.readouterr().err


def test_a_missing_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    for name in [name for name in sys.modules if name.startswith("topomerge.studio")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "uvicorn", None)
    assert main(["studio", str(tmp_path)]) == 1
    assert "topomerge studio needs uvicorn: pip install 'topomerge[studio]'" in capsys.readouterr().err


def test_a_port_that_is_taken_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import socket

    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert main(["studio", str(tmp_path), "--no-browser", "--port", str(port)]) == 1
    assert f"--port {port}: 127.0.0.1 can't be used" in capsys.readouterr().err
