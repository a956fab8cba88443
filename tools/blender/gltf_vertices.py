"""Write vertices of animated glTF files from Blender, for test/data/blender_gltf.npz.

    BLENDER_PYTHON tools/blender/gltf_vertices.py OUT.npz FILE ...

Run it with a Python that has bpy 4.5.15. For each file, the output has every STEP-th vertex of its skinned
mesh in the axes of glTF (y up), metres, at some times of its first animation.
"""

from __future__ import annotations

import sys
from pathlib import Path

import bpy
import numpy as np

SECONDS = (0.0, 0.25, 0.5, 1.0)
STEP = 5


def vertices_of(path: Path) -> np.ndarray:
    """Every STEP-th vertex (T, K, 3) of the skinned mesh of a file."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.fps, scene.render.fps_base = 1000, 1.0  # frames are milliseconds
    bpy.ops.import_scene.gltf(filepath=str(path), merge_vertices=False, import_pack_images=False)
    skinned = [
        o for o in scene.objects if o.type == "MESH" and any(m.type == "ARMATURE" for m in o.modifiers)
    ]
    assert len(skinned) == 1
    out = []
    for seconds in SECONDS:
        scene.frame_set(round(1000 * seconds))
        mesh = skinned[0].evaluated_get(bpy.context.evaluated_depsgraph_get())
        points = np.array([skinned[0].matrix_world @ v.co for v in mesh.data.vertices])
        out.append(points[::STEP, [0, 2, 1]] * [1, 1, -1])  # from z up to y up
    return np.array(out)


def main() -> None:
    out, *files = sys.argv[1:]
    arrays = {Path(file).stem: vertices_of(Path(file)).astype(np.float32) for file in files}
    np.savez_compressed(out, seconds=np.array(SECONDS), step=np.array(STEP), **arrays)
    for name, values in arrays.items():
        print(name, values.shape, values.min((0, 1)), values.max((0, 1)))


if __name__ == "__main__":
    main()
