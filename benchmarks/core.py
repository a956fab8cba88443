"""Cost of one camera and frame without ROS: one human in the demo scene, compared with other renderers.

All renderers draw the same posed triangles for the same cameras, interleaved, so that other load affects all
of them. The figures are medians of wall-clock milliseconds, and of CPU milliseconds of all threads, which
depend less on other load; read the ratios. humansim_ros renders the furnished room, shadow and light too; the
others render the body alone. aitviewer, Open3D and Blender run in processes of their own, with the Python
that an option or HUMANSIM_BENCH_AITVIEWER, _OPEN3D, _BLENDER names.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

os.environ.setdefault("PYOPENGL_PLATFORM", "egl")

import moderngl
import numpy as np
from scipy.spatial.transform import Rotation

from humansim_ros.cameras import Camera
from humansim_ros.data.formats.glb import AnimatedHuman, glb_bytes
from humansim_ros.files import Mesh
from humansim_ros.geometry import ObjectPose
from humansim_ros.render import ALL_CHANNELS, CHANNELS, AdjacentFrame, Body, GLRenderer
from humansim_ros.render.device.context import OpenGLContext
from humansim_ros.render.device.mesh_buffers import PosedMesh, ShadowCaster, Topology
from humansim_ros.render.frame.body_buffers import ProjectedPoints, contour
from humansim_ros.render.frame.edge_antialiasing import edge_crossings
from humansim_ros.render.frame.pyrender import import_pyrender
from humansim_ros.scene import Scene
from humansim_ros.scene.core.objects import SHAPES
from humansim_ros.types import Array
from humansim_ros.view.panels.stage import glb_of

#: glTF has y up; Blender turns it back.
_GLTF_FROM_MAP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
_NEAR, _FAR = 0.05, 200.0
#: Renderers in processes of their own. They are slow: they take part in one round of several.
GUESTS = ("aitviewer", "open3d", "blender")
_GUEST_ROUNDS = 5


@dataclass(frozen=True)
class Shot:
    """One frame to render: ``number`` of the ``frames`` of a moving body, and the camera."""

    number: int
    frames: Sequence[Body]
    camera: Camera

    @property
    def body(self) -> Body:
        return self.frames[self.number]


def shots(scene: Scene, count: int) -> list[Shot]:
    """Consecutive frames of the scene's first human; each camera has some of them."""
    actor = next(iter(scene.actors.values()))
    cameras = list(scene.cameras.values())
    times = 1.0 + scene.period * np.arange(count + 2)
    frames = [actor.body(actor.at(t).vertices) for t in times.tolist()]
    return [Shot(i, frames, cameras[(i - 1) * len(cameras) // count]) for i in range(1, count + 1)]


FOUR = "humansim_ros: rgb (anti-aliased), depth, instance, part"
EVERYTHING = "humansim_ros: all channels"
BARE = "bare draw: rgb, id, depth; no anti-aliasing"
SEGMENTED = "pyrender: rgb, depth, SEG pass by part"
CHANNEL_ROWS: dict[str, Sequence[str]] = {
    FOUR: CHANNELS,
    "humansim_ros: rgb alone": ("rgb",),
    "humansim_ros: depth, instance, part": ("depth", "instance", "part"),
    **{
        f"the four and {channel}": (*CHANNELS, channel) for channel in ALL_CHANNELS if channel not in CHANNELS
    },
    EVERYTHING: ALL_CHANNELS,
}


class BareDraw:
    """Lower bound: the textured mesh, unlit, into rgb, id and depth, all three read back."""

    VERTEX = """#version 330
        in vec3 position; in vec2 uv; uniform mat4 clip; uniform vec4 optical_z; out vec2 v_uv; out float v_z;
        void main() {
            gl_Position = clip * vec4(position, 1.0); v_uv = uv; v_z = dot(optical_z, vec4(position, 1.0));
        }"""
    FRAGMENT = """#version 330
        in vec2 v_uv; in float v_z; uniform sampler2D surface;
        layout(location = 0) out vec4 rgb;
        layout(location = 1) out uint label;
        layout(location = 2) out float depth;
        void main() { rgb = texture(surface, v_uv); label = uint(gl_PrimitiveID + 1); depth = v_z; }"""

    def __init__(self, shot: Shot, first: BareDraw | None = None) -> None:
        """``first``: draw of another mesh into the same image."""
        mesh = shot.body.mesh
        assert mesh.uv is not None and mesh.uv_triangles is not None and mesh.texture is not None
        pairs = np.stack([mesh.triangles.ravel(), mesh.uv_triangles.ravel()], axis=1)
        unique, corners = np.unique(pairs, axis=0, return_inverse=True)
        self.source = unique[:, 0]
        self.context = OpenGLContext() if first is None else first.context
        with self.context.current():
            self._prepare(shot.camera.size, mesh, unique, corners, first)

    def _prepare(
        self, size: tuple[int, int], mesh: Mesh, unique: Array, corners: Array, first: BareDraw | None
    ) -> None:
        assert mesh.uv is not None and mesh.texture is not None
        ctx = self.ctx = self.context.gl
        self.program = ctx.program(self.VERTEX, self.FRAGMENT) if first is None else first.program
        self.positions = ctx.buffer(reserve=len(unique) * 12, dynamic=True)
        uv = ctx.buffer(mesh.uv[unique[:, 1]].astype("f4").tobytes())
        self.triangles = ctx.vertex_array(
            self.program,
            [(self.positions, "3f", "position"), (uv, "2f", "uv")],
            index_buffer=ctx.buffer(corners.astype("i4").tobytes()),
        )
        self.texture = ctx.texture(mesh.texture.shape[1::-1], 3, mesh.texture[::-1].tobytes())
        targets = [ctx.texture(size, 4), ctx.texture(size, 1, dtype="u4"), ctx.texture(size, 1, dtype="f4")]
        self.target = ctx.framebuffer(targets, ctx.depth_renderbuffer(size))

    def __call__(self, shot: Shot) -> None:
        with self.context.current():
            self._draw(shot)

    def _draw(self, shot: Shot) -> None:
        self.begin(shot.camera)
        self.add(shot.body)
        self.read()

    def add(self, body: Body) -> None:
        """Draw one more body."""
        self.positions.orphan()
        self.positions.write(body.vertices[self.source])
        self.texture.use(0)
        self.triangles.render(moderngl.TRIANGLES)

    def begin(self, camera: Camera) -> None:
        """Begin an image."""
        clip = camera.opengl_clip(_NEAR, _FAR) @ camera.optical_from_world
        self.program["clip"].write(clip.T.astype("f4").tobytes())
        self.program["optical_z"].value = (*camera.R[2], camera.t[2])
        self.target.use()
        self.ctx.enable_only(moderngl.DEPTH_TEST)
        self.target.clear()

    def read(self) -> None:
        """Read the image back."""
        self.target.read(components=3, attachment=0)
        self.target.read(components=1, attachment=1, dtype="u4")
        self.target.read(components=1, attachment=2, dtype="f4")


def bare_draw_of(
    bodies: Sequence[Body], camera: Camera
) -> Callable[[Sequence[Body], Sequence[Camera], bool], None]:
    """Function that draws several bodies in each of some cameras like ``camera``; read back if True."""
    draws: list[BareDraw] = []
    for body in bodies:
        draws.append(BareDraw(Shot(0, [body], camera), draws[0] if draws else None))

    def draw(posed: Sequence[Body], cameras: Sequence[Camera], read: bool) -> None:
        with draws[0].context.current():
            for each in cameras:
                draws[0].begin(each)
                for one, body in zip(draws, posed, strict=True):
                    one.add(body)
                if read:
                    draws[0].read()
            draws[0].ctx.finish()

    return draw


class Pyrender:
    """pyrender with a new mesh in each frame, because it cannot change vertices."""

    def __init__(self, shot: Shot, by_part: bool) -> None:
        import trimesh
        from PIL import Image

        pyrender, _ = import_pyrender()
        self.pyrender, self.by_part = pyrender, by_part
        self.scene = pyrender.Scene(ambient_light=[0.6, 0.6, 0.6])
        self.scene.add(pyrender.DirectionalLight(intensity=3.0), pose=np.eye(4))
        mesh = shot.body.mesh
        pairs = np.stack([mesh.triangles.ravel(), mesh.uv_triangles.ravel()], axis=1)
        unique, corners = np.unique(pairs, axis=0, return_inverse=True)
        self.source, self.corners = unique[:, 0], corners.reshape(-1, 3)
        image = Image.fromarray(mesh.texture)
        visual = trimesh.visual.TextureVisuals(uv=mesh.uv[unique[:, 1]], image=image)
        self.material = (
            pyrender.Mesh.from_trimesh(
                trimesh.Trimesh(mesh.vertices[self.source], self.corners, visual=visual, process=False)
            )
            .primitives[0]
            .material
        )
        self.uv = mesh.uv[unique[:, 1]].astype(np.float32)
        labels = np.unique(shot.body.parts)
        self.parts = (
            [(int(n), self.corners[shot.body.parts == n]) for n in labels] if by_part else [(1, self.corners)]
        )
        self.topology = Topology(mesh)
        self.renderer = pyrender.OffscreenRenderer(*shot.camera.size)

    def __call__(self, shot: Shot) -> None:
        pyrender, k = self.pyrender, shot.camera.K
        camera = pyrender.IntrinsicsCamera(k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5, _NEAR, _FAR)
        pose = shot.camera.world_from_optical @ np.diag([1.0, -1.0, -1.0, 1.0])
        nodes = [self.scene.add(camera, pose=pose)]
        positions = shot.body.vertices[self.source]
        normals = PosedMesh(self.topology, shot.body.vertices).normals[self.source]
        labels = {}
        for number, triangles in self.parts:
            primitive = pyrender.Primitive(
                positions, normals, texcoord_0=self.uv, indices=triangles, material=self.material, mode=4
            )
            nodes.append(self.scene.add(pyrender.Mesh([primitive])))
            labels[nodes[-1]] = (number, 0, 0)
        self.renderer.render(self.scene)
        if self.by_part:
            self.renderer.render(self.scene, flags=pyrender.RenderFlags.SEG, seg_node_map=labels)
        for node in nodes:
            self.scene.remove_node(node)


def ours(renderer: GLRenderer, channels: Sequence[str]) -> Callable[[Shot], object]:
    frames: list[Body] = []

    def draw(shot: Shot) -> object:
        # bodies of its own: the renderer caches results for a Body, and frames that were adjacent frames
        if shot.number == 1 or not frames:
            frames[:] = [replace(body) for body in shot.frames]
        after, before = (AdjacentFrame([frames[shot.number + step]], shot.camera) for step in (1, -1))
        return renderer.render(
            [frames[shot.number]], shot.camera, channels, next_frame=after, previous_frame=before
        )

    return draw


def pictured(order: Sequence[Shot], path: Path) -> None:
    """Write the input of the renderers in other processes."""
    mesh = order[0].body.mesh
    assert mesh.uv is not None and mesh.uv_triangles is not None and mesh.texture is not None
    pairs = np.stack([mesh.triangles.ravel(), mesh.uv_triangles.ravel()], axis=1)
    unique, corners = np.unique(pairs, axis=0, return_inverse=True)
    np.savez(
        path,
        size=order[0].camera.size,
        K=[shot.camera.K for shot in order],
        extrinsics=[shot.camera.optical_from_world for shot in order],
        vertices=np.stack([shot.body.vertices for shot in order])[:, unique[:, 0]],
        corners=corners.reshape(-1, 3).astype(np.int32),
        uv=mesh.uv[unique[:, 1]],
        texture=mesh.texture,
    )


@contextmanager
def guest(name: str, python: str, order: Sequence[Shot]) -> Iterator[tuple[str, Callable[[Shot], float]]]:
    """Start a renderer in another Python.

    Yields:
        Its title, empty if it is not installed, and a function that renders a frame and returns milliseconds.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "shots.npz"
        pictured(order, path)
        numbers = {id(shot): number for number, shot in enumerate(order)}
        with _answering(python, "draw.py", name, str(path)) as (title, draw):
            yield title, lambda shot: draw(numbers[id(shot)])


@contextmanager
def workbench(
    python: str, scene: Scene, cameras: Sequence[Camera]
) -> Iterator[tuple[str, Callable[[int], float]]]:
    """Start Blender's Workbench in another Python, with the people and the room of a scene.

    ``cameras``: the camera of each frame of the scene.

    Yields:
        Its title, empty if it is not installed, and a function that renders a frame and returns milliseconds.
    """
    with tempfile.TemporaryDirectory() as folder:
        views, people, room = (Path(folder) / name for name in ("views.npz", "people.glb", "room.glb"))
        np.savez(
            views,
            size=cameras[0].size,
            rate=scene.config.rate,
            K=[camera.K for camera in cameras],
            poses=[camera.world_from_optical for camera in cameras],
        )
        times = scene.period * np.arange(len(cameras))
        moving = {}
        for name, actor in scene.actors.items():
            states, bones = [actor.at(time) for time in times.tolist()], len(actor.human.skeleton)
            poses = np.stack([state.joints[:bones] for state in states])
            moving[name] = AnimatedHuman(actor.human, poses, np.array([state.size for state in states]))
        people.write_bytes(glb_bytes(moving, scene.config.rate))
        static = [replace(mesh, vertices=mesh.vertices @ _GLTF_FROM_MAP.T) for mesh in scene.static_meshes]
        room.write_bytes(glb_of(static))
        with _answering(python, "workbench.py", str(views), str(people), str(room)) as (title, draw):
            yield title, draw


@contextmanager
def _answering(python: str, script: str, *arguments: str) -> Iterator[tuple[str, Callable[[int], float]]]:
    """Start a script of ``guests``: its title, and a function that draws a frame and gives milliseconds."""
    process = subprocess.Popen(
        [python, str(Path(__file__).parent / "guests" / script), *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    assert process.stdin is not None and process.stdout is not None
    requests, answers = process.stdin, process.stdout

    def draw(number: int) -> float:
        print(number, file=requests, flush=True)
        return float(answers.readline())

    try:
        yield answers.readline().strip(), draw
    finally:
        requests.close()
        process.wait(20)


def beside(renderer: GLRenderer, shape: str, count: int) -> Callable[[Shot], object]:
    """The body and ``count`` rotating objects of 0.3 m next to it."""
    meshes = [SHAPES[shape]() for _ in range(count)]
    parts = np.zeros(len(meshes[0].triangles), np.uint8)
    turn = iter(np.arange(0.0, 1e6, 0.1))

    def draw(shot: Shot) -> object:
        angle, middle = next(turn), shot.body.vertices.mean(0)
        bodies = [replace(shot.body)]
        for number, mesh in enumerate(meshes):
            place = middle + np.array([0.4 * np.cos(2.4 * number), 0.4 * np.sin(2.4 * number), 0])
            turned = Rotation.from_euler("z", angle).as_quat()
            vertices = ObjectPose(place, turned, np.full(3, 0.3)).apply(mesh.vertices)
            bodies.append(Body(mesh, vertices.astype(np.float32), parts, 0))
        return renderer.render(bodies, shot.camera, CHANNELS)

    return draw


def interleave(
    contestants: dict[str, Callable[[Shot], object]],
    order: Sequence[Shot],
    rounds: int,
    guests: dict[str, Callable[[Shot], float]],
) -> tuple[dict[str, list[float]], dict[str, list[float]]]:
    """Measure wall-clock and CPU milliseconds of each call.

    Args:
        contestants: Renderers in this process, by title.
        order: Frames to render.
        rounds: Number of frames.
        guests: Renderers in other processes, by title.
    """
    random.seed(1)
    times: dict[str, list[float]] = {name: [] for name in (*contestants, *guests)}
    cpu: dict[str, list[float]] = {name: [] for name in contestants}
    for number in range(-len(order), rounds):  # the first pass warms up
        shot = order[number % len(order)]
        # in random order: a renderer finds the caches and the OpenGL context of the previous one
        for name, draw in random.sample(list(contestants.items()), len(contestants)):
            start, start_cpu = time.perf_counter(), time.process_time()
            draw(shot)
            if number >= 0:
                times[name].append((time.perf_counter() - start) * 1e3)
                cpu[name].append((time.process_time() - start_cpu) * 1e3)
        if number % _GUEST_ROUNDS == 0:
            for name, other in guests.items():
                took = other(shot)
                if number >= 0:
                    times[name].append(took)
    return times, cpu


def table(times: dict[str, list[float]], cpu: dict[str, list[float]], title: str) -> list[dict[str, object]]:
    reference, reference_cpu = float(np.median(times[BARE])), float(np.median(cpu[BARE]))
    print(f"\n{title:<58} {'median':>8} {'best':>8} {'x bare':>8} {'CPU':>8} {'x bare':>8}")
    rows: list[dict[str, object]] = []
    for name, values in times.items():
        median, best = float(np.median(values)), float(np.min(values))
        row: dict[str, object] = {
            "what": name,
            "median_ms": median,
            "best_ms": best,
            "x_bare": median / reference,
        }
        line = f"{name:<58} {median:8.2f} {best:8.2f} {median / reference:8.2f}"
        if name in cpu:
            ms = float(np.median(cpu[name]))
            line += f" {ms:8.2f} {ms / reference_cpu:8.2f}"
            row |= {"cpu_ms": ms, "x_bare_cpu": ms / reference_cpu}
        print(line)
        rows.append(row)
    return rows


def targets(times: dict[str, list[float]], cpu: dict[str, list[float]]) -> list[dict[str, object]]:
    """Ratios with a bound: of medians, and medians of the ratios of consecutive calls."""
    bounds = (
        (FOUR, BARE, "at most", 1.0),
        (EVERYTHING, BARE, "at most", 2.0),
        (SEGMENTED, FOUR, "at least", 8.0),
    )
    rows: list[dict[str, object]] = []
    print(f"\n{'ratios':<74} {'medians':>8} {'paired':>8} {'CPU':>8}")
    for what, beside, bound, limit in bounds:
        if what in times and beside in times:
            of_medians = float(np.median(times[what]) / np.median(times[beside]))
            paired = float(np.median(np.divide(times[what], times[beside])))
            of_cpu = float(np.median(cpu[what]) / np.median(cpu[beside]))
            met = of_medians <= limit if bound == "at most" else of_medians >= limit
            title = f"{what.split(': ')[-1]} / {beside.split(':')[0]}"
            verdict = f"{bound} {limit:g}: {'met' if met else 'MISSED'}"
            print(f"{title[:50]:<50} {verdict:<23} {of_medians:8.2f} {paired:8.2f} {of_cpu:8.2f}")
            rows.append(
                {
                    "what": title,
                    "limit": limit,
                    "of_medians": of_medians,
                    "paired": paired,
                    "cpu": of_cpu,
                    "met": met,
                }
            )
    return rows


def stages(shot: Shot, repeat: int) -> list[dict[str, object]]:
    """Cost of the stages of a frame on the CPU, one by one."""
    topology, vertices, camera = Topology(shot.body.mesh), shot.body.vertices, shot.camera
    posed = PosedMesh(topology, vertices)
    areas, facing = topology.vertex_areas, posed.facing(camera.center)
    projected = ProjectedPoints(posed.points, camera)
    edges = contour(posed, projected, facing, 0.0)
    work: dict[str, Callable[[], object]] = {
        "area vectors of the triangles": lambda: PosedMesh(topology, vertices).areas,
        "area vectors and vertex normals": lambda: PosedMesh(topology, vertices).normals,
        "contact shadow": lambda: ShadowCaster(posed.points, areas).shadow,
        "triangles that face the camera": lambda: posed.facing(camera.center),
        "contour edges": lambda: contour(posed, projected, facing, 0.0),
        "crossings of the contour with pixels": lambda: edge_crossings(edges, camera.size),
    }
    print(f"\n{'stages on the CPU, ms':<58} {'median':>8} {'best':>8}")
    rows: list[dict[str, object]] = []
    for name, run in work.items():
        values = []
        for _ in range(repeat):
            start = time.perf_counter()
            run()
            values.append((time.perf_counter() - start) * 1e3)
        print(f"{name:<58} {np.median(values):8.2f} {min(values):8.2f}")
        rows.append({"what": name, "median_ms": float(np.median(values)), "best_ms": min(values)})
    return rows


def cpu_time(channels: Sequence[str], rounds: int) -> None:
    """Print CPU milliseconds per frame, all threads together, and wall-clock milliseconds, as JSON."""
    scene = Scene.load()
    order = [shot for shot in shots(scene, 48) if shot.camera is next(iter(scene.cameras.values()))]
    renderer = GLRenderer(scene.static_meshes)
    draw = ours(renderer, channels)
    for shot in order:
        draw(shot)
    best_cpu, best_wall = np.inf, np.inf
    for _ in range(max(1, rounds // len(order))):
        before, start = resource.getrusage(resource.RUSAGE_SELF), time.perf_counter()
        for shot in order:
            draw(shot)
        wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_SELF)
        cpu = after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
        best_cpu, best_wall = min(best_cpu, cpu), min(best_wall, wall)
    print(json.dumps({"cpu_ms": best_cpu * 1e3 / len(order), "wall_ms": best_wall * 1e3 / len(order)}))


def threads(rounds: int) -> list[dict[str, object]]:
    """Measure numbers of threads of the software rasteriser, for one camera per process."""
    print(f"\n{'rgb alone, one camera per process, LP_NUM_THREADS':<58} {'CPU ms':>8} {'wall ms':>8}")
    rows: list[dict[str, object]] = []
    for setting in (None, "0", "1", "2"):
        environment = {key: value for key, value in os.environ.items() if key != "LP_NUM_THREADS"}
        if setting is not None:
            environment["LP_NUM_THREADS"] = setting
        command = [sys.executable, __file__, "--cpu-time", "--rounds", str(rounds)]
        answer = json.loads(subprocess.run(command, env=environment, capture_output=True, check=True).stdout)
        print(f"{setting or 'unset':<58} {answer['cpu_ms']:8.2f} {answer['wall_ms']:8.2f}")
        rows.append({"LP_NUM_THREADS": setting, **answer})
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--rounds", type=int, default=120, help="frames of each contestant (default: %(default)s)"
    )
    parser.add_argument("--no-pyrender", action="store_true", help="leave pyrender out")
    for name in GUESTS:
        variable = f"HUMANSIM_BENCH_{name.upper()}"
        module = {"blender": "bpy"}.get(name, name)
        parser.add_argument(
            f"--{name}",
            metavar="PYTHON",
            default=os.environ.get(variable, sys.executable),
            help=f"a Python that can import {module} (default: ${variable}, or this one)",
        )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there too")
    parser.add_argument("--cpu-time", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.cpu_time:
        cpu_time(("rgb",), options.rounds)
        return

    scene = Scene.load()
    order = shots(scene, 48)
    renderer = GLRenderer(scene.static_meshes)
    mesh = order[0].body.mesh
    print(
        f"{renderer.device}, {os.cpu_count()} cores; {len(mesh.triangles)} triangles, {order[0].camera.size}"
    )
    contestants: dict[str, Callable[[Shot], object]] = {BARE: BareDraw(order[0])}
    contestants |= {name: ours(renderer, channels) for name, channels in CHANNEL_ROWS.items()}
    contestants["the four and a moving box"] = beside(renderer, "box", 1)
    contestants["the four and 4 moving spheres"] = beside(renderer, "sphere", 4)
    if not options.no_pyrender:
        for name, by_part in (
            ("pyrender: rgb, depth", False),
            (SEGMENTED, True),
        ):
            contestants[name] = Pyrender(order[0], by_part)
    with ExitStack() as stack:
        guests: dict[str, Callable[[Shot], float]] = {}
        for name in GUESTS:
            title, draw = stack.enter_context(guest(name, getattr(options, name), order))
            if title:
                guests[title] = draw
            else:
                print(f"{name}: left out, as {getattr(options, name)} has none (--{name} PYTHON)")
        times, cpu = interleave(contestants, order, options.rounds, guests)
    figures = {
        "device": renderer.device,
        "cores": os.cpu_count(),
        "triangles": len(mesh.triangles),
        "frames": table(times, cpu, "ms per camera-frame"),
        "targets": targets(times, cpu),
        "stages": stages(order[0], options.rounds),
        "threads": threads(options.rounds),
    }
    if options.json:
        options.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
