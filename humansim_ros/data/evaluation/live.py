"""Evaluate an estimate while its messages arrive: over the last seconds, and over the whole run."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from humansim_ros.data.evaluation.alignment import axes_matrix, seconds
from humansim_ros.data.evaluation.evaluation import DEFAULT_GATE, Evaluation, evaluate_poses
from humansim_ros.data.evaluation.joint_names import read_names
from humansim_ros.data.evaluation.readers.estimates import in_map
from humansim_ros.data.evaluation.readers.pose_files import ReadOptions
from humansim_ros.data.evaluation.report import to_data
from humansim_ros.data.evaluation.stream import EstimateStream
from humansim_ros.data.evaluation.truth import SceneTruth
from humansim_ros.data.messages.people import Pose, PoseFrame
from humansim_ros.errors import EvaluationError, printable
from humansim_ros.people.keypoints import KeypointSet, keypoint_set

#: Most frames and joint positions that truth and estimate each store: about 500 MB in all.
MAX_FRAMES, MAX_POINTS = 100_000, 5_000_000
#: Frame that all positions must be in.
_WORLD = "map"
#: Nanoseconds by which an estimate may be before the first frame of the truth, or after the newest frame.
_MAX_AHEAD = 5 * 10**9


@dataclass(frozen=True)
class LiveOptions(ReadOptions):
    """How an estimate is read and compared. The options are those of ``humansim evaluate``.

    Attributes:
        keypoints: Keypoint set of the estimate and of the truth. If None, both have joints of the skeleton.
        table: Name of a joint in the truth by its name in the estimate.
        gate: Largest mean joint distance at which a person counts as found, metres.
    """

    keypoints: KeypointSet | None = None
    table: Mapping[str, str] | None = None
    gate: float = DEFAULT_GATE

    @classmethod
    def of(
        cls,
        keypoints: str | None,
        names: str | os.PathLike[str] | None,
        scale: float,
        axes: str | None,
        gate: float,
    ) -> LiveOptions:
        """Options from texts and numbers. An empty text and None stand for the default.

        Args:
            keypoints: Name of a keypoint set.
            names: YAML file, the same as in ``read_names``.
            scale: Metres of a unit of the estimate.
            axes: Axes of the estimate.
            gate: Largest mean joint distance at which a person counts as found, metres.

        Raises:
            HumansimError: The keypoint set or the file does not exist, or the axes are not valid.
        """
        points = keypoint_set(keypoints) if keypoints else None
        given = read_names(Path(names)) if names else None
        if axes:
            axes_matrix(axes)
        listed = tuple(given) if isinstance(given, list) else points.names if points is not None else None
        table = given if isinstance(given, dict) else None
        return cls(listed, axes=axes or None, scale=scale, keypoints=points, table=table, gate=gate)


def check_world(frame: PoseFrame) -> None:
    """Raise EvaluationError if the positions of a message are not in ``map``."""
    if frame.frame_id not in ("", _WORLD):
        raise EvaluationError(f"frame_id is '{printable(frame.frame_id, 80)}': publish positions in {_WORLD}")


class LiveEvaluation:
    """Collects truth and estimate message by message, and compares them.

    Memory is limited. In a long run, the oldest frames are forgotten.

    Args:
        source: Name of the estimate, for errors.
        options: How the estimate is read and compared.
        scene: Scene for which the truth is computed at the stamps of the estimate. If None, messages of the
            truth are added to :attr:`truth`.

    Attributes:
        truth: Messages of the truth.
        estimate: Messages of the estimate. It refuses a stamp or frame that does not fit the truth.
    """

    def __init__(self, source: str, options: LiveOptions, scene: SceneTruth | None = None) -> None:
        self._options, self._scene = options, scene
        self.truth = EstimateStream("the truth", MAX_POINTS, MAX_FRAMES, self._note_time)
        self.estimate = EstimateStream(source, MAX_POINTS, MAX_FRAMES, self._check)
        #: First and newest stamp of the truth.
        self._known: tuple[int, int] | None = None

    def _note_time(self, frame: PoseFrame) -> None:
        if frame.stamp is not None and self._scene is None:
            self.add_time(frame.stamp)

    def add_time(self, stamp: int) -> None:
        """Note that the truth has a frame with this stamp."""
        first, newest = self._known or (stamp, stamp)
        self._known = min(first, stamp), max(newest, stamp)

    def _check(self, frame: PoseFrame) -> None:
        check_world(frame)
        if not frame.stamp:
            raise EvaluationError("the message has no stamp: give it the stamp of the images")
        if self._known is None:
            return
        first, newest = self._known
        if not first - _MAX_AHEAD <= frame.stamp <= newest + _MAX_AHEAD:
            raise EvaluationError(
                f"the stamp {seconds(frame.stamp)} is not one of the truth, which has {seconds(first)} to "
                f"{seconds(newest)}: give estimates the stamps of the images"
            )

    @property
    def newest_frame(self) -> int:
        """Newest stamp of the truth in nanoseconds; -1 before the first message."""
        return -1 if self._known is None else self._known[1]

    def window(self, duration: float) -> Evaluation:
        """Compare the newest frames.

        ``duration``: length of the compared time, seconds. It ends at the newest frame of the estimate.

        Raises:
            EvaluationError: The frames cannot be compared.
        """
        newest = self.estimate.newest
        return self._evaluated(max(0, newest - round(duration * 1e9)))

    def total(self) -> Evaluation:
        """Compare all frames that are not forgotten.

        Raises:
            EvaluationError: The frames cannot be compared, for example if there is no estimate.
        """
        return self._evaluated(0)

    def to_data(self, total: Evaluation, ignored: int) -> dict[str, Any]:
        """Result for JSON, with the same keys as from ``humansim evaluate``. In ``live``, two keys are added:
        ``ignored`` messages and ``forgotten`` frames, as numbers."""
        data = to_data(total)
        assert total.live is not None
        live = {**asdict(total.live), "ignored": ignored, "forgotten": self.estimate.forgotten}
        return {**data, "live": live}

    def _evaluated(self, since: int) -> Evaluation:
        estimate = in_map(self.estimate.sequence(since), "z-up", self._options)
        if self._scene is not None:
            self._compute_truth(self._scene, int(estimate.times[-1]))
        elif not len(self.truth):
            raise EvaluationError("no truth has arrived")
        truth = self.truth.sequence(since)
        if self._scene is not None:
            truth = replace(truth, arrivals=None)
        return evaluate_poses(truth, estimate, names=self._options.table, gate=self._options.gate)

    def _compute_truth(self, scene: SceneTruth, last: int) -> None:
        """Compute the truth of a scene up to a stamp, as far as it is not known yet."""
        newest = self.truth.newest
        if newest >= last:
            return
        # the first computation may be for a window; other calls need the truth before it
        begin = self.estimate.first if newest < 0 else newest + 1
        found = scene.poses((begin, last), 0.0, self._options.keypoints)
        for stamp, people in zip(found.times.tolist(), found.people, strict=True):
            if stamp > newest:
                poses = [Pose(name, found.names, joints) for name, joints in people.items()]
                self.truth.add(PoseFrame(stamp, _WORLD, poses), "scene", stamp)
