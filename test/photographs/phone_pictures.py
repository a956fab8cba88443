"""Stand-ins for pictures of phones: a chessboard and a person, rendered and saved as JPEG files."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import chessboard
import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.cameras import Camera
from humansim_ros.motion.body.skeleton import body_joints
from humansim_ros.people import keypoint_set
from humansim_ros.render import Body, GLRenderer, Lighting
from humansim_ros.scene import OUTSIDE, Scene, Simulation

#: Side of a square of the board, metres.
SQUARE = 0.06
#: Pictures of the board for each phone.
PICTURES = 9
SIZE = (960, 720)
#: Corner of the board that is the origin of the calibration, in ``map``: the board is centred at the origin.
ORIGIN = np.array([(1 - chessboard.COLUMNS / 2) * SQUARE, (chessboard.ROWS / 2 - 1) * SQUARE, 0.0])
#: The person in the pictures.
PERSON = "adult_woman"
_LENSES = {
    "anna": (-0.11, 0.05, 0.0005, -0.001, 0.0),
    "ben": (0.06, -0.08, -0.001, 0.0005, 0.0),
    "carla": (-0.05, 0.01, 0.0, 0.001, 0.0),
    "david": (0.09, -0.12, 0.001, 0.001, 0.0),
}


@dataclass(frozen=True)
class PhonePictures:
    """Truth of the pictures: cameras in ``map``, joints (J, 3) without fingers, and vertices (V, 3)."""

    cameras: Mapping[str, Camera]
    joints: NDArray[np.float64]
    vertices: NDArray[np.float32]


def phones() -> dict[str, Camera]:
    """Four phones around the board, each with a lens of its own, which see a person whole."""
    cameras = {}
    for number, (name, lens) in enumerate(_LENSES.items()):
        angle = 2 * np.pi * number / len(_LENSES) + 0.6
        place = (2.9 * np.cos(angle), 2.9 * np.sin(angle), 1.35 + 0.1 * number)
        ideal = Camera.look_at(place, (0, 0, 0.85), SIZE, np.radians(62 + 2 * number))
        cameras[name] = Camera(ideal.size, ideal.K, ideal.R, ideal.t, lens)
    return cameras


def write_phone_pictures(folder: Path, seed: int = 0) -> PhonePictures:
    """Write the pictures of docs/from_photographs.md, and a detector that knows the truth."""
    rng = np.random.default_rng(seed)
    cameras = phones()
    _write_boards(folder / "phones", cameras, rng)
    scene = Scene.from_dict(
        {
            "rate": 25,
            "light": {"shadows": "contact"},
            "room": {"size": [8.0, 8.0, 3.0]},
            "humans": {"person": {"body": PERSON, "motion": {"file": "t_to_a_pose"}}},
            "cameras": {
                name: {
                    "size": list(camera.size),
                    "K": camera.K.tolist(),
                    "R": camera.R.tolist(),
                    "t": camera.t.tolist(),
                    "distortion": list(camera.distortion),
                }
                for name, camera in cameras.items()
            },
        },
        folder,
    )
    with Simulation(scene) as simulation:
        frame = simulation.frame(60)
    names = keypoint_set("coco17").names
    known = {}
    for number, name in enumerate(cameras):
        picture = f"IMG_{2041 + 7 * number}.jpg"
        gain = rng.uniform(0.88, 1.0, 3)  # white balance
        _photograph(folder / "photos" / name / picture, frame.views[name].rgb * gain, rng)
        mask = np.where(frame.views[name].instance == frame.labels["person"], 255, 0).astype(np.uint8)
        (folder / "masks").mkdir(exist_ok=True)
        assert cv2.imwrite(str(folder / "masks" / f"{name}.png"), mask)
        view = frame.keypoints["coco17"][name]["person"]
        noisy = np.nan_to_num(view.pixels) + rng.normal(0, 1.5, view.pixels.shape)
        known[picture] = {
            point: [*pixel, 0.9]
            for point, pixel, visible in zip(names, noisy.tolist(), view.visible, strict=True)
            if visible != OUTSIDE
        }
    (folder / "known.json").write_text(json.dumps(known))
    (folder / "detect.py").write_text(_DETECTOR)
    state = frame.humans["person"]
    body = body_joints(scene.actors["person"].human.skeleton.joint_names)
    return PhonePictures(cameras, state.positions[body], state.vertices)


#: Stands in for a detector: it looks the points up by the name of the picture.
_DETECTOR = """\
import json, os, sys

image, points = sys.argv[1:]
known = json.load(open(os.path.join(os.path.dirname(__file__), "known.json")))
json.dump({"frames": [known[os.path.basename(image)]]}, open(points, "w"))
"""


def _write_boards(folder: Path, cameras: Mapping[str, Camera], rng: np.random.Generator) -> None:
    board = chessboard.board()
    parts = np.zeros(2, np.uint8)
    with GLRenderer(lighting=Lighting(mode="shadeless")) as renderer:
        for name, camera in cameras.items():
            at_origin = Camera(camera.size, camera.K, np.eye(3), np.zeros(3), camera.distortion)
            for number in range(PICTURES):
                turn, middle = chessboard.held_up(at_origin, rng)
                vertices = turn.apply(board.vertices) + middle
                body = Body(board, vertices.astype(np.float32), parts, 0)
                image = renderer.render([body], at_origin, ("rgb",)).rgb
                _photograph(folder / name / "board" / f"IMG_{1000 + number}.jpg", image.astype(float), rng)
            flat = (SQUARE * board.vertices).astype(np.float32)
            image = renderer.render([Body(board, flat, parts, 0)], camera, ("rgb",)).rgb
            _photograph(folder / name / "floor.jpg", image.astype(float), rng)


def _photograph(path: Path, colours: NDArray[np.float64], rng: np.random.Generator) -> None:
    """Save as a phone does: noise, then JPEG."""
    noisy = np.clip(np.rint(colours + rng.normal(0, 1.5, colours.shape)), 0, 255).astype(np.uint8)
    path.parent.mkdir(parents=True, exist_ok=True)
    options = [cv2.IMWRITE_JPEG_QUALITY, 93]
    assert cv2.imwrite(str(path), np.ascontiguousarray(noisy[..., ::-1]), options)


def to_map(points: NDArray[np.floating]) -> NDArray[np.float64]:
    """Points (N, 3) in the world of the calibration as points of ``map``."""
    return np.asarray(points + ORIGIN)
