"""The model that is fitted: keypoints of a body as a function of pose and proportions, with derivatives."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from humansim_ros.errors import MotionError
from humansim_ros.geometry import (
    matrix_to_quaternion,
    quaternion_to_matrix,
    rotation_vector_to_matrix,
    transform,
)
from humansim_ros.motion.body import Skeleton, side_of
from humansim_ros.motion.pose import JointLimits, load_limits
from humansim_ros.people.humans import Human
from humansim_ros.people.keypoints import KeypointLocator, KeypointSet
from humansim_ros.photographs.person_fit import Proportions
from humansim_ros.types import Array, Indices

#: Bones that share one factor of length, by bone names without the side.
_GROUPS = {
    "HumanoidRoot": "pelvis",
    "HumanoidRoot_to_hip": "pelvis",
    "sacroiliac": "spine",
    "vl5": "spine",
    "vl5_to_sternoclavicular": "collar",
    "sternoclavicular": "collar",
}

#: Weight of points of the skin. It is small because bodies differ there by more than the usual noise of
#: points.
_SKIN = 0.25


@dataclass(frozen=True)
class BodyState:
    """Pose and proportions as the numbers that are fitted.

    Attributes:
        position: (3,) place of the head of the first bone in ``map``, metres.
        root: (3, 3) rotation of body space in ``map``.
        vectors: (B, 3) rotation vectors of the bones. The vector of the first bone is zero.
        stature: Logarithm of the factor of the whole body.
        lengths: (G,) logarithms of the factors along the bones, by length group.
        girths: (D,) logarithms of the factors across the bones, by girth group.
    """

    position: Array
    root: Array
    vectors: Array
    stature: float
    lengths: Array
    girths: Array

    @property
    def shape(self) -> Array:
        """Numbers (1 + G + D) of the proportions: stature, lengths, girths."""
        return np.r_[self.stature, self.lengths, self.girths]


@dataclass(frozen=True, eq=False)
class Attachments:
    """N points of a body that move with its bones. ``shares``: (N, B) weights of the bones; each row sums to
    one. ``local``: (N, B, 3) points times their weights, in the frames of the bones in the rest pose."""

    shares: Array
    local: Array

    @classmethod
    def of_vertices(cls, human: Human, vertices: Indices) -> Attachments:
        """Attach vertices of the mesh of a human, given by their numbers (N,)."""
        rest = human.skeleton.rest_inverse
        shares = human.weights[vertices].toarray()
        at = np.einsum("bij,nj->nbi", rest[:, :3, :3], human.mesh.vertices[vertices]) + rest[:, :3, 3]
        return cls(shares, shares[..., None] * at)


class PoseModel:
    """Keypoints of a human with 6 + 3 (B - 1) pose numbers and 1 + G + D numbers of proportions.

    The order of the numbers is: position (3), rotation of the root as a rotation vector in its own axes (3),
    rotation vectors of the other bones (3 (B - 1)), stature (1), lengths (G), girths (D).

    Attributes:
        skeleton: Skeleton of the human.
        groups: Names of the G groups of bones. Bones of a group share one factor of length.
        group_of: (B,) number of the group of each bone.
        girths: Names of the D girth groups. The left and the right bone of a group share one factor of girth.
        girth_of: (B,) number of the girth group of each bone.
        trust: (K,) how much each keypoint counts. Keypoints on the skin count less.
    """

    def __init__(self, human: Human, keypoints: KeypointSet, base: Proportions | None = None) -> None:
        """Make a model. ``base``: betas and offsets that ``human`` already has."""
        self.base = base or Proportions()
        self.keypoint_set = keypoints
        self.skeleton = human.skeleton
        names = [_group(name) for name in self.skeleton.names]
        self.groups = tuple(dict.fromkeys(names))
        self.group_of = np.array([self.groups.index(name) for name in names])
        plain = [plain_name(name) for name in self.skeleton.names]
        self.girths = tuple(dict.fromkeys(plain))
        self.girth_of = np.array([self.girths.index(name) for name in plain])
        self._points = _attachments(human, keypoints)
        self.trust = np.where(KeypointLocator.of(human, keypoints).on_surface, _SKIN, 1.0)
        self._rest = self.skeleton.rest_in_parent

    @cached_property
    def limits(self) -> JointLimits | None:
        """Joint limits of the skeleton; None if the table of limits has none of its bones."""
        try:
            return load_limits(None, self.skeleton)
        except MotionError:
            return None

    @cached_property
    def on_trunk(self) -> NDArray[np.bool_]:
        """(K,) whether the keypoint stays in place on the trunk when limbs move. If no keypoint does, all are
        True."""
        names, parents = self.skeleton.names, self.skeleton.parents
        trunk = np.array([side_of(name) == 0 or _group(name) in _GROUPS.values() for name in names])
        # the head of the first bone of a limb is a point of the trunk
        fixed = trunk | (trunk[np.maximum(parents, 0)] & (np.abs(self._points.local).max(axis=2) < 1e-9))
        found = (fixed | (np.abs(self._points.shares) < 1e-9)).all(axis=1)
        return found if found.sum() >= 3 else np.ones(len(found), bool)

    def shown(self, keypoints: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Return masks of the bones (B,) and of the length groups (G,): those with a rotation or length that
        the keypoints of the mask (K,) determine."""
        slopes = np.abs(self.derivatives(self.neutral())[1][keypoints]).max(axis=(0, 1), initial=0.0) > 1e-6
        turns = slopes[3 : self.pose_size].reshape(-1, 3).any(axis=1)
        return turns, slopes[self.pose_size + 1 :][: len(self.groups)]

    @property
    def pose_size(self) -> int:
        """How many pose numbers there are: 6 + 3 (B - 1)."""
        return 3 + 3 * len(self.skeleton)

    @property
    def size(self) -> int:
        """How many numbers there are, pose and proportions."""
        return self.pose_size + 1 + len(self.groups) + len(self.girths)

    def neutral(self) -> BodyState:
        """The rest pose at the origin of ``map``."""
        shape = 0.0, np.zeros(len(self.groups)), np.zeros(len(self.girths))
        return BodyState(np.zeros(3), np.eye(3), np.zeros((len(self.skeleton), 3)), *shape)

    def moved(self, state: BodyState, step: Array) -> BodyState:
        """Return the state after a ``step`` (size,) is added to its numbers."""
        bones = 3 * len(self.skeleton)
        vectors = state.vectors.copy()
        vectors[1:] += step[6 : 3 + bones].reshape(-1, 3)
        lengths, girths = np.split(step[self.pose_size + 1 :], [len(self.groups)])
        stature = state.stature + float(step[self.pose_size])
        root = state.root @ rotation_vector_to_matrix(step[3:6])
        shape = stature, state.lengths + lengths, state.girths + girths
        return BodyState(state.position + step[:3], root, vectors, *shape)

    def keypoints(self, state: BodyState) -> Array:
        """Positions (K, 3) of the keypoints in ``map``."""
        return self.positions(state, self._points)

    def positions(self, state: BodyState, points: Attachments) -> Array:
        """Positions (N, 3) of points in ``map``."""
        return self._evaluate(state, points).positions

    def derivatives(self, state: BodyState, points: Attachments | None = None) -> tuple[Array, Array]:
        """Positions (N, 3) of points, and derivatives (N, 3, size) of the positions by a step of the numbers.
        If ``points`` is None, the keypoints are used."""
        points = self._points if points is None else points
        body = self._evaluate(state, points)
        count = len(body.positions)
        slopes = np.zeros((count, 3, self.size))
        slopes[:, :, :3] = np.eye(3)
        # for each bone: sums over the bones of its subtree of the parts of the keypoints that these bones
        # carry
        mass, moment = points.shares.copy(), body.parts.copy()
        stretched = body.parts - mass[..., None] * body.origins
        along = points.local[..., 1, None] * (body.axes[:, :, 1] * body.scales[:, 1, None])
        parents = self.skeleton.parents
        for bone in range(len(parents) - 1, 0, -1):
            parent = parents[bone]
            mass[:, parent] += mass[:, bone]
            moment[:, parent] += moment[:, bone]
        for bone in range(1, len(parents)):
            parent = parents[bone]
            offset = self._rest[bone, :3, 3]
            arm = body.axes[parent] @ (body.scales[parent] * offset)
            stretched[:, parent] += mass[:, bone, None] * arm
            along_arm = body.axes[parent][:, 1] * (body.scales[parent, 1] * offset[1])
            along[:, parent] += mass[:, bone, None] * along_arm
        levers = moment - mass[..., None] * body.origins
        turns = body.turns
        turning = -np.matmul(_skew(levers), turns)  # e x v = -[v] e
        slopes[:, :, 3:6] = turning[:, 0]
        bones = len(parents)
        slopes[:, :, 6 : 3 + 3 * bones] = np.moveaxis(turning[:, 1:], 1, 2).reshape(count, 3, -1)
        slopes[:, :, self.pose_size] = stretched.sum(axis=1)
        first = self.pose_size + 1
        for group in range(len(self.groups)):
            slopes[:, :, first + group] = along[:, self.group_of == group].sum(axis=1)
        across, first = stretched - along, first + len(self.groups)
        for group in range(len(self.girths)):
            slopes[:, :, first + group] = across[:, self.girth_of == group].sum(axis=1)
        return body.positions, slopes

    def state(self, proportions: Proportions, root: Array, rotations: Array, body: Skeleton) -> BodyState:
        """Compute the state of a body in a pose.

        Args:
            proportions: Proportions of the body. Lengths and girths of a group are averaged.
            root: (4, 4) transform from body space to ``map``.
            rotations: (B, 4) quaternions xyzw of the bones.
            body: Skeleton in these proportions.
        """
        names = self.skeleton.names
        lengths = np.log([proportions.lengths.get(name, 1.0) for name in names])
        girths = np.log([proportions.girths.get(name, 1.0) for name in names])
        first = quaternion_to_matrix(rotations[0])
        rest = self._rest[0, :3, :3]
        return BodyState(
            root[:3, :3] @ body.heads[0] + root[:3, 3],
            root[:3, :3] @ rest @ first @ rest.T,
            np.vstack([np.zeros(3), Rotation.from_quat(rotations[1:]).as_rotvec()]),
            float(np.log(proportions.stature)),
            np.bincount(self.group_of, lengths) / np.bincount(self.group_of),
            np.bincount(self.girth_of, girths) / np.bincount(self.girth_of),
        )

    def proportions(self, state: BodyState) -> Proportions:
        """Convert a state to the proportions of a person."""
        factors = (np.exp(state.lengths)[self.group_of], np.exp(state.girths)[self.girth_of])
        names = self.skeleton.names
        lengths, girths = (
            {name: float(each) for name, each in zip(names, own, strict=True) if abs(each - 1) > 1e-6}
            for own in factors
        )
        return replace(self.base, stature=float(np.exp(state.stature)), lengths=lengths, girths=girths)

    def rotations(self, state: BodyState) -> Array:
        """Quaternions (B, 4) xyzw of the bones."""
        return matrix_to_quaternion(rotation_vector_to_matrix(state.vectors))

    def root(self, state: BodyState, body: Skeleton) -> Array:
        """Transform (4, 4) from body space to ``map``. ``body``: the skeleton in these proportions."""
        return transform(state.root, state.position - state.root @ body.heads[0])

    def _evaluate(self, state: BodyState, points: Attachments) -> _Body:
        bones = len(self.skeleton)
        scales = np.full((bones, 3), np.exp(state.stature))
        scales[:, 1] *= np.exp(state.lengths)[self.group_of]
        scales[:, [0, 2]] *= np.exp(state.girths)[self.girth_of, None]
        own = rotation_vector_to_matrix(state.vectors)
        axes, origins = np.empty((bones, 3, 3)), np.empty((bones, 3))
        axes[0] = state.root @ self._rest[0, :3, :3]
        origins[0] = state.position
        for bone, parent in enumerate(self.skeleton.parents.tolist()):
            if bone:
                axes[bone] = axes[parent] @ self._rest[bone, :3, :3] @ own[bone]
                origins[bone] = origins[parent] + axes[parent] @ (scales[parent] * self._rest[bone, :3, 3])
        turns = axes @ _right_jacobians(state.vectors)
        turns[0] = state.root  # the step of the root turns about the axes of body space
        parts = points.shares[..., None] * origins
        parts += np.einsum("bij,kbj->kbi", axes * scales[:, None], points.local)
        return _Body(axes, origins, scales, turns, parts)


@dataclass(frozen=True)
class _Body:
    """Posed bones, in ``map``. ``axes``: (B, 3, 3). ``origins``: (B, 3). ``scales``: (B, 3). ``turns``: (B,
    3, 3), how a step of the numbers of a bone rotates the bone and all bones below. ``parts``: (K, B, 3)
    weighted points of each bone. Their sum over the bones is the keypoint."""

    axes: Array
    origins: Array
    scales: Array
    turns: Array
    parts: Array

    @cached_property
    def positions(self) -> Array:
        """Positions (K, 3) of the keypoints."""
        return np.asarray(self.parts.sum(axis=1))


def plain_name(bone: str) -> str:
    """Name of a bone without its side."""
    return bone.replace("_l_", "_").replace("_r_", "_").removeprefix("l_").removeprefix("r_")


def _group(bone: str) -> str:
    return _GROUPS.get(plain_name(bone), plain_name(bone))


def _attachments(human: Human, keypoints: KeypointSet) -> Attachments:
    """Attach the K keypoints to the bones, so that they move with the bones."""
    skeleton, locator = human.skeleton, KeypointLocator.of(human, keypoints)
    rest, bones = skeleton.rest_inverse, skeleton.joint_bones
    ends = skeleton.joint_transforms(skeleton.rest)[:, :3, 3]
    at = np.einsum("jik,jk->ji", rest[bones, :3, :3], ends) + rest[bones, :3, 3]
    mass, local = np.zeros((len(keypoints), len(skeleton))), np.zeros((len(keypoints), len(skeleton), 3))
    for joint, bone in enumerate(bones):
        mass[:, bone] += locator.joint_shares[:, joint]
        local[:, bone] += locator.joint_shares[:, joint, None] * at[joint]
    corners, weights = Attachments.of_vertices(human, locator.corners.ravel()), locator.corner_weights
    shares, moments = (
        each.reshape(*weights.shape, *each.shape[1:]) for each in (corners.shares, corners.local)
    )
    mass[locator.on_surface] = np.einsum("nk,nkb->nb", weights, shares)
    local[locator.on_surface] = np.einsum("nk,nkbi->nbi", weights, moments)
    return Attachments(mass, local)


def _skew(vectors: Array) -> Array:
    """Matrices (..., 3, 3) of the cross product with vectors (..., 3)."""
    out = np.zeros((*vectors.shape, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[..., i, j], out[..., j, i] = -vectors[..., k], vectors[..., k]
    return out


def _right_jacobians(vectors: NDArray[np.float64]) -> Array:
    """Right Jacobians (..., 3, 3) of the exponential map: exp(v + d) = exp(v) exp(J d) [Sola 2018]."""
    angle = np.linalg.norm(vectors, axis=-1)[..., None, None]
    skew = _skew(vectors)
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    first = np.where(small, 0.5, (1 - np.cos(safe)) / safe**2)
    second = np.where(small, 1 / 6, (safe - np.sin(safe)) / safe**3)
    return np.asarray(np.eye(3) - first * skew + second * (skew @ skew))
