"""The world around the people of a scene: its room and mesh files, what is behind them, and its light."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from humansim_ros.errors import MeshError, warn_about
from humansim_ros.mesh.load import read_materials_z_up
from humansim_ros.mesh.mesh import Mesh
from humansim_ros.render.backdrops import Panorama, ambient
from humansim_ros.render.lighting import Lighting, tone_mapped
from humansim_ros.render.renderer import Backdrop
from humansim_ros.scene.backdrops import load_backdrop, load_panorama, scene_file
from humansim_ros.scene.config import LightConfig, RoomConfig, SceneConfig, WorldMeshConfig
from humansim_ros.scene.randomise import random_light
from humansim_ros.scene.room import furnished_room

#: Metres beyond which a mesh is more likely in another unit than meant so.
_LARGE, _SMALL = 1000.0, 0.02


@dataclass(frozen=True)
class Environment:
    """What stands still whatever people do. ``placed``: its mesh files. ``backdrop``: what cameras see where
    nothing is.
    """

    placed: tuple[Mesh, ...] = ()
    room: RoomConfig | None = None
    lighting: Lighting = field(default_factory=Lighting)
    backdrop: Backdrop | None = None

    @classmethod
    def load(cls, config: SceneConfig, scene: Path) -> Environment:
        """The world of a scene file. Raises SceneError with its key, or MeshError with the mesh's file."""
        world, meshes = config.world, list[Mesh]()
        for number, mesh in enumerate(world.meshes):
            meshes += _placed(mesh, scene, f"world.meshes.{number}")
        random = config.randomise is not None and config.randomise.light
        light = random_light(config.light, config.randomise) if random and config.randomise else config.light
        lighting = replace(_lighting(light), shadow_catcher=world.shadow_catcher)
        backdrop: Backdrop | None = None
        if world.environment is not None:
            radiance = load_panorama(world.environment, scene, "world.environment")
            backdrop = Panorama(tone_mapped(radiance, lighting), math.radians(world.environment_yaw_deg))
            sky, ground = ambient(radiance)
            if "sky_color" not in light.model_fields_set:
                lighting = replace(lighting, sky_color=sky)
            if "ground_color" not in light.model_fields_set:
                lighting = replace(lighting, ground_color=ground)
        if isinstance(world.background, str):
            backdrop = load_backdrop(world.background, scene, "world.background")
        elif world.background is not None:
            lighting = replace(lighting, background=world.background)
        return cls(tuple(meshes), config.room, lighting, backdrop)

    @cached_property
    def meshes(self) -> tuple[Mesh, ...]:
        """The room, and what is placed."""
        room = [] if self.room is None else furnished_room(self.room.size, self.room.seed)
        return (*room, *self.placed)


def _lighting(light: LightConfig) -> Lighting:
    return Lighting(**light.model_dump())


def _placed(config: WorldMeshConfig, scene: Path, key: str) -> list[Mesh]:
    """A mesh file where it stands."""
    path = scene_file(config.file, scene, f"{key}.file")
    try:
        meshes = read_materials_z_up(path, config.up_axis)
    except MeshError as error:
        raise MeshError(
            error.message, path=error.path or path, line=error.line, key=error.key or f"{key}.file"
        ) from None
    turn = config.scale * Rotation.from_euler("xyz", config.rotation_deg, degrees=True).as_matrix()
    placed = [replace(m, vertices=m.vertices @ turn.T + np.array(config.position)) for m in meshes]
    points = np.concatenate([mesh.vertices for mesh in placed])
    side = float(np.ptp(points, axis=0).max())
    if side > _LARGE:
        warn_about(
            scene,
            f"{key}: {config.file} is {side:.0f} m large, and nothing is drawn beyond 200 m: if its unit is "
            "a millimetre, say scale: 0.001",
        )
    elif side < _SMALL:
        warn_about(scene, f"{key}: {config.file} is {1000 * side:.2g} mm large: say its scale")
    return placed
