"""Draw a contact sheet of a folder of BVH files: the default human in the middle frame of each motion.

python tools/figures/motion_sheet.py FOLDER -o sheet.jpg
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import cv2
import numpy as np

from humansim_ros.errors import HumansimError
from humansim_ros.motion.pose.reports import read_with_warnings
from humansim_ros.motion.pose.world_motion import to_world
from humansim_ros.people.loading.loading import load_human
from humansim_ros.scene.pictures.people import SkinnedArtist

ROOT = Path(__file__).resolve().parents[2]


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--output", "-o", type=Path, default=Path("sheet.jpg"))
    parser.add_argument("--columns", type=int, default=6)
    options = parser.parse_args()
    human = load_human(ROOT / "assets" / "humans" / "adult_man.npz")
    tiles = []
    for path in sorted(options.folder.glob("*.bvh")):
        motion, _ = read_with_warnings(path)
        try:
            world = to_world(motion)
        except HumansimError as error:
            print(f"skipped: {path.name}: {error.message[:80]}")
            continue
        person = SkinnedArtist(human, world, (200, 260))
        tile = np.ascontiguousarray(person.draw(motion.n_frames // 2 * motion.frame_time))
        person.close()
        cv2.putText(
            tile, path.stem[:26], (6, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.38, (60, 64, 72), 1, cv2.LINE_AA
        )
        tiles.append(tile)
    if not tiles:
        print(f"no motion of a person in {options.folder}")
        return 1
    tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % options.columns)
    rows = [np.concatenate(tiles[i : i + options.columns], 1) for i in range(0, len(tiles), options.columns)]
    cv2.imwrite(str(options.output), np.concatenate(rows)[..., ::-1])
    return 0


if __name__ == "__main__":
    sys.exit(main())
