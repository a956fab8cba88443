"""Render each effect of a sensor (docs/images/sensors.jpg), what depth sensors measure
(docs/images/depth_cameras.jpg), and measure the error of constant velocities.

python tools/figures/sensor_figures.py picture OUTPUT
python tools/figures/sensor_figures.py depth OUTPUT
python tools/figures/sensor_figures.py velocity [MILLISECONDS ...]
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from humansim_ros.cameras import Camera, Sensor, SensorConfig
from humansim_ros.cameras.sensor.depth import metres
from humansim_ros.files.reading.assets import built_in_names, resource_path
from humansim_ros.geometry import moved
from humansim_ros.render import GLRenderer
from humansim_ros.scene import Scene, Simulation
from humansim_ros.scene.config.config import SceneConfig, load_config
from humansim_ros.scene.core.actor import Actor
from humansim_ros.scene.core.scene import DEMO_SCENE
from humansim_ros.scene.core.source import SceneSource
from humansim_ros.scene.pictures.views import color_depth
from humansim_ros.types import Image

_SIZE = (400, 300)
_CAMERA = Camera.look_at((2.6, -2.3, 1.5), (0.3, 0.1, 0.85), _SIZE, float(np.radians(58)))
#: Time of the motion ``run`` in the images, seconds.
_SHOWN = 0.53
#: Enlarged part of the image with the human: x, y, width.
_FIGURE = (92, 52, 100)
#: Tiles: title, settings of the sensor, and the enlarged part (x, y, width), or None for the whole image.
_TILES: list[tuple[str, dict[str, Any], tuple[int, int, int] | None]] = [
    ("as rendered", {}, None),
    ("exposure 0.35", {"exposure": 0.35}, None),
    ("response linear", {"response": "linear"}, None),
    ("white balance 1.3, 1, 0.75", {"white_balance": (1.3, 1.0, 0.75)}, None),
    ("noise: exposure 0.02, 34 dB", {"noise": {}, "exposure": 0.02, "gain_db": 34}, None),
    ("noise, enlarged", {"noise": {}, "exposure": 0.02, "gain_db": 34}, _FIGURE),
    ("vignetting: cos4, corner 0.5", {"vignetting": {"cos4": True, "corner": 0.5}}, None),
    ("motion blur: 40 ms", {"exposure_time": 0.04, "samples": 24}, None),
    ("rolling shutter: 0.3 ms a row", {"rolling_shutter": 3e-4, "samples": 60}, None),
    ("chromatic aberration 3, -3 pixels", {"chromatic_aberration": {"red": 3, "blue": -3}}, (10, 30, 100)),
    ("jpeg 15", {"jpeg": 15}, _FIGURE),
    ("bayer_rggb8", {"encoding": "bayer_rggb8"}, (20, 50, 48)),
]


def scene_of(motion: str, room: bool = True) -> Scene:
    """Demo scene with one human, with or without its room."""
    path = resource_path(DEMO_SCENE)
    human = {"motion": {"file": motion, "anchor": "center", "yaw_deg": 20}}
    config = load_config(path).model_dump() | {"humans": {"one": human}} | ({} if room else {"room": None})
    return Scene.from_config(SceneConfig.model_validate(config), SceneSource.of_file(path))


def draw(scene: Scene, renderer: GLRenderer, config: SensorConfig) -> Image:
    """Render an image of a sensor, with samples from the motion itself."""
    actor, sensor = scene.actors["one"], Sensor(config, _CAMERA)
    pictures = []
    for time in sensor.times():
        view = renderer.render([actor.body(actor.at(_SHOWN + time).vertices)], _CAMERA, ("rgb",))
        pictures.append(view.rgb)
    picture = sensor.expose(pictures, 1)
    return picture if picture.ndim == 3 else cv2.cvtColor(picture, cv2.COLOR_GRAY2RGB)


def tile(picture: Image, text: str, part: tuple[int, int, int] | None) -> Image:
    if part is not None:
        x, y, width = part
        picture = picture[y : y + width * _SIZE[1] // _SIZE[0], x : x + width]
        picture = cv2.resize(picture, _SIZE, interpolation=cv2.INTER_NEAREST)
    out = cv2.copyMakeBorder(picture, 26, 4, 4, 4, cv2.BORDER_CONSTANT, value=(28, 28, 28))
    cv2.putText(out, text, (8, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (235, 235, 235), 1, cv2.LINE_AA)
    return out


def picture(output: Path) -> None:
    scene = scene_of("run")
    renderer = GLRenderer(scene.static_meshes)
    tiles = [tile(draw(scene, renderer, SensorConfig(**c)), text, part) for text, c, part in _TILES]
    rows = [np.concatenate(tiles[i : i + 3], axis=1) for i in range(0, len(tiles), 3)]
    cv2.imwrite(str(output), np.concatenate(rows)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 75])


def depth(output: Path) -> None:
    """One view of the scene with depth cameras, measured by three sensors with the same optics."""
    path = resource_path("config/scenes/depth_camera.yaml")
    view = {"size": _SIZE, "position": (2.3, 0.3, 1.3), "look_at": (0, 0.1, 0.9), "fov_deg": 62}
    optics = {"size": _SIZE, "fov_deg": 62, "rotation_deg": (0, 0, 0), "range": (0.5, 7.0)}
    presets = ("kinect_v1", "realsense_d435", "azure_kinect_nfov")
    cameras = {name: {**view, "depth_sensor": {"preset": name, **optics}} for name in presets}
    config = load_config(path).model_dump() | {"cameras": cameras}
    scene = Scene.from_config(SceneConfig.model_validate(config), SceneSource.of_file(path))
    with Simulation(scene, ("rgb", "depth")) as simulation:
        frame = simulation.frame(22)
        kinect, stereo, flight = (frame.depth_sensors[name] for name in presets)
        tiles = [
            tile(frame.views["kinect_v1"].rgb, "image_raw", None),
            tile(color_depth(kinect.exact), "depth_sensor/image_truth", None),
            tile(color_depth(metres(kinect.aligned)), "aligned_depth_to_color (kinect_v1)", None),
            tile(color_depth(kinect.depth), "structured light (kinect_v1)", None),
            tile(color_depth(stereo.depth), "active stereo (realsense_d435)", None),
            tile(color_depth(flight.depth), "time of flight (azure_kinect_nfov)", None),
        ]
    rows = [np.concatenate(tiles[i : i + 3], axis=1) for i in range(0, len(tiles), 3)]
    cv2.imwrite(str(output), np.concatenate(rows)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 80])


def velocity_errors(actor: Actor, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Errors (N, V) of the vertices +- ``seconds`` from the stamp if joints keep their velocity, and their
    movement (N, V), metres, at sixty times of a motion.
    """
    errors, ways = [], []
    for time in np.linspace(0.1, min(actor.motion.cycle_length, 6.0) - 0.1, 60):
        now = actor.at(time)
        assert now.linear is not None and now.angular is not None
        for step in (-seconds, seconds):
            joints = moved(now.joints, now.linear, now.angular, step)
            true = actor.at(time + step).vertices
            vertices = actor.human.pose(joints[: len(actor.human.skeleton)])
            errors.append(np.linalg.norm(vertices - true, axis=1))
            ways.append(np.linalg.norm(now.vertices - true, axis=1))
    return np.array(errors), np.array(ways)


def velocity(milliseconds: list[float]) -> None:
    print(
        "| motion | ms | movement, mean / 99 % / largest, mm | error, mean / 99 % / largest, mm |\n"
        "|---|---|---|---|"
    )
    for motion in built_in_names("motions"):
        actor = scene_of(motion, room=False).actors["one"]
        for step in milliseconds:
            cells = [
                f"{values.mean():.2f} / {np.percentile(values, 99):.1f} / {values.max():.1f}"
                for values in (1e3 * part for part in reversed(velocity_errors(actor, step * 1e-3)))
            ]
            print(f"| {motion} | {step:g} | {' | '.join(cells)} |")


def main() -> int:
    if sys.argv[1:2] == ["picture"] and len(sys.argv) == 3:
        picture(Path(sys.argv[2]))
    elif sys.argv[1:2] == ["depth"] and len(sys.argv) == 3:
        depth(Path(sys.argv[2]))
    elif sys.argv[1:2] == ["velocity"]:
        velocity([float(value) for value in sys.argv[2:]] or [4.0, 8.0])
    else:
        print(__doc__)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
