"""A scene ready to run: humans with their motions, cameras, the static world."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera import Camera
from humansim_ros.errors import SceneError
from humansim_ros.humans.loading import load_human
from humansim_ros.mesh.mesh import Mesh
from humansim_ros.motion.keyframe_tracks import KeyframeTrack
from humansim_ros.render import Body, GLRenderer, PyrenderRenderer, make_renderer
from humansim_ros.resources import resource_path
from humansim_ros.scene.actor import Actor
from humansim_ros.scene.camera import SceneCamera
from humansim_ros.scene.config import (
    HumanConfig,
    ObjectConfig,
    SceneConfig,
    find_human,
    line_of_key,
    load_config,
)
from humansim_ros.scene.environment import Environment
from humansim_ros.scene.objects import SceneObject, load_tracks
from humansim_ros.scene.randomise import Around, clutter, jittered, restyled
from humansim_ros.scene.rig import build_cameras
from humansim_ros.scene.variety import with_variety
from humansim_ros.truth import joint_surfaces

DEMO_SCENE = "config/scenes/demo.yaml"


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
    environment: Environment = field(default_factory=Environment)

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
        environment = Environment.load(config, path)
        cameras = {
            name: replace(camera, backdrop=camera.backdrop or environment.backdrop)
            for name, camera in build_cameras(config, path).items()
        }
        if config.randomise is not None:
            cameras = jittered(cameras, config.randomise)
        if config.randomise is not None and config.randomise.clutter:
            still = [
                *environment.meshes,
                *(thing.standing() for thing in objects.values() if not thing.moves),
            ]
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
        return cls(path, config, actors, cameras, objects, environment)

    def make_renderer(self, device: int | None = None) -> GLRenderer | PyrenderRenderer:
        """A renderer of the kind that the scene asks for, in its static world. ``device``: number of the GPU
        as EGL counts them; the first that works if None. Raises RenderError.
        """
        light = self.environment.lighting
        return make_renderer(self.config.renderer, self.static_meshes, light, device, self.static_bodies)

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
    def joint_surfaces(self) -> dict[str, NDArray[np.bool_]]:
        """Part labels (J, 256) that are skin around each joint, by human."""
        return {name: joint_surfaces(actor.human) for name, actor in self.actors.items()}

    @cached_property
    def static_meshes(self) -> list[Mesh]:
        """The world that stands still and has no labels."""
        meshes, standing = self._standing
        return [*meshes, *(mesh for name, mesh in standing.items() if not self.objects[name].instance)]

    @cached_property
    def static_bodies(self) -> list[Body]:
        """The objects with labels that stand still: always the same bodies."""
        things = ((self.objects[name], mesh) for name, mesh in self._standing[1].items())
        return [thing.standing_body(mesh) for thing, mesh in things if thing.instance]

    @cached_property
    def _standing(self) -> tuple[list[Mesh], dict[str, Mesh]]:
        """The world, and the objects that stand still by name, in ``map`` with the looks they have."""
        standing = {name: thing.standing() for name, thing in self.objects.items() if not thing.moves}
        meshes = [*self.environment.meshes, *standing.values()]
        if self.config.randomise is not None:
            meshes = restyled(meshes, self.config.randomise)
        count = len(self.environment.meshes)
        return meshes[:count], dict(zip(standing, meshes[count:], strict=True))

    @cached_property
    def moving_objects(self) -> dict[str, SceneObject]:
        """The things that keyframes move."""
        return {name: thing for name, thing in self.objects.items() if thing.moves}


def _actor(
    name: str, instance: int, config: HumanConfig, scene: Path, keyframes: KeyframeTrack | None
) -> Actor:
    body = find_human(config.body, scene, f"humans.{name}.body")
    human = load_human(body, config.outfit, config.skinning)
    return replace(Actor.build(name, instance, human, config.motion, scene), keyframes=keyframes)


def _add_objects(
    objects: dict[str, SceneObject],
    configs: Mapping[str, ObjectConfig],
    scene: Path,
    tracks: Mapping[tuple[str, str], KeyframeTrack],
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
