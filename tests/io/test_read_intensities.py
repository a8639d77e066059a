"""How much light came back, as files of several formats have it: read as it is, point by point."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.samples import box_points
from topomerge.io.points import read_chunks, read_points

POINTS = box_points(500)
BRIGHT = np.linspace(-20, 900, 500).astype(np.float32)


def ply(path: Path, binary: bool) -> None:
    rows = np.zeros(len(POINTS), [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("scalar_Intensity", "<f4")])
    rows["x"], rows["y"], rows["z"] = POINTS.T
    rows["scalar_Intensity"] = BRIGHT
    kind = "binary_little_endian" if binary else "ascii"
    names = "\n".join(f"property float {name}" for name in rows.dtype.names)
    head = f"ply\nformat {kind} 1.0\nelement vertex {len(rows)}\n{names}\nend_header\n"
    body = rows.tobytes() if binary else "".join(" ".join(f"{v:.6f}" for v in row) + "\n" for row in rows.tolist()).encode()
    path.write_bytes(head.encode() + body)


def pcd(path: Path, binary: bool) -> None:
    rows = np.column_stack([POINTS, BRIGHT]).astype("<f4")
    head = "VERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
    head += f"WIDTH {len(rows)}\nHEIGHT 1\nPOINTS {len(rows)}\nDATA {'binary' if binary else 'ascii'}\n"
    body = rows.tobytes() if binary else "".join(" ".join(f"{v:.6f}" for v in row) + "\n" for row in rows.tolist()).encode()
    path.write_bytes(head.encode() + body)


def las(path: Path, bright: np.ndarray) -> None:
    laspy = pytest.importorskip("laspy")
    file = laspy.LasData(laspy.LasHeader(point_format=0, version="1.2"))
    file.header.scales = [1e-4] * 3
    file.x, file.y, file.z = POINTS.astype(float).T
    file.intensity = bright
    file.write(str(path))


def e57(path: Path) -> None:
    pye57 = pytest.importorskip("pye57")
    file = pye57.E57(str(path), mode="w")
    data = {f"cartesian{a}": np.array(POINTS[:, i], float) for i, a in enumerate("XYZ")}
    file.write_scan_raw(data | {"intensity": BRIGHT})
    file.close()


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize("write", [ply, pcd])
def test_intensities_come_back(tmp_path: Path, write, binary: bool) -> None:
    path = tmp_path / f"a.{write.__name__}"
    write(path, binary)
    cloud = read_points(path)
    assert cloud.colors is None and cloud.intensities == pytest.approx(BRIGHT, abs=1e-4)
    assert np.allclose(cloud.points + cloud.shift, POINTS, atol=1e-4)
    chunks = [chunk.intensities for chunk in read_chunks(path, chunk=70)]
    assert len(chunks) > 5 and np.array_equal(np.concatenate(chunks), cloud.intensities)


def test_of_a_laser_scanner(tmp_path: Path) -> None:
    e57(tmp_path / "a.e57")
    las(tmp_path / "a.las", np.arange(500) * 130)
    assert read_points(tmp_path / "a.e57").intensities == pytest.approx(BRIGHT, abs=1e-3)
    assert read_points(tmp_path / "a.las").intensities.tolist() == (np.arange(500) * 130).tolist()


def test_points_that_are_not_finite_take_theirs_along(tmp_path: Path) -> None:
    path = tmp_path / "a.xyz.ply"
    ply(path, True)
    data = bytearray(path.read_bytes())
    data[-16:-12] = np.float32(np.nan).tobytes()  # x of the last point
    path.write_bytes(data)
    assert np.array_equal(read_points(path).intensities, BRIGHT[:-1])
