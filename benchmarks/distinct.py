"""How distinct random people are: whether a person is known again in another view by colours and shape.

    python benchmarks/distinct.py [--count 500] [--seed 1]

Each person stands in two images, seen from 20 degrees to the left and to the right. In each of 40 bands of
height, of 5.5 cm, an image has the width of the person and the mean and the deviation of its colours
(CIELAB); they are divided by their mean difference between the two images of a person, at least a tenth of
their deviation between people. Printed are how many people have a second image that is nearer to the first
than those of all others, and how many pairs of people are nearer than the two most different images of one
person.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parent.parent))

from humansim_ros.cameras import Camera
from humansim_ros.geometry import WORLD_FROM_BODY, transform
from humansim_ros.people import Human, draw_person, make_person
from humansim_ros.render import Body, GLRenderer, Lighting

#: Bands of height, and their height in metres.
BANDS, BAND = 40, 0.055
SIZE = (220, 440)
#: Width of a band in metres below which its colours count less, as of the top of a head.
SEEN = 0.05


def camera(side: float) -> Camera:
    """A camera 6 m away that sees 2.2 m above the floor, ``side`` degrees beside the front of a person."""
    angle = np.radians(side)
    eye = (6 * np.cos(angle), 6 * np.sin(angle), BANDS * BAND / 2)
    return Camera.look_at(
        eye, (0, 0, eye[2]), SIZE, float(2 * np.arctan(SIZE[0] / SIZE[1] * BANDS * BAND / 12))
    )


def features(renderer: GLRenderer, human: Human, side: float) -> NDArray[np.float64]:
    """(BANDS, 7) width in metres, mean and deviation of L, a and b; zeros where nobody is."""
    vertices = human.pose(transform(WORLD_FROM_BODY, np.zeros(3)) @ human.skeleton.rest)
    view = renderer.render(
        [Body(human.mesh, vertices, human.triangle_parts, 1)], camera(side), ("rgb", "instance")
    )
    lab = cv2.cvtColor(view.rgb.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
    found = np.zeros((BANDS, 7))
    height = SIZE[1] // BANDS
    for band in range(BANDS):
        rows = slice(band * height, (band + 1) * height)
        colours = lab[rows][view.instance[rows] > 0]
        if len(colours):
            width = len(colours) / height * BAND / height
            seen = min(1.0, width / SEEN)
            found[band] = (width, *(seen * colours.mean(axis=0)), *(seen * colours.std(axis=0)))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--count", type=int, default=500, help="people")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    start = time.perf_counter()
    seen = []
    with GLRenderer([], Lighting()) as renderer:
        for number in range(options.count):
            human = make_person(draw_person(options.seed, number), f"person_{number}")
            seen.append([features(renderer, human, side).ravel() for side in (20.0, -20.0)])
    first, second = np.array(seen).transpose(1, 0, 2)
    scale = np.maximum(np.abs(first - second).mean(axis=0), np.std(seen, axis=(0, 1)) / 10)
    first, second = (each[:, scale > 0] / scale[scale > 0] for each in (first, second))
    distance = np.array([np.sqrt(((second - one) ** 2).mean(axis=1)) for one in first])
    own = distance.diagonal().copy()
    np.fill_diagonal(distance, np.inf)
    others = np.minimum(distance.min(axis=0), distance.min(axis=1))
    known = own < others
    print(f"{options.count} people of seed {options.seed} in {time.perf_counter() - start:.0f} s")
    pairs = np.count_nonzero(np.minimum(distance, distance.T)[np.triu_indices(len(own), 1)] < own.max())
    print(f"known again: {np.count_nonzero(known)} of {options.count}; pairs nearer than one person: {pairs}")
    print(
        f"distance to the own other image: median {np.median(own):.2f}, largest {own.max():.2f}; to the "
        f"nearest of others: median {np.median(others):.2f}, smallest {others.min():.2f}"
    )
    for number in np.flatnonzero(~known)[:20]:
        nearest = int(distance[number].argmin())
        print(f"  person {number}: own {own[number]:.2f}, person {nearest} {distance[number, nearest]:.2f}")


if __name__ == "__main__":
    main()
