"""Draw open mouths of built-in humans (docs/images/mouths.jpg).

python tools/figures/mouth_picture.py OUT.jpg
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
from humansim_ros.people.loading.loading import load_human  # noqa: E402
from humansim_ros.people.makehuman.face import with_mouth  # noqa: E402
from humansim_ros.render import Body, GLRenderer, Lighting  # noqa: E402
from humansim_ros.render.pictures import title_bar  # noqa: E402

SIZE = (260, 260)
_SMILE = {f"{name}{side}": 0.7 for side in ("Left", "Right") for name in ("mouthSmile", "mouthUpperUp")}
FACES: dict[str, tuple[str, dict[str, float]]] = {
    "jawOpen 0.8": ("adult_woman", {"jawOpen": 0.8}),
    "a laugh": ("adult_man", {"jawOpen": 0.35, **_SMILE}),
    "tongueOut 1": ("child", {"jawOpen": 0.5, "tongueOut": 1.0}),
    "a vowel": ("tall_heavy_man", {"jawOpen": 0.55, "mouthFunnel": 0.3}),
}


def main() -> None:
    if len(sys.argv) != 2:
        raise SystemExit(__doc__)
    renderer, tiles = GLRenderer([], Lighting(background=(238, 240, 243))), []
    for title, (body, face) in FACES.items():
        human = with_mouth(load_human(body))
        posed = transform(WORLD_FROM_BODY, np.zeros(3)) @ human.skeleton.rest
        eye = posed[human.skeleton.bone("l_eyeball_joint"), :3, 3]
        middle = np.array([eye[0] - 0.04, 0.0, eye[2] - 0.065])
        camera = Camera.look_at(middle + np.array([0.72, 0.19, 0.02]), middle, SIZE, np.radians(13))
        bodies = [Body(human.mesh, human.pose(posed, face), human.triangle_parts, 1)]
        picture = renderer.render(bodies, camera, ("rgb",)).rgb
        tiles.append(np.concatenate([title_bar(title, SIZE[0]), picture]))
    cv2.imwrite(sys.argv[1], np.concatenate(tiles, axis=1)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 86])


if __name__ == "__main__":
    main()
