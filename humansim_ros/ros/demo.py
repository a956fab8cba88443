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

from humansim_ros import pictures
from humansim_ros.errors import HumansimError
from humansim_ros.ros.processes import scene_processes
from humansim_ros.ros.runtime import prepare_transport
from humansim_ros.ros.supervisor import Supervisor
from humansim_ros.scene import Scene

#: Seconds until every topic must have spoken.
_START_LIMIT = 60.0
#: Width of one camera's picture in the video.
_VIDEO_WIDTH = 480
#: Newest instants that are held until one of them has arrived from all cameras.
_INSTANTS = 20


def record_demo(scene_path: Path, output: Path, duration: float) -> bool:
    """Write ``contact_sheet.png`` and ``walk.mp4`` to a folder and print the table of topics. False if a node
    failed.
    """
    console = Console()
    scene = Scene.load(scene_path)
    output.mkdir(parents=True, exist_ok=True)
    started = time.monotonic()
    with Supervisor(scene_processes(scene_path)) as nodes, _Listener(scene) as listener:
        with _progress(console) as progress:
            task = progress.add_task("starting the nodes", total=None)
            while not listener.complete:
                if time.monotonic() - started > _START_LIMIT or nodes.dead():
                    progress.stop()
                    _explain(console, nodes.dead(), listener.silent)
                    return False
                listener.spin(0.1)
            listener.reset()
            progress.update(task, description="recording", total=duration)
            begin = time.monotonic()
            while (passed := time.monotonic() - begin) < duration:
                listener.spin(0.1)
                progress.update(task, completed=min(passed, duration))
                if nodes.dead():
                    progress.stop()
                    _explain(console, nodes.dead(), [])
                    return False
            seconds = time.monotonic() - begin
    with _progress(console) as progress:
        task = progress.add_task("writing pictures", total=2)
        pictures.write_png(output / "contact_sheet.png", _contact_sheet(scene, listener))
        progress.advance(task)
        pictures.write_mp4(output / "walk.mp4", _video(scene, listener), scene.config.rate)
        progress.advance(task)
    console.print(_table(listener, seconds))
    whole, any_camera = listener.equal_stamps()
    console.print(f"frames with all {len(scene.cameras)} cameras at equal stamps: {whole} of {any_camera}")
    for name in ("contact_sheet.png", "walk.mp4"):
        console.print(f"wrote {output / name}")
    return True


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
        self.sizes: dict[str, int] = {}
        self.messages: Counter[str] = Counter()
        self._waiting: dict[int, dict[str, Any]] = {}
        self.sheet: dict[str, Any] = {}
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
        for topic, kind in topics:
            self.types[topic] = f"{kind.__module__.split('.')[0]}/{kind.__name__}"
            self._node.create_subscription(kind, topic, self._taker(topic), qos_profile_sensor_data)

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

    @property
    def complete(self) -> bool:
        return not self.silent

    def spin(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            # always the same timeout: with another one rclpy starts its round of ready topics anew, and the first
            # topics starve the last
            self._executor.spin_once(timeout_sec=0.05)

    def reset(self) -> None:
        self.messages.clear()
        self.small.clear()

    def equal_stamps(self) -> tuple[int, int]:
        """Stamps seen by every camera, and by any."""
        return sum(len(cameras) == len(self.scene.cameras) for cameras in self.small.values()), len(
            self.small
        )

    def _taker(self, topic: str) -> Callable[[Any], None]:
        camera = topic.split("/")[1]
        is_picture = topic.endswith("/image_raw")

        def take(message: Any) -> None:
            from rclpy.serialization import serialize_message

            from humansim_ros.ros.messages import to_nanoseconds

            stamp = to_nanoseconds(message.header.stamp)
            self.messages[topic] += 1
            if topic not in self.sizes:
                self.sizes[topic] = len(serialize_message(message))
            if is_picture:
                image = np.frombuffer(message.data, np.uint8).reshape(message.height, message.width, 3)
                height = round(message.height * _VIDEO_WIDTH / message.width)
                small = cv2.resize(image, (_VIDEO_WIDTH, height), interpolation=cv2.INTER_AREA)
                self.small.setdefault(stamp, {})[camera] = small
            if topic in self._sheet_topics:
                self._keep_for_sheet(stamp, topic, message)

        return take

    def _keep_for_sheet(self, stamp: int, topic: str, message: Any) -> None:
        """Hold the messages of the newest few stamps until one instant is there whole; the latest such is
        shown.
        """
        self._waiting.setdefault(stamp, {})[topic] = message
        if len(self._waiting[stamp]) == len(self._sheet_topics):
            self.sheet = self._waiting[stamp]
        for old in sorted(self._waiting)[:-_INSTANTS]:
            del self._waiting[old]


def _contact_sheet(scene: Scene, listener: _Listener) -> pictures.Image:
    from humansim_ros.ros.messages import read_joint_view

    if not listener.sheet:
        raise HumansimError(
            "no instant was received from all cameras: the machine is too slow for this scene"
        )
    rows = []
    for camera in scene.cameras:
        rgb, depth, part = (
            listener.sheet[f"/{camera}/{kind}"] for kind in ("image_raw", "depth/image", "part/image")
        )
        image = np.frombuffer(rgb.data, np.uint8).reshape(rgb.height, rgb.width, 3)
        points = read_joint_view(listener.sheet[f"/{camera}/joints"])
        drawn = image
        for actor in scene.actors.values():
            own = points[points["human"] == actor.instance]
            skeleton = actor.human.skeleton
            names = skeleton.joint_names
            parents = [None if p < 0 else skeleton.names[p] for p in skeleton.parents]
            parents += [skeleton.names[bone] for bone in skeleton.leaves]
            pixels = np.stack([own["u"], own["v"]], axis=-1)
            drawn = pictures.draw_joints(drawn, pixels, own["visible"], names, parents)
        rows.append(
            [
                image,
                drawn,
                pictures.color_depth(
                    np.frombuffer(depth.data, np.float32).reshape(depth.height, depth.width)
                ),
                pictures.color_labels(np.frombuffer(part.data, np.uint8).reshape(part.height, part.width)),
            ]
        )
    titles = ("image_raw", "image_raw with joints", "depth/image", "part/image")
    return pictures.contact_sheet(rows, titles, list(scene.cameras))


def _video(scene: Scene, listener: _Listener) -> Iterator[pictures.Image]:
    """Frames with every camera at the same stamp, two cameras a row."""
    names = list(scene.cameras)
    for stamp in sorted(listener.small):
        images = listener.small[stamp]
        if len(images) == len(names):
            rows = [
                np.concatenate([images[n] for n in names[i : i + 2]], axis=1) for i in range(0, len(names), 2)
            ]
            yield np.concatenate(rows)


def _table(listener: _Listener, seconds: float) -> Table:
    table = Table(title="received")
    for column in ("topic", "type"):
        table.add_column(column)
    for column in ("messages", "Hz", "MB/s"):
        table.add_column(column, justify="right")
    for topic, kind in listener.types.items():
        number = listener.messages[topic]
        rate = number / seconds
        size = rate * listener.sizes.get(topic, 0) / 1e6
        table.add_row(topic, kind, str(number), f"{rate:.1f}", f"{size:.2f}")
    return table
