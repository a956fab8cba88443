#!/usr/bin/env python3
"""Write joint positions of BVH files from Blender, for the tests of `read_bvh`.

    python3.11 -m venv blender && blender/bin/pip install bpy==4.5.15
    blender/bin/python tools/blender/joint_positions.py DIR -o test/data/blender_fk.npz

Imports every BVH file with the importer of Blender, in the axes and units of the file. For some frames of
each file, the output has (`<stem>` is the file name without suffix)

    <stem>/frames           (F,) int32         rows of the MOTION section, from 0
    <stem>/names            (J,) str           joints, and end sites as `<joint>_end`
    <stem>/positions        (F, J, 3) float32  world positions; a position channel replaces the OFFSET
    <stem>/positions_added  (F, J, 3) float32  the same if position channels are added to the OFFSET
    <stem>/moved            (M,) str           joints that Blender moves at rest, see `moved_joints`
    <stem>/size             float              diagonal of the box around the skeleton at rest

Blender replaces the OFFSET by the position channels. Some files need the sum of both. `positions_added` is
written for files with position channels and an OFFSET other than 0: the location curves in Blender are moved
by the OFFSET. Hierarchy, rotations and positions come from Blender; this script does not evaluate any motion.
"""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np
from io_anim_bvh.import_bvh import read_bvh
from mathutils import Matrix, Vector

MAX_FRAMES = 12

# Blender makes shorter bones longer; their tail is then not the end site.
SHORTEST_BONE = 1e-3


def end_sites(path: Path) -> dict[str, Vector]:
    """OFFSETs of end sites by joint."""
    sites = {}
    joint = ""
    in_site = False
    for words in (line.split() for line in path.read_text().splitlines()):
        if not words:
            continue
        keyword = words[0].lower()
        if keyword == "motion":
            break
        if keyword in ("root", "joint"):
            joint = "_".join(words[1:])
        elif keyword == "end":
            in_site = True
        elif keyword == "offset" and in_site:
            sites[joint] = Vector(map(float, words[1:4]))
            in_site = False
    return sites


def import_bvh(path: Path) -> bpy.types.Object:
    """Import a file into a new scene, and return its armature."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.import_anim.bvh(
        filepath=str(path),
        target="ARMATURE",
        axis_forward="Y",
        axis_up="Z",
        global_scale=1.0,
        frame_start=1,
        use_fps_scale=False,
        rotate_mode="QUATERNION",
    )
    return bpy.context.object


def location_curves(armature: bpy.types.Object) -> Iterator[tuple[str, bpy.types.FCurve]]:
    """Name of the bone and curve of every animated location coordinate."""
    for curve in armature.animation_data.action.fcurves:
        if curve.data_path.endswith(".location"):
            yield curve.data_path.split('"')[1], curve


def add_offsets(armature: bpy.types.Object, offsets: dict[str, Vector]) -> None:
    """Add the OFFSETs to the positions. A position of 0 is minus the OFFSET in the location of a bone."""
    for name, curve in location_curves(armature):
        to_bone = armature.data.bones[name].matrix_local.to_3x3().inverted()
        shift = (to_bone @ offsets[name])[curve.array_index]
        for key in curve.keyframe_points:
            key.co.y += shift
        curve.update()


def moved_joints(armature: bpy.types.Object, heads: dict[str, Vector], sites: dict[str, Vector]) -> list[str]:
    """Joints and end sites whose rest position is not the sum of their OFFSETs.

    Blender aligns bones within about 1e-4 radians of -y with this axis, which moves all their descendants.
    """
    expected = heads | {f"{name}_end": heads[name] + site for name, site in sites.items()}
    actual = points({bone.name: bone.matrix_local for bone in armature.data.bones}, armature, sites)
    tolerance = 1e-6 * size_at_rest(armature)
    return [name for name, point in actual.items() if (point - expected[name]).length > tolerance]


def number_of_frames(armature: bpy.types.Object) -> int:
    """Number of MOTION rows, which may differ from the `Frames:` line of the file."""
    return max(len(curve.keyframe_points) for curve in armature.animation_data.action.fcurves)


def size_at_rest(armature: bpy.types.Object) -> float:
    heads = np.array([bone.head_local for bone in armature.data.bones])
    tails = np.array([bone.tail_local for bone in armature.data.bones if not bone.children])
    points = np.concatenate([heads, tails])
    return float(np.linalg.norm(np.ptp(points, axis=0)))


def points(
    matrices: dict[str, Matrix], armature: bpy.types.Object, sites: dict[str, Vector]
) -> dict[str, Vector]:
    """Heads of all bones, and tails that are end sites, for bones with the given matrices."""
    positions = {}
    for name, matrix in matrices.items():
        positions[name] = matrix.translation
        if name in sites and sites[name].length > SHORTEST_BONE:
            positions[f"{name}_end"] = matrix @ Vector((0.0, armature.data.bones[name].length, 0.0))
    return positions


def positions_at(
    armature: bpy.types.Object, frames: np.ndarray, sites: dict[str, Vector]
) -> list[dict[str, Vector]]:
    positions = []
    for frame in frames:
        bpy.context.scene.frame_set(int(frame) + 1)
        world = {bone.name: armature.matrix_world @ bone.matrix for bone in armature.pose.bones}
        positions.append(points(world, armature, sites))
    return positions


def read(path: Path) -> dict[str, np.ndarray]:
    sites = end_sites(path)
    armature = import_bvh(path)
    nodes, _, _ = read_bvh(bpy.context, str(path))
    names = set(armature.pose.bones.keys())
    if names != set(nodes) or not names >= set(sites):
        raise ValueError(
            f"{path.name}: Blender has changed names of joints: {sorted(names ^ (set(nodes) | set(sites)))}"
        )
    offsets = {name: node.rest_head_local for name, node in nodes.items()}
    heads = {name: node.rest_head_world for name, node in nodes.items()}
    count = number_of_frames(armature)
    frames = np.unique(np.linspace(0, count - 1, min(count, MAX_FRAMES)).round().astype(np.int32))
    positions = positions_at(armature, frames, sites)
    arrays = {
        "frames": frames,
        "names": np.array(list(positions[0])),
        "positions": np.array([list(each.values()) for each in positions], dtype=np.float32),
        "moved": np.array(moved_joints(armature, heads, sites), dtype=str),
        "size": np.array(size_at_rest(armature)),
    }
    if any(offsets[name].length > 0 for name, _ in location_curves(armature)):
        add_offsets(armature, offsets)
        positions = positions_at(armature, frames, sites)
        arrays["positions_added"] = np.array([list(each.values()) for each in positions], dtype=np.float32)
    return arrays


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("directory", type=Path, help="folder of BVH files")
    parser.add_argument("-o", "--output", type=Path, default=Path("test/data/blender_fk.npz"))
    arguments = parser.parse_args()
    arrays = {}
    for path in sorted(arguments.directory.glob("*.bvh")):
        for key, array in read(path).items():
            arrays[f"{path.stem}/{key}"] = array
    if not arrays:
        parser.error(f"no BVH files in {arguments.directory}")
    np.savez_compressed(arguments.output, **arrays)
    return 0


if __name__ == "__main__":
    sys.exit(main())
