"""People who are known only from topics: finds their bodies and skinning weights; and estimates of people."""

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

#: Rotation from ``map`` (z up, facing +x) to body space (y up, facing +z).
_BODY_FROM_MAP = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
#: Shortest drawn bone, metres; thickness of a bone as a share of its length; largest thickness, metres.
_SHORTEST, _THICKNESS, _THICKEST = 0.02, 0.12, 0.035
#: Colours of the bones of the left and right side and of the trunk.
_COLORS = {1: (80, 170, 255), -1: (255, 110, 150), 0: (250, 220, 90)}
#: Corners of an octahedron that is drawn as a bone: along y from 0 to 1, thickest at a fifth of its length.
_CORNERS = np.array([(0, 0, 0), (1, 0.2, 0), (0, 0.2, 1), (-1, 0.2, 0), (0, 0.2, -1), (0, 1, 0)])
_FACES = np.array(
    [(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 1), (5, 2, 1), (5, 3, 2), (5, 4, 3), (5, 1, 4)], np.int32
)
_TOLERANCE = 1e-5


def known_body(mesh: Mesh, joint_names: Sequence[str], humans: Sequence[Human] = ()) -> Human | None:
    """Find the human with a given surface, among ``humans`` and the built-in humans; None if there is none.

    Args:
        mesh: The surface at rest.
        joint_names: Names of the joints that move the surface.
        humans: Humans that are compared before the built-in humans.
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
    """Make a figure of bones for a person whose body is unknown; None if the joints form no bones.

    The figure has ``poses`` (one frame) as its rest pose.

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
    """Names of the bones: all joints, each the head of a bone, except the end points ``<bone>_end``."""
    known = set(joints)
    return tuple(name for name in joints if not (name.endswith("_end") and name[:-4] in known))


def posed_joints(human: Human, poses: JointPoses) -> Array:
    """Poses (J, 4, 4) of a human's joints, in the order of the skeleton. ``poses``: one frame of the topic.

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
    """Position (3,) in ``map`` of each joint, by name."""
    return dict(zip(poses.names, poses.positions[0], strict=True))


def _has_rotations(poses: JointPoses) -> bool:
    """Whether the joints have rotations. Some programs leave them unset, so that all are equal."""
    return not np.allclose(poses.rotations, poses.rotations[:, :1], rtol=0, atol=1e-9)


def _turns(names: Sequence[str], parents: Indices, points: Mapping[str, Array], poses: JointPoses) -> Array:
    """Axes (B, 3, 3) of bones in ``map``, y along the bone. Without rotations, y points to the next joint.

    Args:
        names: Names of the bones, parents first.
        parents: (B,) their parents.
        points: Position by joint.
        poses: Joints as the topic has them.
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
    """Yield, for each bone, the position of its end if known, else the heads of its children (maybe none)."""
    for bone, name in enumerate(names):
        children = [points[names[child]] for child in np.flatnonzero(parents == bone).tolist()]
        yield [points[f"{name}_end"]] if f"{name}_end" in points else children


def _parents(names: Sequence[str], poses: JointPoses) -> list[int]:
    """Parent of each bone, as in built-in humans; if a name is unknown, along the shortest tree of joints."""
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
    """Make a skeleton in body space. Bones lie along their y axes, and reach to their children or ends.

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
    """Roll angles (B,) of bones about their y axes, radians, from their axes (B, 3, 3)."""
    swing = quaternion_to_matrix(from_y_axis(axes[:, :, 1]))
    rolled = np.swapaxes(swing, 1, 2) @ axes
    return np.arctan2(rolled[:, 0, 2], rolled[:, 0, 0])


def _octahedra(skeleton: Skeleton) -> tuple[Mesh, csr_matrix]:
    """Mesh with an octahedron for each bone, and its skinning weights."""
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

#: Fewest vertices around a bone that are needed to find its pose at rest.
_FEWEST = 20
#: Most iterations to find the rigid skin around a bone, and share of the vertices that is used.
_STEPS, _KEPT = 20, 0.5
#: A vertex that moves 1 m against a bone counts as this much farther from the bone, metres.
_STEADY = 4.0
#: Iterations over bone frames and weights; and weight above which a vertex counts as rigid with a bone.
_ROUNDS, _RIGID = 2, 0.9
#: Most bones that move a vertex.
_BONES = 4
#: Weights are rejected if the posed skin is farther from the given one than this on average, metres.
_MAX_ERROR = 0.02


def fitted_skin(figure: Human, mesh: Mesh, joints: Array, vertices: Array) -> Human | None:
    """Compute a human with skinning weights for a surface; None if no weights reproduce the given vertices.

    Around the middle of a bone the skin is assumed rigid, so its vertices at rest and in the frames give the
    bone frame at rest. Then the weights are fitted by least squares to the vertices in the frames.

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
    """Number (V,) of the bone that each vertex is near to and moves with.

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
    """Rigid transform (4, 4) from points ``source`` to ``target`` (N, 3), for the best half of the points
    [Umeyama 1991]. It starts with points near the height ``middle`` on the bone.
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
    """Skinning weights (V, B) by least squares, for the bones that move a vertex nearest to ``vertices``.

    Args:
        moves: (F, B, 4, 4) transforms by which each bone moves the skin from rest.
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

#: Names and positions (K, 3) of the true joints or keypoints of a person.
TruePoints = tuple[Sequence[str], Array]


@dataclass(frozen=True)
class Estimate:
    """Estimate of a tracker that was read from files or another bag, not from topics of the source.

    Attributes:
        poses: Poses of the estimate in ``map``, metres.
        options: How the poses are compared with the truth.
    """

    poses: PoseSequence
    options: LiveOptions

    @classmethod
    def read(cls, texts: Sequence[str], options: LiveOptions, period: int, start: int) -> Estimate:
        """Read an estimate in the forms that ``humansim evaluate`` accepts.

        Args:
            texts: ``BAG:TOPIC``, a file, a folder, or several of them.
            options: How the estimate is read and compared.
            period: Nanoseconds between frames of the truth, for formats with frame numbers instead of times.
            start: Stamp of the first frame, nanoseconds.

        Raises:
            HumansimError: The estimate cannot be read, or has detections in images instead of 3D poses.
        """
        if found := next(filter(is_of_images, texts), None):
            raise EvaluationError(
                "is detections in images, and the page compares 3D poses: give it to humansim evaluate",
                path=found,
            )
        return cls(read_estimates(texts, replace(options, period=period, start=start)), options)

    def at(self, stamp: int, half: int) -> list[Pose]:
        """People in the frame nearest to a stamp; empty if it is more than ``half`` nanoseconds away."""
        if not len(self.poses.times):
            return []
        row = int(np.argmin(np.abs(self.poses.times - stamp)))
        if abs(int(self.poses.times[row]) - stamp) > half:
            return []
        people = list(self.poses.people[row].items())[:_MOST]
        return [Pose(name, self.poses.names, pose) for name, pose in people]


def people_of(frame: PoseFrame, person: str | None, options: LiveOptions) -> list[Pose]:
    """Convert the people of a message of an estimate to ``map``, metres.

    Args:
        frame: The message.
        person: Name that the topic gives to the person. If None, the message has the names.
        options: Scale and axes of the estimate.

    Raises:
        EvaluationError: The positions are in another frame than ``map``.
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
    """Match people of an estimate with the nearest people of the truth, and give them these names.

    People of the estimate without a match keep their own name, preceded by ``?``.

    Args:
        estimate: People of the estimate.
        truth: People of the truth by name.
        options: Joint names, and largest distance of a match.

    Returns:
        Points (K, 3) of the estimate by name; and, for matched people, the mean distance of the common joints
        from the truth by name, millimetres.

    Raises:
        EvaluationError: Estimate and truth have no joint in common.
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
