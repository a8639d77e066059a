"""Writer of small true states of Cartographer, by Google's own library from the messages' definitions."""

from __future__ import annotations

import gzip
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

MAGIC = 0x7B1D1F7B5BF501DB
DOUBLE, FLOAT, INT64, INT32, UINT32, BOOL, STRING, MESSAGE, SINT32 = 1, 2, 3, 5, 13, 8, 9, 11, 17
MESSAGES: dict[str, dict[str, tuple[int, Any]]] = {  # name -> field -> number, and type, [type] where it repeats
    "Vector2d": {"x": (1, DOUBLE), "y": (2, DOUBLE)},
    "Vector3d": {"x": (1, DOUBLE), "y": (2, DOUBLE), "z": (3, DOUBLE)},
    "Quaterniond": {"x": (1, DOUBLE), "y": (2, DOUBLE), "z": (3, DOUBLE), "w": (4, DOUBLE)},
    "Rigid3d": {"translation": (1, "Vector3d"), "rotation": (2, "Quaterniond")},
    "SubmapId": {"trajectory_id": (1, INT32), "submap_index": (2, INT32)},
    "NodeId": {"trajectory_id": (1, INT32), "node_index": (2, INT32)},
    "Constraint": {
        "submap_id": (1, "SubmapId"),
        "node_id": (2, "NodeId"),
        "relative_pose": (3, "Rigid3d"),
        "tag": (5, INT32),
        "translation_weight": (6, DOUBLE),
        "rotation_weight": (7, DOUBLE),
    },
    "TrajectoryNode": {"timestamp": (1, INT64), "node_index": (7, INT32), "pose": (5, "Rigid3d")},
    "TrajectorySubmap": {"pose": (1, "Rigid3d"), "submap_index": (2, INT32)},
    "Trajectory": {"node": (1, ["TrajectoryNode"]), "submap": (2, ["TrajectorySubmap"]), "trajectory_id": (3, INT32)},
    "LandmarkPose": {"landmark_id": (1, STRING), "global_pose": (2, "Rigid3d")},
    "PoseGraph": {"constraint": (2, ["Constraint"]), "trajectory": (4, ["Trajectory"]), "landmark_poses": (5, ["LandmarkPose"])},
    "InitialTrajectoryPose": {"relative_pose": (1, "Rigid3d"), "to_trajectory_id": (2, INT32), "timestamp": (3, INT64)},
    "TrajectoryBuilderOptions": {"initial_trajectory_pose": (4, "InitialTrajectoryPose")},
    "SensorId": {"type": (1, INT32), "id": (2, STRING)},
    "OptionsWithSensorIds": {"sensor_id": (1, ["SensorId"]), "trajectory_builder_options": (2, "TrajectoryBuilderOptions")},
    "AllTrajectoryBuilderOptions": {"options_with_sensor_ids": (1, ["OptionsWithSensorIds"])},
    "CellLimits": {"num_x_cells": (1, INT32), "num_y_cells": (2, INT32)},
    "MapLimits": {"resolution": (1, DOUBLE), "max": (2, "Vector2d"), "cell_limits": (3, "CellLimits")},
    "Nothing": {},
    "Grid2D": {
        "limits": (1, "MapLimits"),
        "cells": (2, [INT32]),
        "probability_grid_2d": (4, "Nothing"),
        "tsdf_2d": (5, "Nothing"),
        "min_correspondence_cost": (6, FLOAT),
        "max_correspondence_cost": (7, FLOAT),
    },
    "HybridGrid": {
        "resolution": (1, FLOAT),
        "x_indices": (3, [SINT32]),
        "y_indices": (4, [SINT32]),
        "z_indices": (5, [SINT32]),
        "values": (6, [INT32]),
    },
    "Submap2D": {"local_pose": (1, "Rigid3d"), "num_range_data": (2, INT32), "finished": (3, BOOL), "grid": (4, "Grid2D")},
    "Submap3D": {"local_pose": (1, "Rigid3d"), "num_range_data": (2, INT32), "high_resolution_hybrid_grid": (4, "HybridGrid")},
    "Submap": {"submap_id": (1, "SubmapId"), "submap_2d": (2, "Submap2D"), "submap_3d": (3, "Submap3D")},
    "NodeData": {"timestamp": (1, INT64), "local_pose": (7, "Rigid3d")},
    "Node": {"node_id": (1, "NodeId"), "node_data": (5, "NodeData")},
    "TrajectoryData": {"trajectory_id": (1, INT32), "gravity_constant": (2, DOUBLE), "fixed_frame_origin_in_map": (4, "Rigid3d")},
    "ImuData": {"trajectory_id": (1, INT32)},
    "SerializationHeader": {"format_version": (1, UINT32)},
    "SerializedData": {
        "pose_graph": (1, "PoseGraph"),
        "all_trajectory_builder_options": (2, "AllTrajectoryBuilderOptions"),
        "submap": (3, "Submap"),
        "node": (4, "Node"),
        "trajectory_data": (5, "TrajectoryData"),
        "imu_data": (6, "ImuData"),
    },
}


@cache
def load_messages() -> dict[str, Any]:
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    file = descriptor_pb2.FileDescriptorProto(name="cartographer.proto", package="carto", syntax="proto3")
    for name, fields in MESSAGES.items():
        message = file.message_type.add(name=name)
        for field, (number, kind) in fields.items():
            one = kind[0] if isinstance(kind, list) else kind
            added = message.field.add(name=field, number=number, label=3 if isinstance(kind, list) else 1)
            added.type = MESSAGE if isinstance(one, str) else one
            if isinstance(one, str):
                added.type_name = f".carto.{one}"
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return {name: message_factory.GetMessageClass(pool.FindMessageTypeByName(f"carto.{name}")) for name in MESSAGES}


def rigid(pose: np.ndarray) -> Any:
    messages = load_messages()
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
    turn = messages["Quaterniond"](x=x, y=y, z=z, w=w)
    return messages["Rigid3d"](translation=messages["Vector3d"](**dict(zip("xyz", pose[:3, 3], strict=True))), rotation=turn)


def matrix(message: Any) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat([getattr(message.rotation, axis) for axis in "xyzw"]).as_matrix()
    pose[:3, 3] = [getattr(message.translation, axis) for axis in "xyz"]
    return pose


def write_messages(path: Path, messages: Sequence[Any], version: int = 2) -> Path:
    head = load_messages()["SerializationHeader"](format_version=version)
    data = MAGIC.to_bytes(8, "little")
    for message in (head, *messages):
        packed = gzip.compress(message.SerializeToString())
        data += len(packed).to_bytes(8, "little") + packed
    path.write_bytes(data)
    return path


def read_messages(path: Path) -> list[Any]:
    data, at, found = path.read_bytes(), 8, []
    while at < len(data):
        length = int.from_bytes(data[at : at + 8], "little")
        kind = "SerializedData" if found else "SerializationHeader"
        found.append(load_messages()[kind].FromString(gzip.decompress(data[at + 8 : at + 8 + length])))
        at += 8 + length
    return found


def grid_of(odds: np.ndarray, corner: tuple[float, float], resolution: float = 0.1) -> Any:
    """A grid of probabilities (along x, along y from the corner down); nan is unknown."""
    m = load_messages()
    values = np.where(np.isnan(odds), 0, 1 + np.rint((0.9 - np.nan_to_num(odds, nan=0.9)) / 0.8 * 32766)).astype(int)
    # cell (ix, iy) stands at ix + nx * iy; x of the map falls with iy, y with ix
    limits = m["MapLimits"](resolution=resolution, max=m["Vector2d"](x=corner[0], y=corner[1]))
    limits.cell_limits.CopyFrom(m["CellLimits"](num_x_cells=odds.shape[1], num_y_cells=odds.shape[0]))
    grid = m["Grid2D"](limits=limits, cells=values.ravel().tolist(), min_correspondence_cost=0.1, max_correspondence_cost=0.9)
    grid.probability_grid_2d.SetInParent()
    return grid


def room_odds(size: tuple[int, int] = (40, 30)) -> np.ndarray:
    """A room of 4 by 3 m in cells of 10 cm, its walls 1 cell thick, in what is unknown."""
    odds = np.full((size[0] + 8, size[1] + 8), np.nan)
    odds[4:-4, 4:-4] = 0.85
    odds[5:-5, 5:-5] = 0.15
    return odds


def state(
    trajectories: int = 1, *, local: np.ndarray | None = None, apart: bool = False, spatial: bool = False, tag: str = "tag 7"
) -> list[Any]:
    """Messages of a state: of each trajectory two submaps of one room and three nodes, moved by 0.5 m a trajectory.

    Args:
        local: pose of the frame of a trajectory in which its grids lie, seen from the map; default: turned and moved.
        apart: no constraint joins the trajectories.
    """
    m = load_messages()
    frame = np.eye(4)
    frame[:2, :2] = (0.8, -0.6), (0.6, 0.8)
    frame[:2, 3] = 1.0, -2.0
    frame = frame if local is None else local
    graph, rest = m["PoseGraph"](), []
    options = m["AllTrajectoryBuilderOptions"]()
    for t in range(trajectories):
        own = m["Trajectory"](trajectory_id=t)
        added = options.options_with_sensor_ids.add()
        added.sensor_id.add(type=0, id=f"scan_{t}")
        added.trajectory_builder_options.initial_trajectory_pose.to_trajectory_id = t
        for s in range(2):
            pose = np.eye(4)
            pose[:3, 3] = 0.5 * t + 0.2 * s, 0.1, 0.0
            there = frame @ pose
            own.submap.add(submap_index=s, pose=rigid(there))
            submap = m["Submap"](submap_id=m["SubmapId"](trajectory_id=t, submap_index=s))
            if spatial:
                cells = np.argwhere(np.ones((5, 4, 3))) - 2
                grid = m["HybridGrid"](resolution=0.1, values=[30000] * 59 + [100])
                for k, name in enumerate(("x_indices", "y_indices", "z_indices")):
                    getattr(grid, name).extend(cells[:, k].tolist())
                submap.submap_3d.local_pose.CopyFrom(rigid(pose))
                submap.submap_3d.high_resolution_hybrid_grid.CopyFrom(grid)
            else:
                submap.submap_2d.local_pose.CopyFrom(rigid(pose))
                submap.submap_2d.grid.CopyFrom(grid_of(room_odds(), (4.4 + 6.0 * t, 3.4)))
                submap.submap_2d.finished = True
            rest.append(m["SerializedData"](submap=submap))
        for n in range(3):
            pose = np.eye(4)
            pose[:3, 3] = 1.0 + n, 1.0 + t, 0.0
            own.node.add(node_index=n, timestamp=1000 + n, pose=rigid(frame @ pose))
            data = m["NodeData"](timestamp=1000 + n, local_pose=rigid(pose))
            rest.append(m["SerializedData"](node=m["Node"](node_id=m["NodeId"](trajectory_id=t, node_index=n), node_data=data)))
            for other in {t} if apart else {t, 0}:
                ids = {"submap_id": m["SubmapId"](trajectory_id=other), "node_id": m["NodeId"](trajectory_id=t, node_index=n)}
                graph.constraint.add(**ids, relative_pose=rigid(pose), translation_weight=1.0, rotation_weight=2.0)
        graph.trajectory.append(own)
        rest.append(m["SerializedData"](trajectory_data=m["TrajectoryData"](trajectory_id=t, gravity_constant=9.8)))
        rest.append(m["SerializedData"](imu_data=m["ImuData"](trajectory_id=t)))
    graph.landmark_poses.add(landmark_id=tag, global_pose=rigid(frame))
    heads = [m["SerializedData"](pose_graph=graph), m["SerializedData"](all_trajectory_builder_options=options)]
    return [*heads, *rest]
