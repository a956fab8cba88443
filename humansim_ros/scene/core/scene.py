"""A scene that is ready to play: humans with motions, objects, cameras and the environment."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from humansim_ros.cameras.camera import Camera
from humansim_ros.errors import SceneError
from humansim_ros.files.mesh import Mesh
from humansim_ros.files.reading import hiding_quotes, resource_path
from humansim_ros.motion.body import Motion
from humansim_ros.people.humans import Human, joint_surfaces
from humansim_ros.people.loading import forget_people_data
from humansim_ros.pictures import Pictured
from humansim_ros.render.interface import Body
from humansim_ros.scene.config.config import SceneConfig, check_config, load_config
from humansim_ros.scene.config.timing import CameraTiming, frame_time
from humansim_ros.scene.core.actor import Actor
from humansim_ros.scene.core.camera import SceneCamera
from humansim_ros.scene.core.environment import Environment
from humansim_ros.scene.core.features import begin_draft, features_of
from humansim_ros.scene.core.looks import random_looks
from humansim_ros.scene.core.names import check_node_names
from humansim_ros.scene.core.objects import Robot, SceneObject
from humansim_ros.scene.core.source import SceneSource, name_objects
from humansim_ros.scene.core.world import World

if TYPE_CHECKING:
    from humansim_ros.render.frame import GLRenderer, PyrenderRenderer


#: Names that a short description of a scene lists.
_LISTED = 8
DEMO_SCENE = "config/scenes/demo.yaml"


def short_list(names: Iterable[str], kind: str) -> str:
    """Text of a list of names; their number if there are many."""
    listed = list(names)
    return str(listed) if len(listed) <= _LISTED else f"{len(listed)} {kind}"


@dataclass(frozen=True, repr=False)
class Scene(Pictured):
    """Humans with motions, objects, cameras and environment of a simulation.

    Make one with :meth:`load` (scene file), :meth:`from_dict` (the same keys as a mapping) or :meth:`build`
    (keywords, with objects in memory). Instance labels count from 1: humans in the order of the scene, then
    labelled objects, then labelled clutter.

    Attributes:
        source: Where the scene comes from.
        config: Its checked configuration.
        actors: Humans by name.
        scene_cameras: Cameras with sensor and trajectory by name; ``cameras`` has their geometry only.
        objects: Objects by name.
        environment: Static surroundings.
        random_humans: Names of the humans from ``variety`` and ``crowd``.
        scanners: Laser scanners (``SceneScanner`` of :mod:`humansim_ros.scene.features`) by name.
        robot: What moves the object ``robot``; None without a robot.

    Example:
        >>> scene = Scene.from_dict(
        ...     {
        ...         "room": None,
        ...         "humans": {"anna": {"body": "adult_woman", "motion": "walk"}},
        ...         "cameras": {"front": {"position": [4, 0, 1.5], "look_at": [0, 0, 1]}},
        ...     }
        ... )
        >>> scene
        Scene(humans=['anna'], objects=[], cameras=['front'], rate=30)
        >>> scene.actors["anna"].at(0.5).positions.shape
        (77, 3)
    """

    source: SceneSource
    config: SceneConfig
    actors: dict[str, Actor]
    scene_cameras: dict[str, SceneCamera]
    objects: dict[str, SceneObject] = field(default_factory=dict)
    environment: Environment = field(default_factory=Environment)
    random_humans: frozenset[str] = frozenset()
    scanners: dict[str, Any] = field(default_factory=dict)
    robot: Robot | None = None

    @classmethod
    def load(cls, path: str | os.PathLike[str] | None = None) -> Scene:
        """Load a scene file; the demo scene if None. Raises HumansimError with file, line and key."""
        path = resource_path(DEMO_SCENE) if path is None else Path(path)
        return cls.from_config(load_config(path), SceneSource.of_file(path))

    @classmethod
    def from_dict(cls, scene: Mapping[str, Any], folder: str | os.PathLike[str] = ".") -> Scene:
        """Make a scene from a mapping with the keys of a scene file (docs/scene.md).

        Values may also be objects in memory, see :meth:`build`.

        Args:
            scene: The mapping.
            folder: Folder that relative file names start from.

        Raises:
            HumansimError: The mapping is not a valid scene. The error names the key.
        """
        objects: dict[str, Human | Motion | Mesh] = {}
        data = name_objects(scene, "", objects)
        source = SceneSource(folder=Path(folder).resolve(), objects=objects)
        return cls.from_config(check_config(data), source)

    @classmethod
    def build(
        cls,
        *,
        cameras: Mapping[str, Camera | Mapping[str, Any]],
        humans: Mapping[str, Human | str | Mapping[str, Any]] | None = None,
        objects: Mapping[str, Mesh | str | Mapping[str, Any]] | None = None,
        folder: str | os.PathLike[str] = ".",
        **sections: Any,
    ) -> Scene:
        """Make a scene from keywords; objects in memory may stand where a scene file names a file.

        Args:
            cameras: By name: a Camera, or the keys of a camera in a scene file. Its ``calibration`` may be a
                Camera.
            humans: By name: a Human, a name or path, or the keys of a human in a scene file. Its ``body`` may
                be a Human, its ``motion`` (or the ``file`` of its motion) a Motion.
            objects: By name: a Mesh, a name or path, or the keys of an object. Its ``mesh`` may be a Mesh.
            folder: Folder that relative file names start from.
            **sections: Other sections and keys of a scene file: ``rate``, ``room``, ``light`` …

        Raises:
            HumansimError: The mapping is not a valid scene. The error names the key.

        Example:
            >>> from humansim_ros import read_motion
            >>> from humansim_ros.files.reading.assets import resource_path
            >>> wave = read_motion(resource_path("assets/motions/wave.bvh"))
            >>> camera = Camera.look_at((4, 0, 1.5), (0, 0, 1), size=(320, 240))
            >>> Scene.build(humans={"anna": {"motion": wave}}, cameras={"front": camera}, room=None, rate=25)
            Scene(humans=['anna'], objects=[], cameras=['front'], rate=25)
        """
        scene = {"humans": humans or {}, "cameras": cameras, "objects": objects or {}, **sections}
        return cls.from_dict(scene, folder)

    @classmethod
    def from_config(cls, config: SceneConfig, source: SceneSource | None = None) -> Scene:
        """Make a scene from a checked configuration. ``source`` finds its files and locates its errors."""
        source = source or SceneSource()
        with source.locating_errors(), hiding_quotes(lambda: (config, source.folder)):
            scene = cls._from_config(config, source.loading())
        forget_people_data()
        return replace(scene, source=source)

    @classmethod
    def _from_config(cls, config: SceneConfig, source: SceneSource) -> Scene:
        draft = begin_draft(config, source)
        # random people keep away from the humans and objects of the file
        for feature in features_of(config):
            feature.expand(draft)
        # whoever holds an object or sits on nothing is known now; clutter keeps away from everything
        for feature in features_of(draft.config):
            feature.furnish(draft)
        cameras, scanners = draft.cameras, draft.scanners
        check_node_names(draft.actors, cameras, scanners, bool(config.adapter_settings))
        distorted = [name for name, camera in cameras.items() if camera.camera.distorted]
        if config.renderer == "pyrender" and distorted:
            raise SceneError(
                f"pyrender does not render distorted lenses, as of {distorted[0]}: use moderngl",
                key="renderer",
            )
        actors = {name: replace(actor, others=draft.world) for name, actor in draft.actors.items()}
        random = frozenset(draft.config.humans.keys() - config.humans.keys())
        scene = cls(
            source,
            draft.config,
            actors,
            cameras,
            draft.objects,
            draft.environment,
            random,
            scanners,
            draft.robot,
        )
        scene._fill_world()
        return scene

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._fill_world()

    def _fill_world(self) -> None:
        """Let the humans know the others."""
        world = next((actor.others for actor in self.actors.values()), None)
        if isinstance(world, World):
            world.fill(self.actors, self.scene_cameras, lambda name, seconds: self.objects[name].at(seconds))

    def __repr__(self) -> str:
        parts: dict[str, Iterable[str]] = {
            "humans": self.actors,
            "objects": self.objects,
            "cameras": self.scene_cameras,
        }
        listed = ", ".join(f"{kind}={short_list(names, kind)}" for kind, names in parts.items())
        return f"Scene({listed}, rate={self.config.rate:g})"

    @property
    def path(self) -> Path | None:
        """The scene file; None for a scene that is made in memory."""
        return self.source.path

    def make_renderer(self, device: int | None = None) -> GLRenderer | PyrenderRenderer:
        """Create the renderer of the scene with its static meshes. ``device``: number of the GPU as EGL
        counts; the first that works if None. Raises RenderError."""
        from humansim_ros.render.frame import make_renderer

        light = self.environment.lighting
        return make_renderer(self.config.renderer, self.static_meshes, light, device, self.static_bodies)

    @cached_property
    def cameras(self) -> dict[str, Camera]:
        """Cameras by name, at their initial poses, with the lens that ``image_raw`` shows (not rectified)."""
        return {name: camera.camera for name, camera in self.scene_cameras.items()}

    @cached_property
    def moving_cameras(self) -> dict[str, SceneCamera]:
        """Cameras with a trajectory by name."""
        return {name: camera for name, camera in self.scene_cameras.items() if camera.moves}

    @property
    def period(self) -> float:
        """Seconds between frames."""
        return 1 / self.config.rate

    def frame_time(self, index: int) -> int:
        """Nanoseconds from the start to frame ``index``, round(index * period): errors do not accumulate."""
        return frame_time(index, self.config.rate)

    def at_full_rate(self) -> Scene:
        """The same scene with a picture of every camera in every frame, to be looked at."""
        if all(camera.timing.is_full for camera in self.scene_cameras.values()):
            return self
        timing = CameraTiming(self.config.rate)
        cameras = {name: replace(camera, timing=timing) for name, camera in self.scene_cameras.items()}
        return replace(self, scene_cameras=cameras)

    @cached_property
    def labels(self) -> dict[str, int]:
        """Instance labels by name: of all humans, then of the labelled objects."""
        return {name: actor.instance for name, actor in self.actors.items()} | self.object_labels

    @cached_property
    def object_labels(self) -> dict[str, int]:
        """Instance labels of the labelled objects by name."""
        return {name: item.instance for name, item in self.objects.items() if item.instance}

    @cached_property
    def joint_surfaces(self) -> dict[str, NDArray[np.bool_]]:
        """Part labels (J, 256) that are skin around each joint, by human."""
        return {name: joint_surfaces(actor.human) for name, actor in self.actors.items()}

    @cached_property
    def static_meshes(self) -> list[Mesh]:
        """Meshes of the environment and of static objects without label, in ``map``, with random looks."""
        meshes, static = self.static_parts
        return [*meshes, *(mesh for name, mesh in static.items() if not self.objects[name].instance)]

    @cached_property
    def static_bodies(self) -> list[Body]:
        """Bodies of static objects with label, always the same ones."""
        items = ((self.objects[name], mesh) for name, mesh in self.static_parts[1].items())
        return [item.static_body(mesh) for item, mesh in items if item.instance]

    @cached_property
    def static_parts(self) -> tuple[list[Mesh], dict[str, Mesh]]:
        """Meshes of the environment, and of static objects by name, in ``map``, with random looks."""
        static = {name: item.static_mesh() for name, item in self.objects.items() if not item.moves}
        meshes = [*self.environment.meshes, *static.values()]
        if self.config.randomise is not None:
            meshes = random_looks(meshes, self.config.randomise)
        count = len(self.environment.meshes)
        return meshes[:count], dict(zip(static, meshes[count:], strict=True))

    @cached_property
    def moving_objects(self) -> dict[str, SceneObject]:
        """Objects with keyframes by name."""
        return {name: item for name, item in self.objects.items() if item.moves}
