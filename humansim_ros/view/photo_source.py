"""Photographs of a person as the source of a page: the fitted body among the cameras."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from humansim_ros.camera import Camera
from humansim_ros.errors import HumansimError
from humansim_ros.humans import Human
from humansim_ros.mesh.mesh import Mesh
from humansim_ros.types import Image
from humansim_ros.view.photo_document import PhotoDocument
from humansim_ros.view.photo_solver import PhotoSolver
from humansim_ros.view.pictures import fitted
from humansim_ros.view.source import PixelInfo, ViewFrame, ViewSource, Wanted

#: The only channel, and the name of the person.
PHOTOGRAPH, PERSON = "photograph", "person"
#: Greatest width of the photographs of the page, pixels.
_WIDTH = 2048


class PhotoSource(ViewSource):
    """Photographs that are edited by hand, with the person who was fitted to them.

    Attributes:
        document: The photographs.
        solver: Fits them again.
    """

    objects: Mapping[str, Mesh] = {}
    static: Mapping[str, Mesh] = {}
    channels: tuple[str, ...] = (PHOTOGRAPH,)

    def __init__(self, document: PhotoDocument) -> None:
        self.document, self.solver = document, PhotoSolver()
        self._problems: dict[str, str] = {}
        self._images: tuple[int, dict[str, dict[str, Image]]] | None = None

    @property
    def title(self) -> str:
        """Name of the views file."""
        return self.document.photos.path.stem

    @property
    def people(self) -> Mapping[str, Human]:
        """The fitted person; nobody before the first solution."""
        fit = self.document.state.fit
        return {} if fit is None else {PERSON: fit.body}

    @property
    def cameras(self) -> Mapping[str, Camera]:
        """Cameras of the views."""
        return dict(zip(self.document.photos.names, self.document.photos.cameras, strict=True))

    @property
    def period(self) -> int:
        """Nanoseconds between frames."""
        return self.document.photos.period

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.document.photos.frames)

    @property
    def messages(self) -> Sequence[str]:
        """Photographs that cannot be shown."""
        return list(self._problems.values())

    def show(self, wanted: Wanted) -> ViewFrame:
        index = wanted.index
        fit = self.document.state.fit
        joints = {}
        if fit is not None:
            joints[PERSON] = np.array(fit.body.skeleton.joint_transforms(fit.posed(index)))
        return ViewFrame(
            index=index,
            stamp=index * self.period,
            scene_time=index * self.period,
            joints=joints,
            cameras=self.cameras,
            images=self.photographs(index),
            image_index=index,
        )

    def photographs(self, index: int) -> Mapping[str, Mapping[str, Image]]:
        """Images (H, W, 3) of a frame by view and channel; those that cannot be read are left out."""
        if self._images is None or self._images[0] != index:
            self._problems = {}
            self._images = (index, {name: self._read(index, name) for name in self.document.photos.names})
        return self._images[1]

    def describe(self, camera: str, x: int, y: int) -> PixelInfo:
        """Place and colour of a pixel of the frame that was given last."""
        values = {"camera": camera, "pixel": f"{x}, {y}"}
        return PixelInfo(values)

    def close(self) -> None:
        """End the solution that runs."""
        self.solver.close()

    def _read(self, index: int, view: str) -> dict[str, Image]:
        photo = self.document.photo(index, view)
        if photo.image_path is None:
            return {}
        try:
            return {PHOTOGRAPH: fitted(photo.image(), _WIDTH, "rgb")}
        except HumansimError as error:
            self._problems[view] = str(error)
            return {}
