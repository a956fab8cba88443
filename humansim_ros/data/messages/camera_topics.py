"""Topics of one camera: images, calibration, ground truth, pose, and the depth sensor."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from operator import attrgetter, methodcaller
from typing import Any

from numpy.typing import NDArray

from humansim_ros.cameras.camera import Camera, Region
from humansim_ros.data.messages.camera_truth import (
    boxes_message,
    faults_message,
    joint_view_message,
    overlay_message,
    visible_vertices_message,
)
from humansim_ros.data.messages.cameras import (
    PublishedCalibration,
    camera_info_message,
    extrinsics_message,
    pose_message,
    projection_message,
    twist_message,
)
from humansim_ros.data.messages.headers import depth_optical_frame, optical_frame
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
    joints_legend,
    keypoints_legend,
    label_legends,
    material_legend,
)
from humansim_ros.data.messages.points import image_points_message
from humansim_ros.data.messages.topic import Topic, sent_once
from humansim_ros.data.messages.transforms import fixed_transform
from humansim_ros.data.messages.types import (
    CameraInfo,
    CompressedImage,
    DiagnosticArray,
    Float64MultiArray,
    Image,
    ImageMarker,
    PointCloud2,
    PoseStamped,
    String,
    TransformStamped,
    TwistStamped,
)
from humansim_ros.people.keypoints import KEYPOINT_SETS, has_exact_skin
from humansim_ros.render.interface import ALL_CHANNELS, CHANNEL_TABLE, Channel
from humansim_ros.scene.core import CameraPose, Frame, FrameFaults, Scene, SceneCamera
from humansim_ros.scene.pictures import color_image
from humansim_ros.scene.truth import REQUIRED_CHANNELS, CameraTruth

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

#: Settings of compressed images.
Compression = ImageCompression | DepthCompression
#: Function that takes the content of a message from a frame.
FrameContent = Callable[[Frame], Any]


class CameraTopics:
    """Topics of one camera, ``<camera>/…``.

    Args:
        scene: The scene.
        camera: The camera.
        frame: Name of the optical frame. If None, it follows from the name of the camera. Images and
            calibrations of the right camera of a stereo pair have the frame of the left camera, as
            image_geometry expects.
        channels: Channels that the renderer supports. Other channels have no topic.
        calibration: Calibration that is published. If None, that of the camera.

    Attributes:
        images: Images by channel. A channel with an image per body has a topic for each body.
        png_labels: Label images as PNG (8 and 16 bit integers). Only recordings have them.
        rectified: Images without lens distortion. Empty if the camera has no distortion.
        infos: Calibration of the colour image, where image_transport expects it, and the true calibration in
            the namespace of each other channel.
        depth_extrinsics: Pose of the optical frame of the depth sensor in that of the camera. Empty if the
            camera has no depth sensor.
        measured: Calibration, depth and points of the depth sensor.
        truth: Joints, boxes and visible vertices; keypoints by set; joints to be drawn by viewers.
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
        calibration: PublishedCalibration | None = None,
    ) -> None:
        self._scene, self._camera, self._name = scene, camera, camera.name
        self._has_faults, name = camera.faults is not None, camera.name
        self._frame = frame = optical_frame(name) if frame is None else frame
        # P of a right camera is meant for points in the frame of the left camera
        self._image_frame = frame.replace(name, camera.left) if camera.left else frame
        supported = [channel for channel in CHANNEL_TABLE.values() if channel.name in channels]
        self.images = [topic for channel in supported for topic in self._channel_topics(channel)]
        self.png_labels = [
            topic
            for channel in supported
            if channel.name in COMPRESSED and channel.encoding.startswith("mono")
            for topic in self._channel_topics(channel, ImageCompression("png"))
        ]
        self.rectified = [] if camera.rectified is None else self._rectified_topics()
        shown = PublishedCalibration(camera) if calibration is None else calibration
        info = partial(self._info, frame=self._image_frame, region=camera.region)
        self.infos = [
            info("camera_info", calibration=lambda: shown.published, shown=True, faulty=self._has_faults)
        ]
        namespaces = dict.fromkeys(topic.rpartition("/")[0] for topic in CHANNEL_OF_TOPIC)
        self.infos += [
            info(f"{each}/camera_info", calibration=lambda: shown.beside_truth) for each in namespaces if each
        ]
        self.depth_extrinsics, self.measured = self._depth_sensor_topics(shown)
        self.truth = self._truth_topics()
        self.legends = self._legend_topics()
        self.faults: list[Topic[FrameFaults]] = []
        if camera.faults is not None:
            build = partial(faults_message, frame=frame)
            content = self._of_frame("faults")
            self.faults = [self._topic("faults", DiagnosticArray, build, content, explains=True)]
        posed = partial(self._topic, content=self._published, latched=True, per_frame=camera.moves)
        self.extrinsics: Topic[Camera] = posed(
            "extrinsics", TransformStamped, partial(extrinsics_message, frame=frame)
        )
        self.projection: Topic[Camera] = posed(
            "projection", Float64MultiArray, lambda camera, _: projection_message(camera)
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
        own: Topic[Any] = self.extrinsics
        if camera.mount is not None:
            place, robot = camera.mount
            own = fixed_transform(place, robot.config.base_frame, frame)
        self.transforms: list[Topic[Any]] = [own, *self.depth_extrinsics]
        self.twist, self.pose = moving_camera_topics(name)

    def compressed(self, settings: Compression) -> Topic[NDArray[Any]]:
        """Colours as JPEG or PNG, or depth as PNG of 16 bits, in the formats of image_transport's plugins
        ``compressed`` and ``compressedDepth``."""
        channel = "depth" if isinstance(settings, DepthCompression) else "rgb"
        (topic,) = self._channel_topics(CHANNEL_TABLE[channel], settings)
        return topic

    @property
    def captured(self) -> Sequence[Topic[Any]]:
        """Topics with a message for each frame that the camera captures, except compressed images and
        poses."""
        return [*self.faults, *self.infos, *self.images, *self.rectified, *self.measured, *self.truth]

    def __iter__(self) -> Iterator[Topic[Any]]:
        return iter(self.all(ImageCompression()))

    def all(self, compression: ImageCompression) -> Sequence[Topic[Any]]:
        """All topics of the camera. ``compression``: settings of the compressed images."""
        poses: list[Topic[Any]] = [self.extrinsics, self.projection]
        if self._camera.moves:
            poses += [self.twist, self.pose]
        if self.true_extrinsics is not None:
            poses.append(self.true_extrinsics)
        return [
            *self.faults,
            *self.legends,
            *poses,
            *self.images,
            self.compressed(compression),
            self.compressed(DepthCompression()),
            *self.rectified,
            *self.infos,
            *self.depth_extrinsics,
            *self.measured,
            *self.truth,
        ]

    def _published(self, frame: Frame) -> Camera:
        """The camera at its pose in a frame, as its calibration states it. The camera need not be rendered,
        since tf has all cameras."""
        pose = frame.camera_poses.get(self._name) or CameraPose.of(self._camera.camera)
        return self._camera.published_at(pose)

    def _of_frame(self, part: str, value: Callable[[Any], Any] = lambda found: found) -> FrameContent:
        """Function that takes a value of the camera from a frame. ``part``: attribute of the frame with
        values by camera. ``value``: takes the content from the value of the camera."""
        return lambda frame: value(getattr(frame, part)[self._name])

    def _topic(
        self, path: str, kind: type[Any], build: Callable[..., Any], content: FrameContent, **settings: Any
    ) -> Topic[Any]:
        """Create the topic ``<camera>/<path>``. ``settings``: other attributes of the topic."""
        return Topic(f"{self._name}/{path}", kind, build, content, camera=self._name, **settings)

    def _image(
        self,
        path: str,
        encoding: str,
        frame: str,
        image: FrameContent,
        compression: Compression | None = None,
        **settings: Any,
    ) -> Topic[NDArray[Any]]:
        """Create a topic of images. ``frame``: name of their optical frame. ``compression``: None for raw
        images."""

        def message(image: NDArray[Any], stamp: int) -> Any:
            if compression is None:
                return image_message(image, encoding, stamp, frame)
            if isinstance(compression, DepthCompression):
                return compressed_depth_message(image, compression, stamp, frame)
            return compressed_image_message(image, encoding, compression, stamp, frame)

        kind = Image if compression is None else CompressedImage
        return self._topic(path, kind, message, image, **settings)

    def _info(
        self,
        path: str,
        frame: str,
        calibration: Callable[[], Camera],
        region: Region = _WHOLE_SENSOR,
        **settings: Any,
    ) -> Topic[Camera]:
        """Create the topic of a calibration. ``calibration``: returns that of the whole sensor. ``region``:
        binning and region of interest of the images."""
        build = partial(camera_info_message, frame=frame, region=region)
        return self._topic(path, CameraInfo, build, lambda _: calibration(), **settings)

    def _channel_topics(
        self, channel: Channel, compression: Compression | None = None
    ) -> Sequence[Topic[NDArray[Any]]]:
        """Topic of a channel; a channel with an image per body has one topic for each body. ``compression``:
        None for raw images."""
        name, is_raw = self._name, compression is None

        def topic(path: str, value: Callable[[Any], Any] = lambda image: image) -> Topic[NDArray[Any]]:
            return self._image(
                path if is_raw else f"{path}/{COMPRESSED[channel.name]}",
                channel.encoding or self._camera.encoding,
                self._image_frame,
                self._of_frame("views", lambda view: value(getattr(view, channel.name))),
                compression,
                shown=is_raw and channel.name in _SHOWN_CHANNELS,
                channels=frozenset({channel.name}),
                raw="" if is_raw else f"{name}/{path}",
                faulty=self._has_faults and channel.name == "rgb",
            )

        def mask(label: int) -> Callable[[Any], Any]:
            return lambda masks: mask_pixels(masks[label])

        if not channel.per_body:
            return [topic(channel.topic)]
        labels = self._scene.labels.items()
        return [topic(channel.topic.format(body=body), mask(label)) for body, label in labels]

    def _rectified_topics(self) -> list[Topic[NDArray[Any]]]:
        """Topics of images without lens distortion: colours and depth."""
        frame, camera = self._image_frame, self._camera
        rgb, depth = CHANNEL_TABLE["rgb"], CHANNEL_TABLE["depth"]
        encoding = camera.encoding.replace("bayer_rggb8", "rgb8")
        colors, faulty = self._of_frame("views", lambda view: camera.rectify(view.rgb)), self._has_faults
        channels = frozenset({"rgb"})
        exact = self._of_frame("rectified_depth")
        return [
            self._image(rgb.rectified_topic, encoding, frame, colors, channels=channels, faulty=faulty),
            self._image(depth.rectified_topic, depth.encoding, frame, exact, rectified_depth=True),
        ]

    def _depth_sensor_topics(
        self, calibration: PublishedCalibration
    ) -> tuple[list[Topic[Camera]], list[Topic[Any]]]:
        """Topics of the depth sensor (docs/depth_cameras.md): its pose in the frame of the camera, and what
        it measures. ``calibration``: published calibration of the camera."""
        sensor, frame, name = self._camera.depth_sensor, self._frame, self._name
        if sensor is None:
            return [], []
        own, faulty = depth_optical_frame(frame), self._has_faults

        def depth(path: str, encoding: str, frame: str, image: str, **settings: Any) -> Topic[Any]:
            measured = self._of_frame("depth_sensors", attrgetter(image))
            return self._image(path, encoding, frame, measured, **{"faulty": faulty, **settings})

        def points(path: str, frame: str, content: FrameContent, **settings: Any) -> Topic[Any]:
            def message(found: tuple[NDArray[Any], NDArray[Any] | None], stamp: int) -> PointCloud2:
                return image_points_message(*found, stamp, frame)

            return self._topic(path, PointCloud2, message, content, faulty=faulty, **settings)

        def color_points(simulated: Frame) -> tuple[NDArray[Any], NDArray[Any]]:
            """Points (H, W, 3) of the pixels of ``image_raw``, and their colours."""
            colors = color_image(simulated.views[name].rgb, self._camera.encoding)
            return simulated.depth_sensors[name].color_points, colors

        extrinsics: Topic[Camera] = self._topic(
            "depth_sensor/extrinsics",
            TransformStamped,
            partial(extrinsics_message, frame=own, parent=frame),
            lambda _: sensor.optics,
            latched=True,
            per_frame=False,
        )
        infos = [
            self._info("depth_sensor/camera_info", own, lambda: sensor.optics, shown=True, faulty=faulty)
        ]
        measured = [
            depth("depth_sensor/image_raw", "16UC1", own, "measured", shown=True),
            depth("depth_sensor/image", "32FC1", own, "depth"),
            depth("depth_sensor/image_truth", "32FC1", own, "exact", faulty=False),
            points(
                "depth_sensor/points", own, self._of_frame("depth_sensors", lambda each: (each.points, None))
            ),
        ]
        if sensor.config.aligned:
            path, region = "aligned_depth_to_color", self._camera.region
            info = self._info(
                f"{path}/camera_info", frame, lambda: calibration.published, region, faulty=faulty
            )
            infos.append(info)
            measured += [
                depth(f"{path}/image_raw", "16UC1", frame, "aligned"),
                points("points", frame, color_points, channels=frozenset({"rgb"})),
            ]
        return [extrinsics], [*infos, *measured]

    def _truth_topics(self) -> list[Topic[Any]]:
        labels, frame = self._scene.labels, self._frame

        def labelled(
            path: str,
            message: Callable[..., PointCloud2],
            values: Callable[[CameraTruth], Any],
            **settings: Any,
        ) -> Topic[Mapping[str, Any]]:
            """Create a topic of pairs of an instance label and a value. ``values``: takes the values by human
            or object from the truth."""

            def build(found: Mapping[str, Any], stamp: int) -> PointCloud2:
                return message([(labels[body], value) for body, value in found.items()], stamp, frame)

            channels = frozenset(REQUIRED_CHANNELS[path if path in _TRUTH else "joints"])
            content = self._of_frame("truth", values)
            return self._topic(path, PointCloud2, build, content, channels=channels, **settings)

        topics = [
            labelled(kind, build, attrgetter(kind), shown=kind == "joints") for kind, build in _TRUTH.items()
        ]
        for name in KEYPOINT_SETS:
            values = methodcaller("keypoints", name)
            topics.append(labelled(f"keypoints/{name}", joint_view_message, values, optional=True))
        # about four pixels in an image of 640 x 480
        radius = max(2.0, min(self._camera.camera.size) / 120)
        overlay = self._topic(
            "overlay",
            ImageMarker,
            lambda joints, stamp: overlay_message(joints, radius, stamp, frame),
            self._of_frame("truth", lambda truth: [*truth.joints.values()]),
            channels=frozenset(REQUIRED_CHANNELS["joints"]),
        )
        return [*topics, overlay]

    def _legend_topics(self) -> list[Topic[None]]:
        scene, actors = self._scene, list(self._scene.actors.values())
        joints = {actor.name: (actor.instance, actor.human.skeleton.joint_names) for actor in actors}
        legends = label_legends(scene)
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
            sent_once(f"{name}/{kind}/legend", String, build, camera=name, optional=kind in _OPTIONAL_LEGENDS)
            for kind, build in legends.items()
        ]


def moving_camera_topics(name: str) -> tuple[Topic[CameraPose], Topic[CameraPose]]:
    """Create the topics ``twist`` and ``pose`` of a camera with a trajectory. Each frame has a message."""

    def content(frame: Frame) -> CameraPose:
        return frame.camera_poses[name]

    def velocity(pose: CameraPose, stamp: int) -> TwistStamped:
        return twist_message(pose.velocity, stamp)

    twist: Topic[CameraPose] = Topic(f"{name}/twist", TwistStamped, velocity, content)
    pose: Topic[CameraPose] = Topic(f"{name}/pose", PoseStamped, pose_message, content)
    return twist, pose
