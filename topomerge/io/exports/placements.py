"""Where the maps of a merge or an atlas lie: for ROS 2 a launch file that publishes their frames by tf2's static transforms, and
a pose graph of g2o, to optimise it elsewhere, and to come back with `topomerge move`.

``ros2 launch merged.launch.xml``. The frame of a map is that of its file; the parent is the first map's. A bent merge has more to
say than one transform: this one lays what both maps saw on each other. Source: the arguments of static_transform_publisher.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
from scipy.spatial.transform import Rotation

from topomerge.archive import replace_on_success
from topomerge.errors import InputError
from topomerge.io.native.pose_graph import PoseGraph, format_pose_graph
from topomerge.types import Array, Sim3, TopometricMap, is_level, read_levelling

LISTINGS = ("merge.json", "atlas.json")
SAME_SCALE = 1e-6


@dataclass(frozen=True)
class FramePose:
    """The pose of a map's frame in that of another one: it takes points of the child into the parent.

    Args:
        tilted: (4, 4) float64, the pose, where either file was tilted, so that it is more than a turn about the vertical.
    """

    parent: str
    child: str
    pose: Sim3
    tilted: Array | None = None


def save_launch(map: TopometricMap, path: Path, transforms: Sequence[FramePose] = ()) -> None:
    """Write a launch file in XML.

    Raises:
        InputError: there are no transforms, or one scales.
    """
    if not transforms:
        raise InputError("tf2: needs to know where maps lie; give the folder of a merge or an atlas that brought some together")
    nodes = [_format_node(k, transform) for k, transform in enumerate(transforms)]
    with replace_on_success(path) as temporary:
        temporary.write_text("\n".join(["<launch>", *nodes, "</launch>"]) + "\n", encoding="utf-8")


def save_graph(map: TopometricMap, path: Path, graph: PoseGraph | None = None) -> None:
    """Write the pose graph; a vertex is a map, by its number in merge.json or atlas.json.

    Raises:
        InputError: there is no graph, or the path can't be written.
    """
    del map
    if graph is None:
        raise InputError("g2o: needs to know where maps lie; give the folder of a merge or an atlas that brought some together")
    with replace_on_success(path) as temporary:
        temporary.write_text(format_pose_graph(graph), encoding="utf-8")


def _format_node(number: int, transform: FramePose) -> str:
    pose = transform.pose
    if abs(pose.scale - 1) > SAME_SCALE:
        at = f"{transform.child} is {pose.scale:.4g} times as large in the frame of {transform.parent}"
        raise InputError(f"tf2: {at}, and transforms of ROS can't scale; read it again with --scale {pose.scale:.6g}")
    if transform.tilted is None:
        translation, quaternion = pose.translation, (0.0, 0.0, math.sin(pose.yaw / 2), math.cos(pose.yaw / 2))
    else:
        translation = tuple(transform.tilted[:3, 3])
        quaternion = tuple(Rotation.from_matrix(transform.tilted[:3, :3] / pose.scale).as_quat())
    place = dict(zip(("x", "y", "z"), translation, strict=True))
    turn = dict(zip(("qx", "qy", "qz", "qw"), quaternion, strict=True))
    arguments = [f"--{name} {float(value)!r}" for name, value in {**place, **turn}.items()]
    arguments += [f"--frame-id {transform.parent}", f"--child-frame-id {transform.child}"]
    node = f'pkg="tf2_ros" exec="static_transform_publisher" name="map_frame_{number}"'
    return f"  <node {node} args={quoteattr(' '.join(arguments))}/>"


def read_frame_poses(folder: Path, names: Sequence[str] = ()) -> list[FramePose]:
    """Read the poses of maps from the listing of a merge or an atlas.

    Args:
        folder: that of the merge or the atlas.
        names: of the frames of all its maps, in their order; without, the names of their files.

    Raises:
        InputError: it is no such folder, its listing is damaged, or there are not as many names as maps.
    """
    file = next((folder / name for name in LISTINGS if (folder / name).is_file()), None)
    if file is None:
        raise InputError(f"{folder}: is no folder of a merge or an atlas ({' or '.join(LISTINGS)} is missing); tf2 needs one")
    try:
        listing: Any = json.loads(file.read_text(encoding="utf-8"))
        sources = [str(m.get("name") or m["source"]) for m in listing["maps"]]
        frames = _choose_frame_names(sources, names)
        levelled = [read_levelling(m) for m in listing["maps"]]
        entries = sorted((int(k), int(t["into"]), t) for k, t in listing["transforms"].items())
        return [_parse_frame_pose((frames[into], frames[k]), t, (levelled[into], levelled[k])) for k, into, t in entries]
    except InputError:
        raise
    except (ValueError, KeyError, IndexError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(f"{file}: damaged ({' '.join(str(error).split())[:100]}); merge the maps again") from error


def _parse_frame_pose(frames: tuple[str, str], entry: Mapping[str, Any], levelled: tuple[Array, Array]) -> FramePose:
    """Return the pose of the second frame in the first one, of an entry of `transforms` (docs/outputs.md)."""
    x, y, z = (float(row[3]) for row in entry["matrix"][:3])
    pose = Sim3(math.radians(float(entry["yaw_deg"])), (x, y, z), float(entry["scale"]))
    matrix = None if all(map(is_level, levelled)) else np.array(entry["matrix"], np.float64)
    return FramePose(*frames, pose, matrix)


def _choose_frame_names(sources: Sequence[str], names: Sequence[str]) -> list[str]:
    """Choose the names of frames, no two alike: letters, digits, `_` and `/`, as ROS has them."""
    if names and len(names) != len(sources):
        raise InputError(
            f"--frames: gives {len(names)} names, but there are {len(sources)} maps; give one for each, in their order"
        )
    wrong = [name for name in names if not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_/]*", name)]
    if wrong or len(set(names)) < len(names):
        what = f"{wrong[0]!r} is no name of a frame" if wrong else "two frames have one name"
        raise InputError(f"--frames: {what}; take letters, digits and _, another one for each map")
    if names:
        return list(names)
    plain = [re.sub(r"[^A-Za-z0-9_]", "_", Path(source).name.partition(".")[0]) for source in sources]
    return plain if all(plain) and len(set(plain)) == len(plain) else [f"map_{k}" for k in range(len(sources))]
