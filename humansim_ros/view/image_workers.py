"""Processes that render the images of a page, so that rendering never delays the motion of the page."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import pickle
import queue
import signal
import threading
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any, Literal

from humansim_ros.drawing.views import color_channel, color_image, draw_joints
from humansim_ros.errors import HumansimError
from humansim_ros.scene.scene import Scene
from humansim_ros.scene.simulation import Frame, Simulation
from humansim_ros.types import Image
from humansim_ros.view.source import JOINTS, fitted

#: Channels that joints with their visibility need.
_JOINT_CHANNELS = ("depth", "instance", "part")
#: Seconds in which a process must answer.
_PATIENCE = 60.0
#: The motion of the page goes before its images.
_NICE = 5
#: Most processes; each has a renderer of its own.
_MOST = 4


@dataclass(frozen=True)
class Request:
    """Images that are wanted.

    Attributes:
        index: Number of the frame.
        cameras: Names of the cameras.
        channels: Names of the channels.
        width: Width to which wider images are scaled down, pixels.
    """

    index: int
    cameras: tuple[str, ...]
    channels: tuple[str, ...]
    width: int


@dataclass(frozen=True)
class Images:
    """Images of a request by camera and channel."""

    request: Request
    images: dict[str, dict[str, Image]]


#: What a process says: it has the scene, images, what is wrong, or nothing more (it ended).
_Answer = Literal["ready"] | Images | HumansimError | None


class ImageWorkers:
    """Processes that render different frames of a scene at the same time.

    Raises:
        HumansimError: The scene cannot be rendered, or a process died; from :meth:`latest` and :meth:`exact`.
    """

    def __init__(self, scene: Scene, count: int | None = None) -> None:
        context = multiprocessing.get_context("spawn")
        count = count or min(_MOST, os.cpu_count() or 1)
        self._scene = pickle.dumps(scene)
        self._first = 0
        self._outdated: set[Connection] = set()
        self._latest: Images | None = None
        self._connections: list[Connection] = []
        self._free: list[Connection] = []
        self._wanted: dict[Connection, Request] = {}
        self._numbers: dict[Connection, int] = {}
        self._asked = self._shown = 0
        self._answers: queue.SimpleQueue[tuple[Connection, _Answer]] = queue.SimpleQueue()
        self._processes = []
        for _ in range(count):
            ours, other = context.Pipe()
            process = context.Process(target=_work, args=(other,), daemon=True, name="humansim images")
            process.start()
            other.close()
            # images are larger than the buffer of a pipe: a thread waits for them, not the page
            threading.Thread(target=self._receive, args=(ours, self._scene), daemon=True).start()
            self._processes.append(process)
            self._connections.append(ours)

    def use(self, scene: Scene) -> None:
        """Render another scene from now on; processes are not started again."""
        self._scene = pickle.dumps(scene)
        self._outdated = set(self._connections)
        self._latest, self._first = None, self._asked

    def latest(self, request: Request) -> Images | None:
        """The newest images that are ready; ask for those of ``request`` if a process has time."""
        while self._collect(0):
            pass
        if self._free and request not in self._wanted.values() and not self._has(request):
            self._ask(request)
        return self._latest

    def exact(self, request: Request) -> Images:
        """Images of ``request``; waits for them."""
        while not self._has(request):
            if request not in self._wanted.values() and self._free:
                self._ask(request)
            if not self._collect(_PATIENCE):
                raise HumansimError(f"the images did not arrive within {_PATIENCE:.0f} s")
        assert self._latest is not None
        return self._latest

    def close(self) -> None:
        """End the processes."""
        for connection in self._connections:
            with contextlib.suppress(OSError):
                connection.send(None)
        for process in self._processes:
            process.join(1)
            if process.is_alive():
                process.kill()
                process.join()

    def _has(self, request: Request) -> bool:
        return self._latest is not None and self._latest.request == request

    def _ask(self, request: Request) -> None:
        connection = self._free.pop()
        self._wanted[connection] = request
        self._asked += 1
        self._numbers[connection] = self._asked
        with contextlib.suppress(OSError):  # the thread that receives tells that the process died
            if connection in self._outdated:
                self._outdated.remove(connection)
                connection.send(self._scene)
            connection.send(request)

    def _receive(self, connection: Connection, scene: bytes) -> None:
        """Send the scene, then receive what a process renders, until it ends."""
        try:
            connection.send_bytes(scene)
            self._answers.put((connection, "ready"))
            while True:
                self._answers.put((connection, connection.recv()))
        except (EOFError, OSError):
            self._answers.put((connection, None))

    def _collect(self, timeout: float) -> bool:
        """Take an answer; whether there was one."""
        try:
            connection, answer = self._answers.get(block=timeout > 0, timeout=timeout or None)
        except queue.Empty:
            return False
        self._wanted.pop(connection, None)
        if answer is None:
            raise HumansimError("a process that renders images died; open the scene again")
        self._free.append(connection)
        if answer == "ready":
            return True
        if self._numbers[connection] <= self._first:  # of a scene that is not shown any more
            return True
        if isinstance(answer, HumansimError):
            raise answer
        if self._numbers[connection] > self._shown:  # else images that were asked for later came before
            self._shown, self._latest = self._numbers[connection], answer
        return True


def _work(connection: Connection) -> None:
    """Render until the socket closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that serves the page
    os.nice(_NICE)
    with contextlib.suppress(EOFError, OSError):
        scene: Scene = pickle.loads(connection.recv_bytes())
        painter: _Painter | None = None
        while True:
            request: Request | bytes | None = connection.recv()
            if request is None:
                return
            if isinstance(request, bytes):
                if painter is not None:
                    painter.close()
                scene, painter = pickle.loads(request), None
                continue
            try:
                painter = painter or _Painter(scene)
                answer: Any = Images(request, painter.images(request))
            except HumansimError as error:
                answer = error
            connection.send(answer)


class _Painter:
    """Simulations of a scene with the channels that were asked for; they share a renderer."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._renderer = scene.make_renderer()
        self._simulations: dict[tuple[str, ...], Simulation] = {}

    def close(self) -> None:
        """Free the renderer."""
        self._renderer.close()

    def images(self, request: Request) -> dict[str, dict[str, Image]]:
        wanted = set(request.channels)
        rendered = wanted - {JOINTS} | ({"rgb", *_JOINT_CHANNELS} if JOINTS in wanted else set())
        channels = tuple(sorted(rendered))
        simulation = self._simulations.get(channels)
        if simulation is None:
            simulation = Simulation(self._scene, channels=channels, renderer=self._renderer)
            self._simulations[channels] = simulation
        frame = simulation.frame(request.index, cameras=request.cameras)
        return {
            camera: {
                channel: fitted(picture(self._scene, frame, camera, channel), request.width, channel)
                for channel in request.channels
            }
            for camera in request.cameras
        }


def picture(scene: Scene, frame: Frame, camera: str, channel: str) -> Image:
    """Image (H, W, 3) of a channel for people to look at.

    Args:
        scene: The scene.
        frame: Its frame.
        camera: Name of the camera.
        channel: Name of the channel; ``joints`` is the image with the joints drawn over it.
    """
    view = frame.views[camera]
    if channel != JOINTS:
        if channel == "rgb":
            return color_image(view.rgb, scene.scene_cameras[camera].encoding)
        return color_channel(channel, getattr(view, channel))
    image = color_image(view.rgb, scene.scene_cameras[camera].encoding)
    for name, joints in frame.truth[camera].joints.items():
        skeleton = scene.actors[name].human.skeleton
        names, parents = skeleton.joint_names, skeleton.joint_parents
        image = draw_joints(image, joints.pixels, joints.visible, names, parents)
    return image
