"""Draw every keypoint set on a built-in human (docs/images/keypoints.jpg), or close views of all of them.

Also the points of Face Mesh on some of them.

python tools/figures/keypoint_figure.py docs/images/keypoints.jpg
python tools/figures/keypoint_figure.py --close docs/images/keypoints_close.jpg
python tools/figures/keypoint_figure.py --mesh docs/images/face_mesh.jpg
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from humansim_ros import Scene, Simulation, load_human  # noqa: E402
from humansim_ros.files.reading.assets import built_in_names  # noqa: E402
from humansim_ros.geometry import WORLD_FROM_BODY  # noqa: E402
from humansim_ros.motion.body.skeleton import side_of  # noqa: E402
from humansim_ros.people import KEYPOINT_SETS, KeypointLocator, KeypointSet  # noqa: E402
from humansim_ros.render.pictures import (  # noqa: E402
    INK,
    PAPER,
    SIDE_COLORS,
    draw_disc,
    draw_line,
    draw_text,
)
from humansim_ros.scene import (  # noqa: E402
    VISIBLE,
    Frame,
)
from humansim_ros.types import Image  # noqa: E402

_SIZE = (520, 620)
#: Seconds of the motion t_to_a_pose at which the arms are 45 degrees down.
_A_POSE = 2.0
_CAMERAS = {"front": (7.6, 2.6, 1.2), "back": (-7.6, 2.6, 1.2)}
#: Sets of the whole body, drawn from afar, and those of its parts, drawn close.
_PARTS = {"face68": 0.27, "left_hand21": 0.24, "right_hand21": 0.24}
_WHOLE = [name for name in KEYPOINT_SETS if name not in (*_PARTS, "face70", "face468")]
_CHANNELS = ("rgb", "depth", "instance", "part")


def simulate(body: str, cameras: dict[str, dict[str, object]], seconds: float) -> Frame:
    """A human at a time of the motion t_to_a_pose, without a room."""
    scene = Scene.from_dict(
        {
            "room": None,
            "world": {"background": list(PAPER)},
            "light": {"shadows": "none"},
            "humans": {"man": {"body": body, "motion": "t_to_a_pose"}},
            "cameras": cameras,
        }
    )
    with Simulation(scene, channels=_CHANNELS) as simulation:
        return simulation.frame(round(seconds * scene.config.rate))


def close_up(body: str, sets: dict[str, str]) -> list[Image]:
    """Close views of a built-in human with keypoint sets: face from the front and the side, left hand."""
    human = load_human(body)
    joints = human.skeleton.joint_transforms(human.skeleton.rest)[:, :3, 3]
    cameras = {}
    for name, keypoints, away in (
        ("face", "face68", (1.0, 0.0, 0.0)),
        ("half_face", "face68", (0.8, 0.6, 0.0)),
        ("hand", "left_hand21", (0.5, 0.1, 1.0)),
    ):
        chosen = KEYPOINT_SETS[keypoints]
        places = KeypointLocator.of(human, chosen).positions(joints, human.mesh.vertices)
        middle = (places.max(axis=0) + places.min(axis=0)) / 2 @ WORLD_FROM_BODY.T
        fov = 2 * np.degrees(np.arctan(_PARTS[keypoints] / 4))
        position = middle + 2 * np.array(away) / np.linalg.norm(away)
        cameras[name] = {
            "size": [_SIZE[0], _SIZE[0]],
            "position": position.round(4).tolist(),
            "look_at": middle.round(4).tolist(),
            "fov_deg": float(fov),
        }
    frame = simulate(body, cameras, 0.0)
    return [draw(frame, KEYPOINT_SETS[name], camera, 1) for camera, name in sets.items()]


def side(point: str) -> int:
    """Side of an anatomical point: 1 left, -1 right, 0 middle."""
    return 1 if point.startswith("left_") else -1 if point.startswith("right_") else side_of(point)


def draw(frame: Frame, keypoints: KeypointSet, camera: str, size: int = 2) -> Image:
    """One panel: visible keypoints are discs, others are rings. ``size``: width of the lines, pixels."""
    dot = size + 3 if len(keypoints) < 200 else size + 1
    rgb = frame.views[camera].rgb
    image = np.asarray(255 - (255 - rgb) * 0.5, dtype=np.uint8)
    view = frame.keypoints[keypoints.name][camera]["man"]
    sides = [side(point) for point in keypoints.points]
    for first, second in keypoints.edges:
        color = SIDE_COLORS[sides[first] if sides[first] == sides[second] else 0]
        draw_line(image, [view.pixels[first], view.pixels[second]], color, size)
    for pixel, state, which in zip(view.pixels, view.visible, sides, strict=True):
        draw_disc(image, pixel, dot, SIDE_COLORS[which])
        if state != VISIBLE:
            draw_disc(image, pixel, dot - 2, PAPER)
    title = keypoints.name + (" (from behind)" if camera == "back" else "")
    draw_text(image, title, (14, 26), 0.6, INK)
    return image


def main(path: str, mode: str) -> None:
    """Write the sheet."""
    if mode == "--mesh":
        faces = {"face": "face468", "half_face": "face468"}
        shown = [panel for body in ("adult_man", "child") for panel in close_up(body, faces)]
        rows = [cv2.resize(np.concatenate(shown, axis=1), None, fx=0.6, fy=0.6, interpolation=cv2.INTER_AREA)]
    elif mode == "--close":
        sets = {"face": "face68", "half_face": "face68", "hand": "left_hand21"}
        pictures = [np.concatenate(close_up(body, sets), axis=1) for body in built_in_names("humans")]
        rows = [
            np.asarray(cv2.resize(row, None, fx=0.6, fy=0.6, interpolation=cv2.INTER_AREA))
            for row in pictures
        ]
    else:
        cameras: dict[str, dict[str, object]] = {
            name: {"size": list(_SIZE), "position": list(position), "look_at": [0, 0, 0.92], "fov_deg": 11.5}
            for name, position in _CAMERAS.items()
        }
        frame = simulate("adult_man", cameras, _A_POSE)
        panels = [draw(frame, KEYPOINT_SETS[name], "front") for name in _WHOLE]
        panels.append(draw(frame, KEYPOINT_SETS["plug_in_gait"], "back"))
        panels += [np.full_like(panels[0], 255)] * (-len(panels) % 3)
        rows = [np.concatenate(panels[start : start + 3], axis=1) for start in range(0, len(panels), 3)]
    sheet = np.concatenate(rows)
    cv2.imwrite(path, sheet[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])


if __name__ == "__main__":
    modes = sys.argv[1:-1]
    if len(sys.argv) < 2 or modes not in ([], ["--close"], ["--mesh"]):
        sys.exit(__doc__)
    main(sys.argv[-1], *(modes or [""]))
