"""Places of keypoints on a human: joints, points between joints, points of the skin.

Points that are no joints of the skeleton are in ``config/body_landmarks.json``, which
``tools/assets/find_landmarks.py`` writes. Each has texture coordinates on the bodies that we make, and a
triangle of MakeHuman's base mesh. The points of MediaPipe's Face Mesh are in
``config/face_mesh_points.json``. docs/keypoints.md says how they were found.
"""

from __future__ import annotations

import functools
import weakref
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from humansim_ros.files.reading import read_table
from humansim_ros.geometry import angle_between, rotation_vector_to_matrix, unit_vectors
from humansim_ros.motion.body import JOINT_NAMES, Skeleton, dominant_bones, hanim_skeleton, without_details
from humansim_ros.people.humans.human import Human, joint_surfaces
from humansim_ros.people.keypoints.sets import KeypointSet
from humansim_ros.people.loading.loading import load_human
from humansim_ros.people.makehuman.data import SOURCE
from humansim_ros.people.rigging.landmarks import SKIN_VERTICES, is_makehuman
from humansim_ros.types import Array, Indices

#: Shares of joints in each point between joints (docs/keypoints.md says how they were chosen).
MIXES: Mapping[str, Mapping[str, float]] = read_table("keypoint_mixes")


@dataclass(frozen=True)
class SkinPoint:
    """A point of the skin. ``uv``: texture coordinates, v up, on bodies that
    :mod:`humansim_ros.people.makehuman` makes. ``vertices``: corners of its triangle in MakeHuman's base
    mesh, where eyes come after the skin. ``weights``: barycentric weights of the corners."""

    uv: tuple[float, float]
    vertices: tuple[int, int, int]
    weights: tuple[float, float, float]


@functools.cache
def skin_points() -> Mapping[str, SkinPoint]:
    """All points of the skin by name."""
    return {
        name: SkinPoint(tuple(row["uv"]), tuple(row["vertices"]), tuple(row["weights"]))
        for file in ("body_landmarks", "face_mesh_points")
        for name, row in read_table(file).items()
    }


#: Bones at the ends of limbs. Skeletons of other programs end at different points there.
_ENDS = ("vt3", "l_ankle", "r_ankle", "l_wrist", "r_wrist")
#: Built-in human with the points that are carried over to other bodies.
_TEMPLATE = "adult_man"


@dataclass(frozen=True, eq=False)
class SkinPlaces:
    """Places of N points: corners (N, 3) of their triangles, barycentric weights (N, 3), and whether they are
    certain (N,)."""

    corners: Indices
    weights: Array
    certain: NDArray[np.bool_]


def has_exact_skin(human: Human) -> bool:
    """Whether a human has the texture layout of the bodies that we make."""
    return human.notes.get("source") == SOURCE and human.mesh.uv is not None


def place_on_skin(human: Human, names: Sequence[str]) -> SkinPlaces:
    """Find points of :func:`~humansim_ros.people.keypoints.locator.skin_points` on a human.

    All bodies that we make have one texture layout, which gives the exact place. Bare MakeHuman bodies have
    the vertices of MakeHuman's base mesh. On other bodies the points are carried over from a built-in human,
    and are not certain.
    """
    if has_exact_skin(human):
        return _by_texture(human, names)
    if is_makehuman(human.mesh):
        return _by_vertices(human, names)
    return _carried_over(human, names)


def _by_texture(human: Human, names: Sequence[str]) -> SkinPlaces:
    """Find points by their texture coordinates."""
    uv, uv_triangles = human.mesh.uv, human.mesh.uv_triangles
    assert uv is not None and uv_triangles is not None
    a, b, c = (uv[uv_triangles[:, corner]] for corner in range(3))
    double_area = _cross(b - a, c - a)
    triangles, weights = np.zeros(len(names), np.intp), np.zeros((len(names), 3))
    points = skin_points()
    for number, name in enumerate(names):
        offset = np.array(points[name].uv) - a
        with np.errstate(divide="ignore", invalid="ignore"):  # triangles without area
            second = _cross(offset, c - a) / double_area
            third = _cross(b - a, offset) / double_area
            shares = np.stack([1 - second - third, second, third])
            inside = np.where(np.isfinite(shares).all(axis=0), shares.min(axis=0), -np.inf)
        triangles[number] = np.argmax(inside)
        weights[number] = shares[:, triangles[number]].clip(0)
    weights /= weights.sum(axis=1, keepdims=True)
    corners = human.mesh.triangles[triangles].astype(np.intp)
    return SkinPlaces(corners, weights, np.ones(len(names), bool))


def _cross(first: Array, second: Array) -> Array:
    """Cross products (N,) of vectors (N, 2)."""
    return np.asarray(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])


def _by_vertices(human: Human, names: Sequence[str]) -> SkinPlaces:
    """Find points of a bare MakeHuman body by vertices of its base mesh. Points of the eyes are carried over,
    since such a mesh may lack eyes."""
    rows = [skin_points()[name] for name in names]
    places = _carried_over(human, names)
    known = np.array([max(row.vertices) < SKIN_VERTICES for row in rows], dtype=bool)
    corners = np.array([row.vertices for row in rows], dtype=np.intp).reshape(-1, 3)
    weights = np.array([row.weights for row in rows]).reshape(-1, 3)
    corners = np.where(known[:, None], corners, places.corners)
    return SkinPlaces(corners, np.where(known[:, None], weights, places.weights), known)


def _carried_over(human: Human, names: Sequence[str]) -> SkinPlaces:
    """Carry points over from a built-in human: from their place relative to a bone to the nearest skin of the
    same body part."""
    template = load_human(_TEMPLATE)
    places = _by_texture(template, names)
    skin = np.einsum("nk,nkj->nj", places.weights, template.mesh.vertices[places.corners])
    # other bodies have no bones of fingers, toes, jaw and eyes
    weights = without_details(template.weights, template.skeleton)
    bones = dominant_bones(weights)[places.corners[:, 0]]
    scale = float(np.ptp(human.mesh.vertices[:, 1]) / np.ptp(template.mesh.vertices[:, 1]))
    corners, shares = np.zeros((len(names), 3), np.intp), np.zeros((len(names), 3))
    for bone in np.unique(bones).tolist():
        there = _BodyPart.of(template, template.skeleton.names[bone])
        here = _BodyPart.of(human, template.skeleton.names[bone])
        surface = _Triangles.of(human.mesh.vertices[here.triangles])
        for number in np.flatnonzero(bones == bone):
            nearest, shares[number] = surface.nearest(here.place(skin[number], there, scale))
            corners[number] = here.triangles[nearest]
    return SkinPlaces(corners, shares, np.zeros(len(names), bool))


@dataclass(frozen=True)
class _BodyPart:
    """Skin of a bone of the general skeleton, with the skin of further bones below it.

    ``head``: (3,). ``direction``: unit vector (3,) along the bone. ``length``: metres, length of the bone; at
    the end of a limb, distance to the end of the skin. ``triangles``: (N, 3) vertex indices; the whole skin
    if the bone has no skin.
    """

    head: Array
    direction: Array
    length: float
    triangles: Indices

    @classmethod
    def of(cls, human: Human, name: str) -> _BodyPart:
        skeleton, general = human.skeleton, set(hanim_skeleton().names)
        bone = skeleton.bone(name)
        part = {bone}
        for below, parent in enumerate(skeleton.parents.tolist()):
            if parent in part and skeleton.names[below] not in general:
                part.add(below)
        own = np.isin(human.triangle_parts, [each + 1 for each in part])
        triangles = human.mesh.triangles[own if own.any() else slice(None)].astype(np.intp)
        head, direction = skeleton.heads[bone], unit_vectors(skeleton.tails[bone] - skeleton.heads[bone])
        length = float(skeleton.lengths[bone])
        if name in _ENDS and own.any():
            length = float(((human.mesh.vertices[np.unique(triangles)] - head) @ direction).max())
        return cls(head, direction, length, triangles)

    def place(self, point: Array, other: _BodyPart, scale: float) -> Array:
        """Move a point (3,) near the bone of ``other`` to the same place relative to this bone. Distances
        along the bone are scaled with the length of the bone, distances across the bone with ``scale``."""
        offset = point - other.head
        along = float(offset @ other.direction)
        axis = unit_vectors(np.cross(other.direction, self.direction))
        turn = rotation_vector_to_matrix(axis * angle_between(other.direction, self.direction))
        across = scale * turn @ (offset - along * other.direction)
        return np.asarray(self.head + across + along * self.length / other.length * self.direction)


@dataclass(frozen=True)
class _Triangles:
    """Triangles (N, 3, 3) with their centres (N, 3), and the distances (N,) from the centres to the farthest
    corners."""

    corners: Array
    centres: Array
    radii: Array

    @classmethod
    def of(cls, corners: Array) -> _Triangles:
        centres = corners.mean(axis=1)
        return cls(corners, centres, np.linalg.norm(corners - centres[:, None], axis=2).max(axis=1))

    def nearest(self, target: Array) -> tuple[int, Array]:
        """The triangle nearest to a point (3,), and barycentric weights (3,) of its nearest point."""
        distance = np.linalg.norm(self.centres - target, axis=1)
        near = np.flatnonzero(distance - self.radii <= distance.min())
        triangles = self.corners[near]
        weights = _nearest_weights(target, triangles)
        points = np.einsum("oni,nij->onj", weights, triangles)
        gap = np.linalg.norm(points - target, axis=2)
        option, number = np.unravel_index(np.argmin(gap), gap.shape)
        return int(near[number]), np.asarray(weights[option, number])


def _nearest_weights(target: Array, triangles: Array) -> Array:
    """Barycentric weights (4, N, 3) of points of triangles near a target. First the nearest point inside each
    triangle (a corner if there is none), then the nearest point of each edge."""
    a, b, c = triangles.transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    square = np.maximum(np.einsum("ij,ij->i", normal, normal), 1e-30)
    second = np.einsum("ij,ij->i", np.cross(target - a, c - a), normal) / square
    third = np.einsum("ij,ij->i", np.cross(b - a, target - a), normal) / square
    inside = np.stack([1 - second - third, second, third], axis=1)
    options = [np.where((inside >= 0).all(axis=1, keepdims=True), inside, [1.0, 0.0, 0.0])]
    for first, last in ((0, 1), (1, 2), (2, 0)):
        start, along = triangles[:, first], triangles[:, last] - triangles[:, first]
        length = np.maximum(np.einsum("ij,ij->i", along, along), 1e-30)
        share = np.clip(np.einsum("ij,ij->i", target - start, along) / length, 0, 1)
        edge = np.zeros((len(triangles), 3))
        edge[:, first], edge[:, last] = 1 - share, share
        options.append(edge)
    return np.stack(options)


#: Names of joints that all humans have, or all humans with fingers.
_JOINTS = {joint.name for joint in JOINT_NAMES}


@dataclass(frozen=True, eq=False)
class KeypointLocator:
    """Computes the K keypoints of a set on one human, in any pose.

    ``on_surface``: (K,) whether the keypoint is a point of the skin. ``certain``: (K,) whether the place of
    the keypoint is known exactly. It is uncertain for points of the skin on meshes from other programs, which
    are found by fitting, and for points that a human lacks, such as fingers. ``surfaces``: (K, 256) whether
    each part label is skin around each keypoint. ``joint_shares``: (K, J) share of each joint in the position
    of a keypoint; 0 for points of the skin. ``corners``, ``corner_weights``: (N, 3) vertices and barycentric
    weights of the N keypoints on the skin.
    """

    keypoints: KeypointSet
    on_surface: NDArray[np.bool_]
    certain: NDArray[np.bool_]
    surfaces: NDArray[np.bool_]
    joint_shares: Array
    corners: Indices
    corner_weights: Array

    _known: ClassVar[dict[tuple[int, str], KeypointLocator]] = {}

    def __repr__(self) -> str:
        return f"KeypointLocator({self.keypoints.name!r}, {int(self.on_surface.sum())} on the skin)"

    @classmethod
    def of(cls, human: Human, keypoints: KeypointSet) -> KeypointLocator:
        """Return the locator of a keypoint set on a human from a cache, or make it.

        Example:
            >>> from humansim_ros.people import load_human
            >>> from humansim_ros.people import keypoint_set
            >>> KeypointLocator.of(load_human("child"), keypoint_set("coco17"))
            KeypointLocator('coco17', 5 on the skin)
        """
        key = id(human), keypoints.name
        locator = cls._known.get(key)
        if locator is None or locator.keypoints is not keypoints:
            locator = _locate(human, keypoints)
            cls._known[key] = locator
            weakref.finalize(human, cls._known.pop, key, None)
        return locator

    def positions(self, joints: Array, vertices: NDArray[np.floating]) -> Array:
        """Positions (K, 3) of the keypoints, in the space of the joints and vertices. NaN for points that the
        human lacks. ``joints``: (J, 3) in the order of the joint names of the skeleton. ``vertices``: (V, 3)
        of the mesh."""
        skin = np.einsum("nk,nkj->nj", self.corner_weights, vertices[self.corners])
        positions = np.asarray(self.joint_shares @ joints, dtype=float)
        positions[self.on_surface] = skin
        return positions


def _locate(human: Human, keypoints: KeypointSet) -> KeypointLocator:
    names = human.skeleton.joint_names
    around = joint_surfaces(human)
    shares = np.zeros((len(keypoints), len(names)))
    on_surface = np.zeros(len(keypoints), bool)
    for number, point in enumerate(keypoints.points):
        if point in names:
            shares[number, names.index(point)] = 1
        elif point in _JOINTS:  # a body without fingers: nobody knows where they are
            shares[number] = np.nan
        elif point in MIXES:
            for joint, share in MIXES[point].items():
                shares[number, names.index(joint)] = share
        else:
            on_surface[number] = True
    places = place_on_skin(human, [keypoints.points[k] for k in np.flatnonzero(on_surface)])
    between = (_joints_between(human.skeleton, row) for row in np.nan_to_num(shares))
    surfaces = np.array([around[joints].any(axis=0) for joints in between])
    bones = dominant_bones(human.weights)[places.corners]
    for number, own in zip(np.flatnonzero(on_surface).tolist(), bones, strict=True):
        surfaces[number, own + 1] = True
    certain = np.isfinite(shares).all(axis=1).astype(bool)
    certain[on_surface] = places.certain
    return KeypointLocator(keypoints, on_surface, certain, surfaces, shares, places.corners, places.weights)


def _joints_between(skeleton: Skeleton, shares: Array) -> list[int]:
    """Joints that have a share (J,), and the heads of the bones on the way between these joints."""
    joints = np.flatnonzero(shares).tolist()
    ways = []
    for bone in (skeleton.joint_bones[joint] for joint in joints):
        ways.append([bone])
        while (bone := int(skeleton.parents[bone])) >= 0:
            ways[-1].append(bone)
    common = set.intersection(*map(set, ways)) if ways else set()
    # parents come before children, so the largest common ancestor is the nearest one
    nearest = max(common, default=-1)
    return sorted({*joints, *(bone for way in ways for bone in way if bone not in common or bone == nearest)})
