"""The table of all topics of a scene: name, type, quality of service, and the function that builds its
messages.

The nodes publish the topics of this table, ``humansim demo`` subscribes to them, and ``humansim record``
writes them to bags. Nothing here is a node: :meth:`Topic.message` builds the message from a frame of a
simulation.

Names are relative: a node puts them into its namespace, a recording into ``/``.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from functools import cached_property, partial
from typing import Any

from humansim_ros.data.messages.camera_topics import CameraTopics
from humansim_ros.data.messages.cameras import object_message, transform_message, twist_message
from humansim_ros.data.messages.headers import (
    TF_STATIC_TOPIC,
    TF_TOPIC,
    WORLD_FRAME,
    header,
    scene_time_message,
)
from humansim_ros.data.messages.humans import (
    MarkerBuilder,
    joints_message,
    keypoints_message,
    mesh_message,
    motion_message,
    rated_message,
    vertices_message,
)
from humansim_ros.data.messages.images import ImageCompression
from humansim_ros.data.messages.legends import label_legends, live_legend, motion_legend
from humansim_ros.data.messages.robot import in_odometry, odometry_message
from humansim_ros.data.messages.scanners import (
    points_message,
    scan_message,
    scanner_frame,
    scanner_truth_message,
)
from humansim_ros.data.messages.stacks.adapter import AdapterTopic, section_of
from humansim_ros.data.messages.stacks.adapters import adapter_topics
from humansim_ros.data.messages.topic import Topic, sent_once
from humansim_ros.data.messages.transforms import TF, fixed_transform, transform_topics
from humansim_ros.data.messages.types import (
    Header,
    JointState,
    LaserScan,
    Marker,
    MarkerArray,
    MultiDOFJointState,
    Odometry,
    PointCloud2,
    String,
    TimeReference,
    TransformStamped,
    TwistStamped,
)
from humansim_ros.data.messages.types import Mesh as MeshMessage
from humansim_ros.errors import SceneError
from humansim_ros.geometry import ObjectPose
from humansim_ros.motion.body import JointPoses, Rated
from humansim_ros.people.keypoints import KEYPOINT_SETS, KeypointLocator, KeypointSet
from humansim_ros.scene.config import LIVE
from humansim_ros.scene.core import Actor, Frame, JointSource, Robot, Scene, SceneObject
from humansim_ros.scene.features import ROBOT, SceneScanner, Sweep
from humansim_ros.scene.truth import HumanState

#: Topic with the scene time of each frame (sensor_msgs/TimeReference).
SCENE_TIME = "scene_time"
_DEFAULT_COMPRESSION = ImageCompression()
#: Topics of the nodes themselves, which do not depend on the scene.
_TOPICS_OF_NODES = (
    *(TF_TOPIC, TF_STATIC_TOPIC, "clock", "frame_done"),
    *("diagnostics", "parameter_events", "rosout"),
)

#: Scene time and number of each frame.
SCENE_TIME_TOPIC: Topic[tuple[int, int]] = Topic(
    SCENE_TIME,
    TimeReference,
    lambda content, stamp: scene_time_message(content[0], stamp, content[1]),
    lambda frame: (frame.scene_time, frame.index),
    explains=True,
)


class HumanTopics:
    """Topics of one human, ``humans/<id>/…``.

    Attributes:
        motion: Joints of the motion.
        legend: Meaning of the joints of the motion. Without content if another node moves the human.
        frame: Stamp of each frame. Only a human that another node moves has this topic.
        joints: Joints of the body.
        vertices: Vertices of the body.
        markers: Bones, joints and a coarse skin for viewers.
        mesh: Surface in the rest pose.
        features: Values that are no joints, such as ``face``, by name. Only what the human has is included.
        keypoints: Keypoints in ``map`` by set.
    """

    def __init__(self, actor: Actor, live: bool = False) -> None:
        """Create the topics. ``live``: another node moves the human."""
        name, root, human = actor.name, f"humans/{actor.name}", actor.human
        self._human, self.live = human, live

        def of_body(
            path: str, kind: type[Any], build: Callable[[HumanState, int], Any], **settings: Any
        ) -> Topic[HumanState]:
            return Topic(f"{root}/{path}", kind, build, lambda frame: frame.humans[name], **settings)

        def markers(body: HumanState, stamp: int) -> MarkerArray:
            return self.marker_builder.build(name, actor.instance, body, stamp)

        def feature(path: str, rest: Rated, body: HumanState, stamp: int) -> JointState:
            return rated_message(body.features.get(path, rest), stamp)

        def located(keypoints: KeypointSet, body: HumanState, stamp: int) -> MultiDOFJointState:
            positions = KeypointLocator.of(human, keypoints).positions(body.positions, body.vertices)
            return keypoints_message(keypoints.names, positions, stamp)

        self.motion: Topic[JointPoses] = Topic(
            f"{root}/motion",
            MultiDOFJointState,
            motion_message,
            lambda frame: frame.motions[name],
            shown=True,
        )
        self.legend: Topic[JointSource | None] = Topic(
            f"{root}/motion/legend",
            String,
            lambda source, _: live_legend() if source is None else motion_legend(source),
            lambda _: None if live else JointSource.of_actor(actor),
            latched=True,
            per_frame=False,
        )
        self.frame: Topic[None] = Topic(
            f"{root}/frame", Header, lambda _, stamp: header(stamp, WORLD_FRAME), lambda _: None
        )
        self.joints = of_body("joints", MultiDOFJointState, joints_message, shown=True)
        self.vertices = of_body(
            "vertices", PointCloud2, lambda body, stamp: vertices_message(body.vertices, stamp), shown=True
        )
        self.markers = of_body("markers", MarkerArray, markers)
        self.mesh = sent_once(f"{root}/mesh", MeshMessage, lambda: mesh_message(human.mesh))
        self.features = {
            path: of_body(path, JointState, partial(feature, path, rest), shown=True)
            for path, rest in actor.features.items()
        }
        self.keypoints = {
            own: of_body(f"keypoints/{own}", MultiDOFJointState, partial(located, keypoints), optional=True)
            for own, keypoints in KEYPOINT_SETS.items()
        }

    @cached_property
    def marker_builder(self) -> MarkerBuilder:
        """Builder of the markers. It is cached, since it simplifies the skin once."""
        return MarkerBuilder(self._human)

    def __iter__(self) -> Iterator[Topic[Any]]:
        driven = (self.frame,) if self.live else (self.motion,)
        body = (self.joints, self.vertices, self.markers, self.mesh)
        return iter((*driven, self.legend, *body, *self.features.values(), *self.keypoints.values()))


class ObjectTopics:
    """Topics of one moving object: ``objects/<name>/twist`` and ``objects/<name>/marker``."""

    def __init__(self, item: SceneObject) -> None:
        root = f"objects/{item.name}"

        def topic(path: str, kind: type[Any], build: Callable[[ObjectPose, int], Any]) -> Topic[ObjectPose]:
            return Topic(f"{root}/{path}", kind, build, lambda frame: frame.objects[item.name])

        self.marker = topic("marker", Marker, lambda pose, stamp: object_message(item, pose, stamp))
        self.twist = topic("twist", TwistStamped, lambda pose, stamp: twist_message(pose.velocity, stamp))

    def __iter__(self) -> Iterator[Topic[Any]]:
        return iter((self.twist, self.marker))


class RobotTopics:
    """Topics of the odometry of the robot. The body of the robot has the topics of a moving object, too.

    Args:
        robot: The robot. It must be moved by the scene, not by another node.

    Attributes:
        odom: Pose of ``base_link`` relative to its start, and its velocity.
        start: Transform from ``map`` to the frame of the odometry.
        base: Transform from the frame of the odometry to ``base_link``, with the same content as ``odom``.
    """

    def __init__(self, robot: Robot) -> None:
        odom_frame, base_frame = robot.config.odom_frame, robot.config.base_frame

        def moved(base: ObjectPose, stamp: int) -> TransformStamped:
            pose = in_odometry(robot, base)
            return transform_message(pose.position, pose.rotation, stamp, odom_frame, base_frame)

        self.odom: Topic[ObjectPose] = Topic(
            "odom",
            Odometry,
            partial(odometry_message, robot),
            lambda frame: frame.robot,  # type: ignore[arg-type,return-value]  # the scene has a robot
            shown=True,
        )
        self.start = fixed_transform(robot.start, WORLD_FRAME, odom_frame)
        self.base = replace(self.start, name=TF_TOPIC, build=moved, content=self.odom.content, per_frame=True)

    def __iter__(self) -> Iterator[Topic[Any]]:
        return iter((self.odom,))


class ScannerTopics:
    """Topics of one laser scanner, ``<scanner>/…``.

    Args:
        scene: The scene.
        scanner: The scanner.
        frame: Name of the frame of the scanner. If None, it follows from the name of the scanner.

    Attributes:
        points: Measured points, or a LaserScan.
        truth: Ground truth of each point.
        extrinsics: Pose of the scanner's frame in ``map``. If it moves, there is a message for each frame.
        transform: Transform for tf: ``extrinsics``, or the pose of the scanner on the robot.
        legends: Meaning of the labels of the truth.
    """

    def __init__(self, scene: Scene, scanner: SceneScanner, frame: str | None = None) -> None:
        name, layout = scanner.name, scanner.layout
        frame = scanner_frame(name) if frame is None else frame
        self.frame = frame

        def last(simulated: Frame) -> Sweep:
            return simulated.sweeps[name][-1]

        def of_sweep(path: str, kind: type[Any], build: Callable[[Sweep], Any]) -> Topic[Sweep]:
            return Topic(f"{name}/{path}", kind, lambda sweep, _: build(sweep), last, scanner=name)

        if layout == "scan":
            self.points = of_sweep("scan", LaserScan, lambda sweep: scan_message(sweep, scanner, frame))
        else:
            self.points = of_sweep("points", PointCloud2, lambda sweep: points_message(sweep, layout, frame))
        self.truth = of_sweep(
            "truth/points", PointCloud2, lambda sweep: scanner_truth_message(sweep, layout, frame)
        )
        self.extrinsics: Topic[ObjectPose] = Topic(
            f"{name}/extrinsics",
            TransformStamped,
            lambda pose, stamp: transform_message(pose.position, pose.rotation, stamp, WORLD_FRAME, frame),
            lambda simulated: scanner.pose(simulated.scene_time * 1e-9, simulated.objects.get(ROBOT)),
            latched=True,
            per_frame=scanner.moves,
        )
        self.transform: Topic[ObjectPose] = self.extrinsics
        if scanner.mount is not None:
            place, base = scanner.route.at(0.0), scanner.mount.config.base_frame
            self.transform = fixed_transform(place, base, frame)
        self.legends = [
            sent_once(f"{name}/{kind}/legend", String, build) for kind, build in label_legends(scene).items()
        ]

    def __iter__(self) -> Iterator[Topic[Any]]:
        return iter((*self.legends, self.extrinsics, self.points, self.truth))


def scene_topics(
    scene: Scene, compression: ImageCompression = _DEFAULT_COMPRESSION, png_labels: bool = False
) -> list[Topic[Any]]:
    """Create all topics of a scene: time, humans, moving objects, cameras, laser scanners, adapters, tf.

    Topics about the nodes themselves (``/diagnostics``, ``frame_done``) are not included.

    Args:
        scene: The scene.
        compression: Settings of the compressed images.
        png_labels: Whether topics of label images as PNG are included. No node publishes them.
    """
    topics: list[Topic[Any]] = [SCENE_TIME_TOPIC]
    transforms: list[Topic[Any]] = []
    for name, actor in scene.actors.items():
        topics += HumanTopics(actor, scene.config.humans[name].motion.file == LIVE)
    for item in scene.moving_objects.values():
        topics += ObjectTopics(item)
    if scene.robot is not None and scene.robot.config.odometry is None:
        robot = RobotTopics(scene.robot)
        topics += robot
        transforms += [robot.start, robot.base]
    for camera in scene.scene_cameras.values():
        own = CameraTopics(scene, camera)
        topics += own.all(compression)
        transforms += own.transforms
        if png_labels:
            topics += own.png_labels
    for scanner in scene.scanners.values():
        lidar = ScannerTopics(scene, scanner)
        topics += lidar
        transforms.append(lidar.transform)
    adapters = _checked_adapters(scene, {*(topic.name for topic in topics), *_TOPICS_OF_NODES})
    transforms += [topic for topic in adapters if topic.type_name == TF]
    topics += [topic for topic in adapters if topic.type_name != TF]
    return [*topics, *transform_topics(scene, transforms)]


def check_adapters(scene: Scene, installed: bool = False) -> None:
    """Check the sections ``adapters`` and ``hri`` before nodes start. Otherwise node ``bridge`` would find
    errors only when other nodes run already.

    Args:
        scene: The scene.
        installed: Whether to check also that the message packages are installed, as the node needs them.

    Raises:
        SceneError: A setting names no camera or frame of the scene, or two topics would have the same name.
        RosError: See :func:`~humansim_ros.data.messages.stacks.adapters.adapter_topics`.
    """
    if scene.config.adapter_settings:
        scene_topics(scene)  # this includes the topics of adapters
        if installed:
            adapter_topics(scene, installed=True)


def _checked_adapters(scene: Scene, names: Collection[str]) -> list[AdapterTopic]:
    """Create the topics of the adapters. Raises SceneError if two topics have the same name. ``names``: names
    of the other topics of the scene."""
    topics, settings = adapter_topics(scene), scene.config.adapter_settings
    rows = dict.fromkeys(names, "")
    for topic in topics:
        if topic.type_name == TF:
            continue  # it is a part of the topic
        if topic.name not in rows:
            rows[topic.name] = topic.row
            continue
        # the error names the topic that has a name in the scene
        blamed, other = sorted(
            (topic.row, rows[topic.name]), key=lambda row: getattr(settings.get(row), "topic", None) is None
        )
        owner, section = section_of(other) if other else "the scene", section_of(blamed)
        with scene.source.locating_errors():
            text = f"{owner} has the topic {topic.name}, too: give {section} another 'topic'"
            raise SceneError(text, key=f"{section}.topic")
    return topics


#: Used as the camera of topics that are not from the scene.
_OTHER_NODE = "/"


class TimedTopics:
    """Tells which topics have no message in a frame. Cameras may have a lower rate than the scene.

    Args:
        scene: The scene.
        namespace: Namespace of the nodes of the scene.
    """

    def __init__(self, scene: Scene, namespace: str) -> None:
        self._timings = {name: camera.timing for name, camera in scene.scene_cameras.items()}
        #: Camera of each topic of the scene. Empty for topics of no camera.
        self._cameras: dict[str, str] = {}
        if self:
            self._cameras = {topic.in_namespace(namespace): topic.camera for topic in scene_topics(scene)}

    def __bool__(self) -> bool:
        """Whether some topics have messages only in some frames."""
        return any(not timing.is_full for timing in self._timings.values())

    def resting(self, topics: Collection[str], index: int | None) -> Collection[str]:
        """Return those of ``topics`` that have no message in a frame.

        Topics of other nodes have none in a frame that no camera captures, since these nodes send results for
        pictures.

        Args:
            topics: Absolute names.
            index: Number of the frame. If None, the frame is unknown, and all topics may have a message.
        """
        if not self or index is None:
            return ()
        resting = {camera for camera, timing in self._timings.items() if index not in timing}
        if len(resting) == len(self._timings):
            resting.add(_OTHER_NODE)
        return [topic for topic in topics if self._cameras.get(topic, _OTHER_NODE) in resting]
