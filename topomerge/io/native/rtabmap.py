"""Databases of RTAB-Map joined into one that it opens: all nodes with their data, words, links, tags, and one optimised graph.

Rows go from file to file within SQLite, so that no database is held in memory. Numbers of nodes, maps and words are moved up
where they would collide. Loop closures by the user hold sessions together, both ways, as RTAB-Map stores them. All nodes are
dated as the last state, so that it loads all of them into its memory and goes on from there.
Source: the schemas in RTAB-Map's `corelib/src/resources/backward_compatibility`, and how its driver reads them.
"""

from __future__ import annotations

import itertools
import re
import sqlite3
import zlib
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.errors import InputError
from topomerge.io.native import Doubt, Source, Tally, find_nearest_links
from topomerge.io.piece import build_damage_error
from topomerge.io.rtabmap import (
    LARGEST_BLOB,
    MAT_TAIL,
    MAT_TYPES,
    OPTIMISED_SINCE,
    RTABMAP_KIND,
    Poses,
    build_read_address,
    decode_matrix,
    read_poses,
    read_version,
    refuse_open_database,
)
from topomerge.types import Array

ALIKE_SINCE = ((0, 11), (0, 13), (0, 16, 1), (0, 18))  # versions from which nodes, cameras or scans are stored in another way
NODE, MAP, WORD, LABEL = "node", "map", "word", "label"
TABLES: dict[str, dict[str, str]] = {  # and which of their columns count what
    "Node": {"id": NODE, "map_id": MAP, "label": LABEL},
    "Data": {"id": NODE},
    "Word": {"id": WORD},
    "Feature": {"node_id": NODE, "word_id": WORD},
    "Map_Node_Word": {"node_id": NODE, "word_id": WORD},
    "GlobalDescriptor": {"node_id": NODE},
    "Link": {"from_id": NODE, "to_id": NODE},
    "Statistics": {"id": NODE},
    "Info": {},
    "Admin": {},
}
INDEXES = (
    ("UNIQUE ", "Node", "id"), ("UNIQUE ", "Node", "label"), ("", "Feature", "node_id"), ("", "Map_Node_Word", "node_id"),
    ("", "GlobalDescriptor", "node_id"), ("", "Link", "from_id"), ("UNIQUE ", "Statistics", "id"),
)  # fmt: skip
DATED = {"Node": "Node", "Data": "Node", "Word": "Word", "Info": "Info"}  # tables with a time of entry -> whose is set
COLUMN_TYPES = ("INTEGER", "FLOAT", "REAL", "TEXT", "BLOB", "DATE")
USER_CLOSURE = 4  # kind of a link
FLOAT32_WITHIN = 1e4  # m
SAME_TAG = 1.0  # m, within which a tag of one number in two sessions is one
COUNTED = {"nodes": "Node", "links": "Link", "words": "Word", "features": "Feature"}
LARGEST_NUMBER = 2**31 - 1
STAMP, NO_STAMP = re.compile(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d"), "1970-01-01 00:00:00"


@dataclass(frozen=True, eq=False)
class _Session:
    """A database: its version, the poses of its nodes and (below 0) tags, its tables' columns, and when it was last saved."""

    source: Source
    version: tuple[int, ...]
    poses: Poses
    tables: dict[str, dict[str, tuple[str, bool, bool]]]
    warnings: tuple[str, ...]
    stamp: str


def join(sources: Sequence[Source], target: Path, doubt: Doubt) -> Tally:
    """Write all databases as one.

    Raises:
        InputError: one is damaged, or two store their data in ways of different versions.
    """
    sessions = [_read_session(source) for source in sources]
    _check_versions(sessions)
    target.unlink(missing_ok=True)
    newest = max(sessions, key=lambda session: session.version)
    warnings = [f"{session.source.path}: {text}" for session in sessions for text in session.warnings]
    with closing(sqlite3.connect(target, uri=True, isolation_level=None)) as base:
        base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, LARGEST_BLOB)
        for setting in ("trusted_schema = OFF", "journal_mode = OFF", "synchronous = OFF"):
            base.execute(f"PRAGMA {setting}")
        _create_tables(base, newest)
        before: dict[str, int] = dict.fromkeys(COUNTED, 0)
        joined: dict[int, Array] = {}
        nodes: list[list[int]] = []
        stamp = max(session.stamp for session in sessions) or NO_STAMP
        for session in sessions:
            try:
                session_warnings, fresh = _copy_session(base, session, stamp, joined, before)
            except (sqlite3.Error, UnicodeError) as error:
                raise build_damage_error(session.source.path, RTABMAP_KIND, error) from error
            warnings += session_warnings
            nodes.append(sorted(k for k in fresh if k > 0))
            joined = fresh | joined
        between = _link_sessions(base, newest, nodes, joined, doubt)
        _finish(base, newest, joined)
        after = {name: _count(base, "main", table) for name, table in COUNTED.items()}
        placed = _read_placed(base, newest)
    counts = {name: (before[name] + (between if name == "links" else 0), after[name]) for name in COUNTED}
    counts["links between sessions"] = (between, between)
    counts["landmarks"] = (sum(k < 0 for k in joined), sum(k < 0 for k in placed))
    counts["poses"] = (sum(k > 0 for k in joined), sum(k > 0 for k in placed))
    return Tally(counts, tuple(warnings))


def _read_placed(base: sqlite3.Connection, newest: _Session) -> list[int]:
    """Return the numbers of the nodes and, below 0, tags that have optimised poses in the joined database; older ones hold
    none."""
    row = base.execute("SELECT opt_ids FROM Admin").fetchone() if newest.version >= OPTIMISED_SINCE else None
    ids: list[int] = decode_matrix(row[0], "opt_ids").ravel().tolist() if row is not None and row[0] else []
    return ids


def encode_matrix(values: Array) -> bytes:
    """Encode a matrix (rows, columns) as RTAB-Map packs it."""
    kind = next(code for code, name in MAT_TYPES.items() if values.dtype == np.dtype("<" + name))
    return zlib.compress(np.ascontiguousarray(values).tobytes()) + MAT_TAIL.pack(*values.shape, kind)


def encode_pose(pose: Array) -> bytes:
    """Encode the upper three rows of a pose (4, 4) as twelve floats."""
    return pose[:3].astype("<f4").tobytes()


def _read_session(source: Source) -> _Session:
    path = source.path
    refuse_open_database(path)
    try:
        with closing(sqlite3.connect(build_read_address(path), uri=True)) as base:
            base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, LARGEST_BLOB)
            base.execute("PRAGMA trusted_schema = OFF")
            version = read_version(path, base)
            warnings: list[str] = []
            poses = read_poses(path, base, version, warnings)
            tables = _read_columns(path, base)
            stamp = ""
            if "time_enter" in tables.get("Info", {}):
                stamp = str(base.execute("SELECT MAX(time_enter) FROM Info").fetchone()[0])
            return _Session(source, version, poses, tables, tuple(warnings), stamp if STAMP.fullmatch(stamp) else "")
    except sqlite3.Error as error:
        raise build_damage_error(path, RTABMAP_KIND, error) from error


def _read_columns(path: Path, base: sqlite3.Connection) -> dict[str, dict[str, tuple[str, bool, bool]]]:
    """Return the type, whether it is needed, and whether it is the key, of each column of each table that RTAB-Map has."""
    found: dict[str, dict[str, tuple[str, bool, bool]]] = {}
    for name, sql in base.execute("SELECT name, sql FROM sqlite_master WHERE type = 'table'").fetchall():
        if name not in TABLES:
            continue
        if not re.match(r"(?i)\s*CREATE\s+TABLE\s", str(sql)) or re.search(r"(?i)\bAS\b", re.sub(r"--[^\n]*", "", str(sql))):
            raise InputError(f"{path}: has a table {name} that computes its columns, which RTAB-Map never has; copy it again")
        columns = {}
        for _, column, kind, needed, _, key in base.execute(f"PRAGMA table_info({name})"):
            plain = str(kind).upper() or "BLOB"
            if not re.fullmatch(r"\w{1,64}", column) or plain not in COLUMN_TYPES:
                raise InputError(f"{path}: has a column {column[:40]!r} in {name}, which RTAB-Map never has; copy it again")
            columns[column] = (plain, bool(needed), bool(key))
        found[name] = columns
    missing = [f"{name}.{column}" for name in ("Node", "Link") for column in TABLES[name] if column not in found.get(name, {})]
    if missing:
        raise InputError(f"{path}: has no {' and no '.join(missing)}; bring it to a newer version with rtabmap-reprocess")
    return found


def _check_versions(sessions: Sequence[_Session]) -> None:
    def compute_era(session: _Session) -> int:
        return sum(session.version >= since for since in ALIKE_SINCE)

    newest = max(sessions, key=lambda session: session.version)
    for session in sessions:
        if compute_era(session) != compute_era(newest):
            shown, other = (".".join(map(str, s.version)) for s in (session, newest))
            what = (
                f"is of version {shown}, which stores cameras, scans or links in another way than {other} ({newest.source.path})"
            )
            raise InputError(f"{session.source.path}: {what}; bring it there with rtabmap-reprocess")


def _create_tables(base: sqlite3.Connection, newest: _Session) -> None:
    for name, columns in newest.tables.items():
        lines = [f"{c} {kind}{' NOT NULL' if needed else ''}" for c, (kind, needed, _) in columns.items()]
        keys = [c for c, (_, _, key) in columns.items() if key]
        base.execute(f"CREATE TABLE {name} ({', '.join(lines + ([f'PRIMARY KEY ({keys[0]})'] if keys else []))})")


def _copy_session(
    base: sqlite3.Connection, session: _Session, stamp: str, joined: dict[int, Array], before: dict[str, int]
) -> tuple[list[str], dict[int, Array]]:
    """Copy a session behind those that are there; what is to be told, and the poses of its nodes and tags."""
    base.execute("ATTACH ? AS source", (build_read_address(session.source.path),))
    base.execute("BEGIN")
    for name, table in COUNTED.items():
        before[name] += _count(base, "source", table)
    steps = {kind: _get_most(base, "main", kind) for kind in (NODE, MAP, WORD)}
    if any(steps[kind] + _get_most(base, "source", kind) > LARGEST_NUMBER for kind in steps):
        raise InputError(f"{session.source.path}: numbers its nodes, maps or words beyond {LARGEST_NUMBER:,}; reprocess it first")
    poses = {k: pose for k, pose in session.poses.items() if pose is not None}
    moved = session.source.motion.move_poses(np.array(list(poses.values())).reshape(-1, 4, 4))
    placed = dict(zip(poses, moved, strict=True))
    far = float(np.abs(moved[:, :3, 3]).max(initial=0.0))
    if far > FLOAT32_WITHIN:
        raise InputError(
            f"{session.source.path}: comes to lie {far:,.0f} m from the origin, where RTAB-Map's floats keep no "
            "millimetres; merge with the database first"
        )
    tags, session_warnings = _renumber_tags(session, placed, joined)
    first = not _count(base, "main", "Admin")
    for name in TABLES:
        if name in session.tables and (name != "Info" or first) and name != "Admin":
            _copy_table(base, name, session, {**steps, "stamp": stamp}, tags)
    if first:
        _copy_admin(base, session)
    base.execute("COMMIT")
    base.execute("DETACH source")
    return session_warnings, {k + steps[NODE] if k > 0 else tags.get(k, k): pose for k, pose in placed.items()}


def _count(base: sqlite3.Connection, schema: str, table: str) -> int:
    exists = base.execute(f"SELECT 1 FROM {schema}.sqlite_master WHERE type = 'table' AND name = ?", (table,)).fetchone()
    return int(base.execute(f"SELECT COUNT(*) FROM {schema}.{table}").fetchone()[0]) if exists else 0


def _get_most(base: sqlite3.Connection, schema: str, kind: str) -> int:
    """Return the largest number of a kind that any table uses; of maps, one more, as they count from 0."""
    most = -1 if kind == MAP else 0
    for table, columns in TABLES.items():
        for column in (c for c, counted in columns.items() if counted == kind):
            if _count(base, schema, table):
                value = base.execute(f"SELECT MAX(CAST({column} AS INTEGER)) FROM {schema}.{table}").fetchone()[0]
                most = max(most, value if isinstance(value, int) else most)
    return most + (kind == MAP)


def _renumber_tags(session: _Session, placed: dict[int, Array], joined: dict[int, Array]) -> tuple[dict[int, int], list[str]]:
    """Return new numbers of tags that lie elsewhere in the sessions before, where they are other ones."""
    reported: list[str] = []
    fresh: dict[int, int] = {}
    for tag in sorted((k for k in placed if k < 0 and k in joined), reverse=True):
        apart = float(np.linalg.norm(placed[tag][:3, 3] - joined[tag][:3, 3]))
        if apart > SAME_TAG:
            fresh[tag] = min(itertools.chain(placed, joined, fresh.values())) - 1
            reported.append(
                f"{session.source.path}: tag {-tag} lies {apart:.1f} m from that of an earlier one; it is now {-fresh[tag]}"
            )
    return fresh, reported


def _copy_table(base: sqlite3.Connection, name: str, session: _Session, steps: dict[str, Any], tags: dict[int, int]) -> None:
    known = {row[1] for row in base.execute(f"PRAGMA main.table_info({name})")}
    columns = [c for c in session.tables[name] if c in known]
    if not columns:
        return
    values = [_write_value(base, name, column, steps, tags) for column in columns]
    base.execute(f"INSERT INTO main.{name} ({', '.join(columns)}) SELECT {', '.join(values)} FROM source.{name} ORDER BY rowid")


def _write_value(base: sqlite3.Connection, table: str, column: str, steps: dict[str, Any], tags: dict[int, int]) -> str:
    """Return the expression of a column of the source in the joined table."""
    kind = TABLES[table].get(column)
    if kind == LABEL:  # two nodes of one name would break the index
        ending = _choose_ending(base)
        return f"CASE WHEN label IN (SELECT label FROM main.Node) THEN label || '{ending}' ELSE label END"
    if column == "time_enter":
        return f"'{steps['stamp']}'"
    if kind is None:
        return column
    other = "".join(f" WHEN {column} = {old} THEN {new}" for old, new in tags.items()) if kind == NODE else ""
    least = "> 0" if kind != MAP else ">= 0"
    return f"CASE WHEN {column} {least} THEN CAST({column} AS INTEGER) + {steps[kind]}{other} ELSE {column} END"


def _choose_ending(base: sqlite3.Connection) -> str:
    """Choose the ending for names of nodes that another session has, too, so that no two are alike."""
    joined, own = (
        {label for (label,) in base.execute(f"SELECT label FROM {schema}.Node WHERE label IS NOT NULL")}
        for schema in ("main", "source")
    )
    endings = (f"_{k}" for k in itertools.count(2))
    return next(ending for ending in endings if not {f"{label}{ending}" for label in own & joined} & (joined | own))


def _copy_admin(base: sqlite3.Connection, session: _Session) -> None:
    """Copy the version and the preview; all that is drawn of one session's optimised graph is left out: RTAB-Map draws it
    again."""
    known = {row[1] for row in base.execute("PRAGMA main.table_info(Admin)")}
    columns = [c for c in ("version", "preview_image") if c in known and c in session.tables["Admin"]]
    base.execute(f"INSERT INTO main.Admin ({', '.join(columns)}) SELECT {', '.join(columns)} FROM source.Admin LIMIT 1")


def _link_sessions(
    base: sqlite3.Connection, newest: _Session, nodes: Sequence[list[int]], joined: dict[int, Array], doubt: Doubt
) -> int:
    """Loop closures between the sessions at their nearest nodes, both ways; how many rows."""
    places = [np.array([joined[n][:3, 3] for n in own]).reshape(-1, 3) for own in nodes]
    count = 0
    for a, i, b, j in find_nearest_links(places):
        first, second = nodes[a][i], nodes[b][j]
        relative = np.linalg.inv(joined[first]) @ joined[second]
        for ends, transform in (((second, first), np.linalg.inv(relative)), ((first, second), relative)):
            _insert_link(base, newest, ends, transform, doubt)
            count += 1
    return count


def _insert_link(base: sqlite3.Connection, newest: _Session, ends: tuple[int, int], transform: Array, doubt: Doubt) -> None:
    row: dict[str, object] = {"from_id": ends[0], "to_id": ends[1], "type": USER_CLOSURE, "transform": encode_pose(transform)}
    if "information_matrix" in newest.tables["Link"]:
        row["information_matrix"] = doubt.build_information().tobytes()
    else:  # before 0.13
        row |= {"rot_variance": doubt.turn**2, "trans_variance": doubt.place**2}
    row = {name: value for name, value in row.items() if name in newest.tables["Link"]}
    base.execute(f"INSERT INTO Link ({', '.join(row)}) VALUES ({', '.join('?' * len(row))})", list(row.values()))


def _finish(base: sqlite3.Connection, newest: _Session, joined: dict[int, Array]) -> None:
    """Write the optimised poses of all, one state of the memory, indexes, and the triggers that date what is added later."""
    version = ".".join(map(str, newest.version))
    base.execute("UPDATE Admin SET version = ?", (version,))
    if newest.version >= OPTIMISED_SINCE and joined:
        ids = np.array([sorted(joined)], "<i4")
        rows = np.concatenate([joined[k][:3].ravel() for k in ids[0].tolist()])[None].astype("<f4")
        base.execute("UPDATE Admin SET opt_ids = ?, opt_poses = ?", (encode_matrix(ids), encode_matrix(rows)))
    info = newest.tables.get("Info", {})
    for name, value in (("last_sign_added", "(SELECT MAX(id) FROM Node)"), ("dictionary_size", "(SELECT COUNT(*) FROM Word)")):
        if name in info and (name != "dictionary_size" or "Word" in newest.tables):
            base.execute(f"UPDATE Info SET {name} = {value}")
    for unique, table, column in INDEXES:
        if column in newest.tables.get(table, {}):
            name = "node_label" if column == "label" else f"{table}_{column}"
            base.execute(f"CREATE {unique}INDEX IDX_{name} ON {table} ({column})")
    for table, dated in DATED.items():
        if "time_enter" in newest.tables.get(table, {}) and "time_enter" in newest.tables.get(dated, {}):
            act = f"UPDATE {dated} SET time_enter = DATETIME('NOW') WHERE rowid = new.rowid"
            base.execute(f"CREATE TRIGGER insert_{table}_timeEnter AFTER INSERT ON {table} BEGIN {act}; END")
