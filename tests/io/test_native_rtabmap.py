"""Databases of RTAB-Map joined into one: nothing lost, no number twice, one frame, and what RTAB-Map needs to go on."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.io.rtabmap_bases import Node, numbers, pose_bytes, write_rtabmap
from tests.io.test_read_folders import refusal_of
from tests.io.test_read_rtabmap import scan_nodes
from tests.io.walks import room_walk
from topomerge.errors import InputError
from topomerge.io import read_points
from topomerge.io.native import NATIVE, Doubt, Motion, Source, Tally, save_joined
from topomerge.io.rtabmap import decode_matrix, decode_pose
from topomerge.types import Sim3

MOTION = Motion(Sim3(0.5, (1.0, -2.0, 0.25)).matrix)
DOUBT = Doubt(0.1, 0.02)


def write_session(path: Path, version: str = "0.23.0", extra: int = 0, **more: Any) -> Path:
    """A walk with words, features, links to neighbours and times of entry, as RTAB-Map leaves it."""
    nodes = [Node(**{**vars(n), "label": "door" if k == 1 else None}) for k, n in enumerate(scan_nodes(room_walk(), version))]
    path = write_rtabmap(path, nodes, version, [n.pose for n in nodes] if numbers(version) >= (0, 17) else (), **more)
    with closing(sqlite3.connect(path)) as base:
        table = "Feature" if numbers(version) >= (0, 13) else "Map_Node_Word"
        base.execute("CREATE TABLE Word (id INTEGER NOT NULL, descriptor BLOB, time_enter DATE, PRIMARY KEY (id))")
        base.execute(f"CREATE TABLE {table} (node_id INTEGER NOT NULL, word_id INTEGER NOT NULL, pos_x FLOAT)")
        for name in ("Node", "Info"):
            base.execute(f"ALTER TABLE {name} ADD COLUMN time_enter DATE")
        base.execute("ALTER TABLE Info ADD COLUMN last_sign_added INTEGER")
        base.execute("UPDATE Info SET time_enter = '2026-01-02 03:04:05'")
        if numbers(version) < (0, 13):  # a variance for turns and one for places
            base.execute("DROP TABLE Link")
            columns = "type INTEGER, rot_variance FLOAT NOT NULL, trans_variance FLOAT NOT NULL, transform BLOB"
            base.execute(f"CREATE TABLE Link (from_id INTEGER NOT NULL, to_id INTEGER NOT NULL, {columns})")
        for word in range(1, 4):
            base.execute("INSERT INTO Word VALUES (?, ?, '2026-01-01 00:00:00')", (word, bytes([word + extra])))
            base.execute(f"INSERT INTO {table} VALUES (?, ?, ?)", (word, word, 10.0 * word))
            base.execute(f"INSERT INTO {table} VALUES (?, -1, 5.0)", (word,))  # a feature that is no word
        between = (1.0, 1.0) if numbers(version) < (0, 13) else (np.eye(6).tobytes(),)
        for a, b in [(k, k + 1) for k in range(1, len(nodes))] + [(k + 1, k) for k in range(1, len(nodes))]:
            step = np.linalg.inv(nodes[a - 1].pose) @ nodes[b - 1].pose
            marks = ", ".join("?" * (4 + len(between)))
            base.execute(f"INSERT INTO Link VALUES ({marks})", (a, b, 0, *between, pose_bytes(step)))
        base.commit()
    return path


def join(folder: Path, *sources: Source) -> Tally:
    return save_joined(NATIVE["rtabmap"], sources, folder / "joined.db", DOUBT)


def ask(path: Path, query: str) -> list[Any]:
    with closing(sqlite3.connect(path)) as base:
        return base.execute(query).fetchall()


def poses_of(path: Path) -> dict[int, np.ndarray]:
    ((ids, rows),) = ask(path, "SELECT opt_ids, opt_poses FROM Admin")
    poses = decode_matrix(rows, "poses").reshape(-1, 3, 4)
    return {int(k): np.vstack([pose, (0, 0, 0, 1)]) for k, pose in zip(decode_matrix(ids, "ids").ravel(), poses, strict=True)}


@pytest.mark.parametrize("version", ["0.17.0", "0.18.0", "0.23.0"])
def test_two_sessions_become_one(tmp_path: Path, version: str) -> None:
    a, b = (write_session(tmp_path / f"{name}.db", version, extra) for name, extra in (("a", 0), ("b", 100)))
    kept = a.read_bytes(), b.read_bytes()
    tally = join(tmp_path, Source(a), Source(b, MOTION))
    out = tmp_path / "joined.db"
    assert (a.read_bytes(), b.read_bytes()) == kept
    count = len(room_walk().poses)
    assert tally.counts["nodes"] == (2 * count, 2 * count) and tally.counts["features"] == (12, 12)
    assert all(before == after for before, after in tally.counts.values()), tally.counts
    assert ask(out, "PRAGMA integrity_check") == [("ok",)]
    assert ask(out, "SELECT COUNT(*), COUNT(DISTINCT id), MAX(id), COUNT(DISTINCT map_id) FROM Node") == [
        (2 * count, 2 * count, 2 * count, 2)
    ]
    assert ask(out, "SELECT id, scan, scan_info FROM Data WHERE id > 0 ORDER BY id") == [
        (row[0] + k * count, *row[1:])
        for k, p in enumerate((a, b))
        for row in ask(p, "SELECT id, scan, scan_info FROM Data ORDER BY id")
    ]
    assert [d for (d,) in ask(out, "SELECT descriptor FROM Word ORDER BY id")] == [bytes([n]) for n in (1, 2, 3, 101, 102, 103)]
    assert ask(out, f"SELECT node_id, word_id FROM Feature WHERE node_id > {count} AND word_id > 0") == [
        (count + k, 3 + k) for k in (1, 2, 3)
    ]
    assert ask(out, "SELECT COUNT(*) FROM Feature WHERE word_id = -1") == [(6,)]
    placed, first = poses_of(out), poses_of(a)
    for k in range(1, count + 1):
        np.testing.assert_allclose(placed[k], first[k], rtol=0, atol=1e-7)
        np.testing.assert_allclose(placed[k + count], MOTION.matrix @ first[k], rtol=0, atol=1e-6)
    assert {label for (label,) in ask(out, "SELECT label FROM Node WHERE label IS NOT NULL")} == {"door", "door_2"}


def test_links_between_sessions_say_what_the_merge_says(tmp_path: Path) -> None:
    a, b = write_session(tmp_path / "a.db"), write_session(tmp_path / "b.db")
    tally = join(tmp_path, Source(a), Source(b, MOTION))
    count, placed = len(room_walk().poses), poses_of(tmp_path / "joined.db")
    rows = ask(tmp_path / "joined.db", f"SELECT * FROM Link WHERE type = 4 AND from_id <= {count}")
    back = ask(tmp_path / "joined.db", f"SELECT * FROM Link WHERE type = 4 AND from_id > {count}")
    assert 2 * len(rows) == 2 * len(back) == tally.counts["links between sessions"][1] > 0
    for a_node, b_node, _, information, transform in rows:
        relative = np.linalg.inv(placed[a_node]) @ placed[b_node]
        np.testing.assert_allclose(decode_pose(transform), relative, rtol=0, atol=1e-6)
        spread = np.linalg.inv(np.frombuffer(information).reshape(6, 6))
        np.testing.assert_allclose(np.sqrt(np.diag(spread)), [0.1] * 3 + [0.02] * 3)


def test_all_nodes_are_of_the_last_state(tmp_path: Path) -> None:
    """RTAB-Map loads nodes and words that entered after the last line of Info."""
    a, b = write_session(tmp_path / "a.db"), write_session(tmp_path / "b.db")
    join(tmp_path, Source(a), Source(b, MOTION))
    out = tmp_path / "joined.db"
    for table, total in (("Node", 2 * len(room_walk().poses)), ("Word", 6)):
        late = f"SELECT COUNT(*) FROM {table} WHERE time_enter >= (SELECT MAX(time_enter) FROM Info)"
        assert ask(out, late) == [(total,)]
    assert ask(out, "SELECT COUNT(*), MAX(last_sign_added) FROM Info") == [(1, 2 * len(room_walk().poses))]
    with closing(sqlite3.connect(out)) as base:  # what RTAB-Map adds is dated by a trigger
        base.execute("INSERT INTO Node (id, map_id) VALUES (1000, 9)")
        assert base.execute("SELECT time_enter > '2026-06' FROM Node WHERE id = 1000").fetchone() == (1,)


def test_it_is_read_again_as_one_cloud(tmp_path: Path) -> None:
    a, b = write_session(tmp_path / "a.db"), write_session(tmp_path / "b.db")
    join(tmp_path, Source(a), Source(b, MOTION))
    clouds = [read_points(path).points for path in (a, b, tmp_path / "joined.db")]
    np.testing.assert_allclose(clouds[2][: len(clouds[0])], clouds[0], rtol=0, atol=1e-5)
    np.testing.assert_allclose(clouds[2][len(clouds[0]) :], MOTION.move_points(clouds[1]), rtol=0, atol=1e-5)


def test_a_joined_base_is_joined_again(tmp_path: Path) -> None:
    a, b, c = (write_session(tmp_path / f"{name}.db") for name in "abc")
    join(tmp_path, Source(a), Source(b, MOTION))
    first = (tmp_path / "joined.db").rename(tmp_path / "ab.db")
    join(tmp_path, Source(first), Source(c, MOTION))
    assert ask(tmp_path / "joined.db", "SELECT COUNT(DISTINCT map_id), COUNT(*) FROM Node") == [(3, 3 * len(room_walk().poses))]
    labels = [label for (label,) in ask(tmp_path / "joined.db", "SELECT label FROM Node WHERE label > '' ORDER BY label")]
    assert len(set(labels)) == 3


def test_same_bytes_again(tmp_path: Path) -> None:
    a, b = write_session(tmp_path / "a.db"), write_session(tmp_path / "b.db")
    join(tmp_path, Source(a), Source(b, MOTION))
    once = (tmp_path / "joined.db").read_bytes()
    join(tmp_path, Source(a), Source(b, MOTION))
    assert (tmp_path / "joined.db").read_bytes() == once


def test_old_links_get_two_variances(tmp_path: Path) -> None:
    a, b = (write_session(tmp_path / f"{name}.db", "0.11.10") for name in "ab")
    tally = join(tmp_path, Source(a), Source(b, MOTION))
    rows = ask(tmp_path / "joined.db", "SELECT rot_variance, trans_variance FROM Link WHERE type = 4")
    assert rows and all(np.allclose(row, (0.02**2, 0.1**2)) for row in rows)
    assert tally.counts["features"] == (0, 0)  # they are in Map_Node_Word
    assert ask(tmp_path / "joined.db", "SELECT COUNT(*) FROM Map_Node_Word") == [(12,)]


def test_tags_of_one_number(tmp_path: Path) -> None:
    """A tag that lies where the other session has it is one; elsewhere it is another."""
    at = np.eye(4)
    at[:3, 3] = 1, 2, 1
    back = np.linalg.inv(MOTION.matrix) @ at
    a, b = write_session(tmp_path / "a.db", tag=(5, at)), write_session(tmp_path / "b.db", tag=(5, back))
    same = join(tmp_path, Source(a), Source(b, MOTION))
    assert same.counts["landmarks"] == (1, 1) and not same.warnings
    far = write_session(tmp_path / "far.db", tag=(5, np.eye(4)))
    other = join(tmp_path, Source(a), Source(far, MOTION))
    assert other.counts["landmarks"] == (2, 2) and "tag 5 lies" in other.warnings[0]
    assert {k for k in poses_of(tmp_path / "joined.db") if k < 0} == {-5, -6}


def test_what_cannot_be_joined_is_refused(tmp_path: Path) -> None:
    new, old = write_session(tmp_path / "new.db"), write_session(tmp_path / "old.db", "0.17.0")
    with pytest.raises(InputError, match=r"old.db: is of version 0.17.0, which stores .* rtabmap-reprocess"):
        join(tmp_path, Source(new), Source(old, MOTION))
    cut = tmp_path / "cut.db"
    cut.write_bytes(new.read_bytes()[:9000])
    with pytest.raises(InputError, match=r"cut\.db"):
        join(tmp_path, Source(new), Source(cut, MOTION))
    twice = write_session(tmp_path / "twice.db")
    with closing(sqlite3.connect(twice)) as base:
        base.execute("CREATE TABLE GlobalDescriptor (node_id INTEGER, data BLOB AS (zeroblob(1000000000)) VIRTUAL)")
        base.commit()
    with pytest.raises(InputError, match="computes its columns"):
        join(tmp_path, Source(new), Source(twice, MOTION))
    far = Motion(Sim3(0.0, (480_000.0, 5_400_000.0, 0.0)).matrix)
    with pytest.raises(InputError, match="where RTAB-Map's floats keep no millimetres"):
        join(tmp_path, Source(new), Source(new, far))
    assert not (tmp_path / "joined.db").exists()
    assert refusal_of(cut)
