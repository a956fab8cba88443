"""A body that follows any source of joints: the scene's own motion, what a player has changed it to, or live
motion capture of which only messages are known.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from humansim_ros.errors import MotionError
from humansim_ros.motion.joint_names import JointMatch, find_match
from humansim_ros.motion.keyframes import take_back
from humansim_ros.motion.retarget import Retargeter, has_turns, leg_length
from humansim_ros.motion.world import JointPoses
from humansim_ros.scene.scene import Actor, HumanState

#: Legs that differ by more than this share are another person's.
_SAME_LEGS = 0.01


@dataclass(frozen=True)
class Source:
    """What a body follows: joint names, leg length (metres), how they are put onto its skeleton."""

    names: tuple[str, ...]
    legs: float
    retargeter: Retargeter

    @classmethod
    def of_actor(cls, actor: Actor) -> Source:
        """The motion that the scene file gives a human."""
        legs = leg_length(actor.motion.sample(0.0), actor.motion.match)
        return cls(actor.motion.names, legs, actor.retargeter)

    def to_dict(self) -> dict[str, Any]:
        """As JSON can hold it."""
        return {"joint_names": list(self.names), "leg_length": self.legs, **self.retargeter.to_dict()}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any], actor: Actor) -> Source:
        """What :meth:`to_dict` wrote, for a human; MotionError if it is something else."""
        try:
            names, legs = tuple(str(name) for name in data["joint_names"]), float(data["leg_length"])
        except (KeyError, TypeError, ValueError) as reason:
            raise MotionError(f"this is no legend of a motion: {reason!r}") from None
        retargeter = Retargeter.from_dict(data, actor.human.skeleton)
        used = (*retargeter.match.roles.values(), *retargeter.match.difference.values())
        links = [joint for link in retargeter.match.parallel.values() for joint in link]
        if not names or not all(0 <= joint < len(names) for joint in (*used, *links)):
            raise MotionError("this is no legend of a motion: it speaks of joints that it does not name")
        return cls(names, legs, retargeter)

    def fits(self, poses: JointPoses) -> bool:
        """Whether joints are of this source: the same names, and legs as long."""
        if poses.names != self.names:
            return False
        legs = leg_length(poses, self.retargeter.match)
        return bool(abs(legs - self.legs) <= _SAME_LEGS * self.legs)


class Follower:
    """Puts the joints that come onto a human's body, whoever sends them.

    The scene's motion, and what a player says of another in a legend, are known; of any other source the
    joint table is found by names (or is ``table``), and scale, rest pose and floor by the first pose.
    """

    def __init__(self, actor: Actor, table: str | None = None) -> None:
        self._scene_actor = actor
        self._table = table
        self._known = [Source.of_actor(actor)]
        self._source = self._known[0]
        #: What was found of the newest source, in words; empty for known ones.
        self.found = ""

    @property
    def actor(self) -> Actor:
        """The human with what it follows now."""
        return replace(self._scene_actor, retargeter=self._source.retargeter)

    def hear_legend(self, data: Mapping[str, Any]) -> None:
        """Take what a player says of its motion. MotionError if it is no legend."""
        source = Source.from_dict(data, self._scene_actor)
        self._known = [source, Source.of_actor(self._scene_actor)]
        if source.names == self._source.names:
            self._source = source

    def follow(self, poses: JointPoses) -> HumanState:
        """The body at one instant (N = 1). Raises MotionError where these joints cannot drive it; what was
        followed before is then kept for the next.
        """
        own, _ = take_back(poses)
        if own.names != self._source.names and sorted(own.names) == sorted(self._source.names):
            poses = _in_order(poses, (*self._source.names, *poses.names[len(own.names) :]))
            own, _ = take_back(poses)
        if not self._source.fits(own):
            self._source = self._find(own)
        elif self._source.retargeter.positions_only and has_turns(own):
            self._source = self._observe(own, self._source.retargeter.match)
        return self.actor.state(poses)

    def _find(self, poses: JointPoses) -> Source:
        """The source that joints are of: a known one, or one that is seen for the first time."""
        for source in self._known:
            if source.fits(poses):
                self.found = ""
                return source
        if set(poses.names) < set(self._source.names):
            missing = sorted(set(self._source.names) - set(poses.names))
            raise MotionError(f"joints are missing: {', '.join(missing[:6])}")
        return self._observe(poses, find_match(poses.names, self._table))

    def _observe(self, poses: JointPoses, match: JointMatch) -> Source:
        retargeter = Retargeter.observe(poses, match, self._scene_actor.human.skeleton)
        self.found = (
            f"{len(poses.names)} joints of table {match.table}, scaled by {retargeter.scale:.3f}, "
            + ("positions only" if retargeter.positions_only else "with rotations")
        )
        return Source(poses.names, leg_length(poses, match), retargeter)


def _in_order(poses: JointPoses, names: tuple[str, ...]) -> JointPoses:
    order = np.array([poses.names.index(name) for name in names])
    linear, angular = (
        None if velocity is None else velocity[:, order] for velocity in (poses.linear, poses.angular)
    )
    return JointPoses(names, poses.positions[:, order], poses.rotations[:, order], linear, angular)
