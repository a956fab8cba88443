"""What a renderer is given and what it gives back, whatever draws the pixels."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from humansim_ros.body.mesh import Mesh
from humansim_ros.camera import Camera
from humansim_ros.errors import RenderError

#: Every channel a renderer can be asked for; docs/ground_truth.md defines each.
CHANNELS = ("rgb", "depth", "instance", "part")


@dataclass(frozen=True)
class Body:
    """A moving surface as it stands in one frame.

    ``mesh``: its topology and looks (its own vertices are not used). ``vertices``: (V, 3) float32, ``map``,
    metres. ``parts``: (N,) uint8 part label of each of ``mesh.triangles``. ``instance``: label of this body
    and of no other, 1 to 65535; or 0 for a thing that has no label, only colour and depth, and leaves no
    shadow: things need a mesh of their own each. Make a new Body for a new frame: renderers keep what they
    worked out of one.
    """

    mesh: Mesh
    vertices: NDArray[np.float32]
    parts: NDArray[np.uint8]
    instance: int


@dataclass(frozen=True)
class View:
    """What one camera sees: (H, W, ...) arrays on one pixel grid; None for a channel that was not asked for.

    ``rgb``: (H, W, 3) uint8 sRGB, anti-aliased, or what the camera's sensor makes of it. ``depth``: (H, W)
    float32 metres along z of the optical frame, +inf where nothing is. ``instance``: (H, W) uint16, ``part``:
    (H, W) uint8; 0 where no body is.
    Labels and depth are those of the pixel's centre, never blended.
    """

    rgb: NDArray[np.uint8] | None = None
    depth: NDArray[np.float32] | None = None
    instance: NDArray[np.uint16] | None = None
    part: NDArray[np.uint8] | None = None


class Renderer(Protocol):
    """Draws bodies in a static scene as a camera sees them."""

    def render(
        self,
        bodies: Sequence[Body],
        camera: Camera,
        channels: Collection[str] = CHANNELS,
        passing: bool = False,
    ) -> View:
        """The asked channels of one view. ``passing``: the camera moves on, nothing is kept for it.

        Raises RenderError if a channel is unknown or vertices are not finite.
        """
        ...

    def close(self) -> None:
        """Free what the renderer holds."""
        ...


def check_request(bodies: Sequence[Body], channels: Collection[str]) -> None:
    """RenderError for a channel nobody draws or a body that cannot be drawn."""
    unknown = set(channels) - set(CHANNELS)
    if unknown:
        raise RenderError(f"no such channel: {', '.join(sorted(unknown))}; there are {', '.join(CHANNELS)}")
    labels = [body.instance for body in bodies if body.instance]
    things = [id(body.mesh) for body in bodies if not body.instance]
    if len(set(things)) < len(things):
        raise RenderError("two things without a label cannot share a mesh")
    for body in bodies:
        if body.vertices.shape != body.mesh.vertices.shape:
            raise RenderError(
                f"vertices of shape {body.vertices.shape} do not fit a mesh of {len(body.mesh.vertices)}"
            )
        if not np.isfinite(body.vertices).all():
            raise RenderError(f"a vertex of body {body.instance} is not finite (NaN or infinity)")
        if not 0 <= body.instance < 65536:
            raise RenderError(f"an instance label must be 0 to 65535, not {body.instance}")
        if labels.count(body.instance) > 1:
            raise RenderError(f"two bodies cannot be told apart: instance label {body.instance} twice")
        if body.parts.shape != (len(body.mesh.triangles),):
            n = len(body.mesh.triangles)
            raise RenderError(f"part labels of shape {body.parts.shape} do not fit a mesh of {n} triangles")
