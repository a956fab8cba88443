"""One topic: name, type, quality of service, and how its messages are built from a simulated frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Generic, TypeVar

from humansim_ros.data.messages.types import name_of
from humansim_ros.scene.core import NO_FAULTS, Frame, FrameFaults, Needs

Content = TypeVar("Content")

#: Depth of the queue of a publisher: for messages of frames (the same as camera drivers), and for messages
#: that are sent once.
DATA_DEPTH, LATCHED_DEPTH = 5, 1


@dataclass(frozen=True)
class Topic(Generic[Content]):
    """One topic.

    Attributes:
        name: Relative name.
        type: Message class.
        build: Builds the message from a content and a stamp in nanoseconds.
        content: Function that returns the content (the argument of ``build``) of a simulated frame.
        latched: Whether late subscribers get the last message.
        per_frame: Whether each frame has a message (for a camera, each frame that it captures). If False,
            there is one message for the whole scene.
        shown: Whether ``humansim demo`` shows the topic.
        camera: Name of the camera that the topic belongs to. Empty for humans and objects.
        channels: Image channels that the message is built from.
        rectified_depth: Whether the message needs the depth of ``image_rect``.
        optional: Whether a recording includes the topic only on request.
        explains: Whether other topics need this topic to be understood. Recordings of them include it.
        faulty: Whether faults of the camera change stamps, and when and how often messages are sent.
        raw: For compressed images, the topic with the same images uncompressed. Empty for other topics.
        scanner: Name of the laser scanner that the topic belongs to. Empty for other topics.
        sparse: Whether a frame may have no message of this topic, or several. Lockstep does not wait for
            them.
        absolute: Whether the name does not depend on the namespace of the node.
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

    @cached_property
    def needs(self) -> Needs:
        """What the message needs of a frame."""
        cameras = (self.camera,) if self.camera else ()
        scanners = (self.scanner,) if self.scanner else ()
        return Needs(self.channels, cameras, scanners, cameras if self.rectified_depth else ())

    def in_namespace(self, namespace: str) -> str:
        """Absolute name of the topic for nodes in a namespace."""
        return f"/{self.name}" if self.absolute else f"{namespace.rstrip('/')}/{self.name}"

    @property
    def type_name(self) -> str:
        """Name of the message type, such as ``sensor_msgs/msg/Image``."""
        return name_of(self.type)

    @property
    def depth(self) -> int:
        """Depth of the queue of the publisher, in messages."""
        return LATCHED_DEPTH if self.latched else DATA_DEPTH

    @property
    def recorded(self) -> bool:
        """Whether a recording includes the topic by default."""
        return self.shown or self.explains or bool(self.scanner) or (self.latched and not self.optional)

    def sent(self, frame: Frame) -> list[tuple[int, Any]]:
        """Messages of a simulated frame, each with the time in nanoseconds when it is sent."""
        if self.scanner:
            content: Any = frame.sweeps[self.scanner]
            return [(frame.stamp, self.build(sweep, sweep.stamp)) for sweep in content]
        if self.per_frame and self.camera and self.camera not in frame.views:
            return []  # the camera does not capture this frame
        sent = self._faults(frame).sent
        message = self.message(frame) if sent else None
        return [(frame.stamp + after, message) for after in sent]

    def message(self, frame: Frame) -> Any:
        """Build the message of a simulated frame."""
        return self.build(self.content(frame), self._faults(frame).stamp(frame.stamp))

    def _faults(self, frame: Frame) -> FrameFaults:
        return frame.faults[self.camera] if self.faulty else NO_FAULTS


def sent_once(name: str, kind: type[Any], build: Callable[[], Any], **settings: Any) -> Topic[None]:
    """Topic with one message for the whole scene. ``settings``: other attributes of the topic."""
    return Topic(name, kind, lambda *_: build(), lambda _: None, latched=True, per_frame=False, **settings)
