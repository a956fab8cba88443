"""Project points with cameras of .cam files [thesis §8.3] in Blender (test/data/README.md).

blender/bin/python tools/blender/camera_points.py test/data/blender_cam.json
"""

from __future__ import annotations

import json
import sys
from math import radians
from pathlib import Path

import bpy
from mathutils import Vector

#: C, f, R (degrees), k_u : k_v, width and height.
CAMERAS = [
    ((3.0, 0.0, 1.0), 1.0, (80.0, 0.0, 80.0), (1.0, 1.0), (600, 800)),
    ((-2.5, 1.0, 1.7), 1.5, (75.0, 10.0, -100.0), (1.0, 2.0), (640, 480)),
    ((0.3, -4.0, 2.0), 1.25, (62.0, -5.0, 3.0), (3.0, 2.0), (640, 480)),
    ((0.0, 0.0, 5.0), 2.0, (0.0, 90.0, 20.0), (4.0, 2.0), (300, 900)),
]
#: Points in the axes of a Blender camera: right, up, backward, metres.
POINTS = [(0.1, 0.2, -2.0), (-0.5, 0.3, -4.0), (0.4, -0.9, -3.0), (0.0, 0.0, -1.0)]


def seen(center, focal, degrees, aspect, size) -> list[dict[str, list[float]]]:
    scene = bpy.context.scene
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(camera)
    camera.location = center
    camera.rotation_euler = [radians(angle) for angle in degrees]
    camera.data.sensor_width, camera.data.sensor_fit = 32.0, "AUTO"
    camera.data.lens = 16.0 * focal
    (ku, kv), (width, height) = aspect, size
    bpy.context.view_layer.update()
    projection = camera.calc_matrix_camera(
        bpy.context.evaluated_depsgraph_get(), x=width, y=height, scale_x=kv, scale_y=ku
    )
    points = []
    for point in POINTS:
        world = camera.matrix_world @ Vector(point)
        clip = projection @ camera.matrix_world.inverted() @ world.to_4d()
        x, y = clip.x / clip.w, clip.y / clip.w
        # origin from the lower left corner of the window to the centre of the first pixel of the image
        pixel = [(x + 1) / 2 * width - 0.5, (1 - y) / 2 * height - 0.5]
        points.append({"world": list(world), "pixel": pixel})
    return points


if __name__ == "__main__":
    keys = ("C", "f", "R", "k", "size")
    cameras = [{**dict(zip(keys, values, strict=True)), "points": seen(*values)} for values in CAMERAS]
    lines = ",\n".join(json.dumps(camera) for camera in cameras)
    Path(sys.argv[1]).write_text(f"[{lines}]\n")
