"""Ground truth of one camera at one stamp: joints, keypoints, boxes and visible vertices of all bodies."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera import Camera
from humansim_ros.humans import Human
from humansim_ros.keypoints import KeypointLocator, keypoint_set
from humansim_ros.render import Body, View
from humansim_ros.render.channels import missing_channels
from humansim_ros.truth.boxes import BodyBox, view_boxes
from humansim_ros.truth.joints import NOTHING, OCCLUDED, OUTSIDE, SELF, VISIBLE, JointView, view_joints
from humansim_ros.truth.vertices import visible_points, visible_vertices
from humansim_ros.types import Array

#: Channels that a view must have for each property of :class:`CameraTruth`.
REQUIRED_CHANNELS = {
    "joints": ("depth", "instance", "part"),
    "boxes": ("instance", "amodal"),
    "visible_vertices": ("depth", "instance"),
}


@dataclass(frozen=True, eq=False, repr=False)
class CameraTruth:
    """Ground truth of one camera at one stamp, by name of a human or labelled object.

    Each property is computed from the view on first access, then cached.

    Attributes:
        camera: Camera with its pose at the stamp.
        view: Channels of the camera.
        bodies: All bodies at the stamp.
        labels: Instance labels of humans and labelled objects, by name.
        joint_surfaces: Part labels around joints by human, from :func:`~humansim_ros.truth.joint_surfaces`.
        joint_positions: Returns the joints (J, 3) of a human in ``map``, metres.
        humans: Humans by name, for keypoints.
    """

    camera: Camera
    view: View
    bodies: Sequence[Body]
    labels: Mapping[str, int]
    joint_surfaces: Mapping[str, NDArray[np.bool_]]
    joint_positions: Callable[[str], Array]
    humans: Mapping[str, Human] = field(default_factory=dict)
    _keypoints: dict[str, dict[str, KeypointView]] = field(init=False, default_factory=dict)

    def __repr__(self) -> str:
        kinds = [kind for kind in REQUIRED_CHANNELS if self.has(kind)]
        return f"CameraTruth({self.view!r}: {', '.join(kinds) or 'nothing without more channels'})"

    def has(self, kind: str) -> bool:
        """Whether the view has the channels for ``joints``, ``boxes`` or ``visible_vertices``."""
        return set(REQUIRED_CHANNELS[kind]) <= set(self.view.channels)

    def _require(self, kind: str) -> None:
        """Raise ChannelError if the view has not the channels for a property."""
        if not self.has(kind):
            raise missing_channels(kind, REQUIRED_CHANNELS[kind], self.view.channels)

    @cached_property
    def joints(self) -> dict[str, JointView]:
        """Joints by human. The view must have depth, instance and part; raises ChannelError otherwise."""
        self._require("joints")
        return {
            name: view_joints(
                *(self.camera, self.joint_positions(name), self.view, self.labels[name], surfaces),
                self._objects,
            )
            for name, surfaces in self.joint_surfaces.items()
        }

    def keypoints(self, set_name: str) -> dict[str, KeypointView]:
        """Keypoints of a set by human, by the same rule as :attr:`joints`.

        Raises:
            ChannelError: The view has not the channels depth, instance and part.
            KeypointError: There is no such set.
        """
        self._require("joints")
        if set_name not in self._keypoints:
            chosen = keypoint_set(set_name)
            vertices = {body.instance: body.vertices for body in self.bodies if body.instance}
            locators, positions = {}, {}
            for name, human in self.humans.items():
                label = self.labels[name]
                locators[label] = KeypointLocator.of(human, chosen)
                positions[label] = locators[label].positions(self.joint_positions(name), vertices[label])
            views = view_keypoints(self.camera, self.bodies, self.view, locators, positions, self._objects)
            self._keypoints[set_name] = {self._names[label]: view for label, view in views.items()}
        return self._keypoints[set_name]

    @cached_property
    def boxes(self) -> dict[str, BodyBox]:
        """Boxes by human or object. The view must have instance and amodal; raises ChannelError otherwise."""
        self._require("boxes")
        boxes = view_boxes(self.camera, self.bodies, self.view)
        return {self._names[label]: box for label, box in boxes.items()}

    @cached_property
    def visible_vertices(self) -> dict[str, NDArray[np.bool_]]:
        """Masks (V,) of visible vertices by human or object. The view must have depth and instance; raises
        ChannelError otherwise.
        """
        self._require("visible_vertices")
        masks = visible_vertices(self.camera, self.bodies, self.view)
        return {self._names[label]: mask for label, mask in masks.items()}

    @cached_property
    def _objects(self) -> list[int]:
        """Instance labels of labelled objects."""
        return [label for name, label in self.labels.items() if name not in self.joint_surfaces]

    @cached_property
    def _names(self) -> dict[int, str]:
        return {label: name for name, label in self.labels.items()}


@dataclass(frozen=True, repr=False)
class KeypointView(JointView):
    """Keypoints (K) of a human in the view of a camera.

    Attributes:
        positions: (K, 3) in ``map``, metres.
        certain: (K,) the place on the body is known, not fitted.
    """

    positions: Array
    certain: NDArray[np.bool_]


def view_keypoints(
    camera: Camera,
    bodies: Sequence[Body],
    view: View,
    locators: Mapping[int, KeypointLocator],
    positions: Mapping[int, Array],
    objects: Collection[int] = (),
) -> dict[int, KeypointView]:
    """Compute visibility and occluders of the keypoints of all humans, by instance label.

    Keypoints inside the body follow the rule of :func:`~humansim_ros.truth.view_joints`. A keypoint on the
    skin is visible where a vertex would be, by :func:`~humansim_ros.truth.visible_vertices`; skin that faces
    away from the camera is occluded by the person.

    Args:
        camera: Camera of the view.
        bodies: All bodies at the stamp.
        view: View with the channels depth, instance and part.
        locators: Locators of one set by instance label.
        positions: Keypoints (K, 3) in ``map``, metres, by instance label.
        objects: Instance labels of objects.
    """
    on_skin = {label: locator.on_surface for label, locator in locators.items()}
    points = [positions[label][mask] for label, mask in on_skin.items()]
    seen = visible_points(camera, bodies, np.concatenate([np.zeros((0, 3)), *points]), view)
    parts = np.split(seen, np.cumsum([len(part) for part in points]))[: len(points)]
    views = {}
    for (label, locator), skin_seen in zip(locators.items(), parts, strict=True):
        joints = view_joints(camera, positions[label], view, label, locator.surfaces, objects)
        values = {row.name: getattr(joints, row.name) for row in fields(JointView)}
        values |= _on_skin(joints, label, locator.on_surface, skin_seen)
        views[label] = KeypointView(**values, positions=positions[label], certain=locator.certain)
    return views


def _on_skin(
    view: JointView, label: int, mask: NDArray[np.bool_], seen: NDArray[np.bool_]
) -> dict[str, NDArray[np.generic]]:
    """Fields of a view in which the keypoints of ``mask`` (K,) are on the skin and ``seen``."""
    visible, occluder, by = view.visible.copy(), view.occluder.copy(), view.by.copy()
    inside = mask & (visible != OUTSIDE)
    visible[inside] = np.where(seen[inside[mask]], VISIBLE, OCCLUDED)
    occluder[inside & (visible == VISIBLE)], by[inside & (visible == VISIBLE)] = NOTHING, 0
    # nothing else is in front of it: it faces away, or hides behind a thin edge of the person
    turned = inside & (visible == OCCLUDED) & ((view.occluder == NOTHING) | ~(view.behind > 0))
    occluder[turned], by[turned] = SELF, label
    return {"visible": visible, "occluder": occluder, "by": by}
