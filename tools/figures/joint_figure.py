"""Draw a person from the front with its joints and their names (docs/images/joints.png).

python tools/figures/joint_figure.py docs/images/joints.png
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from humansim_ros import Camera, Scene, Simulation, load_human  # noqa: E402
from humansim_ros.geometry import WORLD_FROM_BODY, transform  # noqa: E402
from humansim_ros.motion import (  # noqa: E402
    Skeleton,
    hanim_skeleton,
    load_limits,
)
from humansim_ros.motion.body.skeleton import (  # noqa: E402
    JOINT_NAMES,
    JointName,
    finger_bones,
    side_of,
)
from humansim_ros.render import Body, GLRenderer, Lighting  # noqa: E402
from humansim_ros.render.pictures import (  # noqa: E402
    INK,
    PAPER,
    SIDE_COLORS,
    draw_disc,
    draw_line,
    draw_text,
    text_size,
    write_png,
)
from humansim_ros.types import Array, Image  # noqa: E402

_SIZE = (1180, 860)
#: Size of the picture of a hand beside the person.
_HAND = (430, 310)
#: Seconds of the motion t_to_a_pose at which the arms are 45 degrees down.
_A_POSE = 2.0
_GAP = 36
_COLUMNS = {-1: 240, 1: 940}


def person() -> tuple[Image, dict[str, Array], Skeleton]:
    """Image of a person from the front, pixels of its joints by name, and its skeleton."""
    camera = {"size": list(_SIZE), "position": [12, 0, 0.86], "look_at": [0, 0, 0.86], "fov_deg": 12.0}
    scene = Scene.from_dict(
        {
            "room": None,
            "world": {"background": list(PAPER)},
            "light": {"shadows": "none"},
            "humans": {"anna": {"body": "adult_woman", "motion": "t_to_a_pose"}},
            "cameras": {"front": camera},
        }
    )
    with Simulation(scene, channels=("rgb",)) as simulation:
        frame = simulation.frame(round(_A_POSE * scene.config.rate))
    human = frame.humans["anna"]
    pixels, _ = frame.cameras["front"].project(human.positions)
    image = np.asarray(255 - (255 - frame.views["front"].rgb) * 0.42, dtype=np.uint8)
    return image, dict(zip(human.joint_names, pixels, strict=True)), scene.actors["anna"].human.skeleton


def bones_of(skeleton: Skeleton) -> list[tuple[str, str]]:
    """Bones as pairs of joints: from a parent, and to the end of a bone."""
    connections = {row.name for row in JOINT_NAMES if row.place.startswith("as ")}
    bones = [
        (skeleton.names[parent], name)
        for name, parent in zip(skeleton.names, skeleton.parents, strict=True)
        if parent >= 0 and name not in connections  # their first end is that of another bone
    ]
    return bones + [(skeleton.names[leaf], f"{skeleton.names[leaf]}_end") for leaf in skeleton.ends]


def hand() -> Image:
    """The straight left hand from above, and the names of its joints."""
    human = load_human("adult_woman")
    skeleton = human.skeleton
    rotations = np.tile([0.0, 0.0, 0.0, 1.0], (len(skeleton), 1))
    angles = load_limits(skeleton=skeleton).angles(rotations[None])
    for bone in finger_bones("l"):
        degrees = -angles[f"{bone}.flexion"][0]
        rotations[skeleton.bone(bone)] = Rotation.from_euler("x", degrees, degrees=True).as_quat()
    posed = skeleton.pose(rotations, transform(WORLD_FROM_BODY, np.zeros(3)))
    places = dict(zip(skeleton.joint_names, skeleton.joint_transforms(posed)[:, :3, 3], strict=True))
    middle = (places["l_wrist"] + places["l_wrist_end"]) / 2
    # seen from above, with the fingers to the right
    above = middle + np.array([0.0, 0.0, 0.6])
    camera = Camera.look_at(above, middle, _HAND, np.radians(30.0), up=(-1, 0, 0))
    renderer = GLRenderer([], Lighting(background=PAPER))
    body = Body(human.mesh, human.pose(posed), human.triangle_parts, 1)
    image = np.asarray(255 - (255 - renderer.render([body], camera, ("rgb",)).rgb) * 0.42, dtype=np.uint8)
    renderer.close()
    own = [name for name in places if name.removesuffix("_end") in finger_bones("l")]
    pixels = {name: camera.project(places[name][None])[0][0] for name in (*own, "l_wrist")}
    for parent, name in bones_of(skeleton):
        if name in own:
            draw_line(image, [pixels[parent], pixels[name]], SIDE_COLORS[1], 2)
    for pixel in pixels.values():
        draw_disc(image, pixel, 4, SIDE_COLORS[1])
    for name in own:
        if name.endswith("_end"):
            x, y = pixels[name].tolist()
            draw_text(image, name, (round(x) + 8, round(y) + 4), 0.42, INK)
    return image


def label(row: JointName) -> tuple[str, str]:
    return row.name, row.place.split(":")[0].split(",")[0]


def draw() -> Image:
    image, pixels, skeleton = person()
    general = hanim_skeleton().joint_names
    for parent, name in bones_of(skeleton):
        if name in general:
            draw_line(image, [pixels[parent], pixels[name]], SIDE_COLORS[side_of(name)], 3)
    for name in general:
        draw_disc(image, pixels[name], 5, SIDE_COLORS[side_of(name)])
    image[-_HAND[1] - 70 : -70, : _HAND[0]] = hand()
    for side, column in _COLUMNS.items():
        # the trunk on the right of the person, which is on the left of the image; the left side opposite
        rows = [row for row in JOINT_NAMES if side_of(row.name) == (1 if side > 0 else 0)]
        rows = [row for row in rows if row.name in general and not row.place.startswith("as ")]
        rows.sort(key=lambda row: pixels[row.name][1])
        heights = spread([pixels[row.name][1] for row in rows])
        for row, height in zip(rows, heights, strict=True):
            draw_line(image, [pixels[row.name], (column - 14 * side, height)], (120, 124, 132))
            draw_line(image, [(column - 14 * side, height), (column - 4 * side, height)], (120, 124, 132))
            for text, scale, drop in zip(label(row), (0.55, 0.45), (2, 18), strict=True):
                left = column if side > 0 else column - text_size(text, scale)[0]
                draw_text(
                    image, text, (left, round(height) + drop), scale, INK if drop == 2 else (96, 100, 108)
                )
    texts = ("Joints of the right side begin with r_.", "<name>_end is the end of a bone.")
    for number, text in enumerate(texts):
        draw_text(image, text, (16, _SIZE[1] - 40 + 22 * number), 0.45, (96, 100, 108))
    return image


def spread(heights: list[float]) -> list[float]:
    """Heights of labels near those wanted (sorted), at least a gap apart."""
    out = np.array(heights)
    for _ in range(200):
        for number in range(1, len(out)):
            overlap = _GAP - (out[number] - out[number - 1])
            if overlap > 0:
                out[number - 1] -= overlap / 2
                out[number] += overlap / 2
    return list(np.clip(out, 20, _SIZE[1] - 26))


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    write_png(sys.argv[1], draw())
