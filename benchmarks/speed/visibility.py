"""Rays from views to every cell in range: our traversal against Open3D's ray casting (Embree) on the same cells as cubes.

Both decide the same rays. Open3D is told where each ray should end and says what it hits first; building its scene is not timed,
and neither is compiling. Run from the root: ``python -m benchmarks.speed.visibility``. Lines: `name ours peer ratio`, see
`bench.print_line`; the rates follow as a comment.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.speed.bench import DEPTH, WIDTH, print_line, storey, time_best
from topomerge.extraction.views.visibility import find_visible_cells
from topomerge.extraction.voxels import voxelise
from topomerge.types import VoxelGrid

VIEW_RANGE = 5.0  # m


def build_cubes(grid: VoxelGrid):
    """Build an Open3D scene of one cube a cell (12 triangles), in units of cells."""
    import open3d as o3d

    corner = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float32)
    faces = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    triangle = np.array([t for a, b, c, d in faces for t in ((a, b, c), (a, c, d))], np.uint32)
    vertices = (grid.cells[:, None].astype(np.float32) + corner).reshape(-1, 3)
    triangles = (triangle + 8 * np.arange(len(grid), dtype=np.uint32)[:, None, None]).reshape(-1, 3)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor(vertices), o3d.core.Tensor(triangles))
    return scene


def main(points: int = 2_000_000, views: int = 200) -> None:
    """Verify, then time."""
    import open3d as o3d

    grid = voxelise(storey(points))
    rng = np.random.default_rng(1)
    places = rng.uniform((0.5, 0.5, 1.4), (WIDTH - 0.5, DEPTH - 0.5, 2.0), (views, 3))
    targets = cKDTree(grid.compute_centroids()).query_ball_point(places, VIEW_RANGE, return_sorted=True)
    view_of = np.repeat(np.arange(views), [len(t) for t in targets])
    target = np.concatenate(targets)
    origin = ((places - grid.origin) / grid.edge)[view_of]
    toward = grid.cells[target] + 0.5 - origin
    length = np.linalg.norm(toward, axis=1)
    rays = o3d.core.Tensor(np.hstack([origin, toward / length[:, None]]).astype(np.float32))
    scene = build_cubes(grid)

    visibility = find_visible_cells(grid, places, VIEW_RANGE)
    answer = scene.cast_rays(rays)
    hit = answer["primitive_ids"].numpy() // 12
    ours = np.concatenate([np.isin(t, visibility.get_rows(v)) for v, t in enumerate(targets)])
    agree = float((ours == (hit == target)).mean())
    if agree < 0.995:  # float32 rays that graze an edge may differ
        raise SystemExit(f"the two don't decide alike: {agree:.4f}")

    seconds = time_best(lambda: find_visible_cells(grid, places, VIEW_RANGE), 3)
    peer = time_best(lambda: scene.cast_rays(rays), 3)
    print_line("visibility_rays", seconds, peer)
    rate = len(target) / 1e6
    print(f"# {len(target)} rays, {len(grid)} cells; {agree:.4%} decided alike")
    print(f"# {rate / seconds:.1f} against {rate / peer:.1f} million rays a second")


if __name__ == "__main__":
    main()
