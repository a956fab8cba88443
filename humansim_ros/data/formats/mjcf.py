"""A scene for MuJoCo (``scene.xml`` and ``motion.npz``): people are mocap bodies with a skin."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping
from dataclasses import replace
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError

from humansim_ros.cameras.camera import Camera
from humansim_ros.data.formats.animation import (
    AnimatedHuman,
    AnimatedScene,
    AnimationWriter,
    PoseTrack,
    TextureFiles,
    identifiers,
    obj_text,
    painted,
    warn_of_curved_skinning,
)
from humansim_ros.data.formats.markup import joined
from humansim_ros.data.formats.writer import ExportFolder, Record, warn_of_lenses
from humansim_ros.errors import warn_about
from humansim_ros.files.mesh import Mesh, split_seams
from humansim_ros.files.reading import npz_bytes
from humansim_ros.geometry import matrix_to_quaternion
from humansim_ros.render.interface import Lighting
from humansim_ros.types import Array

_ASSETS = "assets"
#: Longest name of a bone in a skin file, characters.
_LONGEST = 39
#: Groups of geoms: 2 (for drawing) is visible by default, 3 (for contacts) is not.
_DRAWN, _TOUCHED = "2", "3"
#: Flat surfaces get a box for contacts, behind the surface. This is half the thickness of the box, metres.
_HALF_THICKNESS = 0.01
#: Surfaces thinner than this, metres, count as flat.
_FLAT = 1e-4
#: Most parts of a mesh that are used for contacts. The largest are used, since a scan may have thousands.
_MOST_PARTS = 500
#: Most corners of the convex hull of the skin of a bone.
_CORNERS = "48"


class MujocoWriter(AnimationWriter):
    """Writes the first frame as ``scene.xml`` with ``assets/``, and all poses as ``motion.npz``."""

    def finish(self, records: Iterable[tuple[int, Record]], folder: ExportFolder) -> None:
        scene = self.animated(records)
        model = MujocoModel(scene, folder.subfolder(_ASSETS))
        for name, mesh in self.surfaces.items():
            model.add_geoms(model.world, name, mesh)
        model.add_light(self.simulated.environment.lighting)
        folder.write("scene.xml", model.encoded())
        folder.write("motion.npz", npz_bytes(model.motion))


class MujocoModel:
    """A model of MuJoCo while it is built. Warns (HumansimWarning) of what MuJoCo does not support.

    Args:
        scene: The scene over time.
        assets: Folder for meshes, skins and textures.
    """

    def __init__(self, scene: AnimatedScene, assets: ExportFolder) -> None:
        self._assets, self._textures = assets, TextureFiles(assets)
        self._materials: dict[str, str] = {}
        self._tracks: dict[str, PoseTrack] = {}
        self._times = np.array(scene.frames) / scene.rate
        self._root = Element("mujoco", model="humansim")
        _add(self._root, "compiler", angle="radian", meshdir=_ASSETS, texturedir=_ASSETS)
        self._visual = visual = _add(self._root, "visual")
        sizes = np.array([camera.size for camera, _ in scene.cameras.values()] or [(640, 480)])
        _add(visual, "global", offwidth=str(sizes[:, 0].max()), offheight=str(sizes[:, 1].max()))
        _add(visual, "map", znear="0.001", zfar="50")  # of its extent
        self._asset = _add(self._root, "asset")
        self._deformable = _add(self._root, "deformable")
        self.world = _add(self._root, "worldbody")
        _add(self.world, "geom", name="ground", type="plane", size="0 0 0.05", group=_TOUCHED)
        warn_of_curved_skinning(scene.people, "MuJoCo")
        warn_of_lenses("MuJoCo", {name: camera for name, (camera, _) in scene.cameras.items()})
        bones = [f"{name}.{bone}" for name, p in scene.people.items() for bone in p.human.skeleton.names]
        cameras = [f"camera_{name}" for name in scene.cameras]
        self._names = identifiers([*cameras, *(f"{name}." for name in scene.objects), *bones], _LONGEST)
        for name, person in scene.people.items():
            self._add_person(name, person)
        for name, (mesh, track) in scene.objects.items():
            if track.grows:
                warn_about(f"MuJoCo object {name}", "its size changes: it keeps the first one")
            mesh = replace(mesh, vertices=mesh.vertices * track.sizes[0])
            own = self._names[f"{name}."]
            self.add_geoms(self._body(own, track), own, mesh)
        for name, (camera, track) in scene.cameras.items():
            self._add_camera(name, camera, track)

    @property
    def motion(self) -> Mapping[str, NDArray[np.generic]]:
        """Arrays of ``motion.npz``: times (F,), seconds; names, positions, rotations wxyz of M mocap
        bodies."""
        tracks = self._tracks.values()
        flat = np.array([np.hstack([each.positions, _wxyz(each.rotations)]) for each in tracks])
        poses = np.swapaxes(flat.reshape(len(tracks), len(self._times), 7), 0, 1)
        names = np.array(list(self._tracks), dtype=str)
        return {"time": self._times, "body": names, "mocap_pos": poses[..., :3], "mocap_quat": poses[..., 3:]}

    def encoded(self) -> str:
        """Text of the XML file of the model."""
        indent(self._root)
        return tostring(self._root, encoding="unicode") + "\n"

    def add_light(self, lighting: Lighting) -> None:
        """Add the sun. The light of the sky becomes the ambient part of MuJoCo's headlight."""
        factor = lighting.strength * 2.0**lighting.exposure
        mean = (np.array(lighting.sky_color) + np.array(lighting.ground_color)) / 2
        _add(self._visual, "headlight", ambient=joined(factor * mean), diffuse="0 0 0", specular="0 0 0")
        _add(
            self.world,
            "light",
            type="directional",
            dir=joined(-lighting.direction),
            pos=joined(10 * lighting.direction),
            diffuse=joined(factor * np.array(lighting.sun_color)),
            specular="0 0 0",
            castshadow="false",  # the ceiling of a room would keep the sun out
        )

    def add_geoms(self, body: Element, name: str, mesh: Mesh) -> None:
        """Add a mesh for drawing, and the convex hulls of its parts for contacts.

        Args:
            body: Element of the body that gets the mesh.
            name: Name of the files of the mesh.
            mesh: The mesh in the frame of the body.
        """
        mesh = painted(mesh)
        self._assets.write(f"{name}.obj", obj_text(mesh))
        _add(self._asset, "mesh", name=name, file=f"{name}.obj", inertia="shell")
        look = self._look(mesh)
        seen = {"contype": "0", "conaffinity": "0", "group": _DRAWN, "mass": "0"}
        _add(body, "geom", type="mesh", mesh=name, **look, **seen)
        parts = sorted(_parts(mesh), key=lambda points: -float(np.ptp(points, axis=0).max()))
        for number, points in enumerate(parts[:_MOST_PARTS]):
            center, axes, half = _fitted_box(points)
            corners = _hull(points) if half.min() > _FLAT else None
            if corners is not None:
                _add(self._asset, "mesh", name=f"{name}.{number}", vertex=joined(corners), maxhullvert="64")
                _add(body, "geom", type="mesh", mesh=f"{name}.{number}", group=_TOUCHED, mass="0")
                continue
            center = center - axes[:, 2] * _HALF_THICKNESS * _facing(mesh, points, axes[:, 2])
            half = np.maximum(half, _FLAT)
            half[2] = _HALF_THICKNESS
            place = {"pos": joined(center), "quat": joined(_wxyz(matrix_to_quaternion(axes)))}
            _add(body, "geom", type="box", size=joined(half), **place, group=_TOUCHED, mass="0")

    def _add_person(self, name: str, person: AnimatedHuman) -> None:
        """Add a mocap body for each bone, with the convex hull of its skin; and the skin of the person."""
        human, size = person.human, float(person.sizes[0])
        if person.grows:
            warn_about(f"MuJoCo person {name}", "its size changes: it keeps the first one")
        rotations = matrix_to_quaternion(person.bones[..., :3, :3])
        owner = np.asarray(human.weights.argmax(axis=1)).ravel()
        local = human.skeleton.rest_inverse[owner]
        points = size * (np.einsum("vij,vj->vi", local[:, :3, :3], human.mesh.vertices) + local[:, :3, 3])
        names = [self._names[f"{name}.{bone}"] for bone in human.skeleton.names]
        for bone, body_name in enumerate(names):
            track = PoseTrack(person.bones[:, bone, :3, 3], rotations[:, bone], np.ones((len(rotations), 3)))
            body = self._body(body_name, track, always=True)
            corners = _hull(points[owner == bone])
            if corners is not None:
                _add(self._asset, "mesh", name=body_name, vertex=joined(corners), maxhullvert=_CORNERS)
                _add(body, "geom", name=body_name, type="mesh", mesh=body_name, group=_TOUCHED)
        mesh = painted(human.mesh)
        self._assets.write(f"{name}.skn", skin_bytes(mesh, person, names))
        _add(self._deformable, "skin", name=name, file=f"{name}.skn", **self._look(mesh))

    def _add_camera(self, name: str, camera: Camera, track: PoseTrack) -> None:
        """Add a camera with the focal lengths and principal point of its calibration."""
        track = track.backward
        (width, height), k = camera.size, camera.K
        parent, place = self.world, _pose(track)
        if track.moves:
            parent, place = self._body(self._names[f"camera_{name}"], track), {}
        _add(
            parent,
            "camera",
            name=name,
            resolution=f"{width} {height}",
            sensorsize=joined(np.array([1.0, height / width])),
            focalpixel=joined(k[[0, 1], [0, 1]]),
            principalpixel=joined((np.array(camera.size) - 1) / 2 - k[:2, 2]),
            **place,
        )

    def _body(self, name: str, track: PoseTrack, always: bool = False) -> Element:
        """Add a body at the first pose of a track. If it moves, or if ``always``, it is a mocap body."""
        if always or track.moves:
            self._tracks[name] = track
            return _add(self.world, "body", name=name, mocap="true", **_pose(track))
        return _add(self.world, "body", name=name, **_pose(track))

    def _look(self, mesh: Mesh) -> dict[str, str]:
        """Attributes of a geom or skin: the material, with the texture of the mesh."""
        texture = self._textures.of(mesh)
        if texture is None:
            return {}
        if texture not in self._materials:
            name = self._materials[texture] = texture.split(".")[0]
            _add(self._asset, "texture", name=name, type="2d", file=texture)
            _add(self._asset, "material", name=name, texture=name, specular="0", shininess="0")
        return {"material": self._materials[texture]}


def _add(parent: Element, tag: str, **attributes: str) -> Element:
    return SubElement(parent, tag, attributes)


def skin_bytes(mesh: Mesh, person: AnimatedHuman, bodies: list[str]) -> bytes:
    """Content of a skin file (.skn) of MuJoCo: the rest pose in the axes of ``map``, and the weights.

    Args:
        mesh: Mesh of the person. Copies of its vertices at seams of the texture are added at the end.
        person: Skeleton, weights and size.
        bodies: Name of the body of each bone.
    """
    original, uv, triangles = split_seams(mesh)
    vertices, rest = person.rest
    weights = person.human.weights.tocsr()[original].tocsc()
    moving = np.flatnonzero(np.diff(weights.indptr)).tolist()  # bones that move a vertex
    parts = [struct.pack("<4i", len(original), 0 if uv is None else len(uv), len(triangles), len(moving))]
    parts.append(vertices[original].astype("<f4").tobytes())
    if uv is not None:
        parts.append(np.column_stack([uv[:, 0], 1 - uv[:, 1]]).astype("<f4").tobytes())  # v down
    parts.append(triangles.astype("<i4").tobytes())
    rotations = _wxyz(matrix_to_quaternion(rest[:, :3, :3]))
    for bone in moving:
        column = slice(weights.indptr[bone], weights.indptr[bone + 1])
        parts.append(bodies[bone].encode().ljust(40, b"\0"))
        parts.append(np.concatenate([rest[bone, :3, 3], rotations[bone]]).astype("<f4").tobytes())
        parts.append(struct.pack("<i", column.stop - column.start))
        parts.append(weights.indices[column].astype("<i4").tobytes())
        parts.append(weights.data[column].astype("<f4").tobytes())
    return b"".join(parts)


def _parts(mesh: Mesh) -> list[Array]:
    """Points (P, 3) of each connected part of a mesh. Vertices at the same place count as one."""
    points, number = np.unique(np.round(mesh.vertices, 6), axis=0, return_inverse=True)
    triangles = number.ravel()[mesh.triangles]
    rows, columns = triangles[:, [0, 1]].ravel(), triangles[:, [1, 2]].ravel()
    edges = coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(len(points), len(points)))
    count, part = connected_components(edges, directed=False)
    return [points[part == number] for number in range(count) if (part == number).sum() > 2]


def _fitted_box(points: Array) -> tuple[Array, Array, Array]:
    """Fit a box around points. Returns its centre (3,), axes (3, 3) as columns and half lengths (3,), the
    thinnest side last."""
    _, _, axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=True)
    if np.ptp(points, axis=0).min() <= _FLAT:  # a wall or floor: its sides are along the axes of its frame
        axes = np.eye(3)[np.argsort(-np.ptp(points, axis=0), kind="stable")]
    axes = axes.T.copy()
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    low, high = (points @ axes).min(axis=0), (points @ axes).max(axis=0)
    return axes @ ((low + high) / 2), axes, (high - low) / 2


def _facing(mesh: Mesh, points: Array, direction: Array) -> float:
    """1 if the triangles of a flat part of a mesh face a direction (3,), else -1."""
    corners = mesh.vertices[mesh.triangles]
    inside = (np.abs((corners - points[0]) @ direction) < _FLAT).all(axis=1)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return -1.0 if float((normals[inside] @ direction).sum()) < 0 else 1.0


def _hull(points: Array) -> Array | None:
    """Corner points of the convex hull of points (P, 3); None if the hull has no volume."""
    if len(points) < 4:
        return None
    try:
        return points[ConvexHull(points).vertices]
    except QhullError:
        return None


def _pose(track: PoseTrack) -> dict[str, str]:
    return {"pos": joined(track.positions[0]), "quat": joined(_wxyz(track.rotations[0]))}


def _wxyz(quaternions: Array) -> Array:
    return quaternions[..., [3, 0, 1, 2]]
