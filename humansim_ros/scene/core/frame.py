"""Everything of a scene at one stamp, for one process or another."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from humansim_ros.cameras.camera import Camera
from humansim_ros.errors import RenderError
from humansim_ros.geometry import ObjectPose
from humansim_ros.motion.body import JointPoses
from humansim_ros.people.humans import Human
from humansim_ros.people.keypoints import BySet, KeypointLocator, KeypointSet
from humansim_ros.pictures import Pictured, drawing
from humansim_ros.render.interface import Body, Renderer, View
from humansim_ros.scene.core.camera import CameraPose
from humansim_ros.scene.core.faults import FrameFaults
from humansim_ros.scene.core.needs import Needs
from humansim_ros.scene.core.scene import short_list
from humansim_ros.scene.core.state import CameraShot, DepthCapture, OnAccess, SceneState
from humansim_ros.scene.truth.camera_truth import BodyBox, CameraTruth, JointView, KeypointView
from humansim_ros.scene.truth.human_state import HumanState
from humansim_ros.types import Array, Float32Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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
    humans: Mapping[str, HumanState]
    views: dict[str, View]
    truth: dict[str, CameraTruth] = field(default_factory=dict)
    objects: Mapping[str, ObjectPose] = field(default_factory=dict)
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

    @classmethod
    def captured(
        cls, state: SceneState, shots: Mapping[str, CameraShot], needs: Needs, renderer: Renderer
    ) -> Frame:
        """Render what cameras capture of a scene state, and put the frame together.

        Simulations and camera nodes make each frame with this function.

        Args:
            state: The scene at the stamp of the frame.
            shots: Shots of the cameras that capture the frame, by name, with the channels to be rendered.
            needs: What the frame must have. It says which cameras have rectified depth.
            renderer: Renderer of the scene.
        """
        truth = {name: shot.truth(renderer) for name, shot in shots.items()}
        rectified = {name: shot for name, shot in shots.items() if name in needs.rectified}
        measured = {
            name: partial(_measured, renderer, replace(shot, next_frame=None, previous_frame=None))
            for name, shot in shots.items()
            if shot.camera.depth_sensor is not None
        }
        return cls(
            index=state.index,
            stamp=state.stamp,
            humans=state.humans,
            views={name: each.view for name, each in truth.items()},
            truth=truth,
            objects=state.objects,
            cameras={name: each.camera for name, each in truth.items()},
            bodies=state.bodies,
            labels=state.scene.labels,
            scene_time=state.scene_time,
            motions=state.motions,
            camera_poses=state.cameras,
            rectified_depth={name: shot.rectified_depth(renderer) for name, shot in rectified.items()},
            models={name: actor.human for name, actor in state.actors.items()},
            faults={name: shot.faults for name, shot in shots.items() if shot.camera.faults is not None},
            encodings={name: shot.camera.encoding for name, shot in shots.items()},
            depth_sensors=_DepthCaptures(measured),
            robot=state.robot,
        )

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


def _measured(renderer: Renderer, shot: CameraShot) -> DepthCapture:
    renderer.check_usable()
    assert shot.camera.depth_sensor is not None
    return shot.measured_depth(renderer, shot.camera.depth_sensor)


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
