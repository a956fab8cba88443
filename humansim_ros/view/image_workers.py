"""Processes that render the images of a page, so that rendering never delays the motion of the page."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from humansim_ros.drawing.views import color_channel, color_image, draw_joints
from humansim_ros.errors import HumansimError
from humansim_ros.jobs.cores import cores
from humansim_ros.jobs.frame_job import Costs, FrameResult
from humansim_ros.jobs.workers import WorkerDiedError, Workers
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


class ImageWorkers:
    """Processes that render different frames of a scene at the same time.

    Raises:
        HumansimError: The scene cannot be rendered, or a process died; from :meth:`latest` and :meth:`exact`.
    """

    def __init__(self, scene: Scene, count: int | None = None) -> None:
        self._workers = Workers(_PageImages(scene), count or min(_MOST, cores()), _NICE)
        self._latest: Images | None = None
        self._wanted: dict[int, Request] = {}
        self._first = self._asked = self._shown = 0

    def use(self, scene: Scene) -> None:
        """Render another scene from now on; processes are not started again."""
        self._workers.use(_PageImages(scene))
        self._latest, self._first = None, self._asked

    def latest(self, request: Request) -> Images | None:
        """The newest images that are ready; ask for the images of ``request`` if a process has time."""
        while self._collect(0):
            pass
        self._ask(request)
        return self._latest

    def exact(self, request: Request) -> Images:
        """Images of ``request``; waits for them."""
        while not self._has(request):
            self._ask(request)
            if not self._collect(_PATIENCE):
                raise HumansimError(f"the images did not arrive within {_PATIENCE:.0f} s")
        assert self._latest is not None
        return self._latest

    def close(self) -> None:
        """End the processes."""
        self._workers.close()

    def _has(self, request: Request) -> bool:
        return self._latest is not None and self._latest.request == request

    def _ask(self, request: Request) -> None:
        """Ask a process that has nothing to do for images, unless they are there or on their way."""
        if self._has(request) or request in self._wanted.values():
            return
        with self._death():
            if self._workers.ask((self._asked + 1, request)):
                self._asked += 1
                self._wanted[self._asked] = request

    def _collect(self, timeout: float) -> bool:
        """Take what has arrived; whether something has."""
        found = False
        with self._death():
            for asked, result in self._workers.arrived(timeout):
                found = True
                # None: the start of a job, which fails again with the first request
                if asked is not None:
                    number, request = asked
                    self._take(number, request, result)
        return found

    def _take(self, number: int, request: Request, result: FrameResult | HumansimError) -> None:
        del self._wanted[number]
        if number <= self._first:  # of a scene that is not shown any more
            return
        if isinstance(result, HumansimError):
            raise result
        if number > self._shown:  # else images that were asked for later came before
            self._shown, self._latest = number, Images(request, _images_of(result))

    @contextmanager
    def _death(self) -> Iterator[None]:
        try:
            yield
        except WorkerDiedError:
            raise HumansimError("a process that renders images died; open the scene again") from None


@dataclass(frozen=True)
class _PageImages:
    """Images of a scene for the page, as a job."""

    scene: Scene

    def start(self) -> _Painter:
        return _Painter(self.scene)


class _Painter:
    """Simulations of a scene with the channels that were asked for; they share a renderer."""

    def __init__(self, scene: Scene) -> None:
        self.costs = Costs()
        self._scene = scene
        self._renderer = scene.make_renderer()
        self._simulations: dict[tuple[str, ...], Simulation] = {}

    def close(self) -> None:
        self._renderer.close()

    def work(self, asked: tuple[int, Request]) -> FrameResult:
        _, request = asked
        wanted = set(request.channels)
        rendered = wanted - {JOINTS} | ({"rgb", *_JOINT_CHANNELS} if JOINTS in wanted else set())
        channels = tuple(sorted(rendered))
        simulation = self._simulations.get(channels)
        if simulation is None:
            simulation = Simulation(self._scene, channels=channels, renderer=self._renderer)
            self._simulations[channels] = simulation
        frame = simulation.frame(request.index, cameras=request.cameras)
        images = {
            (camera, channel): fitted(picture(self._scene, frame, camera, channel), request.width, channel)
            for camera in request.cameras
            for channel in request.channels
        }
        contents = [[np.ascontiguousarray(image).data] for image in images.values()]
        return FrameResult([(*key, image.shape) for key, image in images.items()], contents)


def _images_of(result: FrameResult) -> dict[str, dict[str, Image]]:
    """Images by camera and channel."""
    images: dict[str, dict[str, Image]] = {}
    for (camera, channel, shape), (content,) in zip(result.value, result.data, strict=True):
        images.setdefault(camera, {})[channel] = np.frombuffer(content, np.uint8).reshape(shape).copy()
    return images


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
