"""Render bent and twisted limbs with both skinning methods (docs/images/skinning.jpg).

python tools/figures/skinning_picture.py OUTPUT [HUMAN]
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
from deformation_figures import BENDS, ROOT, bent, volume_change

from humansim_ros.cameras import Camera
from humansim_ros.files.mesh.mesh import Mesh
from humansim_ros.geometry import WORLD_FROM_BODY
from humansim_ros.motion.body.skinning import SKINNERS, make_skinner
from humansim_ros.people.humans.human import Human
from humansim_ros.people.loading.loading import load_human
from humansim_ros.render import Body, GLRenderer, Lighting
from humansim_ros.types import Image

_SIZE = (360, 330)
_LIMBS = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
#: Offset of the body, far above the floor.
_UP = np.array([0.0, 0.0, 10.0])
#: Position and target of the camera relative to the joint (x front, y left, z up), metres.
_VIEWS = {
    "elbow 90": ((-0.1, 0.0, 0.9), (0.08, -0.02, 0.0)),
    "knee 90": ((0.15, 1.1, 0.25), (-0.03, 0.0, -0.02)),
    "forearm twisted 90": ((0.9, 0.0, 0.25), (0.0, 0.0, 0.0)),
}


def draw(human: Human, renderer: GLRenderer, bend: str, method: str) -> Image:
    bone, axis, degrees = BENDS[bend]
    skinner = make_skinner(method, human.mesh.vertices, human.weights)
    vertices = skinner(bent(human, bone, axis, degrees)) @ WORLD_FROM_BODY.T.astype(np.float32)
    vertices = (vertices + _UP).astype(np.float32)
    left = [human.skeleton.bone(f"l_{limb}") + 1 for limb in _LIMBS]
    shown = np.isin(human.triangle_parts, left)
    faces = np.pad(human.mesh.triangles[shown], [(0, 0), (0, 1)], constant_values=-1)
    clay = np.full((len(vertices), 3), (206, 172, 146), np.uint8)
    mesh = Mesh(human.mesh.vertices, faces, colors=clay)
    joint = WORLD_FROM_BODY @ human.skeleton.heads[human.skeleton.bone(bone)] + _UP
    away, beside = _VIEWS[bend]
    target = joint + beside
    camera = Camera.look_at(tuple(target + away), tuple(target), _SIZE, float(np.radians(26)))
    view = renderer.render([Body(mesh, vertices, human.triangle_parts[shown], 1)], camera, ("rgb",))
    change = volume_change(human, bone, axis, degrees, method)
    text = f"{bend} degrees, {method.replace('_', ' ')}: {100 * change:+.1f} %"
    cv2.putText(view.rgb, text, (8, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (40, 44, 52), 1, cv2.LINE_AA)
    return view.rgb


def main() -> int:
    human = load_human(Path(sys.argv[2]) if len(sys.argv) > 2 else ROOT / "assets/humans/adult_man.npz")
    human = human.without_details()  # hands are shown with their fingers
    renderer = GLRenderer([], Lighting(background=(238, 240, 243)))
    rows = [
        np.concatenate([draw(human, renderer, bend, method) for bend in _VIEWS], axis=1)
        for method in SKINNERS
    ]
    picture = cv2.cvtColor(np.concatenate(rows), cv2.COLOR_RGB2BGR)
    cv2.imwrite(sys.argv[1], picture, [cv2.IMWRITE_JPEG_QUALITY, 90])
    return 0


if __name__ == "__main__":
    sys.exit(main())
