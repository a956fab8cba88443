"""``humansim demo``: runs a scene's nodes as processes, listens to them as any client would, and shows what
arrived.
"""

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

#: Seconds until every topic must have spoken.
_START_LIMIT = 60.0
#: Width of one camera's picture in the video.
_VIDEO_WIDTH = 480
#: Newest instants that are held until one of them has arrived from all cameras.
_INSTANTS = 20
#: Number type and channels of the image encodings that are shown.
_ARRAYS: dict[str, tuple[type, tuple[int, ...]]] = {
    "rgb8": (np.uint8, (3,)),
    "32FC1": (np.float32, ()),
    "mono8": (np.uint8, ()),
}


def record_demo(scene_path: Path, output: Path, duration: float) -> bool:
    """Write ``contact_sheet.png`` and ``walk.mp4`` to a folder and print the table of topics. False if a node
    failed.
    """
    console = Console()
    scene = Scene.load(scene_path)
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as reason:
        raise HumansimError(
            f"cannot make the folder for the pictures: {reason.strerror}", path=output
        ) from None
    with Supervisor(scene_processes(scene_path)) as nodes, _Listener(scene) as listener:
        seconds = _listen(nodes, listener, duration, console)
    if seconds is None:
        return False
    with _progress(console) as progress:
        task = progress.add_task("writing pictures", total=2)
        canvas.write_png(output / "contact_sheet.png", _contact_sheet(scene, listener))
        progress.advance(task)
        canvas.write_mp4(output / "walk.mp4", _video(scene, listener), scene.config.rate)
        progress.advance(task)
    console.print(_table(listener, seconds))
    whole, any_camera = listener.equal_stamps()
    console.print(f"frames with all {len(scene.cameras)} cameras at equal stamps: {whole} of {any_camera}")
    for name in ("contact_sheet.png", "walk.mp4"):
        console.print(f"wrote {output / name}")
    return True


def _listen(nodes: Supervisor, listener: _Listener, duration: float, console: Console) -> float | None:
    """Wait until every topic speaks, then collect for ``duration``: seconds taken, None if a node dies."""
    with _progress(console) as progress:
        task = progress.add_task("starting the nodes", total=None)
        limit = time.monotonic() + _START_LIMIT
        while listener.silent and not nodes.dead() and time.monotonic() < limit:
            listener.spin(0.1)
        silent = listener.silent
        listener.reset()
        progress.update(task, description="recording", total=duration)
        begin = time.monotonic()
        while not silent and not nodes.dead() and time.monotonic() < begin + duration:
            listener.spin(0.1)
            progress.update(task, completed=time.monotonic() - begin)
    if silent or nodes.dead():
        _explain(console, nodes.dead(), silent)
        return None
    return time.monotonic() - begin


def _explain(console: Console, dead: tuple[str, int] | None, silent: list[str]) -> None:
    if dead:
        console.print(f"error: node {dead[0]} ended by itself (exit code {dead[1]})", style="red")
    else:
        console.print(
            f"error: nothing arrived within {_START_LIMIT:.0f} s on {', '.join(silent)}", style="red"
        )


def _progress(console: Console) -> Progress:
    return Progress(TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), console=console)


class _Listener:
    """Subscribes to a scene's topics with sensor-data QoS and keeps what the pictures need."""

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
        self._waiting: dict[int, dict[str, bytes]] = {}
        self.sheet: dict[str, bytes] = {}
        self.small: dict[int, dict[str, Any]] = {}
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
        self._kinds = dict(topics)
        for topic, kind in topics:
            self.types[topic] = f"{kind.__module__.split('.')[0]}/{kind.__name__}"
            self._node.create_subscription(kind, topic, self._taker(topic), qos_profile_sensor_data, raw=True)

    def __enter__(self) -> _Listener:
        return self

    def __exit__(self, *_: object) -> None:
        import rclpy

        self._node.destroy_node()
        rclpy.try_shutdown()

    @property
    def silent(self) -> list[str]:
        """Topics that have not spoken yet."""
        return [topic for topic in self.types if not self.messages[topic]]

    def spin(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            # always the same timeout: with another one rclpy starts its round of ready topics anew, and the
            # first topics starve the last
            self._executor.spin_once(timeout_sec=0.05)

    def reset(self) -> None:
        self.messages.clear()
        self.bytes.clear()
        self.small.clear()

    def equal_stamps(self) -> tuple[int, int]:
        """Stamps seen by every camera, and by any."""
        return sum(len(cameras) == len(self.scene.cameras) for cameras in self.small.values()), len(
            self.small
        )

    def _taker(self, topic: str) -> Callable[[bytes], None]:
        """Callback for a topic's serialised messages: only what is shown is turned into messages."""
        camera = topic.split("/")[1]

        from humansim_ros.ros.messages import serialised_stamp

        def take(data: bytes) -> None:
            stamp = serialised_stamp(data)
            self.messages[topic] += 1
            self.bytes[topic] += len(data)
            if topic.endswith("/image_raw"):
                image = self.image(topic, data)
                size = (_VIDEO_WIDTH, round(image.shape[0] * _VIDEO_WIDTH / image.shape[1]))
                self.small.setdefault(stamp, {})[camera] = cv2.resize(image, size)
            if topic in self._sheet_topics:
                self._keep_for_sheet(stamp, topic, data)

        return take

    def message(self, topic: str, data: bytes) -> Any:
        """The message of some serialised bytes."""
        from rclpy.serialization import deserialize_message

        return deserialize_message(data, self._kinds[topic])

    def image(self, topic: str, data: bytes) -> Any:
        """The array of an image message's bytes."""
        message = self.message(topic, data)
        kind, channels = _ARRAYS[message.encoding]
        return np.frombuffer(message.data, kind).reshape(message.height, message.width, *channels)

    def _keep_for_sheet(self, stamp: int, topic: str, data: bytes) -> None:
        """Hold the messages of the newest few stamps until one instant is there whole; the latest such is
        shown.
        """
        self._waiting.setdefault(stamp, {})[topic] = data
        if len(self._waiting[stamp]) == len(self._sheet_topics):
            self.sheet = self._waiting[stamp]
        for old in sorted(self._waiting)[:-_INSTANTS]:
            del self._waiting[old]


def _contact_sheet(scene: Scene, listener: _Listener) -> Image:
    from humansim_ros.ros.messages import read_joint_view

    if not listener.sheet:
        raise HumansimError(
            "no instant was received from all cameras: the machine is too slow for this scene"
        )
    rows = []
    for camera in scene.cameras:
        image, depth, part = (
            listener.image(topic, listener.sheet[topic])
            for topic in (f"/{camera}/{kind}" for kind in ("image_raw", "depth/image", "part/image"))
        )
        joints = f"/{camera}/joints"
        points = read_joint_view(listener.message(joints, listener.sheet[joints]))
        drawn = image
        for actor in scene.actors.values():
            own = points[points["human"] == actor.instance]
            skeleton = actor.human.skeleton
            names = skeleton.joint_names
            parents = [None if p < 0 else skeleton.names[p] for p in skeleton.parents]
            parents += [skeleton.names[bone] for bone in skeleton.leaves]
            pixels = np.stack([own["u"], own["v"]], axis=-1)
            drawn = views.draw_joints(drawn, pixels, own["visible"], names, parents)
        rows.append(
            [
                image,
                drawn,
                views.color_depth(depth),
                views.color_labels(part),
            ]
        )
    titles = ("image_raw", "image_raw with joints", "depth/image", "part/image")
    return views.contact_sheet(rows, titles, list(scene.cameras))


def _video(scene: Scene, listener: _Listener) -> Iterator[Image]:
    """Frames with every camera at the same stamp, two cameras a row; each stands until the next is due."""
    names = list(scene.cameras)
    whole = [stamp for stamp in sorted(listener.small) if len(listener.small[stamp]) == len(names)]
    for stamp, following in zip(whole, [*whole[1:], None], strict=True):
        images = listener.small[stamp]
        rows = [
            np.concatenate([images[n] for n in names[i : i + 2]], axis=1) for i in range(0, len(names), 2)
        ]
        periods = 1 if following is None else round((following - stamp) * 1e-9 / scene.period)
        yield from [np.concatenate(rows)] * max(1, periods)


def _table(listener: _Listener, seconds: float) -> Table:
    table = Table(title="received", box=None, padding=(0, 1, 0, 0))
    for column in ("topic", "type"):
        table.add_column(column)
    for column in ("messages", "Hz", "MB/s"):
        table.add_column(column, justify="right")
    for topic, kind in listener.types.items():
        number = listener.messages[topic]
        megabytes = listener.bytes[topic] / 1e6 / seconds
        table.add_row(topic, kind, str(number), f"{number / seconds:.1f}", f"{megabytes:.2f}")
    return table
