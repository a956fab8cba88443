"""Retarget joints of any joint source: the motion of the scene, a motion that the player has changed, or
live motion capture, which is known by its messages only.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from humansim_ros.errors import MotionError, within_bounds
from humansim_ros.geometry import quaternion_to_matrix
from humansim_ros.motion.body import JointPoses
from humansim_ros.motion.matching import JointMatch, match_names
from humansim_ros.motion.pose import PoseStage, Retargeter, has_rotations
from humansim_ros.scene.core.actor import Actor
from humansim_ros.scene.truth.human_state import HumanState
from humansim_ros.types import Array

#: Links by which persons and rotation conventions are distinguished.
_LIMBS = tuple(f"{side}_{part}" for side in "lr" for part in ("shoulder", "elbow", "hip", "knee"))
#: Relative difference of the summed limb lengths up to which the source is the same person.
_LENGTH_TOLERANCE = 0.01
#: Deviation of a limb in the axes of its joint, as a share of its length, of the same rotations.
_AXES_TOLERANCE = 0.1
#: Deviation of limbs of a new source, as a share of their length, until its calibration is complete.
_NOISE = 0.03
#: Messages from which a new source is calibrated.
_CALIBRATION_POSES = 30
#: Consecutive deviating frames that are rejected before they count as another source, at first and at most.
_REJECTED, _MAX_REJECTED = 5, 80
#: Detected sources that are stored.
_MAX_DETECTED = 4


@dataclass(frozen=True)
class JointSource:
    """Joint names of a source, and their retargeting onto the skeleton of a human.

    Attributes:
        names: Joint names.
        retargeter: Retargeting onto the human.
        links: (L, 3) limbs in the axes of their parent joints, metres. They are constant for one person and
            one rotation convention.
        slack: (L,) observed deviations from ``links``, metres.
        since: First stamp of the source, if the motion player has announced it.
        number: Number of a detected source, from 1; 0 for a known one.
    """

    names: tuple[str, ...]
    retargeter: Retargeter
    links: Array
    slack: Array
    since: int = 0
    number: int = 0

    @classmethod
    def of_poses(cls, poses: JointPoses, retargeter: Retargeter, since: int = 0) -> JointSource:
        """Source with some known poses (N >= 1)."""
        links_of_poses = _links(poses, retargeter.match)
        links = links_of_poses.mean(0)
        if retargeter.positions_only:  # without rotations only the lengths are constant
            lengths = np.linalg.norm(links_of_poses, axis=-1)
            links = lengths.mean(0)[:, None] * [0.0, 1.0, 0.0]
            slack = np.ptp(lengths, axis=0)
        else:
            slack = np.linalg.norm(links_of_poses - links, axis=-1).max(0)
        return cls(poses.names, retargeter, links, slack, since)

    @classmethod
    def of_actor(cls, actor: Actor, since: int = 0) -> JointSource:
        """Source that plays the motion of a human of the scene."""
        motion = replace(actor.motion, speed=1.0)
        times = motion.frame_times
        return cls.of_poses(motion.sample(times[:: len(times) // 100 + 1]), actor.retargeter, since)

    def to_dict(self) -> dict[str, Any]:
        """Values for JSON."""
        return {
            "joint_names": list(self.names),
            "since": self.since,
            "links": self.links.tolist(),
            "slack": self.slack.tolist(),
            **self.retargeter.to_dict(),
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any], actor: Actor) -> JointSource:
        """Source from :meth:`to_dict` for a human. Raises MotionError if ``data`` is wrong."""
        try:
            names = tuple(str(name) for name in data["joint_names"])
            links, slack = np.array(data["links"], dtype=float), np.array(data["slack"], dtype=float)
            since = int(data["since"])
        except (KeyError, TypeError, ValueError, OverflowError) as reason:
            raise MotionError(f"this is not the legend of a motion: {reason!r}") from None
        retargeter = Retargeter.from_dict(data, actor.human.skeleton)
        match = retargeter.match
        used = [*match.roles.values(), *match.difference.values()]
        used += [*match.extra.values(), *(joint for link in match.parallel.values() for joint in link)]
        limbs = sum(bone in match.parallel for bone in _LIMBS)
        if not names or not match.complete or not all(0 <= joint < len(names) for joint in used):
            raise MotionError("this is not the legend of a motion: joints have no name")
        fits = links.shape == (limbs, 3) and slack.shape == (limbs,)
        if not fits or not within_bounds(links) or not within_bounds(slack) or (slack < 0).any():
            raise MotionError("this is not the legend of a motion: its links are wrong")
        return cls(names, retargeter, links, slack, since)

    def fits(self, poses: JointPoses) -> bool:
        """Whether a pose (N = 1) with these names has the limb lengths and the rotation convention of the
        source."""
        (links,) = _links(poses, self.retargeter.match)
        lengths = np.linalg.norm(self.links, axis=-1)
        off = abs(np.linalg.norm(links, axis=-1).sum() - lengths.sum())
        if off > _LENGTH_TOLERANCE * lengths.sum() + self.slack.sum():
            return False
        if self.retargeter.positions_only:
            return not has_rotations(poses)
        return bool(
            (np.linalg.norm(links - self.links, axis=-1) <= _AXES_TOLERANCE * lengths + self.slack).all()
        )


class LiveRetargeter:
    """Retargets the joints of any source onto a human.

    The motion of the scene and motions that the motion player announces in a legend are known. For any other
    source the joint table is matched by names (or is ``table``); scale, rest pose and floor come from its
    first message, and again from its first thirty. Frames that deviate from the source are rejected; after
    several in a row they count as another source.
    """

    def __init__(self, actor: Actor, table: str | None = None, live: bool = False) -> None:
        """``live``: the human has no motion of the scene."""
        self._actor = actor
        self._table = table
        self._scene = () if live else (JointSource.of_actor(actor),)
        # newest first
        self._legends: list[JointSource] = []
        self._detected: list[JointSource] = []
        self._source: JointSource | None = None
        self._detections = 0
        self._calibration: list[JointPoses] = []
        self._deviating: list[JointPoses] = []
        self._max_rejected = _REJECTED
        self._refused: tuple[tuple[str, ...], str] | None = None

    @property
    def source_number(self) -> int:
        """Number of the current source: 0 for a known one, from 1 for detected ones."""
        return 0 if self._source is None else self._source.number

    @property
    def detected_source(self) -> str:
        """Description of the current source if it has been detected; empty for a known source."""
        source = self._source
        if source is None or not source.number:
            return ""
        retargeter = source.retargeter
        stature = float(np.ptp(self._actor.human.mesh.vertices[:, 1])) / retargeter.scale
        text = (
            f"{len(source.names)} joints by table {retargeter.match.table}, about {stature:.2f} m tall, "
            f"scaled by {retargeter.scale:.3f}, "
            + ("by positions only" if retargeter.positions_only else "with rotations")
        )
        return text if 0.5 < stature < 2.6 else f"{text}; positions should be in metres"

    def add_legend(self, data: Mapping[str, Any]) -> None:
        """Add the legend of a motion from the motion player. Raises MotionError if it is wrong."""
        self._legends = [JointSource.from_dict(data, self._actor), *self._legends][:2]

    def retarget(self, poses: JointPoses, stamp: int | None = None) -> HumanState:
        """Body at one stamp from poses (N = 1). Raises MotionError if these joints cannot drive it."""
        if len(set(poses.names)) < len(poses.names):
            twice = sorted(name for name, count in Counter(poses.names).items() if count > 1)
            raise MotionError(f"joint names appear twice: {', '.join(twice[:6])}")
        actor = self._actor
        sent = {layer.stage: layer.sent(poses, actor) for layer in actor.layers}
        added = [name for names in sent.values() for name in names]
        own = tuple(name for name in poses.names if name not in set(added))
        space = [name for stage, names in sent.items() if stage <= PoseStage.SPACE for name in names]
        self._source = self._source_of(actor.motion_poses(poses.named((*own, *space))), stamp)
        actor = replace(actor, retargeter=self._source.retargeter)
        return actor.state(poses.named((*self._source.names, *added)))

    def _source_of(self, poses: JointPoses, stamp: int | None) -> JointSource:
        """Source of a pose: a known one, or a new one."""
        for source in self._candidates(stamp):
            if set(source.names) != set(poses.names):
                continue
            ordered = poses.named(source.names)
            if source.fits(ordered):
                self._deviating = []
                return self._calibrated(source, ordered)
        if self._source is None or not set(poses.names) <= set(self._source.names):
            self._max_rejected = _REJECTED
            return self._detect([poses])
        self._deviating = [*(pose for pose in self._deviating if pose.names == poses.names), poses]
        if len(self._deviating) < self._max_rejected:
            missing = sorted(set(self._source.names) - set(poses.names))
            if missing:
                raise MotionError(f"joints are missing: {', '.join(missing[:6])}")
            raise MotionError(
                "lengths or rotations of the limbs differ from before: a bad frame, or another person"
            )
        self._max_rejected = min(2 * self._max_rejected, _MAX_REJECTED)
        deviating, self._deviating = self._deviating, []
        return self._detect(deviating)

    def _candidates(self, stamp: int | None) -> Iterator[JointSource]:
        """Known sources, the most likely first. A legend is not valid for earlier stamps."""
        valid = [legend for legend in self._legends if stamp is None or legend.since <= stamp]
        yield from valid or self._legends
        yield from self._scene
        yield from self._detected

    def _detect(self, first: Sequence[JointPoses]) -> JointSource:
        """Detect a new source from its first poses."""
        poses = _joined(first)
        if self._refused is not None and self._refused[0] == poses.names:
            raise MotionError(self._refused[1])
        try:
            match = match_names(poses.names, self._table)
        except MotionError as error:
            self._refused = (poses.names, f"{error} (parameter joint_names)")
            raise MotionError(self._refused[1]) from None
        self._detections += 1
        source = self._fit(poses, match, self._detections)
        # a source that first came without some joints is replaced by the complete one
        complete = [known for known in self._detected if not set(known.names) < set(source.names)]
        self._detected = [source, *complete][:_MAX_DETECTED]
        self._calibration = list(first)
        return source

    def _calibrated(self, source: JointSource, poses: JointPoses) -> JointSource:
        """Source after one more pose: a new source is calibrated again when it has enough poses."""
        newest = bool(self._detected) and source is self._detected[0]
        if newest and len(self._calibration) < _CALIBRATION_POSES:
            self._calibration.append(poses)
            if len(self._calibration) == _CALIBRATION_POSES:
                source = self._fit(_joined(self._calibration), source.retargeter.match, source.number)
                self._detected[0] = source
        return source

    def _fit(self, poses: JointPoses, match: JointMatch, number: int) -> JointSource:
        source = JointSource.of_poses(poses, Retargeter.fit_live(poses, match, self._actor.human.skeleton))
        source = replace(source, number=number)
        if len(poses.positions) >= _CALIBRATION_POSES:
            return source
        # the noise of its joints is unknown yet
        return replace(source, slack=source.slack + _NOISE * np.linalg.norm(source.links, axis=-1))


def _links(poses: JointPoses, match: JointMatch) -> Array:
    """Limbs (N, L, 3) in the axes of their parent joints."""
    starts, ends = np.array([match.parallel[bone] for bone in _LIMBS if bone in match.parallel]).T
    links = poses.positions[:, ends] - poses.positions[:, starts]
    back = np.swapaxes(quaternion_to_matrix(poses.rotations[:, starts]), -1, -2)
    return np.asarray((back @ links[..., None])[..., 0])


def _joined(poses: Sequence[JointPoses]) -> JointPoses:
    """Poses of the same joints, concatenated."""
    return JointPoses(
        poses[0].names,
        np.concatenate([part.positions for part in poses]),
        np.concatenate([part.rotations for part in poses]),
    )
