"""Find anatomical points on the skin of a human: triangle and barycentric weights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from humansim_ros.body.rigging import dominant_bones
from humansim_ros.humans.human import Human
from humansim_ros.humans.loading import load_human
from humansim_ros.humans.makehuman.building import SOURCE
from humansim_ros.keypoints.anatomy import skin_points
from humansim_ros.types import Array, Indices

#: Built-in human whose points are carried over to other bodies.
_TEMPLATE = "adult_man"


@dataclass(frozen=True, eq=False)
class SkinPlaces:
    """Places of N points: corners (N, 3) of their triangles, barycentric weights (N, 3), certainty (N,)."""

    corners: Indices
    weights: Array
    certain: NDArray[np.bool_]


def has_exact_skin(human: Human) -> bool:
    """Whether the points of the skin of a human are known, not fitted."""
    return human.notes.get("source") == SOURCE and human.mesh.uv is not None


def place_on_skin(human: Human, names: Sequence[str]) -> SkinPlaces:
    """Find points of :func:`~humansim_ros.keypoints.anatomy.skin_points` on a human.

    Bodies that are made here have one texture layout, which gives the exact place. On other bodies the points
    are carried over from a built-in human, and are less certain.
    """
    if has_exact_skin(human):
        return _by_texture(human, names)
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


def _carried_over(human: Human, names: Sequence[str]) -> SkinPlaces:
    """Find points by their place beside the bones of a built-in human: the nearest vertex of that part."""
    template = load_human(_TEMPLATE)
    places = _by_texture(template, names)
    skeleton, other = human.skeleton, template.skeleton
    bones = dominant_bones(template.weights)[places.corners[:, 0]]
    skin = np.einsum("nk,nkj->nj", places.weights, template.mesh.vertices[places.corners])
    own = np.array([skeleton.bone(other.names[bone]) for bone in bones], dtype=np.intp)
    heights = [float(np.ptp(body.mesh.vertices[:, 1])) for body in (human, template)]
    scale = np.full((len(names), 3), heights[0] / heights[1])
    scale[:, 1] = skeleton.lengths[own] / other.lengths[bones]
    local = np.einsum("nij,nj->ni", other.rest_inverse[bones, :3, :3], skin - other.heads[bones])
    targets = np.einsum("nij,nj->ni", skeleton.rest[own, :3, :3], scale * local) + skeleton.heads[own]
    parts = dominant_bones(human.weights)
    corners = np.zeros((len(names), 3), np.intp)
    for number, (target, bone) in enumerate(zip(targets, own, strict=True)):
        allowed = np.flatnonzero(parts == bone)
        if not len(allowed):
            allowed = np.arange(len(parts))
        distances = np.linalg.norm(human.mesh.vertices[allowed] - target, axis=1)
        corners[number] = allowed[np.argmin(distances)]
    weights = np.tile([1.0, 0.0, 0.0], (len(names), 1))
    return SkinPlaces(corners, weights, np.zeros(len(names), bool))
