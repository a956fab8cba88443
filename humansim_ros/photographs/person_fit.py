"""A person in photographs: proportions and fitted poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, cholesky
from scipy.spatial.distance import cdist

from humansim_ros.errors import MeshError
from humansim_ros.files.mesh import Mesh, mean_normals
from humansim_ros.files.reading import find_asset
from humansim_ros.motion.body import Motion, Skeleton
from humansim_ros.motion.files import PosedBones
from humansim_ros.people.humans import Human
from humansim_ros.people.loading import MeshHuman, count_betas, load_human, make_human
from humansim_ros.types import Array, Float32Array, Indices

#: Smallest and largest factor of the proportions.
SMALLEST, LARGEST = 0.2, 5.0
#: Greatest offset of the surface, metres.
GREATEST_OFFSET = 0.08
#: Most betas that are fitted: the first ones of a model matter most.
MOST = 10
#: Standard deviation of a vertex about its place in the model, metres; and number of vertices that count as
#: independent.
_NOISE, _INDEPENDENT = 0.01, 200
#: Offsets of the surface are alike for points within this share of the height, and within this difference of
#: unit normals.
_REACH, _TURN = 0.02, 1.0
#: Most controls of the offsets of a surface; and number of vertices that are computed at once.
MOST_CONTROLS, _CHUNK = 1000, 20_000


@dataclass(frozen=True)
class Proportions:
    """Proportions relative to a human.

    Attributes:
        stature: Factor of the whole body.
        lengths: Factor along each bone, by name of the bone. The factor of an absent bone is 1.
        girths: Factor across each bone, by name of the bone. The factor of an absent bone is 1.
        shape: Betas of the human if the human is an SMPL model.
        offsets: Metres by which the surface moves outwards at the controls of :class:`SurfaceOffsets`, before
            the factors are applied. Offsets describe clothes, hair and what factors cannot. If empty, there
            are no offsets.
    """

    stature: float = 1.0
    lengths: Mapping[str, float] = field(default_factory=dict)
    girths: Mapping[str, float] = field(default_factory=dict)
    shape: tuple[float, ...] = ()
    offsets: tuple[float, ...] = ()

    def scales(self, skeleton: Skeleton) -> Array:
        """Factors (B, 3) along the axes of the bone frames. The y axis is along the bone.

        Raises:
            MeshError: A name is not a bone, or a factor is not between SMALLEST and LARGEST.
        """
        scales = np.ones((len(skeleton), 3))
        for factors, axes in ((self.lengths, [1]), (self.girths, [0, 2])):
            for name, factor in factors.items():
                scales[skeleton.bone(name), axes] = factor
        scales *= self.stature
        if not ((scales >= SMALLEST) & (scales <= LARGEST)).all():  # False for NaN, too
            raise MeshError(f"a factor of the proportions is not between {SMALLEST:g} and {LARGEST:g}")
        return scales


def with_proportions(human: Human, proportions: Proportions) -> Human:
    """Return a human in other proportions. The human already has betas and offsets. Its soles stay where they
    are.

    A bone scales the vertices near it about its head: v' = sum_b w_b (h'_b + R_b S_b R_b^T (v - h_b)). So the
    skin stays smooth where it stretches.

    Raises:
        MeshError: A name is not a bone, or a factor is not plausible.
    """
    skeleton = human.skeleton
    rotations = skeleton.rest[:, :3, :3]
    stretch = np.einsum("bij,bj,bkj->bik", rotations, proportions.scales(skeleton), rotations)
    heads, tails = np.array(skeleton.heads), np.array(skeleton.tails)
    for bone, parent in enumerate(skeleton.parents):
        if parent < 0:
            heads[bone] = proportions.stature * skeleton.heads[bone]
        else:
            heads[bone] = heads[parent] + stretch[parent] @ (skeleton.heads[bone] - skeleton.heads[parent])
        tails[bone] = heads[bone] + stretch[bone] @ (skeleton.tails[bone] - skeleton.heads[bone])
    shift = heads - np.einsum("bij,bj->bi", stretch, skeleton.heads)
    vertices = np.einsum(
        "vij,vj->vi",
        (human.weights @ stretch.reshape(-1, 9)).reshape(-1, 3, 3),
        human.mesh.vertices,
    )
    vertices += human.weights @ shift
    lift = human.mesh.vertices[:, 1].min() - vertices[:, 1].min()
    for points in (vertices, heads, tails):
        points[:, 1] += lift
    return replace(
        human,
        mesh=replace(human.mesh, vertices=vertices),
        skeleton=replace(skeleton, heads=heads, tails=tails),
    )


@dataclass(frozen=True, eq=False)
class SurfaceOffsets:
    """A smooth field of offsets along the normals of a mesh in the rest pose.

    Offsets are a Gaussian process over places and normals. Points that are near each other and face the same
    way have similar offsets. The process is given by its values at the controls, vertices that are spread
    evenly.

    Attributes:
        controls: (K,) numbers of the vertices that are controls.
        factor: (K, K) lower Cholesky factor of the covariances of the controls; their variance is 1.
        shares: (V, K) matrix that turns offsets of the controls into offsets of the vertices.
        normals: (V, 3) unit normals of the vertices.
    """

    controls: Indices
    factor: Array
    shares: Float32Array
    normals: Array

    @classmethod
    def of(cls, mesh: Mesh) -> SurfaceOffsets:
        """Choose the controls of a mesh, and compute the shares of its vertices."""
        a, b, c = (mesh.vertices[mesh.triangles[:, corner]] for corner in range(3))
        _, place = np.unique(mesh.vertices, axis=0, return_inverse=True)
        place = place.reshape(-1)
        normals = mean_normals(np.cross(b - a, c - a), place[mesh.triangles], len(place))[place]
        reach = _REACH * max(float(np.ptp(mesh.vertices[:, 1])), 1e-6)
        features = np.hstack([mesh.vertices / reach, normals / _TURN])
        used = np.unique(mesh.triangles)
        controls = np.asarray(used[_spread(features[used], MOST_CONTROLS)], np.intp)
        covariances = _likeness(features[controls], features[controls]) + 1e-3 * np.eye(len(controls))
        factor = cholesky(covariances, lower=True)
        inverse = cho_solve((factor, True), np.eye(len(controls)))
        parts = np.array_split(features, len(features) // _CHUNK + 1)
        shares = [(_likeness(part, features[controls]) @ inverse).astype(np.float32) for part in parts]
        return cls(controls, factor, np.concatenate(shares), normals)

    def moved(self, human: Human, offsets: Sequence[float] | Array) -> Human:
        """Move the surface of a human by offsets. Raises MeshError if there is not one offset for each
        control."""
        if len(offsets) != len(self.controls):
            raise MeshError(
                f"{len(offsets)} offsets of the surface do not fit {human.name}, which has "
                f"{len(self.controls)} controls"
            )
        vertices = human.mesh.vertices + (self.shares @ np.asarray(offsets))[:, None] * self.normals
        return replace(human, mesh=replace(human.mesh, vertices=vertices))


def _likeness(one: Array, other: Array) -> Array:
    """Covariances (N, M) of points (N, D) and (M, D), for a reach of 1."""
    return np.asarray(np.exp(-0.5 * cdist(one, other, "sqeuclidean")))


def _spread(points: Array, most: int) -> Indices:
    """Numbers of points (N, D). Each point is the farthest from those before, until all points are nearer
    than 1."""
    chosen = [0]
    gaps = np.square(points - points[0]).sum(axis=1)
    while len(chosen) < most and gaps.max() > 1:
        chosen.append(int(gaps.argmax()))
        gaps = np.minimum(gaps, np.square(points - points[chosen[-1]]).sum(axis=1))
    return np.array(chosen, np.intp)


@lru_cache(maxsize=2)
def surface_offsets(name: str, shape: tuple[float, ...] = ()) -> SurfaceOffsets:
    """Offsets of the surface of a human with given betas. ``name``: name or file of the human."""
    return SurfaceOffsets.of(shaped_human(name, Proportions(shape=shape)).mesh)


def shaped_human(name: str, proportions: Proportions) -> Human:
    """Load a human by its name or file, with betas and offsets of the surface, before factors are applied.

    The human has no bones of fingers, toes, jaw and eyes, since photographs do not show their rotations.

    Raises:
        MeshError: The human cannot be loaded, or the betas or offsets do not fit it.
    """
    path, shape = find_asset(name, "humans"), proportions.shape
    human = (make_human(path, MeshHuman(betas=shape)) if shape else load_human(path)).without_details()
    return surface_offsets(name, shape).moved(human, proportions.offsets) if proportions.offsets else human


def can_be_shaped(name: str) -> bool:
    """Whether a human, by its name or file, is an SMPL model with betas."""
    try:
        return count_betas(find_asset(name, "humans")) > 0
    except MeshError:
        return False


def fit_shape(name: str, vertices: Array) -> tuple[float, ...]:
    """Find the betas that make the body in the rest pose most similar to another body of the model, by least
    squares.

    The prior is that betas of people have a standard deviation of 1.

    ``name``: name or file of an SMPL model. ``vertices``: vertices (V, 3) of the other body in the rest pose.
    """
    mean, directions = _directions(str(find_asset(name, "humans")))
    goal = vertices - vertices.mean(axis=0) - mean
    weight = _INDEPENDENT / len(vertices) / _NOISE**2
    flat = directions.reshape(-1, directions.shape[-1])
    matrix = weight * flat.T @ flat + np.eye(flat.shape[1])
    return tuple(float(each) for each in np.linalg.solve(matrix, weight * flat.T @ goal.ravel()).round(4))


@lru_cache(maxsize=4)
def _directions(path: str) -> tuple[Array, Array]:
    """Centred vertices (V, 3) of the mean body, and their changes (V, 3, N) by each beta."""
    count = min(count_betas(path), MOST)

    def body(number: int | None) -> Array:
        betas = tuple(float(each == number) for each in range(count))
        vertices = make_human(Path(path), MeshHuman(betas=betas)).mesh.vertices
        return np.asarray(vertices - vertices.mean(axis=0))

    mean = body(None)
    return mean, np.stack([body(number) - mean for number in range(count)], axis=-1)


@dataclass(frozen=True, eq=False)
class PersonFit:
    """A person fitted to F frames of V photographs.

    Attributes:
        human: Built-in human, or file, that has these proportions.
        proportions: Proportions of the person.
        bones: Names of the B bones.
        root: (F, 4, 4) rigid transforms from body space to ``map``.
        rotations: (F, B, 4) quaternions xyzw of the bones, as :meth:`~humansim_ros.motion.Skeleton.pose`
            takes them. The rotation of the first bone is the identity: ``root`` has its rotation.
        period: Nanoseconds between frames.
        keypoints: Name of the set of the points.
        views: Names of the V views.
        residuals: (F, V, K) pixels between the given and the fitted points. NaN where no point is given.
        outliers: (F, V, K) whether the given point is wrong and was left out.
        swapped: (F, V) whether left and right of the points were exchanged.
    """

    human: str
    proportions: Proportions
    bones: tuple[str, ...]
    root: Array
    rotations: Array
    period: int
    keypoints: str
    views: tuple[str, ...]
    residuals: Array
    outliers: NDArray[np.bool_]
    swapped: NDArray[np.bool_]

    def __repr__(self) -> str:
        return f"PersonFit({self.human!r}, {len(self.root)} frames, {len(self.views)} views)"

    @cached_property
    def body(self) -> Human:
        """The human in the proportions of the person. Raises MeshError if it cannot be loaded."""
        return with_proportions(shaped_human(self.human, self.proportions), self.proportions)

    def posed(self, frame: int = 0) -> Array:
        """Frames of the bones (B, 4, 4) in ``map``."""
        return self.body.skeleton.pose(self.rotations[frame], self.root[frame])

    def joints(self, frame: int = 0) -> Array:
        """Positions (J, 3) of the joints in ``map``, in the order of the joints of the skeleton."""
        return np.array(self.body.skeleton.joint_transforms(self.posed(frame))[:, :3, 3])

    def vertices(self, frame: int = 0) -> Float32Array:
        """Positions (V, 3) of the vertices in ``map``."""
        return self.body.pose(self.posed(frame))


def fit_motion(fit: PersonFit) -> Motion:
    """Motion of the F frames of a fit, with the skeleton of the person, to write as BVH. With ``anchor:
    file`` in a scene, the person moves where it was photographed."""
    posed = np.array([fit.posed(frame) for frame in range(len(fit.root))])
    return PosedBones(fit.body.skeleton, posed, fit.period / 1e9).to_motion()
