"""States of Cartographer: read as walls and floor where their graph puts them, and joined so that Google's library reads them."""

from __future__ import annotations

import gzip
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.io.test_native import TILTED, YAW
from topomerge.errors import InputError
from topomerge.io import read_points
from topomerge.io.native import NATIVE, Doubt, Motion, Source, Tally, save_joined
from topomerge.io.pbstream import get_packed, parse_message
from topomerge.types import transform_points

pytest.importorskip("google.protobuf")
from tests.io import cartographer_states as carto


def write(path: Path, *, version: int = 2, **more: Any) -> Path:
    return carto.write_messages(path, carto.state(**more), version)


def in_room(points: np.ndarray) -> np.ndarray:
    """Points in the frame of the room's grid: back from the map."""
    frame = np.eye(4)
    frame[:2, :2] = (0.8, -0.6), (0.6, 0.8)
    frame[:2, 3] = 1.0, -2.0
    return transform_points(np.linalg.inv(frame), points)


@pytest.mark.parametrize("version", [1, 2])
def test_submaps_become_walls_and_floor_on_the_map(tmp_path: Path, version: int) -> None:
    cloud = read_points(write(tmp_path / "a.pbstream", version=version))
    points = in_room(cloud.points + cloud.shift)
    wall = points[cloud.points[:, 2] > 1.0]
    floor = points[cloud.points[:, 2] < 0.01]
    assert cloud.points[:, 2].max() == pytest.approx(2.5) and not cloud.warnings
    assert np.abs(wall[:, :2].min(axis=0) - 0).max() < 0.25 and np.abs(wall[:, :2].max(axis=0) - (4, 3)).max() < 0.25
    inner = floor[(floor[:, 0] > 0.3) & (floor[:, 0] < 3.7) & (floor[:, 1] > 0.3) & (floor[:, 1] < 2.7)]
    assert len(inner) == pytest.approx(3.4 * 2.4 / 0.01, rel=0.03)
    near = np.minimum(np.abs(wall[:, :2]), np.abs(wall[:, :2] - (4, 3))).min(axis=1)
    assert near.max() < 0.25
    assert cloud.landmarks is not None and cloud.landmarks.values == ("cartographer:tag 7",)


def test_axes_and_corner_of_a_grid(tmp_path: Path) -> None:
    """x falls along the rows of a grid and y along its columns, from the corner of the largest x and y."""
    odds = np.full((20, 30), 0.2)
    odds[2, 5] = 0.9
    messages = carto.state(local=np.eye(4))
    kept = [one for one in messages if not one.HasField("submap")]
    submap = next(one for one in messages if one.HasField("submap"))
    submap.submap.submap_2d.grid.CopyFrom(carto.grid_of(odds, (7.0, 9.0)))
    cloud = read_points(carto.write_messages(tmp_path / "a.pbstream", [*kept, submap]))
    wall = cloud.points[cloud.points[:, 2] > 0.01]
    np.testing.assert_allclose(wall[:, :2].mean(axis=0), (7.0 - 0.25, 9.0 - 0.55), atol=0.051)
    np.testing.assert_allclose(cloud.points[:, :2].min(axis=0), (5.0, 6.0), atol=0.11)


def test_grids_in_space_become_points(tmp_path: Path) -> None:
    cloud = read_points(write(tmp_path / "a.pbstream", spatial=True))
    points = in_room(cloud.points + cloud.shift)
    assert len(points) == 2 * 59  # one cell of each submap is free
    np.testing.assert_allclose(points[:59].min(axis=0), (-0.2, -0.1, -0.2), atol=1e-5)
    np.testing.assert_allclose(points[59:].min(axis=0), (0.0, -0.1, -0.2), atol=1e-5)


def test_trajectories_are_told_apart(tmp_path: Path) -> None:
    together = read_points(write(tmp_path / "a.pbstream", trajectories=2))
    assert not together.warnings
    parted = read_points(write(tmp_path / "b.pbstream", trajectories=2, apart=True))
    assert "trajectory 1 is joined with the others by no constraint" in parted.warnings[0]
    assert np.ptp(parted.points[:, 0]) < np.ptp(together.points[:, 0]) - 0.2


def test_a_file_cut_between_two_messages_is_told(tmp_path: Path) -> None:
    messages = carto.state()
    carto.write_messages(tmp_path / "a.pbstream", messages[:3])
    assert "1 of its submaps have no grid" in read_points(tmp_path / "a.pbstream").warnings[0]


def join(folder: Path, *sources: Source) -> Tally:
    return save_joined(NATIVE["pbstream"], sources, folder / "joined.pbstream", Doubt(0.1, 0.02))


def test_two_states_become_one(tmp_path: Path) -> None:
    a, b = write(tmp_path / "a.pbstream", trajectories=2), write(tmp_path / "b.pbstream", tag="tag 8")
    kept = a.read_bytes(), b.read_bytes()
    tally = join(tmp_path, Source(a), Source(b, YAW))
    assert (a.read_bytes(), b.read_bytes()) == kept
    assert all(before == after for before, after in tally.counts.values()), tally.counts
    assert tally.counts["submaps"] == (6, 6) and tally.counts["nodes"] == (9, 9) and tally.counts["landmarks"] == (2, 2)
    first, second, joined = (carto.read_messages(p) for p in (a, b, tmp_path / "joined.pbstream"))
    assert joined[0].format_version == 2
    graph, own = joined[1].pose_graph, second[1].pose_graph
    assert [t.trajectory_id for t in graph.trajectory] == [0, 1, 2]
    assert graph.trajectory[0] == first[1].pose_graph.trajectory[0]
    for kind in ("node", "submap"):
        for moved, before in zip(getattr(graph.trajectory[2], kind), getattr(own.trajectory[0], kind), strict=True):
            np.testing.assert_allclose(carto.matrix(moved.pose), YAW.matrix @ carto.matrix(before.pose), rtol=0, atol=1e-9)
    np.testing.assert_allclose(
        carto.matrix(graph.landmark_poses[1].global_pose), YAW.matrix @ carto.matrix(own.landmark_poses[0].global_pose), atol=1e-9
    )
    options = joined[2].all_trajectory_builder_options.options_with_sensor_ids
    assert [o.sensor_id[0].id for o in options] == ["scan_0", "scan_1", "scan_0"]
    starts = [o.trajectory_builder_options.initial_trajectory_pose.to_trajectory_id for o in options]
    assert starts == [0, 1, 2]
    rest = [one for one in joined[3:] if one.HasField("submap")]
    assert [one.submap.submap_id.trajectory_id for one in rest] == [0, 0, 1, 1, 2, 2]
    assert rest[4].submap.submap_2d == second[3].submap.submap_2d  # the grid and its frame stay
    assert {one.node.node_id.trajectory_id for one in joined[3:] if one.HasField("node")} == {0, 1, 2}
    assert [one.imu_data.trajectory_id for one in joined[3:] if one.HasField("imu_data")] == [0, 1, 2]


def test_constraints_between_sessions_say_what_the_merge_says(tmp_path: Path) -> None:
    a, b = write(tmp_path / "a.pbstream"), write(tmp_path / "b.pbstream")
    tally = join(tmp_path, Source(a), Source(b, YAW))
    graph = carto.read_messages(tmp_path / "joined.pbstream")[1].pose_graph
    between = [c for c in graph.constraint if c.submap_id.trajectory_id != c.node_id.trajectory_id]
    assert len(between) == tally.counts["links between sessions"][1] >= 1
    for one in between:
        start = carto.matrix(graph.trajectory[0].submap[one.submap_id.submap_index].pose)
        end = carto.matrix(graph.trajectory[1].node[one.node_id.node_index].pose)
        np.testing.assert_allclose(start @ carto.matrix(one.relative_pose), end, rtol=0, atol=1e-9)
        assert (one.tag, one.translation_weight, one.rotation_weight) == (1, pytest.approx(100), pytest.approx(2500))
    own = [c for c in graph.constraint if c.submap_id.trajectory_id == c.node_id.trajectory_id == 1]
    assert [c.relative_pose for c in own] == [c.relative_pose for c in carto.read_messages(b)[1].pose_graph.constraint]


def test_it_is_read_again_as_one_map(tmp_path: Path) -> None:
    a, b = write(tmp_path / "a.pbstream"), write(tmp_path / "b.pbstream")
    far = Motion(YAW.matrix)
    join(tmp_path, Source(a), Source(b, far))
    before, joined = read_points(b).points.astype(float), read_points(tmp_path / "joined.pbstream")
    assert not joined.warnings
    both = np.concatenate([before, far.move_points(before)])
    np.testing.assert_allclose(joined.points.max(axis=0)[:2], both.max(axis=0)[:2], atol=0.15)
    np.testing.assert_allclose(joined.points.min(axis=0)[:2], both.min(axis=0)[:2], atol=0.15)


def test_what_cannot_be_written_truly_is_refused(tmp_path: Path) -> None:
    flat, space = write(tmp_path / "a.pbstream"), write(tmp_path / "b.pbstream", spatial=True)
    with pytest.raises(InputError, match="its map is tilted"):
        join(tmp_path, Source(flat), Source(flat, TILTED))
    join(tmp_path, Source(space), Source(space, TILTED))
    (tmp_path / "joined.pbstream").unlink()
    with pytest.raises(InputError, match="one state is flat and the other is not"):
        join(tmp_path, Source(flat), Source(space))
    assert not (tmp_path / "joined.pbstream").exists()


@pytest.mark.longer
def test_damage_is_told(tmp_path: Path) -> None:
    good = write(tmp_path / "a.pbstream").read_bytes()
    bad = tmp_path / "bad.pbstream"

    def told(data: bytes) -> str:
        bad.write_bytes(data)
        with pytest.raises(InputError) as caught:
            read_points(bad)
        return str(caught.value)

    assert "first eight bytes are others" in told(b"12345678" + good[8:])
    assert "cut short" in told(good[:-31])
    assert "only 1 or 2 is read" in told(carto.write_messages(bad, carto.state(), version=3).read_bytes())
    bomb = gzip.compress(bytes((1 << 28) + 1), 1)
    assert "more than 256 MB" in told(good[:8] + len(bomb).to_bytes(8, "little") + bomb)
    many = gzip.compress(b"\x32\x80\x80\x80\x40" + bytes(1 << 27), 9)  # readings of nothing
    assert "unpacks to more than" in told(good + (len(many).to_bytes(8, "little") + many) * 3)
    assert "holds no submaps" in told(carto.write_messages(bad, carto.state()[:2]).read_bytes())
    tsdf = carto.state()
    tsdf[2].submap.submap_2d.grid.tsdf_2d.SetInParent()
    assert "TSDF" in told(carto.write_messages(bad, tsdf).read_bytes())
    short = carto.state()
    del short[2].submap.submap_2d.grid.cells[5:]
    assert "with 5 values" in told(carto.write_messages(bad, short).read_bytes())


@pytest.mark.parametrize("data", [b"\x08", b"\x0a\x05abc", b"\x0b", b"\x00\x01", b"\x08" + b"\xff" * 11, b"\x09abc"])
def test_messages_that_are_none(data: bytes) -> None:
    with pytest.raises(ValueError, match="cut short|kind|field"):
        parse_message(data)


def test_numbers_of_all_lengths() -> None:
    m = carto.load_messages()
    values = [0, 1, -1, 63, -64, 64, 8191, -8192, 2**31 - 1, -(2**31)]
    grid = m["HybridGrid"](x_indices=values, values=[0, 127, 128, 16383, 16384, 2**31 - 1])
    fields = parse_message(grid.SerializeToString())
    assert get_packed(fields, 3, signed=True).tolist() == values
    assert get_packed(fields, 6).tolist() == [0, 127, 128, 16383, 16384, 2**31 - 1]
