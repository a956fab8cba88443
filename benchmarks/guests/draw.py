"""Render the frames of benchmarks/core.py with another renderer, in a Python that has it.

    PYTHON draw.py RENDERER SHOTS.npz

Prints name and version of the renderer. Then, for each number of a frame on standard input, it prints the
milliseconds for setting the vertices, drawing and reading back.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

Shots = dict[str, Any]
Draw = Callable[[int], object]


def open3d(shots: Shots) -> tuple[str, Draw]:
    os.environ.setdefault("EGL_PLATFORM", "surfaceless")
    import open3d as o3d

    width, height = (int(n) for n in shots["size"])
    renderer = o3d.visualization.rendering.OffscreenRenderer(width, height)
    material = o3d.visualization.rendering.MaterialRecord()
    material.shader = "defaultLit"
    material.albedo_img = o3d.geometry.Image(np.ascontiguousarray(shots["texture"]))
    corners = shots["corners"]
    mesh = o3d.geometry.TriangleMesh()
    mesh.triangles = o3d.utility.Vector3iVector(corners)
    mesh.triangle_uvs = o3d.utility.Vector2dVector(shots["uv"][corners].reshape(-1, 2))

    def draw(number: int) -> object:
        mesh.vertices = o3d.utility.Vector3dVector(shots["vertices"][number])
        mesh.compute_vertex_normals()
        renderer.scene.clear_geometry()
        renderer.scene.add_geometry("body", mesh, material)
        renderer.setup_camera(shots["K"][number], shots["extrinsics"][number], width, height)
        color = np.asarray(renderer.render_to_image())
        return color, np.asarray(renderer.render_to_depth_image(z_in_view_space=True))

    return f"Open3D {o3d.__version__}: rgb, depth", draw


def aitviewer(shots: Shots) -> tuple[str, Draw]:
    from functools import partial
    from importlib.metadata import version

    import moderngl

    # aitviewer would open an X11 window
    moderngl.create_standalone_context = partial(moderngl.create_standalone_context, backend="egl")
    from aitviewer.configuration import CONFIG
    from aitviewer.headless import HeadlessRenderer
    from aitviewer.renderables.meshes import Meshes
    from aitviewer.scene.camera import OpenCVCamera

    width, height = (int(n) for n in shots["size"])
    CONFIG.update_conf({"window_width": width, "window_height": height, "shadows_enabled": False})
    viewer = HeadlessRenderer()
    viewer.scene.floor.enabled = False
    viewer.scene.origin.enabled = False
    with tempfile.NamedTemporaryFile(suffix=".png") as file:
        from PIL import Image

        Image.fromarray(shots["texture"]).save(file.name)
        mesh = Meshes(
            shots["vertices"][:1], shots["corners"], uv_coords=shots["uv"], path_to_texture=file.name
        )
        viewer.scene.add(mesh)

        def draw(number: int) -> object:
            mesh.vertices = shots["vertices"][number : number + 1]
            camera = OpenCVCamera(
                shots["K"][number], shots["extrinsics"][number, :3], width, height, viewer=viewer
            )
            viewer.set_temp_camera(camera)
            return np.asarray(viewer.get_frame()), np.asarray(viewer.get_depth())

        draw(0)
    return f"aitviewer {version('aitviewer')}: rgb, depth, no shadows", draw


def blender(shots: Shots) -> tuple[str, Draw]:
    import bpy
    from workbench import add_camera, place

    bpy.ops.wm.read_factory_settings(use_empty=True)
    mesh = bpy.data.meshes.new("body")
    mesh.from_pydata(shots["vertices"][0].tolist(), [], shots["corners"].tolist())
    layer = mesh.uv_layers.new()
    layer.data.foreach_set("uv", shots["uv"][shots["corners"]].astype(np.float32).ravel())
    image = bpy.data.images.new("texture", *shots["texture"].shape[1::-1])
    rgba = np.dstack([shots["texture"][::-1], np.full(shots["texture"].shape[:2], 255, np.uint8)])
    image.pixels.foreach_set((rgba / 255).astype(np.float32).ravel())
    material = bpy.data.materials.new("skin")
    material.use_nodes = True
    node = material.node_tree.nodes.new("ShaderNodeTexImage")
    node.image = image
    material.node_tree.nodes.active = node
    mesh.materials.append(material)
    scene = bpy.context.scene
    scene.collection.objects.link(bpy.data.objects.new("body", mesh))
    camera = add_camera(shots["size"])
    file = str(Path(tempfile.gettempdir()) / f"humansim_bench_{os.getpid()}.png")
    scene.render.filepath = file

    def draw(number: int) -> object:
        mesh.vertices.foreach_set("co", shots["vertices"][number].astype(np.float32).ravel())
        mesh.update()
        place(camera, shots["K"][number], np.linalg.inv(shots["extrinsics"][number]), shots["size"])
        bpy.ops.render.render(write_still=True)
        return Path(file).read_bytes()

    draw(0)
    return f"Blender {bpy.app.version_string}, Workbench: rgb, one sample, to a PNG file", draw


RENDERERS = {"open3d": open3d, "aitviewer": aitviewer, "blender": blender}


def main() -> int:
    # output of libraries must not mix with the answers
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    with np.load(sys.argv[2]) as archive:
        shots = dict(archive)
    title, draw = RENDERERS[sys.argv[1]](shots)
    print(title, file=answers, flush=True)
    for line in sys.stdin:
        start = time.perf_counter()
        result = draw(int(line))
        print((time.perf_counter() - start) * 1e3, file=answers, flush=True)
        if (folder := os.environ.get("HUMANSIM_BENCH_PICTURES")) and isinstance(result, tuple):
            np.save(Path(folder) / f"{sys.argv[1]}.npy", result[0])
    return 0


if __name__ == "__main__":
    sys.exit(main())
