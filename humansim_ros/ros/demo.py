"""``humansim demo``: runs the nodes of a scene, records their topics as a client, and writes pictures."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from humansim_ros.drawing import canvas, views
from humansim_ros.errors import HumansimError
from humansim_ros.ros.processes import scene_processes
from humansim_ros.ros.runtime import prepare_transport
from humansim_ros.ros.supervisor import Supervisor
from humansim_ros.scene import Scene
from humansim_ros.types import Image

#: Seconds until every topic must have sent a message.
_START_LIMIT = 60.0
#: Width of the image of one camera in the video.
_VIDEO_WIDTH = 480
#: Newest stamps that are held until one of them has arrived from all cameras.
_MAX_INCOMPLETE = 20
#: Element type and shape of a pixel, by image encoding.
_PIXELS: dict[str, tuple[type, tuple[int, ...]]] = {
    "rgb8": (np.uint8, (3,)),
    "32FC1": (np.float32, ()),
    "mono8": (np.uint8, ()),
}


def record_demo(scene_path: Path, output: Path, duration: float) -> bool:
    """Write ``contact_sheet.png`` and ``walk.mp4`` to a folder, and print a table of the topics.

    Returns:
        False if a node failed or a topic sent nothing.
    """
    console = Console()
    scene = Scene.load(scene_path)
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as reason:
        raise HumansimError(
            f"cannot create the folder for the pictures: {reason.strerror}", path=output
        ) from None
    with Supervisor(scene_processes(scene_path)) as nodes, _Recorder(scene) as recorder:
        seconds = _record(nodes, recorder, duration, console)
    if seconds is None:
        return False
    with _progress(console) as progress:
        task = progress.add_task("writing pictures", total=2)
        canvas.write_png(output / "contact_sheet.png", _contact_sheet(scene, recorder))
        progress.advance(task)
        canvas.write_mp4(output / "walk.mp4", _video(scene, recorder), scene.config.rate)
        progress.advance(task)
    console.print(_topic_table(recorder, seconds))
    complete, total = recorder.complete_stamps()
    console.print(f"frames with all {len(scene.cameras)} cameras at equal stamps: {complete} of {total}")
    for name in ("contact_sheet.png", "walk.mp4"):
        console.print(f"wrote {output / name}")
    return True


def _record(nodes: Supervisor, recorder: _Recorder, duration: float, console: Console) -> float | None:
    """Wait until every topic has sent a message, then record for ``duration``.

    Returns:
        Recorded seconds, or None if a node has ended or a topic sends nothing.
    """
    with _progress(console) as progress:
        task = progress.add_task("starting the nodes", total=None)
        limit = time.monotonic() + _START_LIMIT
        while recorder.silent and not nodes.dead() and time.monotonic() < limit:
            recorder.spin(0.1)
        silent = recorder.silent
        recorder.reset()
        progress.update(task, description="recording", total=duration)
        begin = time.monotonic()
        while not silent and not nodes.dead() and time.monotonic() < begin + duration:
            recorder.spin(0.1)
            progress.update(task, completed=time.monotonic() - begin)
    if silent or nodes.dead():
        _print_failure(console, nodes.dead(), silent)
        return None
    return time.monotonic() - begin


def _print_failure(console: Console, dead: tuple[str, int] | None, silent: list[str]) -> None:
    if dead:
        console.print(f"error: node {dead[0]} ended unexpectedly (exit code {dead[1]})", style="red")
    else:
        console.print(
            f"error: nothing arrived within {_START_LIMIT:.0f} s on {', '.join(silent)}", style="red"
        )


def _progress(console: Console) -> Progress:
    return Progress(TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), console=console)


class _Recorder:
    """Subscribes to the topics of a scene with sensor-data QoS and stores what the pictures need."""

    def __init__(self, scene: Scene) -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.qos import qos_profile_sensor_data
        from sensor_msgs.msg import CameraInfo, Image, MultiDOFJointState, PointCloud2

        self.scene = scene
        prepare_transport()
        rclpy.init()
        self._node = rclpy.create_node("humansim_demo")
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self.types: dict[str, str] = {}
        self.bytes: Counter[str] = Counter()
        self.messages: Counter[str] = Counter()
        self._incomplete: dict[int, dict[str, bytes]] = {}
        #: Serialised messages of the latest stamp that is complete, by topic.
        self.sheet: dict[str, bytes] = {}
        #: Scaled images by stamp and camera.
        self.thumbnails: dict[int, dict[str, Any]] = {}
        topics: list[tuple[str, Any]] = []
        for human in scene.actors:
            topics += [(f"/humans/{human}/{kind}", MultiDOFJointState) for kind in ("motion", "joints")]
            topics.append((f"/humans/{human}/vertices", PointCloud2))
        self._sheet_topics = []
        for camera in scene.cameras:
            images = [f"/{camera}/{kind}" for kind in ("image_raw", "depth/image", "part/image")]
            topics += [(topic, Image) for topic in images]
            topics += [(f"/{camera}/camera_info", CameraInfo), (f"/{camera}/joints", PointCloud2)]
            self._sheet_topics += [*images, f"/{camera}/joints"]
        self._message_types = dict(topics)
        for topic, kind in topics:
            self.types[topic] = f"{kind.__module__.split('.')[0]}/{kind.__name__}"
            self._node.create_subscription(
                kind, topic, self._callback(topic), qos_profile_sensor_data, raw=True
            )

    def __enter__(self) -> _Recorder:
        return self

    def __exit__(self, *_: object) -> None:
        import rclpy

        self._node.destroy_node()
        rclpy.try_shutdown()

    @property
    def silent(self) -> list[str]:
        """Topics that have sent nothing yet."""
        return [topic for topic in self.types if not self.messages[topic]]

    def spin(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            # always the same timeout: with another one rclpy restarts its round of ready topics, and the
            # last topics starve
            self._executor.spin_once(timeout_sec=0.05)

    def reset(self) -> None:
        self.messages.clear()
        self.bytes.clear()
        self.thumbnails.clear()

    def complete_stamps(self) -> tuple[int, int]:
        """Number of stamps with images of all cameras, and of any."""
        complete = sum(len(images) == len(self.scene.cameras) for images in self.thumbnails.values())
        return complete, len(self.thumbnails)

    def _callback(self, topic: str) -> Callable[[bytes], None]:
        """Create the callback for serialised messages of a topic; few of them are deserialised."""
        camera = topic.split("/")[1]

        from humansim_ros.ros.messages import serialised_stamp

        def on_message(data: bytes) -> None:
            stamp = serialised_stamp(data)
            self.messages[topic] += 1
            self.bytes[topic] += len(data)
            if topic.endswith("/image_raw"):
                image = self.image(topic, data)
                size = (_VIDEO_WIDTH, round(image.shape[0] * _VIDEO_WIDTH / image.shape[1]))
                self.thumbnails.setdefault(stamp, {})[camera] = cv2.resize(image, size)
            if topic in self._sheet_topics:
                self._store_for_sheet(stamp, topic, data)

        return on_message

    def message(self, topic: str, data: bytes) -> Any:
        """Deserialise a message of a topic."""
        from rclpy.serialization import deserialize_message

        return deserialize_message(data, self._message_types[topic])

    def image(self, topic: str, data: bytes) -> Any:
        """Read the pixels of a serialised image message."""
        message = self.message(topic, data)
        dtype, pixel = _PIXELS[message.encoding]
        return np.frombuffer(message.data, dtype).reshape(message.height, message.width, *pixel)

    def _store_for_sheet(self, stamp: int, topic: str, data: bytes) -> None:
        """Hold messages of the newest stamps until one stamp is complete."""
        self._incomplete.setdefault(stamp, {})[topic] = data
        if len(self._incomplete[stamp]) == len(self._sheet_topics):
            self.sheet = self._incomplete[stamp]
        for old in sorted(self._incomplete)[:-_MAX_INCOMPLETE]:
            del self._incomplete[old]


def _contact_sheet(scene: Scene, recorder: _Recorder) -> Image:
    from humansim_ros.ros.messages import read_joint_view

    if not recorder.sheet:
        raise HumansimError("no frame was received from all cameras: the machine is too slow for this scene")
    rows = []
    for camera in scene.cameras:
        image, depth, part = (
            recorder.image(topic, recorder.sheet[topic])
            for topic in (f"/{camera}/{kind}" for kind in ("image_raw", "depth/image", "part/image"))
        )
        joints = f"/{camera}/joints"
        points = read_joint_view(recorder.message(joints, recorder.sheet[joints]))
        overlay = image
        for actor in scene.actors.values():
            own = points[points["human"] == actor.instance]
            skeleton = actor.human.skeleton
            names = skeleton.joint_names
            parents = [None if p < 0 else skeleton.names[p] for p in skeleton.parents]
            parents += [skeleton.names[bone] for bone in skeleton.leaves]
            pixels = np.stack([own["u"], own["v"]], axis=-1)
            overlay = views.draw_joints(overlay, pixels, own["visible"], names, parents)
        rows.append(
            [
                image,
                overlay,
                views.color_depth(depth),
                views.color_labels(part),
            ]
        )
    titles = ("image_raw", "image_raw with joints", "depth/image", "part/image")
    return views.contact_sheet(rows, titles, list(scene.cameras))


def _video(scene: Scene, recorder: _Recorder) -> Iterator[Image]:
    """Frames with all cameras at one stamp, two cameras a row; each is repeated until the next stamp."""
    names = list(scene.cameras)
    thumbnails = recorder.thumbnails
    complete = [stamp for stamp in sorted(thumbnails) if len(thumbnails[stamp]) == len(names)]
    for stamp, following in zip(complete, [*complete[1:], None], strict=True):
        images = thumbnails[stamp]
        rows = [
            np.concatenate([images[n] for n in names[i : i + 2]], axis=1) for i in range(0, len(names), 2)
        ]
        periods = 1 if following is None else round((following - stamp) * 1e-9 / scene.period)
        yield from [np.concatenate(rows)] * max(1, periods)


def _topic_table(recorder: _Recorder, seconds: float) -> Table:
    table = Table(title="received", box=None, padding=(0, 1, 0, 0))
    for column in ("topic", "type"):
        table.add_column(column)
    for column in ("messages", "Hz", "MB/s"):
        table.add_column(column, justify="right")
    for topic, kind in recorder.types.items():
        number = recorder.messages[topic]
        megabytes = recorder.bytes[topic] / 1e6 / seconds
        table.add_row(topic, kind, str(number), f"{number / seconds:.1f}", f"{megabytes:.2f}")
    return table
