"""Fit a mesh of a standing person into body space, and rig it: skeleton [thesis §4] and weights [thesis §5].

The up axis and the facing direction of the mesh are detected from its shape.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from humansim_ros.errors import MeshError
from humansim_ros.files.mesh import Mesh
from humansim_ros.geometry import angle_between, nearest_axis
from humansim_ros.motion.body import Skeleton, hanim_skeleton, side_of
from humansim_ros.people.rigging.heat_weights import heat_weights
from humansim_ros.people.rigging.landmarks import joint_positions, known_joints, measure
from humansim_ros.types import Array

#: Number of samples of a surface. Their mean distance is 1 % of a person's height.
_SAMPLES = 12_000
#: The mirror error of every other axis is larger than that of the left-right axis by at least this factor.
_SYMMETRY = 1.6
#: Least ratio of height to depth of a standing person.
_SLENDER = 1.4
#: Ranges of heights of body parts as shares of the body height: head and feet; shins; soles; top of the head.
_END, _SHINS, _FEET, _CROWN = 0.12, (0.08, 0.16), 0.05, 0.06
#: A part is far from the body if the gap between them exceeds this share of the body's size.
_FAR_PART = 0.15
_POSE = "a mesh must hold one person, standing in a T or A pose"
_AXES = {"x": 0, "y": 1, "z": 2}


def body_from_file(mesh: Mesh, up: str | None = None, facing: str | None = None) -> Array:
    """Rotation (3, 3), a permutation of axes, from the space of the mesh to y up, facing +z, x to the left.

    ``up``, ``facing``: axes of the file, such as ``z`` or ``-y``. Missing axes are detected. The person must
    be symmetric left-right and taller than deep, with the head over the middle, the feet on both sides of the
    middle, and the toes in front of the shins. If the detection fails, MeshError says what to do.
    """
    upward, forward = _axis(up, "up"), _axis(facing, "facing")
    if upward is not None and forward is not None:
        if abs(upward @ forward) > 0:
            raise MeshError(f"up {up!r} and facing {facing!r} are the same axis: give two different ones")
        return np.stack([np.cross(upward, forward), upward, forward])
    points = surface_samples(mesh)
    extent = np.ptp(points, axis=0)
    if extent.min() <= 1e-6 * extent.max():
        raise MeshError("the mesh is flat, not a person")
    points = (points - (points.min(0) + points.max(0)) / 2) / extent.max()
    side = _side(points, upward, forward)
    rest = [axis for axis in range(3) if axis != side]
    if upward is not None:
        tall = int(np.argmax(np.abs(upward)))
    elif forward is not None:
        tall = next(axis for axis in rest if forward[axis] == 0)
    else:
        tall = max(rest, key=lambda axis: extent[axis])
    deep = next(axis for axis in rest if axis != tall)
    if upward is None and forward is None and extent[tall] < _SLENDER * extent[deep]:
        raise MeshError(f"the mesh is as deep as it is tall: {_POSE}, or give the up and facing axes")
    if upward is None:
        upward = np.eye(3)[tall] * _up_sign(points[:, tall], points[:, side])
    if forward is None:
        forward = np.eye(3)[deep] * _forward_sign(points @ upward, points[:, deep])
    return np.stack([np.cross(upward, forward), upward, forward])


def check_one_person(points: Array) -> None:
    """Raise MeshError unless points (P, 3) in body space have one head, over the middle of the body."""
    height = float(np.ptp(points[:, 1]))
    crown = points[points[:, 1] > points[:, 1].max() - _CROWN * height]
    middle = (points[:, 0].min() + points[:, 0].max()) / 2
    aside = np.abs(crown[:, 0] - middle) / height
    gap = float(np.diff(np.sort(crown[:, 2])).max(initial=0.0)) / height
    if np.quantile(aside, 0.2) > 0.06 or np.quantile(aside, 0.95) > 0.2 or gap > 0.05:
        raise MeshError(f"the mesh has no single head over its middle: {_POSE}")


def check_parts(mesh: Mesh) -> None:
    """Raise MeshError, with place and size, if a part is far from the body."""
    samples, vertices = surface_samples(mesh), used_vertices(mesh)
    points = np.concatenate([samples, vertices])
    size = float(np.ptp(points, axis=0).max())
    for _ in range(3):  # a far part makes the whole larger than the body
        cells = np.floor((points - points.min(axis=0)) / (0.5 * _FAR_PART * size)).astype(np.int64)
        occupied, cell_of = np.unique(cells, axis=0, return_inverse=True)
        neighbours = scipy.spatial.cKDTree(occupied).query_pairs(1.8, output_type="ndarray")
        graph = scipy.sparse.coo_matrix((np.ones(len(neighbours)), neighbours.T), (len(occupied),) * 2)
        count, cluster_of = scipy.sparse.csgraph.connected_components(graph, directed=False)
        cluster = cluster_of[cell_of.reshape(-1)]
        body = np.bincount(cluster[: len(samples)]).argmax()
        if count == 1:
            return
        size = float(np.ptp(points[cluster == body], axis=0).max())
    gaps = np.full(count, np.inf)
    np.minimum.at(gaps, cluster, scipy.spatial.cKDTree(points[cluster == body]).query(points)[0])
    far = int(gaps.argmax())
    if gaps[far] < _FAR_PART * size:
        return
    part = points[cluster == far]
    x, y, z = (part.min(axis=0) + part.max(axis=0)) / 2
    number = int((cluster[len(samples) :] == far).sum())
    raise MeshError(
        f"a part of {number} vertices around ({x:.3g}, {y:.3g}, {z:.3g}) is too far from every bone: "
        f"{gaps[far]:.3g} from the rest, {gaps[far] / size:.0%} of the body's size. Delete the part, or "
        f"move it to the body; {_POSE}"
    )


def surface_samples(mesh: Mesh) -> Array:
    """Deterministic, evenly spread samples (P, 3) of the surface. Raises MeshError if it has no area."""
    corners = mesh.vertices[mesh.triangles]
    size = float(np.abs(corners).max())
    if size == 0:
        raise MeshError("the mesh has no size")
    corners = corners / size
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    total = np.cumsum(area)
    if total[-1] <= 0:
        raise MeshError("the faces have no area: there is no surface to fit")
    step = np.arange(_SAMPLES)
    chosen = np.searchsorted(total, (step + 0.5) / _SAMPLES * total[-1])
    chosen = np.minimum(chosen, len(area) - 1)
    # R2 sequence [Roberts 2018]
    a, b = (0.5 + step * 0.7548776662466927) % 1, (0.5 + step * 0.5698402909980532) % 1
    over = a + b > 1
    a, b = np.where(over, 1 - a, a), np.where(over, 1 - b, b)
    first, second, third = (corners[chosen, k] for k in range(3))
    return np.asarray(size * (first + a[:, None] * (second - first) + b[:, None] * (third - first)))


def _axis(name: str | None, what: str) -> Array | None:
    """Unit vector (3,) of an axis such as ``-y``."""
    if name is None:
        return None
    letter = name.strip().lower().lstrip("+-")
    if letter not in _AXES or len(name.strip()) > 2:
        raise MeshError(f"{what} is one of x, y, z, -x, -y, -z, not {name[:20]!r}", key=what)
    return np.eye(3)[_AXES[letter]] * (-1.0 if name.strip().startswith("-") else 1.0)


def _side(points: Array, upward: Array | None, forward: Array | None) -> int:
    """Axis of the left-right symmetry of the points."""
    given = [axis for axis in (upward, forward) if axis is not None]
    free = [axis for axis in range(3) if all(vector[axis] == 0 for vector in given)]
    tree = scipy.spatial.cKDTree(points)
    errors = []
    for axis in free:
        mirrored = points[::4] * np.where(np.arange(3) == axis, -1.0, 1.0)
        errors.append(float(tree.query(mirrored)[0].mean()))
    order = np.argsort(errors)
    if len(free) > 1 and errors[order[1]] < _SYMMETRY * errors[order[0]]:
        raise MeshError(f"the axes of the body cannot be detected: {_POSE}, or give the up and facing axes")
    return free[int(order[0])]


def _up_sign(high: Array, side: Array) -> float:
    """1 if the head is at the large values of ``high``, else -1. The head is over the middle, feet are at
    both sides."""
    low, top = high.min(), high.max()
    reach = _END * (top - low)
    head, feet = np.abs(side[high > top - reach]), np.abs(side[high < low + reach])
    if not len(head) or not len(feet):
        raise MeshError(f"the mesh has no head or no feet: {_POSE}")
    unit = top - low
    apart = (feet.mean() - head.mean()) / (0.04 * unit)
    between = ((head < 0.02 * unit).mean() - (feet < 0.02 * unit).mean()) / 0.15
    if abs(apart + between) < 0.3:
        raise MeshError(f"head and feet cannot be distinguished: {_POSE}, or give the up axis")
    return 1.0 if apart + between > 0 else -1.0


def _forward_sign(high: Array, deep: Array) -> float:
    """1 if the toes are at the large values of ``deep``, else -1."""
    share = (high - high.min()) / np.ptp(high)
    feet, shins = deep[share < _FEET], deep[(share > _SHINS[0]) & (share < _SHINS[1])]
    if not len(feet) or not len(shins):
        raise MeshError(f"no feet at the lower end of the mesh: {_POSE}")
    ahead, behind = feet.max() - shins.mean(), shins.mean() - feet.min()
    if abs(ahead - behind) < 0.1 * abs(ahead + behind):
        raise MeshError("the facing direction cannot be detected from the toes: give the facing axis")
    return 1.0 if ahead > behind else -1.0


def used_vertices(mesh: Mesh) -> NDArray[np.float64]:
    """Vertices (U, 3) that faces use. Unused vertices must not count for the size."""
    used = np.zeros(len(mesh.vertices), dtype=bool)
    used[mesh.faces[mesh.faces >= 0]] = True
    return mesh.vertices[used]


#: ``fitted`` detects the joints in the mesh. ``general`` takes the joints of the general skeleton.
JointMethod = Literal["fitted", "general"]
MAX_VERTICES = 2_000_000
#: Valid statures, metres.
_STATURES = (0.3, 3.0)
#: Heights of the slice at the ankles, as shares of the body height.
_ANKLES = (0.03, 0.08)
#: If the distance of the head from the middle of the bounding box exceeds this share of the height, the arms
#: are not symmetric.
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
        joints: ``fitted`` detects the joints: from vertices for MakeHuman bodies, from the surface for other
            bodies (:mod:`humansim_ros.people.rigging.landmarks`). ``general`` scales the general skeleton to
            the stature [thesis §4].
        up: Up axis of the file, such as ``z`` or ``-y``. If None, it is detected.
        facing: Axis of the file that the person faces. If None, it is detected.
        unit: Metres per unit of the file.
        stature: Height of the person in metres. If unit and stature are None, that of the general skeleton.

    Returns:
        The mesh in body space, and its skeleton.

    Raises:
        MeshError: No such person can be detected in the mesh. The message says what to do.
    """
    general = hanim_skeleton()
    default = float(general.tails[:, 1].max())
    if len(mesh.vertices) > MAX_VERTICES:
        raise MeshError(
            f"{len(mesh.vertices):,} vertices; at most {MAX_VERTICES:,} are rigged: simplify the mesh first"
        )
    check_parts(mesh)
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
    ankles = general.heads[[general.bone("l_ankle"), general.bone("r_ankle")], 2]
    ankle = float(ankles.mean()) * size / default
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
        up: Up axis of the file. If None, it is detected.
        facing: Axis of the file that the person faces. If None, it is detected.

    Raises:
        MeshError: No standing person can be detected in the mesh.
    """
    height = float(skeleton.tails[:, 1].max())
    fitted, general = fit_skeleton(mesh, "general", up=up, facing=facing)
    scale = height / float(general.tails[:, 1].max())
    ankles, own = (s.heads[[s.bone("l_ankle"), s.bone("r_ankle")], 2].mean() for s in (skeleton, general))
    return replace(mesh, vertices=scale * fitted.vertices + [0.0, 0.0, ankles - scale * own])


def skeleton_at(joints: dict[str, Array]) -> Skeleton:
    """Create the bones of the general skeleton from its joints (3,). The key of a joint is the name of the
    bone that begins there, or ``<bone>_end`` for the end of a leaf."""
    general = hanim_skeleton()
    first_child: dict[int, int] = {}
    for bone, parent in enumerate(general.parents):
        first_child.setdefault(int(parent), bone)
    # connecting bones start at the tail of their parent
    starts = {"HumanoidRoot": "sacroiliac", "vl5": "vt3"}
    heads, tails = np.empty_like(general.heads), np.empty_like(general.tails)
    for bone, name in enumerate(general.names):
        heads[bone] = joints[name if "_to_" not in name else starts[general.names[general.parents[bone]]]]
    for bone, name in enumerate(general.names):
        tails[bone] = heads[first_child[bone]] if bone in first_child else joints[f"{name}_end"]
    return replace(general, heads=heads, tails=tails)


def joints_of(skeleton: Skeleton) -> dict[str, Array]:
    """Joints (3,) of a general skeleton. The key is the bone that begins there, or ``<bone>_end`` at a leaf.
    :func:`skeleton_at` is the inverse."""
    named = zip(skeleton.names, skeleton.heads, strict=True)
    heads = {name: head.copy() for name, head in named if "_to_" not in name}
    return heads | {f"{skeleton.names[bone]}_end": skeleton.tails[bone].copy() for bone in skeleton.ends}


def _rotation_of_joints(joints: dict[str, Array]) -> Array:
    """Rotation (3, 3), a permutation of axes, to y up, facing +z, from the joints of a body."""
    upward = nearest_axis(joints["vt3"] - joints["HumanoidRoot"])
    left = nearest_axis((joints["l_hip"] - joints["r_hip"]) * (1 - np.abs(upward)))
    return np.stack([left, upward, np.cross(left, upward)])


def _stature(height: float, unit: float | None, stature: float | None) -> float | None:
    """Stature in metres from the options; None if no option states it."""
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
    """x of the symmetry plane: middle of the bounding box. If the arms are not symmetric, middle of the
    head."""
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


RigRule = Literal["heat", "thesis", "thesis-printed"]
#: Vertices per block of dense matrices of angles.
_BLOCK = 16_384


def rig(mesh: Mesh, skeleton: Skeleton, rule: RigRule = "heat") -> csr_matrix:
    """Compute skinning weights (V, B) of a mesh in the rest pose of a skeleton. Rows sum to one.

    ``rule``:

    - ``heat``: smooth weights of at most four bones (:mod:`humansim_ros.people.rigging.heat_weights`).
    - ``thesis``: a vertex belongs to the bone with the largest angle head-vertex-tail. Bones of the other
      side of the body do not count. Near the head of the bone it is shared with the parent: the weight of the
      bone is ``min(1, 60 / angle)``, where ``angle`` is between (vertex - head) and (tail - head) in degrees.
    - ``thesis-printed``: the same with ``angle / 60``, as the pseudo-code of [thesis §5] has it. It is zero
      for vertices beyond the tail, so that finger tips would follow the forearm. Text and figures of the
      thesis contradict the pseudo-code ("the weight factor is decreased for vertices with larger angle").

    Raises:
        MeshError: The skeleton has no bone on a side of the mesh, or (for ``heat``) lacks bones of a human.

    Example:
        >>> from humansim_ros import load_human
        >>> from humansim_ros.files.reading.assets import resource_path
        >>> child = load_human(resource_path("assets/humans/child.npz"))
        >>> weights = rig(child.mesh, child.skeleton, "thesis")
        >>> weights.shape == (len(child.mesh.vertices), 57)
        True
    """
    general = np.flatnonzero(skeleton.wholes == np.arange(len(skeleton)))
    if len(general) < len(skeleton):
        weights = rig(mesh, skeleton.part(general), rule)
        return csr_matrix(
            (weights.data, general[weights.indices], weights.indptr), (len(mesh.vertices), len(skeleton))
        )
    if rule == "heat":
        return heat_weights(mesh, skeleton)
    blocks = [
        _by_angle(mesh.vertices[start : start + _BLOCK], skeleton, rule == "thesis-printed")
        for start in range(0, len(mesh.vertices), _BLOCK)
    ]
    best, weight = (np.concatenate(parts) for parts in zip(*blocks, strict=True))
    parent = skeleton.parents[best]
    weight = np.where(parent < 0, 1.0, weight)
    rows = np.arange(len(best))
    places = np.r_[rows, rows], np.r_[best, np.maximum(parent, 0)]
    weights = csr_matrix((np.r_[weight, 1.0 - weight], places), (len(best), len(skeleton)))
    weights.eliminate_zeros()
    return weights


def _by_angle(vertices: Array, skeleton: Skeleton, printed: bool) -> tuple[NDArray[np.intp], Array]:
    """Bone (V,) with the largest angle head-vertex-tail, and its weight (V,)."""
    to_head, to_tail = (ends[None] - vertices[:, None] for ends in (skeleton.heads, skeleton.tails))
    angles = angle_between(to_head, to_tail)
    sides = np.array([side_of(name) for name in skeleton.names])
    angles[sides[None, :] * np.sign(vertices[:, :1]) < 0] = -1.0
    best = np.argmax(angles, axis=1)
    if (angles[np.arange(len(vertices)), best] < 0).any():
        raise MeshError("the skeleton has no bone on one side of the mesh")
    head, tail = skeleton.heads[best], skeleton.tails[best]
    angle = np.degrees(angle_between(vertices - head, tail - head))
    return best, np.minimum(1.0, angle / 60.0 if printed else 60.0 / np.maximum(angle, 1e-9))
