"""Bones at the joints of a MakeHuman body, with the weights of its artists, and the T pose.

The first 22 bones are the bones of [thesis table 4.1]. ``DETAIL_BONES`` are fingers, toes, jaw and eyes. Each
detail belongs to one of the 22 bones and takes a share of its weights. A bone and its details together move
the skin as the bone alone would.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial.transform import Rotation

from humansim_ros.files.reading import read_table
from humansim_ros.geometry import from_y_axis, quaternion_to_matrix, shortest_rotations, unit_vectors
from humansim_ros.motion.body import DETAIL_BONES, FINGERS, skin
from humansim_ros.people.makehuman.data import Base, VertexIndices
from humansim_ros.people.makehuman.surface import ramp
from humansim_ros.types import Array

BONES_PER_VERTEX = 4
#: A shoe bends within this distance from the ball of the foot, as a share of the length of the foot bone.
_SHOE_BEND = 0.14
# Name, parent, and landmarks (see `landmarks`) of head and tail; details come last.
_BONES = read_table("makehuman_bones")["bones"]
#: Names of all bones of a MakeHuman body.
BONE_NAMES: tuple[str, ...] = tuple(bone["name"] for bone in _BONES)
_GENERAL = BONE_NAMES[: -len(DETAIL_BONES)]


def _wholes() -> VertexIndices:
    """For each bone (B,), its own number. For a detail, the number of the bone, among the first 22, that this
    detail belongs to."""
    wholes = list(range(len(_GENERAL)))
    for bone in DETAIL_BONES:
        wholes.append(wholes[BONE_NAMES.index(DETAIL_BONES[bone])])
    return np.array(wholes)


_WHOLE = _wholes()


def landmarks(base: Base) -> dict[str, Array]:
    """Joint centres (3,) in metres: the centres of MakeHuman's joint cubes, and some of our own."""
    joints = {name: rows for name, rows in base.vertex_groups.items() if name.startswith("joint-")}
    points = {name: base.vertices[rows].mean(axis=0) for name, rows in joints.items()}
    body = base.vertices[base.vertex_groups["body"]]
    points["skull-top"] = points["joint-head-2"].copy()
    points["skull-top"][1] = body[:, 1].max()
    # the root bone leads up into the pelvis from the front [thesis table 4.1]
    points["root"] = 2 * points["joint-pelvis"] - points["joint-spine-4"]
    for side in "lr":
        toes = [points[f"joint-{side}-toe-{number}-1"] for number in range(1, 6)]
        points[f"{side}-ball"] = np.mean(toes, axis=0)
        eye, gaze = points[f"joint-{side}-eye"], points[f"joint-{side}-eye-target"]
        ball = base.vertices[base.vertex_groups[f"helper-{side}-eye"]]
        radius = np.linalg.norm(ball - eye, axis=1).max()
        points[f"{side}-pupil"] = eye + radius * unit_vectors(gaze - eye)
    for name, point in points.items():
        if not any(side in f"-{name}" for side in ("-l-", "-r-")):
            point[0] = 0.0
    return points


@dataclass(frozen=True)
class Bones:
    """names (B,), parents (B,) with -1 for the root, heads and tails (B, 3) in metres. ``hinges`` (B, 3):
    unit axes of flexion of fingers and toes; zero for other bones."""

    names: tuple[str, ...]
    parents: VertexIndices
    heads: Array
    tails: Array
    hinges: Array

    def index(self, name: str) -> int:
        """Index of a bone."""
        return self.names.index(name)

    @property
    def rolls(self) -> Array:
        """(B,) radians. The x axis of a bone with a hinge is as near to the hinge as possible. Other bones
        have roll 0."""
        swing = quaternion_to_matrix(from_y_axis(unit_vectors(self.tails - self.heads)))
        x, z = (np.einsum("bi,bi->b", swing[:, :, axis], self.hinges) for axis in (0, 2))
        return np.arctan2(-z, x)


def make_bones(points: Mapping[str, Array], moved: Mapping[str, Array], hinges: Mapping[str, Array]) -> Bones:
    """Bones at the joint centres ``points`` of this body (see :func:`landmarks`). ``moved``, ``hinges``:
    transforms (4, 4) and axes (3,) of finger bones, by name (see :func:`relaxed_fingers`)."""
    names = BONE_NAMES
    parents = np.array([-1 if bone["parent"] is None else names.index(bone["parent"]) for bone in _BONES])
    heads, tails = (np.array([points[bone[end]] for bone in _BONES]) for end in ("head", "tail"))
    axes = np.zeros((len(names), 3))
    for bone, name in enumerate(names):
        if name in moved:
            turn, shift = moved[name][:3, :3], moved[name][:3, 3]
            heads[bone], tails[bone] = turn @ heads[bone] + shift, turn @ tails[bone] + shift
            axes[bone] = hinges[name]
    for side, out in (("l", 1.0), ("r", -1.0)):
        across = points[f"joint-{side}-toe-5-1"] - points[f"joint-{side}-toe-1-1"]
        axes[names.index(f"{side}_metatarsal")] = out * unit_vectors(across)
    return Bones(names, parents, heads, tails, axes)


def _sums(weights: Array) -> Array:
    """Weights (N, 22) of the 22 bones, each including its details."""
    sums = weights[:, : int(_WHOLE.max()) + 1].copy()
    for bone in range(sums.shape[1], len(_WHOLE)):
        sums[:, _WHOLE[bone]] += weights[:, bone]
    return sums


def limit_weights(weights: Array) -> Array:
    """Limit weights (N, B) to four of the 22 bones per vertex, each with its details. Rows sum to one."""
    return _shared(_limited(_sums(weights)), weights)


def _limited(sums: Array) -> Array:
    """Weights (N, 22) of the four bones with the largest weights. Other weights become zero."""
    # ties with the fifth are removed too, to keep left and right symmetric
    fifth = np.sort(sums, axis=1)[:, -BONES_PER_VERTEX - 1][:, None]
    sums = np.where((sums <= fifth) | (sums < 1e-3), 0.0, sums)
    return sums / sums.sum(axis=1, keepdims=True)


def _shared(sums: Array, weights: Array) -> Array:
    """Weights (N, B) in the ratios of ``weights``, scaled so that each of the 22 bones with its details has
    the sum in ``sums`` (N, 22)."""
    weights = np.where(weights < 1e-3, 0.0, weights)
    given = _sums(weights)
    bare = given <= 0
    weights[:, : sums.shape[1]][bare] = 1.0  # a bone without weights takes its whole sum
    given[bare] = 1.0
    return weights * (sums / given)[:, _WHOLE]


def bend_in_shoes(weights: Array, vertices: Array, bones: Bones) -> Array:
    """Weights (N, B) that bend a shoe at the ball of the foot, as leather bends, and not between toes.
    ``weights``: (N, B) and ``vertices``: (N, 3) metres of the shoes, in the pose of ``bones``."""
    weights = weights.copy()
    for side in "lr":
        foot, toes = bones.index(f"{side}_ankle"), bones.index(f"{side}_metatarsal")
        forwards = unit_vectors(np.cross(bones.hinges[toes], [0.0, 1.0, 0.0]))
        ahead = (vertices - bones.heads[toes]) @ forwards
        reach = _SHOE_BEND * float(np.linalg.norm(bones.tails[foot] - bones.heads[foot]))
        share = ramp(ahead, -reach, reach)
        both = weights[:, foot] + weights[:, toes]
        weights[:, foot], weights[:, toes] = (1 - share) * both, share * both
    return weights


def limit_details(weights: Array) -> Array:
    """Limit weights (N, B) to four bones per vertex. The sum over each of the 22 bones with its details does
    not change. ``weights``: at most four of the 22 bones per vertex. Their smallest details are left out."""
    weights = weights.copy()
    while len(many := np.flatnonzero((weights > 0).sum(axis=1) > BONES_PER_VERTEX)):
        rows = weights[many]
        sums = _sums(rows)
        spare = (rows > 0) & (_sums((rows > 0).astype(float))[:, _WHOLE] > 1)
        rows[np.arange(len(rows)), np.where(spare, rows, np.inf).argmin(axis=1)] = 0.0
        weights[many] = _shared(sums, rows)
    return weights


def edges_of(faces: VertexIndices) -> VertexIndices:
    """Edges (E, 2) of quads (F, 4), each once."""
    edges = np.unique(np.sort(np.concatenate([faces[:, [k, (k + 1) % 4]] for k in range(4)]), axis=1), axis=0)
    return edges[edges[:, 0] != edges[:, 1]]


def smooth_weights(weights: Array, vertices: Array, edges: VertexIndices, reach: float) -> Array:
    """Smooth weights along short edges, which a motion would otherwise stretch to many times their length.
    The 22 bones share their weights among their details as before.

    The weights at the ends of an edge may differ so much that the edge stretches to about twice its length
    when bones move ``reach`` metres apart. Larger differences are reduced iteratively.

    Args:
        weights: (N, B).
        vertices: (N, 3) metres.
        edges: See :func:`edges_of`.
        reach: Distance in metres.
    """
    details = weights
    weights = _sums(details)
    length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    allowed = 2.0 * length / reach
    around = _edges_around(edges, len(weights))
    step = weights[edges[:, 1]] - weights[edges[:, 0]]
    differ = np.abs(step).sum(axis=1) / 2
    for _ in range(200):
        bad = np.flatnonzero(differ > 1.02 * allowed)
        if not len(bad):
            break
        moved, place = np.unique(edges[bad], return_inverse=True)
        place = place.reshape(-1, 2)
        pull = (0.5 * (1 - allowed[bad] / differ[bad]))[:, None] * step[bad]
        total = np.zeros((len(moved), weights.shape[1]))
        np.add.at(total, place[:, 0], pull)
        np.subtract.at(total, place[:, 1], pull)
        weights[moved] += total / np.bincount(place.ravel())[:, None]
        near = np.unique(around[moved])  # only these edges have changed
        step[near] = weights[edges[near, 1]] - weights[edges[near, 0]]
        differ[near] = np.abs(step[near]).sum(axis=1) / 2
    return _shared(_limited(weights), details)


def _edges_around(edges: VertexIndices, count: int) -> VertexIndices:
    """Edges (V, K) at each of V vertices. A vertex with fewer edges repeats some."""
    vertex = edges.ravel()
    order = np.argsort(vertex, kind="stable")
    starts = np.searchsorted(vertex[order], np.arange(count + 1))
    degree = np.diff(starts)
    column = np.minimum(np.arange(degree.max())[None], np.maximum(degree - 1, 0)[:, None])
    return order[np.minimum(starts[:-1, None] + column, len(order) - 1)] // 2


def t_pose(bones: Bones) -> tuple[Array, Bones]:
    """Transforms (B, 4, 4) of the bones from MakeHuman's A pose to the T pose, and the bones in the T pose.
    Arms and hands are along x with palms down. Legs are closer together, and feet are level."""
    direction = bones.tails - bones.heads
    along = unit_vectors(direction)
    turn = np.tile(np.eye(3), (len(bones.names), 1, 1))  # world rotation of each bone
    for side, out in (("l", 1.0), ("r", -1.0)):
        shoulder, elbow, wrist = (bones.index(f"{side}_{part}") for part in ("shoulder", "elbow", "wrist"))
        arm = shortest_rotations(along[shoulder], np.array([out, 0, 0]))
        straight = shortest_rotations(along[elbow], along[shoulder])
        turn[shoulder] = arm
        turn[elbow] = arm @ straight
        turn[wrist] = shortest_rotations(turn[elbow] @ along[wrist], np.array([out, 0, 0])) @ turn[elbow]
        hip, knee = bones.index(f"{side}_hip"), bones.index(f"{side}_knee")
        leg = bones.tails[knee] - bones.heads[hip]
        inwards = Rotation.from_euler("z", -out * 0.6 * np.arctan2(abs(leg[0]), -leg[1])).as_matrix()
        turn[hip] = turn[knee] = inwards
    for bone, name in enumerate(bones.names):
        if name in DETAIL_BONES:
            turn[bone] = turn[bones.parents[bone]]
    heads, tails = bones.heads.copy(), bones.tails.copy()
    motion = np.tile(np.eye(4), (len(bones.names), 1, 1))
    for b, parent in enumerate(bones.parents):
        if parent >= 0:
            heads[b] = motion[parent, :3, :3] @ bones.heads[b] + motion[parent, :3, 3]
        tails[b] = heads[b] + turn[b] @ direction[b]
        motion[b, :3, :3] = turn[b]
        motion[b, :3, 3] = heads[b] - turn[b] @ bones.heads[b]
    hinges = np.einsum("bij,bj->bi", turn, bones.hinges)
    return motion, Bones(bones.names, bones.parents, heads, tails, hinges)


def unskin(vertices: Array, weights: Array, motion: Array) -> Array:
    """Invert linear blend skinning: return vertices (N, 3) that the inverse of ``motion`` moves to
    ``vertices``. The A pose of the artists is thus reproduced exactly."""
    back = np.einsum("nb,bij->nij", weights, np.linalg.inv(motion))
    homogeneous = np.c_[vertices, np.ones(len(vertices))]
    return np.linalg.solve(back, homogeneous[:, :, None])[:, :3, 0]


#: Flexion of the three joints of each finger of a relaxed hand, degrees, from thumb to little finger.
_FLEXION = ((6, 10, 14), (20, 28, 14), (24, 32, 16), (27, 34, 17), (30, 35, 17))
#: A finger is turned towards the middle finger by this share of the angle between them.
_CLOSING = 0.6
#: Rotation of the thumb towards the fingers, degrees.
_THUMB_CLOSING = 14.0


def relaxed_fingers(points: Mapping[str, Array]) -> tuple[dict[str, Array], dict[str, Array]]:
    """Relax the hands: transforms (4, 4) of finger bones, and their axes (3,) of flexion after that, both by
    name of the bone. A positive angle about the axis flexes a bone. ``points``: landmarks (see
    ``skeleton.landmarks``)."""
    transforms, hinges = {}, {}
    for side in "lr":
        for number, name in enumerate(FINGERS, 1):
            segments, axis = _finger(points, side, number)
            for segment, transform in enumerate(segments, 1):
                transforms[f"{side}_{name}{segment}"] = transform
                hinges[f"{side}_{name}{segment}"] = transform[:3, :3] @ axis
    return transforms, hinges


def relax_hands(shares: Array, vertices: Array, transforms: Mapping[str, Array]) -> Array:
    """Bend the fingers of both hands: vertices (N, 3) of the base mesh, metres, in the A pose. ``shares``:
    ``finger_shares`` of :class:`MakeHumanData`. ``transforms``: see :func:`relaxed_fingers`."""
    moved = np.flatnonzero(shares[:, 0] < 1.0)
    out = vertices.copy()
    shares = shares[moved] / shares[moved].sum(axis=1, keepdims=True)
    # dual quaternions, since linear blending would flatten the knuckles
    motion = np.array([np.eye(4), *transforms.values()])
    out[moved] = skin(vertices[moved], csr_matrix(shares), motion, "dual_quaternion")
    return out


def _finger(points: Mapping[str, Array], side: str, finger: int) -> tuple[list[Array], Array]:
    """Transforms (4, 4) of the three segments of a finger, and the axis (3,) of flexion before they are
    applied."""

    def joint(number: int, of: int = finger) -> Array:
        return points[f"joint-{side}-finger-{of}-{number}"]

    along = joint(1, 3) - points[f"joint-{side}-hand"]
    across = joint(1, 5) - joint(1, 2)
    palm = np.cross(across, along) * (1.0 if side == "l" else -1.0)
    palm /= np.linalg.norm(palm)
    closing = _closing(palm, joint, finger)
    if finger == 1:  # the thumb bends across the palm
        forwards = joint(4) - joint(1)
        sideways = across / np.linalg.norm(across)
        axis = np.cross(forwards, 0.5 * palm + sideways)
    else:
        axis = np.cross(joint(4) - joint(1), palm)
    axis /= np.linalg.norm(axis)
    out, before = [], np.eye(4)
    for segment, degrees in enumerate(_FLEXION[finger - 1], 1):
        step = np.eye(4)
        turn = Rotation.from_rotvec(np.radians(degrees) * axis).as_matrix()
        step[:3, :3] = turn @ closing if segment == 1 else turn
        step[:3, 3] = joint(segment) - step[:3, :3] @ joint(segment)
        before = before @ step
        out.append(before)
    return out, axis


def _closing(palm: Array, joint: Callable[..., Array], finger: int) -> Array:
    """Rotation (3, 3) about the normal of the palm that turns a finger towards the middle finger."""
    direction, middle = (d - (d @ palm) * palm for d in (joint(3) - joint(1), joint(3, 3) - joint(1, 3)))
    angle = np.arctan2(np.cross(direction, middle) @ palm, direction @ middle)
    angle = np.sign(angle) * np.radians(_THUMB_CLOSING) if finger == 1 else _CLOSING * angle
    return Rotation.from_rotvec(angle * palm).as_matrix()
