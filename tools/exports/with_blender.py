"""Compare GLB, USD, COLLADA and BVH files of an export with the truth, in Blender: vertices and joints.

    BLENDER_PYTHON tools/exports/with_blender.py FOLDER

Run it with a Python that has bpy 4.5 or later; ``tools/exports/make.py`` makes the folder.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np

#: Points (N, 3) in other axes.
Axes = Callable[[np.ndarray], np.ndarray]


def to_map(points: np.ndarray) -> np.ndarray:
    """Points of Blender after the import of a file with y up, in ``map``.

    The file has (y, z, x) of ``map``, and Blender's importers turn (x, y, z) to (x, -z, y).
    """
    return np.stack([-points[..., 1], points[..., 0], points[..., 2]], axis=-1)


def empty_scene(rate: float) -> None:
    """A scene of this rate."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.fps, scene.render.fps_base = round(rate), round(rate) / rate


def heads(armature: bpy.types.Object, names: list[str]) -> np.ndarray:
    """Heads (B, 3) of the bones in the axes of Blender."""
    moved = armature.evaluated_get(bpy.context.evaluated_depsgraph_get())
    return np.array([moved.matrix_world @ moved.pose.bones[name].head for name in names])


def compare_skin(kind: str, person: str, truth: dict[str, np.ndarray], axes: Axes, root: str = "") -> None:
    """Vertices and heads of a person of the scene that is open.

    ``kind``: of the file. ``axes``: from points of Blender to ``map``. ``root``: object that the person
    hangs on.
    """
    scene = bpy.context.scene
    family = [scene.objects[root], *scene.objects[root].children_recursive] if root else scene.objects
    mesh = next(o for o in family if o.type == "MESH" and any(m.type == "ARMATURE" for m in o.modifiers))
    armature = next(m.object for m in mesh.modifiers if m.type == "ARMATURE")
    vertices, joints = truth[f"{person}_vertices"], truth[f"{person}_joints"]
    names = truth[f"{person}_bones"].tolist()
    worst_vertex = worst_joint = 0.0
    for frame in range(len(vertices)):
        scene.frame_set(frame)
        evaluated = mesh.evaluated_get(bpy.context.evaluated_depsgraph_get())
        found = np.zeros(3 * len(evaluated.data.vertices), dtype=np.float32)
        evaluated.data.vertices.foreach_get("co", found)
        world = np.array(evaluated.matrix_world)
        points = axes(found.reshape(-1, 3) @ world[:3, :3].T + world[:3, 3])[: vertices.shape[1]]
        worst_vertex = max(worst_vertex, float(np.linalg.norm(points - vertices[frame], axis=1).max()))
        found_heads = axes(heads(armature, names))
        distance = np.linalg.norm(found_heads - joints[frame, : len(names)], axis=1)
        worst_joint = max(worst_joint, float(distance.max()))
    print(
        f"{kind} {person}: {len(vertices)} frames, {vertices.shape[1]} vertices: "
        f"at most {worst_vertex:.1e} m; {len(names)} joints: at most {worst_joint:.1e} m"
    )


def compare_bvh(folder: Path, truth: dict[str, np.ndarray], rotations: str) -> None:
    """Heads of the BVH file of each person. ``rotations``: kind of rotations that the importer makes."""
    for person in truth["people"].tolist():
        empty_scene(float(truth["rate"]))
        # centimetres; Blender puts the first row at frame 1
        file = str(folder / "export" / "bvh" / f"{person}.bvh")
        bpy.ops.import_anim.bvh(filepath=file, global_scale=0.01, frame_start=1, rotate_mode=rotations)
        scene = bpy.context.scene
        armature = next(o for o in scene.objects if o.type == "ARMATURE")
        joints, names = truth[f"{person}_joints"], truth[f"{person}_bones"].tolist()
        worst = 0.0
        for frame in range(len(joints)):
            scene.frame_set(frame + 1)
            distance = np.linalg.norm(to_map(heads(armature, names)) - joints[frame, : len(names)], axis=1)
            worst = max(worst, float(distance.max()))
        print(f"BVH {person}, {rotations}: {len(joints)} frames, {len(names)} joints: at most {worst:.1e} m")


if __name__ == "__main__":
    exported = Path(sys.argv[-1])
    arrays = dict(np.load(exported / "truth.npz"))
    folder, rate, people = exported / "export", float(arrays["rate"]), arrays["people"].tolist()
    empty_scene(rate)
    bpy.ops.import_scene.gltf(filepath=str(folder / "glb" / "people.glb"), merge_vertices=False)
    for name in people:
        compare_skin("GLB", name, arrays, to_map, name)
    empty_scene(rate)
    bpy.ops.wm.usd_import(filepath=str(folder / "usd" / "scene.usdc"))
    for name in people:
        compare_skin("USD", name, arrays, np.asarray, name)
    for name in people:
        empty_scene(rate)
        bpy.ops.wm.collada_import(filepath=str(folder / "gazebo" / "meshes" / f"{name}.dae"))
        compare_skin("COLLADA", name, arrays, np.asarray)
    for kind in ("QUATERNION", "NATIVE"):
        compare_bvh(exported, arrays, kind)
