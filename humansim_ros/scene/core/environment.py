"""Static surroundings of a scene: room, mesh files, lighting, and the photographs and panoramas behind."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.errors import SceneError, in_section, located, unknown
from humansim_ros.files.mesh import Mesh, read_materials_z_up
from humansim_ros.files.reading import (
    MAX_IMAGE_BYTES,
    MAX_PIXELS,
    declared_size,
    decode_image,
    open_file,
    read_bytes,
    reading_errors,
)
from humansim_ros.geometry import from_degrees
from humansim_ros.render.device import ImageBackdrop, Panorama, ambient
from humansim_ros.render.interface import Backdrop, Lighting, tone_mapped
from humansim_ros.scene.config.config import SceneConfig, WorldMeshConfig
from humansim_ros.scene.core.looks import random_light
from humansim_ros.scene.core.source import SceneSource
from humansim_ros.scene.features.room import RoomConfig

#: Sizes in metres beyond which the unit of a mesh file is probably wrong.
_LARGE, _SMALL = 1000.0, 0.02


@dataclass(frozen=True)
class Fixture:
    """Furniture of the room that stands on the floor.

    Attributes:
        center: Center x and y in ``map``, metres.
        size: Size along x and y, metres.
        top: Height of a surface that somebody may sit on, metres; None for none.
    """

    center: tuple[float, float]
    size: tuple[float, float]
    top: float | None = None


def _no_meshes(_: bool) -> Sequence[Mesh]:
    return ()


@dataclass(frozen=True)
class Furnishing:
    """Furniture of the room.

    Attributes:
        fixtures: What stands on the floor, by name.
        build: Makes the meshes of the room in ``map``. Argument: whether their textures are needed.
    """

    fixtures: Mapping[str, Fixture] = field(default_factory=dict)
    build: Callable[[bool], Sequence[Mesh]] = _no_meshes


@dataclass(frozen=True)
class Environment:
    """Static surroundings of a scene.

    Attributes:
        mesh_files: Meshes of its mesh files, in ``map``, metres.
        room: Size and seed of the furnished room; None for no room.
        lighting: Light, shadows and tone mapping.
        backdrop: Image behind everything; a plain colour if None.
        furnishing: Furniture of the room.
    """

    mesh_files: tuple[Mesh, ...] = ()
    room: RoomConfig | None = None
    lighting: Lighting = field(default_factory=Lighting)
    backdrop: Backdrop | None = None
    furnishing: Furnishing = field(default_factory=Furnishing)

    @classmethod
    def load(cls, config: SceneConfig, source: SceneSource, furnishing: Furnishing) -> Environment:
        """Load the environment of a scene. Raises HumansimError, which names the key."""
        world, files = config.world, enumerate(config.world.meshes)
        meshes = tuple(mesh for n, item in files for mesh in _load_meshes(item, source, f"world.meshes.{n}"))
        random = config.randomise is not None and config.randomise.light
        light = random_light(config.light, config.randomise) if random and config.randomise else config.light
        lighting = Lighting(**light.model_dump(), shadow_catcher=world.shadow_catcher)
        backdrop: Backdrop | None = None
        if world.environment is not None:
            with in_section("world.environment"):
                radiance = load_panorama(source.find(world.environment))
            backdrop = Panorama(tone_mapped(radiance, lighting), math.radians(world.environment_yaw_deg))
            sky, ground = ambient(radiance)
            if "sky_color" not in light.model_fields_set:
                lighting = replace(lighting, sky_color=sky)
            if "ground_color" not in light.model_fields_set:
                lighting = replace(lighting, ground_color=ground)
        if isinstance(world.background, str):
            with in_section("world.background"):
                backdrop = load_backdrop(source.find(world.background))
        elif world.background is not None:
            lighting = replace(lighting, background=world.background)
        return cls(meshes, config.room, lighting, backdrop, furnishing)

    @cached_property
    def meshes(self) -> tuple[Mesh, ...]:
        """Meshes of the room and of the mesh files."""
        return (*self.furnishing.build(True), *self.mesh_files)

    @cached_property
    def room_shapes(self) -> Sequence[Mesh]:
        """Meshes of the room, maybe with blank textures."""
        return self.furnishing.build(False)


def _load_meshes(config: WorldMeshConfig, source: SceneSource, key: str) -> list[Mesh]:
    """Meshes of a mesh file in ``map``."""
    with in_section(f"{key}.file"):
        mesh = source.mesh(config.file)
        meshes = read_materials_z_up(source.find(config.file), config.up_axis) if mesh is None else [mesh]
    rotation = config.scale * from_degrees(config.rotation_deg).as_matrix()
    meshes = [replace(m, vertices=m.vertices @ rotation.T + np.array(config.position)) for m in meshes]
    points = np.concatenate([mesh.vertices for mesh in meshes])
    side = float(np.ptp(points, axis=0).max())
    if side > _LARGE:
        source.warn(
            key,
            f"{config.file} is {side:.0f} m large, and nothing is rendered beyond 200 m: if its unit is "
            "a millimetre, give scale: 0.001",
        )
    elif side < _SMALL:
        source.warn(key, f"{config.file} is {1000 * side:.2g} mm large: give its scale")
    return meshes


_RADIANCE = re.compile(rb"^#\?(RADIANCE|RGBE)\b.*?\n\s*?\n-Y (\d{1,6}) \+X (\d{1,6})\n", re.DOTALL)
_EXR = b"\x76\x2f\x31\x01"
#: Largest panorama file: 8192 x 4096 pixels of four channels without compression.
_MAX_BYTES = 1 << 30
#: Most pixels in a byte of Radiance files: a run of 127 equal values of one channel has two bytes.
_MOST_PER_BYTE = 16
#: Most values in all channels of an OpenEXR file, which are decoded together.
_MAX_VALUES = 4 * MAX_PIXELS
#: Columns of the largest panorama in memory: a camera of 60 degrees sees 700 of them.
_MAX_WIDTH = 4096
#: Rows that are converted to light together.
_STRIP = 256

#: Light (N, W, 3) of some rows of an image.
_LightOfRows = Callable[[slice], NDArray[np.float32]]


def load_backdrop(path: Path) -> ImageBackdrop:
    """Read a photograph (PNG or JPEG). Raises SceneError with the path."""
    with located(SceneError, path):
        data = read_bytes(path, SceneError, "photograph", MAX_IMAGE_BYTES)
        return ImageBackdrop(decode_image(data, "photograph"))


def load_panorama(path: Path) -> NDArray[np.float32]:
    """Read a panorama: Radiance (.hdr), OpenEXR if its package is installed, PNG or JPEG with 1 as white.

    Returns:
        Linear light (H, W, 3), at most 4096 columns.

    Raises:
        SceneError: With the path, if the file is no panorama.
    """
    file = open_file(path, SceneError, "panorama", _MAX_BYTES)
    with located(SceneError, path), file, reading_errors(path, SceneError, "panorama"):
        if file.read(len(_EXR)) == _EXR:
            # the library takes a path; this one is of the file that is open
            return _read_exr(f"/proc/self/fd/{file.fileno()}")
        file.seek(0)
        data = file.read()
        return _read_radiance(data) if declared_size(data) is None else _read_photograph(data)


def _read_photograph(data: bytes) -> NDArray[np.float32]:
    """Light of a PNG or JPEG file."""
    _check_size(*(declared_size(data) or (0, 0)))
    image = decode_image(data, "panorama")
    return _reduced(image.shape, lambda rows: np.square(image[rows] / np.float32(255), dtype=np.float32))


def _read_radiance(data: bytes) -> NDArray[np.float32]:
    header = _RADIANCE.match(data[:65536])
    if header is None:
        raise SceneError("this is no panorama: neither Radiance (.hdr) nor OpenEXR, PNG or JPEG")
    height, width = int(header[2]), int(header[3])
    _check_size(width, height)
    if width * height > _MOST_PER_BYTE * len(data):
        raise SceneError("the panorama is damaged: its file is too short for its size")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
    except cv2.error:
        image = None
    if image is None or image.dtype != np.float32:
        raise SceneError("the panorama cannot be decoded: it is damaged")
    decoded = np.asarray(image[..., ::-1], dtype=np.float32)
    return _reduced(decoded.shape, lambda rows: decoded[rows])


def _read_exr(path: str) -> NDArray[np.float32]:
    """Light of the first part of an OpenEXR file."""
    try:
        import OpenEXR
    except ImportError:
        message = "to read OpenEXR files, pip install OpenEXR; or save the panorama as Radiance (.hdr)"
        raise SceneError(message) from None
    try:
        with OpenEXR.File(path, header_only=True) as file:
            low, high = (np.asarray(corner, dtype=int) for corner in file.header()["dataWindow"])
            channels = len(file.header()["channels"])
        width, height = (high - low + 1).tolist()
        _check_size(width, height)
        if width * height * channels > _MAX_VALUES:
            raise SceneError(f"{channels} channels of {width} x {height} pixels are too many")
        with OpenEXR.File(path, separate_channels=True) as file:
            pixels = {name: np.asarray(channel.pixels) for name, channel in file.channels().items()}
    except (RuntimeError, ValueError, TypeError, KeyError):
        raise SceneError("the panorama cannot be decoded: it is damaged") from None
    missing = [name for name in "RGB" if name not in pixels]
    if missing:
        raise SceneError(unknown("channel", missing[0], pixels, "the panorama"))
    if any(pixels[name].shape != (height, width) for name in "RGB"):
        raise SceneError("the panorama's channels are not of one size")
    return _reduced(
        (height, width),
        lambda rows: np.stack([pixels[name][rows] for name in "RGB"], axis=-1).astype(np.float32),
    )


def _reduced(shape: Sequence[int], light: _LightOfRows) -> NDArray[np.float32]:
    """Light of an image (height, width, ...) with at most 4096 columns, converted some rows at a time."""
    height, width = shape[:2]
    columns = min(width, _MAX_WIDTH)
    out = np.empty((height, columns, 3), np.float32)
    for top in range(0, height, _STRIP):
        rows = _finite(light(slice(top, top + _STRIP)))
        out[top : top + _STRIP] = (
            rows if columns == width else cv2.resize(rows, (columns, len(rows)), interpolation=cv2.INTER_AREA)
        )
    if columns == width:
        return out
    size = columns, round(height * columns / width)
    return np.asarray(cv2.resize(out, size, interpolation=cv2.INTER_AREA), dtype=np.float32)


def _check_size(width: int, height: int) -> None:
    """Check the size in the header of a panorama, before it is decoded."""
    if not 0 < width * height <= MAX_PIXELS:
        raise SceneError(f"a panorama of {width} x {height} pixels is too large")
    if not 1.9 < width / height < 2.1:
        raise SceneError(f"a panorama is twice as wide as high, this one is {width} x {height}")


def _finite(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Light without NaN, infinity and negative values."""
    light = np.nan_to_num(image, nan=0.0, posinf=65504.0)
    return np.ascontiguousarray(np.clip(light, 0.0, 65504.0), dtype=np.float32)
