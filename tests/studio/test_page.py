"""The studio in a real browser: each kind of edit, undo, reload, two pages at once, strangers' names, tablets, and its end."""

from __future__ import annotations

import json
import os
import shutil
import signal
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.scenes_map import building
from tests.studio.browser import MapPage, open_context, run_studio, start_browser
from topomerge.edits.journal import MAP_OPS
from topomerge.io.maps import save_map
from topomerge.types import WINDOW_DTYPE

pytestmark = pytest.mark.longer
pytest.importorskip("starlette")
EVIL = "<img src=x onerror=window.hit=1>"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    root = tmp_path / "maps"
    root.mkdir()
    map = building(3, 2)
    window = np.zeros(1, WINDOW_DTYPE)
    window["rooms"], window["centre"], window["width"], window["confidence"] = (0, -1), (4.1, -3.0, 0.6), 1.2, 0.9
    window["sill"], window["head"] = 0.9, 2.1
    save_map(replace(map, windows=window), root / "house.tmap")
    return root


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    with start_browser() as one:
        yield one


@pytest.fixture
def context(folder: Path, chromium: Any) -> Iterator[Any]:
    with run_studio(folder) as (address, _), open_context(chromium) as one:
        one.address = address
        yield one


def lines(folder: Path) -> list[dict[str, Any]]:
    """The journal."""
    return [json.loads(line) for line in (folder / "house.edits.jsonl").read_text().splitlines()]


def test_each_kind_of_edit_undo_and_reload(context: Any, folder: Path) -> None:
    one = MapPage(context, context.address, "house.tmap")
    middle = lambda i: (one.room(i)["x"], one.room(i)["y"])  # noqa: E731
    box = one.room(0)["box"]
    x = (box[0] + box[2]) / 2 + 30

    one.press("s")
    one.click(x, box[1] + 4)
    one.click(x + 2, box[3] - 4)  # nearly upright: it is drawn along the walls
    one.wait_version(1)
    split = lines(folder)[-1]
    assert split["op"] == "split_room" and abs(split["line"][0][0] - split["line"][1][0]) < 0.01
    assert len(one.storey["rooms"]) == 8
    one.press("Escape")
    one.click(*middle(0))
    one.page.keyboard.down("Shift")
    one.click(*middle(14))
    one.page.keyboard.up("Shift")
    one.press("j")
    one.wait_version(2)
    assert len(one.storey["rooms"]) == 7 and lines(folder)[-1]["op"] == "join_rooms"

    doors = len(one.storey["doors"])
    one.press("Escape", "d")
    a, b = one.room(1), one.room(3)
    wall = ((a["box"][2] + b["box"][0]) / 2, (a["box"][1] + a["box"][3]) / 2 - 100)
    one.click(*wall)
    one.wait_version(3)
    assert len(one.storey["doors"]) == doors + 1
    door = next(d for d in one.storey["doors"] if sorted(d["rooms"]) == [1, 3])
    place = lambda d: ((d["line"][0] + d["line"][2]) / 2, (d["line"][1] + d["line"][3]) / 2)  # noqa: E731
    one.press("m")
    one.drag(place(door), (place(door)[0], place(door)[1] + 150))
    one.wait_version(4)
    moved = next(d for d in one.storey["doors"] if sorted(d["rooms"]) == [1, 3])
    assert abs(place(moved)[1] - place(door)[1] - 150) < 12 and lines(folder)[-1]["op"] == "move_door"
    one.press("v")
    one.click(*place(moved))
    one.page.fill(".side [data-field=width]", "0.75")
    one.press("Enter")
    one.wait_version(5)
    one.page.locator(".plan-canvas").focus()
    one.press("t")
    one.wait_version(6)
    shut = next(d for d in one.storey["doors"] if sorted(d["rooms"]) == [1, 3])
    assert shut["width"] == 0.75 and shut["state"] == "shut"
    one.press("Delete")
    one.wait_version(7)
    assert len(one.storey["doors"]) == doors

    window = one.storey["windows"][0]
    one.click(*place(window))
    one.page.fill(".side [data-field=sill]", "0.5")
    one.press("Enter")
    one.wait_version(8)
    one.press("m")
    one.drag(place(window), (place(window)[0] + 80, place(window)[1]))
    one.wait_version(9)
    assert one.storey["windows"][0]["sill"] == 0.5
    assert abs(place(one.storey["windows"][0])[0] - place(window)[0] - 80) < 12
    one.press("v")
    one.click(*place(one.storey["windows"][0]))
    one.press("Delete")
    one.wait_version(10)
    assert one.storey["windows"] == []

    one.click(*middle(2))
    one.page.fill(".side [data-field=name]", EVIL)
    one.press("Enter")
    one.wait_version(11)
    one.page.fill(".side [data-field=kind]", "kitchen")
    one.press("Enter")
    one.wait_version(12)
    one.page.fill(".side [data-field=area]", "wing A")
    one.press("Enter")
    one.wait_version(13)
    one.page.check(".side [data-field=outside]")
    one.wait_version(14)
    looked = one.room(2)["looked"]
    one.page.locator(".side [data-field=looked_into]").click()
    one.wait_version(15)
    room = one.room(2)
    assert (room["name"], room["kind"], room["group"]) == (EVIL, "kitchen", "wing A")
    assert room["outside"] and room["looked"] is not looked

    one.page.locator(".plan-canvas").focus()
    one.press("l")
    one.click(middle(4)[0], middle(4)[1] + 80)
    one.page.fill("dialog input", "Exit 4")
    one.press("Enter")
    one.wait_version(16)
    assert [mark["value"] for mark in one.storey["landmarks"] if mark["kind"] == "text"] == ["Exit 4"]
    mark = one.storey["landmarks"][-1]
    one.press("v")
    one.click(mark["x"], mark["y"])
    one.press("Delete")
    one.wait_version(17)
    assert not [m for m in one.storey["landmarks"] if m["kind"] == "text"]

    one.press("Control+z")
    one.wait_version(18)
    assert [m["value"] for m in one.storey["landmarks"] if m["kind"] == "text"] == ["Exit 4"]
    one.press("Control+y")
    one.wait_version(19)
    assert not [m for m in one.storey["landmarks"] if m["kind"] == "text"]
    before = one.storey
    one.page.reload()
    one.wait_version(19)
    after = one.storey
    for plain in (before, after):
        for part in plain["rooms"]:
            part.pop("colour")  # a page that is loaded anew need not have those of before
    assert after == before
    assert one.page.evaluate("window.hit") is None, "a name is text"
    ops = {line["op"] for line in lines(folder)}
    assert ops == {*MAP_OPS, "undo", "redo"}


def test_all_tools_work_with_the_keyboard(context: Any, folder: Path) -> None:
    one = MapPage(context, context.address, "house.tmap")
    one.press("]", "r")  # the first room
    one.page.wait_for_selector("dialog input")
    one.page.keyboard.type("Library")
    one.press("Enter")
    one.wait_version(1)
    assert one.room(0)["name"] == "Library"
    one.page.locator(".plan-canvas").focus()
    one.press("s")
    top = one.room(0)["box"][1]
    while one.page.evaluate("() => studio.canvas.cursor[1]") > top + 10:
        one.press("ArrowUp")
    one.press("Enter")
    bottom = one.room(0)["box"][3]
    while one.page.evaluate("() => studio.canvas.cursor[1]") < bottom - 20:
        one.press("ArrowDown")
    one.press("Enter")
    one.wait_version(2)
    assert lines(folder)[-1]["op"] == "split_room" and len(one.storey["rooms"]) == 8
    one.press("PageUp")
    assert one.page.evaluate("() => studio.canvas.storey") == 1
    one.press("?")
    assert one.page.locator("dialog.keys").is_visible()


def test_two_pages_at_one_map_lose_no_change(context: Any, folder: Path) -> None:
    one, other = (MapPage(context, context.address, "house.tmap") for _ in range(2))
    room, second = one.room(0), other.room(1)
    one.click(room["x"], room["y"])
    one.page.fill(".side [data-field=name]", "from one")
    one.press("Enter")
    one.wait_version(1)
    other.wait_version(1)  # it is told
    assert other.room(0)["name"] == "from one"
    other.page.evaluate("() => { studio.reload = () => Promise.resolve(); }")  # deaf: it does not see what comes now
    one.page.fill(".side [data-field=name]", "again")
    one.press("Enter")
    one.wait_version(2)
    other.click(second["x"], second["y"])
    other.page.fill(".side [data-field=name]", "from the other")
    other.press("Enter")
    other.page.wait_for_selector(".toast.bad button")
    assert len(lines(folder)) == 2, "what was made for another version is not written"
    other.page.evaluate("() => { delete studio.reload; return studio.reload(); }")
    other.wait_version(2)
    other.page.click(".toast.bad button")
    for page in (one, other):
        page.wait_version(3)
        assert (page.room(0)["name"], page.room(1)["name"]) == ("again", "from the other")


LATE = """() => {
  const real = window.fetch;
  window.fetch = async (...words) => {
    const answer = await real(...words);
    if (String(words[0]).includes("/api/plan/")) await new Promise((done) => setTimeout(done, 600));
    return answer;
  };
}"""


def test_a_late_answer_does_not_bring_back_what_was_before(context: Any, folder: Path) -> None:
    """The plan that was asked for before an edit comes after that edit's own answer."""
    one = MapPage(context, context.address, "house.tmap")
    room = one.room(0)
    wish = {"op": "rename_room", "at": [room["x"], room["y"]], "name": "Lab"}
    one.page.evaluate(LATE)
    one.page.evaluate("async (wish) => { const asked = studio.reload(); await studio.edit(wish); await asked; }", wish)
    one.wait_version(1)
    assert one.room(0)["name"] == "Lab" and len(lines(folder)) == 1


def test_files_are_dropped_extracted_and_opened(context: Any, folder: Path, tmp_path: Path) -> None:
    from tests.samples import box_points, write_ply

    scan = tmp_path / f"{EVIL}.ply"
    write_ply(scan, box_points(4000), None, text=False, order="<", kind="f4")
    (folder / f"{EVIL}.ply").write_bytes(scan.read_bytes())
    page = context.new_page()
    page.goto(context.address)
    page.wait_for_selector("li[data-path]")
    assert EVIL in page.inner_text(".lists")
    page.set_input_files("input[type=file]", [scan])
    page.wait_for_selector(".jobs li[data-state=done]")
    page.click(".jobs li[data-state=done] >> text=Open")
    page.wait_for_function("() => document.getElementById('view').dataset.version === '0'")
    assert page.evaluate("window.hit") is None and page.locator("img").count() == 0
    assert len(list(folder.glob("*.tmap"))) == 2


STEPS = """() => { window.seen = new Set(); document.addEventListener("studio:job", (event) => {
  for (const [task, [share, text]] of Object.entries(event.detail.job.steps)) window.seen.add(`${task}: ${text}`);
}); }"""


def test_news_of_the_folder_do_not_lose_a_click(context: Any) -> None:
    page = context.new_page()
    page.goto(context.address)
    page.locator("li[data-path] >> text=Open").first.hover()
    page.mouse.down()
    with page.expect_response("**/api/folder"):
        page.evaluate("document.dispatchEvent(new CustomEvent('studio:folder'))")
    page.wait_for_timeout(200)  # the answer is shown
    page.mouse.up()
    page.wait_for_function("() => document.getElementById('view').dataset.version === '0'")


def save_two(folder: Path) -> None:
    """Two maps of one office in a folder."""
    from tests.fusion.atlas.atlas_scenes import office_map

    for k, name in ((0, "west"), (2, "east")):
        save_map(office_map(k), folder / f"{name}.tmap")


def test_a_merge_shows_each_step_and_is_cancelled(tmp_path: Path, chromium: Any) -> None:
    save_two(tmp_path)
    with run_studio(tmp_path) as (address, _), open_context(chromium) as context:
        page = context.new_page()
        page.goto(address)
        page.wait_for_selector("li[data-path]")
        page.evaluate(STEPS)
        choose = lambda: [page.check(f'li[data-path="{name}.tmap"] input') for name in ("west", "east")]  # noqa: E731
        choose()
        page.click(".actions >> text=Merge")
        page.wait_for_selector(".jobs li[data-state=running] .step progress")
        page.click(".jobs li[data-state=running] >> text=Cancel")
        page.wait_for_selector(".jobs li[data-state=cancelled]")
        assert not list(tmp_path.glob("*/merge.json"))
        choose()
        page.click(".actions >> text=Merge")
        page.wait_for_selector(".jobs li[data-state=done]")
        seen = page.evaluate("[...window.seen]")
        for step in ("draw plans", "search poses", "refine the pose", "join the maps", "write the files"):
            assert f"merge: {step}" in seen, step
        page.click(".jobs li[data-state=done] >> text=Open")
        assert "Merged" in page.inner_text(".verdict")


def test_maps_are_matched_and_moved_by_hand_snapped_and_accepted(tmp_path: Path, chromium: Any) -> None:
    from tests.fusion.atlas.atlas_scenes import office_map, truth
    from topomerge.fusion.fuse import match_common_rooms
    from topomerge.matching.poses import pose_difference
    from topomerge.types import Sim3

    save_two(tmp_path)
    rooms, _ = match_common_rooms(office_map(0), office_map(2), truth(0, 2))
    with run_studio(tmp_path) as (address, _), open_context(chromium) as context:
        page = context.new_page()
        page.goto(address)
        page.wait_for_selector("li[data-path]")
        for name in ("west", "east"):
            page.check(f'li[data-path="{name}.tmap"] input')
        page.click(".actions >> text=Match by hand")
        page.wait_for_function("() => studio.canvases?.every((one) => one.frames > 0)")
        canvases = page.locator(".half .plan-canvas")
        assert canvases.count() == 2

        def click(which: int, room: int) -> None:
            at = page.evaluate(
                "([k, i]) => { const one = studio.canvases[k], { x, y } = one.data.byRoom.get(i); return one.toScreen([x, y]); }",
                [which, room],
            )
            box = canvases.nth(which).bounding_box()
            page.mouse.click(box["x"] + at[0], box["y"] + at[1])

        assert page.locator("[data-act=place]").is_disabled()
        for i, j in rooms[:3].tolist():
            click(0, i)
            click(1, j)
        page.click(".journal li:nth-child(3) button")  # one pair is taken back
        assert page.locator(".journal li").count() == 2
        page.click("[data-act=place]")
        page.wait_for_function("() => studio.overlay && !document.getElementById('view').dataset.busy")
        pose = lambda: Sim3.from_matrix(np.array(page.evaluate("studio.matrix")))  # noqa: E731
        shift, turn, _ = pose_difference(pose(), truth(0, 2), np.zeros(3))
        assert shift < 0.3 and abs(turn) < 0.02 and "Probability" in page.inner_text(".side")
        share = page.evaluate("() => studio.overlay.canvas.sheets.map((s) => s.share)")
        page.fill("input[type=range]", "0.9")
        assert page.evaluate("() => studio.overlay.canvas.sheets.map((s) => s.share)") != share

        box = page.locator(".plan-canvas").bounding_box()
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x + 25, y + 10, steps=5)
        page.mouse.up()
        dragged = pose()
        assert pose_difference(dragged, truth(0, 2), np.zeros(3))[0] > shift + 0.1
        page.keyboard.press("ArrowLeft")
        page.keyboard.press(".")
        assert pose_difference(pose(), dragged, np.zeros(3))[1] != 0
        page.keyboard.press(",")
        page.click("[data-act=snap]")
        page.wait_for_function("() => studio.words && !document.getElementById('view').dataset.busy")
        assert pose_difference(pose(), truth(0, 2), np.zeros(3))[0] < 0.3
        page.click("[data-act=accept]")
        page.wait_for_selector(".jobs li[data-state=done]")
        (merged,) = tmp_path.glob("*/merge.json")
        assert "accepted by hand" in json.loads(merged.read_text())["reason"]
        ops = [json.loads(line)["op"] for path in tmp_path.rglob("*edits.jsonl") for line in path.read_text().splitlines()]
        assert sorted(ops) == ["accept_merge", "match_rooms", "match_rooms"]


def test_a_thousand_rooms_are_panned(tmp_path: Path, chromium: Any) -> None:
    save_map(building(50, 10), tmp_path / "large.tmap")
    with run_studio(tmp_path) as (address, _), open_context(chromium) as context:
        one = MapPage(context, address, "large.tmap")
        assert one.page.evaluate("() => studio.plan.rooms") == 1010
        before = one.page.evaluate("() => [studio.canvas.frames, studio.canvas.view.x]")
        x, y = one.point(*one.page.evaluate("() => studio.plan.size.map(v => v / 2)"))
        one.page.mouse.move(x, y)
        one.page.mouse.down()
        for k in range(30):
            one.page.mouse.move(x + 5 * k, y)
        one.page.mouse.up()
        after = one.page.evaluate("() => [studio.canvas.frames, studio.canvas.view.x]")
        assert after[0] > before[0] + 5 and after[1] < before[1]
        room = one.room(40)
        one.click(room["x"], room["y"])
        assert one.page.inner_text(".side h2") == "Room 40"


def test_a_tablet_pinches_and_taps(folder: Path, chromium: Any) -> None:
    tablet = {"has_touch": True, "viewport": {"width": 800, "height": 1100}}
    with run_studio(folder) as (address, _), open_context(chromium, **tablet) as context:
        one = MapPage(context, address, "house.tmap")
        room = one.room(3)
        one.page.touchscreen.tap(*one.point(room["x"], room["y"]))
        assert one.page.inner_text(".side h2") == "Room 3"
        scale = one.page.evaluate("() => studio.canvas.view.scale")
        touch = context.new_cdp_session(one.page)
        x, y = one.point(room["x"], room["y"])
        send = lambda kind, apart: touch.send(  # noqa: E731
            "Input.dispatchTouchEvent",
            {
                "type": kind,
                "touchPoints": [{"x": x - apart, "y": y, "id": 0}, {"x": x + apart, "y": y, "id": 1}] if apart else [],
            },
        )
        send("touchStart", 40)
        for apart in (60, 80, 100, 120):
            send("touchMove", apart)
        send("touchEnd", 0)
        assert one.page.evaluate("() => studio.canvas.view.scale") > 1.8 * scale
        assert len(list(folder.glob("*.jsonl"))) == 0, "a pinch is no edit"
        one.press("0")
        box, x = room["box"], room["x"] + 30
        one.page.tap("[data-tool=split]")
        for place in ((x, box[1] + 4), (x + 2, box[3] - 4)):
            one.page.touchscreen.tap(*one.point(*place))
        one.wait_version(1)
        assert lines(folder)[-1]["op"] == "split_room" and len(one.storey["rooms"]) == 8
        door = one.storey["doors"][0]
        (x0, y0, x1, y1), moved = door["line"], (30, 0) if abs(door["line"][0] - door["line"][2]) > 1 else (0, 30)
        start, end = ((x0 + x1) / 2, (y0 + y1) / 2), ((x0 + x1) / 2 + moved[0], (y0 + y1) / 2 + moved[1])
        one.page.tap("[data-tool=move]")
        one.page.touchscreen.tap(*one.point(*start))
        one.page.touchscreen.tap(*one.point(*end))
        one.wait_version(2)
        assert lines(folder)[-1]["op"] == "move_door"
        one.page.tap("[data-act=undo]")
        one.wait_version(3)
        assert lines(folder)[-1]["op"] == "undo"


def test_ctrl_c_ends_the_server_and_its_job(folder: Path, chromium: Any) -> None:
    (folder / "in").mkdir()
    with run_studio(folder) as (address, process), open_context(chromium) as context:
        page = context.new_page()
        page.goto(address)
        page.wait_for_selector("li[data-path]")
        shutil.copy(folder / "house.tmap", folder / "copy.tmap")
        job = page.evaluate(
            """paths => fetch("/api/jobs", { method: "POST", body: JSON.stringify({ kind: "merge", paths }) })
            .then((answer) => answer.json()).then((told) => told.job.id)""",
            ["house.tmap", "copy.tmap"],
        )
        assert job == 1
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
        end = time.monotonic() + 30
        while not (started := children.read_text().split()):
            assert time.monotonic() < end
            time.sleep(0.02)
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0
        for number in started:
            with pytest.raises(ProcessLookupError):
                os.kill(int(number), 0)
        page.close()
