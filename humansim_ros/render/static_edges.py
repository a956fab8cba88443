"""Edges of the static scene, for the anti-aliasing of images with one sample in each pixel."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera import Camera
from humansim_ros.mesh.mesh import Mesh, padded
from humansim_ros.mesh.normals import welded
from humansim_ros.render.edge_antialiasing import EdgeCrossings, ImageEdges, edge_crossings, share_beyond
from humansim_ros.render.lens_tessellation import LensView, near_plane
from humansim_ros.render.mesh_buffers import PosedMesh, Topology
from humansim_ros.render.pixel_geometry import pixel_rays
from humansim_ros.types import Array, Float32Array, Indices

#: Cosine of the angle between two triangles from which the colour may change at their edge.
_SHARP = 0.99
#: Difference of 1 / z, per metre, above which one surface is before another.
_APART = 1e-6


class StaticEdges:
    """Edges between triangles.

    Args:
        positions: (V, 3) metres in ``map``.
        corners: (N, 3) vertices of the triangles.
        owner: (N,) mesh of each triangle; the colour changes from one to another.
    """

    def __init__(self, positions: Float32Array, corners: NDArray[Any], owner: Indices) -> None:
        places = welded(positions)
        points = np.empty((int(places.max()) + 1, 3), np.float32)
        points[places] = positions
        triangles = places[corners].astype(np.int32)
        self._topology = Topology(Mesh(points.astype(float), padded(triangles)))
        self._posed = PosedMesh(self._topology, points)
        self._owner = owner

    @cached_property
    def _sharp(self) -> NDArray[np.bool_]:
        """(E,) whether the colour changes at an edge from all directions."""
        first, second = self._topology.sides
        areas = self._posed.areas / np.maximum(np.linalg.norm(self._posed.areas, axis=0), 1e-12)
        flat = np.einsum("ij,ij->j", areas[:, first], areas[:, second]) > _SHARP
        return np.asarray(~flat | (self._owner[first] != self._owner[second]) | self._topology.border)

    def crossings(self, camera: Camera, shown: Indices) -> EdgeCrossings:
        """Find where edges pass between pixels, and where surfaces intersect.

        Args:
            camera: The camera.
            shown: (H * W,) triangle that each pixel shows, -1 for none.
        """
        edges = self._edge_crossings(camera, shown)
        return edges + self._intersections(camera, shown, edges)

    def _edge_crossings(self, camera: Camera, shown: Indices) -> EdgeCrossings:
        """Crossings of edges of a triangle that a pixel beside the edge shows."""
        seen = np.zeros(len(self._owner) + 1, bool)
        seen[shown] = True
        first, second = self._topology.sides
        beside = np.flatnonzero(seen[first] | seen[second])
        facing = self._posed.facing(camera.center)
        outline = facing[first[beside]] != facing[second[beside]]
        chosen = beside[self._sharp[beside] | outline]
        starts, ends = (self._posed.vertices[ends].astype(float) for ends in self._topology.edges[chosen].T)
        if camera.distorted:
            starts, ends, parents = LensView(camera).divide_edges(starts, ends)
            chosen = chosen[parents]
        starts, ends, kept = _before_camera(camera, starts, ends)
        (p, near), (q, far) = camera.project_optical(starts), camera.project_optical(ends)
        good = np.isfinite(p[:, 0]) & np.isfinite(q[:, 0])
        edges = ImageEdges((*p[good].T, near[good]), (*q[good].T, far[good]))
        crossings = edge_crossings([edges], camera.size)
        edge = chosen[kept][good][crossings.edge]
        here, there = shown[crossings.pixel], shown[crossings.neighbour]
        own = [(side == first[edge]) | (side == second[edge]) for side in (here, there)]
        return crossings.take((here != there) & (own[0] | own[1]))

    def _intersections(self, camera: Camera, shown: Indices, edges: EdgeCrossings) -> EdgeCrossings:
        """Crossings between neighbours whose surfaces intersect there, where no edge passes."""
        width, height = camera.size
        image = shown.reshape(height, width)
        rays = pixel_rays(camera)
        known = np.zeros((2, height * width), bool)
        lower = np.minimum(edges.pixel, edges.neighbour)
        known[(np.abs(edges.neighbour - edges.pixel) > 1).astype(np.intp), lower] = True
        found = []
        for axis, step in enumerate((1, width)):
            differ = np.zeros((height, width), bool)
            low, high = (image[:, :-1], image[:, 1:]) if axis == 0 else (image[:-1], image[1:])
            differ[: low.shape[0], : low.shape[1]] = (low != high) & (low >= 0) & (high >= 0)
            pixel = np.flatnonzero(differ.ravel() & ~known[axis])
            a, b = shown[pixel], shown[pixel + step]
            # differences of 1 / z, which are linear in an image without a lens
            planes = self._inverse_depths(camera, a) - self._inverse_depths(camera, b)
            last = (pixel >= (height - 1) * width) if axis == 0 else (pixel % width == width - 1)
            beside = np.where(last, pixel, pixel + (width if axis == 0 else 1))
            here, there, other = (
                planes[0] * rays[0, at] + planes[1] * rays[1, at] + planes[2]
                for at in (pixel, pixel + step, beside)
            )
            good = np.flatnonzero((here > _APART) & (there < -_APART))
            here, change = here[good], (here - there)[good]
            distance = here / change
            slope = np.minimum(np.abs(other[good] - here) / change, 1)
            pixel = pixel[good]
            for own, beyond, far in ((pixel, pixel + step, distance), (pixel + step, pixel, 1 - distance)):
                found.append((own, beyond, share_beyond(far, slope), 1 / here))
        pixel, neighbour, share, depth = (np.concatenate(parts) for parts in zip(*found, strict=True))
        return EdgeCrossings(pixel, neighbour, share, depth, np.full(len(pixel), -1)).take(share > 0)

    def _inverse_depths(self, camera: Camera, triangles: Indices) -> Array:
        """(3, N) vectors whose product with a ray of :func:`pixel_rays` is 1 / z of triangles (N,)."""
        normals = self._posed.areas[:, triangles].astype(float)
        corner = self._posed.points[:, self._topology.corners[0][triangles]]
        distance = np.einsum("ij,ij->j", normals, corner - camera.center[:, None])
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(camera.R @ normals / distance)


def _before_camera(camera: Camera, starts: Array, ends: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Parts of edges (E, 3) before the near plane, in the optical frame, and which edges have such a part."""
    near = near_plane(camera)
    a, b = camera.to_optical(starts), camera.to_optical(ends)
    kept = np.maximum(a[:, 2], b[:, 2]) > near
    a, b = a[kept], b[kept]
    for point, other in ((a, b), (b, a)):
        behind = point[:, 2] < near
        share = (near - point[behind, 2]) / (other[behind, 2] - point[behind, 2])
        point[behind] += share[:, None] * (other[behind] - point[behind])
    return a, b, kept
