"""Shape of bodies with sliders: the betas of SMPL models that resemble a fitted person most."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np

from humansim_ros.errors import MeshError
from humansim_ros.humans.description import MeshHuman
from humansim_ros.humans.human import Human
from humansim_ros.humans.loading import load_human, make_human
from humansim_ros.humans.smpl import count_betas
from humansim_ros.io.assets import find_asset
from humansim_ros.types import Array

#: Most betas that are fitted: the first ones of a model are those that matter.
MOST = 10
#: Standard deviation of a vertex about its place in the model, metres; and number of independent vertices.
_NOISE, _INDEPENDENT = 0.01, 200


def shaped_human(name: str, shape: tuple[float, ...] = ()) -> Human:
    """A human by its name or file, with the betas ``shape`` if it is an SMPL model.

    Raises:
        MeshError: It cannot be loaded, or has no such betas.
    """
    path = find_asset(name, "humans")
    return make_human(path, MeshHuman(betas=shape)) if shape else load_human(path)


def can_be_shaped(name: str) -> bool:
    """Whether a human, by its name or file, is an SMPL model with betas."""
    try:
        return count_betas(find_asset(name, "humans")) > 0
    except MeshError:
        return False


def fit_shape(name: str, vertices: Array) -> tuple[float, ...]:
    """Betas whose body at rest is most like another body of the model at rest, by least squares.

    Betas of people are about as large as 1; that is the prior.

    Args:
        name: Name or file of an SMPL model.
        vertices: (V, 3) of the other body.
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
