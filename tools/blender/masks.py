#!/usr/bin/env python3
"""Render masks and depth of a mesh with Blender, for the tests of the renderer.

    python3.11 -m venv blender && blender/bin/pip install bpy==4.5.15
    blender/bin/python tools/blender/masks.py INPUT.npz -o test/data/blender_masks.npz

INPUT is an .npz file, in metres; an earlier output can be used. It has

    vertices (V, 3) float32, quads (Q, 4)   the mesh in the world; each quad is two flat triangles, of
                                            its corners 0 1 2 and 0 2 3
    K (C, 3, 3), R (C, 3, 3), t (C, 3)      x_cam = R x + t, z forward, x right, y down, no skew;
                                            the centre of the top left pixel is (0, 0)
    size (C, 2)                             width, height

The output has the same arrays and, for every camera k,

    k/mask    packed bits of the (height, width) mask, see `numpy.unpackbits`
    k/depth   float32, planar z of the mask's pixels, row by row

Cycles renders one ray through the centre of each pixel, within 0.005 pixels with its narrowest filter. Hits
are computed in float32 without a depth buffer.
"""

import argparse
import sys
import tempfile
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix

# Cycles writes a depth of 1e10 for rays that hit nothing.
NOTHING = 1e9
SENSOR_WIDTH = 36.0


def add_mesh(vertices: np.ndarray, quads: np.ndarray) -> None:
    # Triangles, because Blender may choose the other diagonal of a quad.
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    mesh = bpy.data.meshes.new("human")
    mesh.from_pydata(vertices.tolist(), [], triangles.tolist())
    bpy.context.collection.objects.link(bpy.data.objects.new("human", mesh))


def set_camera(
    camera_matrix: np.ndarray, rotation: np.ndarray, translation: np.ndarray, size: np.ndarray
) -> None:
    """Set the camera and image of the scene to the projection K [R | t]."""
    width, height = map(int, size)
    (fx, _, cx), (_, fy, cy) = camera_matrix[:2]
    # Blender measures from the corner of the image, where the centre of the top left pixel is (0.5, 0.5).
    right_of_middle = cx + 0.5 - width / 2
    below_middle = cy + 0.5 - height / 2
    scene = bpy.context.scene
    scene.render.resolution_x, scene.render.resolution_y = width, height
    scene.render.resolution_percentage = 100
    # Blender accepts no aspect below 1, so the longer side of a pixel is set.
    scene.render.pixel_aspect_x = max(1.0, fy / fx)
    scene.render.pixel_aspect_y = max(1.0, fx / fy)
    lens = scene.camera.data
    lens.sensor_fit = "HORIZONTAL"
    lens.sensor_width = SENSOR_WIDTH
    lens.lens = fx * SENSOR_WIDTH / width
    # The shift moves the window on the image plane, in units of the image width in both directions.
    lens.shift_x = -right_of_middle / width
    lens.shift_y = below_middle * (fx / fy) / width
    lens.clip_start, lens.clip_end = 0.01, 1000.0
    # Cameras of Blender look along -z with y up.
    pose = np.eye(4)
    pose[:3, :3] = rotation.T @ np.diag([1.0, -1.0, -1.0])
    pose[:3, 3] = -rotation.T @ translation
    scene.camera.matrix_world = Matrix(pose.tolist())


def set_cycles() -> None:
    """Set Cycles to one ray per pixel, and the output to an image file of depth."""
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.device = "CPU"
    scene.cycles.samples = 1
    scene.cycles.use_adaptive_sampling = False
    scene.cycles.use_denoising = False
    scene.cycles.max_bounces = 0
    scene.cycles.seed = 0
    # not BOX: the width of the box filter is always one pixel
    scene.cycles.pixel_filter_type = "BLACKMAN_HARRIS"
    scene.cycles.filter_width = 0.01
    bpy.context.view_layer.use_pass_z = True
    scene.use_nodes = True
    nodes = scene.node_tree.nodes
    nodes.clear()
    layers = nodes.new("CompositorNodeRLayers")
    composite = nodes.new("CompositorNodeComposite")
    scene.node_tree.links.new(layers.outputs["Depth"], composite.inputs["Image"])
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.image_settings.color_mode = "RGB"
    scene.render.image_settings.color_depth = "32"


def render_depth() -> np.ndarray:
    """Planar z (height, width) of the scene, top row first."""
    with tempfile.TemporaryDirectory() as folder:
        bpy.context.scene.render.filepath = str(Path(folder) / "depth.exr")
        bpy.ops.render.render(write_still=True)
        image = bpy.data.images.load(bpy.context.scene.render.filepath)
        image.colorspace_settings.name = "Non-Color"
        width, height = image.size
        flat = np.empty(width * height * image.channels, dtype=np.float32)
        image.pixels.foreach_get(flat)
        bpy.data.images.remove(image)
    return flat.reshape(height, width, -1)[::-1, :, 0]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("input", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=Path("test/data/blender_masks.npz"))
    arguments = parser.parse_args()
    with np.load(arguments.input) as archive:
        arrays = {name: archive[name] for name in ("vertices", "quads", "K", "R", "t", "size")}
    bpy.ops.wm.read_factory_settings(use_empty=True)
    add_mesh(arrays["vertices"], arrays["quads"])
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    bpy.context.collection.objects.link(camera)
    bpy.context.scene.camera = camera
    set_cycles()
    views = zip(arrays["K"], arrays["R"], arrays["t"], arrays["size"], strict=True)
    for number, view in enumerate(list(views)):
        set_camera(*view)
        depth = render_depth()
        mask = depth < NOTHING
        arrays[f"{number}/mask"] = np.packbits(mask)
        arrays[f"{number}/depth"] = depth[mask]
    np.savez_compressed(arguments.output, **arrays)
    return 0


if __name__ == "__main__":
    sys.exit(main())
