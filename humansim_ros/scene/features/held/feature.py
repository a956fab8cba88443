"""Objects that a human of the scene holds in both hands, or takes along on its path."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from humansim_ros.errors import SceneError, in_section, unknown
from humansim_ros.geometry import (
    AROUND,
    VELOCITY_STEP,
    ObjectPose,
    Velocity,
    matrix_to_quaternion,
    quaternion_to_matrix,
    unit_vectors,
)
from humansim_ros.motion.pose import PALM, WITHOUT_REACH
from humansim_ros.scene.core.actor import Actor
from humansim_ros.scene.core.draft import Draft
from humansim_ros.scene.core.features import Feature
from humansim_ros.scene.core.objects import SHAPES, SceneObject
from humansim_ros.scene.core.world import World
from humansim_ros.scene.features.held.keys import HoldConfig
from humansim_ros.types import Array

#: Half the thickness of a hand, metres.
_THICK = 0.018
#: Most poses that are kept.
_KNOWN = 10_000
#: Seconds around a time over which a path is smoothed, which three strides fill.
_SMOOTHED = np.linspace(-1.5, 1.5, 31)


def _smoothing() -> Array:
    """Weights (31,): they keep a path of constant acceleration, and little of strides of a second."""
    bell = 1 + np.cos(np.pi * _SMOOTHED / _SMOOTHED[-1])
    moments = [(bell * _SMOOTHED**power).sum() for power in (0, 2, 4)]
    a, b = np.linalg.solve([moments[:2], moments[1:]], [1.0, 0.0])
    return np.asarray(bell * (a + b * _SMOOTHED**2))


@dataclass(frozen=True, eq=False)
class Hold:
    """A human that takes an object along, in the hands or on the path.

    Attributes:
        world: Knows the human by name.
        config: Which human, when, and by what.
        own: Pose of the object in the frame between the palms, or below the hips.
    """

    world: World
    config: HoldConfig
    own: ObjectPose

    def __call__(self, seconds: float) -> ObjectPose:
        """Pose and velocity at a scene time in seconds."""
        key = self.world.version, seconds
        if key not in self._known:
            if len(self._known) >= _KNOWN:
                self._known.clear()
            self._known[key] = self._at(seconds)
        return self._known[key]

    @cached_property
    def _known(self) -> dict[tuple[int, float], ObjectPose]:
        """Poses by version of the motions and scene time: humans that reach for the object ask again."""
        return {}

    @property
    def _human(self) -> Actor:
        return self.world.human(self.config.human)

    def _at(self, seconds: float) -> ObjectPose:
        times = seconds + AROUND
        positions, rotations = self.frames(times)
        turn = quaternion_to_matrix(self.own.rotation)
        places = positions + rotations @ self.own.position
        quaternions = matrix_to_quaternion(rotations @ turn)
        velocity = Velocity.between(places, quaternions, 2 * VELOCITY_STEP)
        return ObjectPose(places[1], quaternions[1], self.own.size, velocity)

    def frames(self, times: Array) -> tuple[Array, Array]:
        """Middles of the palms (N, 3), and axes (N, 3, 3): x ahead, y to the left palm.

        Of a path, points of the floor below the hips, without the sway of steps; y to the left.
        """
        if self.config.by == "path":
            return self._path(self._held(times))
        left, right = self.palms(self._held(times))
        y = unit_vectors(left - right)
        up = np.array([0.0, 0.0, 1.0]) - y[:, 2:] * y
        z = unit_vectors(up)
        return (left + right) / 2, np.stack([np.cross(y, z), y, z], axis=-1)

    def _path(self, times: Array) -> tuple[Array, Array]:
        weights = _smoothing()
        around = self._held(np.add.outer(times, _SMOOTHED).ravel())
        middle, left = (
            np.einsum("w,nwd->nd", weights, each.reshape(len(times), len(weights), 3)) * (1.0, 1.0, 0.0)
            for each in self._human.hips_at(around)
        )
        y, z = unit_vectors(left), np.broadcast_to([0.0, 0.0, 1.0], left.shape)
        return middle, np.stack([np.cross(y, z), y, z], axis=-1)

    def palms(self, times: Array) -> tuple[Array, Array]:
        """Left and right palm (N, 3) at scene times (N,)."""
        joints = self._human.joints_at(times, WITHOUT_REACH)[..., :3, 3]
        names = self._human.human.skeleton.joint_names
        wrists, tips = (
            joints[:, [names.index(f"{side}_{part}") for side in "lr"]] for part in ("wrist", "wrist_end")
        )
        left, right = np.moveaxis((1 - PALM) * wrists + PALM * tips, 1, 0)
        return left, right

    @cached_property
    def width(self) -> float:
        """Metres between the inner sides of the hands when they take the object."""
        left, right = self.palms(self._held(np.zeros(1)))
        return float(np.linalg.norm(left - right)) - 2 * _THICK

    def _held(self, times: Array) -> Array:
        """Clamp scene times (N,) to the part of the cycle in which the hands hold the object."""
        human, motion = self._human, self._human.motion
        end = motion.cycle_length if self.config.end is None else self.config.end
        played = motion.file_times(times + human.offset, human.ahead)
        length = motion.cycle_length
        phase = played % length if motion.loop != "none" and length > 0 else played
        return np.asarray(times + (np.clip(phase, self.config.start, end) - phase) / max(motion.speed, 1e-6))


def held(item: SceneObject, config: HoldConfig, world: World) -> SceneObject:
    """An object that a human takes along; a built-in shape in hands becomes as wide as these are apart.

    Raises:
        SceneError: There is no such human, or it has no hands.
    """
    actors = world.people
    if config.human not in actors:
        raise SceneError(unknown("human", config.human, actors))
    hold = Hold(world, config, item.initial_pose)
    if config.by == "path":
        return replace(item, pose_at=hold)
    if not {"l_wrist_end", "r_wrist_end"} <= set(actors[config.human].human.skeleton.joint_names):
        raise SceneError(f"{config.human} has no hands")
    if item.shape in SHAPES:
        x, _, z = item.initial_pose.size.tolist()
        hold = replace(hold, own=replace(item.initial_pose, size=np.array([x, hold.width, z])))
    return replace(item, initial_pose=hold.own, pose_at=hold, held_by=config.human)


def followed(item: SceneObject, world: World) -> SceneObject:
    """An object that follows the human of another world who takes it along. It keeps its size and place."""
    hold = item.pose_at
    return replace(item, pose_at=replace(hold, world=world)) if isinstance(hold, Hold) else item


class Held(Feature):
    """The key ``held_by`` of objects."""

    def furnish(self, draft: Draft) -> None:
        """Let objects follow the humans who take them along."""
        for name, config in draft.config.objects.items():
            if config.held_by is not None:
                with in_section(f"objects.{name}.held_by"):
                    draft.objects[name] = held(draft.objects[name], config.held_by, draft.world)


FEATURE = Held()
