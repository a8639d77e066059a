"""Simulate partial maps of a procedural building, and draw them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Polygon
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.core.building import Building, Difficulty
from topomerge.datasets.pairs.lookalike_radio import TRACK_GAP, WIFI
from topomerge.datasets.pairs.pairs import ROOMS_A_MAP, Pair, PairSettings, draw_frames, make_pair, simulate_signs
from topomerge.datasets.simulation.radio import build_radio_plans, place_access_points, simulate_readings
from topomerge.datasets.simulation.scanner import scan_building
from topomerge.datasets.simulation.sensors import get_sensor
from topomerge.datasets.simulation.session import simulate_session
from topomerge.datasets.simulation.signs import READERS
from topomerge.datasets.simulation.walk import sample_part

from topomerge.errors import InputError
from topomerge.io.landmarks import format_landmark_table
from topomerge.types import Array, Landmarks, PointCloud, Sim3, TrueRoom, join_landmarks

TRUTH_FORMAT = 1
SIMULATED_LANDMARKS = {"signs": "text", "tags": "tag", "wifi": "radio"}  # and their kinds in a map
Output = tuple[Path, Callable[[Path], None]]


def simulate_maps(
    kind: str = "office",
    seed: int = 7,
    storeys: int = 1,
    sensors: Sequence[str] = ("tls", "depth"),
    overlap: float = 0.4,
    rooms: int | None = None,
    scale: bool = False,
    hard: str | None = None,
) -> tuple[Building, Pair | PointCloud, Sim3]:
    """Return a building with a pair of maps of it, or with one cloud where one sensor is given; and the frame of the first cloud.

    Args:
        kind, seed, storeys: of the building (`make_building`); "other-storey" takes two storeys at least, with one plan.
        rooms: of each map at most; None: 15 of a pair, all of a single cloud.
        scale: the scale of the second map is unknown.

    Raises:
        InputError: as `make_building` and `make_pair`; no sensors or more than two.
    """
    if not 1 <= len(sensors) <= 2:
        raise InputError(f"give one or two sensors, not {len(sensors)}")
    for sensor in sensors:
        get_sensor(sensor)
    if rooms is not None and rooms < 1:
        raise InputError(f"a map must have 1 room or more, not {rooms}")
    same_plan = hard == "other-storey"
    building = make_building(kind, seed, max(storeys, 2) if same_plan else storeys, Difficulty(differ=0.0) if same_plan else None)
    rng = np.random.default_rng([seed, 1])
    if len(sensors) == 2:
        pair = make_pair(building, PairSettings(overlap, sensors, ROOMS_A_MAP if rooms is None else rooms, scale, hard), rng)
        assert pair.frames is not None
        return building, pair, pair.frames[0]
    if hard or scale:
        raise InputError("hard negatives and free scale need two sensors")
    visited = None if rooms is None else sample_part(building, rooms, rng)
    (frame,) = draw_frames(1, False, rng)
    cloud = scan_building(simulate_session(building, None, rng), sensors[0], visited, rng, frame=frame)
    return building, cloud, frame


def prepare_outputs(
    building: Building, simulated: Pair | PointCloud, frame: Sim3, folder: Path, kinds: Sequence[str] = (), reader: str = "good"
) -> list[Output]:
    """Return the files of a simulation, and what writes each.

    Args:
        kinds: of `SIMULATED_LANDMARKS`, that lie beside each cloud, as `a.landmarks.csv`.
        reader: of `READERS`, of signs and tags.

    Raises:
        InputError: landmarks of another building, whose doors are not known.
    """
    clouds = {"a": simulated} if isinstance(simulated, PointCloud) else {"a": simulated.a, "b": simulated.b}
    files: list[Output] = [(folder / f"{name}.ply", partial(save_cloud, cloud)) for name, cloud in clouds.items()]
    files.append((folder / "truth.json", partial(save_truth, building, simulated, frame)))
    files.append((folder / "plan.png", partial(save_figure, building, simulated, frame)))
    if kinds:
        seen = replace(READERS[reader], kinds=tuple(SIMULATED_LANDMARKS[kind] for kind in kinds if kind != "wifi"))
        read = simulate_signs(building, simulated, seen, frame)
        if "wifi" in kinds:
            wifi = simulate_wifi(building, simulated, frame)
            read = [join_landmarks(both) for both in zip(read, wifi, strict=True)]
        files += [(folder / f"{name}.landmarks.csv", partial(save_landmarks, of)) for name, of in zip(clouds, read, strict=True)]
    return files


def simulate_wifi(building: Building, simulated: Pair | PointCloud, frame: Sim3) -> list[Landmarks]:
    """Simulate what a phone hears that the surveyor of each cloud carries, in the frame of the cloud."""
    sides = [(simulated, frame)]
    if not isinstance(simulated, PointCloud):
        assert simulated.frames is not None
        sides = [(simulated.a, simulated.frames[0]), (simulated.b, simulated.frames[1])]
    plans = build_radio_plans(building)
    points = place_access_points(plans, WIFI, building.seed)
    out = []
    for session, (cloud, to_map) in enumerate(sides):
        assert isinstance(cloud, PointCloud) and cloud.poses is not None
        walk = to_map.inverse().apply(cloud.poses[:, :3, 3])
        walk = walk[np.unique(np.floor(walk / TRACK_GAP), axis=0, return_index=True)[1]]
        level = np.maximum(np.searchsorted(building.storeys["floor"], walk[:, 2], side="right") - 1, 0)
        parts: list[Landmarks] = []
        scans = 0
        for own in np.unique(level).tolist():
            part = simulate_readings(plans, points, walk[level == own, :2], own, WIFI, session)
            part.table["group"] += scans
            scans += int((level == own).sum())
            part.table["position"] = to_map.apply(part.table["position"])
            part.table["sigma"] *= to_map.scale
            parts.append(part)
        out.append(join_landmarks(parts))
    return out


def save_landmarks(landmarks: Landmarks, path: Path) -> None:
    """Write landmarks as a table beside a cloud."""
    path.write_text(format_landmark_table(landmarks), encoding="utf-8")


def save_cloud(cloud: PointCloud, path: Path) -> None:
    """Write x y z (float, m) and the true room (int, -1: none) of each point as binary PLY."""
    rows = np.zeros(len(cloud), [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("room", "<i4")])
    for axis, name in enumerate("xyz"):
        rows[name] = cloud.points[:, axis]
    rows["room"] = -1 if cloud.labels is None else cloud.labels
    head = ["ply", "format binary_little_endian 1.0", "comment simulated by topomerge, metres, z up"]
    head += [f"element vertex {len(rows)}", *(f"property float {n}" for n in "xyz"), "property int room", "end_header"]
    with path.open("wb") as file:
        file.write(("\n".join(head) + "\n").encode("ascii"))
        file.write(rows.tobytes())


def save_truth(building: Building, simulated: Pair | PointCloud, frame: Sim3, path: Path) -> None:
    """Write `truth` as JSON."""
    from topomerge.io.listing import format_json

    path.write_text(format_json(describe_truth(building, simulated, frame)), encoding="utf-8")


def describe_truth(building: Building, simulated: Pair | PointCloud, frame: Sim3) -> dict[str, Any]:
    """Describe the truth of the files, as plain values; everything of a map is in the frame of its cloud.

    `T_ab` (4 x 4, row-major) maps points of b into the frame of a; null for maps of two buildings.
    """
    from topomerge.archive import convert_to_plain

    listing: dict[str, Any] = {"format": TRUTH_FORMAT, "building": building.name, "seed": building.seed}
    if isinstance(simulated, PointCloud):
        return convert_to_plain({**listing, "maps": [_describe_map(building, simulated, frame, "a.ply", ())]})
    pair, transform = simulated, simulated.truth
    assert pair.frames is not None
    listing |= {
        "kind": pair.kind,
        "overlap": pair.overlap,
        "T_ab": None if transform is None else transform.matrix,
        "yaw_deg": None if transform is None else np.degrees(transform.yaw),
        "scale": pair.frames[0].scale / pair.frames[1].scale,
        "shared": sorted(set(pair.visited[0]) & set(pair.visited[1])) if pair.kind == "overlap" else [],
        "seen_by_both": [i for i, _ in pair.shared],
    }
    b = None if pair.kind == "other-building" else building  # the doors of another building are not at hand
    maps = [
        _describe_map(building, pair.a, pair.frames[0], "a.ply", pair.visited[0]),
        _describe_map(b, pair.b, pair.frames[1], "b.ply", pair.visited[1]),
    ]
    return convert_to_plain({**listing, "maps": maps})


def _describe_map(
    building: Building | None, cloud: PointCloud, frame: Sim3, name: str, visited: tuple[int, ...]
) -> dict[str, Any]:
    place, _, sensor = cloud.source.rpartition(":")
    return {
        "file": name,
        "building": place,
        "sensor": sensor,
        "points": len(cloud),
        "visited": visited or None,
        "rooms": [_describe_room(i, room) for i, room in enumerate(cloud.rooms)],
        "doors": [] if building is None else [_describe_door(d, frame) for d in building.doors],
    }


def _describe_room(i: int, room: TrueRoom) -> dict[str, Any]:
    entry = {"id": i, "name": room.name, "kind": room.kind, "storey": room.storey}
    return entry | {"floor": round(room.floor, 4), "ceiling": round(room.ceiling, 4), "polygon": room.polygon.round(4)}


def _describe_door(door: Array, frame: Sim3) -> dict[str, Any]:
    size = {"width": round(float(door["width"] * frame.scale), 4), "height": round(float(door["height"] * frame.scale), 4)}
    return {"rooms": door["rooms"], "centre": frame.apply(door["centre"][None])[0].round(4), **size, "state": str(door["state"])}


ONLY_A, ONLY_B, BOTH, NEITHER, OUTLINE_INK = "#aaccee", "#f3c0a5", "#b5dca9", "#f4f4f4", "#555555"
COLOURS = ("#1f5fa8", "#c2410c")  # points and walk of a and of b
DRAWN_POINTS = 60_000  # of a cloud, drawn
SLICE = (0.3, 2.0)  # m above the floor: walls and furniture
WIDEST = 1600  # pixels


def save_figure(building: Building, simulated: Pair | PointCloud, frame: Sim3, path: Path, dpi: int = 100) -> None:
    """Write `picture` as PNG; the same maps give the same file."""
    plot_maps(building, simulated, frame).savefig(path, format="png", dpi=dpi, metadata={"Software": None})


def plot_maps(building: Building, simulated: Pair | PointCloud, frame: Sim3) -> Figure:
    """Draw each storey that a map visits in the frame of the building; maps of two buildings stand side by side."""
    if isinstance(simulated, PointCloud):
        every = tuple(i for i, r in enumerate(building.rooms) if r.kind != "lift")
        panels = _list_panels(building.rooms, [(simulated, frame, every, 0)])
        title = f"{simulated.source}: {len(building.rooms)} rooms"
    else:
        assert simulated.frames is not None
        sides = [
            (simulated.a, simulated.frames[0], simulated.visited[0], 0),
            (simulated.b, simulated.frames[1], simulated.visited[1], 1),
        ]
        if simulated.kind == "overlap":
            panels = _list_panels(building.rooms, sides)
        else:
            panels = [p for side in sides for p in _list_panels(_transform_rooms(side[0], side[1]), [side])]
        title = f"{simulated.name}: {100 * simulated.overlap:.0f} % of rooms in common"
    return _draw(panels, title, len({side[3] for p in panels for side in p[2]}))


def _transform_rooms(cloud: PointCloud, frame: Sim3) -> tuple[TrueRoom, ...]:
    """Return the rooms of a cloud in the frame of its building."""
    from topomerge.datasets.simulation.scanner import transform_cloud

    return transform_cloud(cloud, frame.inverse()).rooms


def _list_panels(rooms: tuple[TrueRoom, ...], sides: list[Any]) -> list[Any]:
    """List (rooms, storey, sides) of each storey that is visited."""
    storeys = sorted({rooms[i].storey for side in sides for i in side[2]})
    return [(rooms, storey, sides) for storey in storeys]


def _draw(panels: list[Any], title: str, maps: int) -> Figure:
    spans = [np.ptp(np.concatenate([r.polygon for r in rooms if r.storey == k]), axis=0) for rooms, k, _ in panels]
    width, height = np.max(spans, axis=0) + 2.0
    columns = 1 if width > 2 * height else min(len(panels), 2 if width > 0.6 * height else 3)
    rows = -(-len(panels) // columns)
    inches = min(14.0 / (columns * width), 10.0 / (rows * height))
    figure = Figure(figsize=(max(columns * width * inches, 5.0), rows * height * inches + 0.9), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for ax, (rooms, storey, sides) in zip(axes, panels, strict=False):
        _draw_storey(ax, rooms, storey, sides)
    for ax in axes[len(panels) :]:
        ax.set_axis_off()
    figure.suptitle(title, fontsize=11)
    fills = [(ONLY_A, "visited by a"), (ONLY_B, "visited by b"), (BOTH, "visited by both"), (NEITHER, "not visited")]
    fills = fills if maps == 2 else [fills[0], fills[3]]
    lines = [(COLOURS[k], f"walls and walk of {'ab'[k]}") for k in range(maps)]
    handles = [Patch(facecolor=c, edgecolor=OUTLINE_INK, label=t) for c, t in [*fills, *lines]]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), fontsize=8, frameon=False)
    return figure


def _draw_storey(ax: Axes, rooms: tuple[TrueRoom, ...], storey: int, sides: list[Any]) -> None:
    here = [i for i, room in enumerate(rooms) if room.storey == storey]
    for i in here:
        by = {side[3] for side in sides if i in side[2]}
        colour = BOTH if len(by) == 2 else NEITHER if not by else (ONLY_A, ONLY_B)[by.pop()]
        ax.add_patch(Polygon(rooms[i].polygon, facecolor=colour, edgecolor=OUTLINE_INK, linewidth=0.8))
        x, y = rooms[i].polygon.mean(axis=0).tolist()
        ax.annotate(str(i), (x, y), fontsize=7, ha="center", va="center", color=OUTLINE_INK)
    floor = min(rooms[i].floor for i in here)
    above = min((r.floor for r in rooms if r.floor > floor + 1.0), default=floor + 20.0)
    for cloud, frame, _, which in sides:
        back = frame.inverse()
        step = max(len(cloud) // (4 * DRAWN_POINTS), 1)
        points = back.apply(cloud.points[::step])
        height = points[:, 2] - floor
        walls = points[(height > SLICE[0]) & (height < SLICE[1])][:, :2]
        ax.plot(*walls[:: max(len(walls) // DRAWN_POINTS, 1)].T, ",", color=COLOURS[which], alpha=0.35, zorder=3, rasterized=True)
        if cloud.poses is not None:
            _draw_walk(ax, back.apply(cloud.poses[:, :3, 3]), floor, above, COLOURS[which])
    corners = np.concatenate([rooms[i].polygon for i in here])
    (left, bottom), (right, top) = corners.min(axis=0) - 1, corners.max(axis=0) + 1
    ax.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", title=f"storey {storey}")
    ax.tick_params(labelsize=7)


def _draw_walk(ax: Axes, at: Array, floor: float, above: float, colour: str) -> None:
    """Draw the positions of the sensor on this storey; a line joins those of one round."""
    here = (at[:, 2] > floor) & (at[:, 2] < above + 0.2)
    far = np.linalg.norm(np.diff(at, axis=0), axis=1) > 1.0  # a surveyor with a tripod leaves no line
    pieces = np.split(np.where(here[:, None], at, np.nan), np.flatnonzero(far) + 1)
    for piece in pieces:
        ax.plot(piece[:, 0], piece[:, 1], "-", color=colour, linewidth=1.0, alpha=0.8, zorder=4)
    ax.plot(at[here, 0], at[here, 1], ".", color=colour, markersize=3.0, zorder=5)
