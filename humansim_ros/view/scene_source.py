"""A scene as the source of a page: motion in this process, images in processes of their own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property

from humansim_ros.camera import Camera
from humansim_ros.humans import Human
from humansim_ros.mesh.mesh import Mesh
from humansim_ros.scene.playback import Playback
from humansim_ros.scene.scene import Scene
from humansim_ros.scene.simulation import Frame, Simulation
from humansim_ros.types import Array
from humansim_ros.view.image_workers import Images, ImageWorkers, Request
from humansim_ros.view.picking import PIXEL_CHANNELS, pixel_info
from humansim_ros.view.source import JOINTS, PixelInfo, ViewFrame, ViewSource, Wanted

#: Channels that the page can show.
_CHANNELS = ("rgb", JOINTS, "depth", "part", "instance", "normal", "flow")
#: Seconds of a scene whose motions are shorter, and longest that the timeline shows.
_SHORTEST, _LONGEST = 2.0, 600.0
#: Width of all images on the page together, and most beside each other.
_PAGE_WIDTH, _BESIDE = 1280, 4


class SceneViewSource(ViewSource):
    """A scene that plays in the page.

    Args:
        scene: The scene.
        title: Title of the page; the name of the scene file if None.
        workers: Number of processes that render; as many as the machine has cores if None.
    """

    title: str = ""
    messages: Sequence[str] = ()
    channels: tuple[str, ...] = _CHANNELS

    def __init__(
        self,
        scene: Scene,
        title: str | None = None,
        workers: int | None = None,
    ) -> None:
        self.scene = scene
        self.title = title or (scene.path.stem if scene.path else "scene")
        self.messages = [] if scene.actors else ["The scene has no people."]
        self._playback = Playback(scene)
        self._count = workers
        self._shown = 0
        self._truth: Simulation | None = None
        self._exact: Frame | None = None

    @property
    def people(self) -> Mapping[str, Human]:
        """Bodies without pose by name, in their outfit."""
        return {name: actor.human for name, actor in self.scene.actors.items()}

    @property
    def objects(self) -> Mapping[str, Mesh]:
        """Meshes of moving objects by name, in their own frame."""
        return {name: item.mesh for name, item in self.scene.moving_objects.items()}

    @cached_property
    def static(self) -> Mapping[str, Mesh]:
        """Meshes by name in ``map``: room, static objects."""
        meshes = {f"room {number}": mesh for number, mesh in enumerate(self.scene.environment.meshes, 1)}
        static = {name: item.static_mesh() for name, item in self.scene.objects.items() if not item.moves}
        return meshes | static

    @property
    def cameras(self) -> Mapping[str, Camera]:
        """Cameras at the start."""
        return self.scene.cameras

    @property
    def period(self) -> int:
        """Nanoseconds between frames."""
        return round(1e9 / self.scene.config.rate)

    @property
    def frames(self) -> int:
        """Number of frames."""
        tracks = [actor.keyframes for actor in self.scene.actors.values()]
        tracks += [item.keyframes for item in self.scene.moving_objects.values()]
        lasting = [track.timeline.duration for track in tracks if track is not None]
        lasting += [actor.motion.duration for actor in self.scene.actors.values()]
        longest = max(lasting, default=0.0)
        return max(2, round(min(max(longest, _SHORTEST), _LONGEST) * self.scene.config.rate))

    def show(self, wanted: Wanted) -> ViewFrame:
        index = wanted.index
        elapsed = self.scene.frame_time(index)
        poses = self._playback.show(elapsed)
        joints: dict[str, Array] = {}
        sizes: dict[str, float] = {}
        for name, actor in self._playback.actors.items():
            (joints[name],), (size,) = actor.joints_of(poses.poses[name].contiguous())
            sizes[name] = float(size)
        self._shown = index
        images = self._images(wanted)
        return ViewFrame(
            index=index,
            stamp=1 + elapsed,
            scene_time=elapsed,
            joints=joints,
            sizes=sizes,
            objects={name: pose.matrix for name, pose in poses.objects.items()},
            cameras={
                name: camera.camera_at(poses.cameras[name]) if name in poses.cameras else camera.camera
                for name, camera in self.scene.scene_cameras.items()
            },
            images=images.images if images else {},
            image_index=images.request.index if images else None,
        )

    def describe(self, camera: str, x: int, y: int) -> PixelInfo:
        """Numbers of a pixel of the frame that was given last."""
        if self._truth is None:
            self._truth = Simulation(self.scene, channels=PIXEL_CHANNELS)
        if self._exact is None or self._exact.index != self._shown or camera not in self._exact.views:
            self._exact = self._truth.frame(self._shown, cameras=[camera])
        return pixel_info(self.scene, self._exact, camera, x, y)

    def take_over(self, previous: ViewSource) -> None:
        """Let the processes of another scene render this one: starting them takes seconds."""
        if isinstance(previous, SceneViewSource) and "_workers" in previous.__dict__:
            workers: ImageWorkers = previous.__dict__.pop("_workers")
            workers.use(self.scene)
            self.__dict__["_workers"] = workers

    def close(self) -> None:
        """Free processes and renderers."""
        if "_workers" in self.__dict__:
            self._workers.close()
        if self._truth is not None:
            self._truth.close()

    @cached_property
    def _workers(self) -> ImageWorkers:
        return ImageWorkers(self.scene, self._count)

    def _images(self, wanted: Wanted) -> Images | None:
        known = tuple(name for name in self.scene.scene_cameras if name in wanted.cameras)
        shown = tuple(name for name in _CHANNELS if name in wanted.channels)
        if not known or not shown:
            return None
        request = Request(wanted.index, known, shown, _PAGE_WIDTH // min(len(known), _BESIDE))
        return self._workers.exact(request) if wanted.wait else self._workers.latest(request)
