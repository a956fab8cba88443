#!/usr/bin/env python3
"""Render a scene with GLRenderer and with the path tracer of Blender, side by side (docs/look.md).

    python3.11 -m venv blender && blender/bin/pip install bpy==4.5.15
    python tools/blender/path_traced_picture.py --blender blender/bin/python [-o docs/images/cycles.jpg]

Blender gets the posed meshes, their textures as base colours, the camera, a sun of the same direction, size
and irradiance, and a uniform sky and ground. Skin of the humans gets the skin material of Blender (subsurface
scattering and specular reflection); clothes get a rough material with sheen. Light passes through walls and
ceiling in both. Only Blender computes indirect light between surfaces.
"""

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
SIZE, SAMPLES = (560, 420), 96
SCENE = """\
humans:
  anna: {body: adult_woman, motion: {file: wave, position: [0.2, -0.2], yaw_deg: -20}}
  walker: {motion: {file: walk, position: [-0.6, 0.9], yaw_deg: 10}}
cameras:
  corner: {size: [560, 420], position: [3.0, 2.3, 1.9], look_at: [-0.2, 0.2, 0.75], fov_deg: 58}
light: {shadows: soft%s}
"""
#: Settings of ``light`` that are compared; the last one is shown in the picture.
LOOKS = {
    "matt, without ambient occlusion": ", materials: false, ambient_occlusion: false",
    "as by default": "",
}


def ours(folder: Path, light: str = "") -> tuple[np.ndarray, np.ndarray]:
    """Render the image (H, W, 3), RGB, and the mask of the humans; write scene.npz for Blender."""
    sys.path.insert(0, str(ROOT))
    from humansim_ros.scene import Scene, Simulation

    path = folder / "scene.yaml"
    path.write_text(SCENE % light)
    scene = Scene.load(path)
    simulation = Simulation(scene, ("rgb", "instance"))
    frame = simulation.frame(20)
    simulation.close()
    meshes = [(mesh, mesh.vertices) for mesh in scene.static_meshes]
    meshes += [(actor.human.mesh, frame.humans[name].vertices) for name, actor in scene.actors.items()]
    camera, light = frame.cameras["corner"], scene.environment.lighting
    data = {
        "K": camera.K,
        "R": camera.R,
        "t": camera.t,
        "sun": light.direction,
        "sun_size": np.radians(light.sun_size_deg),
        **{name: np.array(getattr(light, name)) for name in ("sun_color", "sky_color", "ground_color")},
    }
    for number, (mesh, vertices) in enumerate(meshes):
        # single faces above the floor are walls and ceiling
        shell = len(mesh.faces) == 1 and not np.allclose(vertices[:, 2], 0, atol=0.01)
        # coincident sides of furniture would shade each other at random
        middle = vertices.mean(axis=0)
        vertices = middle + (vertices - middle) * (1 - 1e-4 * (number % 7))
        data |= {
            f"{number}/vertices": vertices,
            f"{number}/triangles": mesh.triangles,
            f"{number}/uv": mesh.uv[mesh.uv_triangles],
            f"{number}/texture": mesh.texture,
            f"{number}/shell": np.array(shell),
        }
        if mesh.skin is not None:
            data[f"{number}/skin"] = mesh.skin
    np.savez(folder / "scene.npz", **data)
    view = frame.views["corner"]
    return view.rgb, view.instance > 0


def render(scene_file: Path, picture: Path) -> None:
    """Render scene.npz with Blender. Runs in the Python of Blender."""
    import bpy
    from masks import set_camera
    from mathutils import Vector

    data = np.load(scene_file)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    eye = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(eye)
    scene.camera = eye
    set_camera(data["K"], data["R"], data["t"], np.array(SIZE))
    for number in sorted({name.partition("/")[0] for name in data.files if "/" in name}, key=int):
        mesh = bpy.data.meshes.new(number)
        triangles = data[f"{number}/triangles"]
        mesh.from_pydata(data[f"{number}/vertices"].tolist(), [], triangles.tolist())
        mesh.uv_layers.new().data.foreach_set("uv", data[f"{number}/uv"].ravel())
        smooth = len(triangles) > 1000
        mesh.polygons.foreach_set("use_smooth", [smooth] * len(triangles))
        material = bpy.data.materials.new(number)
        material.use_nodes = True
        skin = data[f"{number}/skin"] if f"{number}/skin" in data.files else None
        paint(material.node_tree, data[f"{number}/texture"], skin)
        mesh.materials.append(material)
        thing = bpy.data.objects.new(number, mesh)
        if data[f"{number}/shell"]:
            thing.visible_shadow = thing.visible_diffuse = False
        scene.collection.objects.link(thing)
    lamp = bpy.data.lights.new("sun", "SUN")
    # a white surface that faces the sun has sun_color: irradiance / pi
    lamp.energy, lamp.color, lamp.angle = np.pi, data["sun_color"].tolist(), float(data["sun_size"])
    sun = bpy.data.objects.new("sun", lamp)
    sun.rotation_mode = "QUATERNION"
    sun.rotation_quaternion = Vector(data["sun"].tolist()).to_track_quat("Z", "Y")
    scene.collection.objects.link(sun)
    add_sky(scene, data["sky_color"], data["ground_color"])
    scene.render.engine = "CYCLES"
    scene.cycles.device = "CPU"
    scene.cycles.samples = SAMPLES
    scene.cycles.use_denoising = True
    scene.cycles.max_bounces = 3
    scene.view_settings.view_transform = "Standard"
    scene.render.filepath = str(picture)
    scene.render.image_settings.file_format = "PNG"
    bpy.ops.render.render(write_still=True)


def paint(tree, texture: np.ndarray, skin: np.ndarray | None) -> None:
    """Set up a diffuse material, or one of skin and clothes."""
    import bpy

    def image(pixels: np.ndarray, space: str):
        height, width = pixels.shape[:2]
        made = bpy.data.images.new("texture", width, height)
        made.colorspace_settings.name = space
        whole = np.ones((height, width, 4), np.float32)
        whole[..., :3] = pixels[::-1].reshape(height, width, -1) / 255
        made.pixels.foreach_set(whole.ravel())
        node = tree.nodes.new("ShaderNodeTexImage")
        node.image = made
        return node.outputs["Color"]

    def times(factor: float, plus: float, value):
        node = tree.nodes.new("ShaderNodeMath")
        node.operation = "MULTIPLY_ADD"
        node.inputs[1].default_value, node.inputs[2].default_value = factor, plus
        tree.links.new(value, node.inputs[0])
        return node.outputs[0]

    tree.nodes.clear()
    output = tree.nodes.new("ShaderNodeOutputMaterial")
    kind = "BsdfDiffuse" if skin is None else "BsdfPrincipled"
    surface = tree.nodes.new(f"ShaderNode{kind}")
    tree.links.new(surface.outputs["BSDF"], output.inputs["Surface"])
    color = "Color" if skin is None else "Base Color"
    tree.links.new(image(texture, "sRGB"), surface.inputs[color])
    if skin is None:
        return
    share = image(skin, "Non-Color")
    answers = {
        "Subsurface Weight": (1.0, 0.0),
        "Specular IOR Level": (0.4, 0.0),
        "Diffuse Roughness": (-0.4, 0.4),
        "Sheen Weight": (-0.12, 0.12),
    }
    for name, (factor, plus) in answers.items():
        tree.links.new(times(factor, plus, share), surface.inputs[name])
    surface.inputs["Roughness"].default_value = 0.5
    surface.inputs["Sheen Roughness"].default_value = 0.5
    surface.inputs["Subsurface Radius"].default_value = (1.0, 0.35, 0.2)
    surface.inputs["Subsurface Scale"].default_value = 0.01


def add_sky(scene, sky: np.ndarray, ground: np.ndarray) -> None:
    """Add uniform light of the sky from above, and of the ground from below."""
    import bpy

    world = bpy.data.worlds.new("world")
    scene.world = world
    world.use_nodes = True
    nodes, links = world.node_tree.nodes, world.node_tree.links
    place, parts, above, mix = (
        nodes.new(f"ShaderNode{kind}") for kind in ("TexCoord", "SeparateXYZ", "Math", "MixRGB")
    )
    above.operation = "GREATER_THAN"
    above.inputs[1].default_value = 0.0
    mix.inputs[1].default_value = (*ground.tolist(), 1.0)
    mix.inputs[2].default_value = (*sky.tolist(), 1.0)
    links.new(place.outputs["Generated"], parts.inputs[0])
    links.new(parts.outputs["Z"], above.inputs[0])
    links.new(above.outputs[0], mix.inputs[0])
    links.new(mix.outputs[0], nodes["Background"].inputs["Color"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--blender", help="a Python that has bpy")
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs/images/cycles.jpg")
    parser.add_argument("--render", nargs=2, type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.render:
        render(*arguments.render)
        return
    import cv2

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        seen = {what: ours(folder, light) for what, light in LOOKS.items()}
        files = [str(folder / "scene.npz"), str(folder / "blender.png")]
        subprocess.run([arguments.blender, __file__, "--render", *files], check=True)
        right = cv2.imread(files[1])
    for what, (rgb, people) in seen.items():
        left = rgb[..., ::-1]
        off = np.abs(left.astype(int) - right).mean(axis=2)
        print(f"{what}: mean difference {off.mean():.1f} of 255, people {off[people].mean():.1f}")
    cv2.imwrite(str(arguments.output), np.hstack([left, right]), [cv2.IMWRITE_JPEG_QUALITY, 88])


if __name__ == "__main__":
    main()
