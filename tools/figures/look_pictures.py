#!/usr/bin/env python3
"""Render the images of docs/look.md: light, shadows, environments, backgrounds, randomised scenes.

    python tools/figures/look_pictures.py [-o docs/images]

The assets of the scenes (a courtyard as .glb, a sky as .hdr, a photograph) are generated here.
"""

import argparse
import json
import struct
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from humansim_ros.cameras import Camera  # noqa: E402
from humansim_ros.files.mesh.mesh import height_to_normal_map  # noqa: E402
from humansim_ros.render import GLRenderer, Lighting  # noqa: E402
from humansim_ros.scene import Scene, Simulation  # noqa: E402
from humansim_ros.scene.features.room.feature import furnished_room  # noqa: E402

PEOPLE = """\
humans:
  anna: {body: adult_woman, motion: {file: wave, position: [0.2, -0.2], yaw_deg: -20}}
  walker: {motion: {file: walk, position: [-0.6, 0.9], yaw_deg: 10}}
cameras:
  corner: {size: [640, 480], position: [3.0, 2.3, 1.9], look_at: [-0.2, 0.2, 0.75], fov_deg: 58}
"""
FAR = "[3.0, 2.3, 1.9], look_at: [-0.2, 0.2, 0.75], fov_deg: 58"
NEAR = "[1.25, 2.0, 1.6], look_at: [-0.15, 0.6, 1.3], fov_deg: 52"
LOW_SUN = "sun: [0.5, -0.8, 0.75], sun_color: [1.5, 1.3, 1.0]"
SCENES = {
    "shadeless": "light: {mode: shadeless}",
    "contact": "",
    "soft": "light: {shadows: soft}",
    "matt": "light: {shadows: soft, materials: false}",
    "skin": "light: {shadows: soft}",
    "world": f"room: null\nlight: {{shadows: soft, tone_mapping: filmic, exposure: 0.3, {LOW_SUN}}}\n"
    "world: {meshes: [court.glb], environment: sky.hdr}",
    "photo": "room: null\nworld: {background: photo.jpg, shadow_catcher: true}\nlight: {shadows: soft}",
    "hdri": "room: null\nlight: {shadows: soft, sun: [0.5, -0.8, 0.75]}\n"
    "world: {environment: sky.hdr, meshes: [{file: ground.obj}]}",
    **{
        f"random_{seed}": f"light: {{shadows: soft}}\nrandomise: {{seed: {seed}, light: true, colours: true, "
        "textures: true, clutter: 5, camera_jitter: {position: 0.2, rotation_deg: 3}}"
        for seed in (1, 2, 4, 6)
    },
}


def court() -> bytes:
    """Courtyard as .glb, y up: paving, pillars of rough stone, a bronze ball, a glass pane, a lantern."""
    rng = np.random.default_rng(3)
    stone, paving = (
        np.clip(
            np.array(color)
            * (1 + 0.05 * cv2.GaussianBlur(rng.standard_normal((512, 512, 1)), (0, 0), 1.5)[..., None] * 3),
            0,
            255,
        ).astype(np.uint8)
        for color in ((186, 170, 146), (158, 150, 138))
    )
    for image, step in ((stone, 64), (paving, 128)):
        for line in range(4):
            image[line::step] = image[:, line::step] = (112, 104, 94)
    quads: dict[int, list] = {0: [], 1: [], 2: [], 3: [], 4: []}

    def box(low, high, material=1):
        for axis in range(3):
            for sign in (0, 1):
                u, v = [(1, 2), (2, 0), (0, 1)][axis]
                corners = []
                for a, b in ((0, 0), (1, 0), (1, 1), (0, 1)) if sign else ((0, 0), (0, 1), (1, 1), (1, 0)):
                    point = [0.0, 0.0, 0.0]
                    point[axis] = (low, high)[sign][axis]
                    point[u], point[v] = (low, high)[a][u], (low, high)[b][v]
                    corners.append((point, (point[u], point[v])))
                quads[material].append(corners)

    def ball(middle, radius, material):
        across, up = np.meshgrid(np.linspace(0, 2 * np.pi, 49), np.linspace(-np.pi / 2, np.pi / 2, 25))
        around = np.stack([np.cos(up) * np.sin(across), np.sin(up), np.cos(up) * np.cos(across)], axis=-1)
        for i in range(24):
            for j in range(48):
                at = [(i, j), (i, j + 1), (i + 1, j + 1), (i + 1, j)]
                quads[material].append([(middle + radius * around[a, b], (b / 12, a / 12)) for a, b in at])

    quads[0].append([((x, 0.0, z), (x, z)) for x, z in ((-8, 8), (8, 8), (8, -8), (-8, -8))])
    for i in range(-3, 4):
        for along in (0, 1):
            low, high = [(i - 0.22, 0.0, -4.0), (i + 0.22, 2.4, -3.4)]
            turn = (lambda p: p) if along else (lambda p: (p[2], p[1], p[0]))
            box(turn(low), turn(high))
    box((-4.0, 2.4, -4.0), (3.6, 3.1, -3.4))
    box((-4.0, 2.4, -3.4), (-3.4, 3.1, 3.6))
    box((-4.6, 0.0, -4.6), (3.6, 3.1, -4.5))
    box((-4.6, 0.0, -4.6), (-4.5, 3.1, 3.6))
    box((-1.75, 0.0, -0.35), (-1.15, 0.4, 0.25))
    ball(np.array([-1.45, 0.7, -0.05]), 0.3, 2)
    box((-2.2, 0.0, 0.2), (-2.17, 1.7, 1.6), 3)
    box((-3.3, 1.9, -0.55), (-3.1, 2.15, -0.35), 4)

    blob, views, accessors, primitives = b"", [], [], []

    def add(data: bytes) -> int:
        nonlocal blob
        blob += b"\0" * (-len(blob) % 4)
        views.append({"buffer": 0, "byteOffset": len(blob), "byteLength": len(data)})
        blob += data
        return len(views) - 1

    for material, faces in quads.items():
        rows = np.array([[*p, *uv] for quad in faces for p, uv in quad], "<f4")
        corners = np.arange(len(rows))
        if material == 2:  # shared vertices make the ball smooth
            rows, corners = np.unique(rows.round(5), axis=0, return_inverse=True)
        corners = corners.reshape(-1, 4)[:, [0, 1, 2, 0, 2, 3]]
        arrays = [
            ("VEC3", 5126, np.ascontiguousarray(rows[:, :3])),
            ("VEC2", 5126, rows[:, 3:] / 2),
            ("SCALAR", 5125, corners.ravel().astype("<u4")),
        ]
        for kind, component, array in arrays:
            view = add(array.tobytes())
            accessors.append(
                {"bufferView": view, "componentType": component, "count": len(array), "type": kind}
            )
        n = len(accessors)
        primitives.append(
            {
                "attributes": {"POSITION": n - 3, "TEXCOORD_0": n - 2},
                "indices": n - 1,
                "material": material,
            }
        )
    rough = height_to_normal_map(cv2.GaussianBlur(stone, (0, 0), 1.2)[..., 0], 10)
    images = [
        {"bufferView": add(cv2.imencode(".png", image[..., ::-1])[1].tobytes()), "mimeType": "image/png"}
        for image in (paving, stone, rough)
    ]
    matt = {"metallicFactor": 0, "roughnessFactor": 0.8}
    materials = [
        {"pbrMetallicRoughness": {**matt, "baseColorTexture": {"index": 0}}},
        {"pbrMetallicRoughness": {**matt, "baseColorTexture": {"index": 1}}, "normalTexture": {"index": 2}},
        {"pbrMetallicRoughness": {"baseColorFactor": [0.75, 0.48, 0.22, 1], "roughnessFactor": 0.3}},
        {
            "pbrMetallicRoughness": {
                "baseColorFactor": [0.45, 0.62, 0.6, 0.35],
                "metallicFactor": 0,
                "roughnessFactor": 0.1,
            },
            "alphaMode": "BLEND",
        },
        {
            "emissiveFactor": [0.7, 0.45, 0.12],
            "pbrMetallicRoughness": {**matt, "baseColorFactor": [0, 0, 0, 1]},
        },
    ]
    document = {
        "asset": {"version": "2.0"},
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": primitives}],
        "materials": materials,
        "textures": [{"source": n} for n in range(len(images))],
        "images": images,
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(blob)}],
    }
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    blob += b"\0" * (-len(blob) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(blob), b"BIN\0") + blob
    return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks


def sky(width: int = 4096) -> np.ndarray:
    """Panorama (H, W, 3) of linear light: sky, clouds, sun, hills, grass."""
    height = width // 2
    rng = np.random.default_rng(5)
    left = np.pi - 2 * np.pi * (np.arange(width) + 0.5) / width
    up = np.pi / 2 - np.pi * (np.arange(height)[:, None] + 0.5) / height
    view = np.stack(
        np.broadcast_arrays(np.cos(up) * np.cos(left), np.cos(up) * np.sin(left), np.sin(up)), axis=-1
    )
    height_of = np.clip(view[..., 2:], 0, 1) ** 0.5
    image = (1 - height_of) * np.array([0.75, 0.82, 0.9]) + height_of * np.array([0.16, 0.32, 0.72])
    noise = np.zeros((height, width))
    for size in (8, 16, 32, 64, 128):
        grid = rng.standard_normal((size // 2, size)).astype(np.float32)
        grid[:, -1] = grid[:, 0]
        noise += cv2.resize(grid, (width, height), interpolation=cv2.INTER_CUBIC) * 6 / size**0.9
    cloud = np.clip(noise, 0, 1)[..., None] * np.clip(4 * view[..., 2:], 0, 1)
    image = image * (1 - 0.8 * cloud) + 0.8 * cloud * 0.95
    sun = np.array([0.5, -0.8, 0.75]) / np.linalg.norm([0.5, -0.8, 0.75])
    near = np.clip(view @ sun, 0, 1)[..., None]
    image = image + 40 * (near > 0.9997) + 0.6 * near**200
    hills = 0.05 + 0.03 * np.sin(3 * left) + 0.02 * np.sin(7 * left + 1) + 0.008 * np.sin(31 * left)
    image = np.where((up < hills)[..., None], np.array([0.12, 0.2, 0.13]), image)
    image = cv2.GaussianBlur(image, (0, 0), 1.2)
    blades = cv2.GaussianBlur(rng.standard_normal((height, width)), (0, 0), 1.2)[..., None]
    grass = np.array([0.16, 0.2, 0.07]) * (1 + 0.3 * blades)
    image = np.where((up < 0)[..., None], grass, image)
    return np.asarray(np.maximum(image, 0), dtype=np.float32)


def photograph() -> np.ndarray:
    """Photograph of an empty hall from the pose of the scene's camera, slightly out of focus."""
    renderer = GLRenderer(furnished_room((9.0, 8.0, 3.2), seed=8), Lighting(shadows="soft"))
    camera = Camera.look_at((3.0, 2.3, 1.9), (-0.2, 0.2, 0.75), (1280, 960), np.radians(58))
    rgb = renderer.render([], camera, ("rgb",)).rgb
    renderer.close()
    return cv2.GaussianBlur(rgb, (0, 0), 1.5)


def take(folder: Path, name: str) -> np.ndarray:
    """Render an image (480, 640, 3), BGR, of a scene."""
    path = folder / f"{name}.yaml"
    people = PEOPLE.replace(FAR, NEAR) if name in ("matt", "skin") else PEOPLE
    path.write_text(people + SCENES[name] + "\n")
    simulation = Simulation(Scene.load(path), ("rgb",))
    rgb = simulation.frame(20).views["corner"].rgb
    simulation.close()
    return np.ascontiguousarray(rgb[..., ::-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs/images")
    output = parser.parse_args().output
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "court.glb").write_bytes(court())
        (folder / "ground.obj").write_text(
            "mtllib ground.mtl\nv -4 -4 0\nv 4 -4 0\nv 4 4 0\nv -4 4 0\nusemtl sand\nf 1 2 3 4\n"
        )
        (folder / "ground.mtl").write_text("newmtl sand\nKd 0.62 0.58 0.48\n")
        cv2.imwrite(str(folder / "sky.hdr"), sky()[..., ::-1])
        cv2.imwrite(str(folder / "photo.jpg"), photograph()[..., ::-1])
        seen = {name: take(folder, name) for name in SCENES}
    pictures = {
        name: seen[name]
        for name in ("shadeless", "contact", "soft", "matt", "skin", "world", "photo", "hdri")
    }
    random = [image for name, image in seen.items() if name.startswith("random")]
    pictures["randomised"] = cv2.resize(
        np.vstack([np.hstack(random[:2]), np.hstack(random[2:])]), (960, 720), interpolation=cv2.INTER_AREA
    )
    for name, image in pictures.items():
        cv2.imwrite(str(output / f"look_{name}.jpg"), image, [cv2.IMWRITE_JPEG_QUALITY, 88])


if __name__ == "__main__":
    main()
