"""A source without content, for a file that cannot be shown yet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from humansim_ros.camera import Camera
from humansim_ros.errors import SceneError
from humansim_ros.humans import Human
from humansim_ros.mesh.mesh import Mesh
from humansim_ros.view.source import PixelInfo, ViewFrame, ViewSource, Wanted


class EmptySource(ViewSource):
    """Nothing, until the file of the page is mended.

    Args:
        title: Title of the page.
    """

    title: str = ""
    people: Mapping[str, Human] = {}
    objects: Mapping[str, Mesh] = {}
    static: Mapping[str, Mesh] = {}
    cameras: Mapping[str, Camera] = {}
    period: int = 33_333_333
    frames: int | None = 2
    channels: tuple[str, ...] = ("rgb",)
    messages: Sequence[str] = ()

    def __init__(self, title: str) -> None:
        self.title = title

    def show(self, wanted: Wanted) -> ViewFrame:
        return ViewFrame(index=0, stamp=0, scene_time=0)

    def describe(self, camera: str, x: int, y: int) -> PixelInfo:
        """Raises SceneError: there are no cameras."""
        raise SceneError(f"no camera {camera!r}: the scene could not be read")

    def close(self) -> None:
        """Nothing to free."""
