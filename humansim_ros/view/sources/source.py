"""Interface of the sources of a page: people, objects, cameras and images of a scene, bag or graph."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from humansim_ros.cameras.camera import Camera
from humansim_ros.data.engine import ProcessJob
from humansim_ros.files.mesh import Mesh
from humansim_ros.people.humans import Human
from humansim_ros.scene.config import FIRST_STAMP
from humansim_ros.types import Array, Image
from humansim_ros.view.sources.topic_people import Estimate
from humansim_ros.view.sources.tracks import Tracks

#: Extra channel of the page, which no renderer has: the image with the joints drawn over it.
JOINTS = "joints"
#: Width of images on the page, pixels.
IMAGE_WIDTH = 640
#: Channels that can be scaled by averaging pixels. Other channels have labels or sharp edges.
_SMOOTH = ("rgb", JOINTS, "shadow", "alpha")


@dataclass(frozen=True, kw_only=True)
class ViewFrame:
    """One frame for the page: poses of everything that moves, and images.

    Attributes:
        index: Number of the frame.
        stamp: Nanoseconds.
        scene_time: Nanoseconds since the start of the scene.
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
            surfaces. For a moving scanner, its pose at the stamp of the sweep is used, as RViz does.
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
    """Values of a pixel, or of a point of a person, for the user.

    Attributes:
        values: Texts to show, by name, in this order.
        world: Point (3,) on the surface in ``map``, metres; None without surface or depth.
    """

    values: Mapping[str, str]
    world: Array | None = None


@dataclass(frozen=True)
class FrameRequest:
    """What the page wants to get with a frame, in addition to the poses.

    Attributes:
        cameras: Cameras with images that are wanted.
        channels: Channels that are wanted.
        wait: Whether to wait for the images of this frame. Otherwise the latest images are returned.
        full: Cameras whose images keep their size. Other images are scaled down.
        scans: Whether points of laser scanners are wanted.
    """

    cameras: Collection[str] = ()
    channels: Collection[str] = ()
    wait: bool = False
    full: Collection[str] = ()
    scans: bool = False


#: Request for a frame without images.
POSES = FrameRequest()


class ViewSource(ABC):
    """Source of what a page shows. All methods are called in one thread.

    Attributes:
        renders: Whether the source renders its images itself, so that images come soon after the start.
        scanners: Names of the laser scanners with points that can be shown.
        start: Stamp of the first frame, nanoseconds.
        estimate: An estimate from files that is shown next to the truth; None if there is none.
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
        """Bodies in the rest pose, with their outfits, by name of the person."""

    @property
    @abstractmethod
    def objects(self) -> Mapping[str, Mesh]:
        """Meshes of moving objects by name, in their own frame."""

    @property
    @abstractmethod
    def static(self) -> Mapping[str, Mesh]:
        """Meshes of the room and of static objects in ``map``, by name."""

    @property
    @abstractmethod
    def cameras(self) -> Mapping[str, Camera]:
        """Cameras by name, at their initial or last known poses."""

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
        """Text about a running graph: delay of the frames, and lost images; empty for other sources."""
        return ""

    @property
    @abstractmethod
    def messages(self) -> Sequence[str]:
        """Messages for the user, such as "the bag has no images"."""

    @abstractmethod
    def frame(self, index: int, wanted: FrameRequest = POSES) -> ViewFrame:
        """Return the frame with number ``index``, with images. A live source returns its latest frame."""

    def prepare(self, cameras: Collection[str], channels: Collection[str], alone: bool = False) -> None:
        """Start slow preparations, such as rendering the first images, before a browser opens the page.

        Args:
            cameras: Cameras with images that will be wanted.
            channels: Channels that will be wanted.
            alone: Whether this process has no other threads and no OpenGL yet, so that it can be forked.
        """
        del cameras, channels, alone

    @abstractmethod
    def describe(self, camera: str, x: int, y: int) -> PixelInfo:
        """Values, as topics have them, of a pixel (column, row) of the frame that was returned last."""

    def tracks(self) -> ProcessJob | None:
        """Job that reads the tracks of the timeline (``tracks.py``). If None, the source has no timeline."""
        return None

    def live_tracks(self) -> Tracks | None:
        """Present tracks of a live source; None for other sources, and before the first frame."""
        return None

    @abstractmethod
    def close(self) -> None:
        """Free processes, renderers and subscriptions."""


def fitted(image: Image, width: int | None, channel: str) -> Image:
    """Scale an image down if it is wider than ``width`` pixels (None: never). Labels are not averaged."""
    if width is None or image.shape[1] <= width:
        return image
    height = max(1, round(image.shape[0] * width / image.shape[1]))
    method = cv2.INTER_AREA if channel in _SMOOTH else cv2.INTER_NEAREST
    return np.asarray(cv2.resize(image, (width, height), interpolation=method), dtype=np.uint8)


def jpeg_of(image: Image, side: int | None = None) -> bytes:
    """Encode an image (H, W, 3) as a JPEG file. ``side``: the longer side is scaled down to these pixels."""
    scale = 1.0 if side is None else side / max(image.shape[:2])
    if scale < 1:
        smaller = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        image = np.asarray(smaller, dtype=np.uint8)
    return bytes(cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 90])[1])
