"""Compare the joints that a pose detector finds in rendered images with the joints of the scene.

    python benchmarks/pose_detector.py [--python PATH] [--picture sheet.jpg] [--outfits all|first]
        [--size WIDTH HEIGHT] [--span PIXELS] [--people N | --photograph FILE --box LEFT TOP RIGHT BOTTOM]

Every built-in human walks in every outfit in the furnished room. It is rendered at four times from eight
sides, 340 pixels tall in images of 640x480. MediaPipe Pose (0.10.21, its model is in its wheel) processes the
images independently. Printed are the number of views with a detection, and the errors in pixels of shoulders,
elbows, wrists, hips, knees and ankles. MediaPipe needs NumPy 1 and runs in a virtual environment of its own:

    python3.12 -m venv detector && detector/bin/pip install mediapipe==0.10.21
    python benchmarks/pose_detector.py --python detector/bin/python

``--span`` renders people whose joints extend over so many rows of the image instead; ``--people`` renders as
many people by seed, once from four sides, instead of the built-in humans. ``--photograph`` shrinks a
photograph so that real people in it, whose boxes are given, have that size: the detector's own limit.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from humansim_ros.cameras import Camera
    from humansim_ros.people.humans.human import Human
    from humansim_ros.scene.core.actor import HumanState

ROOT = Path(__file__).parent.parent
JOINTS = {
    f"{side}_{joint}": number
    for joint, left in (
        ("shoulder", 11),
        ("elbow", 13),
        ("wrist", 15),
        ("hip", 23),
        ("knee", 25),
        ("ankle", 27),
    )
    for side, number in (("l", left), ("r", left + 1))
}
SIDES = 8
#: Height of a human in an image, pixels.
HEIGHT = 340.0
SIZE = (640, 480)
#: Horizontal field of view, radians.
FOV = math.radians(50.0)
#: No person is taller, metres.
TALLEST = 2.1
#: Seconds of the walk.
TIMES = (0.0, 0.3, 0.6, 0.9)
#: Number of the joints of the body, which are before those of fingers, toes and face.
BODY_JOINTS = 22
#: Seed of people by seed.
SEED = 11
#: Share of the height of somebody who stands over which the joints extend.
JOINT_SHARE = 0.87
#: Pixels by which people of photographs are moved away from the middle of the image.
SHIFTS = ((-20, -8, 0, 7, 19), (-6, 0, 5))


def detect(folder: Path) -> None:
    """Write the joints detected in the images of a folder; runs in the environment of the detector."""
    import cv2
    import mediapipe

    options = {"static_image_mode": True, "model_complexity": 1, "min_detection_confidence": 0.5}
    detected = {}
    with mediapipe.solutions.pose.Pose(**options) as pose:
        for path in sorted(folder.glob("*.png")):
            image = cv2.imread(str(path))[..., ::-1].copy()
            marks = pose.process(image).pose_landmarks
            height, width = image.shape[:2]
            # MediaPipe has fractions of the image; here pixel centers are integers
            detected[path.stem] = marks and [
                (marks.landmark[k].x * width - 0.5, marks.landmark[k].y * height - 0.5)
                for k in JOINTS.values()
            ]
    (folder / "joints.json").write_text(json.dumps(detected))


def render_humans(folder: Path, options: argparse.Namespace) -> dict[str, list[list[float]]]:
    """Write images of all humans from all sides into a folder; return the joints (12, 2) by image."""
    import numpy as np

    from humansim_ros.cli.human import built_in_humans
    from humansim_ros.files.reading.assets import resource_path
    from humansim_ros.people import draw_person, make_person
    from humansim_ros.people.loading.loading import load_human
    from humansim_ros.render import GLRenderer
    from humansim_ros.render.pictures import write_png
    from humansim_ros.scene.config.config import MotionConfig
    from humansim_ros.scene.core.actor import Actor
    from humansim_ros.scene.core.source import SceneSource
    from humansim_ros.scene.features.room.feature import furnished_room

    def people() -> Iterator[tuple[str, str, Human, Sequence[float], Sequence[int]]]:
        for number in range(options.people):
            human = make_person(draw_person(SEED, number), f"person_{number}")
            yield "people", f"seed {SEED}", human, TIMES[1:2], range(number % 2, SIDES, 2)
        for name in () if options.people else built_in_humans():
            human = load_human(resource_path(f"assets/humans/{name}.npz"))
            for outfit in human.outfits if options.outfits == "all" else human.outfits[:1]:
                yield name, outfit, human.wearing(outfit), TIMES, range(SIDES)

    truth = {}
    side_length = room_side(options)
    renderer = GLRenderer(furnished_room((side_length, side_length, 2.8)))
    for number, (name, outfit, human, times, sides) in enumerate(people()):
        motion = MotionConfig(file="walk", anchor="center")
        actor = Actor.build(name, 1, human, motion, SceneSource())
        for frame, time in enumerate(times):
            state = actor.at(time)
            for side in sides:
                camera = camera_beside(state, human, side, options)
                view = renderer.render([actor.body(state.vertices)], camera, ("rgb",))
                image = f"{name}-{outfit}-{number:03}{frame}{side}"
                write_png(folder / f"{image}.png", view.rgb)
                joints = [state.positions[state.joint_names.index(joint)] for joint in JOINTS]
                truth[image] = camera.project(np.array(joints))[0].tolist()
    renderer.close()
    return truth


def shrink_photograph(folder: Path, options: argparse.Namespace) -> None:
    """Write images in which people of a photograph are as large as rendered ones, also mirrored."""
    import cv2
    import numpy as np

    photograph = cv2.imread(str(options.photograph))
    if photograph is None:
        raise SystemExit(f"error: {options.photograph} is not an image")
    middle = np.array(options.size) / 2
    for number, (left, top, right, bottom) in enumerate(options.box):
        scale = (options.span or HEIGHT) / (JOINT_SHARE * (bottom - top))
        smooth = cv2.GaussianBlur(photograph, (0, 0), 0.3 / scale)
        for count, shift in enumerate(itertools.product(*SHIFTS)):
            corner = middle + shift - scale * np.array([left + right, top + bottom]) / 2
            view = cv2.warpAffine(
                smooth,
                np.array([[scale, 0, corner[0]], [0, scale, corner[1]]]),
                tuple(options.size),
                borderMode=cv2.BORDER_REPLICATE,
            )
            cv2.imwrite(str(folder / f"{number}-{count:02}.png"), view)
            cv2.imwrite(str(folder / f"{number}-{count:02}m.png"), view[:, ::-1])


def room_side(options: argparse.Namespace) -> float:
    """Length and width of a room that has all cameras inside, metres: at least 14."""
    focal = options.size[0] / (2 * math.tan(FOV / 2))
    distance = TALLEST * focal / (options.span or HEIGHT)
    return max(14.0, 2 * (distance + 1.0))


def camera_beside(state: HumanState, human: Human, side: int, options: argparse.Namespace) -> Camera:
    """Create a camera on a side of a human, at the distance at which it has its size in the image."""
    import numpy as np

    from humansim_ros.cameras import Camera

    middle = (state.vertices.min(0) + state.vertices.max(0)) / 2
    size = tuple(options.size)
    stature = float(np.ptp(human.mesh.vertices[:, 1]))
    distance = stature * size[0] / (2 * np.tan(FOV / 2)) / HEIGHT
    angle = 2 * np.pi * side / SIDES + 0.2
    for _ in range(5):
        offset = (distance * np.cos(angle), distance * np.sin(angle), 0.35)
        camera = Camera.look_at(tuple(middle + offset), tuple(middle), size, FOV)
        if options.span is None:
            break
        rows = camera.project(state.positions[:BODY_JOINTS])[0][:, 1]
        distance *= float(np.ptp(rows)) / options.span
    return camera


def report(truth: dict[str, list[list[float]]], detected: dict[str, list[list[float]] | None]) -> bool:
    """Print a table of errors; return whether there is a detection in every view."""
    import numpy as np

    print(f"{'human':16} {'outfit':10} {'detected':>8}   mean median   95 %   pixels; mean by joint")
    groups: dict[tuple[str, str], list[str]] = {}
    for image in truth:
        name, outfit, _ = image.rsplit("-", 2)
        groups.setdefault((name, outfit), []).append(image)
    names = [joint.removeprefix("l_") for joint in JOINTS if joint.startswith("l_")]
    all_errors = []
    for (name, outfit), images in groups.items():
        hits = [image for image in images if detected[image]]
        errors = np.array([np.linalg.norm(np.array(detected[i]) - np.array(truth[i]), axis=1) for i in hits])
        all_errors.append(errors)
        by_joint = errors.reshape(len(hits), -1, 2).mean(axis=(0, 2)) if len(hits) else []
        parts = " ".join(f"{joint} {error:.1f}" for joint, error in zip(names, by_joint, strict=False))
        print(
            f"{name:16} {outfit:10} {len(hits):4}/{len(images)} {errors.mean():6.2f} "
            f"{np.median(errors):6.2f} {np.percentile(errors, 95):6.2f}   {parts}"
        )
    total = np.concatenate(all_errors)
    count = sum(len(images) for images in groups.values())
    print(
        f"all: detected in {len(total)} of {count} views; error {total.mean():.2f} px (mean), "
        f"{np.median(total):.2f} px (median)"
    )
    return len(total) == count


def draw_sheet(
    path: Path,
    folder: Path,
    truth: dict[str, list[list[float]]],
    detected: dict[str, list[list[float]] | None],
) -> None:
    """Draw the first outfit of each human from every second side, with joints and detections.

    Args:
        path: File to write.
        folder: Folder with the images.
        truth: Joints of the scene by image: green rings.
        detected: Detected joints by image, or None: red dots.
    """
    import cv2
    import numpy as np

    first: dict[str, list[str]] = {}
    for image in truth:
        name, outfit, _ = image.rsplit("-", 2)
        if all(other.rsplit("-", 2)[1] == outfit for other in first.get(name, [])):
            first.setdefault(name, []).append(image)
    rows = []
    for images in first.values():
        row = []
        for image in images[:SIDES:2]:
            view = cv2.imread(str(folder / f"{image}.png"))
            for (x, y), color, radius, width in (
                *((point, (80, 220, 60), 5, 1) for point in truth[image]),
                *((point, (40, 40, 240), 3, -1) for point in detected[image] or []),
            ):
                at = (round(16 * x), round(16 * y))
                cv2.circle(view, at, 16 * radius, color, width, cv2.LINE_AA, 4)
            row.append(view[40:460, 160:480])
        rows.append(np.concatenate(row, axis=1))
    columns = [np.concatenate(rows[k::2], axis=0) for k in range(2)] if len(rows) % 2 == 0 else None
    sheet = np.concatenate(columns, axis=1) if columns else np.concatenate(rows, axis=0)
    cv2.imwrite(str(path), sheet, [cv2.IMWRITE_JPEG_QUALITY, 85])


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--python",
        default=os.environ.get("POSE_DETECTOR_PYTHON"),
        help="Python of the detector's environment",
    )
    parser.add_argument(
        "--picture", type=Path, help="write a sheet of images with joints and detections (.jpg)"
    )
    parser.add_argument("--outfits", choices=("all", "first"), default="all")
    parser.add_argument("--size", type=int, nargs=2, default=SIZE, metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--span", type=float, metavar="PIXELS", help="rows over which joints extend")
    parser.add_argument("--people", type=int, default=0, metavar="N", help="people by seed")
    parser.add_argument("--photograph", type=Path, help="find the people of --box in this image instead")
    parser.add_argument(
        "--box",
        type=float,
        nargs=4,
        action="append",
        default=[],
        metavar=("LEFT", "TOP", "RIGHT", "BOTTOM"),
        help="somebody who stands in the photograph, pixels; repeatable",
    )
    parser.add_argument("--detect", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.detect is not None:
        detect(options.detect)
        return 0
    if options.python is None:
        print(
            "skipped: no environment with a pose detector (the docstring of this file says how to make one)"
        )
        return 0
    sys.path.insert(0, str(ROOT))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        truth = {}
        if options.photograph is None:
            truth = render_humans(folder, options)
        else:
            shrink_photograph(folder, options)
        command = [options.python, str(Path(__file__).resolve()), "--detect", str(folder)]
        subprocess.run(command, check=True, stderr=subprocess.DEVNULL)
        detected = json.loads((folder / "joints.json").read_text())
        if options.photograph is not None:
            for number, box in enumerate(options.box):
                found = [marks is not None for image, marks in detected.items() if image[0] == str(number)]
                print(f"{[round(side) for side in box]}: detected in {sum(found)} of {len(found)} images")
            return 0
        complete = report(truth, detected)
        if options.picture is not None:
            draw_sheet(options.picture, folder, truth, detected)
    return int(not complete)


if __name__ == "__main__":
    sys.exit(main())
