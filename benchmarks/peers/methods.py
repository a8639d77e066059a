"""KISS-Matcher and Open3D's RANSAC and FGR on two clouds: pose, scores that a verdict can be made of, and seconds of processor.

As their authors run them. KISS-Matcher thins the clouds itself, at its voxel; its verdict is the number of final inliers
(KISS-Matcher's issues 24 and 57; `valid` only says that its solver returned). Its solver is tried with all rotations and with
yaw only (Quatro), from the same matches. Quatro remembers the noise bound of its first call in a process: all calls of a process
must use one voxel. Open3D follows its tutorial of global registration: normals, FPFH, RANSAC or FGR at one voxel; a verdict is
made of the fitness and the inlier residual of `evaluate_registration`. Every pose is refined by ICP, as both recommend.

Calls run in processes of their own, with caps of seconds and memory (`GuardedWork`): one that takes too long, or dies, is a miss.
"""

from __future__ import annotations

import multiprocessing
import resource
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from topomerge.types import Array

OPEN3D_VOXEL, RANSAC_ITERATIONS = 0.3, 100_000  # m
REFINED_FROM, REFINED_TO, REFINED_WITHIN = 0.3, 0.1, 0.3  # m: voxels of b and of a, and how far correspondences are at most
EVALUATED_WITHIN = {"fitness": 0.3, "fitness_icp": 0.1}  # m, distance up to which a point counts as an inlier

CALL_SECONDS = 60.0  # of processor, for each answer of a call
CALL_BYTES = 12 * 2**30  # of address space
WALL_FACTOR = 10  # of the seconds of processor: nothing waits forever for a process that hangs
TOO_LONG, CALL_FAILED = "over the cap", "failed"
Work = Callable[..., Iterator[tuple[str, Any]]]


@dataclass(frozen=True)
class PeerAnswer:
    """The answer of a method about two clouds.

    Args:
        pose: (4, 4) maps b into a, as the solver returned it.
        refined: (4, 4) after ICP.
        scores: KISS-Matcher's ``inliers``; Open3D's ``fitness`` and ``residual`` (m) of the pose, among the points it used; of
            all, ``fitness_icp`` and ``residual_icp`` of the refined pose (`EVALUATED_WITHIN`).
        seconds: of processor, to the pose.
        refinement_seconds: of processor, from there to the refined pose.
    """

    pose: Array
    refined: Array
    scores: dict[str, float]
    seconds: float
    refinement_seconds: float


def run_kiss(b: Array, a: Array, voxel: float) -> Iterator[tuple[str, PeerAnswer]]:
    """Run KISS-Matcher with rotations in space and, as ``…q``, with Quatro's yaw; clouds (n, 3) m."""
    import kiss_matcher

    name, begun = f"kiss{round(10 * voxel):02d}", time.process_time()
    matchers = {
        name + suffix: kiss_matcher.KISSMatcher(kiss_matcher.KISSMatcherConfig(voxel, use_quatro=bool(suffix)))
        for suffix in ("", "q")
    }
    matched = [np.array(m, float).reshape(-1, 3).T for m in matchers[name].match(*(np.asarray(c, float).T for c in (b, a)))]
    matching = time.process_time() - begun
    refine = Refinement(b, a)
    for variant, matcher in matchers.items():
        begun = time.process_time()
        solution = matcher.solve(*matched)
        seconds = matching + time.process_time() - begun
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = np.array(solution.rotation), np.array(solution.translation).ravel()
        inliers = float(matcher.get_num_final_inliers()) if solution.valid else 0.0
        yield variant, refine.refine_answer(pose, {"inliers": inliers}, seconds)


def run_open3d(b: Array, a: Array) -> Iterator[tuple[str, PeerAnswer]]:
    """Run RANSAC and FGR with one set of features, whose time counts for both; clouds (n, 3) m."""
    import open3d as o3d

    o3d.utility.random.seed(0)
    reg = o3d.pipelines.registration
    begun = time.process_time()
    (thin_b, features_b), (thin_a, features_a) = (_compute_features(c) for c in (b, a))
    described = time.process_time() - begun
    refine = Refinement(b, a)
    for name in ("fpfh", "fgr"):
        begun = time.process_time()
        if name == "fgr":
            option = reg.FastGlobalRegistrationOption(maximum_correspondence_distance=0.5 * OPEN3D_VOXEL)
            solution = reg.registration_fgr_based_on_feature_matching(thin_b, thin_a, features_b, features_a, option)
        else:
            within = 1.5 * OPEN3D_VOXEL
            checks = [reg.CorrespondenceCheckerBasedOnEdgeLength(0.9), reg.CorrespondenceCheckerBasedOnDistance(within)]
            estimate = reg.TransformationEstimationPointToPoint(False)
            criteria = reg.RANSACConvergenceCriteria(RANSAC_ITERATIONS, 0.999)
            solution = reg.registration_ransac_based_on_feature_matching(
                thin_b, thin_a, features_b, features_a, True, within, estimate, 3, checks, criteria
            )
        judged = reg.evaluate_registration(thin_b, thin_a, EVALUATED_WITHIN["fitness"], solution.transformation)
        seconds = described + time.process_time() - begun
        scores = {"fitness": judged.fitness, "residual": judged.inlier_rmse}
        yield name, refine.refine_answer(np.array(solution.transformation), scores, seconds)


class Refinement:
    """ICP, point to plane, of clouds (n, 3) m that are thinned once; what is prepared counts for each answer."""

    def __init__(self, b: Array, a: Array) -> None:
        import open3d as o3d

        begun = time.process_time()
        self.b, self.a = (_build_cloud(c).voxel_down_sample(edge) for c, edge in ((b, REFINED_FROM), (a, REFINED_TO)))
        self.a.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius=3 * REFINED_TO, max_nn=30))
        self.prepared = time.process_time() - begun

    def refine_answer(self, pose: Array, scores: dict[str, float], seconds: float) -> PeerAnswer:
        """Return the answer of a solver with its refined pose and the scores of that."""
        import open3d as o3d

        reg = o3d.pipelines.registration
        begun = time.process_time()
        plane = reg.TransformationEstimationPointToPlane()
        refined = np.array(reg.registration_icp(self.b, self.a, REFINED_WITHIN, pose, plane).transformation)
        judged = reg.evaluate_registration(self.b, self.a, EVALUATED_WITHIN["fitness_icp"], refined)
        scores = {**scores, "fitness_icp": judged.fitness, "residual_icp": judged.inlier_rmse}
        return PeerAnswer(pose, refined, scores, seconds, self.prepared + time.process_time() - begun)


def _build_cloud(points: Array) -> Any:
    import open3d as o3d

    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.ascontiguousarray(points, float)))


def _compute_features(points: Array) -> tuple[Any, Any]:
    """Return a cloud at Open3D's voxel and its FPFH features."""
    import open3d as o3d

    cloud = _build_cloud(points).voxel_down_sample(OPEN3D_VOXEL)
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius=2 * OPEN3D_VOXEL, max_nn=30))
    search = o3d.geometry.KDTreeSearchParamHybrid(radius=5 * OPEN3D_VOXEL, max_nn=100)
    return cloud, o3d.pipelines.registration.compute_fpfh_feature(cloud, search)


class GuardedWork:
    """A generator of (name, answer) that is called in a process of its own, which is started anew when it was ended.

    Args:
        work: a function of a module; its arguments and answers are sent from process to process.
        seconds: of processor that each answer may take, rounded up.
    """

    def __init__(self, work: Work, seconds: float = CALL_SECONDS) -> None:
        self.work, self.seconds = work, seconds
        self.process: Any = None
        self.pipe: Any = None

    def __call__(self, *args: Any) -> tuple[dict[str, Any], str, float]:
        """Return the answers; why there are no more (empty, `TOO_LONG` or `CALL_FAILED`); the seconds of processor that it
        took."""
        if self.process is None:
            context = multiprocessing.get_context("spawn")
            self.pipe, theirs = context.Pipe()
            self.process = context.Process(target=_answer_calls, args=(theirs, self.work, self.seconds), daemon=True)
            self.process.start()
            theirs.close()
        self.pipe.send(args)
        answers: dict[str, Any] = {}
        used, why = 0.0, TOO_LONG
        try:
            while self.pipe.poll(WALL_FACTOR * self.seconds):
                name, answer, used = self.pipe.recv()
                if name is None:
                    return answers, "" if answer is None else CALL_FAILED, used
                answers[name] = answer
        except (EOFError, ConnectionError):  # the process was ended
            self.process.join()
            why = TOO_LONG if self.process.exitcode == -signal.SIGXCPU else CALL_FAILED
        self.close()
        return answers, why, used + self.seconds * (why == TOO_LONG)

    def close(self) -> None:
        """End the process."""
        if self.process is not None:
            self.process.kill()
            self.process.join()
            self.pipe.close()
            self.process = None


def _answer_calls(pipe: Connection, work: Work, seconds: float) -> None:
    """Send, in the process, the answers of each call, each under its cap; then why there are no more, None if that was all."""
    resource.setrlimit(resource.RLIMIT_AS, (CALL_BYTES, CALL_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    while True:
        args = pipe.recv()
        begun = time.process_time()
        try:
            _cap(seconds)
            for name, answer in work(*args):
                pipe.send((name, answer, time.process_time() - begun))
                _cap(seconds)
            pipe.send((None, None, time.process_time() - begun))
        except Exception as failure:  # a peer that fails has not merged
            pipe.send((None, repr(failure), time.process_time() - begun))


def _cap(seconds: float) -> None:
    """Allow so many seconds of processor from now on, rounded up, before the system ends the process."""
    hard = resource.getrlimit(resource.RLIMIT_CPU)[1]
    resource.setrlimit(resource.RLIMIT_CPU, (int(time.process_time() + seconds) + 1, hard))
