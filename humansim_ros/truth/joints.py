"""Joints in an image: projection, visibility and occluders."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera import Camera
from humansim_ros.render import View
from humansim_ros.types import Array

#: Visibility of a joint: outside the image (or behind the camera), occluded, or visible.
OUTSIDE, OCCLUDED, VISIBLE = 0, 1, 2
#: Occluder of a joint: none, another part of the same person, another person, an object or the room.
NOTHING, SELF, PERSON, THING = 0, 1, 2, 3


@dataclass(frozen=True, repr=False)
class JointView:
    """Joints (J) of a human in the view of a camera.

    Attributes:
        optical: Positions (J, 3) in the optical frame, metres.
        pixels: Projections (J, 2); NaN behind the camera and outside the field of view of the lens.
        visible: OUTSIDE, OCCLUDED or VISIBLE, (J,).
        occluder: SELF, PERSON or THING of an occluded joint, else NOTHING, (J,).
        by: Instance label of the occluder (J,), the human's own for SELF; 0 without label or occluder.
        behind: Metres along z from the first surface at the joint's pixel to the joint, (J,); -inf without
            surface, NaN outside the image.
    """

    optical: Array
    pixels: Array
    visible: NDArray[np.uint8]
    occluder: NDArray[np.uint8]
    by: NDArray[np.uint16]
    behind: NDArray[np.float32]

    def __repr__(self) -> str:
        counts = [int((self.visible == state).sum()) for state in (VISIBLE, OCCLUDED, OUTSIDE)]
        return type(self).__name__ + "({} visible, {} occluded, {} outside)".format(*counts)


def view_joints(
    camera: Camera,
    positions: Array,
    view: View,
    instance: int,
    surfaces: NDArray[np.bool_],
    objects: Collection[int] = (),
) -> JointView:
    """Compute visibility and occluders of the joints of a human.

    A joint lies inside the body. It is visible if the first surface at its pixel is skin around that joint,
    or if no surface is in front of it: the end of a limb may project beside the pixels of its skin.

    Args:
        camera: Camera of the view.
        positions: Joints (J, 3) in ``map``, metres.
        view: View with the channels depth, instance and part.
        instance: Instance label of the human.
        surfaces: Part labels (J, 256) that are skin around each joint, from
            :func:`~humansim_ros.humans.human.joint_surfaces`.
        objects: Instance labels of objects.
    """
    optical = camera.to_optical(positions)
    pixels, depth = camera.project_optical(optical)
    inside, row, column = nearest_pixels(pixels, camera.size)
    with np.errstate(invalid="ignore"):  # joints that are not finite
        behind = np.where(inside, depth - view.depth[row, column], np.nan)
    first = view.instance[row, column]
    own_skin = surfaces[np.arange(len(positions)), view.part[row, column]]
    seen = ((first == instance) & own_skin) | (behind <= 0)
    visible = np.where(inside, np.where(seen, VISIBLE, OCCLUDED), OUTSIDE)
    is_thing = np.isin(first, [0, *objects])
    occluder = np.where(is_thing, THING, np.where(first == instance, SELF, PERSON))
    occluded = visible == OCCLUDED
    return JointView(
        optical,
        pixels,
        visible.astype(np.uint8),
        np.where(occluded, occluder, NOTHING).astype(np.uint8),
        np.where(occluded, first, 0).astype(np.uint16),
        behind.astype(np.float32),
    )


def nearest_pixels(
    pixels: Array, size: tuple[int, int]
) -> tuple[NDArray[np.bool_], NDArray[np.intp], NDArray[np.intp]]:
    """Find the nearest pixels of points (N, 2) in an image of a size (width, height).

    Returns:
        Mask (N,) of the points inside the image, and row and column (N,) of their pixels; 0, 0 outside.
    """
    inside = np.all((pixels > -0.5) & (pixels < np.array(size) - 0.5), axis=-1)  # false for NaN
    column, row = np.where(inside[:, None], np.rint(np.nan_to_num(pixels)), 0).astype(np.intp).T
    return inside, row, column
