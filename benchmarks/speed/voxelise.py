"""Voxelising 10 million points at 0.1 m against Open3D's voxel down-sampling of the same points.

Open3D's tensor version is the faster of its two and is the peer. Both end with one entry for each occupied cell; ours counts its
points and sorts the cells in Morton order, Open3D's averages positions. Run from the root:
``python -m benchmarks.speed.voxelise``.
"""

from __future__ import annotations

from benchmarks.speed.bench import print_line, storey, time_best
from topomerge.extraction.voxels import voxelise


def main(points: int = 10_000_000) -> None:
    """Verify, then time."""
    import open3d as o3d

    cloud_points = storey(points)
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(cloud_points))
    ours, peer = voxelise(cloud_points), cloud.voxel_down_sample(0.1)
    cells = len(peer.point.positions)
    if abs(cells / len(ours) - 1) > 0.02:
        raise SystemExit(f"not the same cells: {len(ours)} and {cells}")
    name = f"voxelise_{points // 1_000_000}M"
    print_line(name, time_best(lambda: voxelise(cloud_points), 3), time_best(lambda: cloud.voxel_down_sample(0.1), 3))
    classic = cloud.to_legacy()
    print_line(
        f"{name}_legacy", time_best(lambda: voxelise(cloud_points), 3), time_best(lambda: classic.voxel_down_sample(0.1), 1)
    )


if __name__ == "__main__":
    main()
