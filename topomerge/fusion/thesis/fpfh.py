"""Point features and their sample consensus through Open3D (Rusu, Blodow and Beetz 2009): the first pose of a pair of rooms."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from topomerge.errors import InputError
from topomerge.types import Array, Sim3

FEATURE_RADIUS = 1.0  # m
EDGE_RATIO = 0.8  # of the edges of two triples (method 4)
INLIER_DISTANCE = 0.3  # m
TRIPLES = 20_000  # that are drawn at most
CONFIDENCE = 0.999  # that a better triple would have been drawn
LEAST_UPRIGHT = 0.9  # cosine of the tilt: rooms look alike upside down, and floors are level


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


def fpfh(points: Array, normals: Array) -> Features:
    """Fast point feature histograms of oriented points.

    Args:
        points: (N, 3) m.
        normals: (N, 3) unit vectors, pointing to the same side (into the room).
    """
    import open3d

    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    cloud.normals = open3d.utility.Vector3dVector(normals)
    neighbours = open3d.geometry.KDTreeSearchParamRadius(FEATURE_RADIUS)
    return Features(points, cloud, open3d.pipelines.registration.compute_fpfh_feature(cloud, neighbours))


def sampled_pose(a: Features, b: Features, seed: int = 0) -> Sim3 | None:
    """T_ab that brings most points of b near those of a with the likest histograms, of triples with like edges; None where there
    is none, or only one that tilts the floor. The same seed gives the same pose.

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
    return upright(matrix, b.points.mean(axis=0))


def upright(matrix: Array, anchor: Array) -> Sim3:
    """The pose under gravity that is nearest to a rigid one in its turn, and places a point as it does.

    Args:
        matrix: (4, 4).
        anchor: (3,) m.
    """
    yaw = float(np.arctan2(matrix[1, 0] - matrix[0, 1], matrix[0, 0] + matrix[1, 1]))
    x, y, z = (matrix[:3, :3] @ anchor + matrix[:3, 3] - Sim3(yaw).apply(anchor[None])[0]).tolist()
    return Sim3(yaw, (x, y, z))
