"""Relaxed hands: the fingers of MakeHuman's body, which are spread and straight, are bent and closed."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial.transform import Rotation

from humansim_ros.body.skinning import skin
from humansim_ros.humans.makehuman.data import MakeHumanData
from humansim_ros.types import Array

#: Flexion of the three joints of each finger, degrees: thumb to little finger of a hand at rest.
_FLEXION = ((6, 10, 14), (20, 28, 14), (24, 32, 16), (27, 34, 17), (30, 35, 17))
#: Share of the angle between a finger and the middle finger by which the finger is turned to it.
_CLOSING = 0.6
#: Rotation of the thumb towards the fingers, degrees.
_THUMB_CLOSING = 14.0


def relax_hands(source: MakeHumanData, vertices: Array, points: Mapping[str, Array]) -> Array:
    """Bend the fingers of both hands.

    Args:
        source: Weights of the artists.
        vertices: (N, 3) all vertices of the base mesh, metres, in the A pose.
        points: Landmarks of the same body (see ``skeleton.landmarks``).

    Returns:
        (N, 3) vertices; only those of the fingers differ.
    """
    weights = source.weights
    transforms, columns = [np.eye(4)], [np.zeros(len(vertices))]
    for side in "lr":
        for finger in range(1, 6):
            for segment, transform in enumerate(_finger(points, side, finger), 1):
                pairs = np.array(weights[f"finger{finger}-{segment}.{side.upper()}"])
                column = np.zeros(len(vertices))
                column[pairs[:, 0].astype(int)] = pairs[:, 1]
                transforms.append(transform)
                columns.append(column)
    shares = np.stack(columns, axis=1)
    shares[:, 0] = np.maximum(1.0 - shares.sum(axis=1), 0.0)
    moved = np.flatnonzero(shares[:, 0] < 1.0)
    out = vertices.copy()
    shares = shares[moved] / shares[moved].sum(axis=1, keepdims=True)
    # dual quaternions: linear blending would flatten the knuckles
    out[moved] = skin(vertices[moved], csr_matrix(shares), np.array(transforms), "dual_quaternion")
    return out


def _finger(points: Mapping[str, Array], side: str, finger: int) -> list[Array]:
    """Transforms (4, 4) of the three segments of a finger."""

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
        turn = Rotation.from_rotvec(np.radians(degrees) * axis).as_matrix()
        if segment == 1:
            turn = turn @ closing
        before = before @ _about(joint(segment), turn)
        out.append(before)
    return out


def _closing(palm: Array, joint: object, finger: int) -> Array:
    """Rotation (3, 3) about the normal of the palm that turns a finger to the middle finger."""
    assert callable(joint)
    direction, middle = (d - (d @ palm) * palm for d in (joint(3) - joint(1), joint(3, 3) - joint(1, 3)))
    angle = np.arctan2(np.cross(direction, middle) @ palm, direction @ middle)
    angle = np.sign(angle) * np.radians(_THUMB_CLOSING) if finger == 1 else _CLOSING * angle
    return Rotation.from_rotvec(angle * palm).as_matrix()


def _about(centre: Array, turn: Array) -> Array:
    out = np.eye(4)
    out[:3, :3] = turn
    out[:3, 3] = centre - turn @ centre
    return out
