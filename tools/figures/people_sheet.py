"""Draw people by seed, all at one scale: ``python tools/figures/people_sheet.py OUT.jpg [COUNT [SEED]]``."""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))

from humansim_ros.cameras import Camera  # noqa: E402
from humansim_ros.motion import read_motion  # noqa: E402
from humansim_ros.motion.pose.retarget import Retargeter  # noqa: E402
from humansim_ros.motion.pose.world_motion import to_world  # noqa: E402
from humansim_ros.people import load_human  # noqa: E402
from humansim_ros.render import Body, GLRenderer, Lighting  # noqa: E402
from humansim_ros.types import Image  # noqa: E402

#: Size of a picture, pixels; pictures in a row; where the camera is, metres.
SIZE, COLUMNS, EYE = (120, 240), 10, (9.0, 3.4, 1.3)
PAPER = (244, 244, 242)


def standing(renderer: GLRenderer, name: str, time: float) -> Image:
    """A person, by its name, at a time of the motion ``stand``."""
    human = load_human(name)
    world = to_world(read_motion("stand"))
    retargeter = Retargeter.fit(world, human.skeleton)
    vertices = human.pose(retargeter.pose(world.sample(time))[0])
    vertices[:, :2] -= (vertices[:, :2].min(axis=0) + vertices[:, :2].max(axis=0)) / 2
    camera = Camera.look_at(EYE, (0.0, 0.0, 0.98), SIZE, float(np.radians(6.4)))
    body = Body(human.mesh, vertices, human.triangle_parts, 1)
    return renderer.render([body], camera, ("rgb",)).rgb


def main() -> None:
    out, count, seed = (*sys.argv[1:], *("", "50", "7")[len(sys.argv) - 1 :])
    renderer = GLRenderer([], Lighting(sun=(0.5, 0.3, 0.8), background=PAPER))
    pictures = [standing(renderer, f"person#{seed}-{k}", 0.7 * k % 3) for k in range(int(count))]
    renderer.close()
    rows = [np.concatenate(pictures[k : k + COLUMNS], axis=1) for k in range(0, len(pictures), COLUMNS)]
    cv2.imwrite(out, np.concatenate(rows)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])


if __name__ == "__main__":
    main()
