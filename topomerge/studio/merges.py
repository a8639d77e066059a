"""Merges in the studio: commands beside the server, what a merge says of itself, decisions, and maps placed by hand."""

from __future__ import annotations

import asyncio
import itertools
import json
import os
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.edits.draft import find_room_place
from topomerge.edits.journal import append_edits, build_edit, find_journal, read_journal, select_effective
from topomerge.errors import InputError
from topomerge.fusion.decisions import build_acceptance, place_by_hand
from topomerge.fusion.pipeline import format_probability
from topomerge.progress import PROGRESS_MARK, PROGRESS_VARIABLE
from topomerge.registration.posterior import WORDS
from topomerge.registration.prepared import prepare
from topomerge.studio.folder import StudioFolder, read_listing
from topomerge.studio.maps import OpenMap, OpenMaps
from topomerge.types import Deformation, Sim3, TopometricMap, convert_pose_to_maps
from topomerge.viz.merge_plan import CUT_HEIGHT, deform_path

GRACE = 3.0  # s that a process has to end by itself
MOST_WAITING, MOST_KEPT = 200, 50  # jobs
MOST_LINES, LONGEST_LINE = 50, 1000  # that a job said, and characters of one
ENDED = ("done", "failed", "cancelled")


class JobError(ValueError):
    """There are too many jobs."""


@dataclass
class Job:
    """One command.

    Args:
        id: number.
        kind: "extract", "merge" or "compare".
        title: what the page shows.
        arguments: of the command line after `topomerge`.
        result: the path that it writes, as the page knows it.
        accepted: exit statuses that are no failure.
        state: "waiting", "running", "done", "failed" or "cancelled".
        steps: title of a task -> [share done, what is being done].
        lines: what it said: warnings and the error.
    """

    id: int
    kind: str
    title: str
    arguments: tuple[str, ...]
    result: str
    accepted: tuple[int, ...] = (0,)
    state: str = "waiting"
    steps: dict[str, list[Any]] = field(default_factory=dict)
    lines: list[str] = field(default_factory=list)
    began: float = 0.0
    ended: float = 0.0
    status: int | None = None
    process: asyncio.subprocess.Process | None = field(default=None, repr=False)

    def describe(self) -> dict[str, Any]:
        """Describe it to the page."""
        seconds = round((self.ended or time.time()) - self.began, 1) if self.began else 0.0
        names = ("id", "kind", "title", "result", "state", "steps", "lines", "status")
        return {**{name: getattr(self, name) for name in names}, "seconds": seconds}


class JobQueue:
    """Jobs in the order in which they were asked for; one at a time, as each uses all cores.

    Args:
        folder: in which the commands run.
        tell: is called with a job whenever something changes.
    """

    def __init__(self, folder: Path, tell: Callable[[Job], None]) -> None:
        self.folder, self.tell = folder, tell
        self.jobs: dict[int, Job] = {}
        self._numbers = itertools.count(1)
        self._worker: asyncio.Task[None] | None = None

    def add(self, kind: str, title: str, arguments: Sequence[str], result: str, accepted: tuple[int, ...] = (0,)) -> Job:
        """Add a job, which begins when those before it have ended.

        Raises:
            JobError: too many are waiting.
        """
        if sum(job.state == "waiting" for job in self.jobs.values()) >= MOST_WAITING:
            raise JobError(f"{MOST_WAITING} jobs are waiting; wait until some have ended")
        job = Job(next(self._numbers), kind, title, tuple(arguments), result, accepted)
        self.jobs[job.id] = job
        for old in [j.id for j in self.jobs.values() if j.state in ENDED][:-MOST_KEPT]:
            del self.jobs[old]
        self.tell(job)
        if self._worker is None or self._worker.done():
            self._worker = asyncio.create_task(self._work())
        return job

    async def cancel(self, number: int) -> bool:
        """End a job that waits or runs; False where there is none."""
        job = self.jobs.get(number)
        if job is None or job.state in ENDED:
            return False
        job.state, job.ended = "cancelled", time.time()
        self.tell(job)
        if job.process is not None:
            await _end(job.process)
        return True

    async def close(self) -> None:
        """End all jobs."""
        for number in list(self.jobs):
            await self.cancel(number)
        if self._worker is not None:
            self._worker.cancel()
            with suppress(asyncio.CancelledError):
                await self._worker

    async def _work(self) -> None:
        while (job := next((j for j in self.jobs.values() if j.state == "waiting"), None)) is not None:
            job.state, job.began = "running", time.time()
            self.tell(job)
            try:
                await self._run(job)
            except OSError as error:
                job.state, job.lines = "failed", [*job.lines, f"can't be started ({error.strerror or error})"]
            job.ended = job.ended or time.time()
            self.tell(job)

    async def _run(self, job: Job) -> None:
        environment = {**os.environ, PROGRESS_VARIABLE: "lines", "PYTHONUNBUFFERED": "1"}
        command = [sys.executable, "-m", "topomerge", *job.arguments]
        pipe, null = asyncio.subprocess.PIPE, asyncio.subprocess.DEVNULL
        job.process = await asyncio.create_subprocess_exec(
            *command, cwd=self.folder, env=environment, stdin=null, stdout=null, stderr=pipe, start_new_session=True
        )
        assert job.process.stderr is not None
        try:
            while line := await _read_line(job.process.stderr):
                if self._note(job, line.decode("utf-8", "replace").rstrip()):
                    self.tell(job)
            job.status = await job.process.wait()
        finally:
            await _end(job.process)
        if job.state == "running":
            job.state = "done" if job.status in job.accepted else "failed"

    @staticmethod
    def _note(job: Job, line: str) -> bool:
        """Keep what a job says, and return whether it was anything."""
        if line.startswith(PROGRESS_MARK):
            with suppress(ValueError, TypeError, KeyError):
                message = json.loads(line.removeprefix(PROGRESS_MARK))
                job.steps[str(message["task"])[:80]] = [float(message["share"]), str(message["text"])[:200]]
                return True
        elif line:
            job.lines = [*job.lines, line[:LONGEST_LINE].removeprefix("topomerge: ")][-MOST_LINES:]
            return True
        return False


async def _read_line(stream: asyncio.StreamReader) -> bytes:
    """Return the next line, or part of one that is longer than any should be; nothing at the end."""
    try:
        return await stream.readuntil()
    except asyncio.IncompleteReadError as rest:
        return rest.partial
    except asyncio.LimitOverrunError as long:
        return await stream.read(long.consumed)


async def _end(process: asyncio.subprocess.Process) -> None:
    """End a process and those that it started: kindly, then not."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        if process.returncode is not None:
            return
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, number)
        with suppress(TimeoutError):
            await asyncio.wait_for(process.wait(), GRACE)


LONGEST_NAME = 64  # characters of who decided
MOST_PAIRS = 200  # of rooms that are one
LEAST_SHOWN = 0.005  # probability of an alternative that is listed
MOST_SHOWN = 20  # lines of one kind of evidence
DECISIONS = {
    "accept_merge": "accepted",
    "reject_merge": "rejected",
    "place_map": "placed by hand",
    "match_rooms": "rooms matched",
}


def find_sources(folder: StudioFolder, path: Path, listing: Mapping[str, Any]) -> list[Path | None]:
    """Find the maps that were merged: in the folder, under the name that merge.json has; None where there is none.

    Args:
        folder: of the studio.
        path: of the merge.
        listing: its merge.json.
    """
    found = []
    for one in listing.get("maps", []):
        name = Path(str(one.get("source", "")) if isinstance(one, dict) else "").name
        stem = Path(name).stem
        places = [place / n for place in (folder.root, path.parent, path) for n in (name, f"{stem}.tmap", f"{name}.tmap")]
        maps = (p for p in places if p.suffix == ".tmap" and p.is_file() and p.resolve().is_relative_to(folder.root))
        found.append(next(maps, None))
    return found


def describe_merge(folder: StudioFolder, maps: OpenMaps, path: Path) -> dict[str, Any]:
    """Describe a merge to the page: verdict, evidence, where its maps lie, rigid and bent, and what was decided.

    Args:
        folder: of the studio.
        maps: that are open.
        path: the folder of the merge.

    Raises:
        InputError: its merge.json is damaged, or a map can't be read.
    """
    try:
        return _describe(folder, maps, path, read_listing(path / "merge.json"))
    except InputError:
        raise
    except (KeyError, TypeError, AttributeError, ValueError) as error:  # whatever stands in a stranger's file
        raise InputError(f"{path.name}/merge.json: damaged ({' '.join(str(error).split())[:80]}); merge again") from error


def _describe(folder: StudioFolder, maps: OpenMaps, path: Path, listing: Mapping[str, Any]) -> dict[str, Any]:
    sources = find_sources(folder, path, listing)
    opened = [None if source is None else maps.load(source) for source in sources]
    transforms = listing.get("transforms") or {}
    described = []
    for k, (source, held) in enumerate(zip(sources, opened, strict=True)):
        about = listing["maps"][k]
        name = Path(str(about.get("source", ""))).name
        entry = {"name": name, "rooms": about.get("rooms"), "path": None if source is None else folder.name(source)}
        entry["matrix"] = _find_matrix(transforms, k, held, opened[0])
        entry["bent"] = _draw_bent((listing.get("bend") or {}).get(str(k)), held)
        described.append(entry)
    probability = listing.get("probability")
    properties = [
        ("Probability", format_probability(float(probability)) if isinstance(probability, int | float) else "–"),
        ("Matched rooms", str(len(listing.get("matches") or []))),
        ("Maps in it", f"{len(transforms) + 1 if transforms else 0} of {len(described)}"),
        *[(f"Turn of {described[int(k)]['name']}", f"{t['yaw_deg']:.1f}°") for k, t in sorted(transforms.items())],
        *[(f"Residual of {described[int(k)]['name']}", _format_residual(t["rmse_m"])) for k, t in sorted(transforms.items())],
    ]
    landmarks = (listing.get("evidence") or {}).get("landmarks") or {}
    return {
        "status": str(listing.get("status", "damaged")),
        "reason": str(listing.get("reason", "")),
        "facts": properties,
        "maps": described,
        "proposed": bool(transforms),
        "alternatives": _list_alternatives(listing.get("alternatives") or {}),
        "landmarks": [str(one.get("words", one)) for one in (landmarks.get("witnesses") or [])[:MOST_SHOWN]],
        "contradictions": [str(one.get("words", one)) for one in (listing.get("contradictions") or [])[:MOST_SHOWN]],
        "settle": [str(one.get("words", one)) for one in (listing.get("settle") or [])[:MOST_SHOWN]],
        "decisions": _list_decisions(path),
        "report": folder.name(path / "report.html") if (path / "report.html").is_file() else None,
        "joined": folder.name(path / "map.tmap") if (path / "map.tmap").is_file() else None,
    }


def _list_alternatives(each: Mapping[str, float]) -> list[tuple[str, float]]:
    """List the alternatives in words, each with its probability; the most probable first."""
    ranked = sorted(each.items(), key=lambda one: -one[1])
    return [(WORDS.get(name, name), float(p)) for name, p in ranked if p >= LEAST_SHOWN]


def _format_residual(rmse: float | None) -> str:
    return "not measured" if rmse is None else f"{100 * rmse:.1f} cm"


def _find_matrix(transforms: Mapping[str, Any], k: int, held: OpenMap | None, first: OpenMap | None) -> list[Any] | None:
    """Return T_0k between the maps; None where map k has no place."""
    if held is None or first is None or (k and str(k) not in transforms):
        return None
    matrix = np.array(transforms[str(k)]["matrix"], float) if k else np.eye(4)
    listed: list[Any] = convert_pose_to_maps(matrix, held.base.levelling, first.base.levelling).tolist() if k else matrix.tolist()
    return listed


def _draw_bent(bend: Any, held: OpenMap | None) -> list[str] | None:
    """Draw the walls of each storey as they are bent; None of a map that is rigid."""
    if bend is None or held is None or held.drawn is None:
        return None
    deformation = Deformation.from_json(bend)
    floors = held.base.storeys["floor"]
    return [
        deform_path(walls, held.drawn.sheet, deformation, (float(floors[s]) if len(floors) else 0.0) + CUT_HEIGHT)[1]
        for s, walls in enumerate(held.list_walls())
    ]


def _list_decisions(path: Path) -> list[str]:
    edits = select_effective(read_journal(find_journal(path)).edits)
    return [" · ".join(w for w in (DECISIONS.get(e.op, e.op), e.by, e.time[:16].replace("T", " ")) if w) for e in edits]


def decide(folder: StudioFolder, path: Path, wish: Mapping[str, Any]) -> tuple[str, ...]:
    """Write what somebody decided into the journal of a merge.

    Args:
        folder: of the studio.
        path: of the merge.
        wish: `verdict`: "accept" or "reject", and `by`.

    Returns:
        Words of the command that merges anew.

    Raises:
        InputError: there is nothing to decide.
    """
    sources = find_sources(folder, path, read_listing(path / "merge.json"))
    found, verdict, by = [s for s in sources if s is not None], wish.get("verdict"), str(wish.get("by", ""))[:LONGEST_NAME]
    if verdict not in ("accept", "reject") or len(found) != 2 or len(sources) != 2:
        raise InputError(f"{path.name}: only a merge of two maps of the folder can be accepted or rejected")
    if verdict == "accept":
        edit = build_acceptance(path, (0, 1), by)
    else:
        edit = build_edit("reject_merge", by, maps=[0, 1], sources=[s.name for s in found])
    append_edits(find_journal(path), [edit])
    return ("merge", *(folder.format_word(source) for source in found), "-o", folder.format_word(path))


def accept_placed(maps: OpenMaps, paths: Sequence[Path], place: Path, wish: Mapping[str, Any]) -> None:
    """Begin the folder of a merge with what somebody decided: where two maps lie, and which of their rooms are one.

    Args:
        maps: that are open.
        paths: of the two maps.
        place: the folder, which is made.
        wish: `matrix`: T_ab; perhaps `rooms`: pairs of numbers; and `by`.

    Raises:
        InputError: not two maps, or no such pose or rooms.
    """
    a, b = _load_two(maps, paths)
    by, sources = str(wish.get("by", ""))[:LONGEST_NAME], [path.name for path in paths]
    pairs = _parse_rooms(wish.get("rooms") or [], a, b)
    places = [[find_room_place(map, room).round(3).tolist() for map, room in zip((a, b), two, strict=True)] for two in pairs]
    edits = [build_edit("match_rooms", by, maps=[0, 1], at=at, sources=sources) for at in places]
    edits.append(build_edit("accept_merge", by, maps=[0, 1], matrix=_parse_pose(wish["matrix"]).matrix, sources=sources))
    place.mkdir()
    append_edits(find_journal(place), edits)


def place_pair(maps: OpenMaps, paths: Sequence[Path], wish: Mapping[str, Any]) -> dict[str, Any]:
    """Place the second map on the first: by rooms that are one, or by a pose; both are refined by the walls that are near.

    Args:
        maps: that are open.
        paths: of the two maps.
        wish: `rooms`: two pairs of numbers or more; or `matrix`: T_ab.

    Returns:
        `matrix` (T_ab), `probability`, and `words`: what speaks for it.

    Raises:
        InputError: not two maps, or no such rooms or pose.
    """
    a, b = _load_two(maps, paths)
    start = _parse_pose(wish["matrix"]) if "matrix" in wish else _parse_rooms(wish.get("rooms"), a, b)
    placed = place_by_hand(prepare(a), prepare(b), start)
    parts = ["The walls near it moved it there." if placed.snapped else "There are no walls near it that it could snap to."]
    if placed.registration is not None:
        parts.append(placed.registration.reason)
    parts.append(f"Probability, by what the maps show: {format_probability(placed.probability)}")
    parts += [f"Surfaces are {100 * placed.rmse:.1f} cm apart."] if np.isfinite(placed.rmse) else []
    return {"matrix": placed.pose.matrix.tolist(), "words": parts, "probability": placed.probability}


def _load_two(maps: OpenMaps, paths: Sequence[Path]) -> tuple[TopometricMap, TopometricMap]:
    if len(paths) != 2 or any(path.suffix.lower() != ".tmap" for path in paths):
        raise InputError("two maps are placed at a time; choose two")
    a, b = (maps.load(path).map for path in paths)
    return a, b


def _parse_pose(listed: Any) -> Sim3:
    try:
        return Sim3.from_matrix(np.array(listed, float))
    except (ValueError, TypeError) as error:
        raise InputError(f"the pose is none ({error})") from error


def _parse_rooms(listed: Any, a: TopometricMap, b: TopometricMap) -> list[tuple[int, int]]:
    """Parse pairs of rooms, of which both maps have theirs."""
    counts = len(a.rooms), len(b.rooms)
    try:
        pairs = [(int(i), int(j)) for i, j in listed]
    except (TypeError, ValueError) as error:
        raise InputError("pairs of rooms are wanted: a number of each map") from error
    if len(pairs) > MOST_PAIRS or any(not (0 <= i < counts[0] and 0 <= j < counts[1]) for i, j in pairs):
        raise InputError(f"up to {MOST_PAIRS} pairs of rooms that the maps have are wanted")
    return pairs
