"""What sources of topics have in common: a bag, and a running graph."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence

from humansim_ros.camera import Camera
from humansim_ros.humans import Human
from humansim_ros.mesh.mesh import Mesh
from humansim_ros.view.seen_topics import SeenTopics
from humansim_ros.view.source import JOINTS, ViewSource
from humansim_ros.view.topic_frames import TopicFrames

#: Period of a source with a single frame, nanoseconds.
PERIOD = 33_333_333
#: Frames from which the skin of a body that is not known is found.
SAMPLES = 4


class TopicSource(ViewSource):
    """Source of a page that shows topics. ``shown``: reads the messages of frames."""

    def __init__(self, shown: TopicFrames) -> None:
        self._shown = shown

    @property
    @abstractmethod
    def topics(self) -> SeenTopics:
        """Topics that are shown."""

    @property
    def people(self) -> Mapping[str, Human]:
        return self._shown.people

    @property
    def objects(self) -> Mapping[str, Mesh]:
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
    def channels(self) -> tuple[str, ...]:
        """Channels that there are, and joints over the image if there are people."""
        names = list(self.topics.channels)
        if "rgb" in names and self.topics.people:
            names.insert(names.index("rgb") + 1, JOINTS)
        return tuple(names)

    @property
    def messages(self) -> Sequence[str]:
        return self._shown.messages
