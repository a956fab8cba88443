"""Cost of each effect of a sensor: milliseconds of one core per image, compared with a copy of the image.

The images are those of the demo scene. All effects alternate in one process, so that other load affects them
alike. The rendering of images for motion blur and rolling shutter is not included.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from humansim_ros.render import GLRenderer
from humansim_ros.scene import Scene
from humansim_ros.sensor import Sensor, SensorConfig

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
    image = GLRenderer(scene.static_meshes).render(bodies, camera, ("rgb",)).rgb
    assert image is not None
    cases: dict[str, Callable[[int], object]] = {"a copy of the image": lambda _: image.copy()}
    for effect, config in EFFECTS.items():
        sensor = Sensor(SensorConfig(**config), camera, name)
        images = [image] * len(sensor.times())
        cases[effect] = lambda stamp, sensor=sensor, images=images: sensor.expose(images, stamp)
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
