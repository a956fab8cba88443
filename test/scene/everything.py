"""A scene with every feature, and scanners with every option, for tests of what must hold for all of them."""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any, get_args

import cv2
import numpy as np
from keyframe_text import keyframes

from humansim_ros.cameras.scanner.models import MODELS, IntensityMode, Layout

#: Side of all images, pixels.
SIZE = [64, 48]
#: One camera as camera_calibration writes it.
_RIG = """\
image_width: 64
image_height: 48
camera_name: rig
camera_matrix: {rows: 3, cols: 3, data: [60, 0, 32, 0, 60, 24, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0.1, 0, 0, 0, 0]}
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}
projection_matrix: {rows: 3, cols: 4, data: [60, 0, 32, 0, 0, 60, 24, 0, 0, 0, 1, 0]}
"""
_FACE = {
    "alive": True,
    "mouth": True,
    "head": 0.5,
    "keys": [
        {"time": 0, "expression": "happiness"},
        {"time": 0.1, "speak": 2},
        {"time": 0.2, "gaze": "front"},
        {"time": 0.3, "actions": {"jawOpen": 0.4}},
        {"time": 0.4, "gaze": "ben"},
        {"time": 0.6, "gaze": [1, 1, 1]},
    ],
}
_SENSOR = {
    "encoding": "bayer_rggb8",
    "exposure_time": 0.01,
    "rolling_shutter": 0.0001,
    "samples": 2,
    "noise": {},
    "vignetting": {"corner": 0.2},
    "chromatic_aberration": {"red": 1},
}
_FAULTS = {
    "drop": {"probability": 0.1},
    "freeze": {"probability": 0.5},
    "outage": {"probability": 0.1},
    "late": {"delay": [0, 0.1]},
    "out_of_order": {"probability": 0.1},
    "duplicate": {"probability": 0.1},
    "clock": {"jitter": 0.01},
    "trigger_delay": {"delay": 0.001},
    "calibration": {"rotation": 1, "drift": {"rotation": 1}},
    "flicker": {"frequency": 100},
    "exposure_steps": {"probability": 0.1},
    "dirt": {"spots": 3},
}


def everything(folder: Path) -> dict[str, Any]:
    """A scene with every section and every kind of human, object, camera and scanner. Writes its files."""
    (folder / "moves.xml").write_text(
        keyframes(30, 10, ball=((0, 3, 0.2), (1, 3, 0.4)), dora=((0, 0, 0), (0.5, 0, 0)))
    )
    (folder / "box.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\n")
    cv2.imwrite(str(folder / "sky.hdr"), np.full((16, 32, 3), 0.5, np.float32))
    cv2.imwrite(str(folder / "back.png"), np.full((*SIZE[::-1], 3), 128, np.uint8))
    path = [[time, 3, time / 4, 1.5, 0.5, -0.5, 0.5, -0.5] for time in (0, 2)]
    np.savetxt(folder / "path.tum", path)
    (folder / "rig.yaml").write_text(_RIG)
    trajectory, moves = ({"file": str(folder / name)} for name in ("path.tum", "moves.xml"))
    here = {"look_at": [0, 0, 1], "size": SIZE}
    fisheye = {"K": [[20, 0, 32], [0, 20, 24], [0, 0, 1]], "distortion_model": "equidistant"}
    return {
        "room": {"size": [14, 14, 3]},
        "humans": {
            "anna": {
                "body": "adult_woman",
                "skinning": "dual_quaternion",
                "motion": {
                    "file": "walk",
                    "clamp": True,
                    "pin_feet": True,
                    "mirror": True,
                    "blend": 0.2,
                    "floor": "skin",
                    "hands": [{"pose": "fist", "time": 0.2, "side": "left"}],
                },
                "face": _FACE,
            },
            "ben": {
                "body": "adult_man",
                "motion": {"file": "wave", "position": [1.5, 1]},
                "reach": [
                    {"to": "ball", "pose": "grip", "start": 0.1, "end": 2.5},
                    {"to": "anna", "at": "l_shoulder", "hand": "left", "start": 0.2, "end": 2},
                    {"to": [1.5, 1.4, 1], "start": 3, "end": 6},
                ],
            },
            "cara": {"body": "child", "motion": {"file": "carry", "position": [-2, 0], "loop": "continue"}},
            "dora": {"motion": "walk", "keyframes": moves},
            "ed": {"motion": {"file": "sit", "position": [-2, -2]}, "seat": "chair"},
            "fay": {"motion": "live"},
            "gus": {"motion": {"file": "walk", "retarget": "thesis", "position": [2, 2]}},
        },
        "variety": {"count": 2, "people": {}, "alive": True},
        "crowd": {
            "count": 3,
            "groups": 0.5,
            "queues": [{"position": [5, -5], "count": 2}],
            "alive": True,
            "duration": 10,
        },
        "objects": {
            "ball": {"mesh": "sphere", "size": [0.2, 0.2, 0.2], "label": True, "keyframes": moves},
            "box": {"size": [0.3, 0.3, 0.3], "held_by": "cara"},
            "file": {"mesh": str(folder / "box.obj"), "position": [0, -3, 0]},
        },
        "robot": {
            "path": {"points": [[-1, -1], [1, -1]], "speed": 0.5},
            "vibration": {"position": 0.002, "rotation_deg": 0.2},
            "label": True,
        },
        "rig": {"file": str(folder / "rig.yaml"), "position": [3, 3, 1.5]},
        "cameras": {
            "front": {
                **here,
                "position": [3, 0, 1.5],
                "distortion": [-0.2, 0.05, 0, 0, 0],
                "depth_sensor": {"preset": "realsense_d435", "size": SIZE},
                "sensor": _SENSOR,
                "faults": _FAULTS,
            },
            "moving": {
                "trajectory": trajectory,
                "size": SIZE,
                "rate": 15,
                "background": str(folder / "back.png"),
            },
            "left": {**here, "position": [3, 1, 1.5], "stereo": {"baseline": 0.1}},
            "carried": {"mount": "robot", "position": [0, 0, 1.2], "look_at": [1, 0, 1.2], "size": SIZE},
            "fish": {
                **here,
                **fisheye,
                "position": [0, 3, 1.5],
                "distortion": [0.01, 0, 0, 0],
                "depth_sensor": {"preset": "kinect_v2", "size": SIZE},
                "binning": [2, 2],
            },
        },
        "scanners": {
            "lidar": {"model": "livox_mid360", "position": [2, 0, 1]},
            "base": {"model": "velodyne_vlp16", "mount": "robot", "position": [0, 0, 0.5]},
            "own": {
                "pattern": {"columns": 90, "elevations_deg": [0, 5]},
                "rate": 10,
                "range": [0.1, 50],
                "trajectory": trajectory,
            },
        },
        "world": {
            "meshes": [{"file": str(folder / "box.obj"), "position": [0, 3, 0]}],
            "environment": str(folder / "sky.hdr"),
        },
        "light": {"shadows": "soft", "tone_mapping": "filmic"},
        "randomise": {
            "light": True,
            "colours": True,
            "textures": True,
            "clutter": 2,
            "clutter_label": True,
            "camera_jitter": {"position": 0.05},
        },
        "adapters": {
            "detections_2d": {},
            "detections_3d": {},
            "people": {},
            "tracked_persons": {"camera": "front"},
        },
        "hri": {"camera": "front"},
    }


def all_scanners() -> dict[str, dict[str, Any]]:
    """Scanners by name: each model as it is, and some with each option."""
    flat = {name for name, model in MODELS.items() if model.layout == "scan"}
    options: list[tuple[str, dict[str, Any]]] = [(model, {}) for model in MODELS]
    options += [
        (model, {"returns": returns})
        for model, returns in product(("hesai_xt32", "livox_mid40"), ("strongest", "last", "dual"))
    ]
    options += [
        (model, {"layout": layout})
        for model, layout in product(("velodyne_vlp16", "livox_mid360"), get_args(Layout))
        if layout != "scan"
    ]
    options += [
        (
            "livox_mid40",
            {"intensity": intensity, "range_10": 20, "dropout": 0.1, "noise": 0.05, "stamp": "end"},
        )
        for intensity in get_args(IntensityMode)
    ]
    options += [(model, {"rate": 2 * MODELS[model].rate}) for model in [*sorted(flat)[:1], "livox_mid360"]]
    return {
        f"scanner_{number}": {"model": model, "position": [2, 0, 1], **more}
        for number, (model, more) in enumerate(options)
    }
