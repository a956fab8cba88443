"""Stand-ins for photographs of a person: a built-in human in a pose, seen by calibrated cameras.

studio = make_studio(folder, cameras="shelf", noise=2.0, outliers=0.1)
read_views(studio.path)                 # images, masks and noisy points
studio.joints[0], studio.vertices[0]    # the truth of the first frame
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from calibration_files import calibration_path
from conftest import SHARED_DATA
from numpy.typing import NDArray

from humansim_ros.cameras import Camera, read_calibration, write_calibration
from humansim_ros.motion.body.skeleton import body_joints
from humansim_ros.people import Human, keypoint_set
from humansim_ros.people.keypoints.sets import KeypointSet
from humansim_ros.photographs.views import write_points
from humansim_ros.scene import OUTSIDE, VISIBLE, Scene, Simulation

#: Lens of the cameras of a ring: plumb_bob, as of a small camera.
LENS = (-0.12, 0.04, 0.001, -0.0008, 0.0)
#: Name of the person in the scene.
PERSON = "person"


@dataclass(frozen=True)
class Studio:
    """Photographs on disk, and their truth in ``map``.

    ``joints``: (F, J, 3); ``vertices``: (F, V, 3) float32; ``masks``: (F, views, H, W);
    ``points``: (F, views, K, 3) true pixels, confidence 1 visible, 0.5 occluded, 0 outside.
    """

    path: Path
    human: Human
    cameras: Mapping[str, Camera]
    keypoints: KeypointSet
    joints: NDArray[np.float64]
    vertices: NDArray[np.float32]
    masks: NDArray[np.bool_]
    points: NDArray[np.float64]

    @property
    def body_joints(self) -> NDArray[np.float64]:
        """``joints`` without fingers, toes, jaw and eyes: those that a fit has."""
        return self.joints[:, body_joints(self.human.skeleton.joint_names)]


def ring(
    count: int, size: tuple[int, int] = (640, 480), radius: float = 3.0, turn: float = 0.0
) -> dict[str, Camera]:
    """Cameras on a circle around the origin that see a standing person whole, with a lens.

    ``turn``: angle by which the circle is turned, as a share of the angle between cameras.
    """
    cameras = {}
    for number in range(count):
        angle = 2 * np.pi * (number + 0.5 + turn) / count
        place = (radius * np.cos(angle), radius * np.sin(angle), 1.3 + 0.4 * (number % 2))
        ideal = Camera.look_at(place, (0, 0, 0.9), size, np.radians(60))
        cameras[f"view_{number + 1}"] = Camera(ideal.size, ideal.K, ideal.R, ideal.t, LENS)
    return cameras


def studio_cameras(cameras: int | str | Mapping[str, Camera]) -> dict[str, Camera]:
    """A ring of cameras, or ``shelf``: those of the Shelf data set, of a stand-in where it is absent."""
    if isinstance(cameras, Mapping):
        return dict(cameras)
    if isinstance(cameras, int):
        return ring(cameras)
    shared = SHARED_DATA / "calib" / "shelf_4dassociation.json"
    found = read_calibration(shared if shared.is_file() else calibration_path("own_shelf.json"))
    return {f"view_{name}": camera for name, camera in found.items()}


def make_studio(
    folder: Path,
    human: str = "adult_woman",
    motion: str = "walk",
    cameras: int | str | Mapping[str, Camera] = 4,
    frames: int = 1,
    rate: float = 25.0,
    begin: int = 0,
    keypoints: str = "coco17",
    noise: float = 0.0,
    outliers: float = 0.0,
    images: bool = True,
    jpeg: int | None = 92,
    gains: Sequence[Sequence[float]] | None = None,
    pixel_noise: float = 0.0,
    start_human: str = "adult_man",
    position: tuple[float, float] = (0.0, 0.0),
    seed: int = 0,
    light: Mapping[str, Any] | None = None,
) -> Studio:
    """Render a person and write views.yaml, its calibration, photographs, masks and 2D points.

    Args:
        folder: Folder of the files.
        human: Built-in human that is photographed.
        motion: Built-in motion; ``begin`` is its first frame at ``rate`` Hz.
        cameras: Number of cameras around the person, ``shelf``, or cameras by name.
        frames: Number of frames.
        rate: Frames per second.
        begin: Number of the first frame.
        keypoints: Set of the points.
        noise: Standard deviation of the points, pixels.
        outliers: Share of the points that are anywhere near the person.
        images: Write images; only points and masks otherwise.
        jpeg: Quality of JPEG images; PNG if None.
        gains: Factors of red, green and blue of each camera, of sRGB values.
        pixel_noise: Standard deviation of the colours, of 255.
        start_human: Human that views.yaml names.
        position: Place of the motion in ``map``, metres.
        seed: Seed of all noise.
        light: Section ``light`` of the scene.
    """
    rig = studio_cameras(cameras)
    folder.mkdir(parents=True, exist_ok=True)
    write_calibration(folder / "calibration.toml", rig)
    rng = np.random.default_rng(seed)
    chosen = keypoint_set(keypoints)
    scene = Scene.from_dict(
        {
            "rate": rate,
            "room": None,
            "light": {"shadows": "none", **(light or {})},
            "humans": {PERSON: {"body": human, "motion": {"file": motion, "position": list(position)}}},
            "rig": {"file": "calibration.toml"},
        },
        folder,
    )
    names = list(scene.scene_cameras)
    all_joints, all_vertices, all_masks, all_points, noisy = [], [], [], [], []
    channels = ("rgb", "depth", "instance", "part") if images else ("depth", "instance", "part")
    with Simulation(scene, channels=channels) as simulation:
        for number in range(frames):
            frame = simulation.frame(begin + number)
            state = frame.humans[PERSON]
            all_joints.append(state.positions)
            all_vertices.append(state.vertices)
            masks, points = [], []
            for view, name in enumerate(names):
                seen = frame.views[name]
                mask = seen.instance == frame.labels[PERSON]
                masks.append(mask)
                points.append(_points(frame.keypoints[keypoints][name][PERSON]))
                _write(folder / f"{name}_mask" / f"{number:06d}.png", (mask * 255).astype(np.uint8))
                if images:
                    gain = np.ones(3) if gains is None else np.asarray(gains[view])
                    colours = (
                        seen.rgb * gain + rng.normal(0, pixel_noise, seen.rgb.shape)
                        if pixel_noise
                        else (seen.rgb * gain)
                    )
                    image = np.clip(np.rint(colours), 0, 255).astype(np.uint8)
                    suffix = "png" if jpeg is None else "jpg"
                    _write(folder / name / f"{number:06d}.{suffix}", image[..., ::-1], jpeg)
            all_masks.append(masks)
            all_points.append(points)
            noisy.append(
                [
                    _detected(each, mask, noise, outliers, rng)
                    for each, mask in zip(points, masks, strict=True)
                ]
            )
    views = {}
    for view, name in enumerate(names):
        write_points(folder / "points" / f"{name}.json", chosen, [frame[view] for frame in noisy])
        views[name] = {"points": f"points/{name}.json", "mask": f"{name}_mask/*.png"}
        if images:
            views[name]["image"] = f"{name}/*.{'png' if jpeg is None else 'jpg'}"
    content = {
        "calibration": "calibration.toml",
        "keypoints": keypoints,
        "human": start_human,
        "period": 1 / rate,
        "views": views,
    }
    path = folder / "views.yaml"
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    return Studio(
        path,
        scene.actors[PERSON].human,
        {name: frame.cameras[name] for name in names},
        chosen,
        np.array(all_joints),
        np.array(all_vertices),
        np.array(all_masks),
        np.array(all_points),
    )


def _points(view: Any) -> NDArray[np.float64]:
    """True points (K, 3) of a view."""
    visible = np.asarray(view.visible)
    confidence = np.where(visible == OUTSIDE, 0.0, np.where(visible == VISIBLE, 1.0, 0.5))
    pixels = np.where(confidence[:, None] > 0, view.pixels, 0.0)
    return np.column_stack([pixels, confidence])


def _detected(
    points: NDArray[np.float64],
    mask: NDArray[np.bool_],
    noise: float,
    outliers: float,
    rng: np.random.Generator,
) -> NDArray[np.float64]:
    """Points as a detector gives them: noisy, and some of them anywhere near the person."""
    found = points.copy()
    found[:, :2] += rng.normal(0, noise, (len(points), 2)) if noise else 0.0
    if outliers and mask.any():
        rows, columns = np.nonzero(mask)
        low, high = np.array([columns.min(), rows.min()]), np.array([columns.max(), rows.max()])
        wrong = rng.random(len(points)) < outliers
        found[wrong, :2] = rng.uniform(low - 30, high + 30, (int(wrong.sum()), 2))
    found[points[:, 2] == 0] = 0.0
    return found


def _write(path: Path, image: NDArray[np.uint8], quality: int | None = None) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    options = [] if quality is None else [cv2.IMWRITE_JPEG_QUALITY, quality]
    assert cv2.imwrite(str(path), np.ascontiguousarray(image), options)


def change_views(path: Path, **changes: Any) -> Path:
    """Write another views file beside ``path`` with changed keys; ``None`` removes a key."""
    content = yaml.safe_load(path.read_text())
    for key, value in changes.items():
        if value is None:
            content.pop(key, None)
        else:
            content[key] = value
    other = path.with_name(f"{path.stem}_changed.yaml")
    other.write_text(yaml.safe_dump(content, sort_keys=False))
    return other


def write_json(path: Path, content: Any) -> Path:
    """Write a JSON file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))
    return path
