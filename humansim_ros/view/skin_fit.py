"""The skin of a body that is known by its topics only: bones at rest and weights from some posed frames."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from humansim_ros.body.skeleton import Skeleton
from humansim_ros.body.weights import limit_bones
from humansim_ros.humans import Human
from humansim_ros.mesh.mesh import Mesh
from humansim_ros.rotations import fit_similarity, from_y_axis, quaternion_to_matrix, transform
from humansim_ros.types import Array

#: Fewest vertices around a bone from which its place at rest is found.
_FEWEST = 20
#: Steps of finding the rigid part of the skin around a bone, and the share of vertices that is kept.
_STEPS, _KEPT = 20, 0.5
#: Metres of distance from a bone for a metre that a vertex moves against it.
_STEADY = 4.0
#: Rounds of finding frames and weights, and weight from which a vertex moves with a bone.
_ROUNDS, _RIGID = 2, 0.9
#: Most bones that move a vertex.
_BONES = 4
#: Mean distance of the posed skin from the given one up to which the weights are used, metres.
_MAX_ERROR = 0.02


def fitted_skin(figure: Human, mesh: Mesh, joints: Array, vertices: Array) -> Human | None:
    """A human with the skin of a surface; None if bones do not move it so.

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
    swing = quaternion_to_matrix(from_y_axis(along))
    rolled = np.swapaxes(swing, 1, 2) @ frames[:, :3, :3]
    rolls = np.arctan2(rolled[:, 0, 2], rolled[:, 0, 0])
    tails = heads + along * skeleton.lengths[:, None]
    found = Skeleton(skeleton.names, skeleton.parents, heads, tails, rolls)
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
    """Rigid transform (4, 4) from points (N, 3) to others, of the half of the points that fits best
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
