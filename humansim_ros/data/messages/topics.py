"""The table of all topics of a scene: name, type, quality of service, and the function that builds its
messages.

The nodes publish the topics of this table, ``humansim demo`` subscribes to them, and ``humansim record``
writes them to bags. Nothing here is a node: :meth:`Topic.message` builds the message from a frame of a
simulation.

Names are relative: a node puts them into its namespace, a recording into ``/``.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from operator import attrgetter, methodcaller
from typing import Any

from numpy.typing import NDArray

from humansim_ros.cameras.camera import Camera, Region
from humansim_ros.cameras.sensor import DepthSensor
from humansim_ros.data import messages
from humansim_ros.data.messages.adapters import AdapterTopic, adapter_topics, section_of
from humansim_ros.data.messages.camera_truth import (
    boxes_message,
    faults_message,
    joint_view_message,
    overlay_message,
    visible_vertices_message,
)
from humansim_ros.data.messages.cameras import (
    camera_info_message,
    extrinsics_message,
    object_message,
    projection_message,
    transform_message,
)
from humansim_ros.data.messages.headers import (
    TF_STATIC_TOPIC,
    TF_TOPIC,
    depth_optical_frame,
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
from humansim_ros.data.messages.images import (
    DepthCompression,
    ImageCompression,
    compressed_depth_message,
    compressed_image_message,
    image_message,
    mask_pixels,
)
from humansim_ros.data.messages.legends import (
    faults_legend,
    instance_legend,
    joints_legend,
    keypoints_legend,
    live_legend,
    material_legend,
    motion_legend,
    part_legend,
)
from humansim_ros.data.messages.points import image_points_message
from humansim_ros.data.messages.robot import in_odometry, odometry_message
from humansim_ros.data.messages.scanners import (
    points_message,
    scan_message,
    scanner_frame,
    scanner_truth_message,
)
from humansim_ros.data.messages.topic import Topic
from humansim_ros.data.messages.transforms import TF, fixed_transform, transform_topics
from humansim_ros.data.messages.types import (
    CameraInfo,
    CompressedImage,
    DiagnosticArray,
    Float64MultiArray,
    Header,
    Image,
    ImageMarker,
    JointState,
    LaserScan,
    Marker,
    MarkerArray,
    MultiDOFJointState,
    Odometry,
    PointCloud2,
    PoseStamped,
    String,
    TimeReference,
    TransformStamped,
    TwistStamped,
)
from humansim_ros.data.messages.types import Mesh as MeshMessage
from humansim_ros.errors import SceneError
from humansim_ros.geometry import ObjectPose
from humansim_ros.motion.body import JointPoses, Rated
from humansim_ros.people.keypoints import KEYPOINT_SETS, KeypointLocator, KeypointSet, has_exact_skin
from humansim_ros.render.interface import ALL_CHANNELS, CHANNEL_TABLE, Channel, View
from humansim_ros.scene.config import LIVE
from humansim_ros.scene.core import (
    Actor,
    CameraPose,
    DepthCapture,
    Frame,
    FrameFaults,
    JointSource,
    Robot,
    Scene,
    SceneCamera,
    SceneObject,
)
from humansim_ros.scene.features import ROBOT, SceneScanner, Sweep
from humansim_ros.scene.pictures import color_image
from humansim_ros.scene.truth import REQUIRED_CHANNELS, CameraTruth, HumanState

#: Topic with the scene time of each frame (sensor_msgs/TimeReference).
SCENE_TIME = "scene_time"

#: By channel: last part of the name of its compressed topic, after the name of its raw topic.
COMPRESSED = {
    "rgb": "compressed",
    "depth": "compressedDepth",
    # labels fit into a PNG unchanged, so a recording may have them as PNG
    **{row.name: "compressed" for row in CHANNEL_TABLE.values() if row.encoding in ("mono8", "mono16")},
}

#: Channel by name of its topic below a camera, without the channels that have a topic for each body.
CHANNEL_OF_TOPIC = {row.topic: name for name, row in CHANNEL_TABLE.items() if not row.per_body}

#: Namespaces of measured depth below a camera: depth in the pixels of the depth sensor, and depth converted
#: to the pixels of ``image_raw``.
MEASURED_DEPTH = ("depth_sensor", "aligned_depth_to_color")
_WHOLE_SENSOR = Region()
#: Measurement of a depth sensor, and the view of its camera.
DepthContent = tuple[DepthCapture, View]

#: Channels with topics that ``humansim demo`` shows.
_SHOWN_CHANNELS = ("rgb", "depth", "part")
#: By property of :class:`CameraTruth`: the function that builds its message.
_TRUTH: Mapping[str, Callable[..., PointCloud2]] = {
    "joints": joint_view_message,
    "boxes": boxes_message,
    "visible_vertices": visible_vertices_message,
}
#: Legends that a recording includes only on request.
_OPTIONAL_LEGENDS = ("keypoints", "body_part", "material")
_DEFAULT_COMPRESSION = ImageCompression()

#: Topics of the nodes themselves, which do not depend on the scene.
_TOPICS_OF_NODES = (
    *(TF_TOPIC, TF_STATIC_TOPIC, "clock", "frame_done"),
    *("diagnostics", "parameter_events", "rosout"),
)


def _sent_once(name: str, kind: type[Any], build: Callable[[], Any], **settings: Any) -> Topic[None]:
    """Topic with one message for the whole scene. ``settings``: other attributes of the topic."""
    return Topic(name, kind, lambda *_: build(), lambda _: None, latched=True, per_frame=False, **settings)


def _label_legends(scene: Scene) -> dict[str, Callable[[], String]]:
    """Functions that build the legends of the channels ``instance`` and ``part``, by channel. A legend says
    what each number of a label image means."""
    legends = {"instance": lambda: instance_legend(scene.labels)}
    if scene.actors:
        skeleton = next(iter(scene.actors.values())).human.skeleton
        legends["part"] = lambda: part_legend(skeleton)
    return legends


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
        keypoints: Keypoints in ``map`` by set.
        face: Weights of facial expressions. None if the face does not move.
        swing: Swing of loose cloth and hair. None if the human has none.
    """

    def __init__(self, actor: Actor, live: bool = False) -> None:
        """Create the topics. ``live``: another node moves the human."""
        name, root = actor.name, f"humans/{actor.name}"
        self._actor = actor

        def state(frame: Frame) -> HumanState:
            return frame.humans[name]

        self.live = live
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
            f"{root}/frame",
            Header,
            lambda _, stamp: messages.header(stamp, messages.WORLD_FRAME),
            lambda _: None,
        )

        def of_body(path: str, kind: type[Any], build: Callable[[HumanState, int], Any]) -> Topic[HumanState]:
            return Topic(f"{root}/{path}", kind, build, state, shown=path != "markers")

        def rated(path: str, rest: Rated) -> Callable[[HumanState, int], JointState]:
            return lambda body, stamp: rated_message(body.features.get(path, rest), stamp)

        self.joints = of_body("joints", MultiDOFJointState, joints_message)
        self.vertices = of_body(
            "vertices", PointCloud2, lambda body, stamp: vertices_message(body.vertices, stamp)
        )
        self.markers = of_body(
            "markers",
            MarkerArray,
            lambda body, stamp: self.marker_builder.build(name, actor.instance, body, stamp),
        )
        self.mesh = _sent_once(f"{root}/mesh", MeshMessage, lambda: mesh_message(actor.human.mesh))
        self.features = {
            path: of_body(path, JointState, rated(path, rest)) for path, rest in actor.features.items()
        }
        self.keypoints: dict[str, Topic[HumanState]] = {
            keypoints.name: self._keypoint_topic(keypoints, state) for keypoints in KEYPOINT_SETS.values()
        }

    def _keypoint_topic(
        self, keypoints: KeypointSet, state: Callable[[Frame], HumanState]
    ) -> Topic[HumanState]:
        human = self._actor.human

        def message(body: HumanState, stamp: int) -> MultiDOFJointState:
            positions = KeypointLocator.of(human, keypoints).positions(body.positions, body.vertices)
            return keypoints_message(keypoints.names, positions, stamp)

        name = f"humans/{self._actor.name}/keypoints/{keypoints.name}"
        return Topic(name, MultiDOFJointState, message, state, optional=True)

    @cached_property
    def marker_builder(self) -> MarkerBuilder:
        """Builder of the markers. It is cached, since it simplifies the skin once."""
        return MarkerBuilder(self._actor.human)

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
        self.twist = topic(
            "twist", TwistStamped, lambda pose, stamp: messages.twist_message(pose.velocity, stamp)
        )

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
        self.odom: Topic[ObjectPose] = Topic(
            "odom",
            Odometry,
            lambda base, stamp: odometry_message(robot, base, stamp),
            lambda frame: frame.robot,  # type: ignore[arg-type,return-value]  # the scene has a robot
            shown=True,
        )
        odom_frame, base_frame = robot.config.odom_frame, robot.config.base_frame
        self.start = fixed_transform(robot.start, messages.WORLD_FRAME, odom_frame)

        def moved(base: ObjectPose, stamp: int) -> TransformStamped:
            pose = in_odometry(robot, base)
            return transform_message(pose.position, pose.rotation, stamp, odom_frame, base_frame)

        self.base = replace(self.start, name=TF_TOPIC, build=moved, content=self.odom.content, per_frame=True)

    def __iter__(self) -> Iterator[Topic[Any]]:
        return iter((self.odom,))


class CameraTopics:
    """Topics of one camera, ``<camera>/…``.

    Args:
        scene: The scene.
        camera: The camera.
        frame: Name of the optical frame. If None, it follows from the name of the camera. Images and
            calibrations of the right camera of a stereo pair have the frame of the left camera, as
            image_geometry expects.
        channels: Channels that the renderer supports. Other channels have no topic.

    Attributes:
        images: Images by channel. A channel with an image per body has a topic for each body.
        png_labels: Label images as PNG (8 and 16 bit integers). Only recordings have them.
        rectified: Images without lens distortion by channel. Empty if the camera has no distortion.
        info: Calibration. It is in the namespace of the colour image, where image_transport expects it.
        truth_infos: True calibration: a topic in the namespace of each channel other than the colour image.
        depth_sensor: Topics of the depth sensor; None if the camera has none.
        truth: Joints, boxes and visible vertices, by property of :class:`CameraTruth`.
        keypoints: Keypoints by set.
        overlay: Joints to be drawn over the colour image by viewers.
        legends: Meaning of the numbers in images, joints and keypoints; and the settings of faults.
        faults: Faults of each frame. Empty for a camera without faults.
        extrinsics: Pose according to the calibration. If the camera moves, there is a message for each frame.
        true_extrinsics: True pose of a camera with a wrong calibration.
        projection: Projection matrix. If the camera moves, there is a message for each frame.
        transforms: Transforms for tf: ``extrinsics`` or the pose of the camera on the robot, and the depth
            sensor.
        pose: Pose of a camera with a trajectory.
        twist: Velocity of a camera with a trajectory.
    """

    def __init__(
        self,
        scene: Scene,
        camera: SceneCamera,
        frame: str | None = None,
        channels: Collection[str] = ALL_CHANNELS,
    ) -> None:
        self._scene, self._camera = scene, camera
        self._name = name = camera.name
        self._has_faults = camera.faults is not None
        self._frame = frame = messages.optical_frame(name) if frame is None else frame
        # P of a right camera is meant for points in the frame of the left camera
        self._image_frame = frame.replace(name, camera.left) if camera.left else frame
        supported = [channel for channel in CHANNEL_TABLE.values() if channel.name in channels]
        self.images: Sequence[Topic[View]] = [
            topic for channel in supported for topic in self._channel_topics(channel)
        ]
        self.png_labels: Sequence[Topic[View]] = [
            topic
            for channel in supported
            if channel.name in COMPRESSED and channel.encoding.startswith("mono")
            for topic in self._channel_topics(channel, ImageCompression("png"))
        ]
        self.rectified = {} if camera.rectified is None else self._rectified_topics()
        namespaces = dict.fromkeys(topic.rpartition("/")[0] for topic in CHANNEL_OF_TOPIC)

        info = partial(_info_topic, name, frame=self._image_frame, region=camera.region)
        self.info = info(camera.published, shown=True, faulty=self._has_faults)
        self.truth_infos = [info(camera.whole, path=f"{each}/camera_info") for each in namespaces if each]
        self.depth_sensor: DepthSensorTopics | None = None
        if camera.depth_sensor is not None:
            self.depth_sensor = DepthSensorTopics(camera, camera.depth_sensor, frame)

        def of_truth(
            path: str,
            build: Callable[..., Any],
            kind: type[Any] = PointCloud2,
            needs: str = "joints",
            **settings: Any,
        ) -> Topic[CameraTruth]:
            needed = frozenset(REQUIRED_CHANNELS[needs])
            return Topic(
                f"{name}/{path}",
                kind,
                build,
                lambda simulated: simulated.truth[name],
                camera=name,
                channels=needed,
                **settings,
            )

        self.truth = {
            kind: of_truth(kind, self._builder(build, attrgetter(kind)), needs=kind, shown=kind == "joints")
            for kind, build in _TRUTH.items()
        }
        self.keypoints = {
            keypoints: of_truth(
                f"keypoints/{keypoints}",
                self._builder(joint_view_message, methodcaller("keypoints", keypoints)),
                optional=True,
            )
            for keypoints in KEYPOINT_SETS
        }
        # about four pixels in an image of 640 x 480
        radius = max(2.0, min(camera.camera.size) / 120)
        self.overlay = of_truth(
            "overlay",
            lambda truth, stamp: overlay_message([*truth.joints.values()], radius, stamp, frame),
            ImageMarker,
        )
        self.legends: Sequence[Topic[None]] = self._legend_topics()
        self.faults: Sequence[Topic[FrameFaults]] = [] if camera.faults is None else [self._faults_topic()]

        def posed(path: str, kind: type[Any], build: Callable[[Camera, int], Any]) -> Topic[Camera]:
            return Topic(
                f"{name}/{path}",
                kind,
                build,
                # also for a camera that is not rendered, since tf has all cameras
                lambda simulated: camera.published_at(
                    simulated.camera_poses.get(name) or CameraPose.of(camera.camera)
                ),
                latched=True,
                per_frame=camera.moves,
                camera=name,
            )

        self.extrinsics = posed(
            "extrinsics",
            TransformStamped,
            lambda camera, stamp: extrinsics_message(camera, stamp, frame),
        )
        self.true_extrinsics: Topic[Camera] | None = None
        if camera.faults is not None and camera.faults.calibration is not None:
            self.true_extrinsics = replace(
                self.extrinsics,
                name=f"{name}/truth/extrinsics",
                content=lambda simulated: simulated.cameras.get(name, camera.camera),
                per_frame=camera.moves or camera.drifts,
                explains=True,
            )
        self.projection = posed("projection", Float64MultiArray, lambda camera, _: projection_message(camera))
        self.transforms: list[Topic[Any]] = [self.extrinsics]
        if camera.mount is not None:
            place, robot = camera.mount
            self.transforms = [fixed_transform(place, robot.config.base_frame, frame)]
        if self.depth_sensor is not None:
            self.transforms.append(self.depth_sensor.extrinsics)
        self.twist, self.pose = moving_camera_topics(name)

    def compressed(self, settings: ImageCompression) -> Topic[View]:
        """Images as JPEG or PNG, in the format of image_transport's plugin ``compressed``."""
        (topic,) = self._channel_topics(CHANNEL_TABLE["rgb"], settings)
        return topic

    def compressed_depth(self, settings: DepthCompression) -> Topic[View]:
        """Depth as PNG of 16 bits, in the format of image_transport's plugin ``compressedDepth``."""
        (topic,) = self._channel_topics(CHANNEL_TABLE["depth"], settings)
        return topic

    def __iter__(self) -> Iterator[Topic[Any]]:
        return iter(self.all(_DEFAULT_COMPRESSION))

    def all(self, compression: ImageCompression) -> Sequence[Topic[Any]]:
        """All topics of the camera. ``compression``: settings of the compressed images."""
        moving = (self.twist, self.pose) if self._camera.moves else ()
        compressed = self.compressed(compression), self.compressed_depth(DepthCompression())
        truth = [*self.truth.values(), *self.keypoints.values(), self.overlay]
        rectified = self.rectified.values()
        poses = [self.extrinsics, self.projection, *moving]
        if self.true_extrinsics is not None:
            poses.append(self.true_extrinsics)
        return [
            *self.faults,
            *self.legends,
            *poses,
            *self.images,
            *compressed,
            *rectified,
            self.info,
            *self.truth_infos,
            *(self.depth_sensor or ()),
            *truth,
        ]

    def _encoding(self, channel: Channel) -> str:
        return channel.encoding or self._camera.encoding

    def _channel_topics(
        self, channel: Channel, compression: ImageCompression | DepthCompression | None = None
    ) -> Sequence[Topic[View]]:
        """Topic of a channel; a channel with an image per body has one topic for each body. ``compression``:
        None for raw images."""
        name, frame, encoding = self._name, self._image_frame, self._encoding(channel)
        is_raw = compression is None

        def topic(path: str, image: Callable[[View], NDArray[Any]]) -> Topic[View]:
            def message(view: View, stamp: int) -> Any:
                if compression is None:
                    return image_message(image(view), encoding, stamp, frame)
                if isinstance(compression, DepthCompression):
                    return compressed_depth_message(image(view), compression, stamp, frame)
                return compressed_image_message(image(view), encoding, compression, stamp, frame)

            return Topic(
                f"{name}/{path}" if is_raw else f"{name}/{path}/{COMPRESSED[channel.name]}",
                Image if is_raw else CompressedImage,
                message,
                lambda simulated: simulated.views[name],
                shown=is_raw and channel.name in _SHOWN_CHANNELS,
                camera=name,
                channels=frozenset({channel.name}),
                raw="" if is_raw else f"{name}/{path}",
                faulty=self._has_faults and channel.name == "rgb",
            )

        def of_body(label: int) -> Callable[[View], NDArray[Any]]:
            return lambda view: mask_pixels(getattr(view, channel.name)[label])

        if not channel.per_body:
            return [topic(channel.topic, lambda view: getattr(view, channel.name))]
        labels = self._scene.labels.items()
        return [topic(channel.topic.format(body=body), of_body(label)) for body, label in labels]

    def _rectified_topics(self) -> dict[str, Topic[NDArray[Any]]]:
        """Topics of images without lens distortion by channel."""
        name, frame, camera = self._name, self._image_frame, self._camera

        def topic(channel: Channel, content: Callable[[Frame], NDArray[Any]], **needs: Any) -> Topic[Any]:
            encoding = self._encoding(channel).replace("bayer_rggb8", "rgb8")
            return Topic(
                f"{name}/{channel.rectified_topic}",
                Image,
                lambda image, stamp: image_message(image, encoding, stamp, frame),
                content,
                camera=name,
                **needs,
            )

        return {
            "rgb": topic(
                CHANNEL_TABLE["rgb"],
                lambda simulated: camera.rectify(simulated.views[name].rgb),
                channels=frozenset({"rgb"}),
                faulty=self._has_faults,
            ),
            "depth": topic(
                CHANNEL_TABLE["depth"],
                lambda simulated: simulated.rectified_depth[name],
                rectified_depth=True,
            ),
        }

    def _builder(
        self, build: Callable[..., PointCloud2], values: Callable[[CameraTruth], Mapping[str, Any]]
    ) -> Callable[[CameraTruth, int], PointCloud2]:
        """Make a function that builds a message from the truth. ``values``: takes from the truth the values
        by human or object. ``build``: builds the message from these values."""
        labels, frame = self._scene.labels, self._frame

        def message(truth: CameraTruth, stamp: int) -> PointCloud2:
            return build([(labels[name], value) for name, value in values(truth).items()], stamp, frame)

        return message

    def _legend_topics(self) -> Sequence[Topic[None]]:
        scene, actors = self._scene, list(self._scene.actors.values())
        joints = {actor.name: (actor.instance, actor.human.skeleton.joint_names) for actor in actors}
        legends = _label_legends(scene)
        licenses = {actor.name: text for actor in actors if (text := actor.human.license)}
        legends["joints"] = lambda: joints_legend(
            joints, scene.object_labels, licenses, scene.config.license or ""
        )
        exact = {actor.name: (actor.instance, has_exact_skin(actor.human)) for actor in actors}
        legends["keypoints"] = lambda: keypoints_legend(exact, scene.object_labels)
        if actors:
            legends["body_part"] = legends["part"]
            legends["material"] = material_legend

        if (faults := self._camera.faults) is not None:
            legends["faults"] = lambda: faults_legend(faults)
        name = self._name
        return [
            _sent_once(
                f"{name}/{kind}/legend", String, build, camera=name, optional=kind in _OPTIONAL_LEGENDS
            )
            for kind, build in legends.items()
        ]

    def _faults_topic(self) -> Topic[FrameFaults]:
        name, frame = self._name, self._frame
        return Topic(
            f"{name}/faults",
            DiagnosticArray,
            lambda faults, stamp: faults_message(faults, stamp, frame),
            lambda simulated: simulated.faults[name],
            camera=name,
            explains=True,
        )


def _info_topic(
    name: str,
    whole: Camera,
    frame: str,
    region: Region = _WHOLE_SENSOR,
    path: str = "camera_info",
    **settings: Any,
) -> Topic[Camera]:
    """Create the topic of a calibration.

    Args:
        name: Name of the camera.
        whole: Calibration of the whole sensor.
        frame: Name of the optical frame.
        region: Binning and region of interest of the images.
        path: Name of the topic below the camera.
        settings: Other attributes of the topic.
    """
    return Topic(
        f"{name}/{path}",
        CameraInfo,
        lambda whole, stamp: camera_info_message(whole, stamp, frame, region),
        lambda _: whole,
        camera=name,
        **settings,
    )


class DepthSensorTopics:
    """Topics of the depth sensor of a camera (docs/depth_cameras.md).

    Args:
        camera: The camera.
        sensor: Its depth sensor.
        frame: Optical frame of the camera.

    Attributes:
        optics: Size and K of the sensor, and its pose in the optical frame of the camera.
        info: Its calibration.
        aligned_info: Calibration for the depth that is converted to the pixels of ``image_raw``. None if
            there is no such depth.
        extrinsics: Pose of its optical frame in the optical frame of the camera.
        measured: Topics of measured depth, exact depth, and points.
    """

    def __init__(self, camera: SceneCamera, sensor: DepthSensor, frame: str) -> None:
        self._name, self._faulty = name, faulty = camera.name, camera.faults is not None
        own = depth_optical_frame(frame)
        self.optics = sensor.optics
        self.info = _info_topic(
            name, sensor.optics, own, path="depth_sensor/camera_info", shown=True, faulty=faulty
        )
        self.aligned_info: Topic[Camera] | None = None
        self.extrinsics: Topic[Camera] = Topic(
            f"{name}/depth_sensor/extrinsics",
            TransformStamped,
            lambda optics, stamp: extrinsics_message(optics, stamp, own, frame),
            lambda _: sensor.optics,
            latched=True,
            per_frame=False,
            camera=name,
        )
        self.measured = [
            self._image("depth_sensor/image_raw", "16UC1", own, lambda each: each.measured, shown=True),
            self._image("depth_sensor/image", "32FC1", own, lambda each: each.depth),
            self._image("depth_sensor/image_truth", "32FC1", own, lambda each: each.exact, faulty=False),
            self._topic(
                "depth_sensor/points",
                PointCloud2,
                lambda each, _, stamp: image_points_message(each.points, None, stamp, own),
            ),
        ]
        if sensor.config.aligned:
            self._add_aligned(camera, frame)

    def _add_aligned(self, camera: SceneCamera, frame: str) -> None:
        def points(capture: DepthCapture, view: View, stamp: int) -> PointCloud2:
            colors = color_image(view.rgb, camera.encoding)
            return image_points_message(capture.color_points, colors, stamp, frame)

        self.aligned_info = _info_topic(
            self._name,
            camera.published,
            frame,
            camera.region,
            "aligned_depth_to_color/camera_info",
            faulty=self._faulty,
        )
        self.measured += [
            self._image("aligned_depth_to_color/image_raw", "16UC1", frame, lambda each: each.aligned),
            self._topic("points", PointCloud2, points, channels=frozenset({"rgb"})),
        ]

    def _image(
        self,
        path: str,
        encoding: str,
        frame: str,
        image: Callable[[DepthCapture], NDArray[Any]],
        **settings: Any,
    ) -> Topic[DepthContent]:
        def message(capture: DepthCapture, _: View, stamp: int) -> Image:
            return image_message(image(capture), encoding, stamp, frame)

        return self._topic(path, Image, message, **settings)

    def _topic(
        self,
        path: str,
        kind: type[Any],
        build: Callable[[DepthCapture, View, int], Any],
        faulty: bool | None = None,
        **settings: Any,
    ) -> Topic[DepthContent]:
        name = self._name
        return Topic(
            f"{name}/{path}",
            kind,
            lambda content, stamp: build(*content, stamp),
            lambda simulated: (simulated.depth_sensors[name], simulated.views[name]),
            camera=name,
            faulty=self._faulty if faulty is None else faulty,
            **settings,
        )

    def __iter__(self) -> Iterator[Topic[Any]]:
        infos = [self.info] if self.aligned_info is None else [self.info, self.aligned_info]
        return iter([self.extrinsics, *infos, *self.measured])


def moving_camera_topics(name: str) -> tuple[Topic[CameraPose], Topic[CameraPose]]:
    """Create the topics ``twist`` and ``pose`` of a camera with a trajectory. Each frame has a message."""

    def content(frame: Frame) -> CameraPose:
        return frame.camera_poses[name]

    twist: Topic[CameraPose] = Topic(
        f"{name}/twist",
        TwistStamped,
        lambda pose, stamp: messages.twist_message(pose.velocity, stamp),
        content,
    )
    pose: Topic[CameraPose] = Topic(f"{name}/pose", PoseStamped, messages.pose_message, content)
    return twist, pose


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
            lambda pose, stamp: transform_message(
                pose.position, pose.rotation, stamp, messages.WORLD_FRAME, frame
            ),
            lambda simulated: scanner.pose(simulated.scene_time * 1e-9, simulated.objects.get(ROBOT)),
            latched=True,
            per_frame=scanner.moves,
        )
        self.transform: Topic[ObjectPose] = self.extrinsics
        if scanner.mount is not None:
            place, base = scanner.route.at(0.0), scanner.mount.config.base_frame
            self.transform = fixed_transform(place, base, frame)
        self.legends = [
            _sent_once(f"{name}/{kind}/legend", String, build)
            for kind, build in _label_legends(scene).items()
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
        RosError: See :func:`~humansim_ros.data.messages.adapters.adapter_topics`.
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
