#!/usr/bin/env python3
"""What looks cost: CPU milliseconds (of all threads) per 640x480 picture (rgb, depth, instance, part) of the
demo scene's four cameras, side by side in one process, so that a busy machine shows in all of them alike.

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

LOOKS = {
    "contact shadows (default)": (Lighting(), CHANNELS),
    "no shadows": (Lighting(shadows="none"), CHANNELS),
    "no ambient occlusion": (Lighting(ambient_occlusion=False), CHANNELS),
    "all matt": (Lighting(materials=False), CHANNELS),
    "shadeless": (Lighting(mode="shadeless"), CHANNELS),
    "filmic": (Lighting(tone_mapping="filmic"), CHANNELS),
    "soft shadows": (Lighting(shadows="soft"), CHANNELS),
    "soft shadows, and channel shadow": (Lighting(shadows="soft"), (*CHANNELS, "shadow")),
    "contact shadows, and channel shadow": (Lighting(), (*CHANNELS, "shadow")),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=40)
    rounds = parser.parse_args().rounds
    scene = Scene.load()
    actor = next(iter(scene.actors.values()))
    cameras = list(scene.cameras.values())
    renderers = {name: GLRenderer(scene.static_meshes, light) for name, (light, _) in LOOKS.items()}
    times: dict[str, list[float]] = {name: [] for name in LOOKS}
    first: dict[str, float] = {}
    for number in range(rounds + 1):
        vertices = actor.at(0.1 * number).vertices
        for name, (_, channels) in LOOKS.items():
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
    print(f"{'':38}{'ms':>7}{'x default':>11}{'first picture, ms':>20}   on {renderers[name].device}")
    for name, value in medians.items():
        print(f"{name:38}{value:7.1f}{value / base:11.2f}{first[name]:20.0f}")


if __name__ == "__main__":
    main()
