"""How long texturing takes, and how well the person looks from new views.

    python benchmarks/texture.py [--rounds N] [--human NAME] [--size W H]

A built-in human is photographed without shading by 4 and by 8 cameras with a lens, as JPEG, with and without
differences of colour between the cameras. Both methods texture the human without its texture in the known
pose. The pictures from new views are compared with those of the human itself: all pixels of the person, and
those of triangles that some camera has seen.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

from humansim_ros.cameras import Camera  # noqa: E402
from humansim_ros.people import Human, load_human  # noqa: E402
from humansim_ros.photographs.atlas_texture import texture_atlas  # noqa: E402
from humansim_ros.photographs.surface import TexturedPerson, TextureView, texture_thesis  # noqa: E402
from humansim_ros.render import Body, GLRenderer, Lighting  # noqa: E402
from humansim_ros.types import Float32Array, Image  # noqa: E402

#: plumb_bob, as of a small camera.
LENS = (-0.12, 0.04, 0.001, -0.0008, 0.0)
QUALITY = 92
METHODS: dict[str, Callable[[Human, Sequence[TextureView]], TexturedPerson]] = {
    "thesis": texture_thesis,
    "atlas": texture_atlas,
}


def ring(count: int, size: tuple[int, int], turn: float = 0.0) -> list[Camera]:
    """Cameras around a standing person."""
    cameras = []
    for number in range(count):
        angle = 2 * np.pi * (number + 0.5 + turn) / count
        place = (3 * np.cos(angle), 3 * np.sin(angle), 1.3 + 0.4 * (number % 2))
        camera = Camera.look_at(place, (0, 0, 0.9), size)
        cameras.append(replace(camera, distortion=LENS, model=None))
    return cameras


def pictures(
    human: Human, vertices: Float32Array, cameras: Sequence[Camera]
) -> list[tuple[Image, NDArray[np.int32]]]:
    """Images without shading, and face images."""
    with GLRenderer(lighting=Lighting(mode="shadeless")) as renderer:
        body = Body(human.mesh, vertices, human.triangle_parts, 1)
        seen = [renderer.render([body], camera, ("rgb", "face")) for camera in cameras]
    return [(view.rgb, view.face) for view in seen]


def jpeg(image: Image, gains: NDArray[np.float64]) -> Image:
    """The image as a camera with other colours writes it."""
    changed = np.clip(np.rint(image * gains), 0, 255).astype(np.uint8)
    _, encoded = cv2.imencode(".jpg", changed[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    return np.asarray(cv2.imdecode(encoded, cv2.IMREAD_COLOR)[..., ::-1], dtype=np.uint8)


def psnr(pairs: Sequence[tuple[NDArray[np.uint8], NDArray[np.uint8]]]) -> float:
    """Peak signal to noise ratio of pixels, dB."""
    errors = np.concatenate([(one.astype(float) - other).ravel() for one, other in pairs])
    return float(10 * np.log10(255**2 / np.mean(errors**2)))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--human", default="adult_woman")
    parser.add_argument("--size", type=int, nargs=2, default=(640, 480), metavar=("W", "H"))
    options = parser.parse_args()
    human, size = load_human(options.human), tuple(options.size)
    bare = replace(human, mesh=replace(human.mesh, texture=None, skin=None), looks={}, outfit="default")
    upright = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    rotations = np.tile([0.0, 0.0, 0.0, 1.0], (len(human.skeleton), 1))
    vertices = human.pose(human.skeleton.pose(rotations, upright))
    truth = pictures(human, vertices, new := ring(5, size, 0.31))
    print(f"{options.human}: {len(vertices)} vertices, images of {size[0]} x {size[1]}, lens, JPEG {QUALITY}")
    print("| views | colours | method | s | all, dB | seen, dB |\n|---|---|---|---|---|---|")
    rng = np.random.default_rng(0)
    for count in (4, 8):
        cameras = ring(count, size)
        clean = pictures(human, vertices, cameras)
        for colours in ("equal", "0.8 to 1.25"):
            gains = np.exp(rng.uniform(-1, 1, (count, 3)) * np.log(1.25)) ** (colours != "equal")
            gains /= np.exp(np.log(gains).mean(axis=0))
            views = [
                TextureView(f"view_{n}", camera, jpeg(image, gain), vertices)
                for n, (camera, (image, _), gain) in enumerate(zip(cameras, clean, gains, strict=True))
            ]
            for name, method in METHODS.items():
                seconds = []
                for _ in range(options.rounds):
                    start = time.perf_counter()
                    person = method(bare, views)
                    seconds.append(time.perf_counter() - start)
                found = pictures(person.human, vertices, new)
                whole, seen = [], []
                for (expected, face), (image, _) in zip(truth, found, strict=True):
                    whole.append((image[face > 0], expected[face > 0]))
                    known = (face > 0) & person.seen[face - 1]
                    seen.append((image[known], expected[known]))
                print(
                    f"| {count} | {colours} | {name} | {min(seconds):.2f} | {psnr(whole):.1f} | "
                    f"{psnr(seen):.1f} |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
