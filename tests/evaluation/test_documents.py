"""Generated blocks and the README's figures: they say what made them, and what is stale is found without measuring."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from topomerge.code_digest import compute_code_digest
from topomerge.errors import InputError
from topomerge.evaluation import documents, results_check, tasks

MODULES = ("topomerge.metrics",)
COMMAND = "python evaluate.py task=rooms data=dev data.limit=1"


@pytest.fixture
def page(tmp_path: Path) -> Path:
    path = tmp_path / "page.md"
    path.write_text("# Page\n<!-- rooms:begin -->\nold words\n<!-- rooms:end -->\nafter\n")
    return path


def fresh_stamp() -> documents.Stamp:
    return documents.build_stamp(COMMAND, MODULES, tasks.list_inputs_of(COMMAND))


def test_a_block_says_what_made_it_and_is_fresh(page: Path) -> None:
    assert documents.write_blocks(page, {"rooms": "| a |", "doors": "| b |"}, fresh_stamp()) == ["rooms"]
    text = page.read_text()
    assert "old words" not in text and "| b |" not in text and text.endswith("<!-- rooms:end -->\nafter\n")
    ((_, block),) = documents.BLOCK.findall(text)
    assert documents.read_stamp(block) == fresh_stamp()
    assert not list(results_check.find_stale([page], page.parent))


@pytest.mark.parametrize(
    ("stamp", "said"),
    [
        (documents.Stamp(COMMAND, MODULES, "0123456789abcdef", "x"), "the code has changed and the data has changed since"),
        (documents.Stamp(COMMAND, MODULES, compute_code_digest(*MODULES), "x"), "the data has changed since"),
        (documents.Stamp(COMMAND, ("topomerge.gone",), "0123456789abcdef", "x"), "the code has changed and the data"),
        (documents.Stamp("python -m benchmarks.speed", MODULES, compute_code_digest(*MODULES), "none"), ""),
    ],
)
def test_what_has_changed_is_named(page: Path, stamp: documents.Stamp, said: str) -> None:
    documents.write_blocks(page, {"rooms": "| a |"}, stamp)
    found = list(results_check.find_stale([page], page.parent))
    assert bool(found) == bool(said) and all(said in line and line.startswith("page.md rooms: ") for line in found)


def test_a_stamp_tells_which_rows_are_older(page: Path) -> None:
    stamp = documents.build_stamp(COMMAND, MODULES, ["one"], tasks.describe_confirmed([{"confirmed": 2}, {"confirmed": 2}, {}]))
    assert stamp.confirmed == "2 of 3 rows are older, 2 others came out alike" and not tasks.describe_confirmed([{}])
    documents.write_blocks(page, {"rooms": "| a |"}, stamp)
    assert documents.read_stamp(documents.BLOCK.findall(page.read_text())[0][1]) == stamp


@pytest.mark.parametrize(
    ("confirm", "changed", "measured"),
    [
        (0, (), ["a", "b", "c", "d", "e"]),
        (2, (), ["a", "d"]),
        (2, ("d",), ["a", "d", "b", "c", "e"]),
        (2, ("b",), ["a", "d"]),  # a sample cannot see it
        (9, ("b",), ["a", "b", "c", "d", "e"]),
    ],
)
def test_older_rows_stay_where_a_sample_of_them_comes_out_alike(
    tmp_path: Path, confirm: int, changed: tuple[str, ...], measured: list[str]
) -> None:
    now, calls = "old", []

    def work(name: str) -> tasks.Row:
        calls.append(name)
        value = 1.0 if now == "new" and name in changed else 0.0
        return {"iou": value, "nothing": float("nan"), "scans": [{"seconds": float(len(calls))}]}

    def measure() -> list[tasks.Row]:
        items = {name: (name,) for name in "abcde"}
        return tasks.measure_missing(tmp_path / "rows.jsonl", items, work, list, tasks.TaskSettings(confirm=confirm), now)

    first = measure()
    assert calls == list("abcde") and [row["name"] for row in measure()] == calls and not any("confirmed" in r for r in first)
    now, calls[:] = "new", []
    rows = measure()
    assert calls == measured and [row["code"] for row in rows] == ["new"] * 5
    assert [row["name"] for row in rows if row.get("confirmed")] == [name for name in "abcde" if name not in measured]
    assert [row["name"] for row in rows if row["iou"]] == [name for name in changed if name in measured]
    measure()
    assert calls == measured


@pytest.mark.parametrize(("remake", "measured"), [(False, ["a", "d"]), (True, ["a", "b", "c", "d", "e"])])
def test_rows_behind_a_page_are_confirmed_where_no_cache_is(tmp_path: Path, remake: bool, measured: list[str]) -> None:
    calls: list[str] = []

    def work(name: str) -> tasks.Row:
        calls.append(name)
        return {"iou": 0.5}

    def measure(machine: str, code: str, settings: tasks.TaskSettings, names: str = "abcde") -> list[tasks.Row]:
        calls.clear()
        return tasks.measure_missing(tmp_path / machine / "rows.jsonl", {n: (n,) for n in names}, work, list, settings, code)

    page = tmp_path / "results" / "page.md"
    measure("one", "old", tasks.TaskSettings(write=str(page)))
    kept = page.parent / "rows" / "rows.jsonl.gz"
    before = kept.read_bytes()
    rows = measure("another", "new", tasks.TaskSettings(write=str(page), confirm=2, remake=remake))
    assert sorted(calls) == measured and [row["code"] for row in rows] == ["new"] * 5
    assert set(tasks.read_rows(kept)) == set("abcde") and kept.read_bytes() != before
    measure("third", "new", tasks.TaskSettings(write=str(page)), "af")
    assert calls == ["f"] and set(tasks.read_rows(kept)) == set("abcdef")
    measure("fourth", "new", tasks.TaskSettings(), "a")
    assert calls == ["a"]  # nothing is published, and nothing that was is read


def test_a_block_without_a_stamp_is_stale(page: Path) -> None:
    assert list(results_check.find_stale([page], page.parent)) == ["page.md rooms: nothing says what made it"]
    page.write_text(page.read_text().replace("old words", "<!-- measured at commit abc123 -->"))
    assert list(results_check.find_stale([page], page.parent)) == ["page.md rooms: measured at commit abc123, not since"]


def test_a_page_without_marks_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="has no marks of rooms"):
        documents.write_blocks(tmp_path / "none.md", {"rooms": ""}, fresh_stamp())


def test_inputs_of_a_command_follow_what_it_measures() -> None:
    one, two = (tasks.list_inputs_of(f"python evaluate.py task=rooms data=dev data.limit={n}") for n in (1, 2))
    assert len(one) < len(two) == len(set(two)) and tasks.list_inputs_of("python -m benchmarks.speed") is None
    assert documents.digest_inputs(two) == documents.digest_inputs(two[::-1]) != documents.digest_inputs(one)


def test_figures_are_written_with_what_made_them(tmp_path: Path) -> None:
    path = tmp_path / "documents.json"
    path.write_text(documents.FIGURES.read_text(encoding="utf-8"), encoding="utf-8")
    documents.write_headline(path, {"rooms-homes": ("0.71", "13 maps"), "nothing": ("1", "2")}, fresh_stamp())
    entries = {e["name"]: e for e in json.loads(path.read_text(encoding="utf-8"))["figures"]}
    assert entries["rooms-homes"]["result"] == "0.71" and "nothing" not in entries
    assert documents.read_stamp(entries["rooms-homes"]["stamp"]) == fresh_stamp()
    line = next(line for line in documents.tabulate_headline(path).splitlines() if "real homes" in line)
    assert line.endswith("| 0.71 | 13 maps |")


def test_every_figure_of_the_readme_has_a_source() -> None:
    """The block is what the file says, each entry of which names what made it; no other result stands in the README."""
    text = (documents.ROOT / "README.md").read_text(encoding="utf-8")
    ((_, block),) = [found for found in documents.BLOCK.findall(text) if found[0] == "headline"]
    assert block.strip() == documents.tabulate_headline().strip()
    for entry in documents.read_headline():
        assert documents.read_stamp(entry["stamp"]) or documents.OLD_STAMP.match(entry["stamp"]), entry["name"]
        assert (documents.ROOT / entry["page"]).is_file()
    prose = re.sub(r"(?s)```.*?```|`[^`]*`", "", documents.BLOCK.sub("", text))
    prose = re.sub(
        r"Python [\d.]+(?:, [\d.]+)*(?: or [\d.]+)?|[\d.]+ GB|95 % intervals", "", prose
    )  # versions, sizes of installs
    assert not re.findall(r"\d+(?:\.\d+)? ?%|\b\d\.\d+|\b\d+(?:\.\d+)? (?:s|seconds|times)\b|\b\d+ of \d+\b", prose)


@pytest.mark.longer
def test_the_check_never_fails_and_names_what_it_counts(capsys: pytest.CaptureFixture[str]) -> None:
    assert results_check.main() == 0
    *lines, last = capsys.readouterr().out.splitlines()
    assert last.startswith(f"{len(lines)} blocks and figures are not of this state")
