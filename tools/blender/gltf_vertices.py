"""What Blender makes of an animated glTF figure: its vertices in some frames, for test/data/blender_gltf.npz.

    BLENDER_PYTHON tools/blender/gltf_vertices.py OUT.npz FILE ...

Run with a Python that has bpy 4.5.15. Of each file: the names of objects and every so many of the vertices of
its skinned meshes, in the scene's axes of glTF (y up), metres, at some seconds of its first animation.
"""

from __future__ import annotations

import sys
from pathlib import Path

import bpy
import numpy as np

SECONDS = (0.0, 0.25, 0.5, 1.0)
STEP = 5


def vertices_of(path: Path) -> np.ndarray:
    """(T, K, 3) every STEP-th vertex of the file's skinned mesh."""
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
        out.append(points[::STEP, [0, 2, 1]] * [1, 1, -1])  # Blender's z up to y up
    return np.array(out)


def main() -> None:
    out, *files = sys.argv[1:]
    arrays = {Path(file).stem: vertices_of(Path(file)).astype(np.float32) for file in files}
    np.savez_compressed(out, seconds=np.array(SECONDS), step=np.array(STEP), **arrays)
    for name, values in arrays.items():
        print(name, values.shape, values.min((0, 1)), values.max((0, 1)))


if __name__ == "__main__":
    main()
