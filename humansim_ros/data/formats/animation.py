"""A scene over time in the form that animation programs and simulators need: skin, skeleton, all poses."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from humansim_ros.cameras.camera import Camera
from humansim_ros.data.formats.writer import ExportFolder, ExportFrame, FormatWriter, Record
from humansim_ros.errors import warn_about
from humansim_ros.files.mesh import Mesh, SurfaceNormals
from humansim_ros.files.reading import encode_image
from humansim_ros.geometry import (
    WORLD_FROM_BODY,
    matrix_to_quaternion,
    multiply_quaternions,
    normalised,
    quaternion_to_matrix,
    transform,
)
from humansim_ros.people.humans import Human
from humansim_ros.scene.core import CameraPose, Scene
from humansim_ros.types import Array

#: Sizes that differ by less than this count as equal, since they are rounded.
SAME_SIZE = 1e-6
#: Half a turn about x, xyzw.
_HALF_TURN = np.array([1.0, 0.0, 0.0, 0.0])
#: Prefix of the names of surfaces of the room, which no other name has.
_SURFACE = "surface_"


@dataclass(frozen=True)
class AnimatedHuman:
    """A human with its pose in F frames.

    Attributes:
        human: Mesh, skeleton, weights and outfit.
        bones: Posed bone frames (F, B, 4, 4) in ``map``, as in ``HumanState.joints[:B]``.
        sizes: Scale (F,) of the body in each frame, which keyframes may change, as ``HumanState.size``.
    """

    human: Human
    bones: Array
    sizes: Array

    @property
    def grows(self) -> bool:
        """Whether the size of the person changes between frames."""
        return bool(np.ptp(self.sizes) > SAME_SIZE)

    @property
    def rest(self) -> tuple[Array, Array]:
        """Vertices (V, 3) and bones (B, 4, 4) in the rest pose, in the axes of ``map``, scaled by the size in
        the first frame."""
        size, bones = float(self.sizes[0]), np.array(self.human.skeleton.rest)
        bones[:, :3] = WORLD_FROM_BODY @ bones[:, :3]
        bones[:, :3, 3] *= size
        return size * self.human.mesh.vertices @ WORLD_FROM_BODY.T, bones


@dataclass(frozen=True)
class PoseTrack:
    """Poses of an object in F frames: a point x of the object is at ``position + rotation (size * x)``.

    Attributes:
        positions: (F, 3) in ``map``, metres.
        rotations: (F, 4) quaternions xyzw without sign changes, so that their numbers can be interpolated.
        sizes: (F, 3) scale factors along the axes of the object.
    """

    positions: Array
    rotations: Array
    sizes: Array

    @property
    def moves(self) -> bool:
        """Whether a position or rotation differs from that in the first frame."""
        return bool(np.ptp(self.positions, axis=0).any() or np.ptp(self.rotations, axis=0).any())

    @property
    def grows(self) -> bool:
        """Whether the size of the object changes."""
        return bool(np.ptp(self.sizes, axis=0).max() > SAME_SIZE)

    @property
    def backward(self) -> PoseTrack:
        """Convert poses of optical frames (z ahead, y down) to those of cameras that look along -z with y
        up."""
        return replace(self, rotations=multiply_quaternions(self.rotations, _HALF_TURN))


@dataclass(frozen=True)
class AnimatedScene:
    """A scene in F frames.

    Attributes:
        frames: Numbers of the frames in the scene.
        rate: Frames per second.
        people: People by name.
        objects: Meshes and poses of all objects by name.
        cameras: By name: camera with the lens of ``image_raw``, and poses of its optical frame.
    """

    frames: range
    rate: float
    people: Mapping[str, AnimatedHuman]
    objects: Mapping[str, tuple[Mesh, PoseTrack]]
    cameras: Mapping[str, tuple[Camera, PoseTrack]]


class AnimationWriter(FormatWriter):
    """Base class of writers that need the poses of all frames. The source must be a scene, not a bag."""

    @property
    def simulated(self) -> Scene:
        """The scene that is exported."""
        assert self.settings.scene.simulated is not None  # formats that need bodies refuse bags
        return self.settings.scene.simulated

    @property
    def surfaces(self) -> dict[str, Mesh]:
        """Meshes of the room and of mesh files in ``map``, by names with the prefix ``surface_``."""
        meshes = enumerate(self.simulated.static_parts[0])
        return {f"{_SURFACE}{number:03d}": mesh for number, mesh in meshes}

    def frame(self, frame: ExportFrame, folder: ExportFolder) -> Record:
        """Return heads and rotations of bones, sizes of people, and poses of objects and cameras."""
        people, shown = {}, frame.frame
        for name, state in shown.humans.items():
            bones = len(self.settings.scene.humans[name].skeleton)
            people[name] = [state.positions[:bones], state.rotations[:bones], state.size]
        objects = {name: [pose.position, pose.rotation, pose.size] for name, pose in shown.objects.items()}
        cameras = {}
        for name, camera in self.simulated.scene_cameras.items():
            pose = shown.camera_poses.get(name) or CameraPose.of(camera.camera)
            pose = camera.true_pose(pose, shown.scene_time * 1e-9)
            cameras[name] = [pose.position, pose.rotation, np.ones(3)]
        return {"people": people, "objects": objects, "cameras": cameras}

    def animated(self, records: Iterable[tuple[int, Record]]) -> AnimatedScene:
        """Build the scene over all frames from ``records``, the results of :meth:`frame`."""
        tracks = _tracks(records)
        people = {}
        for name, (heads, rotations, sizes) in tracks.get("people", {}).items():
            bones = transform(quaternion_to_matrix(rotations), heads)
            people[name] = AnimatedHuman(self.settings.scene.humans[name], bones, sizes)
        objects, moving = {}, tracks.get("objects", {})
        for name, item in self.simulated.objects.items():
            pose = item.initial_pose
            still = PoseTrack(*(value[None] for value in (pose.position, pose.rotation, pose.size)))
            look = item.mesh if item.moves else self.simulated.static_parts[1][name]
            objects[name] = (
                replace(look, vertices=item.mesh.vertices),
                _track(*moving[name]) if name in moving else still,
            )
        cameras = {
            name: (self.settings.scene.cameras[name].camera, _track(*parts))
            for name, parts in tracks.get("cameras", {}).items()
        }
        return AnimatedScene(self.settings.frames, self.settings.rate, people, objects, cameras)


def _tracks(records: Iterable[tuple[int, Record]]) -> dict[str, dict[str, list[Array]]]:
    """Stack the arrays of all frames. Returns arrays (F, ...) by kind (people, objects, cameras) and name."""
    frames: dict[str, dict[str, list[list[Array]]]] = {}
    for _, record in records:
        for kind, things in record.items():
            for name, parts in things.items():
                values = [np.asarray(part, dtype=float) for part in parts]
                frames.setdefault(kind, {}).setdefault(name, []).append(values)
    return {
        kind: {
            name: [np.array(values) for values in zip(*parts, strict=True)] for name, parts in things.items()
        }
        for kind, things in frames.items()
    }


def _track(positions: Array, rotations: Array, sizes: Array) -> PoseTrack:
    return PoseTrack(positions, without_sign_changes(normalised(rotations)), sizes)


def without_sign_changes(quaternions: Array) -> Array:
    """Change signs of quaternions (F, ..., 4) so that each is nearest to that of the previous frame."""
    flips = np.sum(quaternions[1:] * quaternions[:-1], axis=-1, keepdims=True) < 0
    out = np.array(quaternions)
    out[1:] *= np.where(np.cumsum(flips, axis=0) % 2 == 1, -1.0, 1.0)
    return out


def local_transforms(person: AnimatedHuman, axes: Array = WORLD_FROM_BODY) -> tuple[Array, Array, Array]:
    """Translations (F, B, 3), rotations (F, B, 4) xyzw and scales (F, B, 3) of the bones in their parents.

    The quaternions of a bone have no sign changes, so that programs can interpolate their numbers.

    Args:
        person: The person.
        axes: (3, 3) axes of the file in ``map``. Root bones use them. By default those of glTF, y up.
    """
    parents = person.human.skeleton.parents
    rotations = axes.T @ person.bones[..., :3, :3]
    heads = person.bones[..., :3, 3] @ axes
    is_root = parents < 0
    above = np.where(is_root[:, None, None], np.eye(3), rotations[:, parents])
    inverse = np.swapaxes(above, -1, -2)
    step = heads - np.where(is_root[:, None], 0.0, heads[:, parents])
    sizes = person.sizes[:, None]
    translations = np.einsum("fbij,fbj->fbi", inverse, step) / np.where(is_root, 1.0, sizes)[..., None]
    quaternions = without_sign_changes(matrix_to_quaternion(inverse @ rotations))
    scales = np.where(is_root, sizes, 1.0)[..., None] * np.ones(3)
    return translations, quaternions, scales


#: Bones per vertex in a set of bones and weights of glTF.
BONES_OF_SET = 4


def influences(human: Human) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Bones (V, N) and weights (V, N) of each vertex, the largest weight first; unused entries are zero. N is
    a multiple of 4."""
    weights = human.weights.tocsr()
    counts = np.diff(weights.indptr)
    rows = np.repeat(np.arange(len(counts)), counts)
    order = np.lexsort((weights.indices, -weights.data, rows))
    column = np.arange(len(order)) - np.repeat(weights.indptr[:-1], counts)
    width = -(-int(counts.max()) // BONES_OF_SET) * BONES_OF_SET
    bones = np.zeros((len(counts), width), dtype=np.uint8)
    values = np.zeros((len(counts), width), dtype=np.float32)
    bones[rows, column], values[rows, column] = weights.indices[order], weights.data[order]
    return bones, values


def rest_normals(mesh: Mesh) -> Array:
    """Normals (V, 3) in the rest pose, all of unit length, also at vertices without triangles."""
    normals = SurfaceNormals(mesh.triangles, len(mesh.vertices))(mesh.vertices)
    return np.asarray(np.where(normals.any(axis=-1, keepdims=True), normals, (0.0, 1.0, 0.0)), dtype=float)


def texture_of(human: Human) -> bytes | None:
    """Content of a PNG or JPEG file with the texture of a human; None if the human has no texture."""
    if human.mesh.texture is None:
        return None
    look = human.looks.get(human.outfit)
    return (encode_image(human.mesh.texture) if look is None or look.ndim != 1 else look).tobytes()


def warn_of_curved_skinning(people: Mapping[str, AnimatedHuman], program: str) -> None:
    """Warn (HumansimWarning) of dual quaternion skinning, which ``program`` does not support."""
    if curved := [name for name, person in people.items() if person.human.skinning != "linear"]:
        warn_about(
            program,
            f"no dual quaternion skinning there: vertices near bent joints of {', '.join(curved)} differ",
        )


def identifiers(names: Iterable[str], longest: int = 64) -> dict[str, str]:
    """Convert names to different names that every program accepts: ASCII letters, digits and underscores,
    beginning with a letter.

    ``longest``: greatest length of a name.

    Example:
        >>> identifiers(["anna", "mixamorig:Hips", "mixamorig Hips", "7"])
        {'anna': 'anna', 'mixamorig:Hips': 'mixamorig_Hips', 'mixamorig Hips': 'mixamorig_Hips_2', '7': 'n7'}
    """
    found: dict[str, str] = {}
    used: set[str] = set()
    for name in names:
        plain = re.sub("[^A-Za-z0-9_]+", "_", name).strip("_") or "n"
        plain = (plain if plain[0].isalpha() else f"n{plain}")[:longest].rstrip("_")
        plain = plain.replace(_SURFACE, "surface")  # with names that are taken
        unique, number = plain, 1
        while unique.lower() in used:
            number += 1
            unique = f"{plain[: longest - len(str(number)) - 1]}_{number}"
        used.add(unique.lower())
        found[name] = unique
    return found


#: Most colours in a texture made from vertex colours, and side of the square of a colour, pixels.
_PALETTE, _SQUARE = 256, 4


class TextureFiles:
    """Writes textures to a folder of an export. Equal images are written only once."""

    def __init__(self, folder: ExportFolder) -> None:
        self._folder = folder
        self._names: dict[str, str] = {}
        #: file of each image in memory; the image is kept, so that its id stays its own
        self._seen: dict[int, tuple[NDArray[np.uint8], str]] = {}

    def of(self, mesh: Mesh) -> str | None:
        """Write the texture of a mesh as PNG. Returns the name of the file; None without texture."""
        if mesh.texture is None:
            return None
        if id(mesh.texture) not in self._seen:
            self._seen[id(mesh.texture)] = mesh.texture, self.write(encode_image(mesh.texture).tobytes())
        return self._seen[id(mesh.texture)][1]

    def write(self, content: bytes) -> str:
        """Write the content of a PNG or JPEG file. Returns the name of the file."""
        key = hashlib.sha256(content).hexdigest()
        if key not in self._names:
            suffix = "jpg" if content[:2] == b"\xff\xd8" else "png"
            self._names[key] = f"texture_{len(self._names):03d}.{suffix}"
            self._folder.write(self._names[key], content)
        return self._names[key]


def painted(mesh: Mesh) -> Mesh:
    """Convert the vertex colours of a mesh to a texture, for programs that do not draw vertex colours. A mesh
    with a texture is unchanged. Each colour is a square in the texture. Triangles with corners of different
    colours are drawn wrong. A mesh of more than 256 colours gets their mean."""
    if mesh.colors is None or mesh.texture is not None:
        return mesh
    colors, number = np.unique(mesh.colors, axis=0, return_inverse=True)
    if len(colors) > _PALETTE:
        mean = np.rint(mesh.colors.mean(axis=0)).astype(np.uint8)
        colors, number = mean[None], np.zeros(len(mesh.vertices), np.intp)
    image = np.tile(np.repeat(colors, _SQUARE, axis=0), (_SQUARE, 1, 1))
    middles = np.column_stack([(np.arange(len(colors)) + 0.5) / len(colors), np.full(len(colors), 0.5)])
    corners = np.where(mesh.faces < 0, 0, number.ravel()[mesh.faces]).astype(np.int32)
    return replace(mesh, colors=None, texture=image, uv=middles, uv_faces=corners)


def obj_text(mesh: Mesh) -> str:
    """Text of an OBJ file of a mesh in its own axes, with texture coordinates but no material."""
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in mesh.vertices.tolist()]
    corners = (mesh.triangles + 1).tolist()
    if mesh.uv is None or mesh.uv_triangles is None:
        lines += [f"f {a} {b} {c}" for a, b, c in corners]
    else:
        lines += [f"vt {u:.9g} {v:.9g}" for u, v in mesh.uv.tolist()]
        pairs = zip(corners, (mesh.uv_triangles + 1).tolist(), strict=True)
        lines += ["f " + " ".join(f"{v}/{t}" for v, t in zip(*pair, strict=True)) for pair in pairs]
    return "\n".join([*lines, ""])
