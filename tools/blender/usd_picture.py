"""Render a camera of an OpenUSD export with Blender, for docs/images/simulators.jpg.

    BLENDER_PYTHON tools/blender/usd_picture.py SCENE.usdc CAMERA FRAME OUT.png

Run it with a Python that has bpy 4.5.15.
"""

from __future__ import annotations

import sys

import bpy


def main(file: str, camera: str, frame: int, out: str) -> None:
    """Render a frame with 32 rays a pixel, as wide as in docs/images."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.usd_import(filepath=file)
    scene = bpy.context.scene
    scene.camera = next(each for each in scene.objects if each.type == "CAMERA" and camera in each.name)
    scene.frame_set(frame)
    scene.render.engine = "CYCLES"
    scene.cycles.samples = 32
    scene.view_settings.view_transform = "Standard"
    for each in scene.objects:  # light comes through the walls, as in our pictures
        if each.name.startswith("surface"):
            each.visible_shadow = each.visible_diffuse = False
    scene.render.resolution_x, scene.render.resolution_y = 320, 240
    scene.render.filepath = out
    bpy.ops.render.render(write_still=True)


if __name__ == "__main__":
    main(*sys.argv[-4:-2], int(sys.argv[-2]), sys.argv[-1])
