"""Frames that are made of recorded messages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

from humansim_ros.cameras.camera import Camera
from humansim_ros.errors import BagError
from humansim_ros.render.interface import View
from humansim_ros.scene.core import Frame
from humansim_ros.scene.truth import BodyBox, CameraTruth, KeypointView
from humansim_ros.types import Array


@dataclass(frozen=True, repr=False)
class BagFrame(Frame):
    """A frame that was recorded.

    Attributes:
        recorded_keypoints: Keypoints by set, camera and person.
        recorded_positions: Keypoints (K, 3) in ``map``, metres, by set and person.
    """

    recorded_keypoints: Mapping[str, dict[str, dict[str, KeypointView]]] = field(default_factory=dict)
    recorded_positions: Mapping[str, dict[str, Array]] = field(default_factory=dict)

    @cached_property
    def keypoints(self) -> Mapping[str, dict[str, dict[str, KeypointView]]]:
        """Keypoints by set, camera and person."""
        return self.recorded_keypoints

    @cached_property
    def keypoint_positions(self) -> Mapping[str, dict[str, Array]]:
        """Keypoints (K, 3) in ``map``, metres, by set and person."""
        return self.recorded_positions


@dataclass(frozen=True, eq=False, repr=False)
class BagTruth(CameraTruth):
    """Truth of a camera that was recorded. ``recorded``: boxes by name of a human or object."""

    recorded: Mapping[str, BodyBox] = field(default_factory=dict)

    @classmethod
    def of(
        cls, camera: Camera, view: View, labels: Mapping[str, int], boxes: Mapping[str, BodyBox]
    ) -> BagTruth:
        """Truth of a camera.

        Args:
            camera: The camera at its pose.
            view: Its images.
            labels: Instance labels by name.
            boxes: Boxes by name.
        """
        return cls(camera, view, (), labels, {}, _no_joints, recorded=boxes)

    @cached_property
    def boxes(self) -> dict[str, BodyBox]:
        """Boxes by name of a human or object."""
        return dict(self.recorded)


def _no_joints(name: str) -> Array:
    """Used in place of the joints of a person, which are not read from bags. Always raises BagError."""
    raise BagError(f"the joints of {name} are not read")
