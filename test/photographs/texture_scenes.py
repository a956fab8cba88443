"""People in a known pose as views for texturing: photographs without shading."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from humansim_ros.cameras import Camera
from humansim_ros.geometry import matrix_to_quaternion, rotation_vector_to_matrix
from humansim_ros.people import Human
from humansim_ros.photographs.surface import TextureView
from humansim_ros.render import Body, GLRenderer, Lighting

#: Light that leaves textures as they are.
PLAIN = Lighting(mode="shadeless")


@dataclass(frozen=True)
class Pictures:
    """A person before cameras: images (H, W, 3), and face images (H, W)."""

    images: Sequence[NDArray[np.uint8]]
    faces: Sequence[NDArray[np.int32]]


def in_a_pose(human: Human) -> NDArray[np.float32]:
    """Vertices in ``map`` of the human with raised arms and a bent knee."""
    turns: Mapping[str, Sequence[float]] = {
        "l_shoulder": (0.0, 0.0, 0.5),
        "r_shoulder": (0.0, 0.0, -0.4),
        "l_knee": (0.6, 0.0, 0.0),
        "r_elbow": (0.0, -0.5, 0.0),
    }
    rotations = np.tile([0.0, 0.0, 0.0, 1.0], (len(human.skeleton), 1))
    for name, turn in turns.items():
        rotations[human.skeleton.names.index(name)] = matrix_to_quaternion(
            rotation_vector_to_matrix(np.array(turn))
        )
    up = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])  # y up to z up
    return human.pose(human.skeleton.pose(rotations, up))


def photograph(human: Human, vertices: NDArray[np.float32], cameras: Sequence[Camera]) -> Pictures:
    """Images of a human without shading."""
    with GLRenderer(lighting=PLAIN) as renderer:
        body = Body(human.mesh, vertices, human.triangle_parts, 1)
        seen = [renderer.render([body], camera, ("rgb", "face")) for camera in cameras]
    return Pictures([view.rgb for view in seen], [view.face for view in seen])


def texture_views(human: Human, cameras: Sequence[Camera]) -> list[TextureView]:
    """Photographs of a human in a pose."""
    vertices = in_a_pose(human)
    images = photograph(human, vertices, cameras).images
    return [
        TextureView(f"view_{number}", camera, image, vertices)
        for number, (camera, image) in enumerate(zip(cameras, images, strict=True))
    ]


def psnr(first: NDArray[np.uint8], second: NDArray[np.uint8], mask: NDArray[np.bool_]) -> float:
    """Peak signal to noise ratio, dB, of the pixels of a mask."""
    error = first[mask].astype(float) - second[mask]
    return float(10 * np.log10(255**2 / np.mean(error**2)))


def undressed(human: Human) -> Human:
    """The human without its texture."""
    mesh = replace(human.mesh, texture=None, skin=None, colors=None)
    return replace(human, mesh=mesh, looks={}, outfit="default")
