"""What a renderer is given and what it gives back, whatever draws the pixels."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera import Camera
from humansim_ros.errors import RenderError
from humansim_ros.mesh.mesh import Mesh
from humansim_ros.render.channels import ALL_CHANNELS, CHANNEL_TABLE, CHANNELS, AdjacentName, View

_WHEN: dict[AdjacentName, str] = {"next_frame": "after", "previous_frame": "before"}

#: What a body is.
Kind = Literal["human", "object"]


@dataclass(frozen=True)
class Body:
    """A moving surface as it stands in one frame.

    ``mesh``: its topology and looks (its own vertices are not used). ``vertices``: (V, 3) float32, ``map``,
    metres. ``parts``: (N,) uint8 part label of each of ``mesh.triangles``, 0 of those that have none.
    ``instance``: label of this body and of no other, 1 to 65535; or 0 for one that has no label, only colour,
    depth and shadow: those need a mesh of their own each. ``kind``: what it is, labelled or not. Make a new
    Body for a new frame: renderers keep what they worked out of one.
    """

    mesh: Mesh
    vertices: NDArray[np.float32]
    parts: NDArray[np.uint8]
    instance: int
    kind: Kind = "human"


@dataclass(frozen=True)
class AdjacentFrame:
    """What a camera has before it at another moment: the same bodies, in the same order."""

    bodies: Sequence[Body]
    camera: Camera


class Backdrop(Protocol):
    """What a camera sees where nothing is."""

    def picture(self, camera: Camera) -> NDArray[np.uint8]:
        """(H, W, 3) uint8 sRGB of the size of the camera's image."""
        ...


class Renderer(Protocol):
    """Draws bodies in a static scene as a camera sees them. ``channels``: those that it can be asked for."""

    @property
    def channels(self) -> Collection[str]: ...

    def render(
        self,
        bodies: Sequence[Body],
        camera: Camera,
        channels: Collection[str] = CHANNELS,
        moving_camera: bool = False,
        next_frame: AdjacentFrame | None = None,
        previous_frame: AdjacentFrame | None = None,
        backdrop: Backdrop | None = None,
    ) -> View:
        """The asked channels of one view.

        ``moving_camera``: the static scene is redrawn, not cached. ``next_frame``, ``previous_frame``: for
        the channels of flow. ``backdrop``: the image behind everything; a plain colour if None.

        Raises RenderError if a channel is unknown, lacks what it needs, or vertices are not finite.
        """
        ...

    def close(self) -> None:
        """Free what the renderer holds."""
        ...


def check_request(bodies: Sequence[Body], channels: Collection[str]) -> None:
    """RenderError for a channel nobody draws or a body that cannot be drawn."""
    unknown = set(channels) - set(ALL_CHANNELS)
    if unknown:
        known = ", ".join(ALL_CHANNELS)
        raise RenderError(f"no such channel: {', '.join(sorted(unknown))}; there are {known}")
    labels = Counter(body.instance for body in bodies if body.instance)
    things = [id(body.mesh) for body in bodies if not body.instance]
    if len(set(things)) < len(things):
        raise RenderError("two bodies without a label cannot share a mesh")
    for body in bodies:
        if body.vertices.shape != body.mesh.vertices.shape:
            raise RenderError(
                f"vertices of shape {body.vertices.shape} do not fit a mesh of {len(body.mesh.vertices)}"
            )
        if not np.isfinite(body.vertices).all():
            raise RenderError(f"a vertex of body {body.instance} is not finite (NaN or infinity)")
        if not 0 <= body.instance < 65536:
            raise RenderError(f"an instance label must be 0 to 65535, not {body.instance}")
        if labels[body.instance] > 1:
            raise RenderError(f"two bodies cannot be told apart: instance label {body.instance} twice")
        if body.parts.shape != (len(body.mesh.triangles),):
            n = len(body.mesh.triangles)
            raise RenderError(f"part labels of shape {body.parts.shape} do not fit a mesh of {n} triangles")


def check_adjacent_frames(
    bodies: Sequence[Body], channels: Collection[str], moments: Mapping[AdjacentName, AdjacentFrame | None]
) -> None:
    """RenderError where a channel of flow lacks the frame it needs, or that frame has other bodies."""
    for channel in channels:
        which = CHANNEL_TABLE[channel].adjacent_frame
        if which is None:
            continue
        moment = moments[which]
        if moment is None:
            raise RenderError(f"{channel} needs the frame {_WHEN[which]} this one")
        if [body.vertices.shape for body in moment.bodies] != [body.vertices.shape for body in bodies]:
            raise RenderError(f"the frame {_WHEN[which]} this one has other bodies")
        check_request(moment.bodies, ())
