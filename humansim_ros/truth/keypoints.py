"""Keypoints in an image: projection, visibility and occluders, by the rule of joints and of vertices."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera import Camera
from humansim_ros.keypoints import KeypointLocator
from humansim_ros.render import Body, View
from humansim_ros.truth.joints import NOTHING, OCCLUDED, OUTSIDE, SELF, VISIBLE, JointView, view_joints
from humansim_ros.truth.vertices import visible_points
from humansim_ros.types import Array


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
