"""Reports: what stands in them, that nothing from outside becomes markup, and that a browser shows them without a word."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
import subprocess
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from tests.io.export_maps import doubted
from tests.scenes import two_rooms
from tests.scenes_map import HEIGHT, building
from tests.viz.chromium import browser
from tests.viz.test_figures import without_rooms
from topomerge.cli.main import main
from topomerge.errors import InputError
from topomerge.extraction.landmarks import add_landmarks
from topomerge.types import AREA_DTYPE, EDGE_DTYPE, TopometricMap, VoxelGrid, build_landmarks, join_landmarks
from topomerge.viz.plan import build_scene_data
from topomerge.viz.report import render_report_html, save_report
from topomerge.viz.tables import build_element, embed_json, join

EVIL = "</script><img src=x onerror=alert(1)>\"'&{{script}}<!--.ply"


class Page(HTMLParser):
    """The elements of a page, and that each is closed."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.feed(text)
        assert not self.open, self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in ("meta", "input", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def all(self, tag: str, name: str | None = None) -> list[dict[str, str | None]]:
        of_tag = [about for t, about in self.elements if t == tag]
        return [a for a in of_tag if name is None or name in (a.get("class") or "").split()]


def data_of(text: str) -> dict:
    match = re.search(r'<script type="application/json" id="scene-data">(.*?)</script>', text, re.S)
    assert match
    return json.loads(match[1])


def test_every_room_and_door_is_in_plan_and_table() -> None:
    map = building(2, 2)
    page = Page(render_report_html(map))
    rows = page.all("tr")
    assert [row["data-room"] for row in rows if "data-room" in row] == [str(i) for i in range(10)]
    assert sorted(int(p["data-room"] or -1) for p in page.all("path", "room")) == list(range(10))
    assert sorted(int(p["data-room"] or -1) for p in page.all("g", "label")) == list(range(10))
    assert {row["data-edge"] for row in rows if "data-edge" in row} == {str(i) for i in range(len(map.edges))}
    assert len(page.all("g", "door")) == len(map.edges) + 1  # the stairs stand on both storeys
    assert len(page.all("svg", "plan")) == 2
    assert [p["data-room"] for p in page.all("path", "glimpsed")] == ["0"]


def test_what_is_shown_says_how_sure_it_is() -> None:
    map = doubted()
    page = Page(render_report_html(map))
    sure = [f"{odds:.3f}" for odds in map.rooms["confidence"]]
    for tag, name in (("path", "room"), ("g", "label"), ("circle", "node"), ("tr", None)):
        said = {a["data-room"]: a["data-sure"] for a in page.all(tag, name) if "data-room" in a}
        assert said == {str(r): odds for r, odds in enumerate(sure)}
    doors = ["0.400", "0.300", "0.600", "0.600", "0.600"]  # no surer than their rooms
    for tag, name in (("g", "door"), ("tr", None)):
        said = {a["data-edge"]: a["data-sure"] for a in page.all(tag, name) if "data-edge" in a}
        assert said == {str(i): odds for i, odds in enumerate(doors)}
    assert sorted(a["data-sure"] or "" for a in page.all("path", "link")) == sorted([*doors, doors[-1]]), "stairs: on each storey"
    assert [a["data-sure"] for a in page.all("g", "window")] == ["0.880", "0.770", "0.200"]


def test_one_file_without_a_network() -> None:
    text = render_report_html(building(1, 1))
    page = Page(text)
    for _, about in page.elements:
        assert not {"src", "srcset", "action", "data", "ping"} & set(about)
        assert (about.get("href") or "#") == "#"
        assert not [name for name in about if name.startswith("on")]
    assert "http://" not in text and "https://" not in text and "@import" not in text
    policy = next(m["content"] for m in page.all("meta") if m.get("http-equiv") == "Content-Security-Policy")
    assert policy and "default-src 'none'" in policy and "sha256-" in policy and "unsafe-inline'; script" in policy


def test_names_stay_text() -> None:
    map = building(1, 1)
    odd = replace(map, source=f"/tmp/{EVIL}", warnings=(EVIL, "\udcff\x00"), parameters={EVIL: EVIL}, seconds={EVIL: 1.0})
    plain, escaped = Page(render_report_html(map)), Page(render_report_html(odd))
    assert not escaped.all("img")
    assert len(escaped.all("script")) == len(plain.all("script")) == 2
    assert render_report_html(odd).count("{{script}}") >= 4  # told as it is, not filled in
    assert data_of(render_report_html(odd)) == data_of(render_report_html(map))


def test_markup_escapes() -> None:
    link = build_element("a", "<b>", build_element("i", "x&y"), class_="k", data_x='"<', title=None, hidden=True)
    assert link == '<a class="k" data-x="&quot;&lt;" hidden>&lt;b&gt;<i>x&amp;y</i></a>'
    assert join(["<", build_element("b")], "&") == "&lt;&<b></b>"  # what stands between is the program's own
    data = embed_json({"a": "</script><!--&\u2028"}, "x")
    assert "</script>" not in data[:-9] and "<!--" not in data and "\u2028" not in data
    assert json.loads(re.sub("<[^>]*>", "", data))["a"] == "</script><!--&\u2028"


def test_same_map_same_bytes_written_whole(tmp_path: Path) -> None:
    for name in ("a.html", "b.html"):
        save_report(building(2, 2), tmp_path / name)
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.html", "b.html"]
    with pytest.raises(InputError, match="can't be written"):
        save_report(building(1, 1), tmp_path / "absent" / "a.html")


def test_size() -> None:
    big = building(30, 1)  # 1,300 m2
    assert big.rooms["area"].sum() > 1250
    assert len(render_report_html(big)) < 3e6


def test_areas_and_stairs_are_drawn() -> None:
    map = building(1, 2)
    areas = np.zeros(2, AREA_DTYPE)
    areas["room"] = 2
    narrow = np.zeros(1, EDGE_DTYPE)
    narrow["rooms"], narrow["centre"], narrow["width"] = (0, 1), map.rooms["centroid"][2], 1.8
    edges = map.edges.copy()
    stairs = edges["kind"] == "stairs"
    edges["lower"][stairs] = edges["centre"][stairs] - (2, 0, 0)
    edges["upper"][stairs] = edges["centre"][stairs] + (2, 0, HEIGHT * 0.1)
    edges["open"][0] = False
    page = Page(render_report_html(replace(map, areas=areas, narrows=narrow, edges=edges)))
    assert len(page.all("line", "narrow")) == 1
    assert len(page.all("path", "flight")) == 2 and len(page.all("path", "tread")) == 2
    assert len(page.all("g", "shut")) == 1


def nothing() -> TopometricMap:
    grid = VoxelGrid.from_cells(np.zeros((0, 3), np.int32))
    none = np.zeros(0, np.int32)
    return without_rooms(replace(building(1, 1), grid=grid, room=none, navigable=grid, navigable_room=none, navigable_area=none))


def test_maps_with_little_in_them() -> None:
    for map in (without_rooms(building(1, 1)), nothing()):
        page = Page(render_report_html(map))
        assert len(page.all("svg", "plan")) == 1


def test_a_map_of_two_far_cells() -> None:
    grid = VoxelGrid.from_cells(np.array([[0, 0, 0], [200_000, 5, 3]]))
    map = without_rooms(replace(building(1, 1), grid=grid, room=np.full(2, -1, np.int32)))
    assert max(build_scene_data(map)["shape"]) <= 65_536 and build_scene_data(map)["drawn"] == 2


def test_command_line_writes_it(tmp_path: Path) -> None:
    np.save(tmp_path / "scan.npy", two_rooms().points())
    words = ["extract", str(tmp_path / "scan.npy"), "-o", str(tmp_path / "a.tmap"), "--report", str(tmp_path / "a.html"), "-q"]
    assert main(words) == 0
    page = Page((tmp_path / "a.html").read_text(encoding="utf-8"))
    assert len(page.all("path", "room")) == 2


# In a browser ---------------------------------------------------------------------------------------------------------

FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    *("--enable-logging=stderr", "--virtual-time-budget=4000", "--window-size=1440,1500"),
)
# Presses the page's own buttons, then writes what it saw into its title.
PROBE = """
window.addEventListener("load", () => setTimeout(() => {
  const seen = {};
  const shown = () => [...document.querySelectorAll(".sheet figure")].map((figure) => !figure.hidden);
  seen.first = shown();
  document.querySelectorAll("button[data-storey]")[1].click();
  seen.second = shown();
  seen.rows = [...document.querySelectorAll("#plan tr[data-room]")].filter((row) => row.offsetParent).length;
  const over = (element) => element.dispatchEvent(new PointerEvent("pointerover", { bubbles: true }));
  over(document.querySelector('#plan tr[data-room="7"]'));
  seen.lit = document.querySelector('path.room[data-room="7"]').classList.contains("on");
  over(document.querySelector('path.room[data-room="8"]'));
  seen.row = document.querySelector('#plan tr[data-room="8"]').classList.contains("on");
  seen.told = document.querySelector(".told").textContent;
  const heads = document.querySelectorAll("#plan thead button");
  heads[2].click();
  heads[2].click();
  seen.areas = [...document.querySelectorAll("#plan tbody tr")].map((row) => Number(row.cells[2].dataset.value));
  document.getElementById("theme").click();
  seen.theme = getComputedStyle(document.body).backgroundColor;
  seen.scene = document.querySelector(".scene").dataset.state;
  const at = (type, x) => new PointerEvent(type, { bubbles: true, clientX: x, clientY: 300, pointerId: 1 });
  const way = [["pointerdown", 100], ["pointermove", 160], ["pointerup", 160]];
  const drag = (area) => way.forEach(([type, x]) => area.dispatchEvent(at(type, x)));
  const svg = document.querySelector(".sheet figure:not([hidden]) svg");
  const before = svg.getAttribute("viewBox").split(" ").map(Number);
  drag(svg);
  const moved = svg.getAttribute("viewBox").split(" ").map(Number);
  svg.dispatchEvent(new WheelEvent("wheel", { bubbles: true, deltaY: -300, clientX: 300, clientY: 300, ctrlKey: true }));
  const zoomed = svg.getAttribute("viewBox").split(" ").map(Number);
  seen.moves = moved[0] < before[0] && moved[2] === before[2] && zoomed[2] < moved[2];
  const stage = document.querySelector(".stage");
  drag(stage);
  stage.dispatchEvent(new WheelEvent("wheel", { bubbles: true, deltaY: -300, ctrlKey: true }));
  document.querySelectorAll(".scene input").forEach((input) => {
    if (input.type === "range") input.value = input.max;
    else input.click();
    input.dispatchEvent(new Event("input"));
  });
  document.title = JSON.stringify(seen);
}, 500));
"""


def browse(page: Path, *more: str) -> tuple[str, list[str]]:
    """The page after its scripts, and what they wrote to the console."""
    profile = page.parent / "profile"
    command = [browser(), *FLAGS, f"--user-data-dir={profile}", *more, page.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True, errors="replace")
    lines = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    return done.stdout, [line for line in lines if "GPU stall due to ReadPixels" not in line]  # of software drawing


def with_probe(text: str, probe: str = PROBE) -> str:
    digest = base64.b64encode(hashlib.sha256(probe.encode()).digest()).decode()
    text = text.replace("script-src ", f"script-src 'sha256-{digest}' ")
    return text.replace("</body>", f"<script>{probe}</script></body>")


@pytest.mark.longer
def test_in_a_browser(tmp_path: Path) -> None:
    page = tmp_path / "a.html"
    map = replace(building(2, 2), source=EVIL, warnings=(EVIL,))
    page.write_text(with_probe(render_report_html(map)), encoding="utf-8")
    text, console = browse(page, "--dump-dom")
    assert console == []
    title = re.search("<title>(.*?)</title>", text)
    assert title
    seen = json.loads(title[1].replace("&quot;", '"'))
    assert (seen["first"], seen["second"]) == ([True, False], [False, True])
    assert seen["rows"] == 5 and seen["lit"] and seen["row"]
    assert seen["told"].startswith("room 8 · storey 1 · area")
    assert seen["areas"] == sorted(seen["areas"], reverse=True)
    assert seen["theme"] == "rgb(19, 21, 23)"
    assert seen["scene"] == "shown" and seen["moves"]


SLIDE = """
window.addEventListener("load", () => setTimeout(() => {
  const slider = document.querySelector("input[data-sure]");
  const numbers = (words, name) => [...document.querySelectorAll(words)].filter((one) => one.getClientRects().length)
    .map((one) => one.dataset[name]).sort().join(" ");
  const state = () => [numbers(".plan path.room", "room"), numbers(".plan g.door", "edge"), numbers(".plan g.window", "sure"),
    numbers(".plan path.link", "sure"), numbers("#plan tr[data-room]", "room"), numbers("#doors tr[data-edge]", "edge")];
  const seen = [0, 50, 90].map((least) => {
    slider.value = least;
    slider.dispatchEvent(new Event("change", { bubbles: true }));
    return state();
  });
  document.title = JSON.stringify(seen);
}, 500));
"""


@pytest.mark.longer
def test_the_slider_hides_what_is_less_sure(tmp_path: Path) -> None:
    page = tmp_path / "a.html"
    page.write_text(with_probe(render_report_html(doubted()), SLIDE), encoding="utf-8")
    text, console = browse(page, "--dump-dom")
    assert console == []
    title = re.search("<title>(.*?)</title>", text)
    assert title
    none, half, most = json.loads(title[1].replace("&quot;", '"'))
    assert none == ["0 1 2", "0 1 4", "0.200 0.770 0.880", "0.300 0.400 0.600", "0 1 2", "0 1 2 3 4"]  # the table: of all storeys
    assert half == ["0 2", "4", "0.770 0.880", "0.600", "0 2", "2 3 4"]
    assert most == ["0", "", "", "", "0", ""]


@pytest.mark.longer
def test_without_webgl_words_stand_there(tmp_path: Path) -> None:
    page = tmp_path / "a.html"
    save_report(building(1, 1), page)
    text, console = browse(page, "--dump-dom", "--disable-3d-apis")
    assert 'data-state="missing"' in text and "does not offer" in text
    assert console == []


# Landmarks ------------------------------------------------------------------------------------------------------------

SIGN = "<script>document.title='run'</script>"


def marked() -> TopometricMap:
    """Two storeys with a sign that would run, a name, an object upstairs, and a tag that is known by its room alone."""
    map = building(1, 2)
    middle = map.rooms["centroid"]
    parts = [
        build_landmarks("text", [SIGN], EVIL, middle[:1]),
        build_landmarks("name", ["Kitchen"], "by hand", room=1),
        build_landmarks("object", ["Fire Hose"], "robot", middle[4:5]),
        build_landmarks("tag", ["t:7"], "robot", room=2),
        build_landmarks("radio", ["aa:bb"] * 3, "robot", middle[:3], number=-60.0),
    ]
    return add_landmarks(map, join_landmarks(parts))


def test_landmarks_are_on_the_plan_and_in_the_tables() -> None:
    text = render_report_html(marked())
    page, plain = Page(text), Page(render_report_html(building(1, 2)))
    marks = page.all("g", "landmark")
    assert [(a["class"], a["data-room"]) for a in marks] == [("landmark text", "0"), ("landmark object", "4")]
    words = {a["data-room"]: a["data-words"] for a in page.all("tr") if "data-room" in a and "data-words" in a}
    assert words == {"0": f"0\n{SIGN.lower()}", "1": "1\nkitchen", "2": "2\nt:7", "3": "3", "4": "4\nfire hose", "5": "5"}
    assert [a["data-words"] for a in page.all("tr") if "data-words" in a and "data-room" not in a] == [
        SIGN.lower(), "kitchen", "fire hose", "t:7",
    ]  # fmt: skip
    assert "7 landmarks (1 text, 1 tag, 3 radio, 1 object, 1 name)" in text
    assert len(page.all("script")) == len(plain.all("script")) == 2 and SIGN not in text and "&lt;script&gt;document" in text
    assert [a.get("data-layer") for a in page.all("input") if a.get("data-layer")] == [
        "labels",
        "graph",
        "doors",
        "landmarks",
        "all",
    ]
    assert not plain.all("g", "landmark") and not [a for a in plain.all("input") if "data-find" in a]
    assert "data-words" not in render_report_html(building(1, 1)).replace("[data-words]", "")


def test_very_many_landmarks_are_bounded() -> None:
    map = building(1, 1)
    many = build_landmarks("text", [f"sign {k}" for k in range(20_000)], "here", np.tile(map.rooms["centroid"][0], (20_000, 1)))
    text = render_report_html(add_landmarks(map, many))
    page = Page(text)
    assert len(page.all("g", "landmark")) == 1000 and len(text) < len(render_report_html(map)) + 2e6
    assert "20,000 landmarks (20,000 text), the surest 1000" in text


FIND = """
window.addEventListener("load", () => setTimeout(() => {
  const input = document.querySelector("input[data-find]");
  const there = (words) => [...document.querySelectorAll(words)].filter((one) => one.getClientRects().length);
  const state = () => [
    there("#plan tr[data-room]").map((row) => row.dataset.room).join(" "),
    there(".plan .landmark").map((mark) => mark.dataset.words.slice(0, 4)).join(" "),
    [...document.querySelectorAll(".sheet figure")].findIndex((figure) => !figure.hidden),
  ];
  document.querySelector('input[data-layer="all"]').click();
  const seen = ["", "HOSE", "kitch", "<script>", "nothing"].map((words) => {
    input.value = words;
    input.dispatchEvent(new Event("input", { bubbles: true }));
    return state();
  });
  input.value = "";
  input.dispatchEvent(new Event("input", { bubbles: true }));
  document.querySelector('input[data-layer="landmarks"]').click();
  seen.push(there(".plan .landmark").length);
  document.title = JSON.stringify(seen);
}, 500));
"""


@pytest.mark.longer
def test_landmarks_are_searched_shown_and_never_run(tmp_path: Path) -> None:
    page = tmp_path / "a.html"
    page.write_text(with_probe(render_report_html(marked()), FIND), encoding="utf-8")
    text, console = browse(page, "--dump-dom")
    assert console == []
    title = re.search("<title>(.*?)</title>", text)
    assert title
    every, hose, kitchen, script, nothing, hidden = json.loads(html.unescape(title[1]))
    assert every == ["0 1 2 3 4 5", "<scr", 0]
    assert hose == ["4", "fire", 1], "upstairs, which is shown then"
    assert kitchen == ["1", "", 0] and script == ["0", "<scr", 0] and nothing == ["", "", 0] and hidden == 0
