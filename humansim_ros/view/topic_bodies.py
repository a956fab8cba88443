"""Bodies of people who are known by their topics only: humans that we have, or a figure of bones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache

import numpy as np
from scipy.sparse import csgraph, csr_matrix

from humansim_ros.body.skeleton import Skeleton, hanim_skeleton, side_of
from humansim_ros.humans import Human, load_human
from humansim_ros.humans.human import MAX_BONES
from humansim_ros.io.assets import built_in_names
from humansim_ros.mesh.mesh import Mesh
from humansim_ros.motion.joint_poses import JointPoses
from humansim_ros.rotations import from_y_axis, quaternion_to_matrix, transform
from humansim_ros.types import Array, Indices

#: Axes of body space (y up, facing +z) in those of ``map`` (z up, facing +x).
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
    """The human with a surface: one of ``humans``, or a built-in one; None if it is none of them.

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
    """A figure of bones for joints of a person whose body is not known; None for joints without bones.

    Its rest pose is that of ``poses`` (N = 1).

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
    for bone, name in enumerate(names):
        ends = [points[f"{name}_end"]] if f"{name}_end" in points else list(heads[parents == bone])
        step = np.mean(ends, axis=0) - heads[bone] if ends else np.zeros(3)
        length = np.linalg.norm(step)
        if length > _TOLERANCE:
            along[bone] = step / length
        elif parents[bone] >= 0:
            along[bone] = along[parents[bone]]
    return quaternion_to_matrix(from_y_axis(along))


def _parents(names: Sequence[str], poses: JointPoses) -> list[int]:
    """Parent of each bone: that of the general skeleton, or else along the shortest tree of all joints."""
    general = hanim_skeleton()
    if set(names) <= set(general.names):
        found = []
        for name in names:
            bone = int(general.parents[general.bone(name)])
            while bone >= 0 and general.names[bone] not in names:
                bone = int(general.parents[bone])
            found.append(names.index(general.names[bone]) if bone >= 0 else -1)
        return found
    positions = _points(poses)
    points = np.array([positions[name] for name in names])
    distances = np.linalg.norm(points[:, None] - points[None], axis=2) + 1e-6  # 0 would be no edge
    tree = csgraph.minimum_spanning_tree(distances)
    _, above = csgraph.breadth_first_order(tree, 0, directed=False)
    return [int(parent) if parent >= 0 else -1 for parent in above]


def _depth(parents: Sequence[int], bone: int) -> int:
    depth = 0
    while parents[bone] >= 0:
        bone, depth = parents[bone], depth + 1
    return depth


def _skeleton(
    names: tuple[str, ...], parents: Indices, points: Mapping[str, Array], turns: Array
) -> Skeleton:
    """Skeleton in body space whose bones lie along y of their axes, as far as their children or ends.

    Args:
        names: Names of the bones.
        parents: (B,) their parents.
        points: Position of each joint in ``map``.
        turns: (B, 3, 3) axes of the bones in ``map``.
    """
    heads = np.array([points[name] for name in names])
    along = turns[:, :, 1]
    tails = np.empty_like(heads)
    for bone, name in enumerate(names):
        ends = [points[f"{name}_end"]] if f"{name}_end" in points else list(heads[parents == bone])
        reach = max((float((end - heads[bone]) @ along[bone]) for end in ends), default=0.0)
        tails[bone] = heads[bone] + along[bone] * max(reach, _SHORTEST)
    frames = _BODY_FROM_MAP @ turns
    swing = quaternion_to_matrix(from_y_axis(frames[:, :, 1]))
    rolled = np.swapaxes(swing, 1, 2) @ frames  # rotation about y
    rolls = np.arctan2(rolled[:, 0, 2], rolled[:, 0, 0])
    return Skeleton(names, parents, heads @ _BODY_FROM_MAP.T, tails @ _BODY_FROM_MAP.T, rolls)


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
