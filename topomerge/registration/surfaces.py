"""Poses from matched rooms, as the finished thesis fuses maps (method 4): each pair of rooms is aligned by itself, and the poses
that agree are averaged.

Point features and a random sample consensus (Open3D; Rusu, Blodow and Beetz 2009) give a first pose, point-to-plane refinement
under gravity the pose; pairs whose surfaces stay apart are dropped. Clusters replace the thesis' DBSCAN, and rotations are
averaged as rotations, so that -179 and 179 degrees give 180."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from topomerge.errors import InputError
from topomerge.matching.poses import pose_difference
from topomerge.registration.refine import Surface, build_surface, refine_pose
from topomerge.types import Array, Sim3, TopometricMap, VoxelGrid

FEATURE_RADIUS = 1.0  # m
EDGE_RATIO = 0.8  # of the edges of two triples (method 4)
INLIER_DISTANCE = 0.3  # m
TRIPLES = 20_000  # that are drawn at most
CONFIDENCE = 0.999  # that a better triple would have been drawn
LEAST_UPRIGHT = 0.9  # cosine of the tilt: rooms look alike upside down, and floors are level
CLUSTER_RADIUS = (0.5, np.radians(5.0), 0.05)  # m, rad, log scale: poses nearer than that are of one cluster
CLUSTER_ROUNDS = 5  # in which a cluster's mean and its members settle


@dataclass(frozen=True, eq=False)
class Features:
    """Points of a room with their histograms.

    Args:
        points: (N, 3) m.
        cloud: the same as `open3d.geometry.PointCloud`, with normals.
        histograms: `open3d.pipelines.registration.Feature`, 33 numbers a point.
    """

    points: Array
    cloud: Any
    histograms: Any


def check_open3d() -> None:
    """Raise InputError where Open3D is not installed."""
    try:
        import open3d  # noqa: F401
    except ImportError as error:
        raise InputError("poses of surfaces (--poses surfaces) need Open3D: pip install topomerge[open3d]") from error


def compute_fpfh(points: Array, normals: Array) -> Features:
    """Compute fast point feature histograms of oriented points.

    Args:
        points: (N, 3) m.
        normals: (N, 3) unit vectors, pointing to the same side (into the room).
    """
    import open3d

    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    cloud.normals = open3d.utility.Vector3dVector(normals)
    neighbours = open3d.geometry.KDTreeSearchParamRadius(FEATURE_RADIUS)
    return Features(points, cloud, open3d.pipelines.registration.compute_fpfh_feature(cloud, neighbours))


def estimate_pose(a: Features, b: Features, seed: int = 0) -> Sim3 | None:
    """Return T_ab that brings most points of b near those of a with the likest histograms, of triples with like edges; None where
    there is none, or only one that tilts the floor. The same seed gives the same pose.

    Open3D knows no gravity: of the pose that it gives the turn about the vertical is taken.
    """
    import open3d
    from threadpoolctl import threadpool_limits

    registration = open3d.pipelines.registration
    open3d.utility.random.seed(seed)
    with threadpool_limits(1):  # threads draw from one generator, in an order that differs from run to run
        result = registration.registration_ransac_based_on_feature_matching(
            b.cloud,
            a.cloud,
            b.histograms,
            a.histograms,
            mutual_filter=False,
            max_correspondence_distance=INLIER_DISTANCE,
            estimation_method=registration.TransformationEstimationPointToPoint(False),
            ransac_n=3,
            checkers=[registration.CorrespondenceCheckerBasedOnEdgeLength(EDGE_RATIO)],
            criteria=registration.RANSACConvergenceCriteria(TRIPLES, CONFIDENCE),
        )
    matrix = np.asarray(result.transformation)
    if result.fitness == 0 or matrix[2, 2] < LEAST_UPRIGHT:
        return None
    return convert_to_upright(matrix, b.points.mean(axis=0))


def convert_to_upright(matrix: Array, anchor: Array) -> Sim3:
    """Return the pose under gravity that is nearest to a rigid one in its turn, and places a point as it does.

    Args:
        matrix: (4, 4).
        anchor: (3,) m.
    """
    yaw = float(np.arctan2(matrix[1, 0] - matrix[0, 1], matrix[0, 0] + matrix[1, 1]))
    x, y, z = (matrix[:3, :3] @ anchor + matrix[:3, 3] - Sim3(yaw).apply(anchor[None])[0]).tolist()
    return Sim3(yaw, (x, y, z))


def compute_mean_yaw(yaws: Array | Sequence[float], weights: Array | Sequence[float] | None = None) -> float:
    """Return mean angle, rad in [-pi, pi): the direction of the summed unit vectors.

    Raises:
        ValueError: no yaw, or they cancel each other.
    """
    yaws = np.asarray(yaws, np.float64)
    weights = np.ones(len(yaws)) if weights is None else np.asarray(weights, np.float64)
    if not len(yaws):
        raise ValueError("there is no yaw to average")
    total = (weights * np.exp(1j * yaws)).sum()
    if abs(total) < 1e-9 * max(weights.sum(), 1e-300):
        raise ValueError(f"yaws {np.degrees(yaws).round(1)} degrees have no mean: they cancel each other")
    return float((np.angle(total) + np.pi) % (2 * np.pi) - np.pi)


def compute_mean_pose(poses: Sequence[Sim3], weights: Array | Sequence[float] | None = None, anchor: Array | None = None) -> Sim3:
    """Return mean of similarities: angle as an angle, scale in logarithms, translation where they place `anchor`.

    Args:
        poses: one or more.
        weights: one each; alike by default.
        anchor: (3,) m, a point of the moved map, its middle: translations are those of the frame's origin, which may lie far
            away, where a small difference of yaw is a large one of translation.

    Raises:
        ValueError: no pose, or turned so that they cancel each other.
    """
    weights = np.ones(len(poses)) if weights is None else np.asarray(weights, np.float64)
    anchor = np.zeros(3) if anchor is None else np.asarray(anchor, np.float64)
    yaw = compute_mean_yaw([p.yaw for p in poses], weights)
    share = weights / weights.sum()
    scale = float(np.exp((share * np.log([p.scale for p in poses])).sum()))
    placed = share @ np.array([p.apply(anchor[None])[0] for p in poses])
    x, y, z = (placed - Sim3(yaw, (0.0, 0.0, 0.0), scale).apply(anchor[None])[0]).tolist()
    return Sim3(yaw, (x, y, z), scale)


def cluster_poses(
    poses: Sequence[Sim3], weights: Array | Sequence[float], anchor: Array | None = None
) -> list[tuple[Sim3, float, list[int]]]:
    """Return the clusters of weighted poses, heaviest first: (mean, weight, members).

    The pose with most weight around it is a cluster's seed; members are those within `CLUSTER_RADIUS` of the mean, until none
    changes.

    Args:
        anchor: see `compute_mean_pose`.
    """
    anchor = np.zeros(3) if anchor is None else np.asarray(anchor, np.float64)
    weights = np.asarray(weights, np.float64)
    left = list(range(len(poses)))
    clusters = []
    while left:
        neighbours = [[j for j in left if _is_near(poses[i], poses[j], anchor)] for i in left]
        members = max(neighbours, key=lambda m: float(weights[m].sum()))
        mean = compute_mean_pose([poses[i] for i in members], weights[members], anchor)
        for _ in range(CLUSTER_ROUNDS):
            around = [j for j in left if _is_near(mean, poses[j], anchor)]
            if around == members or not around:
                break
            members, mean = around, compute_mean_pose([poses[i] for i in around], weights[around], anchor)
        clusters.append((mean, float(weights[members].sum()), members))
        left = [i for i in left if i not in members]
    return sorted(clusters, key=lambda c: -c[1])


def _is_near(p: Sim3, q: Sim3, anchor: Array) -> bool:
    return all(d <= limit for d, limit in zip(pose_difference(p, q, anchor), CLUSTER_RADIUS, strict=True))


ROOM_POINTS = 2_000  # of a room at most
ROOM_LEAST_POINTS = 20
LARGEST_ERROR = 0.2  # m, root mean square distance of the surfaces (method 4)
ALIGNED_PAIRS = 30  # of rooms, the likeliest ones
Room = tuple[Surface, Features]


def estimate_room_poses(a: TopometricMap, b: TopometricMap, rooms: Array, weights: Array) -> list[tuple[Sim3, float]]:
    """Return poses T_ab of clusters of pairs of rooms, with their weight, heaviest first; none where no pair can be aligned.

    Args:
        rooms: (M, 2) matched rooms of a and b.
        weights: (M,) how likely each is.
    """
    order = np.argsort(-weights, kind="stable")[:ALIGNED_PAIRS]
    sides = [{k: described(m, k) for k in np.unique(rooms[order, s]).tolist()} for s, m in enumerate((a, b))]
    poses, areas = [], []
    for i, j in rooms[order].tolist():
        pose = align_rooms(sides[0][i], sides[1][j])
        if pose is not None:
            poses.append(pose)
            areas.append(float(min(a.rooms["area"][i], b.rooms["area"][j])))
    middle = b.grid.compute_centroids().mean(axis=0) if len(b.grid) else np.zeros(3)
    return [(pose, weight) for pose, weight, _ in cluster_poses(poses, np.array(areas), middle)]


def described(map: TopometricMap, room: int) -> Room | None:
    """Return the surface of a room, and features of some of its points; None of a room that has hardly any."""
    cells = map.grid.cells[map.room == room]
    if len(cells) < ROOM_LEAST_POINTS:
        return None
    room_surface = build_surface(VoxelGrid.from_cells(cells, map.grid.origin, map.grid.edge))
    flat = np.flatnonzero(room_surface.flat > 0)
    if len(flat) < ROOM_LEAST_POINTS:
        return None
    if len(flat) > ROOM_POINTS:
        flat = np.sort(np.random.default_rng(0).permutation(flat)[:ROOM_POINTS])
    points, normals = room_surface.points[flat], room_surface.normals[flat]
    inward = ((map.rooms["centroid"][room] - points) * normals).sum(axis=1)
    return room_surface, compute_fpfh(points, normals * np.where(inward < 0, -1.0, 1.0)[:, None])


def align_rooms(a: Room | None, b: Room | None) -> Sim3 | None:
    """Return T_ab of one room: sample consensus, then refinement; None where the surfaces stay apart."""
    if a is None or b is None:
        return None
    start = estimate_pose(a[1], b[1])
    if start is None:
        return None
    refined = refine_pose(a[0], b[0], start)
    return refined.pose if np.isfinite(refined.rmse) and refined.rmse <= LARGEST_ERROR else None
