"""Render a scene of glTF files with Blender's Workbench, in a Python that has bpy.

    PYTHON workbench.py VIEWS.npz FILE.glb...

VIEWS.npz has ``size`` (2,), ``rate`` in Hz, and of each frame ``K`` (N, 3, 3) and ``poses`` (N, 4, 4) of the
camera: its optical frame in ``map``, y down and z forward. Prints the version of Blender. Then, for each
number of a frame on standard input, it prints the milliseconds for posing the people, drawing, and writing a
PNG file.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix

_NEAR, _FAR = 0.05, 200.0


def add_camera(size: np.ndarray) -> bpy.types.Object:
    """Let Workbench draw Blender's scene with a new camera, which is returned, in one sample a pixel."""
    width, height = (int(number) for number in size)
    scene = bpy.context.scene
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(camera)
    scene.camera = camera
    scene.render.engine = "BLENDER_WORKBENCH"
    scene.display.shading.color_type = "TEXTURE"
    scene.display.render_aa = "OFF"  # the default, eight samples, takes several times as long
    scene.render.resolution_x, scene.render.resolution_y = width, height
    scene.render.image_settings.compression = 0
    camera.data.clip_start, camera.data.clip_end = _NEAR, _FAR
    return camera


def place(camera: bpy.types.Object, k: np.ndarray, pose: np.ndarray, size: np.ndarray) -> None:
    """Give the camera its matrix (3, 3) and pose (4, 4)."""
    width, height = (int(number) for number in size)
    camera.data.lens = k[0, 0] * camera.data.sensor_width / width
    camera.data.shift_x = -(k[0, 2] + 0.5 - width / 2) / width
    camera.data.shift_y = (k[1, 2] + 0.5 - height / 2) / width
    camera.matrix_world = Matrix((pose @ np.diag([1.0, -1.0, -1.0, 1.0])).tolist())


def main() -> None:
    # output of Blender must not mix with the answers
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    with np.load(sys.argv[1]) as archive:
        views = dict(archive)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.fps = round(float(views["rate"]))
    for glb in sys.argv[2:]:
        bpy.ops.import_scene.gltf(filepath=glb)
    camera = add_camera(views["size"])
    file = str(Path(tempfile.gettempdir()) / f"humansim_bench_{os.getpid()}.png")
    scene.render.filepath = file
    print(f"Blender {bpy.app.version_string}", file=answers, flush=True)
    for line in sys.stdin:
        number = int(line)
        start = time.perf_counter()
        scene.frame_set(number)
        place(camera, views["K"][number], views["poses"][number], views["size"])
        bpy.ops.render.render(write_still=True)
        print((time.perf_counter() - start) * 1e3, file=answers, flush=True)
    if folder := os.environ.get("HUMANSIM_BENCH_PICTURES"):
        Path(file).replace(Path(folder) / "workbench.png")
    Path(file).unlink(missing_ok=True)


if __name__ == "__main__":
    main()
