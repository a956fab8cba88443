"""What the page shows: people, objects, cameras and images of a scene, a bag or a running graph."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from humansim_ros.cameras.camera import Camera
from humansim_ros.data.engine import FrameJob
from humansim_ros.files.mesh import Mesh
from humansim_ros.people.humans import Human
from humansim_ros.scene.config import FIRST_STAMP
from humansim_ros.types import Array, Image
from humansim_ros.view.sources.topic_people import Estimate
from humansim_ros.view.sources.tracks import Tracks

#: Channel of a page that is no channel of a renderer: the image with the joints drawn over it.
JOINTS = "joints"
#: Width of images on the page, pixels.
IMAGE_WIDTH = 640
#: Channels with pixels that may be mixed. Others are labels or have edges.
_SMOOTH = ("rgb", JOINTS, "shadow", "alpha")


@dataclass(frozen=True, kw_only=True)
class ViewFrame:
    """Everything that moves, at one stamp.

    Attributes:
        index: Number of the frame.
        stamp: Nanoseconds.
        scene_time: Nanoseconds from the start.
        joints: Poses (J, 4, 4) in ``map`` by human, in the order of ``skeleton.joint_names``: the B bones
            first, then the end points.
        sizes: Scale of the body by human; 1 if absent.
        faces: Weights (S,) of the shapes of the face, by human. Humans with a stiff face are absent.
        objects: Poses (4, 4) in ``map`` of moving objects, with their scale.
        cameras: Cameras at their poses.
        images: RGB images (H, W, 3) for people to look at, by camera and channel.
        image_index: Number of the frame of the images. It is an earlier frame if images are slower than the
            motion. None if there are no images, or while the first images lack cameras.
        scans: Points (P, 3) in ``map`` of the last sweep of each laser scanner, by person; "" for other
            surfaces. A moving scanner is where it is at the stamp of the sweep, as RViz shows its points.
        estimate: Points (J, 3) of a tracker in ``map``, by person.
        estimate_errors: Distance of the estimate from the truth by person, millimetres.
    """

    index: int
    stamp: int
    scene_time: int
    joints: Mapping[str, Array] = field(default_factory=dict)
    sizes: Mapping[str, float] = field(default_factory=dict)
    faces: Mapping[str, Array] = field(default_factory=dict)
    objects: Mapping[str, Array] = field(default_factory=dict)
    cameras: Mapping[str, Camera] = field(default_factory=dict)
    images: Mapping[str, Mapping[str, Image]] = field(default_factory=dict)
    image_index: int | None = None
    scans: Mapping[str, Mapping[str, Array]] = field(default_factory=dict)
    estimate: Mapping[str, Array] = field(default_factory=dict)
    estimate_errors: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class PixelInfo:
    """Numbers of a pixel.

    Attributes:
        values: Text by name, in the order in which it is shown.
        world: (3,) the point on the surface in ``map``, metres; None without surface or depth.
    """

    values: Mapping[str, str]
    world: Array | None = None


@dataclass(frozen=True)
class FrameRequest:
    """What the page wants of a frame, next to the poses.

    Attributes:
        cameras: Cameras with images that are wanted.
        channels: Channels that are wanted.
        wait: The images must belong to this frame; otherwise the latest images that are ready are given.
        full: Cameras with images that keep their size. Other images are small.
        scans: Points of laser scanners are wanted.
    """

    cameras: Collection[str] = ()
    channels: Collection[str] = ()
    wait: bool = False
    full: Collection[str] = ()
    scans: bool = False


#: A frame without images.
POSES = FrameRequest()


class ViewSource(ABC):
    """Source of a page; all methods are called in one thread.

    Attributes:
        renders: Whether it renders the images itself, so that they are there soon.
        scanners: Names of the laser scanners with points that can be shown.
        start: Stamp of the first frame, nanoseconds.
        estimate: An estimate of files that is shown next to the truth; None without.
    """

    renders: bool = False
    scanners: Collection[str] = ()
    start: int = FIRST_STAMP
    estimate: Estimate | None = None

    @property
    @abstractmethod
    def title(self) -> str:
        """Title of the page."""

    @property
    @abstractmethod
    def people(self) -> Mapping[str, Human]:
        """Bodies without pose by name, in their outfit."""

    @property
    @abstractmethod
    def objects(self) -> Mapping[str, Mesh]:
        """Meshes of moving objects by name, in their own frame."""

    @property
    @abstractmethod
    def static(self) -> Mapping[str, Mesh]:
        """Meshes by name in ``map``: room, static objects."""

    @property
    @abstractmethod
    def cameras(self) -> Mapping[str, Camera]:
        """Cameras at the start, or where they were last."""

    @property
    @abstractmethod
    def period(self) -> int:
        """Nanoseconds between frames."""

    @property
    @abstractmethod
    def frames(self) -> int | None:
        """Number of frames; None for a live source, which shows its latest frame."""

    @property
    @abstractmethod
    def channels(self) -> tuple[str, ...]:
        """Channels that can be shown."""

    @property
    def timing(self) -> str:
        """How late the frames of a running graph are shown, and what is lost; empty for recordings."""
        return ""

    @property
    @abstractmethod
    def messages(self) -> Sequence[str]:
        """What the user should know, such as "the bag has no images"."""

    @abstractmethod
    def frame(self, index: int, wanted: FrameRequest = POSES) -> ViewFrame:
        """A frame with the wanted images. ``index``: its number; a live source gives its latest frame."""

    def prepare(self, cameras: Collection[str], channels: Collection[str], alone: bool = False) -> None:
        """Begin with what takes time before somebody looks.

        Args:
            cameras: Cameras with images that will be wanted.
            channels: Channels that will be wanted.
            alone: This process has no other threads yet, and no OpenGL: it can be copied.
        """
        del cameras, channels, alone

    @abstractmethod
    def describe(self, camera: str, x: int, y: int) -> PixelInfo:
        """Numbers of a pixel of the frame that was given last, as the topics say them."""

    def tracks(self) -> FrameJob | None:
        """Job that reads the tracks of the timeline (``tracks.py``). If None, the source has no timeline."""
        return None

    def live_tracks(self) -> Tracks | None:
        """Tracks of what has arrived of a live source; None for other sources, and without frames."""
        return None

    @abstractmethod
    def close(self) -> None:
        """Free processes, renderers and subscriptions."""


def fitted(image: Image, width: int | None, channel: str) -> Image:
    """Image of at most ``width`` pixels, or as it is if None; labels are not mixed."""
    if width is None or image.shape[1] <= width:
        return image
    height = max(1, round(image.shape[0] * width / image.shape[1]))
    method = cv2.INTER_AREA if channel in _SMOOTH else cv2.INTER_NEAREST
    return np.asarray(cv2.resize(image, (width, height), interpolation=method), dtype=np.uint8)


def jpeg_of(image: Image, side: int | None = None) -> bytes:
    """JPEG file of an image (H, W, 3). ``side``: most pixels of its longest side."""
    scale = 1.0 if side is None else side / max(image.shape[:2])
    if scale < 1:
        smaller = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        image = np.asarray(smaller, dtype=np.uint8)
    return bytes(cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 90])[1])
