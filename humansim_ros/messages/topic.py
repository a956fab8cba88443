"""One topic: name, type, quality of service, and how its messages are built from a frame of a simulation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

from humansim_ros.messages.types import name_of
from humansim_ros.scene.faults import NO_FAULTS, FrameFaults
from humansim_ros.scene.simulation import Frame

Content = TypeVar("Content")

#: Messages that publishers hold: of frame data, as camera drivers do, and of messages that are sent once.
DATA_DEPTH, LATCHED_DEPTH = 5, 1


@dataclass(frozen=True)
class Topic(Generic[Content]):
    """One topic.

    Attributes:
        name: Relative name.
        type: Message class.
        build: Builds the message from its content and a stamp in nanoseconds.
        content: Returns the content from a frame of a simulation.
        latched: Late subscribers get the last message.
        per_frame: Each frame has a message, and of a camera each frame in which it takes a picture;
            otherwise there is one for the scene.
        shown: ``humansim demo`` shows it.
        camera: Name of the camera to which it belongs; empty for humans and objects.
        channels: Channels of the view that the message is built from.
        rectified_depth: The message needs the depth of ``image_rect``.
        optional: A recording has it only if it is asked for.
        explains: Others cannot be understood without it: it is recorded with them.
        faulty: Faults of the camera change its stamp, and when and how often it is sent.
        raw: Name of the topic of the same images uncompressed; empty for all but compressed images.
        scanner: Name of the laser scanner of whose sweeps it is; empty otherwise.
        sparse: A frame may have no message of it, or several: recordings in lockstep do not wait for it.
        absolute: Its name does not depend on the namespace of the node.
    """

    name: str
    type: type[Any]
    build: Callable[[Content, int], Any]
    content: Callable[[Frame], Content]
    latched: bool = False
    per_frame: bool = True
    shown: bool = False
    camera: str = ""
    channels: frozenset[str] = field(default=frozenset())
    rectified_depth: bool = False
    optional: bool = False
    explains: bool = False
    faulty: bool = False
    raw: str = ""
    scanner: str = ""
    sparse: bool = False
    absolute: bool = False

    def in_namespace(self, namespace: str) -> str:
        """Absolute name of the topic of nodes in a namespace."""
        return f"/{self.name}" if self.absolute else f"{namespace.rstrip('/')}/{self.name}"

    @property
    def type_name(self) -> str:
        """Name of the message type, such as ``sensor_msgs/msg/Image``."""
        return name_of(self.type)

    @property
    def depth(self) -> int:
        """Number of messages that the publisher holds."""
        return LATCHED_DEPTH if self.latched else DATA_DEPTH

    @property
    def recorded(self) -> bool:
        """Whether it is recorded unless topics are named."""
        return self.shown or self.explains or bool(self.scanner) or (self.latched and not self.optional)

    def sent(self, frame: Frame) -> list[tuple[int, Any]]:
        """Messages of a frame of a simulation, each after the time in nanoseconds at which it is sent."""
        if self.scanner:
            content: Any = frame.sweeps[self.scanner]
            return [(frame.stamp, self.build(sweep, sweep.stamp)) for sweep in content]
        if self.per_frame and self.camera and self.camera not in frame.views:
            return []  # the camera takes no picture in this frame
        sent = self._faults(frame).sent
        message = self.message(frame) if sent else None
        return [(frame.stamp + after, message) for after in sent]

    def message(self, frame: Frame) -> Any:
        """Build the message of a frame of a simulation."""
        return self.build(self.content(frame), self._faults(frame).stamp(frame.stamp))

    def _faults(self, frame: Frame) -> FrameFaults:
        return frame.faults[self.camera] if self.faulty else NO_FAULTS
