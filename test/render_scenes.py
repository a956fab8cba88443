"""Scenes to render in tests: quads, boxes and walking humans."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import pytest
import trimesh
from keyframe_text import keyframes
from numpy.typing import ArrayLike, NDArray

from humansim_ros.cameras import Camera
from humansim_ros.errors import RenderError
from humansim_ros.files.mesh.mesh import Mesh
from humansim_ros.render import (
    Body,
    GLRenderer,
    Lighting,
    PyrenderRenderer,
    RendererName,
    View,
    make_renderer,
)
from humansim_ros.scene import Scene

#: Even light: a white surface is white whichever way it looks.
EVEN = Lighting(sun_color=(0, 0, 0), sky_color=(1, 1, 1), ground_color=(1, 1, 1), background=(0, 0, 0))

#: Keyframes of a screen that moves past and of a ball that moves, grows and rotates.
MOVES = keyframes(
    20,
    10,
    screen=((0, -1.5, 0), (0, 1.5, 0)),
    ball=((1, -0.6, 1.2), {"position": (1, 0.9, 0.8), "rotation": (90, 30, 200), "size": (1.5, 1, 2)}),
)
#: The renderers that have to pass one test-suite.
RENDERERS: tuple[RendererName, ...] = ("moderngl", "pyrender")
#: The same as parameters: ``make test`` compares the second renderer in test_render_geometry.py only.
EACH_RENDERER = ["moderngl", pytest.param("pyrender", marks=pytest.mark.nightly)]


def renderer_or_skip(
    static: Iterable[Mesh] = (),
    lighting: Lighting | None = None,
    name: RendererName = "moderngl",
    static_bodies: Sequence[Body] = (),
) -> GLRenderer | PyrenderRenderer:
    try:
        return make_renderer(name, tuple(static), lighting, static_bodies=static_bodies)
    except RenderError as reason:
        pytest.skip(str(reason))


def quad(corners: ArrayLike, color: tuple[int, int, int] = (255, 255, 255)) -> Mesh:
    """A quad, its front where the corners run counter-clockwise."""
    colors = np.tile(np.array(color, np.uint8), (4, 1))
    return Mesh(np.array(corners, float), np.array([[0, 1, 2, 3]], np.int32), colors=colors)


def wall(x: float, y: float, z: float, half: float, color: tuple[int, int, int] = (255, 255, 255)) -> Mesh:
    """A square that faces -x."""
    corners = [
        (x, y + half, z - half),
        (x, y - half, z - half),
        (x, y - half, z + half),
        (x, y + half, z + half),
    ]
    return quad(corners, color)


def box(centre: ArrayLike, half: float) -> Mesh:
    """A closed cube."""
    signs = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return Mesh(np.array(centre) + half * signs, np.array(faces, np.int32))


def body(mesh: Mesh, instance: int = 1, part: int = 1) -> Body:
    """A human with a label, or an object without."""
    parts = np.full(len(mesh.triangles), part, np.uint8)
    return Body(mesh, mesh.vertices.astype(np.float32), parts, instance, "human" if instance else "object")


def along_x(size: tuple[int, int] = (320, 240), focal: float = 300.0) -> Camera:
    """A camera at (0, 0, 1) that looks along +x."""
    k = np.array([[focal, 0, (size[0] - 1) / 2], [0, focal, (size[1] - 1) / 2], [0, 0, 1]])
    r = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
    return Camera(size, k, r, -r @ np.array([0, 0, 1.0]))


def oblique(position: ArrayLike, target: ArrayLike) -> Camera:
    """A camera with an off-center principal point, non-square pixels and skew."""
    straight = Camera.look_at(position, target, (640, 480), 1.0)
    k = np.array([[610.3, 13.7, 287.4], [0, 553.8, 268.9], [0, 0, 1]])
    return Camera((640, 480), k, straight.R, straight.t)


def walkers(scene: Scene, seconds: float, places: Iterable[tuple[float, float]] = ((0, 0),)) -> list[Body]:
    """The scene's first human at a time, once at each position."""
    actor = next(iter(scene.actors.values()))
    vertices = actor.at(seconds).vertices
    vertices = vertices - np.float32([*vertices[:, :2].mean(0), 0])
    bodies = []
    for number, (x, y) in enumerate(places, 1):
        here = (vertices + np.float32([x, y, 0])).astype(np.float32)
        bodies.append(Body(actor.human.mesh, here, actor.human.triangle_parts, number))
    return bodies


def finer(camera: Camera, factor: int) -> Camera:
    """The same camera with every pixel divided into ``factor`` x ``factor``."""
    k = camera.K.copy()
    k[:2] *= factor
    k[:2, 2] += (factor - 1) / 2
    return Camera((camera.size[0] * factor, camera.size[1] * factor), k, camera.R, camera.t)


def block_means(image: NDArray[np.generic], factor: int) -> NDArray[np.float64]:
    height, width = image.shape[0] // factor, image.shape[1] // factor
    blocks = image.reshape(height, factor, width, factor, -1).astype(float).mean(axis=(1, 3))
    return blocks[..., 0] if image.ndim == 2 else blocks


# ray casting


BodyBuffers = tuple[NDArray[np.floating], NDArray[np.integer]]


def cast(camera: Camera, surfaces: Sequence[BodyBuffers]) -> tuple[NDArray[np.generic], ...]:
    """First hits of rays through pixel centers, (H, W): depth, surface (-1: none), triangle."""
    offsets = np.cumsum([0, *(len(vertices) for vertices, _ in surfaces)])
    vertices = np.concatenate([vertices for vertices, _ in surfaces]).astype(float)
    triangles = np.concatenate([t + offset for (_, t), offset in zip(surfaces, offsets, strict=False)])
    owner = np.repeat(np.arange(len(surfaces)), [len(t) for _, t in surfaces])
    number = np.concatenate([np.arange(len(t)) for _, t in surfaces])
    width, height = camera.size
    columns, rows = np.meshgrid(np.arange(width), np.arange(height))
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1)
    directions = camera.unproject(pixels, np.ones(len(pixels))) - camera.center
    origins = np.broadcast_to(camera.center, directions.shape)
    mesh = trimesh.Trimesh(vertices, triangles, process=False)
    hit, ray = mesh.ray.intersects_id(origins, directions, multiple_hits=False)[:2]
    # embree determines the triangle; the distance is computed here in double precision
    a, b, c = (vertices[triangles[hit, i]] for i in range(3))
    normal = np.cross(b - a, c - a)
    distance = np.einsum("ij,ij->i", normal, a - camera.center) / np.einsum(
        "ij,ij->i", normal, directions[ray]
    )
    depth, first, face = np.full(len(pixels), np.inf), np.full(len(pixels), -1), np.full(len(pixels), -1)
    depth[ray], first[ray], face[ray] = distance, owner[hit], number[hit]
    return depth.reshape(height, width), first.reshape(height, width), face.reshape(height, width)


def inner(labels: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Pixels of a body whose eight neighbours are of the same one."""
    height, width = labels.shape
    padded = np.pad(labels, 1)
    around = [padded[y : y + height, x : x + width] == labels for y in range(3) for x in range(3)]
    return np.all(around, axis=0) & (labels > 0)


def assert_agrees(view: View, bodies: Sequence[Body], static: Sequence[Mesh], camera: Camera) -> None:
    surfaces = [(body.vertices, body.mesh.triangles) for body in bodies]
    surfaces += [(mesh.vertices, mesh.triangles) for mesh in static]
    depth, first, face = cast(camera, surfaces)
    instance, part = np.zeros(first.shape, int), np.zeros(first.shape, int)
    for number, body in enumerate(bodies):
        here = first == number
        instance[here], part[here] = body.instance, body.parts[face[here]]
    assert np.count_nonzero(instance) > 2000
    assert np.count_nonzero(view.instance != instance) <= 4
    assert np.count_nonzero(view.part != part) <= 8
    inside = inner(instance)
    assert np.mean(np.abs(view.depth[inside] - depth[inside]) < 1e-4) >= 0.999
    background = (instance == 0) & (view.instance == 0) & np.isfinite(depth) & np.isfinite(view.depth)
    if background.any():
        assert np.mean(np.abs(view.depth[background] - depth[background]) < 1e-3) > 0.999
    # up to where a ray grazes an edge
    assert np.count_nonzero(np.isfinite(view.depth) != np.isfinite(depth)) <= 8


def centroids(weights: NDArray[np.floating], near: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weighted centroids (N, 2) of the windows of 8 pixels around (N, 2) points."""
    found = []
    for x, y in near.round().astype(int):
        window = weights[y - 8 : y + 9, x - 8 : x + 9]
        rows, columns = np.mgrid[y - 8 : y + 9, x - 8 : x + 9]
        found.append(np.array([(columns * window).sum(), (rows * window).sum()]) / window.sum())
    return np.array(found)
