"""What a camera can know of the joints: where they fall in the image and whether they can be seen."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera import Camera
from humansim_ros.humans.human import Human
from humansim_ros.render import View
from humansim_ros.types import Array

#: Visibility of a joint: outside the image (or behind the camera), hidden by something, or seen.
OUTSIDE, OCCLUDED, VISIBLE = 0, 1, 2
#: What hides an occluded joint: another part of the same person, another person, or an object or the room.
NOTHING, SELF, PERSON, THING = 0, 1, 2, 3


@dataclass(frozen=True)
class JointView:
    """Joints (J) as a camera sees them.

    ``optical``: (J, 3) in the optical frame, metres. ``pixels``: (J, 2), NaN behind the camera. ``visible``:
    (J,) uint8: OUTSIDE, OCCLUDED or VISIBLE. ``occluder``: (J,) uint8, what hides an occluded joint: SELF,
    PERSON or THING; else NOTHING. ``by``: (J,) uint16 instance label of the person or object that hides it
    (its own where that is itself), 0 where that has none. ``behind``: (J,) float32 metres along z from the
    first surface at the joint's pixel back to the joint; -inf where there is no surface, NaN outside the
    image.
    """

    optical: Array
    pixels: Array
    visible: NDArray[np.uint8]
    occluder: NDArray[np.uint8]
    by: NDArray[np.uint16]
    behind: NDArray[np.float32]


def view_joints(
    camera: Camera,
    positions: Array,
    view: View,
    instance: int,
    surfaces: NDArray[np.bool_],
    objects: Collection[int] = (),
) -> JointView:
    """Joints (J, 3) of the human labelled ``instance``, seen by a camera whose ``view`` has depth, instance
    and part labels. ``objects``: which labels are those of objects.

    Joints lie inside the body, so one counts as visible where the first surface at its pixel is skin around
    that joint: ``surfaces`` (J, 256) says which part labels those are (:func:`joint_surfaces`). So does one
    that nothing lies before: the end of a limb may lie beside the pixels of its skin.
    """
    assert view.depth is not None and view.instance is not None and view.part is not None
    optical = camera.to_optical(positions)
    pixels, depth = camera.project_optical(optical)
    inside, row, column = nearest_pixels(pixels, camera.size)
    with np.errstate(invalid="ignore"):  # joints that are nowhere
        behind = np.where(inside, depth - view.depth[row, column], np.nan)
    first = view.instance[row, column]
    near = surfaces[np.arange(len(positions)), view.part[row, column]]
    seen = ((first == instance) & near) | (behind <= 0)
    visible = np.where(inside, np.where(seen, VISIBLE, OCCLUDED), OUTSIDE)
    thing = np.isin(first, [0, *objects])
    hider = np.where(thing, THING, np.where(first == instance, SELF, PERSON))
    occluded = visible == OCCLUDED
    return JointView(
        optical,
        pixels,
        visible.astype(np.uint8),
        np.where(occluded, hider, NOTHING).astype(np.uint8),
        np.where(occluded, first, 0).astype(np.uint16),
        behind.astype(np.float32),
    )


def nearest_pixels(
    pixels: Array, size: tuple[int, int]
) -> tuple[NDArray[np.bool_], NDArray[np.intp], NDArray[np.intp]]:
    """Which of the points (N, 2) fall into an image of a size (width, height), and the row and column (N,) of
    the pixel whose centre is nearest; 0, 0 for those that do not.
    """
    inside = np.all((pixels > -0.5) & (pixels < np.array(size) - 0.5), axis=-1)  # false for NaN
    column, row = np.where(inside[:, None], np.rint(np.nan_to_num(pixels)), 0).astype(np.intp).T
    return inside, row, column


def joint_surfaces(human: Human) -> NDArray[np.bool_]:
    """(J, 256) which part labels are skin around each ground-truth joint: of the bones that meet there."""
    skeleton = human.skeleton
    with_surface = set((human.triangle_parts - 1).tolist())
    neighbours: list[set[int]] = []
    for joint, bone in enumerate(skeleton.joint_bones):
        is_end = joint >= len(skeleton)
        meeting = {bone} if is_end else {bone, *_siblings(skeleton.parents, skeleton.heads, bone)}
        if not is_end and skeleton.parents[bone] >= 0:
            meeting.add(int(skeleton.parents[bone]))
        if skeleton.parents[bone] < 0:
            meeting |= set(np.flatnonzero(skeleton.parents == bone).tolist())
        # a connector bone has no skin: what it connects meets here instead
        for bare in meeting - with_surface:
            meeting |= {int(skeleton.parents[bare]), *np.flatnonzero(skeleton.parents == bare).tolist()}
        neighbours.append(meeting - {-1})
    table = np.zeros((len(neighbours), 256), dtype=bool)
    for joint, bones in enumerate(neighbours):
        table[joint, [bone + 1 for bone in bones]] = True
    return table


def _siblings(parents: NDArray[np.intp], heads: Array, bone: int) -> list[int]:
    same = (parents == parents[bone]) & (np.linalg.norm(heads - heads[bone], axis=1) < 1e-6)
    return [int(b) for b in np.flatnonzero(same)]
