"""Animated, skinned people as one GLB file (binary glTF 2.0), for Blender, Unity, three.js and others."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from humansim_ros.data.formats.animation import (
    BONES_OF_SET,
    AnimatedHuman,
    AnimationWriter,
    influences,
    local_transforms,
    rest_normals,
    texture_of,
    warn_of_curved_skinning,
)
from humansim_ros.data.formats.writer import ExportFolder, Record
from humansim_ros.errors import warn_about
from humansim_ros.files.mesh import GlbBuilder, split_seams
from humansim_ros.files.reading import decode_srgb, package_version
from humansim_ros.motion.files import PosedBones, write_bvh
from humansim_ros.people.humans import Human
from humansim_ros.types import Array


def posed_bones(name: str, person: AnimatedHuman, frame_time: float) -> PosedBones:
    """Posed bones for BVH files. Bones have the lengths of the first frame, since lengths in BVH are
    constant; warns (HumansimWarning) if keyframes change the size of the person. ``name``: name of the person
    in the warning. ``frame_time``: seconds between frames."""
    skeleton, size = person.human.skeleton, float(person.sizes[0])
    if person.grows:
        text = f"the size of {name} changes, which BVH cannot hold: bones keep their first length"
        warn_about(f"{name}.bvh", text)
    scaled = replace(skeleton, heads=skeleton.heads * size, tails=skeleton.tails * size)
    return PosedBones(scaled, person.bones, frame_time)


class BvhWriter(AnimationWriter):
    """Writes a BVH file for each person: the skeleton of the body with the motion in the scene."""

    def finish(self, records: Iterable[tuple[int, Record]], folder: ExportFolder) -> None:
        for name, person in self.animated(records).people.items():
            motion = posed_bones(name, person, 1.0 / self.settings.rate).to_motion()
            with folder.path(f"{name}.bvh") as path:
                write_bvh(path, motion)


#: Translations and sizes that vary by less than this, metres, count as constant.
_CONSTANT = 1e-9
_VERTICES, _TRIANGLES = 34962, 34963


def glb_bytes(people: Mapping[str, AnimatedHuman], rate: float) -> bytes:
    """Content of a GLB file with people, their skeletons, weights, textures and motions.

    The axes of glTF are: y up, metres, x_gltf = y_map, y_gltf = z_map, z_gltf = x_map. Vertices 0 to V - 1 of
    a mesh are those of the human in their order. Copies of vertices at seams of the texture follow. The
    attribute ``_VERTEX`` has for each vertex the number of its original. The node of a bone has the axes of
    the bone (y along the bone). There is one animation, which starts at time 0. Warns (HumansimWarning) of
    humans with dual quaternion skinning: glTF has only linear blending, so their vertices differ.

    ``people``: one or more people by name, with equal numbers of frames. ``rate``: frames per second.
    """
    warn_of_curved_skinning(people, "glTF")
    document = GlbDocument()
    frames = len(next(iter(people.values())).bones)
    times = document.accessor((np.arange(frames) / rate).astype(np.float32), bounds=True)
    for name, person in people.items():
        document.add_person(name, person, times)
    return document.encoded()


class GlbDocument(GlbBuilder):
    """A glTF document of people and meshes while it is built."""

    def __init__(self) -> None:
        super().__init__()
        self._roots: list[int] = []
        self._samplers: list[dict[str, Any]] = []
        self._channels: list[dict[str, Any]] = []
        #: mesh of each human, by identity: people may share a body
        self._mesh_of: dict[int, int] = {}

    def add_person(self, name: str, person: AnimatedHuman, times: int) -> None:
        """Add the nodes, the mesh and the motion of a person; ``times``: accessor of the times of frames."""
        human, skeleton = person.human, person.human.skeleton
        local = local_transforms(person)
        first = len(self.lists.get("nodes", ())) + 2
        children: list[list[int]] = [[] for _ in skeleton.names]
        roots: list[int] = []
        for bone, parent in enumerate(skeleton.parents.tolist()):
            (children[parent] if parent >= 0 else roots).append(first + bone)
        self._roots.append(self.add("nodes", {"name": name, "children": [first - 1, *roots]}))
        skin = len(self.lists.get("skins", ()))
        self.add("nodes", {"name": f"{name}_mesh", "mesh": self._mesh(human), "skin": skin})
        for bone, bone_name in enumerate(skeleton.names):
            below = {"children": children[bone]} if children[bone] else {}
            self.add("nodes", {"name": bone_name, **below})
            for path, values in zip(("translation", "rotation", "scale"), local, strict=True):
                self._animate(first + bone, path, values[:, bone].astype(np.float32), times)
        # column-major
        inverse_bind = np.swapaxes(skeleton.rest_inverse, -1, -2).astype(np.float32)
        binding = {
            "name": name,
            "joints": list(range(first, first + len(skeleton))),
            "skeleton": roots[0] if len(roots) == 1 else first - 2,
            "inverseBindMatrices": self.accessor(np.ascontiguousarray(inverse_bind)),
        }
        self.add("skins", binding)

    def add_mesh(
        self,
        vertices: Array,
        triangles: NDArray[np.integer],
        *,
        colors: NDArray[np.uint8] | None = None,
        uv: Array | None = None,
        texture: bytes | None = None,
    ) -> None:
        """Add a static mesh without normals, so that programs draw its triangles flat.

        Args:
            vertices: (V, 3), written without a change of axes.
            triangles: (F, 3).
            colors: (V, 3) sRGB.
            uv: (V, 2) in the texture, v up.
            texture: JPEG or PNG file.
        """
        columns: dict[str, NDArray[Any]] = {"POSITION": vertices.astype(np.float32)}
        if uv is not None:
            columns["TEXCOORD_0"] = _image_coordinates(uv)
        if colors is not None:
            columns["COLOR_0"] = _linear(colors)
        material = self._material("static", texture, 0.9, double_sided=False)
        mesh = self._add_mesh("static", columns, triangles.astype(np.uint32), material)
        self._roots.append(self.add("nodes", {"mesh": mesh}))

    def _animate(self, node: int, path: str, values: NDArray[np.float32], times: int) -> None:
        """Set a property of a node to its first value. If the value changes, animate the property."""
        if path != "scale" or (values[0] != 1).any():
            self.lists["nodes"][node][path] = values[0].tolist()
        if np.ptp(values, axis=0).max() <= _CONSTANT:
            return
        self._samplers.append({"input": times, "output": self.accessor(np.ascontiguousarray(values))})
        target = {"node": node, "path": path}
        self._channels.append({"sampler": len(self._samplers) - 1, "target": target})

    def _mesh(self, human: Human) -> int:
        """Return the number of the mesh of a human. The mesh is added on the first call."""
        if id(human) not in self._mesh_of:
            name = f"{human.name} {human.outfit}"
            material = self._material(name, texture_of(human), 1.0, double_sided=True)
            triangles = split_seams(human.mesh)[2]
            self._mesh_of[id(human)] = self._add_mesh(human.name, _columns(human), triangles, material)
        return self._mesh_of[id(human)]

    def _add_mesh(
        self, name: str, columns: Mapping[str, NDArray[Any]], triangles: NDArray[np.uint32], material: int
    ) -> int:
        """Add a mesh and return its number. ``columns``: values (V, ...) of the vertices by attribute."""
        attributes = {
            name: self.accessor(np.ascontiguousarray(values), _VERTICES, bounds=name == "POSITION")
            for name, values in columns.items()
        }
        primitive = {
            "attributes": attributes,
            "indices": self.accessor(triangles.ravel(), _TRIANGLES),
            "material": material,
        }
        return self.add("meshes", {"name": name, "primitives": [primitive]})

    def _material(self, name: str, texture: bytes | None, roughness: float, double_sided: bool) -> int:
        reflection: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": roughness}
        if texture is not None:
            reflection["baseColorTexture"] = {"index": self.image(texture)}
        material = {"name": name, "pbrMetallicRoughness": reflection, "doubleSided": double_sided}
        return self.add("materials", material)

    def encoded(self) -> bytes:
        """Bytes of the GLB file."""
        if self._channels:
            animation = {"name": "motion", "samplers": self._samplers, "channels": self._channels}
            self.lists["animations"] = [animation]
        asset = {"generator": f"humansim_ros {package_version()}"}
        return self.packed(asset=asset, scene=0, scenes=[{"nodes": self._roots}])


def _columns(human: Human) -> dict[str, NDArray[Any]]:
    """Values (V, ...) of the vertices of a human by attribute of glTF, such as ``NORMAL``."""
    mesh = human.mesh
    original, uv, _ = split_seams(mesh)
    columns: dict[str, NDArray[Any]] = {
        "POSITION": mesh.vertices.astype(np.float32)[original],
        "NORMAL": rest_normals(mesh).astype(np.float32)[original],
        "_VERTEX": original.astype(np.float32),
    }
    if uv is not None:
        columns["TEXCOORD_0"] = _image_coordinates(uv)
    if mesh.colors is not None:
        columns["COLOR_0"] = _linear(mesh.colors)[original]
    bones, weights = influences(human)
    for number, start in enumerate(range(0, bones.shape[1], BONES_OF_SET)):
        columns[f"JOINTS_{number}"] = bones[original, start : start + BONES_OF_SET]
        columns[f"WEIGHTS_{number}"] = weights[original, start : start + BONES_OF_SET]
    return columns


def _image_coordinates(uv: Array) -> NDArray[np.float32]:
    """Convert texture coordinates (V, 2) from v up to v down, as glTF has them."""
    return np.column_stack([uv[:, 0], 1 - uv[:, 1]]).astype(np.float32)


def _linear(colors: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Convert colours (V, 3) from sRGB to linear light, as glTF has them."""
    return np.asarray(decode_srgb(colors / 255.0), np.float32)


class GlbWriter(AnimationWriter):
    """Writes all people of a scene to ``people.glb``."""

    def finish(self, records: Iterable[tuple[int, Record]], folder: ExportFolder) -> None:
        folder.write("people.glb", glb_bytes(self.animated(records).people, self.settings.rate))
