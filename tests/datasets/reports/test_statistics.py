"""Tables of a set: counted by hand on three tiny pairs."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from topomerge.datasets.reports.statistics import (
    TABLES_BEGIN,
    TABLES_END,
    count_folder,
    count_manifest,
    item_of,
    kind_of,
    main,
    middles_apart,
    report,
)

from topomerge.errors import InputError
from topomerge.io import archive

TURNED = np.array([[0.0, -1, 0, 5], [1, 0, 0, 1], [0, 0, 1, 0], [0, 0, 0, 1]])  # a quarter turn: b's (x, y) is a's (5 - y, 1 + x)


def pair(folder: Path, other_version: bool = False, **changes: object) -> str:
    """Three rooms in a, two in b; rooms 0 and 1 of a are rooms 1 and 0 of b. The name of the file."""
    asked = {
        "source": "procedural", "kind": "office", "buildings": ["1"], "plans": [""], "other": ["2", ""], "seed": 3, "storeys": 1,
        "asked_overlap": 0.5, "sensors": ["tls", "depth"], "rooms": 3, "hard": "", "scale": False, "difficulty": [["glass", 0.1]],
        "voxel_size": 0.1, "points_per_room": 8, "over_stairs": False,
    }  # fmt: skip
    both = {key: [2, 2] for key in ("visited", "identified", "one_to_one", "partners")}
    about = {**asked, **both, "extracted": [3, 2], "overlap": 0.5, **changes}
    name = "0" * 24 if other_version else item_of(about).name
    about["file"] = f"{name}.npz"
    arrays = {
        "a.pos": np.array([[5.0, 1, 0], [3, 2, 9], [0, 0, 0]]),
        "b.pos": np.array([[1.0, 2, 0], [0, 0.4, 0]]),  # 0 lies on room 1 of a but for its height, 1 is 0.4 m from room 0 of a
        "a.true_iou": np.array([0.9, 0.7, 0.0], np.float32),
        "b.true_iou": np.array([0.9, 0.8], np.float32),
        "a.true_one": np.array([True, True, False]),
        "b.true_one": np.array([True, True]),
        "matches": np.array([[0, 1], [1, 0]]),
        "transform": TURNED,
    }
    arrays["about"] = np.frombuffer(json.dumps(about).encode(), np.uint8)
    archive.write(arrays, folder / f"{name}.npz")
    return f"{name}.npz"


@pytest.fixture
def cache(tmp_path: Path) -> Path:
    folder = tmp_path / "pairs"
    folder.mkdir()
    files = [pair(folder)]
    campus = {"source": "campus", "kind": "", "storeys": 2, "over_stairs": True}
    files.append(pair(folder, overlap=0.1, partners=[0, 0], sensors=["tls", "tls"], **campus))
    files.append(pair(folder, overlap=0.0, partners=[0, 0], hard="twin-wing"))
    (folder / ".half.npz").write_bytes(b"half")
    (folder / "d.refused").write_text("house-12-1 has no two parts of 3 rooms; take another seed\n")
    (folder / "e.refused").write_text("fewer than 2 rooms were extracted from a map of mono or tls\n")
    (folder / "f.refused").write_text("fewer than 2 rooms were extracted from a map of tls or depth\n")
    (tmp_path / "set.jsonl").write_text("".join(json.dumps({"file": name}) + "\n" for name in sorted(files)))
    return tmp_path


def test_middles_under_the_true_transform(cache: Path) -> None:
    arrays = archive.read(next(iter((cache / "pairs").glob("[!.]*.npz"))))
    assert np.allclose(middles_apart(arrays), [0.4, 0])
    arrays["b.true_iou"] = np.array([0.5, 0.8])
    assert np.allclose(middles_apart(arrays), [0.4])
    arrays["a.true_one"] = np.array([False, True, False])
    assert middles_apart(arrays).shape == (0,)


def test_tables_by_hand(cache: Path) -> None:
    text = "\n".join(report(count_manifest(cache / "set.jsonl")))
    for line in (
        "3 pairs, 3 items refused;",
        "| tls | 4 | 2.0 | 2.8 | 73 % | 73 % |",  # 8 of 11 rooms of maps with 3, 3, 2, 3
        "| depth | 2 | 2.0 | 2.0 | 100 % | 100 % |",
        "| all | 6 | 2.0 | 2.5 | 80 % | 80 % |",
        "| none | 0 | – | – | 0 |",
        "| below 15 % | 1 | 10 % | 0 % | 1 |",
        "| 35 to 60 % | 1 | 50 % | 80 % | 0 |",
        "| all that overlap | 2 | 30 % | 40 % | 1 |",
        "| hard negatives: 1 twin wing | 1 | 0 % | 0 % | 1 |",
        "| procedural | 2 | 0 | 0 | 2 office |",
        "| campus | 1 | 1 | 1 | plans |",
        "0.20 m apart under the true transform, seen from above (median of 6",
        "| fewer than … rooms were extracted | 2 |",
        "| … has no two parts of … rooms | 1 |",
    ):
        assert line in text, line


def test_a_folder_without_a_manifest_counts_the_same(cache: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert count_folder(cache / "pairs") == count_manifest(cache / "set.jsonl")
    assert main(["--pairs", str(cache / "pairs")]) == 0 and "| all | 6 |" in capsys.readouterr().out


def test_pairs_of_another_version_are_left_out(cache: Path) -> None:
    pair(cache / "pairs", other_version=True)
    counted = count_folder(cache / "pairs")
    assert counted.outdated == 1 and len(counted.rows) == 3 and "1 pairs of another version" in next(report(counted))


def test_written_between_the_marks(cache: Path) -> None:
    page = cache / "page.md"
    page.write_text(f"before\n\n{TABLES_BEGIN}\nold\n{TABLES_END}\n\nafter\n")
    words = [str(cache / "set.jsonl"), "--write", str(page)]
    assert main(words) == 0
    text = page.read_text()
    assert (
        text.startswith(f"before\n\n{TABLES_BEGIN}\n3 pairs")
        and text.endswith(f"|\n{TABLES_END}\n\nafter\n")
        and "old" not in text
    )
    assert main(words) == 0 and page.read_text() == text


def test_mistakes_are_named(cache: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = cache / "page.md"
    page.write_text("no marks")
    (cache / "damaged.jsonl").write_text("{")
    (cache / "empty").mkdir()
    for words, reason in (
        (["nothing.jsonl"], "no such manifest"),
        ([str(cache / "damaged.jsonl")], "damaged"),
        (["--pairs", "nothing"], "no such folder"),
        (["--pairs", str(cache / "empty")], "no pair is there yet"),
        ([str(cache / "set.jsonl"), "--write", str(page)], "lacks"),
        ([str(cache / "set.jsonl"), "--write", "nothing.md"], "can't be read"),
    ):
        assert main(words) == 1
        err = capsys.readouterr().err
        assert reason in err and err.count("\n") == 1
    archive.write({"x": np.zeros(1)}, cache / "pairs" / "z.npz")
    with pytest.raises(InputError, match="is no cached pair"):
        count_folder(cache / "pairs")


def test_reasons_without_names() -> None:
    assert kind_of("no floor found: nowhere are 1 m2 of it; check --up") == "no floor found: nowhere are … … of it".replace(
        "m2", "…"
    )
    assert kind_of("hotel-3-2 has no two parts with 25 % in common; take another") == "… has no two parts with … % in common"
