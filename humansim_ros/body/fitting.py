"""A mesh of a standing person put into body space, and a skeleton for it: the general one (thesis S1, S2,
chapter 4), or one of its own.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from humansim_ros.body.known import known_joints
from humansim_ros.body.landmarks import joint_places, measure
from humansim_ros.body.orientation import body_from_file, check_one_person, surface_samples, used_vertices
from humansim_ros.body.skeleton import Skeleton, hanim_skeleton
from humansim_ros.errors import MeshError
from humansim_ros.mesh.mesh import Mesh
from humansim_ros.types import Array

#: Whose joints: found in the mesh, or the general skeleton's.
Joints = Literal["fitted", "general"]
#: Vertices of a mesh at most.
MAX_VERTICES = 2_000_000
#: Statures (metres) of people; a unit that gives another is wrong.
_STATURES = (0.3, 3.0)
#: The ankles' slice of a standing person, as fractions of the height.
_ANKLES = (0.03, 0.08)
#: A head this far (of the height) from the middle of the box says that the arms are not held alike.
_LOPSIDED = 0.01


def fit_skeleton(
    mesh: Mesh,
    joints: Joints = "fitted",
    *,
    up: str | None = None,
    facing: str | None = None,
    unit: float | None = None,
    stature: float | None = None,
) -> tuple[Mesh, Skeleton]:
    """The mesh in body space (metres, y up, facing +z, soles at height 0), and a skeleton that stands in it.

    The mesh must hold one person standing in a T or A pose; where it is, which way up, and its unit do not
    matter. ``up``, ``facing``: the file's axes (``z``, ``-y``), found if absent. ``unit``: metres per unit of
    the file; ``stature``: metres; if both are absent the person is as tall as the general skeleton.

    ``joints``: ``fitted`` puts them where the mesh has them: in MakeHuman's bodies by their vertices, else by
    what the surface shows (:mod:`humansim_ros.body.landmarks`). ``general`` is the thesis way: the general
    skeleton as it is, scaled to the stature. Raises MeshError, which says what to do, if no such person can
    be seen in the mesh.
    """
    general = hanim_skeleton()
    usual = float(general.tails[:, 1].max())
    if len(mesh.vertices) > MAX_VERTICES:
        raise MeshError(
            f"{len(mesh.vertices):,} vertices; at most {MAX_VERTICES:,} are rigged: simplify the mesh first"
        )
    known = known_joints(mesh) if joints == "fitted" else None
    if known is not None and up is None and facing is None:
        turn = _turn_of_joints(known)
    else:
        turn = body_from_file(mesh, up, facing)
        check_one_person(surface_samples(mesh) @ turn.T)
    points = used_vertices(mesh) @ turn.T
    low, height = float(points[:, 1].min()), float(np.ptp(points[:, 1]))
    if not height > 0:
        raise MeshError("the mesh has no height")
    size = _stature(height, unit, stature) or usual
    ankle = float(general.heads[[general.bone("l_ankle"), general.bone("r_ankle")], 2].mean()) * size / usual
    origin = np.array([_middle(points, low, height), low, _ankles(points, low, height)])
    to_body = size / height

    def placed(point: Array) -> Array:
        return np.asarray((point @ turn.T - origin) * to_body + [0.0, 0.0, ankle])

    fitted = replace(mesh, vertices=placed(mesh.vertices))
    if joints == "general":
        scale = size / usual
        return fitted, replace(general, heads=scale * general.heads, tails=scale * general.tails)
    if known is not None:
        return fitted, skeleton_at({name: placed(joint) for name, joint in known.items()})
    found = joint_places(measure(replace(mesh, vertices=fitted.vertices / size)))
    return fitted, skeleton_at({name: size * joint for name, joint in found.items()})


def fit_to_skeleton(mesh: Mesh, skeleton: Skeleton, up: str | None = None, facing: str | None = None) -> Mesh:
    """The mesh in body space, as tall as the skeleton, soles at height 0, its ankles at the skeleton's (S1).

    Raises MeshError as :func:`fit_skeleton` does.
    """
    tall = float(skeleton.tails[:, 1].max())
    fitted, general = fit_skeleton(mesh, "general", up=up, facing=facing)
    scale = tall / float(general.tails[:, 1].max())
    ankles, own = (s.heads[[s.bone("l_ankle"), s.bone("r_ankle")], 2].mean() for s in (skeleton, general))
    return replace(mesh, vertices=scale * fitted.vertices + [0.0, 0.0, ankles - scale * own])


def skeleton_at(joints: dict[str, Array]) -> Skeleton:
    """The bones of the general skeleton between joints (3,), named by the bone whose head they are, and
    ``<bone>_end`` of the leaves.
    """
    general = hanim_skeleton()
    first_child: dict[int, int] = {}
    for bone, parent in enumerate(general.parents):
        first_child.setdefault(int(parent), bone)
    # bones that only connect begin where their parent ends
    begins = {"HumanoidRoot": "sacroiliac", "vl5": "vt3"}
    heads = np.array(
        [
            joints[name if "_to_" not in name else begins[general.names[general.parents[bone]]]]
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


def _turn_of_joints(joints: dict[str, Array]) -> Array:
    """Rotation (3, 3), made of axis swaps, to y up, facing +z, of a body whose joints are known."""
    upward = _nearest_axis(joints["vt3"] - joints["HumanoidRoot"])
    left = _nearest_axis((joints["l_hip"] - joints["r_hip"]) * (1 - np.abs(upward)))
    return np.stack([left, upward, np.cross(left, upward)])


def _nearest_axis(direction: Array) -> Array:
    axis = int(np.argmax(np.abs(direction)))
    return np.eye(3)[axis] * (1.0 if direction[axis] > 0 else -1.0)


def _stature(height: float, unit: float | None, stature: float | None) -> float | None:
    """Metres that the person shall be tall; None if nobody says."""
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
    """x of the plane that parts left from right: of the box, or the head's if the arms are not held alike."""
    box = float(points[:, 0].min() + points[:, 0].max()) / 2
    head = points[points[:, 1] > low + 0.9 * height, 0]
    own = float(head.min() + head.max()) / 2
    return own if abs(own - box) > _LOPSIDED * height else box


def _ankles(points: Array, low: float, height: float) -> float:
    """z of the ankles."""
    share = (points[:, 1] - low) / height
    ankles = points[(share >= _ANKLES[0]) & (share <= _ANKLES[1]), 2]
    if not len(ankles):
        raise MeshError("no feet at the lower end: the mesh is no person standing upright")
    return float(ankles.mean())
