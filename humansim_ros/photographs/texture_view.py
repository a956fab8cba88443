"""Views from which a person is textured: a photograph, and the person's pose in it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera.camera import Camera
from humansim_ros.errors import PhotographError
from humansim_ros.humans.human import Human
from humansim_ros.types import Array, Float32Array, Image


@dataclass(frozen=True, eq=False)
class TextureView:
    """A photograph of a person in a known pose.

    Attributes:
        name: Name of the view.
        camera: Camera with its lens and its pose in ``map``.
        image: (H, W, 3) uint8 sRGB.
        vertices: (V, 3) float32, the vertices of the person in ``map``, metres.
        mask: (H, W), true where the photograph shows the person, if that is known.

    Raises:
        PhotographError: The image or the mask has another size than the camera's images.
    """

    name: str
    camera: Camera
    image: Image
    vertices: Float32Array
    mask: NDArray[np.bool_] | None = None

    def __post_init__(self) -> None:
        width, height = self.camera.size
        if self.image.shape != (height, width, 3):
            raise PhotographError(
                f"an image of shape {self.image.shape} does not fit a camera of {width} x {height} pixels",
                key=f"views.{self.name}",
            )
        if self.mask is not None and self.mask.shape != (height, width):
            raise PhotographError(
                f"a mask of shape {self.mask.shape} does not fit a camera of {width} x {height} pixels",
                key=f"views.{self.name}",
            )

    def __repr__(self) -> str:
        return f"TextureView({self.name!r}, {self.camera!r})"


@dataclass(frozen=True, eq=False)
class TexturedPerson:
    """A human with the appearance of a person in photographs.

    Attributes:
        human: The human, wearing the new texture.
        cameras: (N,) index of the view that each triangle of the mesh takes its colour from, or takes most
            of it from; -1 if no view shows anything of the person.
        seen: (N,) some view shows the triangle; the colour of the others is a guess.
        gains: (C, 3) factors of red, green and blue of each view, of sRGB values, that were removed; None if
            colours were not aligned.
        views: Names of the C views.
        notes: What else should be known about the result: a sentence by a keyword.
    """

    human: Human
    cameras: NDArray[np.int32]
    seen: NDArray[np.bool_]
    gains: Array | None = None
    views: tuple[str, ...] = ()
    notes: Mapping[str, str] = field(default_factory=dict)


def check_views(human: Human, views: Sequence[TextureView]) -> None:
    """Raise PhotographError if there are no views, or one is of a person with another number of vertices."""
    if not views:
        raise PhotographError("a texture needs at least one photograph")
    for view in views:
        if view.vertices.shape != human.mesh.vertices.shape:
            raise PhotographError(
                f"{len(view.vertices)} vertices do not fit {human.name}, which has "
                f"{len(human.mesh.vertices)}",
                key=f"views.{view.name}",
            )
