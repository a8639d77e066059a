"""The server of the studio: who is let in, what can be read and sent, edits of two people, and jobs."""

from __future__ import annotations

import asyncio
import json
import os
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.scenes_map import building
from topomerge.io.maps import load_map, save_map

pytest.importorskip("starlette")
pytest.importorskip("httpx")

from starlette.testclient import TestClient

from topomerge.errors import InputError
from topomerge.studio.folder import StudioFolder, UploadLimits, clean_name
from topomerge.studio.guard import POLICY, Access, find_refusal
from topomerge.studio.merges import Job, JobQueue
from topomerge.studio.server import LARGEST_REQUEST, PAGE_FILES, Studio

BASE = "http://127.0.0.1:8000"
ORIGIN = {"origin": BASE}
EVIL = "<img src=x onerror=alert(1)>.ply"


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("stored") / "house.tmap"
    save_map(building(2, 2), path)
    return path


@pytest.fixture
def folder(tmp_path: Path, stored: Path) -> Path:
    root = tmp_path / "maps"
    root.mkdir()
    shutil.copy(stored, root)
    (tmp_path / "secret.tmap").write_bytes(stored.read_bytes())
    return root


@pytest.fixture
def studio(folder: Path) -> Studio:
    return Studio(folder, limits=UploadLimits(file_bytes=1000, files=20))


@pytest.fixture
def client(studio: Studio) -> Iterator[TestClient]:
    with TestClient(studio.app, BASE) as one:
        assert one.get(f"/?token={studio.access.token}").status_code == 200
        yield one


def edit(client: TestClient, version: int, **wish: Any) -> Any:
    return client.post("/api/edits/house.tmap", json={"version": version, "edit": wish}, headers=ORIGIN)


# Who is let in.


def test_nothing_is_shown_without_the_token(studio: Studio) -> None:
    with TestClient(studio.app, BASE) as client:
        paths = ["/", "/?token=wrong", "/api/folder", "/api/plan/house.tmap", "/files/house.tmap", "/page/studio.js", "/nothing"]
        for path in paths:
            answer = client.get(path)
            assert answer.status_code == 403 and "house" not in answer.text and "set-cookie" not in answer.headers, path
        assert client.put("/api/files/a.ply", content=b"x", headers=ORIGIN).status_code == 403
        assert not (studio.folder.root / "a.ply").exists()


def test_the_token_becomes_a_cookie_that_no_script_reads(studio: Studio) -> None:
    with TestClient(studio.app, BASE, follow_redirects=False) as client:
        answer = client.get(f"/?token={studio.access.token}")
        assert answer.status_code == 303 and answer.headers["location"] == "/"
        cookie = answer.headers["set-cookie"]
        assert "HttpOnly" in cookie and "SameSite=lax" in cookie and studio.access.token not in cookie
        assert client.get("/").status_code == 200


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1.evil.example", "192.168.1.5:8000", "", "127.0.0.1@evil.example"])
def test_another_host_is_refused(client: TestClient, host: str) -> None:
    assert client.get("/api/folder", headers={"host": host}).status_code == 403
    assert client.get("/api/folder", headers={"host": "localhost:99"}).status_code == 200


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "http://127.0.0.1:9999", "https://127.0.0.1:8000", None])
def test_another_origin_is_refused(client: TestClient, origin: str | None) -> None:
    headers = {} if origin is None else {"origin": origin}
    wish = {"version": 0, "edit": {"op": "rename_room", "at": [4, -1], "name": "x"}}
    assert client.post("/api/edits/house.tmap", json=wish, headers=headers).status_code == 403
    assert client.put("/api/files/a.ply", content=b"ply", headers=headers).status_code == 403
    assert client.post("/api/jobs", json={"kind": "extract", "paths": ["house.tmap"]}, headers=headers).status_code == 403
    assert client.get("/api/plan/house.tmap").json()["version"] == 0


def test_a_page_from_elsewhere_can_not_even_ask() -> None:
    access = Access()
    headers = {"host": "127.0.0.1:1", "cookie": f"{access.cookie}={access.session}"}
    assert find_refusal(access, "GET", "/api/folder", headers) is None
    assert find_refusal(access, "GET", "/api/folder", {**headers, "sec-fetch-site": "cross-site"}) is not None
    assert find_refusal(access, "GET", "/api/folder", {**headers, "cookie": f"{access.cookie}=x"}) is not None
    elsewhere = {**headers, "sec-fetch-site": "cross-site", "sec-fetch-mode": "navigate"}  # pages of an atlas link to each other
    assert find_refusal(access, "GET", "/files/house/report.html", elsewhere) is None
    assert find_refusal(access, "GET", "/api/report/house.tmap", elsewhere) is not None


def test_a_password_is_asked_for_when_others_can_reach_it(folder: Path) -> None:
    studio = Studio(folder, Access("0.0.0.0", "correct horse"))
    assert studio.access.token not in studio.access.format_address(80)
    with TestClient(studio.app, "http://192.168.1.5:8000", follow_redirects=False) as client:
        origin = {"origin": "http://192.168.1.5:8000"}
        assert client.get("/").headers["location"] == "/login"
        assert client.get(f"/?token={studio.access.token}").headers["location"] == "/login"
        assert client.get("/login").status_code == 200 and client.get("/page/studio.css").status_code == 200
        assert client.get("/page/studio.js").status_code == 403
        wrong = client.post("/login", data={"password": "wrong"}, headers=origin)
        assert wrong.headers["location"] == "/login?wrong" and client.get("/api/folder").status_code == 403
        assert client.post("/login", data={"password": "correct horse"}, headers=origin).headers["location"] == "/"
        assert client.get("/api/folder").status_code == 200
        assert client.get("/api/folder", headers={"host": "evil.example"}).status_code == 403


def test_every_answer_forbids_scripts_of_others(client: TestClient) -> None:
    for path in ("/", "/api/folder", "/page/studio.js", "/nothing", "/api/plan/nothing.tmap"):
        headers = client.get(path).headers
        assert headers["content-security-policy"] == POLICY and "unsafe" not in POLICY
        assert headers["x-content-type-options"] == "nosniff" and headers["referrer-policy"] == "no-referrer"
    page = client.get("/").text
    assert '<script type="module" src=' in page and "onclick" not in page and "<style" not in page and "http" not in page


def test_all_scripts_of_the_page_are_there(client: TestClient) -> None:
    for name in PAGE_FILES:
        answer = client.get(f"/page/{name}")
        assert answer.status_code == 200 and answer.headers["content-type"].startswith("text/"), name
    for name in ("__init__.py", "..%2fserver.py", "studio.html"):
        assert client.get(f"/page/{name}").status_code == 404


# What can be read and sent.


@pytest.mark.parametrize(
    "path",
    ["../secret.tmap", "..%2Fsecret.tmap", "%2e%2e/secret.tmap", "/etc/passwd", "a/../../secret.tmap", "..\\secret.tmap",
     ".hidden.tmap", "linked.tmap", "linked/secret.tmap", "nothing.tmap", "house.tmap%00", "."],
)  # fmt: skip
def test_no_path_leads_out_of_the_folder(client: TestClient, folder: Path, path: str) -> None:
    (folder / "linked.tmap").symlink_to(folder.parent / "secret.tmap")
    (folder / "linked").symlink_to(folder.parent)
    (folder / ".hidden.tmap").write_bytes((folder / "house.tmap").read_bytes())
    for kind in ("api/plan", "api/scene", "api/report", "files", "api/merge"):
        answer = client.get(f"/{kind}/{path}")
        assert answer.status_code in (400, 404), (kind, answer.text[:100])
    listed = {entry["path"] for entry in client.get("/api/folder").json()["entries"]}
    assert listed == {"house.tmap"}
    with pytest.raises(InputError, match="no such file"):
        StudioFolder(folder).resolve(path)


def test_a_link_within_the_folder_is_followed(client: TestClient, folder: Path) -> None:
    (folder / "same.tmap").symlink_to(folder / "house.tmap")
    assert client.get("/api/plan/same.tmap").json()["rooms"] == 10


def test_a_file_is_sent_under_a_clean_name_that_is_free(client: TestClient, folder: Path) -> None:
    first = client.put(f"/api/files/{EVIL.replace('/', '%2F')}", content=b"ply", headers=ORIGIN)
    again = client.put(f"/api/files/{EVIL}", content=b"ply2", headers=ORIGIN)
    assert first.status_code == again.status_code == 201
    assert first.json()["path"] == "_img src=x onerror=alert(1)_.ply"
    assert (folder / first.json()["path"]).read_bytes() == b"ply" and (folder / again.json()["path"]).read_bytes() == b"ply2"
    assert first.json()["path"] != again.json()["path"]


@pytest.mark.parametrize(
    ("name", "clean"),
    [("../../etc/x.ply", "x.ply"), ("C:\\scans\\a.las", "a.las"), (".hidden.ply", "hidden.ply"), ("-rf.ply", "file-rf.ply"),
     ("Grüße 3.ply", "Grüße 3.ply"), ("a\nb\0c.ply", "a_b_c.ply"), ("..", "file"), ("a" * 400 + ".ply", "a" * 120 + ".ply")],
)  # fmt: skip
def test_names_are_cleaned(name: str, clean: str) -> None:
    assert clean_name(name) == clean


def test_uploads_have_limits(client: TestClient, folder: Path) -> None:
    assert client.put("/api/files/big.ply", content=b"x" * 1001, headers=ORIGIN).status_code == 413
    parts = (b"x" * 100 for _ in range(20))  # without a length: it is cut off when it has become too long
    assert client.put("/api/files/big.ply", content=parts, headers=ORIGIN).status_code == 413
    assert client.put("/api/files/x.exe", content=b"MZ", headers=ORIGIN).status_code == 400
    for k in range(30):
        (folder / f"{k}.txt").touch()
    assert client.put("/api/files/a.ply", content=b"x", headers=ORIGIN).status_code == 429
    assert not list(folder.glob("*.ply")) and not list(folder.glob(".upload*")), "what is refused leaves nothing behind"
    huge = client.post("/api/place", content=b"[" * (LARGEST_REQUEST + 1), headers=ORIGIN)
    assert huge.status_code == 413


def test_a_file_of_any_name_is_listed_as_it_is_called(client: TestClient, folder: Path) -> None:
    (folder / EVIL).write_bytes(b"ply")
    entry = next(e for e in client.get("/api/folder").json()["entries"] if e["kind"] == "scan")
    assert entry["name"] == EVIL and not entry["extracted"]  # as text, which the page writes as text (test_page)


def test_pages_of_the_folder_run_in_an_origin_of_their_own(client: TestClient, folder: Path) -> None:
    (folder / "a.html").write_text("<script>fetch('/api/folder')</script>")
    (folder / "notes.txt").write_text("1 2 3")
    policy = client.get("/files/a.html").headers["content-security-policy"]
    assert policy.startswith("sandbox ") and "allow-same-origin" not in policy and "connect-src" not in policy
    assert "default-src 'none'" in policy
    assert client.get("/files/notes.txt").status_code == 400
    assert client.get("/files/house.tmap").headers["content-disposition"].startswith("attachment")


# Maps and edits.


def test_a_plan_holds_what_is_drawn(client: TestClient) -> None:
    plan = client.get("/api/plan/house.tmap").json()
    assert [len(s["rooms"]) for s in plan["storeys"]] == [5, 5] and plan["version"] == 0 and plan["rooms"] == 10
    room = plan["storeys"][0]["rooms"][0]
    a, b, c, d, e, f = plan["back"]
    x, y = a * room["x"] + b * room["y"] + c, d * room["x"] + e * room["y"] + f
    centre = building(2, 2).rooms["centroid"][room["i"]]
    assert np.hypot(x - centre[0], y - centre[1]) < 0.3
    assert room["d"].startswith("M") and len(plan["storeys"][0]["doors"]) == 4
    assert client.get("/api/scene/house.tmap").json()["cells"] > 1000


def test_edits_are_lines_of_the_journal_and_can_be_taken_back(client: TestClient, folder: Path) -> None:
    at = building(2, 2).rooms["centroid"][0][:2].tolist()
    done = edit(client, 0, op="rename_room", at=at, name="<b>Office</b>", by="Ada", storey=0)
    assert done.status_code == 200, done.text
    plan = done.json()
    assert plan["version"] == 1 and plan["storeys"][0]["rooms"][0]["name"] == "<b>Office</b>"
    line = json.loads((folder / "house.edits.jsonl").read_text())
    assert line["op"] == "rename_room" and line["by"] == "Ada" and len(line["at"]) == 3
    assert edit(client, 1, op="undo").json()["storeys"][0]["rooms"][0]["name"] == ""
    again = edit(client, 2, op="redo").json()
    assert again["storeys"][0]["rooms"][0]["name"] == "<b>Office</b>" and again["journal"]["undo"] == line["id"]
    page = client.get("/api/report/house.tmap")
    assert b"&lt;b&gt;Office" in page.content and b"<b>Office" not in page.content
    assert page.headers["content-disposition"].startswith("attachment")
    assert len(load_map(folder / "house.tmap").landmarks) == 0, "the map itself stays as it is"


def test_who_was_slower_is_told_and_nothing_is_lost(client: TestClient, folder: Path) -> None:
    centres = building(2, 2).rooms["centroid"]
    first = edit(client, 0, op="rename_room", at=centres[0][:2].tolist(), name="one", storey=0)
    second = edit(client, 0, op="rename_room", at=centres[1][:2].tolist(), name="two", storey=0)
    assert first.status_code == 200 and second.status_code == 409 and second.json()["version"] == 1
    again = edit(client, 1, op="rename_room", at=centres[1][:2].tolist(), name="two", storey=0)
    assert [room["name"] for room in again.json()["storeys"][0]["rooms"][:2]] == ["one", "two"]
    assert len((folder / "house.edits.jsonl").read_text().splitlines()) == 2


def test_an_edit_that_does_not_fit_is_refused_with_its_reason(client: TestClient, folder: Path) -> None:
    far = edit(client, 0, op="rename_room", at=[500.0, 500.0, 0.0], name="x")
    assert far.status_code == 400 and "no room" in far.json()["error"]
    assert edit(client, 0, op="explode", at=[0, 0]).status_code == 400
    assert edit(client, 0, op="undo").status_code == 400
    for odd in ({"edit": {}}, {"version": "0", "edit": {"op": "undo"}}, []):
        assert client.post("/api/edits/house.tmap", json=odd, headers=ORIGIN).status_code == 400
    assert not (folder / "house.edits.jsonl").exists()


def test_colours_of_rooms_stay_where_rooms_do(client: TestClient) -> None:
    before = {r["i"]: r["colour"] for r in client.get("/api/plan/house.tmap").json()["storeys"][0]["rooms"]}
    room = building(2, 2).rooms[0]
    middle = room["centroid"][:2]
    line = [[float(room["lo"][0]), float(middle[1])], [float(room["hi"][0]), float(middle[1])]]
    plan = edit(client, 0, op="split_room", at=middle.tolist(), line=line, storey=0).json()
    after = {r["i"]: r["colour"] for r in plan["storeys"][0]["rooms"]}
    assert plan["rooms"] == 11 and {i: after[i] for i in before} == before and after[10] != after[0]


# Jobs.


def run_jobs(tmp_path: Path, *words: tuple[str, ...], cancel: int = 0) -> list[Job]:
    """What becomes of jobs; one is cancelled once it runs."""

    async def work() -> list[Job]:
        queue = JobQueue(tmp_path, lambda _: None)
        jobs = [queue.add("extract", "a", one, "a.tmap") for one in words]
        end = time.monotonic() + 60
        while any(job.state in ("waiting", "running") for job in jobs) and time.monotonic() < end:
            if cancel and jobs[cancel - 1].process is not None and jobs[cancel - 1].state == "running":
                await queue.cancel(cancel)
            await asyncio.sleep(0.02)
        await queue.close()
        return jobs

    return asyncio.run(work())


def test_a_job_that_fails_says_why_and_the_next_one_runs(tmp_path: Path, stored: Path) -> None:
    first, second = run_jobs(tmp_path, ("info", "nothing.tmap"), ("info", str(stored)))
    assert first.state == "failed" and first.status == 1 and first.lines == ["nothing.tmap: no such file; check the path"]
    assert second.state == "done" and second.status == 0


def test_a_job_that_is_cancelled_ends_its_process(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    (job,) = run_jobs(tmp_path, ("watch", "./in", "-o", "./site"), cancel=1)  # which would never end
    assert job.state == "cancelled" and job.process is not None and job.process.returncode is not None
    with pytest.raises(ProcessLookupError):
        os.kill(job.process.pid, 0)


@pytest.mark.longer
def test_a_scan_is_extracted_with_its_steps(client: TestClient, folder: Path) -> None:
    from plyfile import PlyData, PlyElement

    from tests.scenes import two_rooms

    points = two_rooms().points()
    rows = np.zeros(len(points), [(n, "f4") for n in "xyz"])
    for k, name in enumerate("xyz"):
        rows[name] = points[:, k]
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(folder / "two rooms.ply"))
    assert client.post("/api/jobs", json={"kind": "extract", "paths": ["two rooms.ply"]}, headers=ORIGIN).status_code == 202
    end = time.monotonic() + 120
    while (job := client.get("/api/folder").json()["jobs"][-1])["state"] in ("waiting", "running"):
        assert time.monotonic() < end
        time.sleep(0.2)
    assert job["state"] == "done", job
    assert {"read", "extract"} <= set(job["steps"]) and job["steps"]["extract"][0] > 0.5
    assert client.get("/api/plan/two%20rooms.tmap").json()["rooms"] == 2


def test_only_what_lies_in_the_folder_can_be_worked_on(client: TestClient) -> None:
    for paths in (["../secret.tmap"], [], "house.tmap", [1], ["house.tmap", "../secret.tmap"]):
        for kind in ("extract", "merge", "compare", "explode"):
            assert client.post("/api/jobs", json={"kind": kind, "paths": paths}, headers=ORIGIN).status_code == 400
    assert client.get("/api/folder").json()["jobs"] == []


def test_the_lowest_storey_of_a_map_is_drawn_first(client: TestClient) -> None:
    quick = client.get("/api/plan/house.tmap?quick").json()
    whole = client.get("/api/plan/house.tmap").json()
    assert not quick["whole"] and whole["whole"] and quick["storeys"][0] == whole["storeys"][0]
    assert quick["storeys"][1]["rooms"] == [] and len(whole["storeys"][1]["rooms"]) == 5
    assert quick["storeys"][1]["doors"] == whole["storeys"][1]["doors"]
    assert client.get("/api/plan/house.tmap?quick").json() == whole, "what is open is whole"
