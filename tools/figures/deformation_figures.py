"""Measure deformations by skinning: volume at joints, flipped triangles, stretched edges, as Markdown tables.

    python tools/figures/deformation_figures.py [HUMAN ...] [--motions walk sit_stand wave]

Without HUMAN, all built-in humans are measured. docs/skinning.md defines the figures.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from humansim_ros.files.mesh.normals import SurfaceNormals
from humansim_ros.motion.body.skinning import SKINNERS, make_skinner, skin
from humansim_ros.motion.files.bvh import read_bvh
from humansim_ros.motion.pose.retarget import Retargeter
from humansim_ros.motion.pose.world_motion import to_world
from humansim_ros.people.humans.human import Human
from humansim_ros.people.loading.loading import load_human
from humansim_ros.types import Array

ROOT = Path(__file__).resolve().parents[2]
MOTIONS = ("walk", "sit_stand", "wave")
#: Columns of the table of volumes: bone that turns, body axis (x left, y up, z front) or "along", degrees.
BENDS = {
    "elbow 90": ("l_elbow", "y", -90.0),
    "elbow 120": ("l_elbow", "y", -120.0),
    "knee 90": ("l_knee", "x", 90.0),
    "knee 120": ("l_knee", "x", 120.0),
    "forearm twisted 90": ("l_elbow", "along", 90.0),
}


def bent(human: Human, bone: str, axis: str, degrees: float) -> Array:
    """Rest-to-posed transforms (B, 4, 4) with one bone turned about an axis of the body, or about itself."""
    skeleton = human.skeleton
    index = skeleton.bone(bone)
    own = Rotation.from_matrix(skeleton.rest[index, :3, :3])
    if axis == "along":
        turn = Rotation.from_euler("y", degrees, degrees=True)
    else:
        turn = own.inv() * Rotation.from_euler(axis, degrees, degrees=True) * own
    rotations = np.tile([0.0, 0, 0, 1], (len(skeleton), 1))
    rotations[index] = turn.as_quat()
    return skeleton.pose(rotations) @ skeleton.rest_inverse


def joint_region(human: Human, bone: str, reach: float = 0.6) -> NDArray[np.int32]:
    """Closed surface (N, 3) around a joint: the limb at rest, from ``reach`` of the bone before the joint to
    ``reach`` of the bone after it, as fractions of their lengths.

    If there are several pieces, it is the largest one. Each end is closed by a fan of triangles about one
    vertex of its rim, so that no vertex is added.
    """
    skeleton, vertices, triangles = human.skeleton, human.mesh.vertices, human.mesh.triangles
    index = skeleton.bone(bone)
    parent = int(skeleton.parents[index])
    own = np.asarray(human.weights[:, [parent, index]].sum(axis=1)).ravel() > 0.5
    for each, low, high in ((parent, 1 - reach, np.inf), (index, -np.inf, reach)):
        along = (vertices - skeleton.heads[each]) @ (skeleton.tails[each] - skeleton.heads[each])
        share = along / skeleton.lengths[each] ** 2
        own &= (share > low) & (share < high)
    chosen = triangles[own[triangles].all(axis=1)]
    edges = chosen[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    graph = csr_matrix((np.ones(len(edges)), edges.T), shape=(len(vertices),) * 2)
    piece = connected_components(graph, directed=False)[1][chosen[:, 0]]
    chosen = chosen[piece == np.bincount(piece).argmax()]
    return np.concatenate([chosen, _lids(chosen)]).astype(np.int32)


def _lids(triangles: NDArray[np.int32]) -> NDArray[np.int32]:
    """Triangle fans (N, 3) that close the holes of a surface."""
    edges = {(int(a), int(b)) for t in triangles for a, b in ((t[0], t[1]), (t[1], t[2]), (t[2], t[0]))}
    rims = [edge for edge in edges if edge[::-1] not in edges]
    numbers = sorted({v for edge in rims for v in edge})
    place = {v: i for i, v in enumerate(numbers)}
    rows, columns = np.array([[place[a], place[b]] for a, b in rims]).T
    graph = csr_matrix((np.ones(len(rims)), (rows, columns)), shape=(len(numbers),) * 2)
    loop = connected_components(graph, directed=False)[1]
    middle = {int(number): numbers[int(np.argmax(loop == number))] for number in np.unique(loop)}
    lids = [(b, a, middle[int(loop[place[a]])]) for a, b in rims]
    return np.array([lid for lid in lids if len(set(lid)) == 3], dtype=np.int32)


def volume(vertices: Array, surface: NDArray[np.int32]) -> float:
    """Volume of a closed surface (N, 3), cubic metres. Self-intersections count twice."""
    a, b, c = (vertices[surface[:, i]] - vertices.mean(axis=0) for i in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def volume_change(human: Human, bone: str, axis: str, degrees: float, method: str) -> float:
    """Relative change of the volume at a joint when a bone turns."""
    region, rest = joint_region(human, bone), human.mesh.vertices
    posed = skin(rest, human.weights, bent(human, bone, axis, degrees), method)
    return volume(posed, region) / volume(rest, region) - 1


@dataclass(frozen=True)
class Deformation:
    """Deformation of a surface in a motion of F frames.

    ``flipped``: (F,) fraction of triangles that face away from their normal at rest, rotated with the bone of
    largest weight at their corners. ``stretch``: (F, E) edge lengths divided by those at rest.
    ``normals_off``: (F, V) angles in degrees between carried normals and normals of the surface. ``edges``:
    (E, 2) vertices. ``lengths``: (E,) lengths at rest, metres.
    """

    flipped: Array
    stretch: NDArray[np.float32]
    normals_off: NDArray[np.float32]
    edges: NDArray[np.int32]
    lengths: Array


def deformation(human: Human, transforms: Array, method: str) -> Deformation:
    """Measure the deformation by rest-to-posed transforms (F, B, 4, 4).

    Triangles without area and edges without length at rest are ignored.
    """
    rest, triangles = human.mesh.vertices, human.mesh.triangles
    skinner = make_skinner(method, rest, human.weights, np.float64)
    edges = np.unique(np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    lengths = np.linalg.norm(rest[edges[:, 0]] - rest[edges[:, 1]], axis=1)
    edges, lengths = edges[lengths > 1e-9], lengths[lengths > 1e-9]
    before = _areas(rest, triangles)
    solid = np.linalg.norm(before, axis=1) > 1e-14
    bones = human.triangle_parts[solid] - 1
    normals = SurfaceNormals(triangles, len(rest))
    at_rest = normals(rest)
    flipped, stretch, off = [], [], []
    for one in transforms:
        posed = skinner(one)
        carried = np.einsum("nij,nj->ni", one[bones, :3, :3], before[solid])
        facing = np.einsum("ni,ni->n", carried, _areas(posed, triangles[solid]))
        flipped.append((facing < 0).mean())
        stretch.append(np.linalg.norm(posed[edges[:, 0]] - posed[edges[:, 1]], axis=1) / lengths)
        cosine = np.einsum("vi,vi->v", skinner.directions(one, at_rest), normals(posed))
        off.append(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    return Deformation(
        np.array(flipped), np.array(stretch, np.float32), np.array(off, np.float32), edges, lengths
    )


def _areas(vertices: Array, triangles: NDArray[np.int32]) -> Array:
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    return np.asarray(np.cross(b - a, c - a))


def motion_transforms(human: Human, path: Path, rate: float = 10.0) -> Array:
    """Rest-to-posed transforms (F, B, 4, 4) of a motion, with about ``rate`` frames per second."""
    world = to_world(read_bvh(path))
    times = world.frame_times
    some = times[:: max(1, round(1 / (rate * (times[1] - times[0]))))]
    return Retargeter.fit(world, human.skeleton).pose(world.sample(some)) @ human.skeleton.rest_inverse


def table(heads: Sequence[str], rows: Sequence[Mapping[str, str] | Sequence[str]]) -> None:
    print("| " + " | ".join(heads) + " |")
    print("|" + "---|" * len(heads))
    for row in rows:
        print("| " + " | ".join(row) + " |")
    print()


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("humans", nargs="*", type=Path)
    parser.add_argument("--motions", nargs="+", default=MOTIONS)
    options = parser.parse_args()
    paths = options.humans or sorted((ROOT / "assets" / "humans").glob("*.npz"))
    humans = {path.stem: load_human(path) for path in paths}
    print("Change of volume, linear / dual quaternion:\n")
    rows = []
    for name, human in humans.items():
        if not {bend[0] for bend in BENDS.values()} <= set(human.skeleton.names):
            rows.append([name, *("no such bone" for _ in BENDS)])
            continue
        if not human.mesh.closed:
            rows.append([name, *("an open surface" for _ in BENDS)])
            continue
        changes = ([volume_change(human, *bend, method) for method in SKINNERS] for bend in BENDS.values())
        rows.append([name, *(" / ".join(f"{100 * c:+.1f} %" for c in pair) for pair in changes)])
    table(("human", *BENDS), rows)
    heads = (
        "human",
        "motion",
        "skinning",
        "flipped, mean / worst frame",
        "stretch 99.9 % / largest",
        "edges over 4",
        "longest of these, mm",
        "carried normals off, median / mean / 95 %",
    )
    rows = []
    for name, human in humans.items():
        for motion in options.motions:
            transforms = motion_transforms(human, ROOT / "assets" / "motions" / f"{motion}.bvh")
            for method in SKINNERS:
                found = deformation(human, transforms, method)
                largest, off = found.stretch.max(axis=0), found.normals_off
                over = largest > 4
                rows.append(
                    [
                        name,
                        motion,
                        method.replace("_", " "),
                        f"{100 * found.flipped.mean():.2f} / {100 * found.flipped.max():.2f} %",
                        f"{np.percentile(found.stretch, 99.9):.2f} / {largest.max():.2f}",
                        f"{over.sum()} of {len(over)}",
                        f"{1e3 * found.lengths[over].max():.1f}" if over.any() else "-",
                        f"{np.median(off):.1f} / {off.mean():.1f} / {np.percentile(off, 95):.0f}°",
                    ]
                )
    table(heads, rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
