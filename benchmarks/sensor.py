"""Cost of each effect of a sensor, and of depth sensors: milliseconds of one core per image, compared with a
copy of the image.

The images are those of the demo scene. All effects alternate in one process, so that other load affects them
alike. Rendering is not included: of images for motion blur and rolling shutter, and of exact depth.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from humansim_ros.cameras import Camera, DepthSensor, DepthSensorConfig, Sensor, SensorConfig
from humansim_ros.cameras.sensor.depth import aligned, metres, points_of
from humansim_ros.data.messages.points import image_points_message
from humansim_ros.render import Body, GLRenderer
from humansim_ros.render.device.pixel_geometry import pixel_rays
from humansim_ros.scene import Scene

EFFECTS: dict[str, dict[str, Any]] = {
    "no effect": {},
    "exposure, gain or response": {"exposure": 0.9},
    "white balance": {"white_balance": (1.1, 1.0, 0.9)},
    "vignetting": {"vignetting": {"cos4": True}},
    "chromatic aberration": {"chromatic_aberration": {"red": 1.0, "blue": -1.0}},
    "noise": {"noise": {}},
    "noise of a dark image: 100 electrons at white": {"noise": {}, "exposure": 0.01, "gain_db": 40},
    "noise, vignetting, response 2.2": {"noise": {}, "vignetting": {"cos4": True}, "response": 2.2},
    "motion blur, 8 samples": {"exposure_time": 0.01},
    "rolling shutter, 8 samples": {"rolling_shutter": 3e-5},
    "rolling shutter with motion blur, 8 samples": {"rolling_shutter": 3e-5, "exposure_time": 0.01},
    "jpeg 90": {"jpeg": 90},
    "jpeg 90 of a noisy image": {"jpeg": 90, "noise": {}},
    "bgr8": {"encoding": "bgr8"},
    "mono8": {"encoding": "mono8"},
    "bayer_rggb8": {"encoding": "bayer_rggb8"},
    "bayer_rggb8 with noise and vignetting": {
        "encoding": "bayer_rggb8",
        "noise": {},
        "vignetting": {"cos4": True},
    },
    "all of rgb8": {
        "exposure_time": 0.01,
        "rolling_shutter": 3e-5,
        "white_balance": (1.1, 1.0, 0.9),
        "noise": {},
        "vignetting": {"cos4": True},
        "chromatic_aberration": {"red": 1.0, "blue": -1.0},
        "jpeg": 90,
    },
}


#: Settings of depth sensors with the optics of the camera.
DEPTH_SENSORS: dict[str, dict[str, Any]] = {
    "structured light": {"model": "structured_light"},
    "active stereo": {"model": "active_stereo"},
    "time of flight": {"model": "time_of_flight"},
}


def depth_cases(
    renderer: GLRenderer, bodies: list[Body], camera: Camera
) -> dict[str, Callable[[int], object]]:
    """What depth sensors compute from exact depth."""
    view = renderer.render(bodies, camera, ("rgb", "depth"))
    cases: dict[str, Callable[[int], object]] = {}
    for name, keys in DEPTH_SENSORS.items():
        config = DepthSensorConfig.model_validate({**keys, "size": camera.size, "K": camera.K.tolist()})
        sensor = DepthSensor(config)
        other = sensor.second_camera(camera)
        second = None if other is None else renderer.render(bodies, other, ("depth",)).depth
        colours = view.rgb if sensor.needs_light else None
        cases[f"depth: {name}"] = partial(sensor.measure, view.depth, second=second, colours=colours)
    beside = replace(camera, t=camera.t + np.array([0.03, 0, 0]))
    millimetres = np.rint(1000 * view.depth).astype(np.uint16)
    rays = pixel_rays(camera)
    cases["depth: alignment"] = lambda _: aligned(millimetres, rays, camera, beside)
    points = points_of(metres(millimetres), rays)
    cases["depth: points"] = lambda _: image_points_message(
        points_of(metres(millimetres), rays), None, 1, "a"
    )
    cases["depth: message of coloured points"] = lambda _: image_points_message(points, view.rgb, 1, "a")
    return cases


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=60, help="images of each effect (default: %(default)s)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there too")
    options = parser.parse_args()
    cv2.setNumThreads(1)

    scene = Scene.load()
    name, camera = next(iter(scene.cameras.items()))
    bodies = [actor.body(actor.at(0.5).vertices) for actor in scene.actors.values()]
    renderer = GLRenderer(scene.static_meshes)
    image = renderer.render(bodies, camera, ("rgb",)).rgb
    cases: dict[str, Callable[[int], object]] = {"a copy of the image": lambda _: image.copy()}
    for effect, config in EFFECTS.items():
        sensor = Sensor(SensorConfig(**config), camera, name)
        images = [image] * len(sensor.times())
        cases[effect] = lambda stamp, sensor=sensor, images=images: sensor.expose(images, stamp)
    cases |= depth_cases(renderer, bodies, camera)
    times: dict[str, list[float]] = {case: [] for case in cases}
    for number in range(-2, options.rounds):  # the first two warm up
        for case, run in cases.items():
            start = time.perf_counter()
            run(number + 10)
            if number >= 0:
                times[case].append((time.perf_counter() - start) * 1e3)

    copy = float(np.median(times["a copy of the image"]))
    print(f"{'ms per image, ' + 'x'.join(map(str, camera.size)):<52} {'median':>8} {'best':>8} {'x copy':>8}")
    rows = []
    for case, values in times.items():
        median, best = float(np.median(values)), float(np.min(values))
        print(f"{case:<52} {median:8.2f} {best:8.2f} {median / copy:8.1f}")
        rows.append({"what": case, "median_ms": median, "best_ms": best, "x_copy": median / copy})
    if options.json:
        options.json.write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    main()
