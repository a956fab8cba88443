"""What sources of topics have in common: a bag, and a running graph."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence

from humansim_ros.camera import Camera
from humansim_ros.humans import Human
from humansim_ros.mesh.mesh import Mesh
from humansim_ros.view.seen_topics import SeenTopics
from humansim_ros.view.source import JOINTS, PixelInfo, ViewFrame
from humansim_ros.view.topic_frames import TopicFrames

#: Period of a source with a single frame, nanoseconds.
PERIOD = 33_333_333
#: Frames from which the skin of a body that is not known is found.
SAMPLES = 4


class TopicSource(ABC):
    """Source of a page that shows topics. ``shown``: reads the messages of frames."""

    def __init__(self, shown: TopicFrames) -> None:
        self._shown = shown

    @property
    @abstractmethod
    def title(self) -> str:
        """Title of the page."""

    @property
    @abstractmethod
    def topics(self) -> SeenTopics:
        """Topics that are shown."""

    @property
    def people(self) -> Mapping[str, Human]:
        """Bodies without pose by name."""
        return self._shown.people

    @property
    def objects(self) -> Mapping[str, Mesh]:
        """Meshes of moving objects by name, in their own frame."""
        return self._shown.objects

    @property
    def static(self) -> Mapping[str, Mesh]:
        """Nothing: no topic has the room."""
        return {}

    @property
    def cameras(self) -> Mapping[str, Camera]:
        """Cameras, where they were last."""
        return self._shown.cameras

    @property
    @abstractmethod
    def period(self) -> int:
        """Nanoseconds between frames."""

    @property
    @abstractmethod
    def frames(self) -> int | None:
        """Number of frames; None for a live source."""

    @property
    def channels(self) -> tuple[str, ...]:
        """Channels that there are, and joints over the image if there are people."""
        names = list(self.topics.channels)
        if "rgb" in names and self.topics.people:
            names.insert(names.index("rgb") + 1, JOINTS)
        return tuple(names)

    @property
    def messages(self) -> Sequence[str]:
        """What the user should know."""
        return self._shown.messages

    @abstractmethod
    def frame(
        self,
        index: int,
        cameras: Collection[str] = (),
        channels: Collection[str] = (),
        wait: bool = False,
    ) -> ViewFrame:
        """A frame.

        Args:
            index: Number of the frame; a live source gives its latest one instead.
            cameras: Cameras whose images are wanted.
            channels: Channels that are wanted.
            wait: Without meaning: images are those of the frame.
        """

    @abstractmethod
    def describe(self, camera: str, x: int, y: int) -> PixelInfo:
        """Numbers of a pixel of the frame that was given last. Raises RosError if there is no such pixel."""

    @abstractmethod
    def close(self) -> None:
        """Free files and subscriptions."""
