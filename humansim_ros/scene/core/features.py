"""Features of scenes, and the draft of a scene, which they change while the scene is made.

A feature is what can be taken away without touching the rest. Each has a folder in scene/features. Its
``__init__`` has its keys of a scene file, ``feature.py`` its :class:`Feature`. Features share what a
:class:`Draft` offers. They do not import each other.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib import import_module
from itertools import product
from typing import Any

import numpy as np
import scipy

from humansim_ros.errors import SceneError, in_section, some_of
from humansim_ros.files.mesh import Mesh
from humansim_ros.geometry import ObjectPose
from humansim_ros.motion.files import KeyframeTrack
from humansim_ros.motion.pose import Reach, Reaches, ReachingHand, WalkPath
from humansim_ros.people.loading import levels_of
from humansim_ros.scene.config.config import LIVE, HumanConfig, ObjectConfig, RandomiseConfig, SceneConfig
from humansim_ros.scene.core.actor import Actor
from humansim_ros.scene.core.camera import SceneCamera, build_cameras
from humansim_ros.scene.core.environment import Environment, Furnishing
from humansim_ros.scene.core.looks import random_numbers
from humansim_ros.scene.core.names import human_names
from humansim_ros.scene.core.objects import Robot, SceneObject
from humansim_ros.scene.core.source import SceneSource
from humansim_ros.scene.core.world import World
from humansim_ros.types import Color

#: Humans from which on those who are small in an image are drawn with fewer triangles.
_MANY = 8


@dataclass
class Draft:
    """A scene while it is made. Each human and each object is built once.

    Attributes:
        config: The configuration. Features add humans to it.
        source: Finds files, and keeps what has been read.
        names: Names of all humans, also of those who are not built yet.
        tracks: Keyframes by section ("humans", "objects") and name.
        furnishing: Furniture of the room.
        robot: The robot, which may carry cameras and scanners.
        robot_body: The robot as an object without label.
        actors: Humans so far by name.
        objects: Objects so far by name.
        world: Knows the humans so far, for those who depend on others.
        scanners: Laser scanners by name.
    """

    config: SceneConfig
    source: SceneSource
    names: Sequence[str]
    tracks: Mapping[tuple[str, str], KeyframeTrack] = field(default_factory=dict)
    furnishing: Furnishing = field(default_factory=Furnishing)
    robot: Robot | None = None
    robot_body: SceneObject | None = None
    actors: dict[str, Actor] = field(default_factory=dict)
    objects: dict[str, SceneObject] = field(default_factory=dict)
    world: World = field(default_factory=World)
    scanners: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.world.people = self.actors

    def add_human(self, name: str, config: HumanConfig, path: WalkPath | None = None) -> None:
        """Build a human. Raises HumansimError, which names the key. ``name``: name in the scene. ``config``:
        section of the human. ``path``: path that its walk follows, if any."""
        track = self.tracks.get(("humans", name))
        actor = Actor.load(name, len(self.actors) + 1, config, self.source, track, path)
        # at once, while what its shape is made of is kept in memory
        self.actors[name] = _with_levels(actor, self.source) if len(self.names) >= _MANY else actor

    def add_objects(self, configs: Mapping[str, ObjectConfig], key: str | None = None) -> None:
        """Build objects, which stand where their sections say. Raises HumansimError, which names the key.

        Their labels continue the labels of all humans and of the objects so far. ``key``: what makes them;
        ``objects`` if None.
        """
        for name, config in configs.items():
            with in_section(f"objects.{name}"):
                if config.label and name in self.names:
                    raise SceneError("a human has this name: a labelled object needs a name of its own")
                track = self.tracks.get(("objects", name))
                item = SceneObject.build(name, config, self.source, track, self.next_label(config.label))
                self.objects[name] = item if key is None else replace(item, key=key)

    def next_label(self, labelled: bool) -> int:
        """Label of the next object; 0 for an object without label."""
        used = len(self.names) + sum(item.instance > 0 for item in self.objects.values())
        return used + 1 if labelled else 0

    def add_object(
        self, name: str, mesh: Mesh, color: Color, mover: Callable[[float], ObjectPose], key: str
    ) -> None:
        """Add a labelled object that something moves.

        Args:
            name: Name in the scene.
            mesh: Mesh in metres about its own origin.
            color: Main colour, sRGB.
            mover: Returns the pose and the velocity at a scene time in seconds, such as
                :class:`~humansim_ros.scene.core.world.InHand`.
            key: Key of the scene file that makes the object. Errors get it from the section of the caller.

        Raises:
            SceneError: A human or an object has this name.
        """
        if name in self.names or name in self.objects:
            raise SceneError(f"{name} is the name of a human or an object: give that another name")
        at_origin = ObjectPose.on_floor(0.0, 0.0, 0.0)
        self.objects[name] = SceneObject(
            name, key, color, mesh, at_origin, None, self.next_label(True), mover, key=key
        )

    def reach(self, name: str, reaches: Sequence[Reach], poses: Sequence[ReachingHand] = ()) -> None:
        """Let a human reach for something, besides what it reaches for already.

        Args:
            name: The human.
            reaches: The reaches. Those of one hand do not overlap.
            poses: Poses of the hands while they reach.

        Raises:
            HumansimError: Another node moves the human, the hands hold or reach for something else, the
                motion has no arms, or the poses of the hands move nothing.
        """
        actor = self.actors[name]
        if self.config.humans[name].motion.file == LIVE:
            raise SceneError(f"another node moves {name}, and its hands")
        if held := [item.name for item in self.objects.values() if item.held_by == name]:
            raise SceneError(f"{name} holds {some_of(held)} in both hands: they reach for nothing else")
        before: Reaches | None = actor.settings("reach")
        if before is not None:
            for old, new in product(before.reaches, reaches):
                if old.side == new.side and old.start < new.last and new.start < old.last:
                    raise SceneError(f"the {new.side} hand of {name} is taken: see humans.{name}.{old.key}")
            reaches, poses = (*before.reaches, *reaches), (*before.poses, *poses)
        settings = Reaches(tuple(reaches), actor.motion.motion, actor.retargeter, tuple(poses))
        self.actors[name] = actor.with_layer("reach", settings=settings)
        self.world.version += 1

    @cached_property
    def environment(self) -> Environment:
        """Static surroundings."""
        return Environment.load(self.config, self.source, self.furnishing)

    @cached_property
    def cameras(self) -> dict[str, SceneCamera]:
        """Cameras by name."""
        cameras = {
            name: replace(camera, backdrop=camera.backdrop or self.environment.backdrop)
            for name, camera in build_cameras(self.config, self.source, self.robot).items()
        }
        randomise = self.config.randomise
        return cameras if randomise is None else _random_cameras(cameras, randomise)


def _with_levels(actor: Actor, source: SceneSource) -> Actor:
    """A human with levels of detail, if the package has them and keyframes do not change its size."""
    if actor.keyframes is not None:
        return actor
    human = actor.human
    levels = source.once(lambda: levels_of(human), "levels", id(human.mesh.vertices), human.skinning)
    return replace(actor, levels=levels)


def _random_cameras(cameras: Mapping[str, SceneCamera], randomise: RandomiseConfig) -> dict[str, SceneCamera]:
    """Cameras moved and rotated at random; cameras with a trajectory stay."""
    jitter = randomise.camera_jitter
    if not jitter.position and not jitter.rotation_deg:
        return dict(cameras)
    moved = {name: camera if camera.moves else _jitter(camera, randomise) for name, camera in cameras.items()}
    return {
        name: camera.placed_beside(moved[camera.left]) if camera.left and not camera.moves else camera
        for name, camera in moved.items()
    }


def _jitter(camera: SceneCamera, randomise: RandomiseConfig) -> SceneCamera:
    jitter, uniform = randomise.camera_jitter, random_numbers(randomise.seed, f"camera {camera.name}")
    shift = np.array([jitter.position * (2 * uniform() - 1) for _ in range(3)])
    turn = np.radians([jitter.rotation_deg * (2 * uniform() - 1) for _ in range(3)])
    r = scipy.spatial.transform.Rotation.from_rotvec(turn).as_matrix() @ camera.whole.R
    return replace(camera, whole=replace(camera.whole, R=r, t=-r @ (camera.whole.center + shift)))


#: Features in the order in which they are called, with the condition under which a scene has them. If a
#: feature needs humans or objects of another one, it comes later. Labels of objects follow this order.
FEATURES: Mapping[str, Callable[[SceneConfig], object]] = {
    "keyframes": lambda config: any(
        item.keyframes for section in (config.humans, config.objects) for item in section.values()
    ),
    "room": lambda config: config.room,
    "variety": lambda config: config.variety,
    "crowd": lambda config: config.crowd,
    "held": lambda config: any(item.held_by for item in config.objects.values()),
    "seats": lambda config: True,
    "robot": lambda config: config.robot,
    "scanners": lambda config: config.scanners,
    "clutter": lambda config: config.randomise and config.randomise.clutter,
    "reach": lambda config: True,
    "face": lambda config: any(human.face for human in config.humans.values()),
}


class Feature:
    """What a feature does while a scene is made. By default it does nothing.

    A scene calls :meth:`prepare` of all its features, then :meth:`expand` of all, then :meth:`furnish` of
    all.
    """

    def prepare(self, draft: Draft) -> None:
        """Add what humans and cameras are built with. The draft has no humans and objects yet."""

    def expand(self, draft: Draft) -> None:
        """Add humans. The humans and objects of the scene file are in the draft already."""

    def furnish(self, draft: Draft) -> None:
        """Add objects and devices, or change humans and objects. All humans are in the draft already."""


def features_of(config: SceneConfig) -> list[Feature]:
    """Features that a scene has, in the order of :data:`FEATURES`. Others are not imported."""
    names = [name for name, has in FEATURES.items() if has(config)]
    return [import_module(f"humansim_ros.scene.features.{name}.feature").FEATURE for name in names]


def begin_draft(config: SceneConfig, source: SceneSource) -> Draft:
    """Draft with the humans and objects of a scene file, without those that features add. Raises
    HumansimError, which names the key."""
    draft = Draft(config, source.loading(), human_names(config))
    for feature in features_of(config):
        feature.prepare(draft)
    for name, human in config.humans.items():
        draft.add_human(name, human)
    draft.add_objects(config.objects)
    return draft
