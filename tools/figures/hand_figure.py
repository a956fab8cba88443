"""Draw the hand poses, each from the palm and from the side of the thumb (docs/images/hand_poses.jpg).

python tools/figures/hand_figure.py OUTPUT [HUMAN]
"""

from __future__ import annotations

import sys

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.cameras import Camera
from humansim_ros.geometry import WORLD_FROM_BODY, transform
from humansim_ros.motion.pose.hand_poses import HAND_POSES, HandAnatomy, hand_angles
from humansim_ros.people import Human, load_human
from humansim_ros.render import Body, GLRenderer, Lighting
from humansim_ros.render.pictures import row
from humansim_ros.types import Array, Image

_SIZE = (250, 230)
#: Places of the camera relative to the right hand of a T pose, palm down (x front, y left, z up), metres.
_VIEWS = {"palm": (0.05, -0.1, -0.62), "thumb": (0.6, -0.12, 0.15)}
_UP = np.array([0.0, 0.0, 10.0])  # far above the floor


def posed(human: Human, angles: Array) -> NDArray[np.float32]:
    """Vertices (V, 3) of a human in its rest pose with posed hands, angles (30, 3) radians; z up."""
    anatomy = HandAnatomy.of(human.skeleton)
    assert anatomy is not None
    rotations = np.tile([0.0, 0.0, 0.0, 1.0], (len(human.skeleton), 1))
    rotations[anatomy.bones] = anatomy.rotations(angles)
    return human.pose(human.skeleton.pose(rotations, transform(WORLD_FROM_BODY, _UP)))


def draw(human: Human, renderer: GLRenderer, pose: str, view: str) -> Image:
    """Picture of the right hand in a pose."""
    anatomy = HandAnatomy.of(human.skeleton)
    assert anatomy is not None
    vertices = posed(human, np.tile(hand_angles(pose, anatomy), (2, 1)))
    knuckle = WORLD_FROM_BODY @ human.skeleton.heads[human.skeleton.bone("r_middle1")] + _UP
    target = knuckle + np.array([0.0, -0.02, -0.01])
    size = (
        float(human.skeleton.lengths[[human.skeleton.bone(f"r_middle{n}") for n in (1, 2, 3)]].sum()) / 0.098
    )
    camera = Camera.look_at(tuple(target + size * np.array(_VIEWS[view])), tuple(target), _SIZE, 0.42)
    body = Body(human.mesh, vertices, human.triangle_parts, 1)
    return renderer.render([body], camera, ("rgb",)).rgb


def main() -> int:
    human = load_human(sys.argv[2] if len(sys.argv) > 2 else "adult_man")
    renderer = GLRenderer(
        [],
        Lighting(
            background=(238, 240, 243), sun=(0.3, -0.5, -0.2), sky_color=(0.6,) * 3, ground_color=(0.75,) * 3
        ),
    )
    poses = list(HAND_POSES)
    rows = []
    for some in (poses[:6], poses[6:]):
        for view in _VIEWS:
            images = [draw(human, renderer, pose, view) for pose in some]
            images += [np.full_like(images[0], 255)] * (6 - len(images))
            rows.append(row(images, [*some, *[""] * (6 - len(some))]))
    renderer.close()
    cv2.imwrite(
        sys.argv[1], cv2.cvtColor(np.concatenate(rows), cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 88]
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
