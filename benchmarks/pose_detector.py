"""Does a stock pose detector take our people for people, and find their joints where they are?

    python benchmarks/pose_detector.py [--python PATH] [--picture found.jpg] [--outfits all|first]

Every built-in person, in every outfit, walks in the furnished room and is seen at four instants from eight
sides, 340 pixels tall in 640x480 images. MediaPipe Pose (0.10.21, its model is in its wheel) looks at each
image by itself. Printed are in how many views it found somebody, and how far its shoulders, elbows, wrists,
hips, knees and ankles are from ours, in pixels. It wants NumPy 1 and runs in an environment of its own:

    python3.12 -m venv detector && detector/bin/pip install mediapipe==0.10.21
    python benchmarks/pose_detector.py --python detector/bin/python
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from humansim_ros.camera import Camera
    from humansim_ros.humans.human import Human

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
TALL = 340.0
SIZE = (640, 480)
#: Instants of the walk, seconds.
PHASES = (0.0, 0.3, 0.6, 0.9)


def detect(folder: Path) -> None:
    """Run in the detector's environment: landmarks of every image in a folder, written beside them."""
    import cv2
    import mediapipe

    options = {"static_image_mode": True, "model_complexity": 1, "min_detection_confidence": 0.5}
    found = {}
    with mediapipe.solutions.pose.Pose(**options) as pose:
        for path in sorted(folder.glob("*.png")):
            image = cv2.imread(str(path))[..., ::-1].copy()
            marks = pose.process(image).pose_landmarks
            height, width = image.shape[:2]
            # its coordinates are fractions of the image; pixel centres are integers here
            found[path.stem] = marks and [
                (marks.landmark[k].x * width - 0.5, marks.landmark[k].y * height - 0.5)
                for k in JOINTS.values()
            ]
    (folder / "found.json").write_text(json.dumps(found))


def draw_people(folder: Path, all_outfits: bool) -> dict[str, list[list[float]]]:
    """Images of all people from all sides in a folder; where their joints are (12, 2), by image."""
    import numpy as np

    from humansim_ros.cli.human import built_in_humans
    from humansim_ros.drawing.canvas import write_png
    from humansim_ros.humans.loading import load_human
    from humansim_ros.render import GLRenderer
    from humansim_ros.resources import resource_path
    from humansim_ros.scene.actor import Actor
    from humansim_ros.scene.config import MotionConfig
    from humansim_ros.scene.room import furnished_room
    from humansim_ros.scene.source import SceneSource

    truth = {}
    renderer = GLRenderer(furnished_room((14.0, 14.0, 2.8)))
    for name in built_in_humans():
        human = load_human(resource_path(f"assets/humans/{name}.npz"))
        for outfit in human.outfits if all_outfits else human.outfits[:1]:
            dressed = human.wearing(outfit)
            motion = MotionConfig(file="walk", anchor="center")
            actor = Actor.build(name, 1, dressed, motion, SceneSource())
            for phase, time in enumerate(PHASES):
                state = actor.at(time)
                for side, camera in enumerate(cameras_around(state.vertices, human)):
                    view = renderer.render([actor.body(state.vertices)], camera, ("rgb",))
                    assert view.rgb is not None
                    image = f"{name}-{outfit}-{phase}{side}"
                    write_png(folder / f"{image}.png", view.rgb)
                    places = [state.positions[state.joint_names.index(joint)] for joint in JOINTS]
                    truth[image] = camera.project(np.array(places))[0].tolist()
    renderer.close()
    return truth


def cameras_around(vertices: Any, human: Human) -> list[Camera]:
    """Cameras on all sides of a person, from whom it is as tall as it should be."""
    import numpy as np

    from humansim_ros.camera import Camera

    middle = (vertices.min(0) + vertices.max(0)) / 2
    fov = np.radians(50.0)
    stature = float(np.ptp(human.mesh.vertices[:, 1]))
    away = stature * SIZE[0] / (2 * np.tan(fov / 2)) / TALL
    angles = 2 * np.pi * np.arange(SIDES) / SIDES + 0.2
    ways = np.column_stack([away * np.cos(angles), away * np.sin(angles), np.full(SIDES, 0.35)])
    return [Camera.look_at(tuple(middle + way), tuple(middle), SIZE, float(fov)) for way in ways]


def report(truth: dict[str, list[list[float]]], found: dict[str, list[list[float]] | None]) -> bool:
    """Print a table; whether everybody was found everywhere."""
    import numpy as np

    print(f"{'person':16} {'outfit':10} {'found':>7}   mean median   95 %   pixels; mean by joint")
    people: dict[tuple[str, str], list[str]] = {}
    for image in truth:
        name, outfit, _ = image.rsplit("-", 2)
        people.setdefault((name, outfit), []).append(image)
    names = [joint.removeprefix("l_") for joint in JOINTS if joint.startswith("l_")]
    everything = []
    for (name, outfit), images in people.items():
        seen = [image for image in images if found[image]]
        errors = np.array([np.linalg.norm(np.array(found[i]) - np.array(truth[i]), axis=1) for i in seen])
        everything.append(errors)
        by_joint = errors.reshape(len(seen), -1, 2).mean(axis=(0, 2)) if len(seen) else []
        parts = " ".join(f"{joint} {error:.1f}" for joint, error in zip(names, by_joint, strict=False))
        print(
            f"{name:16} {outfit:10} {len(seen):3}/{len(images)} {errors.mean():6.2f} "
            f"{np.median(errors):6.2f} {np.percentile(errors, 95):6.2f}   {parts}"
        )
    total = np.concatenate(everything)
    count = sum(len(images) for images in people.values())
    print(
        f"all: found in {len(total)} of {count} views; error {total.mean():.2f} px in the mean, "
        f"{np.median(total):.2f} px in the median, at {TALL:.0f} px height"
    )
    return len(total) == count


def draw_picture(
    path: Path, folder: Path, truth: dict[str, list[list[float]]], found: dict[str, list[list[float]] | None]
) -> None:
    """The first outfits from every second side: our joints as green rings, the detector's as red dots."""
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
            picture = cv2.imread(str(folder / f"{image}.png"))
            for (x, y), color, radius, width in (
                *((point, (80, 220, 60), 5, 1) for point in truth[image]),
                *((point, (40, 40, 240), 3, -1) for point in found[image] or []),
            ):
                at = (round(16 * x), round(16 * y))
                cv2.circle(picture, at, 16 * radius, color, width, cv2.LINE_AA, 4)
            row.append(picture[40:460, 160:480])
        rows.append(np.concatenate(row, axis=1))
    columns = [np.concatenate(rows[k::2], axis=0) for k in range(2)] if len(rows) % 2 == 0 else None
    sheet = np.concatenate(columns, axis=1) if columns else np.concatenate(rows, axis=0)
    cv2.imwrite(str(path), sheet, [cv2.IMWRITE_JPEG_QUALITY, 85])


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--python", default=os.environ.get("POSE_DETECTOR_PYTHON"), help="of its environment")
    parser.add_argument("--picture", type=Path, help="a sheet of what was found (.jpg)")
    parser.add_argument("--outfits", choices=("all", "first"), default="all")
    parser.add_argument("--detect", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.detect is not None:
        detect(options.detect)
        return 0
    if options.python is None:
        print("left out: no environment with a pose detector (see the head of this file)")
        return 0
    sys.path.insert(0, str(ROOT))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        truth = draw_people(folder, options.outfits == "all")
        command = [options.python, str(Path(__file__).resolve()), "--detect", str(folder)]
        subprocess.run(command, check=True, stderr=subprocess.DEVNULL)
        found = json.loads((folder / "found.json").read_text())
        complete = report(truth, found)
        if options.picture is not None:
            draw_picture(options.picture, folder, truth, found)
    return int(not complete)


if __name__ == "__main__":
    sys.exit(main())
