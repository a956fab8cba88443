"""The 22 bones at the joints of a MakeHuman body, with the weights of its artists, and the T pose."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from humansim_ros.humans.makehuman.data import Base, MakeHumanData, VertexIndices
from humansim_ros.rotations import shortest_rotations, unit_vectors
from humansim_ros.types import Array

BONES_PER_VERTEX = 4

# Name, parent, and landmarks (see `landmarks`) of head and tail; `{}` is the side, l or r.
TRUNK = (
    ("HumanoidRoot", None, "root", "joint-pelvis"),
    ("sacroiliac", "HumanoidRoot", "joint-pelvis", "joint-spine-3"),
    ("vl5", "sacroiliac", "joint-spine-3", "joint-neck"),
    ("vt3", "vl5", "joint-neck", "skull-top"),
)
SIDE = (
    ("HumanoidRoot_to_{}_hip", "HumanoidRoot", "joint-pelvis", "joint-{}-upper-leg"),
    ("{}_hip", "HumanoidRoot_to_{}_hip", "joint-{}-upper-leg", "joint-{}-knee"),
    ("{}_knee", "{}_hip", "joint-{}-knee", "joint-{}-ankle"),
    ("{}_ankle", "{}_knee", "joint-{}-ankle", "joint-{}-foot-2"),
    ("vl5_to_{}_sternoclavicular", "vl5", "joint-neck", "joint-{}-clavicle"),
    ("{}_sternoclavicular", "vl5_to_{}_sternoclavicular", "joint-{}-clavicle", "joint-{}-shoulder"),
    ("{}_shoulder", "{}_sternoclavicular", "joint-{}-shoulder", "joint-{}-elbow"),
    ("{}_elbow", "{}_shoulder", "joint-{}-elbow", "joint-{}-hand"),
    ("{}_wrist", "{}_elbow", "joint-{}-hand", "joint-{}-finger-3-4"),
)

# Bones that take the weight of a bone of MakeHuman's default rig, by the longest prefix of its name.
# Shared weights at neck and pelvis smooth joints that are several joints in the rig.
WEIGHT_SHARES: dict[str, dict[str, float]] = {
    "": {"vt3": 1.0},  # head, jaw, tongue, eyes and the muscles of the face
    "root": {"HumanoidRoot": 1.0},
    "pelvis": {"HumanoidRoot": 1.0},
    "spine05": {"HumanoidRoot": 0.5, "sacroiliac": 0.5},
    "spine04": {"sacroiliac": 1.0},
    "spine03": {"vl5": 1.0},
    "spine02": {"vl5": 1.0},
    "spine01": {"vl5": 1.0},
    "breast": {"vl5": 1.0},
    "neck01": {"vl5": 0.5, "vt3": 0.5},
    "clavicle": {"{}_sternoclavicular": 1.0},
    "shoulder01": {"{}_sternoclavicular": 1.0},
    "upperarm": {"{}_shoulder": 1.0},
    "lowerarm": {"{}_elbow": 1.0},
    "wrist": {"{}_wrist": 1.0},
    "metacarpal": {"{}_wrist": 1.0},
    "finger": {"{}_wrist": 1.0},
    "upperleg": {"{}_hip": 1.0},
    "lowerleg": {"{}_knee": 1.0},
    "foot": {"{}_ankle": 1.0},
    "toe": {"{}_ankle": 1.0},
}


def landmarks(base: Base) -> dict[str, Array]:
    """Joint centres (3,) in metres: the centres of MakeHuman's joint cubes, and two of our own."""
    points = {
        name: base.vertices[rows].mean(axis=0)
        for name, rows in base.vertex_groups.items()
        if name.startswith("joint-")
    }
    body = base.vertices[base.vertex_groups["body"]]
    points["skull-top"] = points["joint-head-2"].copy()
    points["skull-top"][1] = body[:, 1].max()
    # the root bone leads up into the pelvis from the front [thesis table 4.1]
    points["root"] = 2 * points["joint-pelvis"] - points["joint-spine-4"]
    for name, point in points.items():
        if not any(side in name for side in ("-l-", "-r-")):
            point[0] = 0.0
    return points


@dataclass(frozen=True)
class Bones:
    """names (B,), parents (B,) with -1 for the root, heads and tails (B, 3) in metres."""

    names: tuple[str, ...]
    parents: VertexIndices
    heads: Array
    tails: Array

    def index(self, name: str) -> int:
        """Index of a bone."""
        return self.names.index(name)


def make_bones(points: Mapping[str, Array]) -> Bones:
    """The 22 bones of [thesis table 4.1], at the joint centres of this body."""
    rows = list(TRUNK)
    for side in "lr":
        rows += [(n.format(side), p.format(side), h.format(side), t.format(side)) for n, p, h, t in SIDE]
    names = tuple(row[0] for row in rows)
    parents = np.array([-1 if parent is None else names.index(parent) for _, parent, _, _ in rows])
    return Bones(
        names, parents, np.array([points[row[2]] for row in rows]), np.array([points[row[3]] for row in rows])
    )


def bone_weights(source: MakeHumanData, bones: Bones, vertex_count: int) -> Array:
    """Weights of the artists summed per bone, dense (N, B); at most four per vertex, rows sum to one."""
    weights = np.zeros((vertex_count, len(bones.names)))
    for name, pairs in source.weights.items():
        if not pairs:
            continue
        prefix = max((p for p in WEIGHT_SHARES if name.startswith(p)), key=len)
        side = "l" if name.endswith(".L") else "r"
        rows = np.array(pairs)
        for bone, share in WEIGHT_SHARES[prefix].items():
            np.add.at(weights[:, bones.index(bone.format(side))], rows[:, 0].astype(int), share * rows[:, 1])
    weights[weights.sum(axis=1) == 0, bones.index("vt3")] = 1.0
    return limit_weights(weights)


def limit_weights(weights: Array) -> Array:
    """Limit weights (N, B) to four bones per vertex; rows sum to one."""
    # ties with the fifth are removed too, to keep left and right symmetric
    fifth = np.sort(weights, axis=1)[:, -BONES_PER_VERTEX - 1][:, None]
    weights = np.where((weights <= fifth) | (weights < 1e-3), 0.0, weights)
    return weights / weights.sum(axis=1, keepdims=True)


def smooth_weights(weights: Array, vertices: Array, faces: VertexIndices, reach: float) -> Array:
    """Smooth weights (N, B) along short edges, which motion would stretch to many times their length.

    Weights of the ends of an edge may differ so far that it stretches to about twice its length when bones
    move ``reach`` metres apart. Larger differences are reduced iteratively.

    Args:
        weights: (N, B).
        vertices: (N, 3) metres.
        faces: Quads (F, 4).
        reach: Distance in metres.
    """
    edges = np.unique(np.sort(np.concatenate([faces[:, [k, (k + 1) % 4]] for k in range(4)]), axis=1), axis=0)
    edges = edges[edges[:, 0] != edges[:, 1]]
    length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    allowed = 2.0 * length / reach
    weights = weights.copy()
    for _ in range(200):
        a, b = weights[edges[:, 0]], weights[edges[:, 1]]
        differ = np.abs(a - b).sum(axis=1) / 2
        bad = np.flatnonzero(differ > 1.02 * allowed)
        if not len(bad):
            break
        share = (0.5 * (1 - allowed[bad] / differ[bad]))[:, None]
        step, count = np.zeros_like(weights), np.zeros((len(weights), 1))
        np.add.at(step, edges[bad, 0], share * (b - a)[bad])
        np.add.at(step, edges[bad, 1], share * (a - b)[bad])
        np.add.at(count, edges[bad].ravel(), 1.0)
        weights += step / np.maximum(count, 1.0)
    return limit_weights(weights)


def t_pose(bones: Bones) -> tuple[Array, Bones]:
    """Transforms (B, 4, 4) of the bones from MakeHuman's A pose to the T pose, and the bones in the T pose.

    Arms and hands are along x with palms down, legs closer together with level feet.
    """
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
    heads, tails, motion = (
        bones.heads.copy(),
        bones.tails.copy(),
        np.tile(np.eye(4), (len(bones.names), 1, 1)),
    )
    for b, parent in enumerate(bones.parents):
        if parent >= 0:
            heads[b] = motion[parent, :3, :3] @ bones.heads[b] + motion[parent, :3, 3]
        tails[b] = heads[b] + turn[b] @ direction[b]
        motion[b, :3, :3] = turn[b]
        motion[b, :3, 3] = heads[b] - turn[b] @ bones.heads[b]
    return motion, Bones(bones.names, bones.parents, heads, tails)


def unskin(vertices: Array, weights: Array, motion: Array) -> Array:
    """Vertices (N, 3) that linear blend skinning with the inverse of ``motion`` moves to ``vertices``.

    So the A pose of the artists is reproduced exactly, without the errors of skinning twice.
    """
    back = np.einsum("nb,bij->nij", weights, np.linalg.inv(motion))
    homogeneous = np.c_[vertices, np.ones(len(vertices))]
    return np.linalg.solve(back, homogeneous[:, :, None])[:, :3, 0]
