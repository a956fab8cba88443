"""A scene ready to run: humans with their motions, cameras, the static world."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from humansim_ros.body import Human
from humansim_ros.body.mesh import Mesh
from humansim_ros.camera import Camera
from humansim_ros.errors import SceneError
from humansim_ros.files import beside
from humansim_ros.motion.contacts import FootContacts
from humansim_ros.motion.files import read_motion, split_name
from humansim_ros.motion.joint_names import match_motion
from humansim_ros.motion.keyframes import SPACE_JOINTS, Track, take_back
from humansim_ros.motion.kinematics import Motion
from humansim_ros.motion.retarget import Retargeter
from humansim_ros.motion.world import (
    VELOCITY_STEP,
    JointPoses,
    Placement,
    WorldMotion,
    central_difference,
    understand,
)
from humansim_ros.render import Body, GLRenderer, PyrenderRenderer, make_renderer
from humansim_ros.resources import resource_path
from humansim_ros.rotations import Array, matrix_to_quaternion, moved
from humansim_ros.scene.config import (
    HumanConfig,
    MotionConfig,
    ObjectConfig,
    SceneConfig,
    find_file,
    find_human,
    line_of_key,
    load_config,
)
from humansim_ros.scene.filming import SceneCamera, build_cameras
from humansim_ros.scene.objects import SceneObject, load_tracks
from humansim_ros.scene.randomise import Around, clutter, jittered, restyled
from humansim_ros.scene.variety import with_variety
from humansim_ros.scene.world import World

DEMO_SCENE = "config/scenes/demo.yaml"


@dataclass(frozen=True)
class HumanState:
    """A human at one instant, in ``map``, metres.

    ``joint_names``: J names. ``joints``: (J, 4, 4) poses of the joints, each with its bone's axes (y along
    the bone).
    ``linear``, ``angular``: (J, 3) velocities in ``map``, m/s and rad/s, or None where the motion gives none.
    ``vertices``: (V, 3) float32 in mesh order. ``size``: how many times as large as the body is by itself
    (keyframes).
    """

    joint_names: tuple[str, ...]
    joints: Array
    linear: Array | None
    angular: Array | None
    vertices: NDArray[np.float32]
    size: float = 1.0

    @property
    def positions(self) -> Array:
        """(J, 3) joint positions."""
        return self.joints[:, :3, 3]


@dataclass(frozen=True)
class Actor:
    """One human of a scene: its body, what drives it, and the label it is drawn with.

    ``offset``: seconds of the scene that the motion is ahead by, ``ahead``: seconds of its file, after it has
    been changed while it played. ``keyframes``: move, turn and size the space in which the motion plays, on
    the clock of the scene.
    """

    name: str
    instance: int
    human: Human
    motion: WorldMotion
    retargeter: Retargeter
    offset: float = 0.0
    ahead: float = 0.0
    keyframes: Track | None = None

    @classmethod
    def build(
        cls,
        name: str,
        instance: int,
        human: Human,
        config: MotionConfig,
        scene: Path,
        motion: Motion | None = None,
    ) -> Actor:
        """A human with the motion of a scene file, which may have been read already (``motion``). Raises
        HumansimError naming what is wrong with it.
        """
        if motion is None:
            file, animation = split_name(config.file)
            path = find_file(file, "motions", ".bvh", scene, f"humans.{name}.motion.file")
            motion = read_motion(path if animation is None else f"{path}#{animation}", config.positions)
        table = config.joint_names
        if table is not None:
            own, there = beside(scene, table)
            table = str(own) if there and own.is_file() else table
        match = match_motion(motion, table).with_own(human.skeleton.names, motion.joint_names)
        world = WorldMotion(
            motion,
            match,
            understand(motion, match, config.unit, config.up, config.facing),
            Placement(config.position, float(np.radians(config.yaw_deg)), config.anchor),
            config.loop,
            config.start,
            config.end,
            config.speed,
            config.blend,
            config.mirror,
        )
        retargeter = Retargeter.fit(world, human.skeleton, config.retarget, config.root_scale, config.clamp)
        if config.pin_feet:
            world = replace(world, clean_up=FootContacts.detect(world, retargeter))
        return cls(name, instance, human, world, retargeter, config.offset)

    def with_motion(self, config: MotionConfig, scene: Path, motion: Motion | None = None) -> Actor:
        """The same human doing something else; files are looked for as from the scene file, but for a
        ``motion`` that has been read already.
        """
        changed = Actor.build(self.name, self.instance, self.human, config, scene, motion)
        return replace(changed, keyframes=self.keyframes)

    @property
    def motion_names(self) -> tuple[str, ...]:
        """Names of :meth:`joint_poses`: the motion's joints, and SPACE_JOINTS where there are keyframes."""
        return self.motion.names if self.keyframes is None else (*self.motion.names, *SPACE_JOINTS)

    def joint_poses(self, seconds: float) -> JointPoses:
        """The motion's joints at a time since the start of the scene: what the motion player publishes."""
        poses = self.motion.sample_moving(seconds + self.offset, self.ahead)
        return poses if self.keyframes is None else self.keyframes.carry(poses, seconds)

    def state(self, poses: JointPoses) -> HumanState:
        """The body at one instant, from joint poses with N = 1: what the skinner publishes."""
        skeleton = self.human.skeleton
        if poses.linear is None:
            (joints,), (size,) = self._joints(poses)
            linear = angular = None
        else:
            (before, joints, after), (_, size, _) = self._joints(
                poses.moved([-VELOCITY_STEP, 0.0, VELOCITY_STEP])
            )
            linear, angular = central_difference(
                before[:, :3, 3],
                after[:, :3, 3],
                matrix_to_quaternion(before[:, :3, :3]),
                matrix_to_quaternion(after[:, :3, :3]),
                2 * VELOCITY_STEP,
            )
        bones = joints[: len(skeleton)]
        if size != 1:
            bones = bones @ np.diag([size, size, size, 1.0])
        return HumanState(skeleton.joint_names, joints, linear, angular, self.human.pose(bones), float(size))

    def at(self, seconds: float) -> HumanState:
        """The body at a time since the start of the scene."""
        return self.state(self.joint_poses(seconds))

    def moved(self, joints: Array, linear: Array, angular: Array, seconds: float) -> NDArray[np.float32]:
        """Vertices (V, 3) some time after an instant, or before, every joint at constant velocity.

        ``joints`` (J, 4, 4), ``linear``, ``angular`` (J, 3): as in :class:`HumanState`.
        """
        skeleton = self.human.skeleton
        count = len(skeleton)
        bones = moved(joints[:count], linear[:count], angular[:count], seconds)
        size = _size(joints[:count, :3, 3], skeleton.heads, skeleton.parents)
        return self.human.pose(bones @ np.diag([size, size, size, 1.0]) if size != 1 else bones)

    def body(self, vertices: NDArray[np.float32]) -> Body:
        """What a renderer needs to draw this human with its vertices (V, 3) as they stand in a frame."""
        return Body(self.human.mesh, vertices, self.human.triangle_parts, self.instance)

    def _joints(self, poses: JointPoses) -> tuple[Array, Array]:
        """Frames (N, J, 4, 4) of the ground-truth joints, and how large the body is (N,)."""
        own, space = take_back(poses)
        joints = self.human.skeleton.joint_transforms(self.retargeter.pose(own))
        return (joints, np.ones(len(joints))) if space is None else (space.carry(joints), space.size)


@dataclass(frozen=True)
class Scene:
    """Everything that is simulated. Humans are numbered from 1 in the file's order, then the objects that are
    to have labels, then clutter that is: their instance labels.
    """

    path: Path
    config: SceneConfig
    actors: dict[str, Actor]
    scene_cameras: dict[str, SceneCamera]
    objects: dict[str, SceneObject] = field(default_factory=dict)
    world: World = field(default_factory=World)

    @classmethod
    def load(cls, path: str | os.PathLike[str] | None = None) -> Scene:
        """Load a scene file (the demo scene if none is given). Raises HumansimError naming file and key."""
        path = resource_path(DEMO_SCENE) if path is None else Path(path)
        return cls.build(with_variety(load_config(path), path), path)

    @classmethod
    def build(cls, config: SceneConfig, path: Path) -> Scene:
        """The scene of a checked configuration; files it names are looked for from the folder of ``path``."""
        tracks = load_tracks(config, path)
        actors = {
            name: _actor(name, number, human, path, tracks.get(("humans", name)))
            for number, (name, human) in enumerate(config.humans.items(), 1)
        }
        objects: dict[str, SceneObject] = {}
        _add_objects(objects, config.objects, path, tracks, actors)
        world = World.load(config, path)
        cameras = {
            name: replace(camera, backdrop=camera.backdrop or world.backdrop)
            for name, camera in build_cameras(config, path).items()
        }
        if config.randomise is not None:
            cameras = jittered(cameras, config.randomise)
        if config.randomise is not None and config.randomise.clutter:
            still = [*world.meshes, *(thing.standing() for thing in objects.values() if not thing.moves)]
            things = clutter(config, path, Around.of(actors.values(), cameras, objects, still))
            _add_objects(objects, things, path, tracks, actors)
        distorted = [name for name, camera in cameras.items() if camera.camera.distorted]
        if config.renderer == "pyrender" and distorted:
            raise SceneError(
                f"pyrender knows no lens distortion, such as that of {distorted[0]}: take moderngl",
                path=path,
                line=line_of_key(path, "renderer"),
                key="renderer",
            )
        return cls(path, config, actors, cameras, objects, world)

    def make_renderer(self, device: int | None = None) -> GLRenderer | PyrenderRenderer:
        """A renderer of the kind that the scene asks for, in its static world. ``device``: number of the GPU
        as EGL counts them; the first that works if None. Raises RenderError.
        """
        light = self.world.lighting
        return make_renderer(self.config.renderer, self.static_meshes, light, device, self.standing_bodies)

    @cached_property
    def cameras(self) -> dict[str, Camera]:
        """The cameras of image_raw, as they stand at the start."""
        return {name: camera.camera for name, camera in self.scene_cameras.items()}

    @cached_property
    def moving_cameras(self) -> dict[str, SceneCamera]:
        """The cameras that trajectories move."""
        return {name: camera for name, camera in self.scene_cameras.items() if camera.moves}

    @property
    def period(self) -> float:
        """Seconds between frames."""
        return 1 / self.config.rate

    def frame_time(self, index: int) -> int:
        """Nanoseconds from the start to frame ``index``: round(index * period), so that no error adds up."""
        return round(index * 1_000_000_000 / self.config.rate)

    @cached_property
    def labels(self) -> dict[str, int]:
        """Instance labels by name: of all humans, then of the objects that have one."""
        return {name: actor.instance for name, actor in self.actors.items()} | self.object_labels

    @cached_property
    def object_labels(self) -> dict[str, int]:
        """Instance labels of the objects that have one, by name."""
        return {name: thing.instance for name, thing in self.objects.items() if thing.instance}

    @cached_property
    def static_meshes(self) -> list[Mesh]:
        """The world that stands still and has no labels."""
        meshes, standing = self._standing
        return [*meshes, *(mesh for name, mesh in standing.items() if not self.objects[name].instance)]

    @cached_property
    def standing_bodies(self) -> list[Body]:
        """The objects with labels that stand still: always the same bodies."""
        things = ((self.objects[name], mesh) for name, mesh in self._standing[1].items())
        return [thing.standing_body(mesh) for thing, mesh in things if thing.instance]

    @cached_property
    def _standing(self) -> tuple[list[Mesh], dict[str, Mesh]]:
        """The world, and the objects that stand still by name, in ``map`` with the looks they have."""
        standing = {name: thing.standing() for name, thing in self.objects.items() if not thing.moves}
        meshes = [*self.world.meshes, *standing.values()]
        if self.config.randomise is not None:
            meshes = restyled(meshes, self.config.randomise)
        count = len(self.world.meshes)
        return meshes[:count], dict(zip(standing, meshes[count:], strict=True))

    @cached_property
    def moving_objects(self) -> dict[str, SceneObject]:
        """The things that keyframes move."""
        return {name: thing for name, thing in self.objects.items() if thing.moves}


def _actor(name: str, instance: int, config: HumanConfig, scene: Path, keyframes: Track | None) -> Actor:
    body = find_human(config.body, scene, f"humans.{name}.body")
    human = Human.load(body, config.outfit, config.skinning)
    return replace(Actor.build(name, instance, human, config.motion, scene), keyframes=keyframes)


def _add_objects(
    objects: dict[str, SceneObject],
    configs: Mapping[str, ObjectConfig],
    scene: Path,
    tracks: Mapping[tuple[str, str], Track],
    actors: Mapping[str, Actor],
) -> None:
    """Build objects and put them to those that are there. Labels go on from those of humans and objects."""
    last = len(actors) + sum(thing.instance > 0 for thing in objects.values())
    for name, config in configs.items():
        if config.label and name in actors:
            key = f"objects.{name}"
            raise SceneError(
                "there is a human of this name: an object with a label needs one of its own",
                path=scene,
                line=line_of_key(scene, key),
                key=key,
            )
        last += config.label
        number = last if config.label else 0
        objects[name] = SceneObject.build(name, config, scene, tracks.get(("objects", name)), number)


def _size(heads: Array, at_rest: Array, parents: NDArray[np.intp]) -> float:
    """How many times as large a body is as at rest, by how far its bones begin from each other."""
    child = np.flatnonzero(parents >= 0)
    now, rest = (np.linalg.norm(p[child] - p[parents[child]], axis=1).sum() for p in (heads, at_rest))
    size = float(now / rest) if rest > 0 else 1.0
    return 1.0 if abs(size - 1) < 1e-6 else size
