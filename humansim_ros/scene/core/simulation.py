"""A scene in one process, without ROS: states of its frames, rendering, and ground truth."""

from __future__ import annotations

import math
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import count
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

import numpy as np
from numpy.typing import NDArray

from humansim_ros.cameras.camera import Camera
from humansim_ros.cameras.sensor import DepthSensor
from humansim_ros.errors import RenderError, SceneError, unknown
from humansim_ros.geometry import ObjectPose
from humansim_ros.motion.body import JointPoses
from humansim_ros.people.humans import Human
from humansim_ros.people.keypoints import BySet, KeypointLocator, KeypointSet
from humansim_ros.pictures import Pictured, drawing
from humansim_ros.render.interface import (
    ADJACENT_NAMES,
    CHANNELS,
    AdjacentName,
    Body,
    Renderer,
    View,
    comparing_with,
)
from humansim_ros.scene.config.timing import frame_at
from humansim_ros.scene.core.camera import CameraPose, SceneCamera
from humansim_ros.scene.core.faults import NO_FAULTS, FrameFaults
from humansim_ros.scene.core.needs import Needs
from humansim_ros.scene.core.playback import Playback
from humansim_ros.scene.core.scene import Scene, short_list
from humansim_ros.scene.core.state import CameraShot, DepthCapture, OnAccess, SceneState
from humansim_ros.scene.truth.camera_truth import BodyBox, CameraTruth, JointView, KeypointView
from humansim_ros.scene.truth.human_state import HumanState
from humansim_ros.types import Array, Float32Array, Image

if TYPE_CHECKING:
    from matplotlib.figure import Figure

T = TypeVar("T")

#: Pictures of a camera from the present one to each of the adjacent ones.
_DIRECTIONS = dict(zip(ADJACENT_NAMES, (1, -1), strict=True))


class SceneStates:
    """States of a scene, each computed once while frames follow each other.

    Args:
        scene: The scene.
        start: Stamp of frame 0, nanoseconds.

    Attributes:
        playback: Clock and motions, at the state that was asked for last.
    """

    def __init__(self, scene: Scene, start: int = 1) -> None:
        self.playback = Playback(scene)
        self._scene, self._start = scene, start
        #: Adjacent frames that cameras compared the last frame with.
        self._directions: dict[AdjacentName, int] = {}
        #: Makers of sweeps by scanner.
        self._scanning = {name: scanner.scanning(scene) for name, scanner in scene.scanners.items()}
        longest = max((scanner.pattern.period for scanner in scene.scanners.values()), default=0.0)
        #: Frames before the present one that sweeps need.
        self._sweep_frames = 1 + math.ceil(longest * 1e-9 / scene.period)
        #: States that are needed again, by scene time and version of the motions.
        self._kept: dict[tuple[int, int], SceneState] = {}

    def at(self, index: int) -> SceneState:
        """State of the scene at a frame. A frame that is still in the cache returns the same bodies, so that
        renderers can reuse what they computed from them."""
        elapsed = self._scene.frame_time(index)
        key = elapsed, self.playback.version
        if key in self._kept:
            self.playback.elapsed = elapsed
            return self._kept[key]
        state = self.playback.show(elapsed)
        humans = {name: actor.state(state.motions[name]) for name, actor in state.actors.items()}
        state = replace(state, stamp=self._start + elapsed, humans=humans)
        if self._scanning or self._directions:
            self._kept[key] = state
        return state

    def adjacent(
        self, index: int, steps: Collection[int], compared: Collection[AdjacentName]
    ) -> dict[int, Mapping[AdjacentName, SceneState]]:
        """States some frames after and before a frame, by step.

        Args:
            index: Number of the frame.
            steps: Numbers of frames between two pictures of a camera.
            compared: Which adjacent frames cameras compare the frame with.
        """
        self._directions = {name: _DIRECTIONS[name] for name in compared}
        self._forget(index)
        return {
            step: {name: self.at(index + sign * step) for name, sign in self._directions.items()}
            for step in steps
        }

    def sweeps(self, scanner: str, index: int) -> list[Any]:
        """Sweeps of a scanner that end after the frame before, and not after frame ``index``."""
        if index == 0:
            return []
        self._forget(index)
        scanning, frame_time = self._scanning[scanner], self._scene.frame_time
        sweeps = []
        for number in scanning.due(frame_time(index - 1), frame_time(index)):
            begin = scanning.scanner.pattern.start(number)
            first = frame_at(begin, self._scene.config.rate)
            first -= frame_time(first) > begin
            states = [self.at(each) for each in range(first, index + 1)]
            sweeps.append(scanning.sweep(number, states, self._start))
        return sweeps

    def _forget(self, index: int) -> None:
        """Forget the states that frames from frame ``index`` on do not need, if they follow each other."""
        if not self._kept:
            return
        frames = set(range(index - self._sweep_frames, index + 1)) if self._scanning else set()
        for timing in {camera.timing for camera in self._scene.scene_cameras.values()}:
            number = timing.number(index)
            frames |= {timing.frame(number + each) for each in (0, *self._directions.values())}
        needed = {(self._scene.frame_time(frame), self.playback.version) for frame in frames}
        self._kept = {key: state for key, state in self._kept.items() if key in needed}


@dataclass(frozen=True, repr=False)
class Frame(Pictured):
    """Everything of a scene at one stamp. It can be pickled for another process.

    Attributes:
        index: Number of the frame, from 0.
        stamp: Nanoseconds.
        humans: Joints and vertices by human.
        views: Channels by camera. Only cameras that capture this frame are included. The same holds for
            ``truth``, ``cameras``, ``encodings``, ``depth_sensors``, ``rectified_depth`` and ``faults``.
        truth: Ground truth by camera. Its numbers are computed on first access.
        objects: Poses of moving objects by name.
        cameras: Cameras of ``views`` at their poses by name: the true ones.
        published_cameras: All requested cameras as topics publish them, with the errors of
            ``faults.calibration``.
        encodings: Encodings of ``rgb`` by camera, such as ``rgb8``, as the sensors have them.
        depth_sensors: What depth sensors measure, by camera that has one. It is rendered on first access, or
            when the frame is pickled, which is possible until the simulation is closed.
        bodies: All bodies, humans first.
        labels: Instance labels of humans and labelled objects by name.
        scene_time: Nanoseconds from the start of the scene.
        motions: Joints of the motions (N = 1) by human, with the names that they have in the motion.
        camera_poses: Poses and velocities by name of the cameras that a trajectory or the robot moves.
        robot: Pose and velocity of the robot's ``base_link``, as in its odometry. None if there is no robot.
        rectified_depth: (H, W) float32 depth in metres along the axis of ``image_rect`` by camera, if it was
            requested.
        models: Humans without pose by name.
        faults: Faults of cameras that have any, by camera. ``views`` show the faults of the image; ``sent``
            says whether and when it is sent.
        sweeps: By laser scanner: each ``Sweep`` that ended after the previous frame and not after this frame.
    """

    index: int
    stamp: int
    humans: dict[str, HumanState]
    views: dict[str, View]
    truth: dict[str, CameraTruth] = field(default_factory=dict)
    objects: dict[str, ObjectPose] = field(default_factory=dict)
    cameras: dict[str, Camera] = field(default_factory=dict)
    bodies: Sequence[Body] = ()
    labels: Mapping[str, int] = field(default_factory=dict)
    scene_time: int = 0
    motions: Mapping[str, JointPoses] = field(default_factory=dict)
    camera_poses: Mapping[str, CameraPose] = field(default_factory=dict)
    rectified_depth: Mapping[str, Float32Array] = field(default_factory=dict)
    models: Mapping[str, Human] = field(default_factory=dict)
    faults: Mapping[str, FrameFaults] = field(default_factory=dict)
    published_cameras: Mapping[str, Camera] = field(default_factory=dict)
    encodings: Mapping[str, str] = field(default_factory=dict)
    depth_sensors: Mapping[str, DepthCapture] = field(default_factory=dict)
    sweeps: Mapping[str, Sequence[Any]] = field(default_factory=dict)
    robot: ObjectPose | None = None

    def __repr__(self) -> str:
        humans, views = short_list(self.humans, "humans"), short_list(self.views, "views")
        return f"Frame(index={self.index}, stamp={self.stamp}, humans={humans}, views={views})"

    @property
    def joints(self) -> dict[str, dict[str, JointView]]:
        """Joints by camera and human; raises ChannelError without the channels depth, instance and part."""
        return {name: truth.joints for name, truth in self.truth.items()}

    @cached_property
    def keypoint_positions(self) -> Mapping[str, dict[str, Array]]:
        """Keypoints (K, 3) in ``map``, metres: ``frame.keypoint_positions["coco17"]["anna"]``.

        A set is computed on first access. Raises KeypointError if there is no such set.
        """
        return BySet(self._located)

    def _located(self, keypoints: KeypointSet) -> dict[str, Array]:
        return {
            name: KeypointLocator.of(model, keypoints).positions(
                self.humans[name].positions, self.humans[name].vertices
            )
            for name, model in self.models.items()
        }

    @cached_property
    def keypoints(self) -> Mapping[str, dict[str, dict[str, KeypointView]]]:
        """Keypoints by set, camera and human: ``frame.keypoints["coco17"]["camera_1"]["anna"]``.

        A set is computed on first access. Raises KeypointError if there is no such set, and ChannelError
        without the channels depth, instance and part.
        """
        return BySet(self._seen)

    def _seen(self, keypoints: KeypointSet) -> dict[str, dict[str, KeypointView]]:
        return {name: truth.keypoints(keypoints.name) for name, truth in self.truth.items()}

    @property
    def boxes(self) -> dict[str, dict[str, BodyBox]]:
        """Boxes by camera, then human or labelled object; raises ChannelError unless the channels have
        instance and amodal."""
        return {
            camera: {name: truth.boxes[name] for name in self.labels} for camera, truth in self.truth.items()
        }

    def plot(self, channel: str = "rgb", joints: bool = True) -> Figure:
        """Plot the cameras in a grid, with the joints over the images, and their names as titles.

        Needs matplotlib (``pip install 'humansim_ros[plot]'``). Visible joints are green, hidden ones orange
        circles; without the channels ``depth``, ``instance`` and ``part`` only the lines between joints are
        drawn. Notebooks show the figure; elsewhere ``frame.plot().savefig("frame.png")`` writes it.

        Args:
            channel: Name of the channel to plot.
            joints: Draw the joints.

        Raises:
            HumansimError: matplotlib is not installed, or the frame has no cameras.
            RenderError: There is no channel of this name.
            ChannelError: The frame has not this channel.
        """
        figure: Figure = drawing("sheets").plot_frame(self, channel, joints)
        return figure

    def visible_vertices(self, camera: str) -> dict[str, NDArray[np.bool_]]:
        """Masks (V,) of the vertices that a camera sees, by human or labelled object; raises ChannelError
        unless the channels have depth and instance."""
        masks = self.truth[camera].visible_vertices
        return {name: masks[name] for name in self.labels}


class Simulation:
    """Play a scene: iterate over its frames without end, or get :meth:`frames` or one :meth:`frame`.

    The same scene gives the same frames. Use it in a ``with`` statement, or call :meth:`close`, to free the
    renderer; else it is freed some time after the last reference to it. A simulation belongs to the thread
    that makes it (docs/scene.md, "Threads and worker processes").

    Args:
        scene: The scene.
        channels: Names of the channels that the cameras render (docs/ground_truth.md). Joints need ``depth``,
            ``instance`` and ``part``; boxes need ``instance`` and ``amodal``.
        start: Stamp of frame 0, nanoseconds.
        renderer: Renderer to use; a new one (moderngl needs EGL) if None.

    Attributes:
        channels: Names of the channels.
        playback: Clock and motions. ``simulation.playback.change("anna", speed=0.5)`` changes a motion after
            the frame that was shown last, as the parameters of the motion player do.

    Example:
        >>> with Simulation(Scene.load(), channels=("rgb", "depth")) as simulation:  # doctest: +SKIP
        ...     for frame in simulation.frames(2):
        ...         print(frame.stamp, frame.views["camera_1"])
        1 View(640x480: rgb, depth)
        33333334 View(640x480: rgb, depth)
    """

    def __init__(
        self,
        scene: Scene,
        channels: Collection[str] = CHANNELS,
        start: int = 1,
        renderer: Renderer | None = None,
    ) -> None:
        self.scene = scene
        self.channels: tuple[str, ...] = (channels,) if isinstance(channels, str) else tuple(channels)
        self._needs = Needs(self.channels, scanners=None)
        self.start = start
        self._states = SceneStates(scene, start)
        self.playback = self._states.playback
        self.renderer: Renderer = renderer or scene.make_renderer()

    def __repr__(self) -> str:
        return f"Simulation({self.scene!r}, channels={self.channels})"

    def __iter__(self) -> Iterator[Frame]:
        return (self.frame(index) for index in count())

    def __enter__(self) -> Simulation:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def frames(self, count: int) -> Iterator[Frame]:
        """The first ``count`` frames, one after the other."""
        return (self.frame(index) for index in range(count))

    def frame(self, index: int, needs: Needs | None = None, **former: Any) -> Frame:
        """Frame ``index``. Its stamp is ``start + round(index * period)``.

        Args:
            index: Number of the frame, from 0.
            needs: What the frame must have. If None, the channels of the simulation for all cameras, and all
                laser scanners. Cameras with a rate of their own are rendered only in their frames.
            former: Deprecated arguments ``cameras``, ``rectified_depth`` and ``scanners``.

        Raises:
            SceneError: There is no camera or scanner of a name.
            RenderError: The simulation belongs to another thread, or to the process that this one was forked
                from, or has been closed; or OpenGL failed.
        """
        self.renderer.check_usable()  # before playback is set to the frame, which another thread may be using
        if needs is None and not former:
            needs = self._needs
        elif not isinstance(needs, Needs):
            needs = self._former_needs(**{"cameras": needs, **former})
        channels = needs.ordered_channels
        asked = _chosen("camera", self.scene.scene_cameras, needs.cameras)
        chosen = {name: camera for name, camera in asked.items() if index in camera.timing}
        steps = {camera.timing.step for camera in chosen.values()}
        compared = [name for name in ADJACENT_NAMES if comparing_with(name, channels)]
        adjacent = self._states.adjacent(index, steps, compared)
        faults = {name: camera.faults.at(index) for name, camera in chosen.items() if camera.faults}
        frozen = {
            name: self._frozen(camera, camera.faults.pictured(index))
            for name, camera in chosen.items()
            if camera.faults and faults[name].picture and "rgb" in channels
        }
        swept = _chosen("scanner", self.scene.scanners, needs.scanners)
        sweeps = {name: self._states.sweeps(name, index) for name in swept}
        state = self._states.at(index)
        shots = {}
        for name, camera in chosen.items():
            others = adjacent[camera.timing.step].items()
            around = {frame: other.shot(camera).adjacent_frame for frame, other in others}
            shots[name] = replace(
                state.shot(camera, channels),
                faults=faults.get(name, NO_FAULTS),
                frozen=frozen.get(name),
                next_frame=around.get("next_frame"),
                previous_frame=around.get("previous_frame"),
            )
        captured = {name: shot.truth(self.renderer) for name, shot in shots.items()}
        return Frame(
            index=index,
            stamp=state.stamp,
            humans=dict(state.humans),
            views={name: each.view for name, each in captured.items()},
            truth=captured,
            objects=dict(state.objects),
            cameras={name: each.camera for name, each in captured.items()},
            bodies=state.bodies,
            labels=self.scene.labels,
            scene_time=state.scene_time,
            motions=state.motions,
            camera_poses=state.cameras,
            robot=state.robot,
            models={name: actor.human for name, actor in state.actors.items()},
            rectified_depth={
                name: shot.rectified_depth(self.renderer)
                for name, shot in shots.items()
                if name in needs.rectified
            },
            faults=faults,
            encodings={name: camera.encoding for name, camera in chosen.items()},
            published_cameras={
                name: camera.published_at(state.calibrated_pose(camera)) for name, camera in asked.items()
            },
            depth_sensors=_DepthCaptures(
                {
                    name: partial(self._measured, state.shot(camera), camera.depth_sensor)
                    for name, camera in chosen.items()
                    if camera.depth_sensor is not None
                }
            ),
            sweeps=sweeps,
        )

    def _former_needs(
        self, cameras: Any = None, rectified_depth: Collection[str] = (), scanners: Any = None
    ) -> Needs:
        """Needs of deprecated arguments."""
        text = "cameras, rectified_depth and scanners of Simulation.frame are deprecated: give Needs"
        warnings.warn(f"{text}; 0.4.0 removes them", DeprecationWarning, stacklevel=3)
        return Needs(self.channels, cameras, scanners, rectified_depth)

    def _measured(self, shot: CameraShot, sensor: DepthSensor) -> DepthCapture:
        self.renderer.check_usable()
        return shot.measured_depth(self.renderer, sensor)

    def close(self) -> None:
        """Free the renderer."""
        self.renderer.close()

    def _frozen(self, camera: SceneCamera, index: int) -> Image:
        """Image of an earlier frame, at which a camera has frozen."""
        state = self._states.at(index)
        faults = NO_FAULTS if camera.faults is None else camera.faults.at(index)
        return replace(state.shot(camera, ("rgb",)), faults=faults).take(self.renderer).rgb


def _chosen(kind: str, known: Mapping[str, T], names: Collection[str] | None) -> dict[str, T]:
    """Cameras or scanners of some names, all if None. Raises SceneError for a name that is not known."""
    if missing := set(names or ()) - known.keys():
        raise SceneError(unknown(kind, min(missing), known))
    return {name: each for name, each in known.items() if names is None or name in names}


class _DepthCaptures(OnAccess[DepthCapture]):
    """Measurements of depth sensors by camera, each rendered on first access."""

    def __reduce__(self) -> tuple[Any, ...]:
        for name in self._compute:
            with suppress(RenderError):  # the simulation is closed, or belongs to another thread
                self[name]
        return type(self), (dict.fromkeys(self._compute, _not_rendered), self._values)


def _not_rendered() -> NoReturn:
    raise RenderError(
        "this depth was not rendered before the frame was pickled: access frame.depth_sensors before, in the "
        "thread of the simulation"
    )
