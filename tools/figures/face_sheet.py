"""Draw the expressions of built-in humans: one row per human, one column per expression.

python tools/figures/face_sheet.py OUT.jpg [BODY ...]
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))

from humansim_ros.cameras import Camera  # noqa: E402
from humansim_ros.geometry import WORLD_FROM_BODY, transform  # noqa: E402
from humansim_ros.motion.body.face import EXPRESSIONS, expression  # noqa: E402
from humansim_ros.people.loading.loading import load_human  # noqa: E402
from humansim_ros.render import Body, GLRenderer, Lighting  # noqa: E402
from humansim_ros.render.pictures import title_bar  # noqa: E402
from humansim_ros.types import Image  # noqa: E402

SIZE = (260, 310)


def row(renderer: GLRenderer, body: str) -> Image:
    """Draw one human with all expressions."""
    human = load_human(body)
    posed = transform(WORLD_FROM_BODY, np.zeros(3)) @ human.skeleton.rest
    eye = posed[human.skeleton.bone("l_eyeball_joint"), :3, 3]
    face = np.array([eye[0] - 0.04, 0.0, eye[2] - 0.03])
    camera = Camera.look_at(face + np.array([0.72, 0.19, 0.04]), face, SIZE, np.radians(22))
    tiles = []
    for name in EXPRESSIONS:
        bodies = [Body(human.mesh, human.pose(posed, expression(name)), human.triangle_parts, 1)]
        picture = renderer.render(bodies, camera, ("rgb",)).rgb
        tiles.append(np.concatenate([title_bar(name, SIZE[0]), picture]))
    return np.concatenate(tiles, axis=1)


def main() -> None:
    if not sys.argv[1:]:
        raise SystemExit(__doc__)
    renderer = GLRenderer([], Lighting(background=(238, 240, 243)))
    rows = [row(renderer, body) for body in sys.argv[2:] or ["adult_woman", "adult_man"]]
    cv2.imwrite(sys.argv[1], np.concatenate(rows)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])


if __name__ == "__main__":
    main()
