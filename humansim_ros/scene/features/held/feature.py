"""Objects that a human of the scene holds in both hands, or takes along on its path."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from humansim_ros.errors import SceneError, in_section, unknown
from humansim_ros.geometry import unit_vectors
from humansim_ros.motion.pose import PALM, WITHOUT_REACH
from humansim_ros.scene.core.features import Draft, Feature
from humansim_ros.scene.core.objects import SHAPES, SceneObject
from humansim_ros.scene.core.world import Follower, World, path_frames
from humansim_ros.scene.features.held import HoldConfig
from humansim_ros.types import Array

#: Half the thickness of a hand, metres.
_THICK = 0.018


@dataclass(frozen=True, eq=False)
class Hold(Follower):
    """A human that takes an object along in both hands or on the path; ``config``: when, and by what.

    ``own`` is the pose of the object in the frame between the palms, or below the hips.
    """

    config: HoldConfig

    def frames(self, times: Array) -> tuple[Array, Array]:
        """Middles of the palms (N, 3), and axes (N, 3, 3): x ahead, y to the left palm; or
        :func:`path_frames`."""
        if self.config.by == "path":
            return path_frames(self.actor, self._held(times), self._held)
        left, right = self.palms(self._held(times))
        y = unit_vectors(left - right)
        up = np.array([0.0, 0.0, 1.0]) - y[:, 2:] * y
        z = unit_vectors(up)
        return (left + right) / 2, np.stack([np.cross(y, z), y, z], axis=-1)

    def palms(self, times: Array) -> tuple[Array, Array]:
        """Left and right palm (N, 3) at scene times (N,)."""
        joints = self.actor.joints_at(times, WITHOUT_REACH)[..., :3, 3]
        names = self.actor.human.skeleton.joint_names
        parts = ([names.index(f"{side}_{part}") for side in "lr"] for part in ("wrist", "wrist_end"))
        wrists, tips = (joints[:, numbers] for numbers in parts)
        left, right = np.moveaxis((1 - PALM) * wrists + PALM * tips, 1, 0)
        return left, right

    @cached_property
    def width(self) -> float:
        """Metres between the inner sides of the hands when they take the object."""
        left, right = self.palms(self._held(np.zeros(1)))
        return float(np.linalg.norm(left - right)) - 2 * _THICK

    def _held(self, times: Array) -> Array:
        """Clamp scene times (N,) to the part of the cycle in which the hands hold the object."""
        human, motion = self.actor, self.actor.motion
        end = motion.cycle_length if self.config.end is None else self.config.end
        played = motion.file_times(times + human.offset, human.ahead)
        length = motion.cycle_length
        phase = played % length if motion.loop != "none" and length > 0 else played
        return np.asarray(times + (np.clip(phase, self.config.start, end) - phase) / max(motion.speed, 1e-6))


def held(item: SceneObject, config: HoldConfig, world: World) -> SceneObject:
    """An object that a human takes along. A built-in shape becomes as wide as the hands are apart. Raises
    SceneError if there is no such human, or if it has no hands."""
    actors = world.people
    if config.human not in actors:
        raise SceneError(unknown("human", config.human, actors))
    hold = Hold(world, config.human, item.initial_pose, config)
    if config.by == "path":
        return replace(item, pose_at=hold)
    if not {"l_wrist_end", "r_wrist_end"} <= set(actors[config.human].human.skeleton.joint_names):
        raise SceneError(f"{config.human} has no hands")
    if item.shape in SHAPES:
        x, _, z = item.initial_pose.size.tolist()
        hold = replace(hold, own=replace(item.initial_pose, size=np.array([x, hold.width, z])))
    return replace(item, initial_pose=hold.own, pose_at=hold, held_by=config.human)


class Held(Feature):
    """The key ``held_by`` of objects."""

    def furnish(self, draft: Draft) -> None:
        """Let objects follow the humans who take them along."""
        for name, config in draft.config.objects.items():
            if config.held_by is not None:
                with in_section(f"objects.{name}.held_by"):
                    draft.objects[name] = held(draft.objects[name], config.held_by, draft.world)


FEATURE = Held()
