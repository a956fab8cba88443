"""Read SMPL models, and convert skinned meshes (glTF, SMPL) to humans: body space, names of bones."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from humansim_ros.errors import MeshError, MotionError, located, warn_about
from humansim_ros.files.mesh import LARGEST, Mesh, SkinnedMesh, normalise_weights, padded
from humansim_ros.files.reading import read_npz
from humansim_ros.geometry import angle_between, rotation_vector_to_matrix, unit_vectors
from humansim_ros.motion.body import (
    DETAIL_BONES,
    SMPL_MODELS,
    Motion,
    Skeleton,
    dominant_bones,
    finger_bones,
    hanim_skeleton,
    limit_bones,
)
from humansim_ros.motion.matching import LIMBS, JointMatch, detect_file_frame, match_motion
from humansim_ros.motion.pose import finger_hinges
from humansim_ros.people.makehuman.skeleton import Bones
from humansim_ros.types import Array

_ARRAYS = ("v_template", "f", "weights", "kintree_table", "J_regressor", "J", "shapedirs", "vt", "ft")


def count_betas(path: str | os.PathLike[str]) -> int:
    """Number of betas that a model takes. 0 for other files, and for models with joints that do not follow
    betas. Raises MeshError if the file cannot be read."""
    if Path(path).suffix.lower() != ".npz":
        return 0
    arrays = read_npz(path, MeshError, "human", ("v_template", "shapedirs", "J_regressor"))
    directions, regressor = arrays.get("shapedirs"), arrays.get("J_regressor")
    if "v_template" not in arrays or directions is None or regressor is None or regressor.ndim != 2:
        return 0
    return int(directions.shape[2]) if directions.ndim == 3 else 0


def read_smpl(path: str | os.PathLike[str], betas: Sequence[float] = ()) -> SkinnedMesh:
    """Read a model in the rest pose with the shape ``betas``. Raises MeshError, which names the file and the
    array."""
    arrays = read_npz(path, MeshError, "SMPL", _ARRAYS)

    def get(name: str, *shape: int | None) -> NDArray[Any]:
        if name not in arrays:
            raise MeshError("not an SMPL model: an array is missing", path=path, key=name)
        array = arrays[name]
        wanted = tuple(m if n is None else n for n, m in zip(shape, array.shape, strict=False))
        if array.ndim != len(shape) or wanted != array.shape or array.dtype.kind not in "fiu":
            expected = ", ".join("?" if n is None else str(n) for n in shape)
            message = f"must be numbers ({expected}), not {array.shape} {array.dtype}"
            raise MeshError(message, path=path, key=name)
        if array.dtype.kind == "f" and not float(np.abs(array).max(initial=0)) <= LARGEST:
            message = f"a number is not finite (NaN or infinity), or beyond {LARGEST:g}"
            raise MeshError(message, path=path, key=name)
        return array

    vertices = get("v_template", None, 3).astype(float)
    if len(betas):
        directions = get("shapedirs", len(vertices), 3, None)
        if len(betas) > directions.shape[2]:
            message = f"{len(betas)} betas, the model has {directions.shape[2]}"
            raise MeshError(message, path=path, key="betas")
        vertices = vertices + directions[:, :, : len(betas)] @ np.asarray(betas, dtype=float)
    weights = get("weights", len(vertices), None).astype(float)
    n = weights.shape[1]
    table = get("kintree_table", 2, n).astype(np.int64)
    # the parent of the root is -1, or the largest unsigned integer
    parents = np.where((table[0] < 0) | (table[0] >= n), -1, table[0]).astype(np.intp)
    if n not in SMPL_MODELS:
        raise MeshError(f"{n} joints; SMPL has 24, SMPL+H 52, SMPL-X 55", path=path, key="kintree_table")
    if not (parents < np.arange(n)).all() or (parents < 0).sum() != 1:
        raise MeshError("a joint's parent must come before it", path=path, key="kintree_table")
    # joints of the shape, or of the template if the file has no regressor
    by_shape = "J_regressor" in arrays and arrays["J_regressor"].ndim == 2
    joints = get("J_regressor", n, len(vertices)) @ vertices if by_shape else get("J", n, 3)
    if not by_shape and len(betas):
        raise MeshError("betas need the joint regressor as a plain array", path=path, key="J_regressor")
    faces = get("f", None, 3).astype(np.int64)
    if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise MeshError(f"a face uses a vertex outside 0..{len(vertices) - 1}", path=path, key="f")
    mesh = Mesh(vertices, padded(faces))
    if "vt" in arrays and "ft" in arrays:
        uv, corners = get("vt", None, 2).astype(float), get("ft", len(faces), 3)
        mesh = Mesh(vertices, mesh.faces, uv, padded(corners))
    with located(path=path, key="weights"):
        limited = limit_bones(normalise_weights(csr_matrix(weights)))
    return SkinnedMesh(Path(path).stem, mesh, SMPL_MODELS[n], parents, joints.astype(float), limited)


#: Range of plausible statures, metres. A mesh of another size has another unit.
PLAUSIBLE_STATURE = (0.4, 2.6)
#: Length that is assumed for a bone without a child or skin, metres.
_STUB = 0.03
#: Bones of the trunk, from below. A bone points to the next one, through all joints between them.
_TRUNK = ("HumanoidRoot", "sacroiliac", "vl5", "vt3")
#: Directions of chest and head in the rest pose: degrees forwards from straight up, and most degrees from
#: that direction. Motions turn these bones along their own links, which rise like the bones of the built-in
#: bodies. A bone with another direction would stoop or look up.
_UPRIGHT = {"vl5": (5.0, 7.0), "vt3": (7.5, 7.0)}
#: The skin of the head's joint is the head (without hats) if its height is at least this share of the height
#: of everything that the joint carries.
_SKULL = 0.5
#: Largest distance of a foot from the end of its shin, as a share of the length of the thigh. The same holds
#: for a hand.
_FOOT_GAP = 0.25
_HAND = re.compile(r"hand|wrist|palm|fist", re.IGNORECASE)
#: Bones at the ends of limbs. If such a bone has no joint, it begins where the previous bone ends.
_ENDS = ("l_wrist", "r_wrist", "l_ankle", "r_ankle")

#: Directions of bones without a child that do not continue their parent.
_ALONG = {
    **dict.fromkeys(("l_ankle", "r_ankle", "l_metatarsal", "r_metatarsal"), (0.0, 0.0, 1.0)),
    **dict.fromkeys(("l_eyeball_joint", "r_eyeball_joint"), (0.0, 0.0, 1.0)),
    "temporomandibular": (0.0, -0.6, 0.8),
    "vt3": (0.0, 1.0, 0.0),
}


def to_body_space(
    figure: SkinnedMesh, unit: float | None = None, up: str | None = None, facing: str | None = None
) -> tuple[Mesh, Skeleton, csr_matrix]:
    """Move a skinned mesh into body space, and name its bones as in the general skeleton.

    Joints are matched by name and hierarchy, or by the shape of the skeleton. Fingers, toes, jaw and eyes are
    matched by name. Other joints keep their names. Bones of the general skeleton without a joint are inserted
    without skin.

    Args:
        figure: Skinned mesh of a person.
        unit: Metres per unit of the file. If None, it is guessed from the stature.
        up: Up axis of the file. If None, it is detected.
        facing: Axis of the file that the person faces. If None, it is detected.

    Returns:
        Mesh in body space (metres, y up, facing +z, soles at height 0), skeleton, and weights (V, B).

    Raises:
        MeshError: The skeleton is not a person standing upright.
    """
    rest = _rest_motion(figure)
    try:
        match = match_motion(rest)
        attached = _attach_ends(figure, match)
        if attached is not None:
            figure, rest = attached, _rest_motion(attached)
            match = match_motion(rest)
        if match.warning is not None:
            warn_about(figure.name, f"{match.warning}. Look at the result (docs/humans.md)")
        frame = detect_file_frame(rest, match, unit, up, facing)
    except MotionError as error:
        raise MeshError(f"the skeleton is not a person's: {error.message}") from None
    if frame.rest_from_body.ndim != 2:
        raise MeshError("the rest pose does not stand upright: export the mesh in a T or A pose")
    stature = float(np.ptp(figure.mesh.vertices @ frame.rest_from_body[:, 1]))
    scale = 1.0 if unit is None else unit
    if unit is None and not PLAUSIBLE_STATURE[0] <= stature <= PLAUSIBLE_STATURE[1]:
        scale = frame.unit
        known = frame.unit_name != "unknown"
        assumed = f"{frame.unit_name} assumed" if known else "no unit gives the height of a person"
        warn_about(
            figure.name,
            f"the person is {stature:.3g} units tall: {assumed}, made {stature * scale:.2f} m tall. "
            "If that is wrong, give 'stature' or 'unit' in a description (docs/humans.md)",
        )
    vertices = scale * figure.mesh.vertices @ frame.rest_from_body
    joints = scale * figure.joints @ frame.rest_from_body
    hips = joints[[match.roles["LeftHip"], match.roles["RightHip"]]].mean(0)
    origin = np.array([hips[0], vertices[:, 1].min(), hips[2]])
    vertices, joints = vertices - origin, joints - origin
    skeleton, bones = _skeleton(figure, match, joints, vertices)
    columns = np.array(bones)
    weights = csr_matrix(
        (figure.weights.data, columns[figure.weights.indices], figure.weights.indptr),
        shape=(len(vertices), len(skeleton)),
    )
    return replace(figure.mesh, vertices=vertices), skeleton, limit_bones(weights)


def _attach_ends(figure: SkinnedMesh, match: JointMatch) -> SkinnedMesh | None:
    """Return a figure with feet and hands that follow their limbs, where these are children of the root.
    Returns None if every foot and hand is attached to its limb already."""
    heaviest, parents = dominant_bones(figure.weights), np.array(figure.parents)
    for side, (upper, lower, last) in product(("Left", "Right"), LIMBS):
        hip, knee = (match.roles.get(side + part) for part in (upper, lower))
        if side + last in match.roles or hip is None or knee is None:
            continue
        below = np.flatnonzero(figure.parents == knee)
        skin = figure.mesh.vertices[heaviest == knee]
        if len(below) == 1:
            end = figure.joints[below[0]]
        elif len(skin):
            end = skin[np.argmax(np.linalg.norm(skin - figure.joints[hip], axis=1))]
        else:
            continue
        gaps = np.linalg.norm(figure.joints - end, axis=1)
        apart = [joint for joint in np.unique(heaviest) if not _descends(joint, hip, figure.parents)]
        if last == "Wrist":  # clothes may be near a hand
            apart = [joint for joint in apart if _HAND.search(figure.joint_names[joint])]
        foot = min(apart, key=lambda joint: gaps[joint], default=None)
        thigh = float(np.linalg.norm(figure.joints[knee] - figure.joints[hip]))
        if foot is not None and gaps[foot] < _FOOT_GAP * thigh and not _descends(knee, foot, figure.parents):
            parents[foot] = knee
    if (parents == figure.parents).all():
        return None
    order = sorted(range(len(parents)), key=lambda joint: _depth(joint, parents))  # parents come first
    place = np.argsort(order)
    return replace(
        figure,
        joint_names=tuple(figure.joint_names[joint] for joint in order),
        parents=np.array([place[parents[j]] if parents[j] >= 0 else -1 for j in order], dtype=np.intp),
        joints=figure.joints[order],
        weights=csr_matrix(figure.weights[:, order]),
    )


def _descends(joint: int, ancestor: int, parents: NDArray[np.intp]) -> bool:
    while joint >= 0 and joint != ancestor:
        joint = int(parents[joint])
    return joint == ancestor


def _depth(joint: int, parents: NDArray[np.intp]) -> int:
    depth = 0
    while parents[joint] >= 0:
        joint, depth = int(parents[joint]), depth + 1
    return depth


def _rest_motion(figure: SkinnedMesh) -> Motion:
    """The skeleton of a skinned mesh as a motion of one frame in the rest pose."""
    parents = figure.parents
    offsets = figure.joints - np.where((parents < 0)[:, None], 0.0, figure.joints[parents])
    no_channels: tuple[tuple[str, ...], ...] = ((),) * len(figure.joint_names)
    return Motion(figure.joint_names, parents, offsets, no_channels, np.zeros((1, 0)), 1.0)


def joints_of_bones(match: JointMatch) -> dict[str, int]:
    """Bone -> joint at its head, for general bones. A joint occurs once, for the bone nearest the root."""
    skeleton = hanim_skeleton()
    joints: dict[str, int] = {}
    for bone in skeleton.names:
        joint = match.parallel[bone][0] if bone in match.parallel else match.difference.get(bone)
        if joint is not None and joint not in joints.values():
            joints[bone] = joint
    return joints


def _details(figure: SkinnedMesh, match: JointMatch, matched: Mapping[str, int]) -> dict[str, int]:
    """Joint at the head of each bone of fingers, toes, jaw and eyes, if it is below hand, foot or head.
    ``matched``: joints of the general bones."""
    joints: dict[str, int] = {}
    for bone, above in DETAIL_BONES.items():  # the bone above comes first
        joint = match.details.get(bone, (-1,))[0]
        over = joints.get(above, matched.get(above))
        taken = (*matched.values(), *joints.values())
        if joint >= 0 and joint not in taken and over is not None and _descends(joint, over, figure.parents):
            joints[bone] = joint
    return joints


def _skeleton(
    figure: SkinnedMesh, match: JointMatch, joints: Array, vertices: Array
) -> tuple[Skeleton, list[int]]:
    """Skeleton with the bone names of the general skeleton, and the bone of each joint.

    ``joints``: (J, 3), ``vertices``: (V, 3) metres in body space.
    """
    general = hanim_skeleton()
    parent_of = {
        n: general.names[p] if p >= 0 else None for n, p in zip(general.names, general.parents, strict=True)
    }
    matched = joints_of_bones(match)
    details = _details(figure, match, matched)
    bone_of = {joint: bone for bone, joint in matched.items()}
    detail_of = {joint: bone for bone, joint in details.items()}
    taken = {*general.names, *details}
    body = _Body(figure, match, joints, vertices)
    for joint in range(len(joints)):
        above = body.name_of[int(figure.parents[joint])] if figure.parents[joint] >= 0 else None
        bone = bone_of.get(joint)
        if bone is None:
            bone = detail_of.get(joint) or _unique_name(figure.joint_names[joint], taken)
        else:
            # bones of the general skeleton on the way to this one that have no joint
            chain: list[str] = []
            ancestor = parent_of[bone]
            while ancestor is not None and ancestor not in matched and ancestor not in body.names:
                chain.insert(0, ancestor)
                ancestor = parent_of[ancestor]
            start = body.head(above) if above is not None else joints[joint] - [0.0, _STUB, 0.0]
            for step, name in enumerate(chain):
                share = step / len(chain)
                body.add(name, above, (1 - share) * start + share * joints[joint])
                above = name
        body.add(bone, above, joints[joint])
        body.name_of[joint] = bone
    for name in general.names:  # remaining bones, which have no joints
        if name not in body.names:
            parent = parent_of[name]
            body.add(name, parent, body.head(parent) if parent is not None else joints[0])
    names, tails = body.names, body.tails()
    numbers = np.array([-1 if p is None else names.index(p) for p in body.parents])
    bones = Bones(tuple(names), numbers, np.array(body.heads), tails, _hinges(names, body.heads, tails))
    rolls = np.where(bones.hinges.any(axis=1), bones.rolls, 0.0)
    skeleton = Skeleton(bones.names, bones.parents, bones.heads, tails, rolls)
    return skeleton, [names.index(body.name_of[joint]) for joint in range(len(joints))]


def _hinges(names: list[str], heads: list[Array], tails: Array) -> Array:
    """Axes (B, 3) about which fingers flex and toes bend down. Zero for other bones."""
    hinges = np.zeros((len(names), 3))
    for side in "lr":
        bones = {name: names.index(name) for name in finger_bones(side) if name in names}
        ends = {name: (heads[bone], tails[bone]) for name, bone in bones.items()}
        if ends:
            for name, axis in finger_hinges(side, ends, heads[names.index(f"{side}_wrist")]).items():
                hinges[bones[name]] = axis
        if (toes := f"{side}_metatarsal") in names:
            bone = names.index(toes)
            hinges[bone] = unit_vectors(np.cross([0.0, 1.0, 0.0], tails[bone] - heads[bone]))
    return hinges


class _Body:
    """Bones of a skinned mesh while they are made. ``joints``: (J, 3), ``vertices``: (V, 3) metres in body
    space. The lists have an entry for each bone. ``name_of``: bone of each joint."""

    def __init__(self, figure: SkinnedMesh, match: JointMatch, joints: Array, vertices: Array) -> None:
        self.figure, self.match, self.joints, self.vertices = figure, match, joints, vertices
        self.names: list[str] = []
        self.parents: list[str | None] = []
        self.heads: list[Array] = []
        self.name_of: dict[int, str] = {}
        #: (V,) joint that each vertex follows most.
        self.heaviest = dominant_bones(figure.weights)

    def add(self, name: str, parent: str | None, head: Array) -> None:
        self.names.append(name)
        self.parents.append(parent)
        self.heads.append(np.asarray(head))

    def head(self, name: str) -> Array:
        return self.heads[self.names.index(name)]

    def tails(self) -> Array:
        """Tails (B, 3) of the bones.

        A tail is at the end of the link, at the only child (or the next bone of the general skeleton), or at
        the end of the skin. The chest points to the head's joint, the head to the top of the head. Both are
        nearly upright.
        """
        joint_of = {name: joint for joint, name in self.name_of.items()}
        tails = np.array(self.heads)
        for number, name in enumerate(self.names):
            parent = self.parents[number]
            if name in _ENDS and name not in joint_of and parent is not None:
                self.heads[number] = tails[self.names.index(parent)]
            head, joint = self.heads[number], joint_of.get(name)
            children = [i for i, parent in enumerate(self.parents) if parent == name]
            goal = self._goal(name, head, children, joint_of)
            if np.linalg.norm(goal - head) < 1e-3:
                along = _along(number, self.names, self.parents, self.heads)
                skin = self.vertices[self.heaviest == joint] if joint is not None else self.vertices[:0]
                reach = (skin - head) @ along
                far = skin[reach >= 0.9 * reach.max(initial=0.0)]
                goal = far.mean(0) if reach.max(initial=0.0) > _STUB else head + _STUB * along
            elif children and name in ("l_wrist", "r_wrist") and joint is not None:
                goal = head + (goal - head) * self._hand_reach(joint, head, goal)
            tails[number] = head + _upright(name, goal - head)
        return tails

    def _goal(self, name: str, head: Array, children: list[int], joint_of: Mapping[str, int]) -> Array:
        """Point (3,) towards which a bone is directed. If nothing shows the direction, the head (3,) of the
        bone. ``children``: bones below this bone."""
        names, links = self.names, {**self.match.details, **self.match.parallel}
        if name == "vt3":
            return self._top_of_head(joint_of.get(name), head)
        if name in links and joint_of.get(name) == links[name][0]:
            return np.asarray(self.joints[links[name][1]])
        if name in _TRUNK:
            return self.head(_TRUNK[_TRUNK.index(name) + 1])
        general = hanim_skeleton().names
        named = [i for i in children if names[i] in general]
        # a hand or a foot without a joint has no place in the file
        placed = [i for i in children if names[i] not in _ENDS or names[i] in joint_of]
        if len(children) > len(named):
            named = [i for i in named if i in placed]
        if len(named) == 1:
            return self.heads[named[0]]
        chosen = named or placed or children
        return np.asarray(np.mean([self.heads[i] for i in chosen], axis=0)) if chosen else head

    def _hand_reach(self, joint: int, head: Array, goal: Array) -> float:
        """Length of a hand with fingers, as a multiple (at least 1) of the distance from the wrist ``head``
        (3,) to the point ``goal`` (3,) of the knuckles. ``joint``: joint of the hand."""
        parents = self.figure.parents
        hand = [number for number in range(len(parents)) if _descends(number, joint, parents)]
        skin, along = self.vertices[np.isin(self.heaviest, hand)], goal - head
        length = float(along @ along)
        return max(1.0, float(((skin - head) @ along).max(initial=0.0)) / length)

    def _top_of_head(self, joint: int | None, head: Array) -> Array:
        """Top of the head (3,): the joint at this place, or else a point at the height of the top of the
        skin. Joints of eyes, hair and hats may lie on any side of the head, so they do not show its
        direction. ``joint``: joint of the head. ``head``: (3,) lower end of the bone of the head."""
        top = self.match.roles.get("HeadTop")
        if top is not None and self.joints[top, 1] > head[1] + _STUB:
            return np.asarray(self.joints[top])
        if joint is None:
            return head
        parents = self.figure.parents
        carried = np.array([_descends(number, joint, parents) for number in range(len(parents))])
        own, all_ = (
            float((self.vertices[skin, 1] - head[1]).max(initial=0.0))
            for skin in (self.heaviest == joint, carried[self.heaviest])
        )
        height = own if own >= _SKULL * all_ else all_
        return head + height * _direction(_UPRIGHT["vt3"][0]) if height > _STUB else head


def _direction(degrees: float) -> Array:
    """Unit vector (3,), ``degrees`` forwards from straight up."""
    return np.array([0.0, np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])


def _upright(name: str, along: Array) -> Array:
    """Return the direction ``along`` (3,) of a bone. For chest and head, turn it until it is as upright as in
    a standing person (:data:`_UPRIGHT`)."""
    if name not in _UPRIGHT:
        return along
    lean, most = _UPRIGHT[name]
    typical, length = _direction(lean), float(np.linalg.norm(along))
    excess = float(angle_between(along, typical)) - np.radians(most)
    if excess <= 0:
        return along
    axis = unit_vectors(np.cross(along, typical))
    return np.asarray(rotation_vector_to_matrix(excess * axis) @ along) if length else along


def _along(number: int, names: list[str], parents: list[str | None], heads: list[Array]) -> Array:
    """Unit direction (3,) of a bone without a child: from :data:`_ALONG`, or else that of the parent bone."""
    if names[number] in _ALONG:
        return np.array(_ALONG[names[number]])
    parent = parents[number]
    while parent is not None:
        step = heads[number] - heads[names.index(parent)]
        length = float(np.linalg.norm(step))
        if length > 1e-3:
            return np.asarray(step / length)
        parent = parents[names.index(parent)]
    return np.array([0.0, 1.0, 0.0])


def _unique_name(name: str, taken: set[str]) -> str:
    """Make a bone name unique."""
    base = name or "joint"
    unique, number = base, 0
    while unique in taken:
        number += 1
        unique = f"{base}.{number:03d}"
    taken.add(unique)
    return unique
