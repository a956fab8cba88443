"""BVH text as programs write it: units, up axes, orders of channels, white space, wrong counts."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    from motion_files import StandIn

Array = NDArray[np.float64]

#: Up axis of a file -> rotation (3, 3) from the axes of the T pose (y up) to those of the file.
UP = {"y": np.eye(3), "z": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])}


@dataclass(frozen=True)
class FileStyle:
    """How a program writes its BVH files.

    Attributes:
        unit: Centimetres per unit of the file.
        up: Up axis, y or z.
        order: Rotation channels, outermost first.
        orders: Other rotation channels of some roles.
        rotation_first: The root has its rotation channels before its position channels.
        positions: Position channels of the root alone; of all joints, whose values replace OFFSETs; or of all
            joints, whose values are near 0 and are added to OFFSETs.
        root_offset: The root has its place at rest as OFFSET; else zero. Position channels replace it.
        prefix: Text before each joint name.
        number: Format of numbers in the hierarchy.
        newline: End of a line.
        separator: White space between words of the hierarchy, and after ``Frames:``.
        blank_lines: Empty lines between joints.
        end_sites: Leaf joints have end sites.
        frames: Added to the number of frames that the file says it has.
        frame_time: Format of the frame time.
    """

    unit: float = 1.0
    up: str = "y"
    order: str = "ZXY"
    orders: Mapping[str, str] = field(default_factory=dict)
    rotation_first: bool = False
    positions: str = "root"
    root_offset: bool = True
    prefix: str = ""
    number: str = "{:.8f}"
    newline: str = "\n"
    separator: str = " "
    blank_lines: bool = False
    end_sites: bool = True
    frames: int = 0
    frame_time: str = "{:.6f}"

    def points(self, points: Array) -> Array:
        """Points (..., 3) in centimetres and in the axes of the T pose, in the file."""
        return np.asarray(points @ UP[self.up].T / self.unit)


def bvh_text(
    person: StandIn,
    local: Array,
    root: Array,
    axes: Array,
    frame_time: float,
    style: FileStyle,
) -> str:
    """BVH text of a person.

    Args:
        person: The skeleton in T pose.
        local: (F, J, 3, 3) local rotations in the axes of the T pose.
        root: (F, 3) positions of the root, centimetres.
        axes: (J, 3, 3) axes of the joints in the T pose.
        frame_time: Seconds between frames.
        style: How it is written.
    """
    up = UP[style.up]
    axes = up @ axes @ up.T
    local = up @ local @ up.T
    columns, count = [], len(root)
    for joint, parent in enumerate(person.parents):
        above = np.eye(3) if parent < 0 else axes[parent]
        order = style.orders.get(person.roles[joint], style.order)
        turn = Rotation.from_matrix(above.T @ local[:, joint] @ axes[joint])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # at a pole one of the three angles is free
            angles = turn.as_euler(order, degrees=True)
        offset = style.points(person.offsets[joint]) @ above
        position = style.points(root) if parent < 0 else np.broadcast_to(offset, (count, 3))
        if style.positions == "added":
            position = position - (offset if parent >= 0 or style.root_offset else 0)
        columns.append(_in_order(style, parent < 0, position, angles))
    lines = ["HIERARCHY", *_hierarchy(person, 0, axes, 0, style), "MOTION"]
    space = "\t" if style.separator == "\t" else " "
    lines += [
        f"Frames:{space}{count + style.frames}",
        f"Frame Time:{space}{style.frame_time.format(frame_time)}",
    ]
    lines += [" ".join(f"{value:.8f}" for value in row) for row in np.hstack(columns)]
    return style.newline.join(lines) + style.newline


def _in_order(style: FileStyle, is_root: bool, position: Array, angles: Array) -> Array:
    if not is_root and style.positions == "root":
        return angles
    return np.hstack([angles, position] if style.rotation_first else [position, angles])


def _channels(style: FileStyle, is_root: bool, order: str) -> str:
    turns = [f"{axis}rotation" for axis in order]
    moves = [f"{axis}position" for axis in "XYZ"] if is_root or style.positions != "root" else []
    names = [*turns, *moves] if style.rotation_first else [*moves, *turns]
    return " ".join(["CHANNELS", str(len(names)), *names])


def _hierarchy(person: StandIn, joint: int, axes: Array, depth: int, style: FileStyle) -> list[str]:
    """Lines of a joint and all below it. ``axes``: of the joints in the T pose, in the axes of the file."""
    tab, is_root = "\t" * depth, depth == 0

    def offset(vector: Array, frame: Array) -> str:
        return style.separator.join(["OFFSET", *map(style.number.format, style.points(vector) @ frame)])

    parent = person.parents[joint]
    own = person.offsets[joint] * (style.root_offset or not is_root)
    lines = [f"{tab}{'ROOT' if is_root else 'JOINT'} {style.prefix}{person.names[joint]}", f"{tab}{{"]
    lines.append(f"{tab}\t{offset(own, np.eye(3) if is_root else axes[parent])}")
    order = style.orders.get(person.roles[joint], style.order)
    lines.append(f"{tab}\t{_channels(style, is_root, order)}")
    for child in person.children(joint):
        lines += [""] * style.blank_lines + _hierarchy(person, child, axes, depth + 1, style)
    if joint in person.ends and style.end_sites:
        end = offset(np.array(person.ends[joint]), axes[joint])
        lines += [f"{tab}\tEnd Site", f"{tab}\t{{", f"{tab}\t\t{end}", f"{tab}\t}}"]
    return [*lines, f"{tab}}}"]
