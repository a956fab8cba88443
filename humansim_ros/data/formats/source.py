"""Sources of exports: they provide the frames. A scene is simulated; a bag is read (``formats/bag.py``)."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol

import cv2
import numpy as np

from humansim_ros.data.formats.formats import SWEEPS, ExportFormat, needed_channels
from humansim_ros.data.formats.writer import ExportScene
from humansim_ros.errors import ExportError, SceneError
from humansim_ros.files.reading import package_version, read_blocks
from humansim_ros.render.device import rendering_device
from humansim_ros.render.interface import NoRenderer
from humansim_ros.scene.config import map_files
from humansim_ros.scene.core import Frame, Needs, Scene, SceneCamera, Simulation


class FrameReader(Protocol):
    """Provides frames in any order, in one process.

    Attributes:
        device: Device that renders. Empty if nothing is rendered.
    """

    device: str

    def frame(self, index: int) -> Frame:
        """Make a frame with the data that the formats need. Raises HumansimError if that fails."""

    def close(self) -> None:
        """Free the renderer, or close the bag."""


class ExportSource(Protocol):
    """A scene or bag that is exported to some formats. It can be copied to another process."""

    @property
    def formats(self) -> Sequence[ExportFormat]:
        """The formats that are written."""

    @property
    def keypoints(self) -> str:
        """Name of the keypoint set."""

    @property
    def scene(self) -> ExportScene:
        """Description of the scene for the writers of formats."""

    @property
    def hash(self) -> str:
        """Hash that is equal for sources that lead to the same exported files."""

    @property
    def step(self) -> str:
        """Name of the step that makes frames, for the summary of costs."""

    @property
    def count(self) -> int | None:
        """Number of frames; None for a scene, which has no end."""

    def device(self) -> str:
        """Device that renders. Empty if nothing is rendered. Raises RenderError if OpenGL is missing."""

    def open(self) -> FrameReader:
        """Create a reader of the frames. Raises HumansimError if this machine cannot."""

    def provenance(self, frames: range) -> dict[str, Any]:
        """Describe where the data of some frames come from, for the index of an export."""


@dataclass(frozen=True)
class SimulatedSource:
    """A scene as source of an export: its frames are simulated.

    Attributes:
        simulated: The scene.
        formats: The formats that are written.
        keypoints: Name of the keypoint set.
        title: Name of the scene in the files. If empty, the name of the scene file.
    """

    simulated: Scene
    formats: tuple[ExportFormat, ...]
    keypoints: str = "coco17"
    title: str = ""
    step = "rendering and motion"
    count = None

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.simulated, self.formats, self.keypoints, self.title)

    @cached_property
    def scene(self) -> ExportScene:
        """Description of the scene for the writers of formats."""
        scene = ExportScene.of(self.simulated)
        return replace(scene, title=self.title) if self.title else scene

    @cached_property
    def hash(self) -> str:
        """Hash of the scene and of the files that it names."""
        return scene_hash(self.simulated)

    def device(self) -> str:
        """Device that renders. Empty if nothing is rendered. Raises RenderError if OpenGL is missing."""
        if not needed_channels(self.formats):
            return ""
        return rendering_device()

    def open(self) -> FrameReader:
        """Load the renderer if a format has images.

        Raises:
            ExportError: A format needs a laser scanner, and the scene has none.
            RenderError: OpenGL is missing.
        """
        sweeping = [row.name for row in self.formats if SWEEPS in row.content]
        if sweeping and not self.simulated.scanners:
            raise ExportError(f"{sweeping[0]} needs a laser scanner, and the scene has none", key="--format")
        return _SimulatedFrames(self.simulated, Needs.of(self.formats))

    def provenance(self, frames: range) -> dict[str, Any]:
        """Describe the scene, seeds, versions, and the faults of cameras that have faults."""
        scene, config = self.simulated, self.simulated.config
        origin = {
            "scene_file": scene.path.name if scene.path else None,
            "scene": config.model_dump(mode="json", exclude_defaults=True),
            "seeds": dict(_seeds(config.model_dump(mode="json"), "")),
            "versions": versions(),
        }
        faults = {
            name: _faults(camera, frames) for name, camera in scene.scene_cameras.items() if camera.faults
        }
        return {**origin, "faults": faults} if faults else origin


def _faults(camera: SceneCamera, frames: range) -> dict[str, Any]:
    """Describe a camera with faults: faults by frame, whether images are sent, and published calibration."""
    assert camera.faults is not None
    published = camera.published_at(camera.pose(0.0))
    of_frames = {index: camera.faults.at(index) for index in camera.timing.frames(frames)}
    return {
        "published_calibration": {key: getattr(published, key).tolist() for key in ("K", "R", "t")},
        "lost": [index for index, faults in of_frames.items() if not faults.sent],
        "frames": {str(index): dict(faults.kinds) for index, faults in of_frames.items() if faults.kinds},
    }


class _SimulatedFrames:
    """Makes frames of a scene with what formats need."""

    def __init__(self, scene: Scene, needs: Needs) -> None:
        self._needs = needs
        self._simulation = Simulation(scene, renderer=None if needs.channels else NoRenderer())
        self.device = self._simulation.renderer.device

    def frame(self, index: int) -> Frame:
        """Render a frame."""
        return self._simulation.frame(index, self._needs)

    def close(self) -> None:
        """Free the renderer."""
        self._simulation.close()


def versions() -> dict[str, str]:
    """Versions of this package and of the packages that influence the numbers in the files."""
    return {
        "humansim_ros": package_version(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "opencv": cv2.__version__,
    }


def _seeds(value: Any, key: str) -> Iterator[tuple[str, int]]:
    """Yield the random seeds in a configuration with their keys, also seeds with default values."""
    if isinstance(value, dict):
        for name, part in value.items():
            if name == "seed":
                yield f"{key}{name}", part
            else:
                yield from _seeds(part, f"{key}{name}.")


def scene_hash(scene: Scene) -> str:
    """Hash of a scene: its settings, and the content of the files that they name."""
    digest = hashlib.sha256(scene.config.model_dump_json().encode())

    def add(name: str) -> str:
        path = scene.source.folder / name.split("#")[0]
        if path.is_file():
            digest.update(f"{name}\n".encode())
            for block in read_blocks(path, SceneError, "scene"):
                digest.update(block)
        return name

    map_files(scene.config.model_dump(exclude_none=True), add)
    return digest.hexdigest()
