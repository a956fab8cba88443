"""Ground truth of a scene (computed without rendering) or of a bag."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from humansim_ros.data.evaluation.evaluation import CameraCountScore, Evaluation
from humansim_ros.data.evaluation.metrics import mean_error
from humansim_ros.data.evaluation.pose_sequence import PoseSequence
from humansim_ros.data.evaluation.readers.estimates import read_bag_topic
from humansim_ros.data.evaluation.readers.pose_files import ReadOptions
from humansim_ros.errors import EvaluationError
from humansim_ros.people.keypoints import KeypointLocator, KeypointSet
from humansim_ros.scene.config import FIRST_STAMP, LIVE, frame_at
from humansim_ros.scene.core import Scene
from humansim_ros.types import Array, Indices

#: Most frames for which the truth of a scene is computed: nine hours at 30 Hz.
MAX_TRUTH_FRAMES = 1_000_000
#: A stamp that would be of this frame or a later one must come from a wall clock.
WALL_CLOCK_FRAME = 100 * MAX_TRUTH_FRAMES
#: Number of frames that are computed in one array.
_BLOCK = 1000


class SceneTruth:
    """Ground truth that is computed from a scene. ``period``: nanoseconds between frames. ``start``: stamp of
    the first frame."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.period, self.start = scene.frame_time(1), FIRST_STAMP

    def poses(
        self, span: tuple[int, int], around: float = 0.0, keypoints: KeypointSet | None = None
    ) -> PoseSequence:
        """Joints or keypoints of all humans, with the stamps of ``Simulation`` and lockstep.

        Args:
            span: First and last time that are needed, nanoseconds.
            around: Seconds before and after the span.
            keypoints: Set of keypoints in place of the joints.

        Raises:
            EvaluationError: The scene has no people or a live human (moved by another node), or the times are
                too late for a scene, such as those of a wall clock.
        """
        first, last = frames_of(self.scene, span, around)
        times = np.array([self.scene.frame_time(index) for index in range(first, last + 1)], np.int64)
        return truth_at(self.scene, times, FIRST_STAMP + times, keypoints)


class RecordedTruth:
    """Ground truth that is read from a bag, all at once. ``period`` and ``start``: see
    :class:`SceneTruth`.

    Raises:
        EvaluationError: The bag has no topic ``/humans/<id>/joints``.
        BagError: The bag cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.joints = self._read("joints")
        self.period, self.start = self.joints.period, int(self.joints.times[0])

    def poses(self, span: tuple[int, int], around: float, keypoints: KeypointSet | None) -> PoseSequence:
        """Joints or keypoints in all frames of the bag. ``span`` and ``around`` are ignored. Raises
        EvaluationError if the bag has no topic ``/humans/<id>/keypoints/<set>``."""
        return self.joints if keypoints is None else self._read(f"keypoints/{keypoints.name}")

    def _read(self, kind: str) -> PoseSequence:
        try:
            return read_bag_topic(self.path, f"/humans/*/{kind}", ReadOptions()).sequence().checked()
        except EvaluationError as error:
            if "no topic" not in error.message:
                raise
            text = f"the bag has no truth: no topic /humans/<id>/{kind}. Record it as well, or give the scene"
            raise EvaluationError(text, path=self.path, key="--truth") from None


def check_motions(scene: Scene) -> None:
    """Raise EvaluationError if a scene has no people, or a live human (moved by another node)."""
    live = [name for name, actor in scene.actors.items() if actor.motion.motion.path == LIVE]
    if live or not scene.actors:
        reason = f"{live[0]} is moved live" if live else "there are no people in it"
        raise EvaluationError(f"{reason}: record a bag, and give it as truth", path=scene.path, key="--truth")


def truth_at(
    scene: Scene,
    times: NDArray[np.int64],
    stamps: NDArray[np.int64],
    keypoints: KeypointSet | None = None,
) -> PoseSequence:
    """Joints or keypoints of all humans of a scene at some times.

    Args:
        scene: The scene.
        times: (F,) times of the scene, nanoseconds.
        stamps: (F,) stamps of these frames, nanoseconds.
        keypoints: Set of keypoints in place of the joints.

    Raises:
        EvaluationError: The scene has no people, or a live human.
    """
    check_motions(scene)
    if keypoints is None:
        paths = {name: _path(scene, name, times) for name in scene.actors}
        joints = {name: actor.human.skeleton.joint_names for name, actor in scene.actors.items()}
    else:
        paths = {name: _keypoint_path(scene, name, times, keypoints) for name in scene.actors}
        joints = dict.fromkeys(scene.actors, keypoints.names)
    names = tuple(dict.fromkeys(joint for each in joints.values() for joint in each))
    for person, path in paths.items():
        wide = np.full((len(times), len(names), 3), np.nan)
        wide[:, [names.index(joint) for joint in joints[person]]] = path
        paths[person] = wide
    people = [{name: path[frame] for name, path in paths.items()} for frame in range(len(times))]
    return PoseSequence(names, stamps, people, source=str(scene.path or "the scene"))


def frames_of(scene: Scene, span: tuple[int, int], around: float) -> tuple[int, int]:
    """First and last frame of a scene for a span of stamps, with ``around`` seconds before and after. Frames
    outside the scene are left out."""
    margin = 0.5 + around * scene.config.rate
    first, last = ((time - FIRST_STAMP) * 1e-9 * scene.config.rate for time in span)
    first, last = max(0, int(first - margin)), max(1, int(last + margin))
    if last - first >= MAX_TRUTH_FRAMES or first >= WALL_CLOCK_FRAME:
        start, end = (f"{time * 1e-9:.3f} s" for time in span)
        raise EvaluationError(
            f"the times of the estimate, {start} to {end}, are not times of a scene, which begins at 0 s: "
            "were they stamped with a wall clock? Record truth and estimate together and give the bag as "
            "--truth, or run the scene in lockstep",
            path=scene.path,
            key="--truth",
        )
    return first, last


def _path(scene: Scene, name: str, times: NDArray[np.int64]) -> Array:
    """Joints (F, J, 3) of a human."""
    blocks = (times[begin : begin + _BLOCK] * 1e-9 for begin in range(0, len(times), _BLOCK))
    return np.concatenate([scene.actors[name].joint_paths(np.asarray(block, float)) for block in blocks])


def _keypoint_path(scene: Scene, name: str, times: NDArray[np.int64], keypoints: KeypointSet) -> Array:
    """Keypoints (F, K, 3) of a human. The body is skinned only if some keypoints are on the skin."""
    actor = scene.actors[name]
    locator = KeypointLocator.of(actor.human, keypoints)
    if locator.on_surface.any():
        states = (actor.at(time * 1e-9) for time in times.tolist())
        return np.stack([locator.positions(state.positions, state.vertices) for state in states])
    return np.stack([locator.positions(each, np.zeros((0, 3))) for each in _path(scene, name, times)])


def with_camera_counts(evaluation: Evaluation, scene: Scene) -> Evaluation:
    """Add the errors by number of cameras that have a joint in their image. Returns a copy of the result.
    Nothing is rendered, so occluded joints count, too."""
    if not len(evaluation.matches.stamp):  # nobody is matched
        return evaluation
    counts = camera_counts(scene, evaluation.matches.stamp, evaluation.matches.truth)
    known = np.isfinite(evaluation.errors)
    scores = {
        str(count): CameraCountScore(len(own), mean_error(own))
        for count in np.unique(counts[known]).tolist()
        if len(own := evaluation.errors[known & (counts == count)])
    }
    return replace(evaluation, by_cameras=scores)


def camera_counts(scene: Scene, stamps: Indices, joints: Array) -> Indices:
    """Number of cameras (M, C) that have each joint in their image. ``stamps``: (M,) nanoseconds. ``joints``:
    (M, C, 3) in ``map``, metres. A joint that is NaN is in no image."""
    counts = np.zeros(joints.shape[:2], np.intp)
    frames = {stamp: frame_at(stamp - FIRST_STAMP, scene.config.rate) for stamp in np.unique(stamps).tolist()}
    for camera in scene.scene_cameras.values():
        pictured = [stamp for stamp, frame in frames.items() if frame in camera.timing]
        blocks = [(camera.camera, np.flatnonzero(np.isin(stamps, pictured)))]
        if camera.moves:
            blocks = [
                (camera.camera_at(camera.pose((stamp - FIRST_STAMP) * 1e-9)), np.flatnonzero(stamps == stamp))
                for stamp in pictured
            ]
        for placed, rows in blocks:
            pixels = placed.project(joints[rows].reshape(-1, 3))[0]
            counts[rows] += _inside(pixels, placed.size).reshape(len(rows), -1)
    return counts


def _inside(pixels: Array, size: tuple[int, int]) -> Indices:
    """1 for pixels (..., 2) inside an image with some width and height; 0 for others and NaN."""
    inside = ((pixels >= -0.5) & (pixels < np.array(size) - 0.5)).all(axis=-1)
    return np.asarray(inside, np.intp)
