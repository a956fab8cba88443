"""The interface of renderers: bodies, requests, and the base class."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NoReturn, Protocol, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

from humansim_ros.cameras.camera import Camera
from humansim_ros.errors import RenderError
from humansim_ros.files.mesh import Mesh, Simplification
from humansim_ros.render.interface.channels import CHANNEL_TABLE, CHANNELS, AdjacentName, View, check_channels
from humansim_ros.types import Float32Array, Image

_Self = TypeVar("_Self", bound="Renderer")
#: Kind of a body.
Kind = Literal["human", "object"]


@dataclass(frozen=True, eq=False)
class Body:
    """A surface in one frame. Create a new Body for each frame, since renderers cache the results of a Body.

    Attributes:
        mesh: Topology and appearance. The vertices of the mesh are not used. The mesh must not change.
        vertices: (V, 3) float32 in ``map``, metres. If the array can be written to, the body keeps a
            read-only copy.
        parts: (N,) uint8 part label of each triangle, 0 for no part. Read-only like ``vertices``.
        instance: Label, 1 to 65535, different for each body. A body with 0 has no labels, only colour, depth
            and shadow. Its mesh may not be used by another body.
        kind: Human or object.
        levels: Simpler versions of the mesh (levels of detail). Colours may show them where the difference is
            not visible.
    """

    mesh: Mesh
    vertices: Float32Array
    parts: NDArray[np.uint8]
    instance: int
    kind: Kind = "human"
    levels: Simplification | None = None

    def __post_init__(self) -> None:
        for name in ("vertices", "parts"):
            object.__setattr__(self, name, _read_only(getattr(self, name)))


@dataclass(frozen=True)
class AdjacentFrame:
    """The next or the previous frame of a camera. It has the same bodies in the same order."""

    bodies: Sequence[Body]
    camera: Camera


class Backdrop(Protocol):
    """Image behind the scene."""

    def picture(self, camera: Camera) -> Image:
        """Return the backdrop that a camera sees, (H, W, 3) uint8 sRGB in the size of the camera's image."""
        ...


@dataclass(frozen=True, eq=False)
class RenderRequest:
    """A view to render.

    Attributes:
        bodies: Bodies in the frame.
        camera: Camera with its pose in the frame.
        channels: Names of the channels to render, see :data:`~humansim_ros.render.ALL_CHANNELS`.
        moving_camera: Whether the camera moves. Then the image of the static scene is not cached.
        next_frame: Next frame, for the channels ``flow`` and ``flow_hidden``.
        previous_frame: Previous frame, for the channels ``flow_back`` and ``flow_back_hidden``.
        backdrop: Image behind the scene. If None, the background has the colour of the light.
    """

    bodies: Sequence[Body]
    camera: Camera
    channels: Collection[str] = CHANNELS
    moving_camera: bool = False
    next_frame: AdjacentFrame | None = None
    previous_frame: AdjacentFrame | None = None
    backdrop: Backdrop | None = None

    def adjacent(self, name: AdjacentName) -> AdjacentFrame | None:
        """Return the next or the previous frame."""
        return self.next_frame if name == "next_frame" else self.previous_frame

    def check(self, renderer: Renderer) -> None:
        """Raise RenderError if a renderer cannot satisfy the request."""
        check_channels(self.channels)
        check_bodies(self.bodies)
        if missing := sorted(set(self.channels) - set(renderer.channels)):
            text = f"{renderer.name} does not render {', '.join(missing)}: use the renderer moderngl"
            raise RenderError(text)
        shapes = [body.vertices.shape for body in self.bodies]
        for channel in self.channels:
            name = CHANNEL_TABLE[channel].adjacent_frame
            if name is None:
                continue
            frame = self.adjacent(name)
            if frame is None:
                raise RenderError(f"{channel} needs {name}")
            if [body.vertices.shape for body in frame.bodies] != shapes:
                raise RenderError(f"{name} has other bodies than the frame")
            check_bodies(frame.bodies)


class Renderer(ABC):
    """Renders bodies in a static scene as a camera sees them. A subclass defines ``channels``, the channels
    that it supports, ``name``, :meth:`render_request` and :meth:`close`. Use it in a ``with`` statement, or
    call :meth:`close`, to free its memory at once."""

    channels: Collection[str]
    name: str

    @property
    def device(self) -> str:
        """Name of the device that renders. Empty if it is not known."""
        return ""

    def __enter__(self: _Self) -> _Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __reduce__(self) -> NoReturn:
        text = "a renderer and its Simulation cannot be copied to another process: make one in each"
        raise RenderError(text)

    @overload
    def render(self, request: RenderRequest, /) -> View: ...

    @overload
    def render(
        self,
        bodies: Sequence[Body],
        camera: Camera,
        channels: Collection[str] = CHANNELS,
        moving_camera: bool = False,
        next_frame: AdjacentFrame | None = None,
        previous_frame: AdjacentFrame | None = None,
        backdrop: Backdrop | None = None,
    ) -> View: ...

    def render(self, *request: Any, **fields: Any) -> View:
        """Render one view of a :class:`RenderRequest`.

        The arguments are a request, or those of its constructor: ``render(bodies, camera, ("rgb",))``.
        Results for a Body are cached: pass the same Body objects for all cameras of a frame.

        Raises:
            RenderError: A channel is unknown, not supported or lacks its adjacent frame, a body is not
                valid, or OpenGL failed.
        """
        given = len(request) == 1 and isinstance(request[0], RenderRequest)
        asked: RenderRequest = request[0] if given else RenderRequest(*request, **fields)
        asked.check(self)
        return self.render_request(asked)

    @abstractmethod
    def render_request(self, request: RenderRequest) -> View:
        """Render a checked request."""

    def check_usable(self) -> None:
        """Raise RenderError if the renderer has been closed, or belongs to another thread or process. A
        renderer without OpenGL may be usable anywhere."""
        return

    @abstractmethod
    def close(self) -> None:
        """Free the OpenGL context and all resources."""


class NoRenderer(Renderer):
    """Stands in for a renderer where nothing is rendered. It needs no OpenGL."""

    channels = ()
    name = "no renderer"

    def render_request(self, request: RenderRequest) -> View:
        """Raise RenderError."""
        raise RenderError("nothing is rendered here")

    def close(self) -> None:
        """Do nothing."""


def check_bodies(bodies: Sequence[Body]) -> None:
    """Raise RenderError if a body cannot be rendered, or if two bodies cannot be in one frame."""
    labels = Counter(body.instance for body in bodies if body.instance)
    unlabelled = [id(body.mesh) for body in bodies if not body.instance]
    if len(set(unlabelled)) < len(unlabelled):
        raise RenderError("two bodies without a label cannot share a mesh")
    for body in bodies:
        if body.vertices.shape != body.mesh.vertices.shape:
            n = len(body.mesh.vertices)
            raise RenderError(f"vertices of shape {body.vertices.shape} do not fit a mesh of {n}")
        if not np.isfinite(body.vertices).all():
            raise RenderError(f"a vertex of body {body.instance} is not finite (NaN or infinity)")
        if not 0 <= body.instance < 65536:
            raise RenderError(f"an instance label must be 0 to 65535, not {body.instance}")
        if labels[body.instance] > 1:
            raise RenderError(f"instance label {body.instance} twice: each body needs its own")
        if body.parts.shape != (len(body.mesh.triangles),):
            n = len(body.mesh.triangles)
            raise RenderError(f"part labels of shape {body.parts.shape} do not fit a mesh of {n} triangles")


def _read_only(array: NDArray[Any]) -> NDArray[Any]:
    """Return the array if neither it nor its base array can be written to; else a read-only copy."""
    base: Any = array
    while isinstance(base, np.ndarray):
        if base.flags.writeable:
            copy = array.copy()
            copy.setflags(write=False)
            return copy
        base = base.base
    return array
