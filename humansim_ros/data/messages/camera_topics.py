"""Topics of one camera: images, calibration, ground truth, pose, and the depth sensor."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from operator import attrgetter, methodcaller
from typing import Any

from numpy.typing import NDArray

from humansim_ros.cameras.camera import Camera, Region
from humansim_ros.cameras.sensor import DepthSensor
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
from humansim_ros.scene.core import CameraPose, DepthCapture, Frame, FrameFaults, Scene, SceneCamera
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
#: Function that takes an image from a frame.
FrameImage = Callable[[Frame], NDArray[Any]]


class _OfCamera:
    """Makes topics below the name of a camera."""

    def __init__(self, camera: SceneCamera) -> None:
        self._camera, self._name = camera, camera.name
        self._has_faults = camera.faults is not None

    def _topic(
        self,
        path: str,
        kind: type[Any],
        build: Callable[..., Any],
        content: Callable[[Frame], Any],
        **settings: Any,
    ) -> Topic[Any]:
        """Create the topic ``<camera>/<path>``. ``settings``: other attributes of the topic."""
        return Topic(f"{self._name}/{path}", kind, build, content, camera=self._name, **settings)

    def _image(
        self,
        path: str,
        encoding: str,
        frame: str,
        image: FrameImage,
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


class CameraTopics(_OfCamera):
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
        info: Calibration. It is in the namespace of the colour image, where image_transport expects it.
        truth_infos: True calibration: a topic in the namespace of each channel other than the colour image.
        depth_sensor: Topics of the depth sensor; None if the camera has none.
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
        super().__init__(camera)
        self._scene, name = scene, camera.name
        self._frame = frame = optical_frame(name) if frame is None else frame
        # P of a right camera is meant for points in the frame of the left camera
        self._image_frame = frame.replace(name, camera.left) if camera.left else frame
        supported = [channel for channel in CHANNEL_TABLE.values() if channel.name in channels]
        self.images: Sequence[Topic[NDArray[Any]]] = [
            topic for channel in supported for topic in self._channel_topics(channel)
        ]
        self.png_labels: Sequence[Topic[NDArray[Any]]] = [
            topic
            for channel in supported
            if channel.name in COMPRESSED and channel.encoding.startswith("mono")
            for topic in self._channel_topics(channel, ImageCompression("png"))
        ]
        self.rectified = [] if camera.rectified is None else self._rectified_topics()
        shown = PublishedCalibration(camera) if calibration is None else calibration
        info = partial(self._info, frame=self._image_frame, region=camera.region)
        self.info = info(
            "camera_info", calibration=lambda: shown.published, shown=True, faulty=self._has_faults
        )
        namespaces = dict.fromkeys(topic.rpartition("/")[0] for topic in CHANNEL_OF_TOPIC)
        self.truth_infos = [
            info(f"{each}/camera_info", calibration=lambda: shown.beside_truth) for each in namespaces if each
        ]
        self.depth_sensor: DepthSensorTopics | None = None
        if camera.depth_sensor is not None:
            self.depth_sensor = DepthSensorTopics(camera, camera.depth_sensor, frame, shown)
        self.truth = self._truth_topics()
        self.legends: Sequence[Topic[None]] = self._legend_topics()
        self.faults: Sequence[Topic[FrameFaults]] = [] if camera.faults is None else [self._faults_topic()]
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
        self.transforms: list[Topic[Any]] = [self.extrinsics]
        if camera.mount is not None:
            place, robot = camera.mount
            self.transforms = [fixed_transform(place, robot.config.base_frame, frame)]
        if self.depth_sensor is not None:
            self.transforms.append(self.depth_sensor.extrinsics)
        self.twist, self.pose = moving_camera_topics(name)

    def compressed(self, settings: ImageCompression) -> Topic[NDArray[Any]]:
        """Images as JPEG or PNG, in the format of image_transport's plugin ``compressed``."""
        (topic,) = self._channel_topics(CHANNEL_TABLE["rgb"], settings)
        return topic

    def compressed_depth(self, settings: DepthCompression) -> Topic[NDArray[Any]]:
        """Depth as PNG of 16 bits, in the format of image_transport's plugin ``compressedDepth``."""
        (topic,) = self._channel_topics(CHANNEL_TABLE["depth"], settings)
        return topic

    @property
    def captured(self) -> Sequence[Topic[Any]]:
        """Topics with a message for each frame that the camera captures, except compressed images and
        poses."""
        depth = self.depth_sensor
        measured = [] if depth is None else [*depth.infos, *depth.measured]
        return [
            *self.faults,
            self.info,
            *self.truth_infos,
            *self.images,
            *self.rectified,
            *measured,
            *self.truth,
        ]

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
            self.compressed_depth(DepthCompression()),
            *self.rectified,
            self.info,
            *self.truth_infos,
            *(self.depth_sensor or ()),
            *self.truth,
        ]

    def _published(self, frame: Frame) -> Camera:
        """The camera at its pose in a frame, as its calibration states it. The camera need not be rendered,
        since tf has all cameras."""
        pose = frame.camera_poses.get(self._name) or CameraPose.of(self._camera.camera)
        return self._camera.published_at(pose)

    def _channel_topics(
        self, channel: Channel, compression: Compression | None = None
    ) -> Sequence[Topic[NDArray[Any]]]:
        """Topic of a channel; a channel with an image per body has one topic for each body. ``compression``:
        None for raw images."""
        name, is_raw = self._name, compression is None

        def topic(path: str, image: FrameImage) -> Topic[NDArray[Any]]:
            return self._image(
                path if is_raw else f"{path}/{COMPRESSED[channel.name]}",
                channel.encoding or self._camera.encoding,
                self._image_frame,
                image,
                compression,
                shown=is_raw and channel.name in _SHOWN_CHANNELS,
                channels=frozenset({channel.name}),
                raw="" if is_raw else f"{name}/{path}",
                faulty=self._has_faults and channel.name == "rgb",
            )

        def of_body(label: int) -> FrameImage:
            return lambda frame: mask_pixels(getattr(frame.views[name], channel.name)[label])

        if not channel.per_body:
            return [topic(channel.topic, lambda frame: getattr(frame.views[name], channel.name))]
        labels = self._scene.labels.items()
        return [topic(channel.topic.format(body=body), of_body(label)) for body, label in labels]

    def _rectified_topics(self) -> Sequence[Topic[NDArray[Any]]]:
        """Topics of images without lens distortion: colours and depth."""
        name, frame, camera = self._name, self._image_frame, self._camera
        rgb, depth = CHANNEL_TABLE["rgb"], CHANNEL_TABLE["depth"]
        encoding = camera.encoding.replace("bayer_rggb8", "rgb8")
        return [
            self._image(
                rgb.rectified_topic,
                encoding,
                frame,
                lambda simulated: camera.rectify(simulated.views[name].rgb),
                channels=frozenset({"rgb"}),
                faulty=self._has_faults,
            ),
            self._image(
                depth.rectified_topic,
                depth.encoding,
                frame,
                lambda simulated: simulated.rectified_depth[name],
                rectified_depth=True,
            ),
        ]

    def _truth_topics(self) -> Sequence[Topic[Any]]:
        topics = [
            self._labelled(kind, build, attrgetter(kind), needs=kind, shown=kind == "joints")
            for kind, build in _TRUTH.items()
        ]
        for name in KEYPOINT_SETS:
            values = methodcaller("keypoints", name)
            topics.append(self._labelled(f"keypoints/{name}", joint_view_message, values, optional=True))
        # about four pixels in an image of 640 x 480
        radius = max(2.0, min(self._camera.camera.size) / 120)
        overlay = self._topic(
            "overlay",
            ImageMarker,
            lambda joints, stamp: overlay_message(joints, radius, stamp, self._frame),
            lambda simulated: [*simulated.truth[self._name].joints.values()],
            channels=frozenset(REQUIRED_CHANNELS["joints"]),
        )
        return [*topics, overlay]

    def _labelled(
        self,
        path: str,
        message: Callable[..., PointCloud2],
        values: Callable[[CameraTruth], Mapping[str, Any]],
        needs: str = "joints",
        **settings: Any,
    ) -> Topic[Mapping[str, Any]]:
        """Create a topic of ground truth.

        Args:
            path: Name of the topic below the camera.
            message: Builds the message from pairs of an instance label and a value.
            values: Takes from the truth the values by human or object.
            needs: Property of :class:`CameraTruth` that the values are computed from.
            settings: Other attributes of the topic.
        """
        name, labels, frame = self._name, self._scene.labels, self._frame

        def build(found: Mapping[str, Any], stamp: int) -> PointCloud2:
            return message([(labels[body], value) for body, value in found.items()], stamp, frame)

        return self._topic(
            path,
            PointCloud2,
            build,
            lambda simulated: values(simulated.truth[name]),
            channels=frozenset(REQUIRED_CHANNELS[needs]),
            **settings,
        )

    def _legend_topics(self) -> Sequence[Topic[None]]:
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

    def _faults_topic(self) -> Topic[FrameFaults]:
        name = self._name
        return self._topic(
            "faults",
            DiagnosticArray,
            partial(faults_message, frame=self._frame),
            lambda simulated: simulated.faults[name],
            explains=True,
        )


class DepthSensorTopics(_OfCamera):
    """Topics of the depth sensor of a camera (docs/depth_cameras.md).

    Args:
        camera: The camera.
        sensor: Its depth sensor.
        frame: Optical frame of the camera.
        calibration: Calibration of the camera that is published.

    Attributes:
        optics: Size and K of the sensor, and its pose in the optical frame of the camera.
        infos: Its calibration. If depth is converted to the pixels of ``image_raw``, also the calibration of
            the camera.
        extrinsics: Pose of its optical frame in the optical frame of the camera.
        measured: Topics of measured depth, exact depth, and points.
    """

    def __init__(
        self, camera: SceneCamera, sensor: DepthSensor, frame: str, calibration: PublishedCalibration
    ) -> None:
        super().__init__(camera)
        self.optics, faulty = sensor.optics, self._has_faults
        own = depth_optical_frame(frame)
        self.infos = [
            self._info("depth_sensor/camera_info", own, lambda: sensor.optics, shown=True, faulty=faulty)
        ]
        self.extrinsics: Topic[Camera] = self._topic(
            "depth_sensor/extrinsics",
            TransformStamped,
            partial(extrinsics_message, frame=own, parent=frame),
            lambda _: sensor.optics,
            latched=True,
            per_frame=False,
        )
        self.measured = [
            self._depth("depth_sensor/image_raw", "16UC1", own, attrgetter("measured"), shown=True),
            self._depth("depth_sensor/image", "32FC1", own, attrgetter("depth")),
            self._depth("depth_sensor/image_truth", "32FC1", own, attrgetter("exact"), faulty=False),
            self._points(
                "depth_sensor/points", own, lambda simulated: (self._capture(simulated).points, None)
            ),
        ]
        if not sensor.config.aligned:
            return
        self.infos.append(
            self._info(
                "aligned_depth_to_color/camera_info",
                frame,
                lambda: calibration.published,
                camera.region,
                faulty=faulty,
            )
        )
        self.measured += [
            self._depth("aligned_depth_to_color/image_raw", "16UC1", frame, attrgetter("aligned")),
            self._points("points", frame, self._color_points, channels=frozenset({"rgb"})),
        ]

    def _capture(self, frame: Frame) -> DepthCapture:
        return frame.depth_sensors[self._name]

    def _color_points(self, frame: Frame) -> tuple[NDArray[Any], NDArray[Any]]:
        """Points (H, W, 3) of the pixels of ``image_raw``, and their colours."""
        colors = color_image(frame.views[self._name].rgb, self._camera.encoding)
        return self._capture(frame).color_points, colors

    def _depth(
        self,
        path: str,
        encoding: str,
        frame: str,
        image: Callable[[DepthCapture], NDArray[Any]],
        faulty: bool = True,
        **settings: Any,
    ) -> Topic[NDArray[Any]]:
        return self._image(
            path,
            encoding,
            frame,
            lambda simulated: image(self._capture(simulated)),
            faulty=faulty and self._has_faults,
            **settings,
        )

    def _points(self, path: str, frame: str, points: Callable[[Frame], Any], **settings: Any) -> Topic[Any]:
        """Create a topic of points. ``points``: returns points and colours; None for no colours."""

        def message(found: tuple[NDArray[Any], NDArray[Any] | None], stamp: int) -> PointCloud2:
            return image_points_message(*found, stamp, frame)

        return self._topic(path, PointCloud2, message, points, faulty=self._has_faults, **settings)

    def __iter__(self) -> Iterator[Topic[Any]]:
        return iter([self.extrinsics, *self.infos, *self.measured])


def moving_camera_topics(name: str) -> tuple[Topic[CameraPose], Topic[CameraPose]]:
    """Create the topics ``twist`` and ``pose`` of a camera with a trajectory. Each frame has a message."""

    def content(frame: Frame) -> CameraPose:
        return frame.camera_poses[name]

    twist: Topic[CameraPose] = Topic(
        f"{name}/twist",
        TwistStamped,
        lambda pose, stamp: twist_message(pose.velocity, stamp),
        content,
    )
    pose: Topic[CameraPose] = Topic(f"{name}/pose", PoseStamped, pose_message, content)
    return twist, pose
