"""Humans of a scene: body, motion and label; and their state at one scene time."""

from __future__ import annotations

import warnings
from collections import defaultdict
from collections.abc import Mapping, Set
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from humansim_ros.errors import MotionError, in_section, warn_about
from humansim_ros.files.mesh import Simplification
from humansim_ros.geometry import (
    AROUND,
    VELOCITY_STEP,
    central_difference,
    matrix_to_quaternion,
    moved,
    quaternion_to_matrix,
    rotate,
    transform,
    unit_vectors,
)
from humansim_ros.motion.body import Eyes, JointPoses, Motion, Rated
from humansim_ros.motion.files import KeyframeSpace, KeyframeTrack
from humansim_ros.motion.matching import detect_file_frame, match_motion
from humansim_ros.motion.pose import (
    BODY,
    WITHOUT_REACH,
    Gait,
    Palm,
    PathMotion,
    Placement,
    PoseStage,
    Retargeter,
    WalkPath,
    WorldMotion,
    playing_warnings,
    sample_together,
)
from humansim_ros.people.humans import Human
from humansim_ros.render.interface import Body
from humansim_ros.scene.config.config import HumanConfig, MotionConfig
from humansim_ros.scene.core.layers import BodyPoses, Fitted, PoseLayer, layer_types, layers_of
from humansim_ros.scene.core.source import STANDING, SceneSource
from humansim_ros.scene.truth.human_state import HumanState
from humansim_ros.types import Array

#: Former names of settings of layers.
_FORMER = {"face": "face", "hands": "hands", "reaches": "reach"}


@dataclass(frozen=True)
class Actor:
    """A human of a scene with the motion that drives it.

    Attributes:
        name: Name in the scene.
        instance: Instance label, from 1.
        human: Mesh, skeleton and weights.
        motion: The motion in ``map``.
        retargeter: Retargeting of the motion onto the skeleton.
        offset: Time that the motion is ahead of the scene, seconds of the scene.
        ahead: Time that the motion is ahead after a change while it played, seconds of its file.
        levels: Simpler versions of the mesh, for colours of small people; None for the whole mesh alone.
        layers: What changes the pose of the motion, in the order of the stages.
        others: The ``World`` of its scene, which knows the others by name, for gazes and reaches; or None.
    """

    name: str
    instance: int
    human: Human
    motion: WorldMotion
    retargeter: Retargeter
    offset: float = 0.0
    ahead: float = 0.0
    levels: Simplification | None = None
    layers: tuple[PoseLayer, ...] = ()
    others: Any = field(default=None, repr=False, compare=False)

    @classmethod
    def build(
        cls,
        name: str,
        instance: int,
        human: Human,
        config: MotionConfig,
        source: SceneSource,
        motion: Motion | None = None,
        before: Actor | None = None,
    ) -> Actor:
        """Create a human with a motion.

        Args:
            name: Name in the scene.
            instance: Instance label, from 1.
            human: The body.
            config: Section ``motion`` of a scene file.
            source: Finds the motion and the joint table.
            motion: The motion, if it has been read already.
            before: The same human with another motion, if there is one: its layers stay.

        Raises:
            HumansimError: The human cannot play the motion; ``key`` is relative to the section.
        """
        table = None if config.joint_names is None else source.joint_table(config.joint_names)
        section = "file" if table is None else "joint_names"
        if motion is None:
            with in_section("file"):
                read = source.motion(config.file, config.positions)
            with in_section(section):
                match = source.once(
                    lambda: match_motion(read, table, config.min_confidence),
                    *("match", config.file, config.positions, table, config.min_confidence),
                )
            motion = read
        else:
            with in_section(section):
                match = match_motion(motion, table, config.min_confidence)
        of_file = "frame", id(motion), config.unit, config.up, config.facing, table, config.min_confidence
        world = WorldMotion(
            motion,
            match,
            source.once(
                lambda: detect_file_frame(motion, match, config.unit, config.up, config.facing), *of_file
            ),
            Placement(config.position, float(np.radians(config.yaw_deg)), config.anchor),
            config.loop,
            config.start,
            config.end,
            config.speed,
            config.blend,
            config.mirror,
        )
        for warning in source.once(lambda: playing_warnings(world), "warnings", *of_file):
            warn_about(motion.path, warning)
        retargeter = cls._fit(world, human, config, source)
        fitted = Fitted(config, retargeter, source)
        for kind in layer_types():
            world = kind.corrected(world, human, fitted)
        if before is not None:
            actor = replace(before, motion=world, retargeter=retargeter, offset=config.offset, ahead=0.0)
        else:
            actor = cls(name, instance, human, world, retargeter, config.offset, layers=layers_of(human))
        return actor._fitted(config)

    def _fitted(self, config: MotionConfig) -> Actor:
        """The same human after its layers have been fitted to its motion."""
        actor = replace(self, layers=tuple(layer.fitted(self, config) for layer in self.layers))
        return actor._joined()

    def _joined(self) -> Actor:
        """The same human after its layers have been fitted to each other."""
        return replace(self, layers=tuple(layer.joined(self) for layer in self.layers))

    @classmethod
    def load(
        cls,
        name: str,
        instance: int,
        config: HumanConfig,
        source: SceneSource,
        keyframes: KeyframeTrack | None = None,
        path: WalkPath | None = None,
    ) -> Actor:
        """Load a human of a scene with its motion.

        Args:
            name: Name in the scene.
            instance: Instance label, from 1.
            config: Section of the human.
            source: Finds its files.
            keyframes: Keyframes that move it, if any.
            path: Path that its walk follows, if any.

        Raises:
            HumansimError: With the key.
        """
        with in_section(f"humans.{name}"):
            human = source.human(config.body, config.outfit, config.skinning)
            with in_section("motion"):
                actor = cls.build(name, instance, human, config.motion, source)
                if path is not None:
                    actor = actor._along(path, config.motion, source)
        return actor.with_layer("keyframes", settings=keyframes)

    def with_motion(self, config: MotionConfig, source: SceneSource, motion: Motion | None = None) -> Actor:
        """The same human with another motion; parameters as in :meth:`build`."""
        return Actor.build(self.name, self.instance, self.human, config, source, motion, self)

    def with_changed_keys(self, keys: Set[str], config: MotionConfig) -> Actor | None:
        """The same human after some keys of its section have changed. Its motion goes on.

        Returns:
            The human. None if no layer reads these keys alone: then another motion is needed.

        Raises:
            HumansimError: The keys do not fit the motion, or change nothing.
        """
        own = next((layer for layer in self.layers if keys <= layer.keys), None)
        return None if own is None else self._with(own, own.changed(self, config))._joined()

    def with_layer(self, name: str, **changes: Any) -> Actor:
        """The same human with other fields of one of its layers. Raises HumansimError if other layers do not
        fit it."""
        own = next(layer for layer in self.layers if layer.name == name)
        return self._with(own, replace(own, **changes))._joined()

    def _with(self, old: PoseLayer, new: PoseLayer) -> Actor:
        return replace(self, layers=tuple(new if layer is old else layer for layer in self.layers))

    def settings(self, name: str) -> Any:
        """Settings of one of its layers; None for nothing."""
        return next((layer.settings for layer in self.layers if layer.name == name), None)

    def __getattr__(self, name: str) -> Any:
        """Former names of settings."""
        if name not in _FORMER:
            raise AttributeError(f"a human of a scene has no attribute {name!r}")
        text = f"{name} is deprecated and goes in 0.4.0: use settings({_FORMER[name]!r})"
        warnings.warn(text, DeprecationWarning, stacklevel=2)
        return self.settings(_FORMER[name])

    @property
    def keyframes(self) -> KeyframeTrack | None:
        """Keyframes that move, rotate and scale the space of the motion over scene time."""
        track: KeyframeTrack | None = self.settings("keyframes")
        return track

    @staticmethod
    def _fit(world: WorldMotion, human: Human, config: MotionConfig, source: SceneSource) -> Retargeter:
        """Retargeting of a motion, which is fitted once for all humans with a skeleton and a motion."""

        def fit() -> Retargeter:
            origin = replace(world, placement=Placement())  # wherever the first of these humans is
            return Retargeter.fit(origin, human.skeleton, config.retarget, config.root_scale, config.clamp)

        placed = {"position", "yaw_deg", "offset", "speed", "pin_feet", "floor", "hands"}
        fitted = source.once(fit, "fit", id(human.skeleton), config.model_dump_json(exclude=placed))
        return fitted.placed_about(*world.placement.position)

    def _along(self, path: WalkPath, config: MotionConfig, source: SceneSource) -> Actor:
        """The same human with a walk along a path on the floor."""

        def make() -> Gait:
            with in_section("file"):
                standing = source.motion(STANDING, "auto")
                match = match_motion(standing)
                return Gait.of(walk, WorldMotion(standing, match, detect_file_frame(standing, match)))

        walk = self.motion
        gait = source.once(make, "gait", config.file)
        # the gait has the size of the body, so that its stride is the distance on the path
        motion = PathMotion(
            walk.motion, walk.match, walk.frame, gait=gait, path=path, size=self.retargeter.scale
        )
        return replace(self, motion=motion, retargeter=replace(self.retargeter, scale=1.0, origin=(0.0, 0.0)))

    def joint_poses(self, seconds: float) -> JointPoses:
        """Joint poses of the motion at a scene time, as the motion player publishes them."""
        poses = self.motion.sample_with_velocities(seconds + self.offset, self.ahead)
        return self.encoded(poses, seconds)

    def encoded(self, poses: JointPoses, seconds: float) -> JointPoses:
        """Joint poses of the motion at a scene time, changed by the layers."""
        for layer in self.layers:
            poses = layer.encode(poses, seconds, self)
        return poses

    @cached_property
    def memory(self) -> dict[str, Any]:
        """What the layers remember of this human, by their names."""
        return {}

    def bones_at(self, times: Array) -> Array:
        """Frames (N, B, 4, 4) of the bones, scaled, without reach, at scene times (N,)."""
        bones = self.joints_at(times, WITHOUT_REACH)[:, : len(self.human.skeleton)].copy()
        space = self.space_at(times)
        if space is not None:
            bones[..., :3, :3] *= space.size[:, None, None, None]
        return bones

    def state(self, poses: JointPoses) -> HumanState:
        """State of the body from joint poses (N = 1), bit-identical with and without a message in between."""
        skeleton, poses = self.human.skeleton, poses.contiguous()
        linear = angular = None
        features: dict[str, Rated] = {}
        moving = poses.linear is not None
        body = self.posed(poses.extrapolate(AROUND) if moving else poses)
        for topic, (rest, values) in body.values.items():
            still = replace(rest, values=values[0])
            features[topic] = rest.moving(values, 2 * VELOCITY_STEP) if moving else still
        now = len(body.bones) // 2
        bones, joints, size = body.bones[now], body.joints[now], body.sizes[now]
        if moving:
            turns = matrix_to_quaternion(body.joints[::2, :, :3, :3])
            linear, angular = central_difference(body.joints[::2, :, :3, 3], turns)
        bones = bones[: len(skeleton)]
        if size != 1:
            bones = bones @ np.diag([size, size, size, 1.0])
        rotations = matrix_to_quaternion(joints[:, :3, :3])
        return HumanState(
            skeleton.joint_names,
            transform(quaternion_to_matrix(rotations), joints[:, :3, 3]),
            linear,
            angular,
            self._skin(bones, {name: each.values for name, each in features.items()}),
            float(size),
            rotations=rotations,
            features=features,
        )

    @cached_property
    def features(self) -> Mapping[str, Rated]:
        """Values at rest that travel next to the joints, by name of their topic."""
        return {layer.topic: rest for layer in self.layers if (rest := layer.rest) is not None}

    def _skin(self, bones: Array, values: Mapping[str, Array]) -> NDArray[np.float32]:
        """Vertices (V, 3) of bone frames (B, 4, 4), with values of :attr:`HumanState.features`."""
        named = {
            layer.topic: layer.skinned(self.human, values[layer.topic])
            for layer in self.layers
            if layer.topic in values
        }
        return self.human.pose(bones, **named)

    def at(self, seconds: float) -> HumanState:
        """State of the body at a scene time in seconds."""
        return self.state(self.joint_poses(seconds))

    def joint_paths(self, times: Array) -> Array:
        """Positions (N, J, 3) of the joints of the skeleton at scene times (N,), seconds. Hands and eyes
        rest."""
        return self.joints_at(times, BODY | {PoseStage.HEAD})[..., :3, 3]

    def joints_at(self, times: Array, stages: Set[PoseStage] = BODY) -> Array:
        """Frames (N, J, 4, 4) of the joints at scene times (N,). ``stages``: stages that count, among ARMS,
        SPACE and HEAD; MOTION and FLOOR always count."""
        chosen = [layer for layer in self.layers if layer.stage in stages]
        poses = self.motion.sample(times + self.offset, self.ahead)
        for layer in chosen:
            poses = layer.bend(poses, times, self)
        joints = self.human.skeleton.joint_transforms(self.retargeter.pose(poses, {}))
        for layer in chosen:
            joints = layer.place(joints, times, self)
        return joints

    def asking(self) -> Any:
        """The ``World`` of its scene. Raises MotionError if the human is in no scene."""
        if self.others is None:
            raise MotionError(f"{self.name} is in no scene: nobody knows where the others are")
        return self.others

    def hips_at(self, times: Array) -> tuple[Array, Array]:
        """Middle of the hips (N, 3), and the direction to their left (N, 3), at scene times (N,)."""
        poses, roles = self.motion.sample(times + self.offset, self.ahead), self.motion.match.roles
        middle, left = self.retargeter.hips(poses), poses.positions[:, roles["LeftHip"]]
        left = unit_vectors(left - poses.positions[:, roles["RightHip"]])
        space = self.space_at(times)
        if space is not None:
            middle = space.position + space.size[:, None] * rotate(space.rotation, middle)
            left = rotate(space.rotation, left)
        return middle, left

    def palms_at(self, side: str, times: Array) -> Array:
        """Points (N, 3) of the skin of the ``left`` or ``right`` palm at scene times (N,)."""
        space = self.space_at(times)
        size = 1.0 if space is None else space.size[:, None]
        return Palm.of(self.human.skeleton, side).points(self.joints_at(times), size)

    def space_at(self, times: Array) -> KeyframeSpace | None:
        """Space of the motion, as keyframes move it, at scene times (N,); None without keyframes."""
        if self.keyframes is None:
            return None
        key = self.keyframes.at(times)
        return KeyframeSpace(key.position, quaternion_to_matrix(key.quaternion), key.size[:, 0])

    def eye_rays(self, times: Array) -> tuple[Array, Array]:
        """Middle of the eyes (N, 3) and direction ahead (N, 3) at scene times (N,), before the head turns.
        For a body without eyes: middle of the head, and direction of its top."""
        return self.rays(self.joints_at(times, WITHOUT_REACH))

    def rays(self, joints: Array) -> tuple[Array, Array]:
        """Middle of the eyes (N, 3) and direction ahead (N, 3) of frames (N, J, 4, 4) of the joints."""
        if self._eyes is not None:
            return self._eyes.rays(joints)
        bone = self.human.skeleton.bone("vt3")
        head = joints[:, bone]
        along = head[:, :3, 1]
        return head[:, :3, 3] + 0.5 * self.human.skeleton.lengths[bone] * along, along

    def played(self, times: Array) -> Array:
        """Seconds (N,) of the file of the motion that are played at scene times (N,)."""
        return self.motion.phases(times + self.offset, self.ahead)

    def plays(self, path: str) -> bool:
        """Whether its motion is of a file."""
        return self.motion.motion.path == path

    @cached_property
    def _eyes(self) -> Eyes | None:
        return Eyes.of(self.human.skeleton)

    def moved(self, state: HumanState, seconds: float) -> NDArray[np.float32]:
        """Vertices (V, 3) some time after a state, with all joints at constant velocity.

        Args:
            state: State of this human. Without velocities, its vertices stay.
            seconds: Time after the state; negative for before.
        """
        if state.linear is None or state.angular is None:
            return state.vertices
        skeleton, joints, features = self.human.skeleton, state.joints, state.features
        count = len(skeleton)
        bones = moved(joints[:count], state.linear[:count], state.angular[:count], seconds)
        own = [
            (layer, features[layer.topic], bone)
            for layer in self.layers
            if layer.topic in features and (bone := layer.moved_bone(features[layer.topic])) >= 0
        ]
        size = skeleton.size_of(joints[:count, :3, 3], but=own[0][2] if own else -1)
        for layer, rated, bone in own:  # the values move the skin, not the bone
            joints = joints.copy()
            joints[bone] = layer.undone(joints[bone], rated.values, size)
            bones[bone] = layer.undone(bones[bone], rated.after(seconds), size)
        # fingers, toes, jaw and eyes stay joined to the bone above: they are short, and would come apart
        for details in skeleton.detail_levels:
            above = skeleton.parents[details]
            offset = joints[details, :3, 3] - joints[above, :3, 3]
            turn = bones[above, :3, :3] @ np.swapaxes(joints[above, :3, :3], -1, -2)
            bones[details, :3, 3] = bones[above, :3, 3] + rotate(turn, offset)
        bones = bones @ np.diag([size, size, size, 1.0]) if size != 1 else bones
        return self._skin(bones, {name: each.after(seconds) for name, each in state.features.items()})

    def body(self, vertices: NDArray[np.float32]) -> Body:
        """Body for renderers from the vertices (V, 3) of a frame."""
        return Body(self.human.mesh, vertices, self.human.triangle_parts, self.instance, levels=self.levels)

    def posed(self, poses: JointPoses) -> BodyPoses:
        """The body posed by joint poses at N times."""
        body, carried = self._before_fit(poses)
        rotations = self.retargeter.pose(body.poses, body.turns)
        body.joints = body.bones = self.human.skeleton.joint_transforms(rotations)
        body.sizes = np.ones(len(body.bones))
        for layer, data in reversed(carried):
            layer.after_fit(body, data)
        return body

    def motion_poses(self, poses: JointPoses) -> JointPoses:
        """Joints of the motion that joint poses with joints of layers were made of."""
        return self._before_fit(poses)[0].poses

    def _before_fit(self, poses: JointPoses) -> tuple[BodyPoses, list[tuple[PoseLayer, Any]]]:
        """A body before its fit, and each layer that has joints in the poses with its data, the last layer
        first."""
        body, carried = BodyPoses(poses), []
        for layer in reversed(self.layers):
            rest, own = layer.take(body.poses)
            if own.names:
                body.poses = rest
                carried.append((layer, layer.before_fit(body, own)))
        return body, carried


def joint_poses_of(actors: Mapping[str, Actor], seconds: float) -> dict[str, JointPoses]:
    """Joint poses of humans by name at a scene time, equal to :meth:`Actor.joint_poses`. Humans who walk
    along paths with one gait are computed together."""
    walking: dict[int, dict[str, PathMotion]] = defaultdict(dict)
    for name, actor in actors.items():
        if isinstance(actor.motion, PathMotion):
            walking[id(actor.motion.gait)][name] = actor.motion
    together: dict[str, JointPoses] = {}
    for motions in walking.values():
        times = [
            motion.file_times(seconds + actors[name].offset, actors[name].ahead)
            for name, motion in motions.items()
        ]
        together |= zip(motions, sample_together(list(motions.values()), times), strict=True)
    return {
        name: actor.encoded(together[name], seconds) if name in together else actor.joint_poses(seconds)
        for name, actor in actors.items()
    }
