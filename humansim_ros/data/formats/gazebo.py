"""A world of Gazebo (``scene.sdf``, SDF 1.9): people are actors with a COLLADA skin and animation.

The files are the templates ``world.sdf`` and ``skin.dae`` of ``config/pages``.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from humansim_ros.cameras.camera import Camera
from humansim_ros.data.formats.animation import (
    AnimatedHuman,
    AnimationWriter,
    PoseTrack,
    TextureFiles,
    identifiers,
    local_transforms,
    obj_text,
    painted,
    rest_normals,
    warn_of_curved_skinning,
)
from humansim_ros.data.formats.markup import document, joined
from humansim_ros.data.formats.writer import ExportFolder, Record
from humansim_ros.errors import warn_about
from humansim_ros.files.mesh import Mesh
from humansim_ros.files.reading import package_version
from humansim_ros.geometry import matrix_to_quaternion, multiply_quaternions, quaternion_to_matrix, transform
from humansim_ros.types import Array

#: Axes of an SDF camera (x forward, y left, z up), as columns in the optical frame.
_SDF_IN_OPTICAL = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
#: A model or actor: name, pose (None for the frame of the world), and by part of a model the file of its
#: texture. Parts are None for an actor.
_Thing = tuple[str, Array | None, Mapping[str, str | None] | None]


class GazeboWriter(AnimationWriter):
    """Writes a world ``scene.sdf``, with its meshes and textures in ``meshes/``."""

    def finish(self, records: Iterable[tuple[int, Record]], folder: ExportFolder) -> None:
        scene = self.animated(records)
        meshes = MeshFiles(np.arange(len(scene.frames)) / scene.rate, folder.subfolder("meshes"))
        cameras = (f"camera_{name}" for name in scene.cameras)
        objects = (f"{name}." for name in scene.objects)
        names = identifiers(["room", *cameras, *scene.people, *objects])
        things = [meshes.model("room", self.surfaces)] if self.surfaces else []
        warn_of_curved_skinning(scene.people, "Gazebo")
        for name, person in scene.people.items():
            if person.grows:
                warn_about(f"Gazebo actor {name}", "its size changes: it keeps the first one")
            things.append(meshes.actor(names[name], Puppet.of_human(person)))
        for name, (mesh, track) in scene.objects.items():
            own = names[f"{name}."]
            if track.moves or track.grows:
                things.append(meshes.actor(own, Puppet.of_object(mesh, track)))
            else:
                parts = {own: replace(mesh, vertices=mesh.vertices * track.sizes[0])}
                things.append(meshes.model(own, parts, _pose(track)))
        lighting = self.simulated.environment.lighting
        factor = lighting.strength * 2.0**lighting.exposure
        mean = (np.array(lighting.sky_color) + np.array(lighting.ground_color)) / 2
        text = document(
            "world.sdf",
            sky=_color(factor * mean),
            background=_color(np.array(lighting.background) / 255),
            sun=_color(factor * np.array(lighting.sun_color)),
            direction=-lighting.direction,
            things=things,
            cameras=[self._camera(name, *parts) for name, parts in scene.cameras.items()],
            atan=math.atan,
        )
        folder.write("scene.sdf", text)

    def _camera(self, name: str, camera: Camera, track: PoseTrack) -> tuple[str, Array, Camera, float]:
        """Name, pose, calibration and rate of a camera. Warns (HumansimWarning) of what SDF does not have."""
        if track.moves:
            warn_about(f"Gazebo camera {name}", "SDF moves no camera: it stands at its first pose")
        if camera.distorted and camera.lens.model != "plumb_bob":
            text = f"SDF has no {camera.lens.model} lens: it is without distortion"
            warn_about(f"Gazebo camera {name}", text)
        return name, _pose(track, _SDF_IN_OPTICAL), camera, self.settings.scene.cameras[name].rate or 0.0


@dataclass(frozen=True)
class Puppet:
    """A skin that follows a tree of moving joints.

    Attributes:
        mesh: The skin at rest, in ``map``.
        joints: Names.
        parents: (B,) index of the parent of each joint, -1 for a root. Parents come first.
        rest: (B, 4, 4) joints at rest in ``map``.
        weights: (V, B) weights of the joints by vertex; rows sum to one.
        poses: (F, B, 4, 4) pose of each joint in its parent; a root in ``map``.
    """

    mesh: Mesh
    joints: Sequence[str]
    parents: NDArray[np.intp]
    rest: Array
    weights: csr_matrix
    poses: Array

    @classmethod
    def of_human(cls, person: AnimatedHuman) -> Puppet:
        """Create the puppet of a person with the size in the first frame, since bones of an actor have no
        scale."""
        human, (vertices, rest) = person.human, person.rest
        mesh = replace(human.mesh, vertices=vertices)
        shifts, turns, _ = local_transforms(replace(person, sizes=np.ones(len(person.sizes))), np.eye(3))
        names = list(identifiers(human.skeleton.names).values())
        poses = transform(quaternion_to_matrix(turns), shifts)
        return cls(mesh, names, human.skeleton.parents, rest, human.weights.tocsr(), poses)

    @classmethod
    def of_object(cls, mesh: Mesh, track: PoseTrack) -> Puppet:
        """Create the puppet of a rigid object, with a single joint."""
        turns = quaternion_to_matrix(track.rotations) * track.sizes[:, None]
        weights = csr_matrix(np.ones((len(mesh.vertices), 1)))
        poses = transform(turns, track.positions)[:, None]
        return cls(mesh, ["base"], np.array([-1]), np.eye(4)[None], weights, poses)


class MeshFiles:
    """Writes the meshes of models and the skins of actors.

    Args:
        times: (F,) times of the frames, seconds; the first is 0.
        folder: Folder for meshes and textures.
    """

    def __init__(self, times: Array, folder: ExportFolder) -> None:
        self._times, self._folder, self._textures = times, folder, TextureFiles(folder)

    def model(self, name: str, parts: Mapping[str, Mesh], pose: Array | None = None) -> _Thing:
        """Write the meshes of a model that does not move. ``parts``: meshes in the frame of the model, by the
        name of their files."""
        meshes = {part: painted(mesh) for part, mesh in parts.items()}
        for part, mesh in meshes.items():
            self._folder.write(f"{part}.obj", obj_text(mesh))
        return name, pose, {part: self._textures.of(mesh) for part, mesh in meshes.items()}

    def actor(self, name: str, puppet: Puppet) -> _Thing:
        """Write the skin of an actor, a model that moves. At time k / rate it has its pose of frame k."""
        mesh = painted(puppet.mesh)
        skinned = replace(puppet, mesh=mesh)
        self._folder.write(f"{name}.dae", collada_text(skinned, self._textures.of(mesh), self._times))
        return name, None, None


def collada_text(puppet: Puppet, texture: str | None, times: Array) -> str:
    """Text of a COLLADA 1.4.1 file (z up, metres) with skin, joints, and animated matrices of the joints.

    ``texture``: name of the texture file. ``times``: (F,) seconds.
    """
    mesh, weights = puppet.mesh, puppet.weights
    corners, uv = [mesh.triangles, mesh.triangles], None
    if mesh.uv is not None and mesh.uv_triangles is not None:
        corners, uv = [*corners, mesh.uv_triangles], mesh.uv
    nodes: list[tuple[str, Array, list[Any]]] = [
        (name, pose, []) for name, pose in zip(puppet.joints, puppet.poses[0], strict=True)
    ]
    roots: list[Any] = []
    for node, parent in zip(nodes, puppet.parents.tolist(), strict=True):
        (roots if parent < 0 else nodes[parent][2]).append(node)
    return document(
        "skin.dae",
        version=package_version(),
        texture=texture,
        vertices=mesh.vertices,
        normals=rest_normals(mesh),
        uv=uv,
        corners=np.stack(corners, axis=-1).reshape(len(mesh.triangles), -1),
        joints=puppet.joints,
        binds=np.linalg.inv(puppet.rest).reshape(-1, 16),
        weights=weights.data[:, None],
        counts=np.diff(weights.indptr),
        pairs=np.column_stack([weights.indices, np.arange(len(weights.data))]),
        times=times[:, None],
        motion=[(name, puppet.poses[:, n].reshape(-1, 16)) for n, name in enumerate(puppet.joints)],
        roots=roots,
    )


def _pose(track: PoseTrack, axes: Array | None = None) -> Array:
    """First pose (7,) of a track: position, quaternion xyzw. ``axes``: (3, 3) other axes in its frame."""
    turn = track.rotations[0]
    if axes is not None:
        turn = multiply_quaternions(turn, matrix_to_quaternion(axes))
    return np.concatenate([track.positions[0], turn])


def _color(values: Array) -> str:
    return f"{joined(np.clip(values, 0, 1))} 1"
