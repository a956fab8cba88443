"""A person in photographs: proportions, fitted poses, and files of fits (.yaml)."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import Field
from scipy.linalg import cho_solve, cholesky
from scipy.spatial.distance import cdist

from humansim_ros.errors import MAX_COORDINATE, MeshError, PhotographError, located
from humansim_ros.files.mesh import Mesh, mean_normals
from humansim_ros.files.reading import atomic_path, find_asset
from humansim_ros.files.yaml import Section, read_yaml, validated
from humansim_ros.geometry import matrix_to_quaternion, quaternion_to_matrix, transform, unit_quaternions
from humansim_ros.motion.body import Motion, Skeleton
from humansim_ros.motion.files import PosedBones
from humansim_ros.people.humans import Human
from humansim_ros.people.keypoints import keypoint_set
from humansim_ros.people.loading import MeshHuman, count_betas, load_human, make_human
from humansim_ros.photographs.views import MAX_FRAMES
from humansim_ros.types import Array, Float32Array, Indices

#: Smallest and largest factor of the proportions.
SMALLEST, LARGEST = 0.2, 5.0
#: Greatest offset of the surface, metres.
GREATEST_OFFSET = 0.08
#: Most betas that are fitted. The first betas of an SMPL model matter most.
MOST = 10
#: For the fit of betas: standard deviation of a vertex from the model, metres; and number of vertices that
#: count as independent.
_NOISE, _INDEPENDENT = 0.01, 200
#: Points have similar offsets if they are nearer than this share of the height, and their unit normals differ
#: by less than this.
_REACH, _TURN = 0.02, 1.0
#: Most control vertices of :class:`SurfaceOffsets`, and number of vertices that are computed at once.
MOST_CONTROLS, _CHUNK = 1000, 20_000


@dataclass(frozen=True)
class Proportions:
    """Proportions of a person, relative to a human.

    Attributes:
        stature: Factor of the whole body.
        lengths: Factor along each bone, by name of the bone. The factor of an absent bone is 1.
        girths: Factor across each bone, by name of the bone. The factor of an absent bone is 1.
        shape: Betas of the human if the human is an SMPL model.
        offsets: Metres by which the surface moves outwards at the controls of :class:`SurfaceOffsets`, before
            the factors are applied. Offsets describe clothes, hair and shapes that factors cannot. If empty,
            there are no offsets.
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
    """Return a human in other proportions. Its soles stay where they are. ``human`` already has the betas and
    offsets.

    Each bone scales its vertices about the head of the bone: v' = sum_b w_b (h'_b + R_b S_b R_b^T (v - h_b)).
    Skinning weights w_b keep the skin smooth.

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
    stretches = (human.weights @ stretch.reshape(-1, 9)).reshape(-1, 3, 3)
    vertices = np.einsum("vij,vj->vi", stretches, human.mesh.vertices)
    vertices += human.weights @ shift
    lift = human.mesh.vertices[:, 1].min() - vertices[:, 1].min()
    for points in (vertices, heads, tails):
        points[:, 1] += lift
    mesh, skeleton = replace(human.mesh, vertices=vertices), replace(skeleton, heads=heads, tails=tails)
    return replace(human, mesh=mesh, skeleton=skeleton)


@dataclass(frozen=True, eq=False)
class SurfaceOffsets:
    """A smooth field of offsets along the normals of a mesh in the rest pose.

    Offsets are a Gaussian process over places and normals. Points that are near each other and face the same
    way have similar offsets. The process is given by its values at the controls, vertices that are spread
    evenly.

    Attributes:
        controls: (K,) numbers of the vertices that are controls.
        factor: (K, K) lower Cholesky factor of the covariances of the controls (variance 1).
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
        """Move the surface of a human by offsets. Raises MeshError unless each control has one
        offset."""
        if len(offsets) != len(self.controls):
            raise MeshError(
                f"{len(offsets)} offsets of the surface do not fit {human.name}, which has "
                f"{len(self.controls)} controls"
            )
        vertices = human.mesh.vertices + (self.shares @ np.asarray(offsets))[:, None] * self.normals
        return replace(human, mesh=replace(human.mesh, vertices=vertices))


def _likeness(one: Array, other: Array) -> Array:
    """Covariances (N, M) of points (N, D) and (M, D), with coordinates in units of the reach."""
    return np.asarray(np.exp(-0.5 * cdist(one, other, "sqeuclidean")))


def _spread(points: Array, most: int) -> Indices:
    """Choose up to ``most`` of points (N, D); return their numbers. Each next point is the farthest from
    those chosen, until all are nearer than 1."""
    chosen = [0]
    gaps = np.square(points - points[0]).sum(axis=1)
    while len(chosen) < most and gaps.max() > 1:
        chosen.append(int(gaps.argmax()))
        gaps = np.minimum(gaps, np.square(points - points[chosen[-1]]).sum(axis=1))
    return np.array(chosen, np.intp)


@lru_cache(maxsize=2)
def surface_offsets(name: str, shape: tuple[float, ...] = ()) -> SurfaceOffsets:
    """Get the :class:`SurfaceOffsets` of a human with given betas. ``name``: name or file of the human."""
    return SurfaceOffsets.of(shaped_human(name, Proportions(shape=shape)).mesh)


def shaped_human(name: str, proportions: Proportions) -> Human:
    """Load a human by its name or file. Apply the betas and offsets of ``proportions``, but not the factors.

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
    """Find the betas of an SMPL body in the rest pose, by least squares from its vertices.

    The prior is that betas of people have a standard deviation of 1.

    ``name``: name or file of an SMPL model. ``vertices``: vertices (V, 3) of the body in the rest pose.
    """
    mean, directions = _directions(str(find_asset(name, "humans")))
    goal = vertices - vertices.mean(axis=0) - mean
    weight = _INDEPENDENT / len(vertices) / _NOISE**2
    flat = directions.reshape(-1, directions.shape[-1])
    matrix = weight * flat.T @ flat + np.eye(flat.shape[1])
    return tuple(float(each) for each in np.linalg.solve(matrix, weight * flat.T @ goal.ravel()).round(4))


@lru_cache(maxsize=4)
def _directions(path: str) -> tuple[Array, Array]:
    """Centred vertices (V, 3) of the mean body of an SMPL model, and their changes (V, 3, N) by each beta."""
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
        human: Built-in human, or file, that the proportions are relative to.
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
        """Frames (B, 4, 4) of the bones in ``map``, of one frame of the photographs."""
        return self.body.skeleton.pose(self.rotations[frame], self.root[frame])

    def joints(self, frame: int = 0) -> Array:
        """Positions (J, 3) of the joints in ``map``, in the order of the joints of the skeleton."""
        return np.array(self.body.skeleton.joint_transforms(self.posed(frame))[:, :3, 3])

    def vertices(self, frame: int = 0) -> Float32Array:
        """Positions (V, 3) of the vertices in ``map``."""
        return self.body.pose(self.posed(frame))


def fit_motion(fit: PersonFit) -> Motion:
    """Motion of the F frames of a fit, for a BVH file, with the skeleton of the person. With ``anchor:
    file``, a scene plays it at the place that was photographed."""
    posed = np.array([fit.posed(frame) for frame in range(len(fit.root))])
    return PosedBones(fit.body.skeleton, posed, fit.period / 1e9).to_motion()


_HEADER = "# Fit of `humansim human fit`; docs/from_photographs.md describes the keys.\n"
_Number = Annotated[float, Field(ge=-MAX_COORDINATE, le=MAX_COORDINATE)]
_Factor = Annotated[float, Field(ge=SMALLEST, le=LARGEST)]
_Offset = Annotated[float, Field(ge=-GREATEST_OFFSET, le=GREATEST_OFFSET)]
_Quaternion = tuple[_Number, _Number, _Number, _Number]


class _ProportionsSection(Section):
    """Section ``proportions``."""

    stature: _Factor = 1.0
    lengths: dict[str, _Factor] = Field(default_factory=dict)
    girths: dict[str, _Factor] = Field(default_factory=dict)
    shape: tuple[_Number, ...] = Field((), max_length=400)
    offsets: tuple[_Offset, ...] = Field((), max_length=MOST_CONTROLS)


class _FrameSection(Section):
    """One frame: place and rotation of the body, rotations of bones, errors of points by view."""

    position: tuple[_Number, _Number, _Number]
    rotation: _Quaternion
    bones: dict[str, _Quaternion] = Field(default_factory=dict)
    residuals: dict[str, dict[str, _Number]] = Field(default_factory=dict)
    outliers: dict[str, dict[str, _Number]] = Field(default_factory=dict)
    swapped: tuple[str, ...] = ()


class _FitSection(Section):
    """Content of a file."""

    human: str = Field(min_length=1)
    keypoints: str = "coco17"
    period: Annotated[float, Field(gt=0, le=3600)] = 0.04
    views: tuple[str, ...] = ()
    bones: tuple[str, ...] = Field(min_length=1, max_length=255)
    proportions: _ProportionsSection = _ProportionsSection()
    frames: tuple[_FrameSection, ...] = Field(min_length=1, max_length=MAX_FRAMES)


def write_fit(path: str | os.PathLike[str], fit: PersonFit) -> None:
    """Write a fit atomically. Lengths are metres and pixels, rotations quaternions xyzw."""
    names, shape = keypoint_set(fit.keypoints).names, fit.proportions
    lengths, girths = (
        {name: round(float(value), 6) for name, value in factors.items()}
        for factors in (shape.lengths, shape.girths)
    )
    content: dict[str, Any] = {
        "human": fit.human,
        "keypoints": fit.keypoints,
        "period": fit.period / 1e9,
        "views": list(fit.views),
        "bones": list(fit.bones),
        "proportions": {
            "stature": round(float(shape.stature), 6),
            "lengths": lengths,
            "girths": girths,
            "shape": list(shape.shape),
            "offsets": list(shape.offsets),
        },
        "frames": [_frame(fit, number, names) for number in range(len(fit.root))],
    }
    with atomic_path(path) as part, part.open("w", encoding="utf-8") as file:
        file.write(_HEADER)
        yaml.safe_dump(content, file, sort_keys=False, default_flow_style=None, width=110, allow_unicode=True)


def _frame(fit: PersonFit, number: int, names: tuple[str, ...]) -> dict[str, Any]:
    root = fit.root[number]
    frame: dict[str, Any] = {
        "position": np.round(root[:3, 3], 6).tolist(),
        "rotation": np.round(matrix_to_quaternion(root[:3, :3]), 7).tolist(),
        "bones": {
            bone: np.round(rotation, 7).tolist()
            for bone, rotation in zip(fit.bones, fit.rotations[number], strict=True)
            if abs(rotation[3]) < 1
        },
    }
    for key, chosen in (("residuals", ~fit.outliers[number]), ("outliers", fit.outliers[number])):
        by_view = {
            view: {
                name: round(float(value), 3)
                for name, value, used in zip(names, fit.residuals[number, row], chosen[row], strict=True)
                if used and np.isfinite(value)
            }
            for row, view in enumerate(fit.views)
        }
        frame[key] = {view: values for view, values in by_view.items() if values}
    frame["swapped"] = [view for view, swapped in zip(fit.views, fit.swapped[number], strict=True) if swapped]
    return frame


def read_fit(path: str | os.PathLike[str]) -> PersonFit:
    """Read a fit.

    Raises:
        PhotographError: The file is wrong; the message has line and key.
    """
    data, tree = read_yaml(path, PhotographError, "fit")
    if not isinstance(data, dict):
        raise PhotographError("a fit is a mapping with the keys human, bones and frames", path=path)
    section = validated(_FitSection, data, PhotographError, path, tree)
    with located(PhotographError, path, key="keypoints"):
        keypoints = keypoint_set(section.keypoints)
    if len(set(section.bones)) < len(section.bones):
        raise PhotographError("a bone is repeated", path=path, key="bones")
    frames, views, points = section.frames, section.views, keypoints.names
    shape = len(frames), len(views), len(points)
    root = np.tile(np.eye(4), (len(frames), 1, 1))
    rotations = np.tile([0.0, 0.0, 0.0, 1.0], (len(frames), len(section.bones), 1))
    residuals, outliers = np.full(shape, np.nan), np.zeros(shape, bool)
    swapped = np.zeros(shape[:2], bool)

    def place(known: tuple[str, ...], name: str, key: str) -> int:
        if name not in known:
            raise PhotographError(f"{name!r} is not one of {', '.join(known)}", path=path, key=key)
        return known.index(name)

    def quaternion(value: _Quaternion, key: str) -> Any:
        if not 0.99 < np.linalg.norm(value) < 1.01:
            raise PhotographError("a rotation is a quaternion x, y, z, w of length 1", path=path, key=key)
        return unit_quaternions(np.array(value))

    for number, frame in enumerate(frames):
        key = f"frames.{number}"
        turn = quaternion(frame.rotation, f"{key}.rotation")
        root[number] = transform(quaternion_to_matrix(turn), np.array(frame.position))
        for bone, value in frame.bones.items():
            row = place(section.bones, bone, f"{key}.bones")
            rotations[number, row] = quaternion(value, f"{key}.bones.{bone}")
        for part, errors in (("residuals", frame.residuals), ("outliers", frame.outliers)):
            for view, values in errors.items():
                row = place(views, view, f"{key}.{part}")
                for name, error in values.items():
                    column = place(points, name, f"{key}.{part}.{view}")
                    residuals[number, row, column] = error
                    outliers[number, row, column] = part == "outliers"
        for view in frame.swapped:
            swapped[number, place(views, view, f"{key}.swapped")] = True
    period, proportions = round(section.period * 1e9), Proportions(**section.proportions.model_dump())
    rows = residuals, outliers, swapped
    return PersonFit(
        section.human, proportions, section.bones, root, rotations, period, section.keypoints, views, *rows
    )
