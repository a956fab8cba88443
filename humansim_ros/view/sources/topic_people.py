"""People who are known by their topics only: bodies, the skin of unknown bodies, and estimates."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csgraph, csr_matrix

from humansim_ros.data.evaluation import (
    LiveOptions,
    PoseSequence,
    axes_matrix,
    below_hips,
    check_world,
    is_of_images,
    match_people,
    pair_distances,
    pair_joints,
    read_estimates,
)
from humansim_ros.data.messages import GROUND, Pose, PoseFrame
from humansim_ros.errors import EvaluationError, printable
from humansim_ros.files.mesh import Mesh
from humansim_ros.files.reading import built_in_names
from humansim_ros.geometry import fit_similarity, from_y_axis, quaternion_to_matrix, transform
from humansim_ros.motion.body import DETAIL_BONES, JointPoses, Skeleton, hanim_skeleton, limit_bones, side_of
from humansim_ros.people.humans import MAX_BONES, Human
from humansim_ros.people.loading import load_human
from humansim_ros.types import Array, Indices

#: Axes of body space (y up, facing +z) in axes of ``map`` (z up, facing +x).
_BODY_FROM_MAP = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
#: Shortest bone that is drawn, and thickness of a bone as a share of its length, with its greatest, metres.
_SHORTEST, _THICKNESS, _THICKEST = 0.02, 0.12, 0.035
#: Colours of the bones of the left and right side and of the trunk.
_COLORS = {1: (80, 170, 255), -1: (255, 110, 150), 0: (250, 220, 90)}
#: Octahedron along y from 0 to 1 as a bone: thickest at a fifth of its length.
_CORNERS = np.array([(0, 0, 0), (1, 0.2, 0), (0, 0.2, 1), (-1, 0.2, 0), (0, 0.2, -1), (0, 1, 0)])
_FACES = np.array(
    [(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 1), (5, 2, 1), (5, 3, 2), (5, 4, 3), (5, 1, 4)], np.int32
)
_TOLERANCE = 1e-5


def known_body(mesh: Mesh, joint_names: Sequence[str], humans: Sequence[Human] = ()) -> Human | None:
    """Find the human with a surface, among ``humans`` and the built-in ones; None if no human has the
    surface.

    Args:
        mesh: The surface at rest.
        joint_names: Names of the joints that move it.
        humans: Humans that are compared before the built-in ones.
    """
    for human in (*humans, *_built_in()):
        same = human.mesh.vertices.shape == mesh.vertices.shape
        if (
            same
            and np.array_equal(human.mesh.triangles, mesh.triangles)
            and np.allclose(human.mesh.vertices, mesh.vertices, rtol=0, atol=_TOLERANCE)
            and set(human.skeleton.joint_names) <= set(joint_names)
        ):
            return human
    return None


@lru_cache(1)
def _built_in() -> tuple[Human, ...]:
    return tuple(load_human(name) for name in built_in_names("humans"))


def bone_figure(name: str, poses: JointPoses) -> Human | None:
    """A figure of bones for joints of a person with a body that is not known; None for joints without bones.

    ``poses`` (N = 1) are its rest pose.

    Args:
        name: Name of the person.
        poses: Joints in ``map``.
    """
    bones = bone_names(poses.names)
    if not 1 < len(bones) <= MAX_BONES:
        return None
    parents = _parents(bones, poses)
    depths = [_depth(parents, bone) for bone in range(len(bones))]
    order = sorted(range(len(bones)), key=depths.__getitem__)
    names = tuple(bones[bone] for bone in order)
    place = {bone: number for number, bone in enumerate(order)}
    above = np.array([place.get(parents[bone], -1) for bone in order], dtype=np.intp)
    points = _points(poses)
    turns = _turns(names, above, points, poses)
    skeleton = _skeleton(names, above, points, turns)
    mesh, weights = _octahedra(skeleton)
    return Human(name, mesh, skeleton, weights)


def bone_names(joints: Sequence[str]) -> tuple[str, ...]:
    """Names of joints that are the head of a bone: all but the ends ``<bone>_end``."""
    known = set(joints)
    return tuple(name for name in joints if not (name.endswith("_end") and name[:-4] in known))


def posed_joints(human: Human, poses: JointPoses) -> Array:
    """Poses (J, 4, 4) of the joints of a human, in the order of its skeleton, from its topic (N = 1).

    KeyError if the topic lacks a joint of the skeleton.
    """
    index = {name: number for number, name in enumerate(poses.names)}
    skeleton = human.skeleton
    if not _has_rotations(poses):
        heads = poses.positions[0, [index[name] for name in skeleton.names]]
        turns = _turns(skeleton.names, skeleton.parents, _points(poses), poses)
        return skeleton.joint_transforms(transform(turns, heads))
    whole = set(skeleton.joint_names) <= index.keys()
    chosen = [index[name] for name in (skeleton.joint_names if whole else skeleton.names)]
    joints = transform(quaternion_to_matrix(poses.rotations[0, chosen]), poses.positions[0, chosen])
    return joints if whole else skeleton.joint_transforms(joints)


def _points(poses: JointPoses) -> dict[str, Array]:
    """Position in ``map`` by joint."""
    return dict(zip(poses.names, poses.positions[0], strict=True))


def _has_rotations(poses: JointPoses) -> bool:
    """Whether a source gives rotations: some leave them unset."""
    return not np.allclose(poses.rotations, poses.rotations[:, :1], rtol=0, atol=1e-9)


def _turns(names: Sequence[str], parents: Indices, points: Mapping[str, Array], poses: JointPoses) -> Array:
    """Axes (B, 3, 3) of bones in ``map``, y along the bone; towards the next joint without rotations.

    Args:
        names: Names of the bones, parents first.
        parents: (B,) their parents.
        points: Position by joint.
        poses: Joints as the source gives them.
    """
    if _has_rotations(poses):
        rotations = dict(zip(poses.names, quaternion_to_matrix(poses.rotations[0]), strict=True))
        return np.array([rotations[name] for name in names])
    heads = np.array([points[name] for name in names])
    along = np.tile([0.0, 0.0, 1.0], (len(names), 1))
    for bone, ends in enumerate(_ends(names, parents, points)):
        step = np.mean(ends, axis=0) - heads[bone] if ends else np.zeros(3)
        length = np.linalg.norm(step)
        if length > _TOLERANCE:
            along[bone] = step / length
        elif parents[bone] >= 0:
            along[bone] = along[parents[bone]]
    return quaternion_to_matrix(from_y_axis(along))


def _ends(names: Sequence[str], parents: Indices, points: Mapping[str, Array]) -> Iterator[list[Array]]:
    """Position of the end of each bone if it is known; else the heads of its children."""
    for bone, name in enumerate(names):
        children = [points[names[child]] for child in np.flatnonzero(parents == bone).tolist()]
        yield [points[f"{name}_end"]] if f"{name}_end" in points else children


def _parents(names: Sequence[str], poses: JointPoses) -> list[int]:
    """Parent of each bone: as in the built-in humans, or else along the shortest tree of all joints."""
    general = hanim_skeleton()
    above: dict[str, str | None] = {
        name: general.names[parent] if parent >= 0 else None
        for name, parent in zip(general.names, general.parents, strict=True)
    }
    above |= DETAIL_BONES
    if set(names) <= above.keys():
        found = []
        for name in names:
            bone = above[name]
            while bone is not None and bone not in names:
                bone = above[bone]
            found.append(-1 if bone is None else names.index(bone))
        return found
    positions = _points(poses)
    points = np.array([positions[name] for name in names])
    distances = np.linalg.norm(points[:, None] - points[None], axis=2) + 1e-6  # 0 would be no edge
    tree = csgraph.minimum_spanning_tree(distances)
    _, before = csgraph.breadth_first_order(tree, 0, directed=False)
    return [int(parent) if parent >= 0 else -1 for parent in before]


def _depth(parents: Sequence[int], bone: int) -> int:
    depth = 0
    while parents[bone] >= 0:
        bone, depth = parents[bone], depth + 1
    return depth


def _skeleton(
    names: tuple[str, ...], parents: Indices, points: Mapping[str, Array], turns: Array
) -> Skeleton:
    """Skeleton in body space. Bones lie along their y axes, and reach to their children or ends.

    Args:
        names: Names of the bones.
        parents: (B,) their parents.
        points: Position of each joint in ``map``.
        turns: (B, 3, 3) axes of the bones in ``map``.
    """
    heads = np.array([points[name] for name in names])
    along = turns[:, :, 1]
    tails = np.empty_like(heads)
    for bone, ends in enumerate(_ends(names, parents, points)):
        reach = max((float((end - heads[bone]) @ along[bone]) for end in ends), default=0.0)
        tails[bone] = heads[bone] + along[bone] * max(reach, _SHORTEST)
    rolls = _rolls(_BODY_FROM_MAP @ turns)
    return Skeleton(names, parents, heads @ _BODY_FROM_MAP.T, tails @ _BODY_FROM_MAP.T, rolls)


def _rolls(axes: Array) -> Array:
    """Angles (B,) by which axes (B, 3, 3) of bones are turned about y, radians."""
    swing = quaternion_to_matrix(from_y_axis(axes[:, :, 1]))
    rolled = np.swapaxes(swing, 1, 2) @ axes
    return np.arctan2(rolled[:, 0, 2], rolled[:, 0, 0])


def _octahedra(skeleton: Skeleton) -> tuple[Mesh, csr_matrix]:
    """A surface of an octahedron for each bone, and its weights."""
    count, size = len(skeleton), len(_CORNERS)
    width = np.minimum(_THICKNESS * skeleton.lengths, _THICKEST)
    corners = _CORNERS * np.stack([width, skeleton.lengths, width], axis=1)[:, None]
    vertices = np.einsum("bij,bvj->bvi", skeleton.rest[:, :3, :3], corners) + skeleton.heads[:, None]
    triangles = (_FACES[None] + size * np.arange(count)[:, None, None]).reshape(-1, 3)
    faces = np.concatenate([triangles, np.full((len(triangles), 1), -1)], axis=1).astype(np.int32)
    colors = np.repeat([_COLORS[side_of(name)] for name in skeleton.names], size, axis=0).astype(np.uint8)
    bones = np.repeat(np.arange(count), size)
    weights = csr_matrix((np.ones(count * size), (np.arange(count * size), bones)))
    return Mesh(vertices.reshape(-1, 3), faces, colors=colors), weights


# --- the skin of an unknown body: bones at rest and weights from some posed frames

#: Fewest vertices around a bone from which its place at rest is found.
_FEWEST = 20
#: Steps of finding the rigid part of the skin around a bone, and the share of vertices that is kept.
_STEPS, _KEPT = 20, 0.5
#: A vertex that moves 1 m against a bone counts as this much farther from the bone, metres.
_STEADY = 4.0
#: Rounds of finding frames and weights, and weight from which a vertex moves with a bone.
_ROUNDS, _RIGID = 2, 0.9
#: Most bones that move a vertex.
_BONES = 4
#: Mean distance of the posed skin from the given one up to which the weights are used, metres.
_MAX_ERROR = 0.02


def fitted_skin(figure: Human, mesh: Mesh, joints: Array, vertices: Array) -> Human | None:
    """A human with the skin of a surface; None if bones cannot move the surface as given.

    Around the middle of a bone the skin is rigid: its vertices at rest and in the frames give the frame of
    the bone at rest. Then each vertex is a weighted mean of where its bones take it, by least squares.

    Args:
        figure: The person as a figure of bones.
        mesh: The surface at rest, V vertices.
        joints: Frames (F, B, 4, 4) of the bones of the figure in ``map``.
        vertices: The surface (F, V, 3) in ``map`` at the same stamps.
    """
    skeleton, rest = figure.skeleton, mesh.vertices
    inverse: Array = np.asarray(np.linalg.inv(joints), dtype=float)
    near = _nearest_bones(skeleton, inverse, vertices)
    of_bone = [np.flatnonzero(near == bone) for bone in range(len(skeleton))]
    frames = np.tile(np.eye(4), (len(skeleton), 1, 1))
    for first in (True, *(False,) * (_ROUNDS - 1)):
        for bone, skin in enumerate(of_bone):
            if len(skin) >= _FEWEST:
                local = np.mean(
                    [_moved(a[bone], b[skin]) for a, b in zip(inverse, vertices, strict=True)], axis=0
                )
                frames[bone] = _rigid(local, rest[skin], skeleton.lengths[bone] / 2)
            elif first and skeleton.parents[bone] >= 0:  # moves with its parent
                parent = skeleton.parents[bone]
                frames[bone] = frames[parent] @ inverse[0, parent] @ joints[0, bone]
        weights = _weights(joints @ np.linalg.inv(frames), rest, vertices)
        of_bone = [np.flatnonzero(column > _RIGID) for column in weights.toarray().T]
    heads, along = frames[:, :3, 3], frames[:, :3, 1]
    tails = heads + along * skeleton.lengths[:, None]
    found = Skeleton(skeleton.names, skeleton.parents, heads, tails, _rolls(frames[:, :3, :3]))
    human = Human(figure.name, mesh, found, limit_bones(weights))
    errors = [np.linalg.norm(human.pose(p) - v, axis=1).mean() for p, v in zip(joints, vertices, strict=True)]
    return human if max(errors) <= _MAX_ERROR else None


def _moved(matrix: Array, points: Array) -> Array:
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def _nearest_bones(skeleton: Skeleton, inverse: Array, vertices: Array) -> NDArray[np.intp]:
    """Bone (V,) that each vertex is nearest to, and moves with.

    Args:
        skeleton: Lengths of the bones.
        inverse: (F, B, 4, 4) transforms from ``map`` to the bones.
        vertices: (F, V, 3) vertices in ``map``.
    """
    scores = []
    for bone, length in enumerate(skeleton.lengths):
        local = np.array([_moved(a[bone], b) for a, b in zip(inverse, vertices, strict=True)])
        middle = local.mean(axis=0)
        unsteady = np.linalg.norm(local - middle, axis=2).max(axis=0)
        middle[:, 1] -= np.clip(middle[:, 1], 0, length)
        scores.append(np.linalg.norm(middle, axis=1) + _STEADY * unsteady)
    return np.argmin(scores, axis=0)


def _rigid(source: Array, target: Array, middle: float) -> Array:
    """Rigid transform (4, 4) from points (N, 3) to others, for the half of the points that fits best
    [Umeyama 1991].
    """
    count = max(_FEWEST // 2, int(_KEPT * len(source)))
    kept = np.argsort(np.abs(source[:, 1] - middle))[:count]
    for _ in range(_STEPS):
        matrix = transform(*fit_similarity(source[kept], target[kept], scale=1.0)[1:])
        best = np.argsort(np.linalg.norm(_moved(matrix, source) - target, axis=1))[:count]
        if set(best) == set(kept):
            break
        kept = best
    return matrix


def _weights(moves: Array, rest: Array, vertices: Array) -> csr_matrix:
    """Weights (V, B) by least squares, of the bones that take a vertex nearest to where it is.

    Args:
        moves: (F, B, 4, 4) transforms of the skin by each bone.
        rest: (V, 3) vertices at rest.
        vertices: (F, V, 3) vertices in the frames.
    """
    taken = np.einsum("fbij,vj->vbfi", moves[..., :3, :3], rest) + np.moveaxis(moves[..., :3, 3], 0, 1)[None]
    away = taken - np.moveaxis(vertices, 0, 1)[:, None]  # (V, B, F, 3)
    error = np.linalg.norm(away, axis=3).mean(axis=2)
    chosen = np.argsort(error, axis=1)[:, : min(_BONES, error.shape[1])]
    rows = np.arange(len(rest))[:, None]
    steps = away[rows, chosen].reshape(*chosen.shape, -1)  # weights sum to 1: their mean must be 0
    products = steps @ np.swapaxes(steps, 1, 2)
    scale = np.trace(products, axis1=1, axis2=2)[:, None, None] + 1e-12
    products = products / scale + 1e-6 * np.eye(chosen.shape[1])
    free = np.ones(chosen.shape, bool)
    for _ in range(chosen.shape[1]):
        blocked = products + 1e6 * (~free)[:, :, None] * np.eye(chosen.shape[1])
        solved = np.linalg.solve(blocked, free.astype(float)[..., None])[..., 0] * free
        solved /= solved.sum(axis=1, keepdims=True)
        if (solved >= 0).all():
            break
        free &= solved > 0
    shape = (len(rest), moves.shape[1])
    flat = (np.repeat(rows[:, 0], chosen.shape[1]), chosen.ravel())
    return csr_matrix((np.maximum(solved, 0).ravel(), flat), shape=shape)


# --- an estimate next to the truth of the same frame

#: Most people of an estimate that are shown.
_MOST = 64

#: Names and positions (K, 3) of a person of the truth.
TruePoints = tuple[Sequence[str], Array]


@dataclass(frozen=True)
class Estimate:
    """Poses of a tracker that are not on topics of the source which is shown.

    Attributes:
        poses: They, in ``map``, metres.
        options: How they are compared.
    """

    poses: PoseSequence
    options: LiveOptions

    @classmethod
    def read(cls, texts: Sequence[str], options: LiveOptions, period: int, start: int) -> Estimate:
        """Read what ``humansim evaluate`` takes as an estimate.

        Args:
            texts: ``BAG:TOPIC``, a file, a folder, or several of them.
            options: How it is read and compared.
            period: Nanoseconds between frames of the truth, for formats that number frames.
            start: Stamp of the first frame, nanoseconds.

        Raises:
            HumansimError: It cannot be read, or is detections in images.
        """
        if found := next(filter(is_of_images, texts), None):
            raise EvaluationError(
                "is detections in images, and the page compares 3D poses: give it to humansim evaluate",
                path=found,
            )
        return cls(read_estimates(texts, replace(options.reading, period=period, start=start)), options)

    def at(self, stamp: int, half: int) -> list[Pose]:
        """People in the frame that is nearest to a stamp, if it is at most ``half`` nanoseconds away."""
        if not len(self.poses.times):
            return []
        row = int(np.argmin(np.abs(self.poses.times - stamp)))
        if abs(int(self.poses.times[row]) - stamp) > half:
            return []
        people = list(self.poses.people[row].items())[:_MOST]
        return [Pose(name, self.poses.names, pose) for name, pose in people]


def people_of(frame: PoseFrame, person: str | None, options: LiveOptions) -> list[Pose]:
    """People of a message, in ``map`` and metres.

    Args:
        frame: The message.
        person: Name that the topic gives to the person. If None, the message has the names.
        options: Scale and axes of the estimate.

    Raises:
        EvaluationError: The positions are in another frame.
    """
    check_world(frame)
    matrix = options.scale * axes_matrix(options.axes or "z-up")
    return [
        pose._replace(person=person or pose.person, positions=pose.positions @ matrix.T)
        for pose in frame.people[:_MOST]
    ]


def beside_truth(
    estimate: Sequence[Pose], truth: Mapping[str, TruePoints], options: LiveOptions
) -> tuple[dict[str, Array], dict[str, float]]:
    """Give people of an estimate the names of the nearest people of the truth.

    People who match nobody keep their own name after a ``?``.

    Args:
        estimate: People of the estimate.
        truth: People of the truth by name.
        options: Names of joints, and greatest distance of a person who is found.

    Returns:
        Points (K, 3) by name, and mean distance from the common joints of the truth by name, millimetres.

    Raises:
        EvaluationError: No joint is common.
    """
    estimate = [pose for pose in estimate if np.isfinite(pose.positions).any()]
    names = list(truth)
    distances = np.full((len(names), len(estimate)), np.inf)
    for row, name in enumerate(names):
        known, positions = truth[name]
        for column, pose in enumerate(estimate):
            if pose.names == (GROUND,):
                own = np.array([[*pose.positions[0, :2], 0.0]])
                found = pair_distances([below_hips(known, positions)], [own])
            else:
                pairs = np.array(pair_joints(known, pose.names, options.table))
                found = pair_distances([positions[pairs[:, 0]]], [pose.positions[pairs[:, 1]]])
            distances[row, column] = found[0, 0]
    matched = {column: row for row, column in match_people(distances, options.gate)} if distances.size else {}
    points: dict[str, Array] = {}
    errors: dict[str, float] = {}
    for column, pose in enumerate(estimate):
        if column in matched:
            name = names[matched[column]]
            errors[name] = 1000.0 * float(distances[matched[column], column])
        else:
            name = f"?{printable(pose.person or str(column + 1), 80)}"
        points[name] = pose.positions
    return points, errors
