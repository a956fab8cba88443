#!/usr/bin/env python3
"""Texture figures of other authors from photographs that Blender renders (docs/from_photographs.md).

    python3.11 -m venv blender && blender/bin/pip install bpy==4.5.15
    python tools/blender/photographed_figures.py FIGURE... --blender blender/bin/python [-o FOLDER]

Each figure (any file that `load_human` reads) stands in a pose in the light of a sun and a sky. Cycles
renders photographs from 4 and from 8 cameras with a lens, and pictures from new views. Figures without a
texture get clothes with a pattern that only Blender computes. The figure is textured by both methods from the
JPEG files: in the known pose; with other colours in each camera; in the pose that `fit_person` finds from 17
points with noise and silhouettes; and as the built-in man, fitted in the same way. All are rendered without
light and compared with the pictures of Blender: pixels of the person, those that some camera saw, and the
overlap (IoU) of the silhouettes.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
SIZE, SAMPLES, QUALITY, NOISE = (640, 480), 12, 92, 2.0
#: plumb_bob, as of a small camera. Blender renders larger images without a lens, which are bent afterwards.
LENS = (-0.12, 0.04, 0.001, -0.0008, 0.0)
LARGER, FINER = 1.25, 1.25
NEW_VIEWS = (0.35, 2.4, 4.4)
POSE = {
    "l_shoulder": (0.0, 0.0, 0.4),
    "r_shoulder": (0.2, 0.0, -0.4),
    "l_elbow": (0.0, 0.4, 0.0),
    "r_knee": (0.5, 0.0, 0.0),
    "l_hip": (-0.3, 0.0, 0.0),
}
#: Cases, and the human that is fitted: none, the figure itself, or a built-in one.
CASES = {"known pose": None, "other colours": None, "fitted pose": "", "fitted man": "adult_man"}


# in the Python of this project


def looking(angle: float, height: float):
    """A camera with a lens that sees the whole figure."""
    from humansim_ros.cameras import Camera

    place = (2.7 * np.cos(angle), 2.7 * np.sin(angle), height)
    ideal = Camera.look_at(place, (0, 0, 0.85), SIZE, np.radians(55))
    return Camera(SIZE, ideal.K, ideal.R, ideal.t, LENS)


def larger_matrix(matrix: np.ndarray) -> tuple[np.ndarray, tuple[int, int]]:
    """K and size of the images that Blender renders."""
    size = tuple(round(side * LARGER * FINER) for side in SIZE)
    larger = matrix.copy()
    larger[0, 0] *= FINER
    larger[1, 1] *= FINER
    larger[:2, 2] = (np.array(size) - 1) / 2
    return larger, size


def box(vertices, matrix, rotation, translation) -> np.ndarray:
    """Lowest and highest pixel, (2, 2), of the figure and its surroundings."""
    points = (vertices @ rotation.T + translation) @ matrix.T
    pixels = points[:, :2] / points[:, 2:]
    return np.stack([pixels.min(axis=0) - 30, pixels.max(axis=0) + 30])


def bend(image: np.ndarray, camera) -> np.ndarray:
    """What the camera sees through its lens, from an image of Blender."""
    import cv2

    larger, size = larger_matrix(camera.K)
    columns, rows = np.meshgrid(*(np.arange(side, dtype=np.float64) for side in SIZE))
    pixels = np.stack([columns, rows], axis=-1).reshape(-1, 1, 2)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-9)
    straight = cv2.undistortPointsIter(pixels, camera.K, np.array(LENS), None, larger, criteria)
    places = straight.reshape(SIZE[1], SIZE[0], 2).astype(np.float32)
    assert places.min() > 0
    assert (places.reshape(-1, 2).max(axis=0) < np.array(size) - 1).all()
    soft = cv2.GaussianBlur(image, (0, 0), 0.35 * FINER)
    return cv2.remap(soft, places[..., 0], places[..., 1], cv2.INTER_CUBIC)


def clothes(human) -> np.ndarray:
    """Colours (V, 3) of a figure without a texture: skin, shirt, trousers and shoes, by its bones."""
    bones = np.asarray(human.weights.argmax(axis=1)).ravel()
    names = np.array(human.skeleton.names)[bones]
    height = human.mesh.vertices[:, 1] / human.mesh.vertices[:, 1].max()
    colours = np.tile([0.55, 0.12, 0.10], (len(names), 1))
    legs = np.array([any(part in name for part in ("hip", "knee", "Root")) for name in names])
    colours[legs | (height < 0.5)] = (0.06, 0.10, 0.28)
    arms = np.array([any(part in name for part in ("shoulder", "elbow", "wrist")) for name in names])
    colours[arms] = (0.55, 0.12, 0.10)
    bare = np.array([any(part in name for part in ("elbow", "wrist")) for name in names])
    colours[bare | (height > 0.86)] = (0.72, 0.42, 0.30)
    colours[height > 0.965] = (0.05, 0.03, 0.02)
    colours[height < 0.045] = (0.5, 0.5, 0.48)
    return colours


def render_in_blender(python: str, folder: Path, human, vertices, cameras) -> list[np.ndarray]:
    """Images (H, W, 3) RGB of the figure from cameras with a lens."""
    import cv2

    larger = [larger_matrix(camera.K) for camera in cameras]
    files = [folder / f"{number}.png" for number in range(len(cameras))]
    if not all(file.is_file() for file in files):
        folder.mkdir(parents=True, exist_ok=True)
        write_figure(folder / "figure.npz", human, vertices, cameras, larger)
        command = [python, __file__, "--render", str(folder / "figure.npz"), str(folder)]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    images = [cv2.imread(str(file))[..., ::-1] for file in files]
    return [bend(image, camera) for image, camera in zip(images, cameras, strict=True)]


def write_figure(path: Path, human, vertices, cameras, larger) -> None:
    """Write the figure and the cameras for Blender. ``larger``: K and size of its images."""
    mesh = human.mesh
    data = {
        "vertices": vertices,
        "rest": mesh.vertices,
        "triangles": mesh.triangles,
        "K": np.array([matrix for matrix, _ in larger]),
        "size": np.array([size for _, size in larger]),
        "R": np.array([camera.R for camera in cameras]),
        "t": np.array([camera.t for camera in cameras]),
    }
    # only the surroundings of the figure are rendered
    data["boxes"] = np.array(
        [box(vertices, *each) for each in zip(data["K"], data["R"], data["t"], strict=True)]
    )
    # a texture of a few texels has one colour
    if mesh.texture is not None and min(mesh.texture.shape[:2]) > 16:
        data |= {"uv": mesh.uv[mesh.uv_triangles], "texture": mesh.texture}
    else:
        data["colors"] = clothes(human)
    np.savez(path, **data)


def ours(human, vertices, cameras):
    """Images without light and face images of a human."""
    from humansim_ros.render import Body, GLRenderer, Lighting

    with GLRenderer(lighting=Lighting(mode="shadeless")) as renderer:
        body = Body(human.mesh, vertices, human.triangle_parts, 1)
        seen = [renderer.render([body], camera, ("rgb", "face")) for camera in cameras]
    return [view.rgb for view in seen], [view.face for view in seen]


def psnr(found, expected, masks) -> float:
    """Peak signal to noise ratio, dB, of the pixels of masks."""
    pairs = zip(found, expected, masks, strict=True)
    errors = np.concatenate([one[mask].astype(float) - other[mask] for one, other, mask in pairs])
    return float(10 * np.log10(255**2 / np.mean(errors**2)))


def write_photographs(folder: Path, names, cameras, images, gains) -> list[np.ndarray]:
    """Write JPEG files of cameras with other colours; what they show."""
    import cv2

    read = []
    for name, image, gain in zip(names, images, gains, strict=True):
        changed = np.clip(np.rint(image * gain), 0, 255).astype(np.uint8)
        path = str(folder / f"{name}.jpg")
        cv2.imwrite(path, changed[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
        read.append(np.ascontiguousarray(cv2.imread(path)[..., ::-1]))
    return read


def fitted(folder: Path, start: str, human, posed, vertices, cameras, faces):
    """A built-in human or that of a file, fitted to noisy points and silhouettes, and its vertices."""
    import cv2
    import yaml

    from humansim_ros.cameras import write_calibration
    from humansim_ros.people import keypoint_set
    from humansim_ros.people.keypoints.locator import KeypointLocator
    from humansim_ros.photographs import read_views
    from humansim_ros.photographs.fitting import fit_person
    from humansim_ros.photographs.views import write_points

    keypoints = keypoint_set("coco17")
    joints = human.skeleton.joint_transforms(posed)[:, :3, 3]
    places = KeypointLocator.of(human, keypoints).positions(joints, vertices)
    rng = np.random.default_rng(0)
    write_calibration(folder / "calibration.toml", cameras)
    views = {}
    for (name, camera), face in zip(cameras.items(), faces, strict=True):
        pixels = camera.project(places)[0] + rng.normal(0, NOISE, (len(places), 2))
        points = np.column_stack([pixels, np.ones(len(pixels))])
        write_points(folder / f"{name}.json", keypoints, [points])
        cv2.imwrite(str(folder / f"{name}.png"), (face > 0) * np.uint8(255))
        views[name] = {"image": f"{name}.jpg", "points": f"{name}.json", "mask": f"{name}.png"}
    content = {"calibration": "calibration.toml", "keypoints": "coco17", "human": start, "views": views}
    (folder / "views.yaml").write_text(yaml.safe_dump(content))
    fit = fit_person(read_views(folder / "views.yaml"))
    return fit.body, fit.vertices(0)


def evaluate(path: Path, blender: str, renders: Path, output: Path | None) -> None:
    """Print the rows of one figure. ``renders``: folder of the images of Blender."""
    import cv2

    from humansim_ros.geometry import matrix_to_quaternion, rotation_vector_to_matrix
    from humansim_ros.people import load_human
    from humansim_ros.photographs.atlas_texture import texture_atlas
    from humansim_ros.photographs.surface import TextureView, texture_thesis

    human = load_human(path)
    rotations = np.tile([0.0, 0.0, 0.0, 1.0], (len(human.skeleton), 1))
    for name, turn in POSE.items():
        rotations[human.skeleton.names.index(name)] = matrix_to_quaternion(
            rotation_vector_to_matrix(np.array(turn))
        )
    upright = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    posed = human.skeleton.pose(rotations, upright)
    vertices = human.pose(posed)
    cameras = [looking(2 * np.pi * (n + 0.5) / 8, 1.2 + 0.5 * (n % 2)) for n in range(8)]
    new = [looking(angle, 1.4) for angle in NEW_VIEWS]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        images = render_in_blender(blender, renders / human.name, human, vertices, cameras + new)
        photographs, truth = images[:8], images[8:]
        _, faces = ours(human, vertices, cameras + new)
        rng = np.random.default_rng(1)
        for count in (4, 8):
            chosen = range(0, 8, 8 // count)
            used = {f"view_{n}": cameras[n] for n in chosen}
            for case, start in CASES.items():
                gains = np.exp(rng.uniform(-1, 1, (count, 3)) * np.log(1.25)) ** (case == "other colours")
                gains /= np.exp(np.log(gains).mean(axis=0))
                read = write_photographs(folder, used, used, [photographs[n] for n in chosen], gains)
                body, shape = human, vertices
                masks = [None if start is None else faces[n] > 0 for n in chosen]
                if start is not None:
                    known = posed, vertices, used, [faces[n] for n in chosen]
                    body, shape = fitted(folder, start or str(path.resolve()), human, *known)
                views = [
                    TextureView(each, camera, image, shape, mask)
                    for (each, camera), image, mask in zip(used.items(), read, masks, strict=True)
                ]
                for method in (texture_thesis, texture_atlas):
                    person = method(body, views)
                    found, shown = ours(person.human, shape, new)
                    both = [(a > 0) & (b > 0) for a, b in zip(shown, faces[8:], strict=True)]
                    either = [(a > 0) | (b > 0) for a, b in zip(shown, faces[8:], strict=True)]
                    seen = [mask & person.seen[face - 1] for mask, face in zip(both, shown, strict=True)]
                    overlap = np.sum(both) / np.sum(either)
                    label = method.__name__.removeprefix("texture_")
                    print(
                        f"| {human.name} | {count} | {case} | {label} | {psnr(found, truth, both):.1f} | "
                        f"{psnr(found, truth, seen):.1f} | {overlap:.3f} |",
                        flush=True,
                    )
                    if output is not None:
                        rows = np.vstack([np.hstack(truth), np.hstack(found)])
                        file = f"{human.name}_{count}_{case.replace(' ', '_')}_{label}.jpg"
                        cv2.imwrite(str(output / file), rows[..., ::-1])


# in the Python of Blender


def render(scene_file: Path, folder: Path) -> None:
    """Render the figure of a file from all its cameras."""
    import bpy
    from masks import set_camera
    from mathutils import Vector
    from path_traced_picture import add_sky

    data = np.load(scene_file)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    eye = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(eye)
    scene.camera = eye
    mesh = bpy.data.meshes.new("figure")
    mesh.from_pydata(data["vertices"].tolist(), [], data["triangles"].tolist())
    mesh.polygons.foreach_set("use_smooth", [True] * len(mesh.polygons))
    material = bpy.data.materials.new("figure")
    material.use_nodes = True
    (dress if "colors" in data.files else paint)(material.node_tree, mesh, data)
    mesh.materials.append(material)
    scene.collection.objects.link(bpy.data.objects.new("figure", mesh))
    floor = bpy.data.meshes.new("floor")
    floor.from_pydata([(-6, -6, 0), (6, -6, 0), (6, 6, 0), (-6, 6, 0)], [], [(0, 1, 2, 3)])
    scene.collection.objects.link(bpy.data.objects.new("floor", floor))
    lamp = bpy.data.lights.new("sun", "SUN")
    lamp.energy, lamp.angle = 1.2, 0.2
    sun = bpy.data.objects.new("sun", lamp)
    sun.rotation_mode = "QUATERNION"
    sun.rotation_quaternion = Vector((0.4, 0.5, 0.8)).to_track_quat("Z", "Y")
    scene.collection.objects.link(sun)
    add_sky(scene, np.array([0.5, 0.5, 0.5]), np.array([0.3, 0.3, 0.3]))
    scene.render.engine = "CYCLES"
    scene.cycles.device = "CPU"
    scene.cycles.samples = SAMPLES
    scene.cycles.use_denoising = True
    scene.cycles.max_bounces = 2
    scene.view_settings.view_transform = "Standard"
    scene.render.use_border, scene.render.use_persistent_data = True, True
    scene.render.image_settings.file_format = "PNG"
    for number, view in enumerate(zip(data["K"], data["R"], data["t"], data["size"], strict=True)):
        set_camera(*view)
        (left, top), (right, bottom) = np.clip(data["boxes"][number] / view[3], 0, 1)
        scene.render.border_min_x, scene.render.border_max_x = left, right
        scene.render.border_min_y, scene.render.border_max_y = 1 - bottom, 1 - top
        scene.render.filepath = str(folder / f"{number}.png")
        bpy.ops.render.render(write_still=True)


def paint(tree, mesh, data) -> None:
    """Set up a slightly glossy material with the texture of the figure."""
    import bpy

    texture = data["texture"]
    mesh.uv_layers.new().data.foreach_set("uv", data["uv"].ravel())
    height, width = texture.shape[:2]
    image = bpy.data.images.new("texture", width, height)
    whole = np.ones((height, width, 4), np.float32)
    whole[..., :3] = texture[::-1] / 255
    image.pixels.foreach_set(whole.ravel())
    node = tree.nodes.new("ShaderNodeTexImage")
    node.image = image
    _finish(tree, node.outputs["Color"])


def dress(tree, mesh, data) -> None:
    """Set up a slightly glossy material with the colours of vertices and a pattern at rest."""
    colors = mesh.color_attributes.new("clothes", "FLOAT_COLOR", "POINT")
    colors.data.foreach_set("color", np.pad(data["colors"], [(0, 0), (0, 1)], constant_values=1).ravel())
    rest = mesh.attributes.new("rest", "FLOAT_VECTOR", "POINT")
    rest.data.foreach_set("vector", data["rest"].astype(np.float32).ravel())
    clothes, place = (tree.nodes.new("ShaderNodeAttribute") for _ in range(2))
    clothes.attribute_name, place.attribute_name = "clothes", "rest"
    cells = tree.nodes.new("ShaderNodeTexVoronoi")
    cells.inputs["Scale"].default_value = 18.0
    mix = tree.nodes.new("ShaderNodeMixRGB")
    mix.blend_type = "SOFT_LIGHT"
    mix.inputs[0].default_value = 0.8
    tree.links.new(place.outputs["Vector"], cells.inputs["Vector"])
    tree.links.new(clothes.outputs["Color"], mix.inputs[1])
    tree.links.new(cells.outputs["Color"], mix.inputs[2])
    _finish(tree, mix.outputs[0])


def _finish(tree, color) -> None:
    surface = tree.nodes["Principled BSDF"]
    surface.inputs["Roughness"].default_value = 0.7
    surface.inputs["Specular IOR Level"].default_value = 0.2
    tree.links.new(color, surface.inputs["Base Color"])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("figures", nargs="*", type=Path)
    parser.add_argument("--blender", help="a Python that has bpy")
    parser.add_argument("-o", "--output", type=Path, help="write pictures of the results there")
    parser.add_argument(
        "--renders", type=Path, help="keep the images of Blender there, and use those that are there"
    )
    parser.add_argument("--render", nargs=2, type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.render:
        render(*arguments.render)
        return
    sys.path.insert(0, str(ROOT))
    warnings.simplefilter("ignore")
    print("| figure | views | case | method | both, dB | seen, dB | IoU |\n|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as temporary:
        for path in arguments.figures:
            evaluate(path, arguments.blender, arguments.renders or Path(temporary), arguments.output)


if __name__ == "__main__":
    main()
