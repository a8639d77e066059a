"""`topomerge export` and `topomerge view`: files, folders, servers, and one line for whatever is wrong."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
import webbrowser
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import topomerge
from tests.io.export_maps import doubted, two_floors
from topomerge.cli.main import main as cli

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    monkeypatch.chdir(tmp_path)
    topomerge.save_map(two_floors(), tmp_path / "a.tmap")
    np.save(tmp_path / "cloud.npy", np.zeros((3, 3), np.float32))

    def call(*words: str) -> tuple[int, str, str]:
        status = cli(list(words))
        out, err = capsys.readouterr()
        return status, out, "\n".join(line for line in err.splitlines() if "warning: only a test" not in line)

    return call


def names(folder: str) -> list[str]:
    return sorted(p.name for p in Path(folder).iterdir())


@pytest.mark.skipif(sys.platform == "win32", reason="no line breaks in names there")
def test_names_with_line_breaks_are_printed_in_one_line(run: Run) -> None:
    status, out, _ = run("export", "a.tmap", "--to", "graphml", "-o", "li\nne.graphml")
    assert (status, out) == (0, "6 rooms, 5 doors and stairs -> li ne.graphml\n") and Path("li\nne.graphml").exists()
    status, out, _ = run("embed", "a.tmap", "--descriptor", "engineered", "-o", "ro\nws.npy")
    assert status == 0 and out.endswith(" -> ro ws.npy\n") and out.count("\n") == 1
    whole = run("info", "a.tmap")[1]
    topomerge.save_map(replace(topomerge.load_map("a.tmap"), source="sc\nan.ply"), "b.tmap")
    status, out, _ = run("info", "b.tmap")
    assert status == 0 and out.startswith("sc an.ply: ") and out.count("\n") == whole.count("\n")


def test_one_format_is_a_file_or_goes_into_a_folder(run: Run) -> None:
    status, out, err = run("export", "a.tmap", "--to", "graphml", "-o", "b.graphml")
    assert (status, out, err) == (0, "6 rooms, 5 doors and stairs -> b.graphml\n", "")
    assert run("export", "a.tmap", "--to", "geojson", "-o", "new/er/")[0] == 0 and names("new/er") == ["a.geojson"]
    assert run("export", "a.tmap", "--to", "indoorgml", "-o", "new")[0] == 0 and names("new") == ["a.gml", "er"]
    assert run("export", "a.tmap", "--to", "ply", "-q") == (0, "", "") and Path("a.ply").is_file()


def test_several_formats_are_a_folder(run: Run) -> None:
    assert run("export", "a.tmap", "--to", "graphml,geojson,indoorgml,dsg,ros,ply", "-o", "all")[0] == 0
    robots = [f"a_storey_{s}{end}" for s in (0, 1) for end in (".pgm", ".yaml", "_route.geojson")]
    assert names("all") == sorted(["a.graphml", "a.geojson", "a.gml", "a.dsg.json", "a.ply", *robots])
    before = Path("all/a.gml").read_bytes()
    assert run("export", "a.tmap", "--to", "graphml,indoorgml", "-o", "all")[0] == 0, "what was there is replaced, as elsewhere"
    assert Path("all/a.gml").read_bytes() == before
    assert topomerge.read_points("all/a_storey_1.yaml").points.shape[0] > 1000


def test_the_folder_of_a_merge(run: Run) -> None:
    Path("merged").mkdir()
    Path("a.tmap").rename("merged/map.tmap")
    assert run("export", "merged", "--to", "geojson,ros", "-o", "out", "--storey", "0")[0] == 0
    assert names("out") == ["merged.geojson", "merged_storey_0.pgm", "merged_storey_0.yaml", "merged_storey_0_route.geojson"]
    Path("merged/map.tmap").unlink()
    Path("merged/merge.json").write_text("{}")
    assert "refused" in run("export", "merged", "--to", "geojson")[2]


def test_the_folder_of_an_atlas(run: Run) -> None:
    Path("atlas").mkdir()
    Path("a.tmap").rename("atlas/map_0.tmap")
    assert run("export", "atlas", "--to", "ply", "-o", "out/")[0] == 0 and names("out") == ["atlas.ply"]
    Path("atlas/map_3.tmap").write_bytes(Path("atlas/map_0.tmap").read_bytes())
    status, _, err = run("export", "atlas", "--to", "ply")
    assert status == 1 and "atlas/map_0.tmap, atlas/map_3.tmap" in err


BAD = [
    (("a.tmap", "--to", "shp", "-o", "x"), "choose from graphml, geojson"),
    (("a.tmap", "--to", ",", "-o", "x"), "names no format"),
    (("no.tmap", "--to", "ply", "-o", "x"), "no.tmap: no such file"),
    (("cloud.npy", "--to", "ply", "-o", "x"), "topomerge extract cloud.npy -o cloud.tmap"),
    ((".", "--to", "ply", "-o", "x"), "holds no joined map"),
    (("a.tmap", "--to", "ply,ros", "-o", "cloud.npy"), "is a file"),
    (("a.tmap", "--to", "ros", "-o", "cloud.npy/x"), "can't be made"),
    (("a.tmap", "--to", "ply", "-o", "a.tmap"), "--to ply writes .ply"),
    (("a.tmap", "--to", "geojson", "-o", "x/y.geojson", "--storey", "9"), "no such storey (0 to 1)"),
    (("a.tmap", "--to", "ros", "-o", "x/y", "--storey", "2"), "no such storey"),
    (("a.tmap", "--to", "geojson", "-o", "x", "--origin", "north"), "latitude,longitude"),
    (("a.tmap", "--to", "ply", "-o", "x", "--origin", "1,2"), "it is for geojson"),
    (("a.tmap", "--to", "graphml", "-o", "x", "--storey", "1"), "geojson and ros"),
    (("a.tmap", "--to", "graphml", "-o", "x", "--storey", "one"), "whole number"),
    (("a.tmap", "-o", "x"), "--to"),
    (("a.tmap", "--to", "ply", "-o", "x", "--min-confidence", "1.5"), "from 0 to 1"),
    (("a.tmap", "--to", "ply", "-o", "x", "--min-confidence=-0.5"), "from 0 to 1"),
    (("a.tmap", "--to", "ply", "-o", "x", "--min-confidence", "nan"), "from 0 to 1"),
    (("a.tmap", "--to", "tf2", "-o", "x", "--min-confidence", "0.5"), "means nothing for tf2"),
]


def test_only_what_is_likely_enough(run: Run) -> None:
    topomerge.save_map(doubted(), "a.tmap")
    words = ("export", "a.tmap", "--to", "geojson,ros", "-o", "out", "--min-confidence")
    assert run(*words, "0.5")[1].startswith("5 rooms, 3 doors and stairs -> ")
    features = json.loads(Path("out/a.geojson").read_text())["features"]
    assert sorted(f["id"] for f in features if f["properties"]["kind"] == "room") == [f"room {r}" for r in range(5)]
    assert all(f["properties"].get("confidence", 1) >= 0.5 for f in features)
    assert run(*words, "1")[1].startswith("0 rooms, 0 doors and stairs -> "), "nothing is so sure"
    assert run(*words, "0")[1].startswith("6 rooms, 5 doors and stairs -> ")


@pytest.mark.longer
def test_an_origin_in_the_south(run: Run) -> None:
    for words in (("--origin", "-33.9,-151.2"), ("--origin=-33.9,-151.2,-5",)):
        assert run("export", "a.tmap", "--to", "geojson", "-o", "a.geojson", *words)[0] == 0
        west = [x for x, y in re.findall(r"\[\s*(-?[\d.]+),\s*(-?[\d.]+)", Path("a.geojson").read_text()) if float(y) < -33]
        assert len(west) > 10 and {round(float(x)) for x in west} == {-151}


@pytest.mark.parametrize(("words", "said"), BAD)
def test_bad_input_is_one_line_and_leaves_nothing(run: Run, words: tuple[str, ...], said: str) -> None:
    before = names(".")
    status, out, err = run("export", *words)
    assert status == 1 and out == "" and len(err.splitlines()) == 1 and said in err, err
    assert names(".") == before


def test_damaged_maps(run: Run) -> None:
    Path("half.tmap").write_bytes(Path("a.tmap").read_bytes()[:3000])
    status, _, err = run("export", "half.tmap", "--to", "ply", "-o", "x/y.ply")
    assert status == 1 and err.startswith("topomerge: half.tmap: ") and len(err.splitlines()) == 1 and not Path("x").exists()


def test_all_or_none(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("topomerge.io.exports.indoorgml.write_xml", fail)
    status, _, err = run("export", "a.tmap", "--to", "graphml,indoorgml", "-o", "out")
    assert status == 1 and "No space left" in err and not Path("out").exists()


@pytest.mark.parametrize("command", ["export", "view"])
def test_help_is_fast_and_has_an_example(command: str) -> None:
    code = f"import sys; from topomerge.cli.main import main; main(['{command}', '--help']); "
    code += "sys.exit(any(m in sys.modules for m in ('numpy', 'scipy', 'shapely', 'http.server', 'matplotlib')))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0 and f"topomerge {command} " in done.stdout.split("example:")[1]


def test_view_makes_the_report_of_a_map(run: Run) -> None:
    status, out, err = run("view", "a.tmap", "-o", "r.html", "--no-open")
    assert (status, out, err) == (0, "r.html\n", "") and "<html" in Path("r.html").read_text()
    status, out, _ = run("view", "a.tmap", "--no-open")
    page = Path(out.strip())
    assert status == 0 and page.name == "a.html" and page.read_text() == Path("r.html").read_text()
    page.unlink()
    page.parent.rmdir()


def test_view_opens_reports(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", lambda address: opened.append(address) or len(opened) < 2)
    Path("merged").mkdir()
    Path("merged/report.html").write_text("<p>")
    assert run("view", "merged") == (0, "merged/report.html\n", "")
    assert opened == [Path("merged/report.html").resolve().as_uri()]
    status, out, err = run("view", "merged/report.html")
    assert status == 0 and out == "merged/report.html\n" and "no browser" in err


def test_views_of_damaged_maps_leave_nothing(run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    Path("half.tmap").write_bytes(Path("a.tmap").read_bytes()[:3000])
    status, out, err = run("view", "half.tmap", "--no-open")
    assert status == 1 and out == "" and err.startswith("topomerge: half.tmap: damaged") and not names("temporary")


BAD_VIEWS = [
    (("no.html",), "no such file"),
    (("cloud.npy",), "can't be shown"),
    (("sub",), "holds no report.html"),
    (("sub/page.html", "-o", "x.html"), "is for the report of a .tmap"),
    (("a.tmap", "-o", "a.tmap"), "is the input"),
    (("a.tmap", "--serve", "70000"), "port"),
    (("a.tmap", "--serve", "many"), "whole number"),
]


@pytest.mark.parametrize(("words", "said"), BAD_VIEWS)
def test_bad_views(run: Run, words: tuple[str, ...], said: str) -> None:
    Path("sub").mkdir()
    Path("sub/page.html").write_text("<p>")
    status, out, err = run("view", *words, "--no-open")
    assert status == 1 and out == "" and said in err and len(err.splitlines()) == 1


def test_view_serves_the_page_and_nothing_else(tmp_path: Path) -> None:
    (tmp_path / "my report.html").write_text("<p>seen</p>")
    (tmp_path / "secret.txt").write_text("no")
    command = [sys.executable, "-m", "topomerge", "view", "my report.html", "--serve", "--no-open"]
    heard = partial(signal.signal, signal.SIGINT, signal.default_int_handler)  # a suite in the background ignores Ctrl-C
    server = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=heard)
    try:
        assert server.stdout is not None and server.stderr is not None
        address = server.stdout.readline().strip()
        assert address.startswith("http://127.0.0.1:") and address.endswith("/my%20report.html")
        root = address.rsplit("/", 1)[0]
        opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
        assert opener.open(address).read() == opener.open(root + "/").read() == b"<p>seen</p>"
        for path, host, status in (
            ("/secret.txt", "", 404),
            ("/../secret.txt", "", 404),
            ("/my%20report.html", "evil.example", 403),
        ):
            request = urllib.request.Request(root + path, headers={"Host": host} if host else {})
            with pytest.raises(urllib.error.HTTPError) as refused:
                opener.open(request)
            assert refused.value.code == status
        port = root.rsplit(":", 1)[1]
        taken = subprocess.run(
            [*command[:-2], "--serve", port, "--no-open"], cwd=tmp_path, capture_output=True, text=True, check=False
        )
        assert taken.returncode == 1 and "can't be used" in taken.stderr and len(taken.stderr.splitlines()) == 1
        server.send_signal(signal.SIGINT)
        assert server.wait(10) == 0 and server.stderr.read() == ""
    finally:
        server.kill()
        server.wait()


@pytest.mark.longer
def test_what_is_served_of_a_map_is_deleted_in_the_end(tmp_path: Path) -> None:
    topomerge.save_map(two_floors(), tmp_path / "a.tmap")
    (tmp_path / "scratch").mkdir()
    command = [sys.executable, "-m", "topomerge", "view", "a.tmap", "--serve", "--no-open"]
    env = {**os.environ, "TMPDIR": str(tmp_path / "scratch")}
    server = subprocess.Popen(command, cwd=tmp_path, env=env, stdout=subprocess.PIPE, text=True)
    try:
        assert server.stdout is not None and server.stdout.readline().startswith("http://127.0.0.1:")
        assert list((tmp_path / "scratch").rglob("a.html"))
        server.terminate()
        assert server.wait(10) == 143
        time.sleep(0.1)
        assert not list((tmp_path / "scratch").glob("topomerge-*"))
    finally:
        server.kill()
        server.wait()
