"""A body that follows any source of joints: the scene's own motion, what a player has changed it to, or live
motion capture of which only messages are known.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from humansim_ros.errors import MotionError
from humansim_ros.motion.joint_match import JointMatch
from humansim_ros.motion.joint_matching import match_names
from humansim_ros.motion.joint_poses import JointPoses
from humansim_ros.motion.joint_rotations import has_rotations
from humansim_ros.motion.keyframe_tracks import SPACE_JOINTS, undo_keyframes
from humansim_ros.motion.retarget import Retargeter
from humansim_ros.rotations import quaternion_to_matrix
from humansim_ros.scene.actor import Actor, HumanState
from humansim_ros.types import Array

#: The links that tell people, and conventions of rotations, from each other.
_LIMBS = tuple(f"{side}_{part}" for side in "lr" for part in ("shoulder", "elbow", "hip", "knee"))
#: Limbs that are longer or shorter by more than this share are another person's.
_SAME_LENGTH = 0.01
#: A limb that is off by more than this share of its length, seen from its joint, is turned otherwise.
_SAME_AXES = 0.1
#: What the limbs of a new source may be off by, as a share of their length, until it has been looked at.
_NOISE = 0.03
#: Messages after which a new source has been looked at long enough.
_LOOKED_AT = 30
#: Frames in a row that may be broken before they count as another source, at first and at most.
_PATIENCE, _MAX_PATIENCE = 5, 80
#: New sources that are remembered.
_REMEMBERED = 4


@dataclass(frozen=True)
class JointSource:
    """What a body follows: joint names, and how they are put onto its skeleton.

    ``links`` (L, 3): the limbs in the axes of the joints that carry them, metres, which are the same in all
    poses of a person whose joints' rotations mean the same; ``slack`` (L,): how far they were seen from that.
    ``since``: stamp from which on a player means it.
    """

    names: tuple[str, ...]
    retargeter: Retargeter
    links: Array
    slack: Array
    since: int = 0

    @classmethod
    def of_poses(cls, poses: JointPoses, retargeter: Retargeter, since: int = 0) -> JointSource:
        """A source of which some poses (N >= 1) are known."""
        seen = _links(poses, retargeter.match)
        links = seen.mean(0)
        if retargeter.positions_only:  # they are in no joint's axes: their lengths count only
            lengths = np.linalg.norm(seen, axis=-1)
            links = lengths.mean(0)[:, None] * [0.0, 1.0, 0.0]
            slack = np.ptp(lengths, axis=0)
        else:
            slack = np.linalg.norm(seen - links, axis=-1).max(0)
        return cls(poses.names, retargeter, links, slack, since)

    @classmethod
    def of_actor(cls, actor: Actor, since: int = 0) -> JointSource:
        """The motion that a human of a scene plays."""
        motion = replace(actor.motion, speed=1.0)
        times = motion.frame_times
        return cls.of_poses(motion.sample(times[:: len(times) // 100 + 1]), actor.retargeter, since)

    def to_dict(self) -> dict[str, Any]:
        """As JSON can hold it."""
        return {
            "joint_names": list(self.names),
            "since": self.since,
            "links": self.links.tolist(),
            "slack": self.slack.tolist(),
            **self.retargeter.to_dict(),
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any], actor: Actor) -> JointSource:
        """What :meth:`to_dict` wrote, for a human; MotionError if it is something else."""
        try:
            names = tuple(str(name) for name in data["joint_names"])
            links, slack = np.array(data["links"], dtype=float), np.array(data["slack"], dtype=float)
            since = int(data["since"])
        except (KeyError, TypeError, ValueError, OverflowError) as reason:
            raise MotionError(f"this is no legend of a motion: {reason!r}") from None
        retargeter = Retargeter.from_dict(data, actor.human.skeleton)
        match = retargeter.match
        used = [*match.roles.values(), *match.difference.values()]
        used += [joint for link in match.parallel.values() for joint in link]
        limbs = sum(bone in match.parallel for bone in _LIMBS)
        if not names or not match.complete or not all(0 <= joint < len(names) for joint in used):
            raise MotionError("this is no legend of a motion: it speaks of joints that it does not name")
        if links.shape != (limbs, 3) or slack.shape != (limbs,) or not np.isfinite([*links.T, slack]).all():
            raise MotionError("this is no legend of a motion: its links are none")
        return cls(names, retargeter, links, slack, since)

    def fits(self, poses: JointPoses) -> bool:
        """Whether a pose (N = 1) with these names is of this source: limbs as long, and rotations that mean
        the same.
        """
        (links,) = _links(poses, self.retargeter.match)
        lengths = np.linalg.norm(self.links, axis=-1)
        off = abs(np.linalg.norm(links, axis=-1).sum() - lengths.sum())
        if off > _SAME_LENGTH * lengths.sum() + self.slack.sum():
            return False
        if self.retargeter.positions_only:
            return not has_rotations(poses)
        return bool((np.linalg.norm(links - self.links, axis=-1) <= _SAME_AXES * lengths + self.slack).all())


class Follower:
    """Puts the joints that come onto a human's body, whoever sends them.

    What a player says of its motion in a legend, and the scene's motion, are known. Of any other source the
    joint table is found by names (or is ``table``), and scale, rest pose and floor by its first message and,
    better, by its first thirty. Frames that do not go with those before are refused until there have been
    some in a row: then they are another source's.
    """

    def __init__(self, actor: Actor, table: str | None = None) -> None:
        self._actor = actor
        self._table = table
        self._scene = JointSource.of_actor(actor)
        # newest first
        self._legends: list[JointSource] = []
        self._observed: list[JointSource] = []
        self._source: JointSource | None = None
        self._looked_at: list[JointPoses] = []
        self._odd: list[JointPoses] = []
        self._patience = _PATIENCE
        self._refused: tuple[tuple[str, ...], str] | None = None

    @property
    def found(self) -> str:
        """What was found of a source that nobody has told about, in words; empty while a known one is
        followed.
        """
        source = self._source
        if source is None or not any(source is observed for observed in self._observed):
            return ""
        retargeter = source.retargeter
        stature = float(np.ptp(self._actor.human.mesh.vertices[:, 1])) / retargeter.scale
        text = (
            f"{len(source.names)} joints by table {retargeter.match.table}, about {stature:.2f} m tall, "
            f"scaled by {retargeter.scale:.3f}, "
            + ("by positions only" if retargeter.positions_only else "with rotations")
        )
        return text if 0.5 < stature < 2.6 else f"{text}; positions should be in metres"

    def hear_legend(self, data: Mapping[str, Any]) -> None:
        """Take what a player says of its motion. MotionError if it is no legend."""
        self._legends = [JointSource.from_dict(data, self._actor), *self._legends][:2]

    def follow(self, poses: JointPoses, stamp: int | None = None) -> HumanState:
        """The body at one instant (N = 1). Raises MotionError where these joints cannot drive it."""
        if len(set(poses.names)) < len(poses.names):
            twice = sorted({name for name in poses.names if poses.names.count(name) > 1})
            raise MotionError(f"joints are there twice: {', '.join(twice[:6])}")
        space = SPACE_JOINTS if set(SPACE_JOINTS) <= set(poses.names) else ()
        own = tuple(name for name in poses.names if name not in space)
        moved, _ = undo_keyframes(_in_order(poses, (*own, *space)))
        self._source = self._find(moved, stamp)
        actor = replace(self._actor, retargeter=self._source.retargeter)
        return actor.state(_in_order(poses, (*self._source.names, *space)))

    def _find(self, poses: JointPoses, stamp: int | None) -> JointSource:
        """The source that a pose is of: a known one, or one that is seen for the first time."""
        for source in self._candidates(stamp):
            if set(source.names) != set(poses.names):
                continue
            ordered = _in_order(poses, source.names)
            if source.fits(ordered):
                self._odd = []
                return self._look(source, ordered)
        if self._source is None or not set(poses.names) <= set(self._source.names):
            self._patience = _PATIENCE
            return self._observe([poses])
        self._odd = [*(odd for odd in self._odd if odd.names == poses.names), poses]
        if len(self._odd) < self._patience:
            missing = sorted(set(self._source.names) - set(poses.names))
            if missing:
                raise MotionError(f"joints are missing: {', '.join(missing[:6])}")
            raise MotionError(
                "the limbs are not as long, or not turned, as before: a bad frame, or another person"
            )
        self._patience = min(2 * self._patience, _MAX_PATIENCE)
        odd, self._odd = self._odd, []
        return self._observe(odd)

    def _candidates(self, stamp: int | None) -> Iterator[JointSource]:
        """Known sources, the likeliest first. A legend is not meant for what was sent before it."""
        meant = [legend for legend in self._legends if stamp is None or legend.since <= stamp]
        yield from meant or self._legends
        yield self._scene
        yield from self._observed

    def _observe(self, seen: Sequence[JointPoses]) -> JointSource:
        """A source that is seen for the first time."""
        poses = _joined(seen)
        if self._refused is not None and self._refused[0] == poses.names:
            raise MotionError(self._refused[1])
        try:
            match = match_names(poses.names, self._table)
        except MotionError as error:
            self._refused = (poses.names, f"{error} (parameter joint_names)")
            raise MotionError(self._refused[1]) from None
        source = self._fitted(poses, match)
        # of a source that first came with some joints missing, the whole one is meant from now on
        others = [known for known in self._observed if not set(known.names) < set(source.names)]
        self._observed = [source, *others][:_REMEMBERED]
        self._looked_at = list(seen)
        return source

    def _look(self, source: JointSource, poses: JointPoses) -> JointSource:
        """The source as it is after one more pose of it: a new one is fitted again when enough are known."""
        newest = bool(self._observed) and source is self._observed[0]
        if newest and len(self._looked_at) < _LOOKED_AT:
            self._looked_at.append(poses)
            if len(self._looked_at) == _LOOKED_AT:
                source = self._fitted(_joined(self._looked_at), source.retargeter.match)
                self._observed[0] = source
        return source

    def _fitted(self, poses: JointPoses, match: JointMatch) -> JointSource:
        source = JointSource.of_poses(poses, Retargeter.fit_live(poses, match, self._actor.human.skeleton))
        if len(poses.positions) >= _LOOKED_AT:
            return source
        # how noisy its joints are is not known yet
        return replace(source, slack=source.slack + _NOISE * np.linalg.norm(source.links, axis=-1))


def _links(poses: JointPoses, match: JointMatch) -> Array:
    """The limbs (N, L, 3) in the axes of the joints that carry them."""
    starts, ends = np.array([match.parallel[bone] for bone in _LIMBS if bone in match.parallel]).T
    links = poses.positions[:, ends] - poses.positions[:, starts]
    back = np.swapaxes(quaternion_to_matrix(poses.rotations[:, starts]), -1, -2)
    return np.asarray((back @ links[..., None])[..., 0])


def _in_order(poses: JointPoses, names: tuple[str, ...]) -> JointPoses:
    """Those joints of poses that are named, in that order."""
    if names == poses.names:
        return poses
    index = {name: number for number, name in enumerate(poses.names)}
    order = [index[name] for name in names]
    linear, angular = (
        None if velocity is None else velocity[:, order] for velocity in (poses.linear, poses.angular)
    )
    return JointPoses(names, poses.positions[:, order], poses.rotations[:, order], linear, angular)


def _joined(poses: Sequence[JointPoses]) -> JointPoses:
    """Poses of the same joints, one after the other."""
    return JointPoses(
        poses[0].names,
        np.concatenate([part.positions for part in poses]),
        np.concatenate([part.rotations for part in poses]),
    )
