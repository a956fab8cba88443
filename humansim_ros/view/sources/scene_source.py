"""Shows a scene in the page: computes motion in this process, and renders images in other processes."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import cached_property
from typing import TypeAlias

import numpy as np

from humansim_ros.cameras.camera import Camera
from humansim_ros.data.engine import JobProcesses, ProcessDiedError
from humansim_ros.data.evaluation import truth_at
from humansim_ros.errors import EvaluationError, HumansimError
from humansim_ros.files.mesh import Mesh
from humansim_ros.files.reading import cores
from humansim_ros.geometry import quaternion_to_matrix
from humansim_ros.people.humans import Human
from humansim_ros.scene.config import FIRST_STAMP
from humansim_ros.scene.core import Frame, Needs, Playback, Scene, SceneStates, Simulation
from humansim_ros.scene.features import Sweep
from humansim_ros.scene.pictures import channel_picture, draw_joints
from humansim_ros.scene.truth import REQUIRED_CHANNELS
from humansim_ros.types import Array, Image
from humansim_ros.view.sources.picking import PIXEL_CHANNELS, pixel_info
from humansim_ros.view.sources.source import (
    JOINTS,
    POSES,
    FrameRequest,
    PixelInfo,
    ViewFrame,
    ViewSource,
    fitted,
)
from humansim_ros.view.sources.topic_people import beside_truth
from humansim_ros.view.sources.tracks import ErrorPlan, SceneTracks

#: Channels that the page can show.
_CHANNELS = ("rgb", JOINTS, "depth", "part", "instance", "normal", "flow")
#: Shortest and longest duration that the timeline shows, seconds.
_SHORTEST, _LONGEST = 2.0, 600.0
#: Width of all images next to each other, pixels, and most images next to each other.
_PAGE_WIDTH, _BESIDE = 1280, 4


class SceneViewSource(ViewSource):
    """A scene that plays in the page.

    Args:
        scene: The scene.
        title: Title of the page. If None, the name of the scene file.
        workers: Number of processes that render. If None, the number of cores, at most four.
        has_cameras: Whether the page shows the cameras of the scene.
    """

    title: str = ""
    messages: Sequence[str] = ()
    channels: tuple[str, ...] = _CHANNELS
    renders = True

    def __init__(
        self,
        scene: Scene,
        title: str | None = None,
        workers: int | None = None,
        has_cameras: bool = True,
    ) -> None:
        self.scene = scene = scene.at_full_rate()
        self.title = title or (scene.path.stem if scene.path else "scene")
        self.messages = [] if scene.actors else ["The scene has no people."]
        if not has_cameras:
            self.messages.append("The scene has no cameras.")
        self._has_cameras = has_cameras
        self._playback = Playback(scene)
        self._count = workers
        self._shown = 0
        self._exact: Frame | None = None
        #: Cache: for each scanner, the frame in which its last sweep ended, and the points of that sweep.
        self._scans: dict[str, tuple[int, dict[str, Array]]] = {}

    @property
    def people(self) -> Mapping[str, Human]:
        return {name: actor.human for name, actor in self.scene.actors.items()}

    @property
    def objects(self) -> Mapping[str, Mesh]:
        return {name: item.mesh for name, item in self.scene.moving_objects.items()}

    @cached_property
    def static(self) -> Mapping[str, Mesh]:
        """Meshes of the room and of static objects in ``map``, by name."""
        meshes = {f"room {number}": mesh for number, mesh in enumerate(self.scene.environment.meshes, 1)}
        static = {name: item.static_mesh() for name, item in self.scene.objects.items() if not item.moves}
        return meshes | static

    @property
    def cameras(self) -> Mapping[str, Camera]:
        return self.scene.cameras if self._has_cameras else {}

    @property
    def scanners(self) -> Collection[str]:  # type: ignore[override]
        return self.scene.scanners

    @property
    def period(self) -> int:
        return round(1e9 / self.scene.config.rate)

    @property
    def frames(self) -> int:
        tracks = [actor.keyframes for actor in self.scene.actors.values()]
        tracks += [item.keyframes for item in self.scene.moving_objects.values()]
        lasting = [track.timeline.duration for track in tracks if track is not None]
        lasting += [actor.motion.duration for actor in self.scene.actors.values()]
        if self.estimate is not None and len(self.estimate.poses.times):
            # show all frames of the estimate, which may last longer than the motions
            first, last = (int(stamp) * 1e-9 for stamp in self.estimate.poses.times[[0, -1]])
            if first < _LONGEST:  # not of another clock
                lasting.append(last - FIRST_STAMP * 1e-9 + self.period * 1e-9)
        longest = max(lasting, default=0.0)
        return max(2, round(min(max(longest, _SHORTEST), _LONGEST) * self.scene.config.rate))

    def frame(self, index: int, wanted: FrameRequest = POSES) -> ViewFrame:
        elapsed = self.scene.frame_time(index)
        shown = self._playback.show(elapsed)
        joints: dict[str, Array] = {}
        sizes: dict[str, float] = {}
        faces: dict[str, Array] = {}
        for name, actor in self._playback.actors.items():
            # the bones do not move the jaw: on the page, shapes of the face do
            body = actor.posed(shown.motions[name].contiguous())
            joints[name], sizes[name] = body.bones[0], float(body.sizes[0])
            if "face" in body.values:
                faces[name] = actor.human.of_actions(body.values["face"][1][0])
        self._shown = index
        images = self._images(index, wanted)
        estimate, errors = self._estimate(elapsed)
        return ViewFrame(
            index=index,
            stamp=FIRST_STAMP + elapsed,
            scene_time=elapsed,
            joints=joints,
            sizes=sizes,
            faces=faces,
            objects={name: pose.matrix for name, pose in shown.objects.items()},
            cameras={
                name: camera.camera_at(shown.cameras[name]) if name in shown.cameras else camera.camera
                for name, camera in self.scene.scene_cameras.items()
                if name in self.cameras
            },
            images=images.images if images else {},
            image_index=images.request.index if images and images.is_whole else None,
            scans=self._scanned(index) if wanted.scans else {},
            estimate=estimate,
            estimate_errors=errors,
        )

    def _scanned(self, index: int) -> dict[str, dict[str, Array]]:
        """Points in ``map``, by person, of the last sweep of each scanner that ended at or before a frame."""
        found = {}
        for name, scanner in self.scene.scanners.items():
            most = 1 + math.ceil(scanner.pattern.period / self.period)
            for number in range(index, max(index - most, 0), -1):
                if self._scans.get(name, (None,))[0] != number:
                    sweeps = self._states.sweeps(name, number)
                    if not sweeps:
                        continue
                    self._scans[name] = number, self._by_person(sweeps[-1])
                found[name] = self._scans[name][1]
                break
        return found

    def _by_person(self, sweep: Sweep) -> dict[str, Array]:
        """Points of a sweep in ``map`` by person; "" for other surfaces. People without points are absent."""
        points = sweep.points @ quaternion_to_matrix(sweep.rotation).T + sweep.position
        actors = self.scene.actors
        people = {name: points[sweep.instances == actor.instance] for name, actor in actors.items()}
        people[""] = points[~np.isin(sweep.instances, [actor.instance for actor in actors.values()])]
        return {name: seen for name, seen in people.items() if len(seen)}

    @cached_property
    def _states(self) -> SceneStates:
        """States of the scene to compute sweeps of scanners, which need no renderer."""
        return SceneStates(self.scene)

    @cached_property
    def _simulation(self) -> Simulation:
        """Simulation in this process, which gives the exact truth of clicked pixels."""
        return Simulation(self.scene)

    def _estimate(self, elapsed: int) -> tuple[dict[str, Array], dict[str, float]]:
        """Points and errors of the estimate at a time of the scene, nanoseconds, by person."""
        if self.estimate is None:
            return {}, {}
        people = self.estimate.at(FIRST_STAMP + elapsed, self.period // 2)
        if not people or not self.scene.actors:
            return {}, {}
        options, time = self.estimate.options, np.array([elapsed], np.int64)
        with suppress(EvaluationError):  # the tracks tell it
            truth = truth_at(self.scene, time, FIRST_STAMP + time, options.keypoints)
            named = {name: (truth.names, pose) for name, pose in truth.people[0].items()}
            return beside_truth(people, named, options)
        return {pose.person or "": pose.positions for pose in people}, {}

    def prepare(self, cameras: Collection[str], channels: Collection[str], alone: bool = False) -> None:
        with suppress(HumansimError):  # the first frame tells it
            if alone and self.cameras:
                _ = self.scene.static_meshes, self.scene.joint_surfaces  # once for all
                self.__dict__["_workers"] = ImageWorkers(self.scene, self._count, copies=True)
            self._images(0, FrameRequest(cameras, channels))

    def describe(self, camera: str, x: int, y: int) -> PixelInfo:
        if self._exact is None or self._exact.index != self._shown or camera not in self._exact.views:
            self._exact = self._simulation.frame(self._shown, Needs(PIXEL_CHANNELS, [camera]))
        return pixel_info(self.scene, self._exact, camera, x, y)

    def tracks(self) -> SceneTracks:
        plan = None
        if self.estimate is not None and self.scene.actors:
            times = [self.scene.frame_time(index) for index in range(self.frames)]
            stamps = FIRST_STAMP + np.array(times, np.int64)
            plan = ErrorPlan.of(stamps, self.estimate.poses, self.estimate.options)
        return SceneTracks(self.scene, self.frames, tuple(self.cameras), plan)

    def take_over(self, previous: ViewSource) -> None:
        """Let the processes of the previous source render this scene, since starting new ones takes
        seconds."""
        if isinstance(previous, SceneViewSource) and "_workers" in previous.__dict__:
            workers: ImageWorkers = previous.__dict__.pop("_workers")
            workers.use(self.scene)
            self.__dict__["_workers"] = workers

    def close(self) -> None:
        if "_workers" in self.__dict__:
            self._workers.close()
        if "_simulation" in self.__dict__:
            self._simulation.close()

    @cached_property
    def _workers(self) -> ImageWorkers:
        return ImageWorkers(self.scene, self._count)

    def _images(self, index: int, wanted: FrameRequest) -> Images | None:
        known = tuple(name for name in self.scene.scene_cameras if name in wanted.cameras)
        shown = tuple(name for name in _CHANNELS if name in wanted.channels)
        if not known or not shown:
            return None
        width = _PAGE_WIDTH // min(len(known), _BESIDE)
        request = Request(index, known, shown, width, frozenset(known) & frozenset(wanted.full))
        return self._workers.exact(request) if wanted.wait else self._workers.latest(request)


# --- processes that render the images, so that rendering never delays the motion of the page

#: Longest wait for images of a process, seconds.
_PATIENCE = 60.0
#: Niceness of the rendering processes, so that the motion of the page goes before its images.
_NICE = 5
#: Most processes by default. Each has its own renderer.
_MOST = 4


@dataclass(frozen=True)
class Request:
    """A request for the images of a frame.

    Attributes:
        index: Number of the frame.
        cameras: Names of the cameras.
        channels: Names of the channels.
        width: Width to which wider images are scaled down, pixels.
        full: Names of the cameras with images that keep their size.
    """

    index: int
    cameras: tuple[str, ...]
    channels: tuple[str, ...]
    width: int
    full: frozenset[str] = frozenset()


@dataclass(frozen=True)
class Images:
    """Images of a request by camera and channel. The first images of a scene may lack some cameras."""

    request: Request
    images: dict[str, dict[str, Image]]

    @property
    def is_whole(self) -> bool:
        """Whether the images of all requested cameras are there."""
        return self.images.keys() >= set(self.request.cameras)


@dataclass
class _Frame:
    """A frame whose images are being rendered: cameras that no process renders yet, and finished images."""

    request: Request
    left: list[str]
    images: dict[str, dict[str, Image]] = field(default_factory=dict)

    @property
    def so_far(self) -> Images:
        """The images that have arrived until now, in the order of the cameras in the request."""
        found = {name: self.images[name] for name in self.request.cameras if name in self.images}
        return Images(self.request, found)


class ImageWorkers:
    """Processes that render in parallel: different cameras of a frame, and different frames.

    Each process caches the static image of its cameras. Therefore it gets the same cameras again.

    Args:
        scene: The scene.
        count: Number of processes. If None, as many as the machine has cores, but at most four.
        copies: Whether the processes are forked from this process (see :class:`JobProcesses`).

    Raises:
        HumansimError: Raised by :meth:`latest` and :meth:`exact` if rendering fails, or a process died.
    """

    def __init__(self, scene: Scene, count: int | None = None, copies: bool = False) -> None:
        self._count = count or min(_MOST, cores())
        self._workers = JobProcesses(_PageImages(scene), self._count, _NICE, copies)
        self._latest: Images | None = None
        #: Frames in progress, by number of the request, in this order.
        self._frames: dict[int, _Frame] = {}
        #: Cameras that each process has rendered.
        self._rendered: list[set[str]] = [set() for _ in range(self._count)]
        self._first = self._asked = self._shown = 0

    def use(self, scene: Scene) -> None:
        """Render another scene from now on, with the same processes."""
        self._workers.use(_PageImages(scene))
        self._latest, self._first = None, self._asked
        self._frames.clear()
        self._rendered = [set() for _ in range(self._count)]

    def latest(self, request: Request) -> Images | None:
        """Return the newest finished images, or None. If a process is idle, start to render ``request``."""
        while self._collect(0):
            pass
        self._ask(request)
        if self._latest is not None:
            return self._latest
        return next(
            (Images(each.request, each.images) for each in self._frames.values() if each.images), None
        )

    def exact(self, request: Request) -> Images:
        """Wait for the images of ``request``, and return them. Other unfinished frames are dropped."""
        for number, frame in list(self._frames.items()):
            if frame.left and frame.request != request:
                del self._frames[number]
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
        """Give each idle process some cameras of a frame in progress or, if none is left, of a new frame for
        ``request``."""
        with self._death():
            for process in self._workers.idle():
                found = next(((number, frame) for number, frame in self._frames.items() if frame.left), None)
                if found is None:
                    if self._has(request) or any(each.request == request for each in self._frames.values()):
                        return
                    self._asked += 1
                    found = self._asked, _Frame(request, list(request.cameras))
                    self._frames[self._asked] = found[1]
                number, frame = found
                cameras = self._share(process, frame)
                self._workers.ask(_Part(number, frame.request, cameras), process)

    def _share(self, process: int, frame: _Frame) -> tuple[str, ...]:
        """Choose cameras of a frame for a process: first those it has rendered, last those of other
        processes."""
        own = self._rendered[process]
        others = set().union(*self._rendered) - own
        order = sorted(frame.left, key=lambda name: (name not in own, name in others))
        taken = tuple(order[: -(-len(frame.request.cameras) // self._count)])
        frame.left = [name for name in frame.left if name not in taken]
        own.update(taken)
        return taken

    def _collect(self, timeout: float) -> bool:
        """Process finished images, waiting at most ``timeout`` seconds. Returns whether some have arrived."""
        found = False
        with self._death():
            for part, result in self._workers.arrived(timeout):
                found = True
                self._take(part, result)
        return found

    def _take(self, part: _Part, result: _CameraImages | HumansimError) -> None:
        if part.number <= self._first:  # of a scene that is not shown any more
            return
        frame = self._frames.get(part.number)
        if isinstance(result, HumansimError):
            self._frames.pop(part.number, None)
            raise result
        if frame is None:
            return
        frame.images |= result
        images = frame.so_far
        if not images.is_whole:
            return
        del self._frames[part.number]
        if part.number > self._shown:  # else images that were asked for later came before
            self._shown, self._latest = part.number, images

    @contextmanager
    def _death(self) -> Iterator[None]:
        try:
            yield
        except ProcessDiedError:
            raise HumansimError("a process that renders images died; open the scene again") from None


#: Images by camera and channel.
_CameraImages: TypeAlias = dict[str, dict[str, Image]]


@dataclass(frozen=True)
class _Part:
    """The cameras of a request that one process renders. ``number``: number of the request."""

    number: int
    request: Request
    cameras: tuple[str, ...]


@dataclass(frozen=True)
class _PageImages:
    """Job that renders images of a scene for the page."""

    scene: Scene

    def start(self) -> _Painter:
        return _Painter(self.scene)


class _Painter:
    """Renders images in a process."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._simulation = Simulation(scene)

    def close(self) -> None:
        self._simulation.close()

    def work(self, part: _Part) -> _CameraImages:
        request = part.request
        wanted = set(request.channels)
        rendered = wanted - {JOINTS} | ({"rgb", *REQUIRED_CHANNELS["joints"]} if JOINTS in wanted else set())
        frame = self._simulation.frame(request.index, Needs(rendered, part.cameras))
        images: _CameraImages = {}
        for camera in part.cameras:
            width = None if camera in request.full else request.width
            for channel in request.channels:
                image = picture(self._scene, frame, camera, channel)
                images.setdefault(camera, {})[channel] = fitted(image, width, channel)
        return images


def picture(scene: Scene, frame: Frame, camera: str, channel: str) -> Image:
    """Make an image (H, W, 3) of a channel for people to look at, with depth and labels as colours.

    Args:
        scene: The scene.
        frame: Frame of the scene.
        camera: Name of the camera.
        channel: Name of the channel; ``joints`` is the image with the joints drawn over it.
    """
    own = "rgb" if channel == JOINTS else channel
    image = channel_picture(frame.views[camera], own, scene.scene_cameras[camera].encoding)
    if channel != JOINTS:
        return image
    for name, joints in frame.truth[camera].joints.items():
        skeleton = scene.actors[name].human.skeleton
        names, parents = skeleton.joint_names, skeleton.joint_parents
        image = draw_joints(image, joints.pixels, joints.visible, names, parents)
    return image
