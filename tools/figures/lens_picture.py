"""Draw the demo scene with four lenses and the true positions of the joints (docs/images/lenses.jpg).

python tools/figures/lens_picture.py OUTPUT
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from humansim_ros.cameras import Camera  # noqa: E402
from humansim_ros.people import joint_surfaces  # noqa: E402
from humansim_ros.render import GLRenderer  # noqa: E402
from humansim_ros.scene import (  # noqa: E402
    Scene,
    view_joints,
)
from humansim_ros.scene.pictures.views import draw_joints  # noqa: E402
from humansim_ros.types import Image  # noqa: E402

_SECONDS = 2.3
#: Coefficients, model, and focal length in pixels of a 640x480 image, by title.
_LENSES = {
    "ideal": ((), None, 430.0),
    "barrel: plumb_bob, k1 -0.36, k2 0.11": ((-0.361976, 0.110510, 0.001014, 0.000505, 0.0), None, 430.0),
    "pincushion: plumb_bob, k1 0.35": ((0.35, 0.0, 0.0, 0.0, 0.0), None, 430.0),
    "fisheye: equidistant": ((-0.013, 0.021, -0.0031, 0.0004), "equidistant", 205.0),
}


def draw(scene: Scene, renderer: GLRenderer, title: str) -> Image:
    coefficients, model, focal = _LENSES[title]
    there = next(iter(scene.cameras.values()))
    k = np.array([[focal, 0, 319.5], [0, focal, 239.5], [0, 0, 1]])
    camera = Camera(there.size, k, there.R, there.t, coefficients, model)
    actor = next(iter(scene.actors.values()))
    state = actor.at(_SECONDS)
    view = renderer.render([actor.body(state.vertices)], camera)
    joints = view_joints(camera, state.positions, view, actor.instance, joint_surfaces(actor.human))
    skeleton = actor.human.skeleton
    parents = [None if p < 0 else skeleton.names[p] for p in skeleton.parents]
    parents += [skeleton.names[bone] for bone in skeleton.ends]
    picture = draw_joints(view.rgb, joints.pixels, joints.visible, state.joint_names, parents)
    out = cv2.copyMakeBorder(picture, 26, 4, 4, 4, cv2.BORDER_CONSTANT, value=(28, 28, 28))
    cv2.putText(out, title, (8, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (235, 235, 235), 1, cv2.LINE_AA)
    return out


def main() -> int:
    if len(sys.argv) != 2:
        print(__doc__)
        return 2
    scene = Scene.load()
    renderer = GLRenderer(scene.static_meshes)
    tiles = [draw(scene, renderer, title) for title in _LENSES]
    sheet = np.concatenate([np.concatenate(tiles[:2], axis=1), np.concatenate(tiles[2:], axis=1)])
    cv2.imwrite(sys.argv[1], sheet[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 80])
    return 0


if __name__ == "__main__":
    sys.exit(main())
