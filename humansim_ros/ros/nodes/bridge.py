"""Node ``bridge``: publishes the truth of a scene in the messages of other people stacks.

The section ``adapters`` of a scene names these messages (docs/people_messages.md). The node subscribes to
their inputs: joints and vertices of the humans, and topics of cameras such as ``<camera>/boxes``. The inputs
may come from a bag that is played. The node combines inputs with the same stamp, and publishes the result
with this stamp. Messages without subscribers are not built. Latched messages are sent when they change.
Images are received only while a topic that needs them has subscribers. Lists of ROS4HRI are sent again each
second while no frames arrive.

Node ``hri_bridge`` publishes ROS4HRI alone (docs/ros4hri.md), also for a scene without ``hri``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

from humansim_ros.data import messages
from humansim_ros.data.messages import CAMERA_INPUTS, AdapterTopic, Frames, adapter_topics, received_frame
from humansim_ros.errors import HumansimError, SceneError, some_of
from humansim_ros.files.yaml import Section
from humansim_ros.ros.graph.qos import subscription_profile
from humansim_ros.ros.nodes.frame_synchronizer import FrameSynchronizer
from humansim_ros.ros.processes.node import SceneNode
from humansim_ros.scene.core import Scene, SceneState

#: Name of the input with bodies and objects of a frame, next to the names of topics.
_STATE = "state"
#: Most frames that wait for a topic of a camera. If a stamp goes back by more than the second number,
#: nanoseconds, a new run has begun.
_MAX_FRAMES, _NEW_RUN = 16, 10**9
#: Seconds between two checks for subscribers of crops, and seconds until lists are sent again.
_LOOK_EVERY, _AGAIN_EVERY = 0.2, 1.0


class _Join(NamedTuple):
    """Published topics that need the same inputs; and these inputs, collected by stamp."""

    camera: str
    topics: list[AdapterTopic]
    frames: Frames[Any]


class BridgeNode(SceneNode):
    """Publishes the topics of the adapters (formats of other people stacks) of a scene.

    Args:
        scene: Scene of its parameter, if it is loaded already.
        name: Name of the node.
        options: Options of the node.
    """

    def __init__(self, scene: Scene | None = None, name: str = "bridge", **options: Any) -> None:
        super().__init__(name, scene, **options)
        description = "Text before the frames of cameras and scanners, such as lab/"
        prefix = self.text_parameter("frame_prefix", "", description)
        topics = adapter_topics(self.scene, prefix, self.adapters(), installed=True)
        if not topics:
            text = "the scene has no adapters: name them in a section 'adapters', such as people: {}"
            raise SceneError(text, path=self.scene.path, key="adapters")
        per_frame = [topic for topic in topics if topic.per_frame]
        self._senders = {topic.name: self.topic_publisher(topic) for topic in per_frame}
        for topic in topics:
            if not topic.per_frame:
                self.publish_latched(topic.build(received_frame(0, None, {}, self.scene), 0), topic.name)
        #: Newest messages by topic, of topics that are latched or sent again.
        self._newest: dict[str, list[Any]] = {}
        #: Topics with the same inputs, by the names of these inputs.
        self._joins: dict[tuple[str, ...], _Join] = {}
        for topic in per_frame:
            self._join(topic)
        #: Subscriptions to topics of cameras.
        self._inputs: dict[str, Any] = {}
        self._update_inputs()
        posed = dict.fromkeys(topic.posed for topic in topics if topic.posed)
        moving = [name for name in posed if self.scene.scene_cameras[name].moves]
        # also without a topic of people: frames in lockstep wait for its reports
        self._synchronizer = FrameSynchronizer(self, self._on_state, [self], moving, previews=False)
        if any(topic.optional for topic in per_frame):
            self.create_timer(_LOOK_EVERY, self._update_inputs, clock=self._steady_clock)
        self._again = [topic.name for topic in per_frame if topic.repeated]
        self._has_sent = False
        if self._again:
            self.create_timer(_AGAIN_EVERY, self._send_again, clock=self._steady_clock)
        self.get_logger().info(f"publishing {some_of([topic.name for topic in topics])}")

    def adapters(self) -> dict[str, Section]:
        """Return the settings of the adapters to publish, by name."""
        return self.scene.config.adapter_settings

    def _join(self, topic: AdapterTopic) -> None:
        needed = (*((_STATE,) if topic.people else ()), *(f"{topic.camera}/{each}" for each in topic.inputs))
        if needed not in self._joins:
            frames: Frames[Any] = Frames(needed, max_frames=_MAX_FRAMES, new_run=_NEW_RUN)
            self._joins[needed] = _Join(topic.camera, [], frames)
        self._joins[needed].topics.append(topic)

    def _update_inputs(self) -> None:
        """Subscribe only to those topics of cameras that are needed at present."""
        needed = dict.fromkeys(
            name
            for names, join in self._joins.items()
            if any(not topic.optional or self._has_subscribers(topic) for topic in join.topics)
            for name in names
            if name != _STATE
        )
        for name in needed.keys() - self._inputs.keys():
            source = CAMERA_INPUTS[name.partition("/")[2]]
            receive: Callable[[Any], None] = partial(self._on_message, name, source.read)
            # a long queue, since frames in lockstep do not wait for it
            self._inputs[name] = self.create_subscription(
                source.type, name, receive, subscription_profile([])
            )
        for name in self._inputs.keys() - needed.keys():
            self.destroy_subscription(self._inputs.pop(name))

    def _has_subscribers(self, topic: AdapterTopic) -> bool:
        return bool(self._senders[topic.name].get_subscription_count())

    def _on_message(self, name: str, read: Callable[[Any, Scene], Any], message: Any) -> None:
        try:
            content = read(message, self.scene)
        except HumansimError as error:
            self.report_skipped(f"{name}: {error}")
        else:
            self._add(name, messages.to_nanoseconds(message.header.stamp), content)

    def _on_state(self, state: SceneState) -> None:
        self._add(_STATE, state.stamp, state)

    def _add(self, name: str, stamp: int, content: Any) -> None:
        """Add the content of an input, and publish all topics that now have all inputs for this stamp."""
        for needed, join in self._joins.items():
            if name in needed and join.frames.add(name, stamp, content):
                with self.skip_frame_on_error():
                    self._publish(join, stamp, needed)

    def _publish(self, join: _Join, stamp: int, needed: Sequence[str]) -> None:
        found = join.frames.pop(stamp)
        wanted = [
            topic for topic in join.topics if topic.latched or topic.repeated or self._has_subscribers(topic)
        ]
        if not wanted:
            return
        of_camera = {name.partition("/")[2]: found[name] for name in needed if name != _STATE}
        cameras = {join.camera: of_camera} if of_camera else {}
        frame = received_frame(stamp, found.get(_STATE), cameras, self.scene)
        for topic in wanted:
            sent = topic.messages(frame, stamp)
            if topic.latched and (not sent or sent == self._newest.get(topic.name)):
                continue  # nobody is seen, or nothing has changed since somebody was
            if topic.latched or topic.repeated:
                self._newest[topic.name] = sent
            for message in sent:
                self._senders[topic.name].publish(message)
        self._has_sent = True
        self.count("frames")
        self.report_lateness(stamp)

    def _send_again(self) -> None:
        """Send the newest lists again, unless frames have arrived since the last call."""
        for name in () if self._has_sent else self._again:
            for message in self._newest.get(name, ()):
                self._senders[name].publish(message)
        self._has_sent = False
