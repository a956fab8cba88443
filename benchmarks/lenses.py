"""Cost of a lens: frames of the demo scene with each lens model, compared with an ideal camera; and moving
cameras, compared with a bare draw: room and person once, one sample in each pixel, read back. Blender's
Workbench draws the same, if HUMANSIM_BENCH_BLENDER names a Python with bpy.

All lenses are interleaved in one process, frame by frame and in changing order, so that other load
affects all of them. The figures are medians of wall-clock milliseconds; read the ratios.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import moderngl
import numpy as np
from core import workbench

from humansim_ros.cameras import Camera
from humansim_ros.files.mesh.mesh import Mesh
from humansim_ros.render import CHANNELS, Body, GLRenderer
from humansim_ros.render.device.context import lit_program, set_uniform, use_camera
from humansim_ros.render.frame.body_buffers import ProjectedPoints
from humansim_ros.render.frame.gl import _SeenBody
from humansim_ros.render.frame.static_scene import UNIT
from humansim_ros.scene import Scene

#: Calibrations of real cameras; the fisheye's coefficients are made up.
LENSES: dict[str, tuple[tuple[float, ...], str | None]] = {
    "ideal": ((), None),
    "plumb_bob": ((-0.361976, 0.110510, 0.001014, 0.000505, 0.0), "plumb_bob"),
    "rational_polynomial": (
        (0.189544, -0.018229, -0.00063, 0.000054, -0.000212, 0.543582, -0.027892, 0.0),
        "rational_polynomial",
    ),
    "equidistant": ((-0.013, 0.021, -0.0031, 0.0004), "equidistant"),
}
Draw = Callable[[Body, Camera, int], object]


def through(camera: Camera, lens: str) -> Camera:
    coefficients, model = LENSES[lens]
    return replace(camera, distortion=coefficients, model=model)


def steady(renderer: GLRenderer, lens: str, channels: Sequence[str]) -> Draw:
    """Render a frame of a static camera."""
    return lambda body, camera, _: renderer.render([replace(body)], through(camera, lens), channels)


def moving(renderer: GLRenderer, lens: str) -> Draw:
    """Render a frame of a camera that moves one centimetre per frame."""

    def draw(body: Body, camera: Camera, number: int) -> object:
        there = replace(through(camera, lens), t=camera.t + 0.01 * (number % 20))
        return renderer.render([replace(body)], there, CHANNELS, moving_camera=True)

    return draw


def bare(meshes: Sequence[Mesh]) -> Draw:
    """Draw the room and the person once, without lens and without anti-aliasing, and read the images: all
    triangles of the room, its textures filtered in the usual way.
    """
    renderer = GLRenderer(meshes)
    ctx, static = renderer._ctx, renderer._static
    with renderer._context.current():
        program = lit_program(ctx, static._lighting, ("STATIC_SCENE", "AMBIENT_OCCLUSION"))
        set_uniform(program, "light_map", UNIT)
        for material in static._scene._materials:
            material.texture.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)

    def draw(body: Body, camera: Camera, number: int) -> object:
        there = replace(camera, t=camera.t + 0.01 * (number % 20))
        with renderer._context.current():
            target = renderer._targets.of(there.size)
            if static._light_map is not None:
                static._light_map.use()
            use_camera(ctx, program, there)
            static._draw(target, static._scene.whole, program)
            posed = renderer._bodies.pose(replace(body))
            projected = ProjectedPoints(posed.posed.points, there)
            nothing = np.full(there.size[::-1], np.inf, np.float32)
            renderer._draw([_SeenBody(0, posed, projected)], target, True, nothing)
            return [target.read(name, True) for name in ("rgba", "depth", "triangle_id")]

    return draw


def first(renderer: GLRenderer, lens: str) -> Draw:
    """Render the first frame of a new camera with a new lens: nothing is cached."""
    coefficients, model = LENSES[lens]

    def draw(body: Body, camera: Camera, number: int) -> object:
        own = tuple(k * (1 + 1e-6 * number) for k in coefficients)
        there = replace(camera, t=camera.t + 0.001 * number, distortion=own, model=model)
        return renderer.render([replace(body)], there, CHANNELS)

    return draw


def compare(title: str, draws: dict[str, Draw], shots: Sequence[tuple[Body, Camera]], rounds: int) -> object:
    """Print and return the median of each contestant, and its ratio to that of the first one."""
    times: dict[str, list[float]] = {lens: [] for lens in draws}
    order = list(draws)
    for number in range(-4, rounds):  # the first four warm up
        body, camera = shots[number % len(shots)]
        order.append(order.pop(0))
        for lens in order:
            start = time.perf_counter()
            draws[lens](body, camera, number + 100)
            if number >= 0:
                times[lens].append((time.perf_counter() - start) * 1e3)
    reference = next(iter(draws))
    print(f"\n{title:<52} {'median':>8} {'best':>8}   x {reference}")
    unit, rows = float(np.median(times[reference])), []
    for lens, values in times.items():
        median, best = float(np.median(values)), float(np.min(values))
        print(f"{lens:<52} {median:8.2f} {best:8.2f} {median / unit:8.2f}")
        rows.append({"lens": lens, "median_ms": median, "best_ms": best, f"x_{reference}": median / unit})
    return rows


#: Cameras of a new renderer: number, size, lens.
FIRST_FRAMES = [
    (4, (640, 480), "ideal"),
    (1, (1920, 1080), "ideal"),
    (4, (1920, 1080), "ideal"),
    *((1, (1280, 1024), lens) for lens in LENSES),
]


def first_frames(scene: Scene) -> object:
    """Print and return milliseconds of the first frame of a new renderer: rgb of the room, best of three."""
    rows = []
    print(f"\n{'ms: first frame of a new renderer, rgb of the room':<52} {'wall':>8} {'CPU':>8}")
    positions = [(2.8, 2.3, 2.2), (-2.8, 2.3, 2.2), (-2.8, -2.3, 2.2), (2.8, -2.3, 2.2)]
    for count, size, lens in FIRST_FRAMES:
        times = []
        for _ in range(3):
            renderer = GLRenderer(scene.static_meshes)
            start = time.perf_counter(), time.process_time()
            for position in positions[:count]:
                camera = Camera.look_at(position, (0, 0, 1), size=size)
                renderer.render([], through(camera, lens), ("rgb",))
            times.append((time.perf_counter() - start[0], time.process_time() - start[1]))
            renderer.close()
        wall, cpu = (1e3 * min(column) for column in zip(*times, strict=True))
        name = f"{count} of {size[0]}x{size[1]}, {lens}"
        print(f"{name:<52} {wall:8.0f} {cpu:8.0f}")
        rows.append({"cameras": name, "wall_ms": wall, "cpu_ms": cpu})
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--rounds", type=int, default=160, help="frames of each contestant (default: %(default)s)"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there too")
    options = parser.parse_args()

    scene = Scene.load()
    actor, cameras = next(iter(scene.actors.values())), list(scene.cameras.values())
    bodies = [actor.body(actor.at(0.25 * number).vertices) for number in range(16)]
    shots = [(body, cameras[number % len(cameras)]) for number, body in enumerate(bodies)]
    renderer = GLRenderer(scene.static_meshes)
    print(f"{renderer.device}, {os.cpu_count()} cores; {len(cameras)} cameras, {cameras[0].size}")
    figures: dict[str, object] = {"device": renderer.device, "cores": os.cpu_count()}
    for title, channels in (
        ("ms: rgb, depth, instance, part", CHANNELS),
        ("ms: rgb alone", ("rgb",)),
        ("ms: depth, instance, part", ("depth", "instance", "part")),
    ):
        draws = {lens: steady(renderer, lens, channels) for lens in LENSES}
        figures[title] = compare(title, draws, shots, options.rounds)
    title = "ms: rgb, depth, instance, part, moving camera"
    draws = {"bare draw": bare(scene.static_meshes), **{lens: moving(renderer, lens) for lens in LENSES}}
    moved = [replace(cameras[n % len(cameras)], t=cameras[n % len(cameras)].t + 0.01 * n) for n in range(20)]
    with workbench(os.environ.get("HUMANSIM_BENCH_BLENDER", sys.executable), scene, moved) as (name, blender):
        if name:
            draws[f"{name} Workbench, one sample, to a PNG file"] = lambda _, __, n: blender(n % 20)
        figures[title] = compare(title, draws, shots, max(options.rounds // 8, 1))
    title = "ms: rgb, depth, instance, part, first frame"
    draws = {lens: first(renderer, lens) for lens in LENSES}
    figures[title] = compare(title, draws, shots, max(options.rounds // 16, 1))
    figures["ms: first frame of a new renderer"] = first_frames(scene)
    if options.json:
        options.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
