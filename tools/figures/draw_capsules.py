"""Draw the capsules by which self-penetration is measured (docs/images/capsules.jpg).

    python tools/figures/draw_capsules.py OUTPUT

Left: the start of a stride. Right: a hand inside the belly. Capsules that overlap are red.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping

import cv2
import numpy as np
import trimesh
from capsules import Capsules, fit_capsules, self_penetration
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from humansim_ros.cameras import Camera
from humansim_ros.files.mesh.mesh import Mesh
from humansim_ros.files.reading.assets import resource_path
from humansim_ros.geometry import WORLD_FROM_BODY, transform
from humansim_ros.people.humans.human import Human
from humansim_ros.people.loading.loading import load_human
from humansim_ros.render import Body, GLRenderer
from humansim_ros.types import Array

#: Rotations of bones about body axes (x left, y up, z front), degrees.
POSES: tuple[Mapping[str, tuple[str, list[float]]], ...] = (
    {
        "l_shoulder": ("zy", [-65, 25]),
        "r_shoulder": ("zy", [65, 10]),
        "l_elbow": ("y", [-25]),
        "r_elbow": ("y", [25]),
        "l_hip": ("x", [18]),
        "r_hip": ("x", [-22]),
        "l_knee": ("x", [12]),
    },
    {
        "l_shoulder": ("zx", [-70, 80]),
        "r_shoulder": ("z", [70]),
        "l_elbow": ("y", [-105]),
    },
)
BLUE, RED = (70, 130, 230), (230, 60, 50)


def posed_bones(human: Human, pose: Mapping[str, tuple[str, list[float]]]) -> Array:
    skeleton = human.skeleton
    rotations = np.tile([0.0, 0, 0, 1], (len(skeleton), 1))
    for name, (axes, degrees) in pose.items():
        bone = skeleton.bone(name)
        rest = Rotation.from_matrix(skeleton.rest[bone, :3, :3])
        turn = Rotation.from_euler(axes.upper(), degrees, degrees=True)
        rotations[bone] = (rest.inv() * turn * rest).as_quat()
    return skeleton.pose(rotations, transform(WORLD_FROM_BODY, np.zeros(3)))


def capsule_bodies(body: Capsules, posed: Array) -> list[Body]:
    depths = self_penetration(posed[None], body)[0]
    deep = set(body.pairs[depths > 0].ravel().tolist())
    starts, ends = body.axes(posed[None])
    out = []
    for number, (bone, start, end, radius) in enumerate(
        zip(body.bones, starts[0], ends[0], body.radii, strict=True), 2
    ):
        length = float(np.linalg.norm(end - start))
        shape = trimesh.creation.capsule(height=length, radius=float(radius), count=[32, 32])
        vertices = shape.vertices - shape.vertices.mean(0)
        way = (end - start) / length if length > 1e-6 else np.array([0.0, 0.0, 1.0])
        vertices = vertices @ trimesh.geometry.align_vectors([0, 0, 1], way)[:3, :3].T + (start + end) / 2
        faces = np.pad(shape.faces, [(0, 0), (0, 1)], constant_values=-1).astype(np.int32)
        colors = np.tile(np.array(RED if bone in deep else BLUE, np.uint8), (len(vertices), 1))
        parts = np.ones(len(faces), np.uint8)
        out.append(Body(Mesh(vertices, faces, colors=colors), vertices.astype(np.float32), parts, number))
    return out


def main() -> int:
    human = load_human(resource_path("assets/humans/adult_man.npz"))
    body = fit_capsules(human.skeleton, human.mesh, human.weights)
    renderer = GLRenderer()
    camera = Camera.look_at((3.4, 1.3, 1.3), (0, 0, 0.88), (560, 800), np.radians(24))
    panels: list[NDArray[np.uint8]] = []
    for pose in POSES:
        posed = posed_bones(human, pose)
        person = Body(human.mesh, human.pose(posed), human.triangle_parts, 1)
        images = [
            renderer.render(bodies, camera, ("rgb",)).rgb
            for bodies in ([person], capsule_bodies(body, posed))
        ]
        assert images[0] is not None and images[1] is not None
        panels.append(cv2.addWeighted(images[0], 0.45, images[1], 0.55, 0).astype(np.uint8))
    cv2.imwrite(sys.argv[1], np.concatenate(panels, axis=1)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])
    return 0


if __name__ == "__main__":
    sys.exit(main())
