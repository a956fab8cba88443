"""Adapters: they send ground truth as messages of other people stacks (docs/people_messages.md).

The table :data:`ADAPTERS` has a row for each adapter. The row states what the adapter needs, which topics the
adapter has, and how messages are built from a frame. A simulation makes such frames. Node ``bridge`` puts
frames together from the topics of the other nodes. The messages are the same in both cases.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from humansim_ros.data.messages.headers import TF_TOPIC, optical_frame
from humansim_ros.data.messages.people import DETECTIONS_2D, MESSAGE_TYPES
from humansim_ros.data.messages.stacks.adapter import (
    PEOPLE_MSGS,
    SPENCER_MSGS,
    VISION_MSGS,
    AdapterScene,
    AdapterTopic,
)
from humansim_ros.data.messages.stacks.hri import (
    HRI_KEYPOINTS,
    HRI_MESSAGES,
    TF_MESSAGES,
    HriFrame,
    HriTopic,
    check_ids,
    hri_person,
    hri_topics,
)
from humansim_ros.data.messages.stacks.people_messages import (
    detections_2d_message,
    detections_3d_message,
    label_info_message,
    people_message,
    tracked_persons_message,
)
from humansim_ros.data.messages.stacks.ros4hri import HriLinks
from humansim_ros.data.messages.types import (
    MessagePackage,
)
from humansim_ros.files.yaml import Section
from humansim_ros.geometry import invert_rigid, quaternion_to_matrix, transform
from humansim_ros.render.interface import CHANNEL_TABLE
from humansim_ros.scene.config import BoxesConfig, FramedConfig, HriConfig, TrackedConfig
from humansim_ros.scene.core import Frame, Scene
from humansim_ros.scene.truth import (
    REQUIRED_CHANNELS,
)


@dataclass(frozen=True)
class Adapter:
    """An adapter: sends ground truth as messages of another people stack.

    Attributes:
        name: Name of the adapter, a key in section ``adapters`` of a scene file.
        package: Package of the messages.
        message: Name of the message in the package.
        topic: Name of the topic if the scene sets no other. ``<camera>`` stands for the name of a camera.
        needs: What the messages are made from, in words for the documentation.
        topics: Function that returns the topics of the adapter in a scene.
    """

    name: str
    package: MessagePackage
    message: str
    topic: str
    needs: str
    topics: Callable[[AdapterScene, Any, str], Iterator[AdapterTopic]]

    @property
    def type(self) -> str:
        """Name of the message type, such as ``people_msgs/msg/People``."""
        return f"{self.package.name}/msg/{self.message}"

    @property
    def is_read(self) -> bool:
        """Whether the evaluation can read these messages from trackers."""
        return self.type in (*MESSAGE_TYPES, DETECTIONS_2D)


def _name(config: FramedConfig, usual: str) -> str:
    """Name of a topic without leading slash: the one in the settings, or else ``usual``."""
    return usual if config.topic is None else config.topic.lstrip("/")


def _detections_2d(scene: AdapterScene, config: BoxesConfig, usual: str) -> Iterator[AdapterTopic]:
    whole, people = config.box == "whole", list(scene.scene.actors)
    if config.cameras is None:
        cameras: Sequence[str] = list(scene.scene.scene_cameras)
    else:
        cameras = [scene.camera(name, "cameras") for name in dict.fromkeys(config.cameras)]
    for camera in cameras:
        frame_id = scene.optical(camera)
        name = usual.replace("<camera>", camera)
        if config.topic is not None:
            name = f"{camera}/{config.topic.lstrip('/')}"

        def build(frame: Frame, stamp: int, camera: str = camera, frame_id: str = frame_id) -> Any:
            boxes = frame.truth[camera].boxes
            return detections_2d_message({each: boxes[each] for each in people}, whole, stamp, frame_id)

        needed = frozenset(REQUIRED_CHANNELS["boxes"])
        yield AdapterTopic.of(
            VISION_MSGS,
            "Detection2DArray",
            name,
            build,
            camera=camera,
            channels=needed,
            people=False,
            inputs=("boxes",),
        )
        yield _label_info(name, frame_id, camera)


def _detections_3d(scene: AdapterScene, config: FramedConfig, usual: str) -> Iterator[AdapterTopic]:
    placed, name = scene.placed(config.frame), _name(config, usual)

    def build(frame: Frame, stamp: int) -> Any:
        return detections_3d_message(frame, placed, stamp)

    yield AdapterTopic.of(VISION_MSGS, "Detection3DArray", name, build, posed=placed.camera)
    yield _label_info(name, placed.frame_id)


def _label_info(topic: str, frame_id: str, camera: str = "") -> AdapterTopic:
    return AdapterTopic.of(
        VISION_MSGS,
        "LabelInfo",
        f"{topic}/label_info",
        lambda *_: label_info_message(frame_id),
        camera=camera,
        latched=True,
        per_frame=False,
        people=False,
    )


def _people(scene: AdapterScene, config: FramedConfig, usual: str) -> Iterator[AdapterTopic]:
    placed, labels = scene.placed(config.frame), scene.scene.labels

    def build(frame: Frame, stamp: int) -> Any:
        return people_message(frame, placed, labels, stamp)

    yield AdapterTopic.of(PEOPLE_MSGS, "People", _name(config, usual), build, posed=placed.camera)


def _tracked_persons(scene: AdapterScene, config: TrackedConfig, usual: str) -> Iterator[AdapterTopic]:
    placed, labels = scene.placed(config.frame), scene.scene.labels
    camera = None if config.camera is None else scene.camera(config.camera, "camera")

    def build(frame: Frame, stamp: int) -> Any:
        return tracked_persons_message(frame, placed, labels, camera, stamp)

    topic = AdapterTopic.of(SPENCER_MSGS, "TrackedPersons", _name(config, usual), build, posed=placed.camera)
    if camera is not None:
        needed = frozenset(REQUIRED_CHANNELS["boxes"])
        topic = replace(topic, camera=camera, channels=needed, inputs=("boxes",))
    yield topic


def _hri(scene: AdapterScene, config: HriConfig, _: str) -> Iterator[AdapterTopic]:
    camera, actors = scene.camera(config.camera, "camera"), scene.scene.actors
    placed, size = scene.placed(optical_frame(camera)), scene.scene.scene_cameras[camera].camera.size
    check_ids(list(actors))
    links = {name: HriLinks.of(actor.human.skeleton) for name, actor in actors.items()}
    newest: list[tuple[Frame, HriFrame]] = []

    def described(frame: Frame) -> HriFrame:
        """Describe the people of a frame. The last result is cached, since all topics use it."""
        if not newest or newest[0][0] is not frame:
            axes = placed.at(frame)
            to_camera = invert_rigid(transform(quaternion_to_matrix(axes.rotation), axes.position))
            truth = frame.truth[camera]
            keypoints = truth.keypoints(HRI_KEYPOINTS)
            people = {
                name: hri_person(
                    name,
                    links[name],
                    frame.humans[name],
                    truth.boxes[name].visible,
                    keypoints[name],
                    to_camera,
                    size,
                )
                for name in actors
            }
            newest[:] = [
                (
                    frame,
                    HriFrame(people, to_camera, lambda: (frame.views[camera].rgb, frame.encodings[camera])),
                )
            ]
        return newest[0][1]

    channels = frozenset((*REQUIRED_CHANNELS["boxes"], *REQUIRED_CHANNELS["joints"]))
    inputs = ("boxes", f"keypoints/{HRI_KEYPOINTS}")
    for topic in hri_topics(list(actors), placed.frame_id, size):
        image = topic.has_image

        def build(frame: Frame, stamp: int, topic: HriTopic = topic) -> list[Any]:
            return topic.build(described(frame), stamp)

        yield AdapterTopic(
            topic.name,
            topic.type,
            build,
            lambda frame: frame,
            latched=topic.latched,
            shown=not image,
            camera=camera,
            channels=channels | {"rgb"} if image else channels,
            optional=image,
            package=TF_MESSAGES if topic.name == TF_TOPIC else HRI_MESSAGES,
            inputs=(*inputs, CHANNEL_TABLE["rgb"].topic) if image else inputs,
            posed=camera,
            absolute=True,
            repeated=topic.repeated,
            on_demand=image,
            sparse=topic.sparse,
        )


#: The table of all adapters by name.
ADAPTERS = {
    row.name: row
    for row in (
        Adapter(
            "detections_2d",
            VISION_MSGS,
            "Detection2DArray",
            "<camera>/detections_2d",
            "boxes of the camera",
            _detections_2d,
        ),
        Adapter("detections_3d", VISION_MSGS, "Detection3DArray", "detections_3d", "bodies", _detections_3d),
        Adapter("people", PEOPLE_MSGS, "People", "people", "hips", _people),
        Adapter(
            "tracked_persons",
            SPENCER_MSGS,
            "TrackedPersons",
            "spencer/perception/tracked_persons",
            "hips; with a camera, its boxes",
            _tracked_persons,
        ),
        Adapter(
            "hri",
            HRI_MESSAGES,
            "IdsList",
            "humans/bodies/tracked",
            "joints; boxes, keypoints and image of a camera",
            _hri,
        ),
    )
}


def adapter_topics(
    scene: Scene,
    frame_prefix: str = "",
    adapters: Mapping[str, Section] | None = None,
    installed: bool = False,
) -> list[AdapterTopic]:
    """Create the topics of the adapters of a scene.

    Args:
        scene: The scene.
        frame_prefix: Text before the names of the frames of cameras and scanners.
        adapters: Settings of the adapters by name. If None, those of the scene.
        installed: Whether it is an error if a message package is not installed. Nodes need them installed.

    Raises:
        SceneError: A setting names no camera or frame of the scene. The error names file, line and key.
        RosError: A message package is neither installed nor defined, or has another version.
    """
    topics: list[AdapterTopic] = []
    settings = scene.config.adapter_settings if adapters is None else adapters
    for name, row in ADAPTERS.items():
        if (config := settings.get(name)) is not None:
            row.package.check(installed)
            with scene.source.locating_errors():
                own = row.topics(AdapterScene(scene, name, frame_prefix), config, row.topic)
                topics += [replace(topic, row=name) for topic in own]
    for package in {topic.package.name: topic.package for topic in topics}.values():
        package.check(installed)
    return topics
