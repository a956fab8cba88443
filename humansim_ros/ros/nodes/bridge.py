"""Node ``bridge``: publishes the truth of a scene in the messages of other people stacks.

A scene says in its section ``adapters`` which (docs/people_messages.md). The node subscribes to what they are
made of: joints and vertices of the humans, and topics of cameras such as ``<camera>/boxes``, also of a bag
that is played. It joins them by exact stamp, and publishes with that stamp. Messages without subscribers are
not built.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

from humansim_ros import messages
from humansim_ros.errors import HumansimError, SceneError
from humansim_ros.messages.adapters import CAMERA_INPUTS, AdapterTopic, adapter_topics, received_frame
from humansim_ros.messages.frames import Frames
from humansim_ros.ros.frame_synchronizer import FrameSynchronizer
from humansim_ros.ros.node import SceneNode
from humansim_ros.ros.qos import subscription_profile
from humansim_ros.ros.runtime import run_node
from humansim_ros.scene import Scene
from humansim_ros.scene.capture import SceneState

#: In place of a topic: bodies and objects of a frame.
_STATE = "state"
#: Frames that wait for a topic of a camera, and nanoseconds by which a stamp goes back in a new run.
_MAX_FRAMES, _NEW_RUN = 16, 10**9


class _Join(NamedTuple):
    """Topics that are made of the same messages, and these messages by stamp."""

    camera: str
    topics: list[AdapterTopic]
    frames: Frames[Any]


class BridgeNode(SceneNode):
    """Publishes the topics of the adapters of a scene."""

    def __init__(self, scene: Scene | None = None, **options: Any) -> None:
        super().__init__("bridge", scene, **options)
        description = "Text before the frames of cameras and scanners, such as lab/"
        topics = adapter_topics(self.scene, self.text_parameter("frame_prefix", "", description))
        if not topics:
            text = "the scene has no adapters: name them in a section 'adapters', such as people: {}"
            raise SceneError(text, path=self.scene.path, key="adapters")
        for topic in topics:
            topic.package.check(installed=True)
        per_frame = [topic for topic in topics if topic.per_frame]
        self._senders = {topic.name: self.topic_publisher(topic) for topic in per_frame}
        for topic in topics:
            if not topic.per_frame:
                self.publish_latched(topic.build(received_frame(0, None, {}, self.scene), 0), topic.name)
        #: By what their topics are made of.
        self._joins: dict[tuple[str, ...], _Join] = {}
        for topic in per_frame:
            self._join(topic)
        for name in dict.fromkeys(name for needed in self._joins for name in needed if name != _STATE):
            self._subscribe(name)
        posed = dict.fromkeys(topic.posed for topic in topics if topic.posed)
        moving = [name for name in posed if self.scene.scene_cameras[name].moves]
        # also without a topic of people: frames in lockstep wait for its reports
        self._synchronizer = FrameSynchronizer(self, self._on_state, [self], moving)
        self.get_logger().info(f"publishing {', '.join(topic.name for topic in topics)}")

    def _join(self, topic: AdapterTopic) -> None:
        needed = (*((_STATE,) if topic.people else ()), *(f"{topic.camera}/{each}" for each in topic.inputs))
        if needed not in self._joins:
            frames: Frames[Any] = Frames(needed, max_frames=_MAX_FRAMES, new_run=_NEW_RUN)
            self._joins[needed] = _Join(topic.camera, [], frames)
        self._joins[needed].topics.append(topic)

    def _subscribe(self, name: str) -> None:
        """Subscribe to a topic of a camera, with a long queue: frames in lockstep do not wait for it."""
        message_type, read = CAMERA_INPUTS[name.partition("/")[2]]
        receive: Callable[[Any], None] = partial(self._on_message, name, read)
        self.create_subscription(message_type, name, receive, subscription_profile([]))

    def _on_message(self, name: str, read: Callable[[Any, Scene], Any], message: Any) -> None:
        try:
            content = read(message, self.scene)
        except HumansimError as error:
            self.report_skipped(f"{name}: {error}")
        else:
            self._add(name, messages.to_nanoseconds(message.header.stamp), content)

    def _on_state(self, state: SceneState) -> None:
        if not state.is_preview:
            self._add(_STATE, state.stamp, state)

    def _add(self, name: str, stamp: int, content: Any) -> None:
        """Add what has arrived, and publish what is whole with it."""
        for needed, join in self._joins.items():
            if name in needed and join.frames.add(name, stamp, content):
                with self.skip_frame_on_error():
                    self._publish(join, stamp, needed)

    def _publish(self, join: _Join, stamp: int, needed: Sequence[str]) -> None:
        found = join.frames.pop(stamp)
        wanted = [topic for topic in join.topics if self._senders[topic.name].get_subscription_count()]
        if not wanted:
            return
        of_camera = {name.partition("/")[2]: found[name] for name in needed if name != _STATE}
        cameras = {join.camera: of_camera} if of_camera else {}
        frame = received_frame(stamp, found.get(_STATE), cameras, self.scene)
        for topic in wanted:
            self._senders[topic.name].publish(topic.build(frame, stamp))
        self.count("frames")
        self.report_lateness(stamp)


def main(scene: Scene | None = None) -> int:
    """Run the node; returns its exit code. ``scene``: the scene of its parameter, if it is loaded already."""
    return run_node(lambda: BridgeNode(scene=scene))
