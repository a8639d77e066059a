"""A room of 4 x 3 x 2.5 m as a depth camera sees it, and writers of the layouts in which data sets have such images."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from tests.io.walks import START, write_tum

FOCAL, CENTRE, SHAPE = (525.0, 525.0), (319.5, 239.5), (480, 640)
ROOM = np.array([4.0, 3.0, 2.5])
COLOR = (10, 20, 30)
CAMERA = np.array([[FOCAL[0], 0, CENTRE[0], 0], [0, FOCAL[1], CENTRE[1], 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
MILLIMETRES = 1000.0
NO_POSE = np.full((4, 4), -np.inf)


def looking(turn: float, place: tuple[float, ...], tilt: float = 0.0) -> np.ndarray:
    """A camera that looks along a turn about z, raised by a tilt: z is ahead, y down."""
    ahead = np.array([np.cos(turn) * np.cos(tilt), np.sin(turn) * np.cos(tilt), np.sin(tilt)])
    right = np.array([np.sin(turn), -np.cos(turn), 0])
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([right, np.cross(ahead, right), ahead])
    pose[:3, 3] = place
    return pose


def camera_poses() -> np.ndarray:
    """Three places in the room."""
    return np.stack([looking(0.3, (1, 1, 1.2)), looking(2.0, (2, 1.5, 1.2)), looking(4.0, (3, 2, 1.0))])


def poses_all_around() -> np.ndarray:
    """From two places, all that there is to see."""
    turns = np.arange(0, 2 * np.pi, 0.7)
    return np.stack([looking(t, place, tilt) for place in ((1.2, 1, 1.3), (2.8, 2, 1.3)) for t in turns for tilt in (-0.6, 0.6)])


def depth_image(pose: np.ndarray, metre: float = 5000.0) -> np.ndarray:
    """(480, 640) uint16: how far along the camera's axis the walls of the room are."""
    rows, columns = np.indices(SHAPE)
    rays = np.stack([(columns - CENTRE[0]) / FOCAL[0], (rows - CENTRE[1]) / FOCAL[1], np.ones(SHAPE)], axis=-1) @ pose[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(rays > 0, (ROOM - pose[:3, 3]) / rays, -pose[:3, 3] / rays)
        share = np.where(rays == 0, np.inf, share).min(axis=-1)
    return np.rint(share * metre).astype(np.uint16)


def color_image(scale: int = 1) -> Image.Image:
    """All of one colour."""
    return Image.fromarray(np.full((SHAPE[0] * scale, SHAPE[1] * scale, 3), COLOR, np.uint8))


def matrix_text(matrix: np.ndarray) -> str:
    return "\n".join(" ".join(f"{v:.17g}" for v in row) for row in matrix) + "\n"


def write_tum_images(folder: Path, poses: np.ndarray, metre: float = 5000.0) -> Path:
    """The TUM benchmark."""
    for name in ("depth", "rgb"):
        (folder / name).mkdir(parents=True)
    times = START + np.arange(len(poses))
    for pose, time in zip(poses, times.tolist(), strict=True):
        Image.fromarray(depth_image(pose, metre)).save(folder / "depth" / f"{time:.6f}.png")
        color_image().save(folder / "rgb" / f"{time + 0.01:.6f}.png")
    (folder / "depth.txt").write_text("# depth\n" + "".join(f"{t:.6f} depth/{t:.6f}.png\n" for t in times))
    (folder / "rgb.txt").write_text("".join(f"{t + 0.01:.6f} rgb/{t + 0.01:.6f}.png\n" for t in times))
    write_tum(folder / "groundtruth.txt", poses, times)
    if metre != 5000.0:
        (folder / "camera.txt").write_text(f"{FOCAL[0]} {FOCAL[1]} {CENTRE[0]} {CENTRE[1]} {metre}\n")
    return folder


def write_replica(folder: Path, poses: np.ndarray) -> Path:
    """Replica as NICE-SLAM has it; the camera stands above the folder."""
    (folder / "results").mkdir(parents=True)
    for number, pose in enumerate(poses):
        Image.fromarray(depth_image(pose, MILLIMETRES)).save(folder / "results" / f"depth{number:06d}.png")
        color_image().save(folder / "results" / f"frame{number:06d}.jpg", quality=100)
    (folder / "traj.txt").write_text("".join(" ".join(f"{v:.18e}" for v in pose.ravel()) + "\n" for pose in poses))
    sizes = {"w": SHAPE[1], "h": SHAPE[0], "fx": FOCAL[0], "fy": FOCAL[1], "cx": CENTRE[0], "cy": CENTRE[1]}
    (folder.parent / "cam_params.json").write_text(json.dumps({"camera": {**sizes, "scale": MILLIMETRES}}))
    return folder


def write_scannet(folder: Path, poses: np.ndarray) -> Path:
    """What ScanNet's exporter writes; the colours are twice as large."""
    for name in ("depth", "color", "pose", "intrinsic"):
        (folder / name).mkdir(parents=True)
    for number, pose in enumerate(poses):
        if np.isfinite(pose).all():
            Image.fromarray(depth_image(pose, MILLIMETRES)).save(folder / "depth" / f"{number}.png")
        else:
            Image.fromarray(np.ones(SHAPE, np.uint16)).save(folder / "depth" / f"{number}.png")
        color_image(2).save(folder / "color" / f"{number}.jpg", quality=100)
        (folder / "pose" / f"{number}.txt").write_text(matrix_text(pose))
    (folder / "intrinsic" / "intrinsic_depth.txt").write_text(matrix_text(CAMERA))
    (folder / "intrinsic" / "intrinsic_color.txt").write_text(matrix_text(np.diag([2.0, 2, 1, 1]) @ CAMERA))
    return folder


def write_3rscan(folder: Path, poses: np.ndarray) -> Path:
    """3RScan, unpacked into `sequence/`."""
    sequence = folder / "sequence"
    sequence.mkdir(parents=True)
    flat = " ".join(f"{v:g}" for v in CAMERA.ravel())
    lines = ["m_versionNumber = 4", "m_sensorName = room", f"m_colorWidth = {SHAPE[1]}", f"m_colorHeight = {SHAPE[0]}"]
    lines += [f"m_depthWidth = {SHAPE[1]}", f"m_depthHeight = {SHAPE[0]}", "m_depthShift = 1000"]
    lines += [f"m_calibrationColorIntrinsic = {flat} ", f"m_calibrationDepthIntrinsic = {flat} ", f"m_frames.size = {len(poses)}"]
    (sequence / "_info.txt").write_text("\n".join(lines) + "\n")
    for number, pose in enumerate(poses):
        stem = sequence / f"frame-{number:06d}"
        head = f"P5\n{SHAPE[1]} {SHAPE[0]}\n65535\n".encode()
        stem.with_suffix(".depth.pgm").write_bytes(head + depth_image(pose, MILLIMETRES).astype(">u2").tobytes())
        color_image().save(stem.with_suffix(".color.jpg"), quality=100)
        stem.with_suffix(".pose.txt").write_text(matrix_text(pose))
    return folder


def write_arkit(folder: Path, poses: np.ndarray) -> Path:
    """ARKitScenes; poses are those of the world in the camera."""
    for name in ("lowres_depth", "lowres_wide", "lowres_wide_intrinsics", "confidence"):
        (folder / name).mkdir(parents=True)
    lines = []
    for number, pose in enumerate(poses):
        time = 6791.213 + 0.1 * number
        name = f"40753679_{time:.3f}"
        Image.fromarray(depth_image(pose, MILLIMETRES)).save(folder / "lowres_depth" / f"{name}.png")
        color_image().save(folder / "lowres_wide" / f"{name}.png")
        Image.fromarray(np.full(SHAPE, 2, np.uint8)).save(folder / "confidence" / f"{name}.png")
        numbers = (SHAPE[1], SHAPE[0], *FOCAL, *CENTRE)
        (folder / "lowres_wide_intrinsics" / f"40753679_{time + 0.001:.3f}.pincam").write_text(
            " ".join(f"{v:g}" for v in numbers)
        )
        world = np.linalg.inv(pose)
        row = (time, *Rotation.from_matrix(world[:3, :3]).as_rotvec(), *world[:3, 3])
        lines.append(" ".join(f"{v:.12f}" for v in row))
    (folder / "lowres_wide.traj").write_text("\n".join(lines) + "\n")
    return folder


def write_sens(path: Path, poses: np.ndarray, depth_kind: int = 1, camera: np.ndarray = CAMERA) -> Path:
    """ScanNet's own file: zlib or raw depth, JPEG colours, and two records of its gyroscope at the end."""
    eye = np.eye(4)
    matrices = np.stack([camera, eye, camera, eye]).astype("<f4").tobytes()
    data = struct.pack("<IQ", 4, 4) + b"room" + matrices
    data += struct.pack("<2i4IfQ", 2, depth_kind, SHAPE[1], SHAPE[0], SHAPE[1], SHAPE[0], MILLIMETRES, len(poses))
    for number, pose in enumerate(poses):
        stream = BytesIO()
        color_image().save(stream, "JPEG", quality=100)
        depth = depth_image(pose, MILLIMETRES).tobytes() if np.isfinite(pose).all() else bytes(2 * SHAPE[0] * SHAPE[1])
        depth = zlib.compress(depth) if depth_kind == 1 else depth
        sizes = struct.pack("<4Q", 33333 * number, 33333 * number, len(stream.getvalue()), len(depth))
        data += np.asarray(pose, "<f4").tobytes() + sizes + stream.getvalue() + depth
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data + struct.pack("<Q", 2) + bytes(2 * 128))
    return path


def _sens(folder: Path, poses: np.ndarray) -> Path:
    return write_sens(folder / "room.sens", poses)


def _tum_millimetres(folder: Path, poses: np.ndarray) -> Path:
    return write_tum_images(folder, poses, MILLIMETRES)


WRITERS: dict[str, Callable[[Path, np.ndarray], Path]] = {
    "tum": _tum_millimetres,
    "replica": write_replica,
    "scannet": write_scannet,
    "3rscan": write_3rscan,
    "arkit": write_arkit,
    "sens": _sens,
}
