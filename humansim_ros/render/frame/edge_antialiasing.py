"""Anti-aliasing of outlines and of edges of the static scene [Persson 2011].

An image has one sample per pixel. Where an edge crosses the line between two neighbouring pixel centers, a
part of one pixel shows the surface of the other pixel. The position and the slope of the crossing give the
size of this part. The colour of the other pixel is blended in with this share.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from humansim_ros.cameras.camera import Camera
from humansim_ros.files.mesh import Mesh, padded, welded
from humansim_ros.render.device.lens_tessellation import VISIBLE, LensView, near_plane
from humansim_ros.render.device.mesh_buffers import PosedMesh, Topology
from humansim_ros.render.device.pixel_geometry import pixel_rays
from humansim_ros.types import Array, Float32Array, Indices

#: Largest difference of depth, metres, between an outline and the same surface half a pixel further inside.
_RIM = 0.1
#: The device rounds vertices to 1/256 of a pixel. An edge nearer than this to a pixel center, pixels, may
#: therefore pass on the other side than computed.
_SNAP = 1 / 128


@dataclass(frozen=True)
class EdgeCrossings:
    """Places where outlines pass between two pixel centers: ``pixel`` gets ``share`` of the colour of
    ``neighbour``. All arrays are (N,). Pixels are flat indices into the image. ``depth``: depth of the
    outline, metres. ``edge``: number of the edge."""

    pixel: NDArray[np.intp]
    neighbour: NDArray[np.intp]
    share: Array
    depth: Array
    edge: NDArray[np.intp]

    def __add__(self, other: EdgeCrossings) -> EdgeCrossings:
        """Return the crossings of both objects, joined."""
        both = ([getattr(one, field.name) for one in (self, other)] for field in fields(self))
        return EdgeCrossings(*(np.concatenate(values) for values in both))

    def take(self, which: NDArray[Any]) -> EdgeCrossings:
        """Return the crossings that a mask (N,) or indices select."""
        return EdgeCrossings(*(getattr(self, one.name)[which] for one in fields(self)))


class ImageEdges(NamedTuple):
    """Straight edges in an image: columns, rows and depths (N,) of their starts and ends."""

    start: tuple[NDArray[Any], NDArray[Any], NDArray[Any]]
    end: tuple[NDArray[Any], NDArray[Any], NDArray[Any]]

    @classmethod
    def of(cls, camera: Camera, starts: NDArray[np.floating], ends: NDArray[np.floating]) -> ImageEdges:
        """Project straight edges from ``starts`` to ``ends``, (N, 3) in ``map``. The lens must not bend
        them."""
        (p, near), (q, far) = camera.project(starts), camera.project(ends)
        good = np.isfinite(p[:, 0]) & np.isfinite(q[:, 0])
        (px, py), (qx, qy) = p[good].T, q[good].T
        return cls((px, py, near[good]), (qx, qy, far[good]))


def edge_crossings(edges: Sequence[ImageEdges], size: tuple[int, int]) -> EdgeCrossings:
    """Find where edges cross columns and rows of pixel centers. ``size``: width and height of the image."""
    (px, py, near), (qx, qy, far) = (
        [np.concatenate(values, dtype=float) for values in zip(*side, strict=True)]
        for side in zip(*edges, strict=True)
    )
    # columns, then rows: x is across the crossed line, y is along it
    width, height = size
    x0, x1 = np.concatenate([px, py]), np.concatenate([qx, qy])
    y0, y1 = np.concatenate([py, px]), np.concatenate([qy, qx])
    # 1 / z is linear along an edge in the image
    inverse0, inverse1 = 1 / np.concatenate([near, near]), 1 / np.concatenate([far, far])
    lines, pixels = (np.repeat(limit, len(px)) for limit in ((width, height), (height, width)))
    first, end = (
        np.minimum(np.maximum(np.ceil(x), 0), lines).astype(np.intp)
        for x in (np.minimum(x0, x1), np.maximum(x0, x1))
    )
    count = end - first
    edge = np.repeat(np.arange(len(count)), count)
    x = np.arange(len(edge)) + (first - np.cumsum(count) + count).take(edge)
    slope = ((y1 - y0) / np.where(count > 0, x1 - x0, 1)).take(edge)
    offset = x - x0.take(edge)
    y = y0.take(edge) + slope * offset
    depth = 1 / (
        inverse0.take(edge) + ((inverse1 - inverse0) / np.where(count > 0, x1 - x0, 1)).take(edge) * offset
    )
    centre = np.rint(y)
    side = np.where(y < centre, -1, 1)
    limit = pixels.take(edge)
    inside = np.flatnonzero(
        (np.minimum(centre, centre + side) >= 0) & (np.maximum(centre, centre + side) < limit)
    )
    x, y, depth, centre, side, limit, slope, edge = (
        values.take(inside) for values in (x, y, depth, centre, side, limit, slope, edge)
    )
    rows = edge >= len(px)
    edge = np.where(rows, edge - len(px), edge)
    along = np.where(rows, 1, width)
    nearer = x * np.where(rows, width, 1) + centre.astype(np.intp) * along
    farther = nearer + side * along
    slope = np.minimum(np.abs(slope), 1)  # a steeper edge crosses the lines of the other axis
    distance = np.abs(y - centre)
    both = np.flatnonzero(distance + slope / 2 > 0.5)
    # where an edge passes through a center, either neighbour may be on the other side
    tie = np.flatnonzero((distance < _SNAP) & (centre - side >= 0) & (centre - side < limit))
    shares = share_beyond(distance, slope), share_beyond(1 - distance[both], slope[both]), 0.5 - distance[tie]
    parts = (
        *([nearer, farther[both], nearer[tie]], [farther, nearer[both], 2 * nearer[tie] - farther[tie]]),
        *(shares, [depth, depth[both], depth[tie]], [edge, edge[both], edge[tie]]),
    )
    return EdgeCrossings(*(np.concatenate(part) for part in parts))


def share_beyond(distance: Array, slope: Array) -> Array:
    """Share (N,) of a pixel that lies beyond an edge, at most half. ``distance``: (N,) pixels from the center
    of the pixel to the crossing. ``slope``: (N,) change of the distance per pixel across, 0 to 1."""
    # the edge rises by the slope within the pixel, so that it may leave the pixel
    corner = np.maximum(0.5 + slope / 2 - distance, 0)
    return np.where(distance + slope / 2 > 0.5, corner**2 / np.maximum(2 * slope, 1e-9), 0.5 - distance)


def blend(
    images: Sequence[NDArray[np.uint8]], z: Float32Array, z_neighbour: Float32Array, outline: EdgeCrossings
) -> None:
    """Blend visible outlines into images in place.

    Args:
        images: (H, W) or (H, W, C).
        z: Depth (N,) at ``outline.pixel``, metres.
        z_neighbour: Depth (N,) at ``outline.neighbour``, metres.
        outline: The N crossings.
    """
    # the nearer surface must be the outlined one, not an occluder, and another surface must be behind it
    front, behind = np.minimum(z, z_neighbour), np.maximum(z, z_neighbour)
    visible = np.flatnonzero((np.abs(front - outline.depth) < _RIM) & (behind > outline.depth))
    # the largest share in a pixel counts: a slanted edge crosses two lines, and the larger share is right
    order = visible[np.argsort(outline.share[visible], kind="stable")]
    pixel, neighbour = outline.pixel[order], outline.neighbour[order]
    share = outline.share[order, None].astype(np.float32)
    for image in images:
        flat = image.reshape(image.shape[0] * image.shape[1], -1)
        own = flat[pixel]
        flat[pixel] = np.rint(own + share * (flat[neighbour].astype(np.float32) - own)).astype(np.uint8)


def mix(image: NDArray[np.uint8], crossings: EdgeCrossings) -> None:
    """Blend colours across edges in an image (H, W, C), in place. If a pixel lies between two edges of a
    narrow surface, the neighbours on both sides are blended in."""
    height, width = image.shape[:2]
    mark = np.zeros(height * width, bool)
    mark[crossings.pixel] = True
    pixels = np.flatnonzero(mark)
    place = np.searchsorted(pixels, crossings.pixel)
    steps = np.array([1, -1, width, -width])
    which = (crossings.neighbour - crossings.pixel)[:, None] == steps
    order = np.argsort(crossings.share)
    shares = np.zeros((4, len(pixels)), np.float32)
    # the last assignment remains: that of the largest share
    shares[which.argmax(axis=1)[order], place[order]] = crossings.share[order]
    # a slanted edge crosses lines of both axes: the axis of the larger share is the right one
    across = shares[:2].max(axis=0) >= shares[2:].max(axis=0)
    shares *= [across, across, ~across, ~across]
    flat = image.reshape(height * width, -1)
    mixed = flat[pixels] * (1 - shares.sum(axis=0))[:, None]
    for share, step in zip(shares, steps, strict=True):
        used = np.flatnonzero(share)
        mixed[used] += share[used, None] * flat[pixels[used] + step]
    flat[pixels] = np.rint(mixed).astype(np.uint8)


#: An edge is sharp if the cosine of the angle between its triangles is below this: the colour may change
#: there.
_SHARP = 0.99
#: A surface is before another one if their 1 / z (z in metres) differ by more than this.
_APART = 1e-6
#: A narrow surface is nearer than this share of the depth of the surfaces behind it.
_BEFORE = 0.999
#: A narrow surface counts if it covers more than this share of a pixel.
_VISIBLE = 1 / 64


class StaticEdges:
    """Edges between the triangles of the static scene, to anti-alias its images. ``positions``: (V, 3) metres
    in ``map``. ``corners``: (N, 3) vertices of the triangles. ``owner``: (N,) mesh of each triangle; the
    colour changes from one mesh to the next."""

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
        """(E,) whether the colour changes at an edge, seen from any direction."""
        first, second = self._topology.sides
        areas = self._posed.areas / np.maximum(np.linalg.norm(self._posed.areas, axis=0), 1e-12)
        flat = np.einsum("ij,ij->j", areas[:, first], areas[:, second]) > _SHARP
        return np.asarray(~flat | (self._owner[first] != self._owner[second]) | self._topology.border)

    @cached_property
    def _forward(self) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Two of (E,), for the two triangles at each edge: whether the order of the triangle's corners runs
        from the start of the edge to its end."""
        corners = np.stack(self._topology.corners, axis=1)
        start, end = self._topology.edges.T[..., None]
        one, other = (
            ((corners[side] == start) & (np.roll(corners[side], -1, axis=1) == end)).any(axis=1)
            for side in self._topology.sides
        )
        return one, other

    @cached_property
    def _facets(self) -> Indices:
        """(N + 1,) number of the facet of each triangle; the last value is -1. A facet is a set of triangles
        that are connected by edges that are not sharp."""
        from scipy.sparse import coo_matrix
        from scipy.sparse.csgraph import connected_components

        first, second = (side[~self._sharp] for side in self._topology.sides)
        count = len(self._owner)
        graph = coo_matrix((np.ones(len(first), bool), (first, second)), shape=(count, count))
        return np.append(connected_components(graph, directed=False)[1], -1)

    def smooth(self, image: NDArray[np.uint8], camera: Camera, shown: Indices, depth: Float32Array) -> None:
        """Anti-alias an image in place.

        Colours are mixed where edges pass between pixels, where surfaces intersect, and where a surface is so
        narrow that it passes between pixels.

        Args:
            image: (H, W, C) colours.
            camera: The camera.
            shown: (H * W,) triangle that each pixel shows, -1 for none.
            depth: (H, W) metres, 0 where nothing is.
        """
        facets = self._facets[shown]
        passing = self._passing(camera, facets)
        crossings = passing.crossings
        own = [self._facets[side[passing.edge]] for side in self._topology.sides]
        here, there = facets[crossings.pixel], facets[crossings.neighbour]
        shows = (here == own[0]) | (here == own[1]) | (there == own[0]) | (there == own[1])
        z = np.where(depth > 0, depth, np.inf).ravel()
        before = crossings.depth < _BEFORE * np.minimum(z[crossings.pixel], z[crossings.neighbour])
        narrow = self._narrow(camera, facets, passing.take(np.flatnonzero(before & ~shows & passing.across)))
        colours = image.reshape(len(shown), -1)[narrow.source]
        other = shown[crossings.pixel] != shown[crossings.neighbour]
        visible = crossings.take(np.flatnonzero(other & shows))
        mix(image, visible + self._intersections(camera, shown, visible))
        _add(image.reshape(len(shown), -1), narrow, colours)

    def _passing(self, camera: Camera, facets: Indices) -> _Passing:
        """Find where edges of visible facets pass between two neighbouring pixels. ``facets``: (H * W,) facet
        that each pixel shows, -1 for none."""
        seen = np.zeros(len(self._owner) + 1, bool)
        seen[facets] = True
        seen[-1] = False
        first, second = self._topology.sides
        beside = np.flatnonzero(seen[self._facets[first]] | seen[self._facets[second]])
        facing = self._posed.facing(camera.center)
        outline = facing[first[beside]] != facing[second[beside]]
        chosen = beside[self._sharp[beside] | outline]
        starts, ends = (self._posed.vertices[ends].astype(float) for ends in self._topology.edges[chosen].T)
        if camera.distorted:
            starts, ends, parents = LensView(camera).divide_edges(starts, ends, VISIBLE)
            chosen = chosen[parents]
        starts, ends, kept = _before_camera(camera, starts, ends)
        (p, near), (q, far) = camera.project_optical(starts), camera.project_optical(ends)
        good = np.isfinite(p[:, 0]) & np.isfinite(q[:, 0])
        edges = ImageEdges((*p[good].T, near[good]), (*q[good].T, far[good]))
        crossings = edge_crossings([edges], camera.size)
        return _Passing(crossings, chosen[kept][good][crossings.edge], (q - p)[good][crossings.edge])

    def _narrow(self, camera: Camera, facets: Indices, passing: _Passing) -> _Narrow:
        """Shares of pixels that narrow surfaces cover, one for each crossing of their edges. A share is
        positive if the surface begins at the edge, and negative if it ends there."""
        facing, sides = self._posed.facing(camera.center), self._topology.sides
        pixel, share, facet = [], [], []
        outline = facing[sides[0][passing.edge]] != facing[sides[1][passing.edge]]
        for number, (side, forward) in enumerate(zip(sides, self._forward, strict=True)):
            surface = side[passing.edge]
            used = np.where(outline, facing[surface], True)
            if number:
                used &= ~self._topology.border[passing.edge]
            sign = np.where((forward[passing.edge] == facing[surface]) == passing.left, 1.0, -1.0)
            pixel.append(passing.crossings.pixel[used])
            share.append((sign * passing.crossings.share)[used])
            facet.append(self._facets[surface[used]])
        return _Narrow.of(np.concatenate(pixel), np.concatenate(share), np.concatenate(facet), facets)

    def _intersections(self, camera: Camera, shown: Indices, edges: EdgeCrossings) -> EdgeCrossings:
        """Find crossings where two surfaces intersect between neighbouring pixels, and no edge passes.
        ``edges``: the crossings of edges."""
        width, height = camera.size
        image, rays = self._facets[shown].reshape(height, width), pixel_rays(camera)
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
            # differences of 1 / z, which is linear in an image without distortion
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
        """(3, N) vector of the plane of each triangle: its product with the ray (x, y, 1) of a pixel is 1 /
        z."""
        normals = self._posed.areas[:, triangles].astype(float)
        corner = self._posed.points[:, self._topology.corners[0][triangles]]
        distance = np.einsum("ij,ij->j", normals, corner - camera.center[:, None])
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(camera.R @ normals / distance)


class _Passing(NamedTuple):
    """Places where edges pass between pixels. ``edge``: (N,) number of the edge. ``run``: (N, 2) direction of
    the edge in the image."""

    crossings: EdgeCrossings
    edge: Indices
    run: Array

    def take(self, which: Indices) -> _Passing:
        return _Passing(self.crossings.take(which), self.edge[which], self.run[which])

    @property
    def _step(self) -> tuple[NDArray[np.bool_], Array]:
        """(N,) whether the neighbour is in the same row; and (N,) 1 if it comes after the pixel, -1 if
        before."""
        step = self.crossings.neighbour - self.crossings.pixel
        return np.abs(step) == 1, np.sign(step).astype(float)

    @property
    def across(self) -> NDArray[np.bool_]:
        """(N,) whether the edge runs more across the line from pixel to neighbour than along this line."""
        x, y = np.abs(self.run.T)
        return self._step[0] == (y >= x)

    @property
    def left(self) -> NDArray[np.bool_]:
        """(N,) whether the neighbour is to the left of the edge, seen from its start to its end."""
        level, step = self._step
        x, y = self.run.T
        return np.where(level, y, -x) * step > 0


class _Narrow(NamedTuple):
    """Narrow surfaces that pass between pixel centers. ``share``: (N,) share of ``pixel`` (N,) that the
    surface covers. ``source``: (N,) another pixel that shows the same facet, for the colour."""

    pixel: Indices
    share: Array
    source: Indices

    @classmethod
    def of(cls, pixel: Indices, share: Array, facet: Indices, facets: Indices) -> _Narrow:
        """For each of the facets (N,), find the nearest pixel that shows it, in the order of rows. Facets
        that no pixel shows are left out. ``facets``: (H * W,) facet that each pixel shows, or -1."""
        wanted = np.zeros(max(int(facet.max(initial=-1)), int(facets.max(initial=-1))) + 2, bool)
        wanted[facet] = True
        shows = np.flatnonzero(wanted[facets])
        shows = shows[np.argsort(facets[shows], kind="stable")]
        if not len(shows):
            return cls(pixel[:0], share[:0], pixel[:0])
        after = np.searchsorted(facets[shows] * len(facets) + shows, facet * len(facets) + pixel)
        around = shows[[np.maximum(after - 1, 0), np.minimum(after, len(shows) - 1)]]
        distance = np.where(facets[around] == facet, np.abs(around - pixel), len(facets))
        nearest = distance.argmin(axis=0)[None]
        found = np.take_along_axis(distance, nearest, axis=0)[0] < len(facets)
        return cls(pixel[found], share[found], np.take_along_axis(around, nearest, axis=0)[0, found])


def _add(image: NDArray[np.uint8], narrow: _Narrow, colours: NDArray[np.uint8]) -> None:
    """Blend the colours (N, C) of narrow surfaces into the pixels of an image (H * W, C), in place."""
    pixels, which = np.unique(narrow.pixel, return_inverse=True)
    covered = np.bincount(which, narrow.share, len(pixels))
    sums = np.stack([np.bincount(which, narrow.share * one, len(pixels)) for one in colours.T], axis=1)
    seen = np.flatnonzero(covered > _VISIBLE)
    colour = np.clip(sums[seen] / covered[seen, None], 0, 255)
    part = np.minimum(covered[seen, None], 1)
    image[pixels[seen]] = np.rint(image[pixels[seen]] * (1 - part) + colour * part).astype(np.uint8)


def _before_camera(camera: Camera, starts: Array, ends: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Clip edges (E, 3) at the near plane of the camera. Returns starts and ends (K, 3) of the remaining
    parts in the optical frame, and mask (E,) of the edges that have such a part."""
    near = near_plane(camera)
    a, b = camera.to_optical(starts), camera.to_optical(ends)
    kept = np.maximum(a[:, 2], b[:, 2]) > near
    a, b = a[kept], b[kept]
    for point, other in ((a, b), (b, a)):
        behind = point[:, 2] < near
        share = (near - point[behind, 2]) / (other[behind, 2] - point[behind, 2])
        point[behind] += share[:, None] * (other[behind] - point[behind])
    return a, b, kept
