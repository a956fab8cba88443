"""Draw humans in poses of motions, for visual inspection: one row per human, the rest pose first.

    python tools/figures/body_sheet.py OUT.jpg [BODY ...]

A BODY is a built-in human, or a file of a human. Without BODY, all built-in humans are drawn.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))

from humansim_ros.cli.human import built_in_humans  # noqa: E402
from humansim_ros.files.reading.assets import find_asset  # noqa: E402
from humansim_ros.motion import read_motion  # noqa: E402
from humansim_ros.motion.pose.world_motion import to_world  # noqa: E402
from humansim_ros.people.loading.loading import load_human  # noqa: E402
from humansim_ros.scene.pictures.people import HumanArtist, SkinnedArtist  # noqa: E402
from humansim_ros.types import Image  # noqa: E402

SIZE = (230, 300)
SHOTS = (("walk", 0.25), ("walk", 0.75), ("run", 0.3), ("sit_stand", 2.0), ("pick_up", 1.2), ("wave", 1.4))


def row(body: str) -> Image:
    """Draw one human in all poses."""
    human = load_human(find_asset(body, "humans"))
    artist = HumanArtist(human, SIZE)
    pictures = [artist.draw(human, 30)]
    artist.close()
    for motion, time in SHOTS:
        world = to_world(read_motion(ROOT / "assets" / "motions" / f"{motion}.bvh"))
        skinned = SkinnedArtist(human, world, SIZE)
        pictures.append(skinned.draw(time))
        skinned.close()
    cv2.putText(
        pictures[0], human.name, (8, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (60, 64, 72), 1, cv2.LINE_AA
    )
    return np.concatenate(pictures, axis=1)


def main() -> None:
    out, *bodies = sys.argv[1:]
    sheet = np.concatenate([row(body) for body in bodies or built_in_humans()])
    cv2.imwrite(out, sheet[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])


if __name__ == "__main__":
    main()
