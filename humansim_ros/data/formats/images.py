"""Colour images, depth, labels and optical flow: an image for each camera and frame; videos of cameras."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from io import BytesIO
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.data.formats.writer import ExportFolder, ExportFrame, ExportScene, FormatWriter, Record
from humansim_ros.errors import ExportError
from humansim_ros.files.mesh import MATERIAL_LABELS
from humansim_ros.files.reading import ANY_SIZE, read_bytes
from humansim_ros.render.pictures import write_mp4
from humansim_ros.scene.pictures import color_image
from humansim_ros.types import Float32Array, Image

#: Units of 16 bit depth in a metre: millimetres. The value 0 means no depth.
_DEPTH_SCALE = 1000.0
#: Scale and zero of flow in KITTI: displacement = (value - 2^15) / 64.
_KITTI_SCALE, _KITTI_ZERO = 64.0, 1 << 15
#: First four bytes of .flo files, and the value of pixels without flow (readers take values above 1e9 as
#: unknown).
_FLO_TAG, _FLO_UNKNOWN = np.float32(202021.25), 1e10
_LARGEST_16 = (1 << 16) - 1
_JPEG_QUALITY = 95
#: Compression of PNG. Higher levels make files a few per cent smaller, but take several times as long.
_PNG_COMPRESSION = 3


class ImageWriter(FormatWriter):
    """Writes colour images for all formats: ``images/<camera>/<frame>.png``. They are the images that the
    cameras deliver: grey for mono8, the Bayer mosaic for bayer_rggb8."""

    def frame(self, frame: ExportFrame, folder: ExportFolder) -> Record:
        """Write an image for each camera. ``folder``: the folder ``images``."""
        for camera, view in frame.frame.views.items():
            encoding = self.settings.scene.cameras[camera].encoding
            image = encoded_image(view.rgb, encoding, self.settings.image_suffix)
            folder.write(f"{camera}/{frame.name}{self.settings.image_suffix}", image)


class DepthPngWriter(FormatWriter):
    """Writes depth along z as 16 bit PNG in millimetres; 0 where there is no surface, or beyond 65.535 m."""

    def frame(self, frame: ExportFrame, folder: ExportFolder) -> Record:
        for camera, view in frame.frame.views.items():
            folder.write(f"{camera}/{frame.name}.png", encoded_png(millimetres(view.depth)))


class DepthNpyWriter(FormatWriter):
    """Writes depth along z as NumPy files: (H, W) float32 metres, inf where there is no surface."""

    def frame(self, frame: ExportFrame, folder: ExportFolder) -> Record:
        for camera, view in frame.frame.views.items():
            content = BytesIO()
            np.save(content, view.depth)
            folder.write(f"{camera}/{frame.name}.npy", content.getvalue())


class DepthExrWriter(FormatWriter):
    """Writes depth along z as OpenEXR: float32 metres, inf for no surface; channel Y, which OpenCV reads."""

    def frame(self, frame: ExportFrame, folder: ExportFolder) -> Record:
        import OpenEXR

        for camera, view in frame.frame.views.items():
            header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
            with folder.path(f"{camera}/{frame.name}.exr") as path:
                OpenEXR.File(header, {"Y": np.ascontiguousarray(view.depth)}).write(str(path))


class LabelWriter(FormatWriter):
    """Writes labels as PNG (16 bit instances, 8 bit body parts), and the names of both in ``labels.json``."""

    def frame(self, frame: ExportFrame, folder: ExportFolder) -> Record:
        for camera, view in frame.frame.views.items():
            folder.write(f"instance/{camera}/{frame.name}.png", encoded_png(view.instance))
            folder.write(f"part/{camera}/{frame.name}.png", encoded_png(view.part))

    def finish(self, records: Iterable[tuple[int, Record]], folder: ExportFolder) -> None:
        scene = self.settings.scene
        instances = {"0": "background"} | {str(label): name for name, label in scene.labels.items()}
        legend = {"instance": instances, "part": _part_legends(scene)}
        folder.write("labels.json", json.dumps(legend, indent=1) + "\n")


def _part_legends(scene: ExportScene) -> dict[str, dict[str, str]]:
    """Names of the labels of body parts, by human."""
    return {
        name: {"0": "background"} | {str(n): part for n, part in enumerate(parts, 1)}
        for name, parts in scene.parts.items()
    }


class _OneLabelWriter(FormatWriter):
    """Base class: writes labels of one channel as 8 bit PNG, and their names in ``labels.json``."""

    channel: ClassVar[str]

    def legend(self) -> dict[str, Any]:
        """Names of the labels."""
        raise NotImplementedError

    def frame(self, frame: ExportFrame, folder: ExportFolder) -> Record:
        for camera, view in frame.frame.views.items():
            folder.write(f"{camera}/{frame.name}.png", encoded_png(getattr(view, self.channel)))

    def finish(self, _: Iterable[tuple[int, Record]], folder: ExportFolder) -> None:
        folder.write("labels.json", json.dumps(self.legend(), indent=1) + "\n")


class BodyPartWriter(_OneLabelWriter):
    """Writes body parts without skirts, hats, bags and long hair, and names of labels for each human."""

    channel = "body_part"

    def legend(self) -> dict[str, Any]:
        return _part_legends(self.settings.scene)


class MaterialWriter(_OneLabelWriter):
    """Writes the kind of surface: skin, hair, garment or worn thing."""

    channel = "material"

    def legend(self) -> dict[str, Any]:
        return {"0": "background"} | {str(label): name for name, label in MATERIAL_LABELS.items()}


class FloWriter(FormatWriter):
    """Writes optical flow to the next frame as ``.flo`` files of Middlebury; 1e10 for no surface."""

    def frame(self, frame: ExportFrame, folder: ExportFolder) -> Record:
        for camera, view in frame.frame.views.items():
            folder.write(f"{camera}/{frame.name}.flo", flo_bytes(view.flow))


class KittiFlowWriter(FormatWriter):
    """Writes optical flow to the next frame as 16 bit PNG of KITTI. In folder ``noc`` only pixels that stay
    visible are valid; in ``occ`` all pixels that show a surface."""

    def frame(self, frame: ExportFrame, folder: ExportFolder) -> Record:
        for camera, view in frame.frame.views.items():
            visible = view.flow_hidden == 0
            for name, valid in (("occ", np.ones_like(visible)), ("noc", visible)):
                image = kitti_flow(view.flow, valid)
                folder.write(f"flow_{name}/{camera}/{frame.name}.png", encoded_png(image))


def millimetres(depth: Float32Array) -> NDArray[np.uint16]:
    """Convert depth (H, W) from metres to 16 bit millimetres; 0 for no surface, or beyond 65.535 m."""
    scaled = np.rint(depth * _DEPTH_SCALE)
    return np.where(scaled <= _LARGEST_16, scaled, 0).astype(np.uint16)


def flo_bytes(flow: Float32Array) -> bytes:
    """Content of a ``.flo`` file with flow (H, W, 2). NaN becomes 1e10, which means unknown."""
    height, width = flow.shape[:2]
    known = np.where(np.isnan(flow), np.float32(_FLO_UNKNOWN), flow)
    return _FLO_TAG.tobytes() + np.array([width, height], "<i4").tobytes() + known.astype("<f4").tobytes()


def kitti_flow(flow: Float32Array, valid: NDArray[np.bool_]) -> NDArray[np.uint16]:
    """Convert flow to KITTI's image (H, W, 3) with channels valid, v, u. Flow beyond 512 pixels is invalid.

    ``flow``: (H, W, 2) pixels. ``valid``: (H, W), pixels to keep.
    """
    scaled = np.rint(flow * _KITTI_SCALE) + _KITTI_ZERO
    kept = valid & np.all((scaled >= 0) & (scaled <= _LARGEST_16), axis=-1)  # false for NaN
    image = np.zeros((*flow.shape[:2], 3), np.uint16)
    image[kept, 0] = 1
    image[kept, 1:] = scaled[kept][:, ::-1]
    return image


def encoded_image(image: Image, encoding: str, suffix: str) -> bytes:
    """Encode the image of a camera as PNG or JPEG.

    Args:
        image: (H, W, 3), or (H, W) for mono8 and bayer_rggb8, which stay as they are.
        encoding: ROS encoding of the image.
        suffix: ``.png`` or ``.jpg``.
    """
    ordered = image if encoding == "bgr8" or image.ndim == 2 else image[..., ::-1]
    if suffix == ".png":
        return encoded_png(ordered)
    return _encoded(suffix, ordered, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])


def encoded_png(image: NDArray[Any]) -> bytes:
    """Encode an image as PNG: (H, W) or (H, W, 3), 8 or 16 bits, channels in the order of OpenCV (BGR)."""
    return _encoded(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, _PNG_COMPRESSION])


def _encoded(suffix: str, image: NDArray[Any], options: list[int]) -> bytes:
    done, encoded = cv2.imencode(suffix, image, options)
    if not done:
        raise ExportError("an image cannot be encoded")
    return bytes(encoded.tobytes())


class VideoWriter(FormatWriter):
    """Writes an H.264 video for each camera, at its rate. An odd width or height is cut by one pixel."""

    def finish(self, records: Iterable[tuple[int, Record]], folder: ExportFolder) -> None:
        for camera in self.settings.cameras:
            with folder.path(f"{camera}.mp4") as path:
                write_mp4(path, self._images(camera, folder), self.settings.rate_of(camera))

    def _images(self, camera: str, folder: ExportFolder) -> Iterator[Image]:
        """Read the exported images (H, W, 3) of a camera, RGB, in order."""
        encoding = self.settings.scene.cameras[camera].encoding
        for index in self.settings.frames_of(camera):
            path = folder.root / self.settings.image(camera, index)
            encoded = np.frombuffer(read_bytes(path, ExportError, "image", ANY_SIZE), np.uint8)
            image = cv2.imdecode(encoded, cv2.IMREAD_UNCHANGED) if encoded.size else None
            if image is None:
                raise ExportError("this image of the export cannot be read", path=path)
            # images in colour have the channel order of OpenCV, whatever the camera delivers
            yield color_image(np.asarray(image, np.uint8), "bgr8" if image.ndim == 3 else encoding)
