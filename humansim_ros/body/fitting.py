"""Fit a mesh of a standing person into body space, and a skeleton to the mesh [thesis §4]."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from humansim_ros.body.known import known_joints
from humansim_ros.body.landmarks import joint_positions, measure
from humansim_ros.body.orientation import body_from_file, check_one_person, surface_samples, used_vertices
from humansim_ros.body.skeleton import Skeleton, hanim_skeleton
from humansim_ros.errors import MeshError
from humansim_ros.mesh.mesh import Mesh
from humansim_ros.types import Array

#: Joints detected in the mesh, or those of the general skeleton.
JointMethod = Literal["fitted", "general"]
MAX_VERTICES = 2_000_000
#: Valid statures, metres.
_STATURES = (0.3, 3.0)
#: Heights of the slice at the ankles, as shares of the body height.
_ANKLES = (0.03, 0.08)
#: Distance of the head from the middle of the bounding box, as a share of the height, if the arms are
#: not symmetric.
_ASYMMETRY = 0.01


def fit_skeleton(
    mesh: Mesh,
    joints: JointMethod = "fitted",
    *,
    up: str | None = None,
    facing: str | None = None,
    unit: float | None = None,
    stature: float | None = None,
) -> tuple[Mesh, Skeleton]:
    """Move a mesh into body space (metres, y up, facing +z, soles at height 0), and fit a skeleton to it.

    The mesh must be one person, standing in a T or A pose. Position, orientation and unit may be any.

    Args:
        mesh: Mesh of a person.
        joints: ``fitted`` detects the joints: by vertex for MakeHuman bodies, else from the surface
            (:mod:`humansim_ros.body.landmarks`). ``general`` scales the general skeleton to the stature
            [thesis §4].
        up: Up axis of the file, such as ``z`` or ``-y``; detected if absent.
        facing: Axis of the file that the person faces; detected if absent.
        unit: Metres per unit of the file.
        stature: Height of the person in metres. Without unit and stature it is that of the general skeleton.

    Returns:
        The mesh in body space, and its skeleton.

    Raises:
        MeshError: No such person can be detected in the mesh; the message says what to do.
    """
    general = hanim_skeleton()
    default = float(general.tails[:, 1].max())
    if len(mesh.vertices) > MAX_VERTICES:
        raise MeshError(
            f"{len(mesh.vertices):,} vertices; at most {MAX_VERTICES:,} are rigged: simplify the mesh first"
        )
    known = known_joints(mesh) if joints == "fitted" else None
    if known is not None and up is None and facing is None:
        rotation = _rotation_of_joints(known)
    else:
        rotation = body_from_file(mesh, up, facing)
        check_one_person(surface_samples(mesh) @ rotation.T)
    points = used_vertices(mesh) @ rotation.T
    low, height = float(points[:, 1].min()), float(np.ptp(points[:, 1]))
    if not height > 0:
        raise MeshError("the mesh has no height")
    size = _stature(height, unit, stature) or default
    ankle = (
        float(general.heads[[general.bone("l_ankle"), general.bone("r_ankle")], 2].mean()) * size / default
    )
    origin = np.array([_middle(points, low, height), low, _ankles(points, low, height)])
    scale_to_body = size / height

    def to_body_space(point: Array) -> Array:
        return np.asarray((point @ rotation.T - origin) * scale_to_body + [0.0, 0.0, ankle])

    fitted = replace(mesh, vertices=to_body_space(mesh.vertices))
    if joints == "general":
        scale = size / default
        return fitted, replace(general, heads=scale * general.heads, tails=scale * general.tails)
    if known is not None:
        return fitted, skeleton_at({name: to_body_space(joint) for name, joint in known.items()})
    positions = joint_positions(measure(replace(mesh, vertices=fitted.vertices / size)))
    return fitted, skeleton_at({name: size * joint for name, joint in positions.items()})


def fit_to_skeleton(mesh: Mesh, skeleton: Skeleton, up: str | None = None, facing: str | None = None) -> Mesh:
    """Move a mesh into body space, with the height and the ankles of a skeleton [thesis S1].

    Args:
        mesh: Mesh of a standing person.
        skeleton: Skeleton in body space.
        up: Up axis of the file; detected if absent.
        facing: Axis of the file that the person faces; detected if absent.

    Raises:
        MeshError: No standing person can be detected in the mesh.
    """
    height = float(skeleton.tails[:, 1].max())
    fitted, general = fit_skeleton(mesh, "general", up=up, facing=facing)
    scale = height / float(general.tails[:, 1].max())
    ankles, own = (s.heads[[s.bone("l_ankle"), s.bone("r_ankle")], 2].mean() for s in (skeleton, general))
    return replace(mesh, vertices=scale * fitted.vertices + [0.0, 0.0, ankles - scale * own])


def skeleton_at(joints: dict[str, Array]) -> Skeleton:
    """Create the bones of the general skeleton between joints (3,).

    Keys are the bone whose head the joint is, and ``<bone>_end`` for leaves.
    """
    general = hanim_skeleton()
    first_child: dict[int, int] = {}
    for bone, parent in enumerate(general.parents):
        first_child.setdefault(int(parent), bone)
    # connecting bones start at the tail of their parent
    starts = {"HumanoidRoot": "sacroiliac", "vl5": "vt3"}
    heads = np.array(
        [
            joints[name if "_to_" not in name else starts[general.names[general.parents[bone]]]]
            for bone, name in enumerate(general.names)
        ]
    )
    tails = np.array(
        [
            heads[first_child[bone]] if bone in first_child else joints[f"{name}_end"]
            for bone, name in enumerate(general.names)
        ]
    )
    return replace(general, heads=heads, tails=tails)


def _rotation_of_joints(joints: dict[str, Array]) -> Array:
    """Rotation (3, 3), a permutation of axes, to y up, facing +z, from the joints of a body."""
    upward = _nearest_axis(joints["vt3"] - joints["HumanoidRoot"])
    left = _nearest_axis((joints["l_hip"] - joints["r_hip"]) * (1 - np.abs(upward)))
    return np.stack([left, upward, np.cross(left, upward)])


def _nearest_axis(direction: Array) -> Array:
    axis = int(np.argmax(np.abs(direction)))
    return np.eye(3)[axis] * (1.0 if direction[axis] > 0 else -1.0)


def _stature(height: float, unit: float | None, stature: float | None) -> float | None:
    """Stature in metres from the options; None without options."""
    if unit is not None and stature is not None:
        raise MeshError("give unit or stature, not both")
    size = stature if unit is None else unit * height
    if size is not None and not _STATURES[0] <= size <= _STATURES[1]:
        raise MeshError(
            f"a person would be {size:.4g} m tall: 'unit' is metres per unit of the file, "
            f"in which the mesh is {height:.4g} tall"
        )
    return size


def _middle(points: Array, low: float, height: float) -> float:
    """x of the symmetry plane: middle of the bounding box, or of the head if the arms are not symmetric."""
    box = float(points[:, 0].min() + points[:, 0].max()) / 2
    head = points[points[:, 1] > low + 0.9 * height, 0]
    of_head = float(head.min() + head.max()) / 2
    return of_head if abs(of_head - box) > _ASYMMETRY * height else box


def _ankles(points: Array, low: float, height: float) -> float:
    """z of the ankles."""
    share = (points[:, 1] - low) / height
    ankles = points[(share >= _ANKLES[0]) & (share <= _ANKLES[1]), 2]
    if not len(ankles):
        raise MeshError("no feet at the lower end: the mesh is not a person standing upright")
    return float(ankles.mean())
