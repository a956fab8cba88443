"""``humansim demo``: run the nodes of a scene, subscribe to their topics, and write a picture and a video."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from humansim_ros.data.messages import (
    Frames,
    deserialised,
    read_faults,
    read_image,
    read_joint_view,
    scene_topics,
    serialised_stamp,
    to_nanoseconds,
)
from humansim_ros.errors import HumansimError, RosError
from humansim_ros.files.reading import make_folder
from humansim_ros.render.pictures import write_mp4, write_png
from humansim_ros.ros.processes.lockstep_settings import TimeOptions
from humansim_ros.ros.processes.node_processes import scene_processes
from humansim_ros.ros.processes.runtime import prepare_transport
from humansim_ros.ros.processes.supervisor import Supervisor
from humansim_ros.ros.tools.bench import in_step
from humansim_ros.ros.tools.listener import Listener
from humansim_ros.scene.core import Scene
from humansim_ros.scene.pictures import Tile, color_channel, color_image, sheet
from humansim_ros.types import Image

#: After the start, each topic must send a first message within this time, seconds.
_START_LIMIT = 60.0
#: Width and height of an image in the video, and width of an image in the contact sheet, pixels.
_VIDEO_SIZE, _TILE_WIDTH = (480, 360), 480
#: Most frames that are stored while images of some cameras are missing; and most memory for them, bytes.
_MAX_INCOMPLETE, _MAX_BYTES = 20, 1 << 29
#: Most frames for which stamps of images are stored.
_MAX_CLOCKS = 200
#: Most cameras that the pictures show.
_MAX_CAMERAS = 8
#: JPEG quality of the video frames that are held in memory.
_JPEG_QUALITY = 92
#: Encodings of topics with images other than RGB.
_ENCODINGS = {"depth/image": "32FC1", "part/image": "mono8"}
#: A joint farther away than this, pixels, is not drawn.
_FAR_OUTSIDE = 1e5


def record_demo(scene_path: Path, output: Path, duration: float, video: str = "walk.mp4") -> bool:
    """Write ``contact_sheet.png`` and a video to a folder, and print a table of the topics.

    Args:
        scene_path: Scene file.
        output: Folder for the files.
        duration: Seconds to record.
        video: File name of the video.

    Returns:
        False if a node failed or a topic sent nothing.
    """
    console = Console()
    scene = Scene.load(scene_path)
    make_folder(output)
    processes = scene_processes(scene_path, time=TimeOptions(lockstep=False))
    prepare_transport(len(processes) + 1, network=False)
    with Supervisor(processes) as nodes, _Recorder(scene) as recorder:
        seconds = _record(nodes, recorder, duration, console)
    if seconds is None:
        return False
    with _progress(console) as progress:
        task = progress.add_task("writing pictures", total=2)
        write_png(output / "contact_sheet.png", _contact_sheet(scene, recorder))
        progress.advance(task)
        write_mp4(output / video, _video(scene, recorder), scene.config.rate)
        progress.advance(task)
    console.print(_topic_table(recorder, seconds))
    complete, total = recorder.complete_stamps()
    shown, count = len(recorder.cameras), len(scene.cameras)
    if shown < count:
        console.print(f"the pictures show {shown} of the {count} cameras: {', '.join(recorder.cameras)}")
    console.print(f"frames with all {shown} cameras at equal stamps: {complete} of {total}")
    for name in ("contact_sheet.png", video):
        console.print(f"wrote {output / name}")
    return True


def _record(nodes: Supervisor, recorder: _Recorder, duration: float, console: Console) -> float | None:
    """Wait until every topic has sent a message, then record for ``duration`` seconds, and until a frame is
    complete.

    Returns:
        Recorded seconds, or None if a node has ended or a topic sends nothing.
    """
    with _progress(console) as progress:
        task = progress.add_task("starting the nodes", total=None)
        try:
            recorder.wait_for_all(nodes, _START_LIMIT)
            limit = time.monotonic() + _START_LIMIT
            while not recorder.sheet and not nodes.dead() and time.monotonic() < limit:
                recorder.spin(0.1)
            recorder.reset()
            progress.update(task, description="recording", total=duration)
            begin = time.monotonic()
            limit = begin + max(duration, _START_LIMIT)
            while time.monotonic() < limit:
                if dead := nodes.dead():
                    raise RosError(str(dead))
                if time.monotonic() >= begin + duration and recorder.thumbnails.whole():
                    break  # on a slow machine, no frame of such a short recording may have arrived completely
                recorder.spin(0.1)
                progress.update(task, completed=time.monotonic() - begin)
        except RosError as error:
            console.print(f"error: {error}", style="red")
            return None
    return time.monotonic() - begin


def _progress(console: Console) -> Progress:
    return Progress(TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), console=console)


class _Recorder(Listener):
    """Subscribes to the topics of a scene, and stores what the pictures need."""

    def __init__(self, scene: Scene) -> None:
        super().__init__("humansim_demo")
        self.scene = scene
        self.types: dict[str, str] = {}
        self.bytes: Counter[str] = Counter()
        self.messages: Counter[str] = Counter()
        #: Images and joints of the newest complete frame, by topic.
        self.sheet: dict[str, NDArray[Any]] = {}
        #: Cameras that the pictures show, chosen so that their images have the same stamps.
        self.cameras = in_step(scene.scene_cameras)[:_MAX_CAMERAS]
        #: Scaled images as JPEG, by stamp and camera, for the video.
        self.thumbnails: Frames[Any] = Frames(self.cameras)
        #: For cameras with a wrong clock: stamp of the frame, by the (wrong) stamp of its image.
        self._frame_stamps: dict[str, dict[int, int]] = {
            name: {} for name in self.cameras if _has_wrong_clock(scene, name)
        }
        # subscribed before the images, since they explain the stamps of images
        clocks = [f"{name}/faults" for name in self._frame_stamps]
        topics = sorted(scene_topics(scene), key=lambda topic: topic.name not in clocks)
        topics = [topic for topic in topics if topic.shown or topic.name in clocks]
        topics = [topic for topic in topics if topic.camera in ("", *self.cameras)]
        self._sheet_topics = [
            f"/{camera}/{kind}" for camera in self.cameras for kind in ("image_raw", *_ENCODINGS, "joints")
        ]
        self._for_sheet: Frames[NDArray[Any]] = Frames(
            self._sheet_topics,
            max_frames=_MAX_INCOMPLETE,
            max_size=_MAX_BYTES,
            size_of=lambda content: content.nbytes,
        )
        self._message_types = {f"/{topic.name}": topic.type for topic in topics}
        for topic, kind in self._message_types.items():
            self.types[topic] = f"{kind.__module__.split('.')[0]}/{kind.__name__}"
            self.listen(kind, topic, partial(self._on_message, topic))

    def reset(self) -> None:
        self.messages.clear()
        self.bytes.clear()
        self.thumbnails.clear()

    def complete_stamps(self) -> tuple[int, int]:
        """Count the stamps from the first to the last complete one. A stamp is complete if it has images of
        all cameras. Returns the number of complete stamps, and the number of stamps with at least one image.
        If no stamp is complete, the second number counts all stamps."""
        complete = self.thumbnails.whole()
        if not complete:
            return 0, len(self.thumbnails)
        # the first and the last frame of the recording may not have arrived completely
        return len(complete), sum(complete[0] <= stamp <= complete[-1] for stamp in self.thumbnails.stamps())

    def _on_message(self, topic: str, data: bytes) -> None:
        """Count a serialised message of a topic, and store what is in it. Only a few are deserialised."""
        camera = topic.split("/")[1]
        stamp: int | None = serialised_stamp(data)
        if topic.endswith("/faults"):
            self._note_clock(camera, data)
        if topic.endswith("/image_raw") and camera in self._frame_stamps:
            stamp = self._frame_stamps[camera].get(serialised_stamp(data))
        if topic in self._sheet_topics and stamp is not None:
            content = self._joints(topic, data) if topic.endswith("/joints") else self._image(topic, data)
            if self._for_sheet.add(topic, stamp, content):
                self.sheet = self._for_sheet.frame(stamp)
            if topic.endswith("/image_raw"):
                quality = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
                picture = cv2.imencode(".jpg", Tile(content, camera).draw(_VIDEO_SIZE), quality)[1]
                self.thumbnails.add(camera, stamp, picture)
        self.messages[topic] += 1
        self.bytes[topic] += len(data)

    def _note_clock(self, camera: str, data: bytes) -> None:
        """Note the stamp that a camera with a wrong clock gives to the image of a frame."""
        message = deserialised(data, self._message_types[f"/{camera}/faults"])
        stamp, known = to_nanoseconds(message.header.stamp), self._frame_stamps[camera]
        known[stamp + round(1e9 * read_faults(message)["clock"]["seconds"])] = stamp
        if len(known) > _MAX_CLOCKS:
            del known[next(iter(known))]

    def _image(self, topic: str, data: bytes) -> NDArray[Any]:
        """Pixels of a serialised image. Raises RosError unless it fits the camera of the topic."""
        message = deserialised(data, self._message_types[topic])
        camera, kind = topic[1:].split("/", 1)
        encoding = _ENCODINGS.get(kind, self.scene.scene_cameras[camera].encoding)
        width, height = self.scene.cameras[camera].size
        if (message.encoding, message.width, message.height) != (encoding, width, height):
            raise RosError(f"this is no image of {width}x{height} pixels in {encoding}")
        pixels = read_image(message)
        return color_image(pixels, encoding) if kind == "image_raw" else pixels

    def _joints(self, topic: str, data: bytes) -> NDArray[Any]:
        """Joints of a serialised message. Raises RosError unless they belong to humans of the scene."""
        points = read_joint_view(deserialised(data, self._message_types[topic]))
        actors = self.scene.actors.values()
        counts = [(actor.instance, len(actor.human.skeleton.joint_names)) for actor in actors]
        if any((points["human"] == instance).sum() != count for instance, count in counts):
            raise RosError("these are not the joints of the humans of the scene")
        return points


def _has_wrong_clock(scene: Scene, camera: str) -> bool:
    faults = scene.scene_cameras[camera].faults
    return faults is not None and faults.config.clock is not None


def _contact_sheet(scene: Scene, recorder: _Recorder) -> Image:
    if not recorder.sheet or not recorder.thumbnails.whole():
        raise HumansimError("no frame was received from all cameras: the machine is too slow for this scene")
    width, height = scene.cameras[recorder.cameras[0]].size
    size = _TILE_WIDTH, round(_TILE_WIDTH * height / width)
    tiles = []
    for camera in recorder.cameras:
        image, depth, part, points = (
            recorder.sheet[f"/{camera}/{kind}"] for kind in ("image_raw", *_ENCODINGS, "joints")
        )
        joints = []
        for actor in scene.actors.values():
            own = points[points["human"] == actor.instance]
            pixels = np.stack([own["u"], own["v"]], axis=-1)
            pixels[np.abs(pixels) > _FAR_OUTSIDE] = np.nan
            joints.append((actor.human.skeleton, pixels, own["visible"]))
        tiles += [
            Tile(image, f"{camera}/image_raw"),
            Tile(image, f"{camera}/image_raw with {camera}/joints", joints=joints),
            Tile(color_channel("depth", depth), f"{camera}/depth/image", "depth"),
            Tile(color_channel("part", part), f"{camera}/part/image", "part"),
        ]
    title = "The received images, and the received joints drawn over them"
    return sheet(title, [tile.draw(size) for tile in tiles], columns=4)


def _video(scene: Scene, recorder: _Recorder) -> Iterator[Image]:
    """Yield video frames: a grid with the images of all cameras at one stamp, repeated until the next
    stamp."""
    names, thumbnails = recorder.cameras, recorder.thumbnails
    columns = round(np.ceil(np.sqrt(len(names))))
    complete = thumbnails.whole()
    for stamp, following in zip(complete, [*complete[1:], None], strict=True):
        pictures = thumbnails.frame(stamp)
        images: list[Any] = [cv2.imdecode(pictures[name], cv2.IMREAD_UNCHANGED) for name in names]
        images += [np.zeros_like(images[0])] * (-len(images) % columns)
        rows = [np.concatenate(images[i : i + columns], axis=1) for i in range(0, len(images), columns)]
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
