"""Static surroundings of a scene: room, mesh files, lighting and backdrop."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache

import numpy as np
import scipy

from humansim_ros.errors import in_section
from humansim_ros.mesh.load import read_materials_z_up
from humansim_ros.mesh.mesh import Mesh
from humansim_ros.render.backdrops import Panorama, ambient
from humansim_ros.render.lighting import Lighting, tone_mapped
from humansim_ros.render.renderer import Backdrop
from humansim_ros.scene.backdrops import load_backdrop, load_panorama
from humansim_ros.scene.config import LightConfig, RoomConfig, SceneConfig, WorldMeshConfig
from humansim_ros.scene.randomise import random_light
from humansim_ros.scene.room import furnished_room
from humansim_ros.scene.source import SceneSource

#: Sizes in metres beyond which the unit of a mesh file is probably wrong.
_LARGE, _SMALL = 1000.0, 0.02


@dataclass(frozen=True)
class Environment:
    """Static surroundings of a scene.

    Attributes:
        mesh_files: Meshes of its mesh files, in ``map``, metres.
        room: Size and seed of the furnished room; None for no room.
        lighting: Light, shadows and tone mapping.
        backdrop: Image behind everything; a plain colour if None.
    """

    mesh_files: tuple[Mesh, ...] = ()
    room: RoomConfig | None = None
    lighting: Lighting = field(default_factory=Lighting)
    backdrop: Backdrop | None = None

    @classmethod
    def load(cls, config: SceneConfig, source: SceneSource) -> Environment:
        """Load the environment of a scene. Raises HumansimError with the key."""
        world, meshes = config.world, mesh_files(config, source)
        random = config.randomise is not None and config.randomise.light
        light = random_light(config.light, config.randomise) if random and config.randomise else config.light
        lighting = replace(_lighting(light), shadow_catcher=world.shadow_catcher)
        backdrop: Backdrop | None = None
        if world.environment is not None:
            with in_section("world.environment"):
                radiance = load_panorama(source.find(world.environment))
            backdrop = Panorama(tone_mapped(radiance, lighting), math.radians(world.environment_yaw_deg))
            sky, ground = ambient(radiance)
            if "sky_color" not in light.model_fields_set:
                lighting = replace(lighting, sky_color=sky)
            if "ground_color" not in light.model_fields_set:
                lighting = replace(lighting, ground_color=ground)
        if isinstance(world.background, str):
            with in_section("world.background"):
                backdrop = load_backdrop(source.find(world.background))
        elif world.background is not None:
            lighting = replace(lighting, background=world.background)
        return cls(meshes, config.room, lighting, backdrop)

    @cached_property
    def meshes(self) -> tuple[Mesh, ...]:
        """Meshes of the room and of the mesh files."""
        room = () if self.room is None else _furnished(self.room.size, self.room.seed)
        return (*room, *self.mesh_files)


def mesh_files(config: SceneConfig, source: SceneSource) -> tuple[Mesh, ...]:
    """Meshes of ``world.meshes`` in ``map``. Raises HumansimError with the key."""
    files = enumerate(config.world.meshes)
    return tuple(mesh for n, item in files for mesh in _load_meshes(item, source, f"world.meshes.{n}"))


@lru_cache(maxsize=2)
def _furnished(size: tuple[float, float, float], seed: int) -> tuple[Mesh, ...]:
    """Meshes of a room; kept, because an editor makes a scene again after each edit."""
    return tuple(furnished_room(size, seed))


def _lighting(light: LightConfig) -> Lighting:
    return Lighting(**light.model_dump())


def _load_meshes(config: WorldMeshConfig, source: SceneSource, key: str) -> list[Mesh]:
    """Meshes of a mesh file in ``map``."""
    with in_section(f"{key}.file"):
        mesh = source.mesh(config.file)
        meshes = read_materials_z_up(source.find(config.file), config.up_axis) if mesh is None else [mesh]
    turn = scipy.spatial.transform.Rotation.from_euler("xyz", config.rotation_deg, degrees=True)
    rotation = config.scale * turn.as_matrix()
    meshes = [replace(m, vertices=m.vertices @ rotation.T + np.array(config.position)) for m in meshes]
    points = np.concatenate([mesh.vertices for mesh in meshes])
    side = float(np.ptp(points, axis=0).max())
    if side > _LARGE:
        source.warn(
            key,
            f"{config.file} is {side:.0f} m large, and nothing is rendered beyond 200 m: if its unit is "
            "a millimetre, give scale: 0.001",
        )
    elif side < _SMALL:
        source.warn(key, f"{config.file} is {1000 * side:.2g} mm large: give its scale")
    return meshes
