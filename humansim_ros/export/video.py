"""MP4 of each camera, made of the images of the export."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import cv2
import numpy as np

from humansim_ros.drawing.canvas import write_mp4
from humansim_ros.drawing.views import color_image
from humansim_ros.errors import ExportError
from humansim_ros.export.folder import ExportFolder
from humansim_ros.export.writer import FormatWriter, Record
from humansim_ros.io.files import ANY_SIZE, read_bytes
from humansim_ros.types import Image


class VideoWriter(FormatWriter):
    """A video for each camera, H.264, at the rate of the scene; odd sides lose their last pixel."""

    def finish(self, records: Iterable[tuple[int, Record]], folder: ExportFolder) -> None:
        """Write the videos."""
        for camera in self.settings.cameras:
            with folder.path(f"{camera}.mp4") as path:
                write_mp4(path, self._images(camera, folder), self.settings.rate)

    def _images(self, camera: str, folder: ExportFolder) -> Iterator[Image]:
        """Images (H, W, 3) of a camera, RGB."""
        encoding = self.settings.scene.cameras[camera].encoding
        for index in self.settings.frames:
            path = folder.root / self.settings.image(camera, index)
            encoded = np.frombuffer(read_bytes(path, ExportError, "image", ANY_SIZE), np.uint8)
            image = cv2.imdecode(encoded, cv2.IMREAD_UNCHANGED) if encoded.size else None
            if image is None:
                raise ExportError("this image of the export cannot be read", path=path)
            # images in colour are in the order of OpenCV, whatever the camera delivers
            yield color_image(np.asarray(image, np.uint8), "bgr8" if image.ndim == 3 else encoding)
