#!/usr/bin/env python3
"""Cost of light, shadows and materials: CPU milliseconds of all threads per 640x480 image of the demo scene.

rgb, depth, instance and part of four cameras. All settings are rendered in turn in one process, so that other
work on the machine affects all of them alike.

    python benchmarks/look.py [--rounds 40]
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from humansim_ros.render import CHANNELS, Body, GLRenderer, Lighting
from humansim_ros.scene import Scene

#: Setting -> lighting and channels.
SETTINGS = {
    "contact shadows (default)": (Lighting(), CHANNELS),
    "no shadows": (Lighting(shadows="none"), CHANNELS),
    "no ambient occlusion": (Lighting(ambient_occlusion=False), CHANNELS),
    "materials: false": (Lighting(materials=False), CHANNELS),
    "shadeless": (Lighting(mode="shadeless"), CHANNELS),
    "filmic": (Lighting(tone_mapping="filmic"), CHANNELS),
    "soft shadows": (Lighting(shadows="soft"), CHANNELS),
    "soft shadows, and channel shadow": (Lighting(shadows="soft"), (*CHANNELS, "shadow")),
    "contact shadows, and channel shadow": (Lighting(), (*CHANNELS, "shadow")),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--rounds", type=int, default=40, help="frames of each setting (default: %(default)s)"
    )
    rounds = parser.parse_args().rounds
    scene = Scene.load()
    actor = next(iter(scene.actors.values()))
    cameras = list(scene.cameras.values())
    renderers = {name: GLRenderer(scene.static_meshes, light) for name, (light, _) in SETTINGS.items()}
    times: dict[str, list[float]] = {name: [] for name in SETTINGS}
    first: dict[str, float] = {}
    for number in range(rounds + 1):
        vertices = actor.at(0.1 * number).vertices
        for name, (_, channels) in SETTINGS.items():
            body = Body(actor.human.mesh, vertices, actor.human.triangle_parts, 1)
            start = time.process_time()
            for camera in cameras:
                renderers[name].render([body], camera, channels)
            spent = 1000 * (time.process_time() - start) / len(cameras)
            if number:
                times[name].append(spent)
            else:
                first[name] = spent
    medians = {name: float(np.median(values)) for name, values in times.items()}
    base = medians["contact shadows (default)"]
    device = next(iter(renderers.values())).device
    print(f"{'':38}{'ms':>7}{'x default':>11}{'first image, ms':>20}   on {device}")
    for name, value in medians.items():
        print(f"{name:38}{value:7.1f}{value / base:11.2f}{first[name]:20.0f}")


if __name__ == "__main__":
    main()
