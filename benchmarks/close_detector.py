"""Compare landmarks that a detector finds on faces and hands, seen close, with the keypoints of the scene.

    python benchmarks/close_detector.py [--python PATH] [--picture sheet.jpg]

Every built-in human stands in the furnished room. Five cameras see its face from the front and up to 40
degrees from the side, five its left hand. MediaPipe Face Mesh and Hands (0.10.21, their models are in its
wheel) process the images independently, in an environment of its own, as ``pose_detector.py`` says. Printed
are the number of views with a detection, and the errors: of the 68 points of faces, and of the 51 without the
jaw line, as shares of the distance of the outer corners of the eyes (NME); of hands as shares of the longer
side of the box of the hand. Of the 468 points of Face Mesh, the mean, the median and the 95th percentile.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent
SIZE = 480
#: Angles of the cameras to the front of the face and to the back of the hand, degrees.
ANGLES = (-40, -20, 0, 20, 40)
#: Width of the image at the face or hand, metres.
WIDTHS = {"face68": 0.5, "left_hand21": 0.4}
#: Landmarks of Face Mesh at the points of iBUG 300-W, in their order.
MESH_POINTS: tuple[int, ...] = (
    *(127, 234, 93, 132, 58, 172, 136, 150, 152, 379, 365, 397, 288, 361, 323, 454, 356),
    *(70, 63, 105, 66, 107, 336, 296, 334, 293, 300, 168, 197, 5, 4, 98, 97, 2, 326, 327),
    *(33, 160, 158, 133, 153, 144, 362, 385, 387, 263, 373, 380),
    *(61, 40, 37, 0, 267, 270, 291, 321, 314, 17, 84, 91, 78, 81, 13, 311, 308, 402, 14, 178),
)


#: Points (K, 2) in pixels by image; None for an image without a detection.
Points = dict[str, Any]


def detect(folder: Path) -> None:
    """Write the landmarks detected in the images of a folder; runs in the environment of the detector."""
    import cv2
    import mediapipe

    solutions = mediapipe.solutions
    found: Points = {}
    with (
        solutions.face_mesh.FaceMesh(static_image_mode=True) as faces,
        solutions.hands.Hands(static_image_mode=True, max_num_hands=1) as hands,
    ):
        for path in sorted(folder.glob("*.png")):
            image = cv2.imread(str(path))[..., ::-1].copy()
            if path.stem.startswith("face68"):
                marks = faces.process(image).multi_face_landmarks
            else:
                marks = hands.process(image).multi_hand_landmarks
            # MediaPipe has fractions of the image; here pixel centers are integers
            points = marks and [(each.x * SIZE - 0.5, each.y * SIZE - 0.5) for each in marks[0].landmark]
            if path.stem.startswith("face68"):
                found[path.stem.replace("face68", "face468")] = points and points[:468]
                points = points and [points[k] for k in MESH_POINTS]
            found[path.stem] = points
    (folder / "found.json").write_text(json.dumps(found))


def render(folder: Path) -> Points:
    """Write the images of all humans into a folder; return the keypoints (K, 2) by image."""
    import numpy as np

    from humansim_ros import Scene, Simulation
    from humansim_ros.cli.human import built_in_humans
    from humansim_ros.render.pictures import write_png

    truth: Points = {}
    for body in built_in_humans():
        scene: dict[str, Any] = {"humans": {"person": {"body": body, "motion": "stand"}}}
        first = {"first": {"position": [3, 0, 1], "look_at": [0, 0, 1]}}
        with Simulation(Scene.from_dict(scene | {"cameras": first}), channels=()) as simulation:
            positions = simulation.frame(0).keypoint_positions
        cameras = {}
        for name, width in WIDTHS.items():
            points = positions[name]["person"]
            middle = (points.min(axis=0) + points.max(axis=0)) / 2
            across = points[45] - points[36] if name == "face68" else points[17] - points[5]
            along = points[27] - points[8] if name == "face68" else points[0] - points[9]
            front = np.cross(across, along)
            front /= np.linalg.norm(front)
            front *= np.sign(front @ [1, 0, 0] if name == "face68" else front @ [0, 1, 0])
            for angle in ANGLES:
                turn = np.radians(angle)
                away = front * np.cos(turn) + np.cross([0, 0, 1], front) * np.sin(turn)
                cameras[f"{name}_{ANGLES.index(angle)}"] = {
                    "size": [SIZE, SIZE],
                    "position": (middle + 1.2 * away).round(4).tolist(),
                    "look_at": middle.round(4).tolist(),
                    "fov_deg": float(2 * np.degrees(np.arctan(width / 2.4))),
                }
        channels = ("rgb", "depth", "instance", "part")
        with Simulation(Scene.from_dict(scene | {"cameras": cameras}), channels=channels) as simulation:
            frame = simulation.frame(0)
            for camera, view in frame.views.items():
                name = camera.rpartition("_")[0]
                image = f"{name}-{body}-{camera[-1]}"
                write_png(folder / f"{image}.png", view.rgb)
                truth[image] = frame.keypoints[name][camera]["person"].pixels.tolist()
                if name == "face68":
                    mesh = frame.keypoints["face468"][camera]["person"].pixels
                    truth[image.replace(name, "face468")] = mesh.tolist()
    return truth


def report(truth: Points, found: Points) -> None:
    """Print a table of errors."""
    import numpy as np

    print(f"{'points':12} {'human':16} found   error of all; without the jaw; median and 95 % of 468")
    meshes = []
    groups: dict[tuple[str, str], list[str]] = {}
    for image in truth:
        name, body, _ = image.split("-")
        groups.setdefault((name, body), []).append(image)
    for (name, body), images in groups.items():
        hits = [image for image in images if found[image]]
        errors = []
        for image in hits:
            goal, own = np.array(truth[image]), np.array(found[image])
            corners = {"face68": (45, 36), "face468": (263, 33)}.get(name)
            unit = (
                np.linalg.norm(np.subtract(*goal[list(corners)])) if corners else np.ptp(goal, axis=0).max()
            )
            errors.append(np.linalg.norm(own - goal, axis=1) / unit)
        found_errors = np.array(errors).reshape(-1, len(truth[images[0]]) or 1)
        text = f"{name:12} {body:16} {len(hits)} of {len(images)} {found_errors.mean():8.1%}"
        if name == "face68":
            text += f" {found_errors[:, 17:].mean():8.1%}"
        elif name == "face468":
            text += " {:8.1%} {:8.1%}".format(*np.percentile(found_errors, [50, 95]))
            meshes.append(found_errors)
        print(text)
    if meshes:
        every = np.concatenate(meshes)
        print(
            "face468, all humans: mean {:.1%}, median {:.1%}, 95 % {:.1%}".format(
                every.mean(), *np.percentile(every, [50, 95])
            )
        )


def draw_sheet(path: Path, folder: Path, truth: Points, found: Points) -> None:
    """Draw all images with the keypoints (green) and the landmarks that were found (red)."""
    import cv2
    import numpy as np

    rows: dict[tuple[str, str], list[Any]] = {}
    for image, points in truth.items():
        view = cv2.imread(str(folder / f"{image.replace('face468', 'face68')}.png"))
        for marks, color in ((points, (80, 220, 60)), (found[image] or [], (40, 40, 240))):
            for x, y in marks:
                cv2.circle(view, (round(16 * x), round(16 * y)), 40, color, -1, cv2.LINE_AA, 4)
        name, body, _ = image.split("-")
        rows.setdefault((body, name), []).append(view)
    sheet = np.concatenate([np.concatenate(row, axis=1) for row in rows.values()])
    cv2.imwrite(str(path), cv2.resize(sheet, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    environment = os.environ.get("POSE_DETECTOR_PYTHON")
    parser.add_argument("--python", default=environment, help="Python of the detector's environment")
    parser.add_argument("--picture", type=Path, help="write a sheet of the images with all points (.jpg)")
    parser.add_argument("--detect", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.detect is not None:
        detect(options.detect)
        return 0
    if options.python is None:
        print("skipped: no environment with a detector (pose_detector.py says how to make one)")
        return 0
    sys.path.insert(0, str(ROOT))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        truth = render(folder)
        command = [options.python, str(Path(__file__).resolve()), "--detect", str(folder)]
        subprocess.run(command, check=True, stderr=subprocess.DEVNULL)
        found = json.loads((folder / "found.json").read_text())
        report(truth, found)
        if options.picture is not None:
            draw_sheet(options.picture, folder, truth, found)
    return 0


if __name__ == "__main__":
    sys.exit(main())
