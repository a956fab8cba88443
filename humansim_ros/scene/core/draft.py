"""A scene while it is made: what is known of it so far, and what features share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

from humansim_ros.errors import SceneError, in_section
from humansim_ros.motion.files import KeyframeTrack
from humansim_ros.motion.pose import WalkPath
from humansim_ros.people.loading import levels_of
from humansim_ros.scene.config.config import HumanConfig, ObjectConfig, SceneConfig
from humansim_ros.scene.core.actor import Actor
from humansim_ros.scene.core.camera import SceneCamera, build_cameras, random_cameras
from humansim_ros.scene.core.environment import Environment
from humansim_ros.scene.core.names import human_names
from humansim_ros.scene.core.objects import SceneObject, load_tracks
from humansim_ros.scene.core.source import SceneSource
from humansim_ros.scene.core.world import World
from humansim_ros.scene.features.robot.keys import ROBOT
from humansim_ros.scene.features.robot.robot import Robot, robot_object
from humansim_ros.scene.features.scanners.scanner import SceneScanner

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
        actors: Humans so far by name.
        objects: Objects so far by name.
        world: Knows the humans so far, for those who depend on others.
        scanners: Laser scanners by name.
    """

    config: SceneConfig
    source: SceneSource
    names: Sequence[str]
    tracks: Mapping[tuple[str, str], KeyframeTrack]
    actors: dict[str, Actor] = field(default_factory=dict)
    objects: dict[str, SceneObject] = field(default_factory=dict)
    world: World = field(default_factory=World)
    scanners: dict[str, SceneScanner] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.world.people = self.actors

    @classmethod
    def begin(cls, config: SceneConfig, source: SceneSource) -> Draft:
        """Draft with the humans and objects of a scene file, without those that features add. Raises
        HumansimError, which names the key."""
        source = source.loading()
        draft = cls(config, source, human_names(config), load_tracks(config, source))
        for name, human in config.humans.items():
            draft.add_human(name, human)
        draft.add_objects(config.objects)
        return draft

    def add_human(self, name: str, config: HumanConfig, path: WalkPath | None = None) -> None:
        """Build a human. Raises HumansimError with the key.

        Args:
            name: Name in the scene.
            config: Section of the human.
            path: Path that its walk follows, if any.
        """
        track = self.tracks.get(("humans", name))
        actor = Actor.load(name, len(self.actors) + 1, config, self.source, track, path)
        # at once, while what its shape is made of is kept in memory
        self.actors[name] = _with_levels(actor, self.source) if len(self.names) >= _MANY else actor

    def add_objects(self, configs: Mapping[str, ObjectConfig]) -> None:
        """Build objects, which stand where their sections say. Raises HumansimError, which names the key.
        Their labels continue the labels of all humans and of the objects so far."""
        for name, config in configs.items():
            with in_section(f"objects.{name}"):
                if config.label and name in self.names:
                    raise SceneError("a human has this name: a labelled object needs a name of its own")
                track = self.tracks.get(("objects", name))
                item = SceneObject.build(name, config, self.source, track, self.next_label(config.label))
                self.objects[name] = item

    def next_label(self, labelled: bool) -> int:
        """Label of the next object; 0 for an object without label."""
        used = len(self.names) + sum(item.instance > 0 for item in self.objects.values())
        return used + 1 if labelled else 0

    @cached_property
    def environment(self) -> Environment:
        """Static surroundings."""
        return Environment.load(self.config, self.source)

    @cached_property
    def robot(self) -> Robot | None:
        """The robot, which may carry cameras and scanners."""
        return Robot.of_scene(self.config, self.source)

    @cached_property
    def robot_body(self) -> SceneObject | None:
        """The robot as an object without label."""
        if self.robot is None:
            return None
        with in_section(ROBOT):
            return robot_object(self.robot, self.source)

    @cached_property
    def cameras(self) -> dict[str, SceneCamera]:
        """Cameras by name."""
        cameras = {
            name: replace(camera, backdrop=camera.backdrop or self.environment.backdrop)
            for name, camera in build_cameras(self.config, self.source, self.robot).items()
        }
        randomise = self.config.randomise
        return cameras if randomise is None else random_cameras(cameras, randomise)


def _with_levels(actor: Actor, source: SceneSource) -> Actor:
    """A human with levels of detail, unless keyframes change its size."""
    if actor.keyframes is not None:
        return actor
    human = actor.human
    levels = source.once(lambda: levels_of(human), "levels", id(human.mesh.vertices), human.skinning)
    return replace(actor, levels=levels)
