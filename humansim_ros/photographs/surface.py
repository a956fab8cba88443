"""The surface of a person in views, and a texture in which each triangle shows one photograph.

This module finds what each view shows of the surface, and colours for the parts that no view shows. It makes
the texture of the thesis: each triangle takes its colours from one photograph.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csr_matrix, diags
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from humansim_ros.cameras.camera import Camera
from humansim_ros.errors import PhotographError
from humansim_ros.files.mesh import Mesh, SurfaceTexels, pack_images, padded
from humansim_ros.files.reading import encode_image
from humansim_ros.geometry import unit_vectors
from humansim_ros.people.humans import Human
from humansim_ros.render.frame import GLRenderer
from humansim_ros.render.interface import Body
from humansim_ros.types import Array, Float32Array, Image, Indices


@dataclass(frozen=True, eq=False)
class TextureView:
    """A photograph of a person in a known pose.

    Attributes:
        name: Name of the view.
        camera: Camera with its lens and its pose in ``map``.
        image: (H, W, 3) uint8 sRGB.
        vertices: (V, 3) float32, the vertices of the person in ``map``, metres.
        mask: (H, W) whether each pixel shows the person; None if no mask is known.
    """

    name: str
    camera: Camera
    image: Image
    vertices: Float32Array
    mask: NDArray[np.bool_] | None = None

    def __repr__(self) -> str:
        return f"TextureView({self.name!r}, {self.camera!r})"


@dataclass(frozen=True, eq=False)
class TexturedPerson:
    """A human with the appearance of a person in photographs.

    Attributes:
        human: The human, wearing the new texture.
        cameras: (N,) index of the view that each triangle of the mesh takes its colour from, or takes most
            of it from; -1 if no view shows anything of the person.
        seen: (N,) whether some view shows the triangle. The colours of other triangles are guesses.
        gains: (C, 3) factors of the red, green and blue sRGB values of each view. They were removed from the
            colours. None if colours were not aligned.
        views: Names of the C views.
        notes: Sentences about the result for the user, by a keyword.
    """

    human: Human
    cameras: NDArray[np.int32]
    seen: NDArray[np.bool_]
    gains: Array | None = None
    views: tuple[str, ...] = ()
    notes: Mapping[str, str] = field(default_factory=dict)


#: Two vertices form a left-right pair if one is nearer than this to the mirror image of the other; as a share
#: of the height.
_MIRROR = 0.008
#: Tolerance when depths are compared, metres. It grows with the tangent of the viewing angle, up to this
#: tangent.
_DEPTH, _STEEPEST = 0.006, 6.0
#: A place that is seen at a flatter angle (a smaller cosine of the viewing angle) does not count.
_LEAST_COSINE = 0.12
#: Width of the border of the person where its colours mix with the background; and width of the zone inside
#: of the border where weights grow; pixels.
_BORDER, _RAMP = 1.0, 4.0
#: A jump of depth between neighbouring pixels that is larger than this is a border, metres.
_JUMP = 0.04
#: If the pose is slightly wrong, a strip behind a jump may show what is in front of the jump. This is the
#: width of the strip, metres.
_DOUBTFUL = 0.02
#: Rounds of averaging over neighbours, so that weights fade towards the border of the seen surface.
_FADE = 4
#: Lists of texels are arranged as images with this number of columns, since OpenCV takes images.
_COLUMNS = 4096


@dataclass(frozen=True, eq=False)
class Surface:
    """Topology of a mesh in the rest pose. Vertices at the same position (texture seams) are one place.

    Attributes:
        mesh: The mesh in the rest pose. The x axis points to the person's left.
        place: (V,) number of the place of each vertex.
        points: (P, 3) positions of the places.
    """

    mesh: Mesh
    place: Indices
    points: Array

    @classmethod
    def of(cls, mesh: Mesh) -> Surface:
        """Surface of a mesh."""
        points, place = np.unique(mesh.vertices, axis=0, return_inverse=True)
        return cls(mesh, place.reshape(-1), points)

    def places(self, vertices: NDArray[np.floating]) -> Array:
        """Positions (P, 3) of the places, from vertices (V, 3) of the mesh in a pose."""
        points = np.zeros((len(self.points), 3))
        points[self.place] = vertices
        return points

    @cached_property
    def triangles(self) -> Indices:
        """(N, 3) places of the corners of the triangles."""
        return np.asarray(self.place[self.mesh.triangles])

    @cached_property
    def graph(self) -> csr_matrix:
        """(P, P) sparse matrix of the edges between places, weighted by the inverse of their length."""
        sides = self.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        sides = np.unique(np.sort(sides, axis=1), axis=0)
        sides = sides[sides[:, 0] != sides[:, 1]]
        lengths = np.linalg.norm(self.points[sides[:, 0]] - self.points[sides[:, 1]], axis=1)
        values = 1 / np.maximum(lengths, 1e-6 * max(float(np.ptp(self.points)), 1e-6))
        count = len(self.points)
        half = coo_matrix((values, (sides[:, 0], sides[:, 1])), (count, count))
        return csr_matrix(half + half.T)

    @cached_property
    def mirrored(self) -> Indices:
        """(P,) number of the mirrored place on the other side of the body; -1 if a place has none."""
        distance, other = cKDTree(self.points).query(self.points * [-1, 1, 1])
        height = float(np.ptp(self.points[:, 1]))
        return np.where(distance < _MIRROR * height, other, -1)

    @cached_property
    def mirrored_triangles(self) -> tuple[Indices, Indices]:
        """For each triangle, the triangle at the mirrored place on the other side of the body.

        Returns:
            Number (N,) of the other triangle, -1 if there is none; and (N, 3) for each corner of the other
            triangle the corner (0, 1 or 2) of this triangle that is its mirror image.
        """
        opposite = self.mirrored[self.triangles]
        order, other = np.argsort(opposite, axis=1), np.argsort(self.triangles, axis=1)
        count = len(self.points)

        def keys(corners: Indices) -> Indices:
            return np.asarray((corners[:, 0] * count + corners[:, 1]) * count + corners[:, 2])

        own = keys(np.take_along_axis(self.triangles, other, axis=1))
        wanted = keys(np.take_along_axis(opposite, order, axis=1))
        by_key = np.argsort(own, kind="stable")
        at = np.minimum(np.searchsorted(own, wanted, sorter=by_key), len(own) - 1)
        found = by_key[at]
        exists = (own[found] == wanted) & (opposite >= 0).all(axis=1)
        corner = np.zeros_like(order)
        np.put_along_axis(corner, other[found], order, axis=1)
        return np.where(exists, found, -1), corner

    def smoothed(self, values: NDArray[np.floating], rounds: int) -> NDArray[np.floating]:
        """Average the values (P, ...) of each place with those of its neighbours, several times."""
        step = diags(1 / np.maximum(np.asarray(self.graph.sum(axis=1)).ravel(), 1e-12)) @ self.graph
        for _ in range(rounds):
            values = 0.5 * values + 0.5 * (step @ values)
        return values


def fill_colours(surface: Surface, colours: Array, seen: NDArray[np.bool_]) -> Array:
    """Find colours (P, 3) of all places from the colours of the seen places.

    Hidden places continue the colours at their border as smoothly as possible. If the other side of the body
    is seen, hidden places also take the differences of colour from there (Poisson's equation on the surface
    [Perez 2003]). Parts without any seen place take the colour of the nearest seen place.

    Args:
        surface: The surface.
        colours: (P, 3) colours. Only those of seen places are used.
        seen: (P,) whether the colour is known. At least one colour must be known.
    """
    out = np.array(colours, dtype=float)
    hidden = ~seen
    if not hidden.any():
        return out
    count, component = connected_components(surface.graph, directed=False)
    reached = np.bincount(component[seen], minlength=count) > 0
    free = hidden & reached[component]
    if free.any():
        graph = surface.graph
        laplacian = csr_matrix(diags(np.asarray(graph.sum(axis=1)).ravel()) - graph)
        rows = laplacian[free]
        right = _guide(surface, out, seen, free)[free] - rows[:, seen] @ out[seen]
        matrix = rows[:, free].tocsc()
        out[free] = splu(matrix + 1e-9 * diags(matrix.diagonal())).solve(right)
    alone = hidden & ~free
    if alone.any():
        _, nearest = cKDTree(surface.points[seen]).query(surface.points[alone])
        out[alone] = out[seen][nearest]
    return np.clip(out, 0, 255)


def _guide(surface: Surface, colours: Array, seen: NDArray[np.bool_], free: NDArray[np.bool_]) -> Array:
    """Right side (P, 3) of Poisson's equation: for each place, the sum over its edges of the weighted
    differences of colour on the other side of the body, where known."""
    other = surface.mirrored
    known = (other >= 0) & seen[np.maximum(other, 0)]
    image = np.where(known[:, None], colours[np.maximum(other, 0)], 0.0)
    edges = surface.graph.tocoo()
    both = known[edges.row] & known[edges.col] & (free[edges.row] | free[edges.col])
    row, column, weight = (each[both] for each in (edges.row, edges.col, edges.data))
    guide = np.zeros_like(colours, dtype=float)
    np.add.at(guide, row, weight[:, None] * (image[row] - image[column]))
    return guide


@dataclass(frozen=True, eq=False)
class SurfaceSight:
    """What one view shows of a surface.

    Attributes:
        view: The view.
        pixels: (P, 2) float32 pixels of the places.
        depths: (P,) depths of the places along the axis of the camera, metres.
        tolerance: (P,) tolerance of the depths, metres.
        weights: (P,) float32 how well the places are seen. The weight is 0 if the place is hidden, and grows
            with the number of pixels per metre. It fades out towards the border of the seen surface.
        depth_image: (H, W) float32 depths, metres. Infinite where the person or the mask is absent.
        inside: (H, W) float32 from 0 to 1. It is 0 at borders of the person, where colours mix with those of
            things behind, and grows away from borders.
    """

    view: TextureView
    pixels: Float32Array
    depths: Float32Array
    tolerance: Float32Array
    weights: Float32Array
    depth_image: Float32Array
    inside: Float32Array

    @cached_property
    def resolution(self) -> float:
        """Pixels per metre of the seen surface, viewed at right angles; 0 if nothing is seen."""
        seen = self.weights > 0
        if not seen.any():
            return 0.0
        focal = float(np.sqrt(abs(np.linalg.det(self.view.camera.K[:2, :2]))))
        return focal / float(np.median(self.depths[seen]))

    def texel_weights(self, surface: Surface, texels: SurfaceTexels) -> tuple[Float32Array, Float32Array]:
        """Pixels (M, 2) of texels, and weights (M,), interpolated between the corners of triangles; 0 if
        hidden."""
        triangles = surface.triangles
        values = np.column_stack([self.pixels, self.depths, self.tolerance, self.weights])
        mixed = texels.mix(np.nan_to_num(values).astype(np.float32), triangles)
        projected = np.isfinite(self.pixels).sum(axis=1) == 2
        visible = projected[triangles].sum(axis=1)[texels.triangle] == 3
        nearest = lookup(self.depth_image, mixed[:, :2], cv2.INTER_NEAREST, np.inf)
        visible &= mixed[:, 2] <= nearest + mixed[:, 3]
        visible &= np.isfinite(nearest)
        inside = lookup(self.inside, mixed[:, :2])  # large triangles reach borders between their corners
        return mixed[:, :2], np.where(visible, mixed[:, 4] * inside, 0).astype(np.float32)


def lookup(
    image: NDArray[np.floating], pixels: Float32Array, how: int = cv2.INTER_LINEAR, outside: float = 0.0
) -> NDArray[np.float32]:
    """Values (M, ...) of an image at pixels.

    Args:
        image: (H, W, ...) values.
        pixels: (M, 2) x, y. They may be outside of the image.
        how: Interpolation of OpenCV.
        outside: Value outside of the image.
    """
    count = len(pixels)
    rows = -(-count // _COLUMNS)
    flat = np.full((rows * _COLUMNS, 2), -1e6, np.float32)
    flat[:count] = pixels
    table = flat.reshape(rows, _COLUMNS, 2)
    beyond: dict[str, Any] = {"borderMode": cv2.BORDER_CONSTANT, "borderValue": (outside,) * 4}
    found = [
        cv2.remap(np.asarray(image, np.float32), part[..., 0], part[..., 1], how, **beyond)
        for part in np.array_split(table, max(1, rows // 16384 + 1))
    ]
    whole = np.concatenate(found).reshape(rows * _COLUMNS, *image.shape[2:])
    return np.asarray(whole[:count], np.float32)


def see_surface(
    human: Human, surface: Surface, view: TextureView, points: Array, renderer: GLRenderer
) -> SurfaceSight:
    """Find what a view shows of the surface of a person.

    Args:
        human, surface: The person, and its surface.
        view, points: The photograph, and the positions (P, 3) of the places of the surface in ``map``.
        renderer: Renderer of an empty scene.
    """
    camera = view.camera
    body = Body(human.mesh, view.vertices, human.triangle_parts, 1)
    depth = np.array(renderer.render([body], camera, ("depth",)).depth, np.float32)
    if view.mask is not None:
        depth[~view.mask] = np.inf
    a, b, c = (points[surface.triangles[:, corner]] for corner in range(3))
    normals = np.zeros_like(points)  # of the places, weighted by area
    for corner in range(3):
        np.add.at(normals, surface.triangles[:, corner], np.cross(b - a, c - a))
    normals = unit_vectors(normals)
    pixels, depths = camera.project(points)
    toward = unit_vectors(camera.center - points)
    cosine = np.einsum("ij,ij->i", normals, toward)
    focal = float(np.sqrt(abs(np.linalg.det(camera.K[:2, :2]))))
    tangent = np.sqrt(np.maximum(1 - cosine**2, 0)) / np.maximum(cosine, 1e-3)
    tolerance = _DEPTH + np.minimum(tangent, _STEEPEST) * np.maximum(depths, 0) / focal
    at = np.nan_to_num(pixels, nan=-1e6).astype(np.float32)
    behind = lookup(depth, at, cv2.INTER_NEAREST, np.inf)
    visible = np.isfinite(behind) & (depths <= behind + tolerance) & (cosine > _LEAST_COSINE) & (depths > 0)
    behind_steps = step_distance(depth) * depth / focal > _DOUBTFUL
    inside = np.clip((_border_distance(depth) - _BORDER) / _RAMP, 0, 1) * behind_steps
    faded = np.clip(2 * surface.smoothed(visible.astype(float), _FADE) - 1, 0, 1)
    density = np.where(visible, focal / np.maximum(depths, 1e-3), 0.0) / 100  # about 1 for usual images
    weights = visible * lookup(inside, at) * faded * np.maximum(cosine, 0) ** 2 * density**2
    places, distances, slack, shares = (
        values.astype(np.float32) for values in (pixels, depths, tolerance, weights)
    )
    return SurfaceSight(view, places, distances, slack, shares, depth, inside)


def _border_distance(depth: Float32Array) -> Float32Array:
    """Distance (H, W) in pixels of each pixel from the nearest pixel without the person, or from a jump of
    the depth of the person."""
    seen = np.isfinite(depth)
    filled = np.where(seen, depth, 0).astype(np.float32)
    kernel = np.ones((3, 3), np.uint8)
    highest = cv2.dilate(filled, kernel)
    lowest = cv2.erode(np.where(seen, depth, 1e6).astype(np.float32), kernel)
    smooth = seen & (highest - lowest < _JUMP + 0.01 * filled)
    return np.asarray(cv2.distanceTransform(smooth.astype(np.uint8), cv2.DIST_L2, 3), np.float32)


def step_distance(depth: Float32Array) -> Float32Array:
    """Distance (H, W) in pixels of each pixel from the nearest part of the person that is nearer to the
    camera by a jump of the depth. It is 1e6 if there is none."""
    seen = np.isfinite(depth)
    far = np.where(seen, depth, 1e6).astype(np.float32)
    nearest = cv2.erode(far, np.ones((3, 3), np.uint8))
    steps = seen & (far - nearest > _JUMP + 0.01 * nearest)
    if not steps.any():
        return np.full(depth.shape, 1e6, np.float32)
    distance, labels = cv2.distanceTransformWithLabels(
        (~steps).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    # the depth behind the nearest step decides on which side of the step a pixel is
    at = np.zeros(int(labels.max()) + 1, np.float32)
    at[labels[steps]] = ((far + nearest) / 2)[steps]
    return np.where(far >= at[labels], distance, 1e6).astype(np.float32)


#: Name of the outfit of textured people.
OUTFIT = "photographs"
#: The texture includes this number of pixels around the person, so that its coarser mip levels do not mix in
#: other colours.
_MARGIN = 8
#: Least share of the pixels of a triangle that a view has to show, so that the triangle takes its colours.
_LEAST_VISIBLE = 0.5
#: Most rounds in which triangles without a view take the view of their neighbours.
_ROUNDS = 10


def count_faces(human: Human, views: Sequence[TextureView]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Count the visible and the covered pixels of the N triangles of a person in C views.

    Pixel centres are counted, through the lens. Both counts are equal for a triangle that nothing hides. If a
    view has a mask, only pixels of the mask show the person.

    Returns:
        Number of pixels that show each triangle (C, N), and number of pixels that would show it if nothing
        hid it (C, N).

    Raises:
        RenderError: OpenGL is missing or failed.
    """
    count = len(human.mesh.triangles)
    visible, covered = np.zeros((2, len(views), count), np.int32)
    with GLRenderer() as renderer:
        for number, view in enumerate(views):
            body = Body(human.mesh, view.vertices, human.triangle_parts, 1)
            face = renderer.render([body], view.camera, ("face",)).face
            shown = face[face > 0] if view.mask is None else face[(face > 0) & view.mask]
            visible[number] = np.bincount(shown, minlength=count + 1)[1:]
            covered[number] = renderer.coverage(body, view.camera)
    return visible, covered


def triangle_neighbours(mesh: Mesh) -> Indices:
    """Pairs of triangles (E, 2) that share an edge. Each pair appears once, with the lower triangle first.
    Vertices at the same position count as one, since some files have two vertices at each point of a texture
    seam."""
    _, place = np.unique(mesh.vertices, axis=0, return_inverse=True)
    corners = place.reshape(-1)[mesh.triangles]
    sides = np.sort(corners[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    keys = sides[:, 0] * len(mesh.vertices) + sides[:, 1]
    order = np.argsort(keys, kind="stable")
    keys, owner = keys[order], order // 3
    pairs = [np.empty((0, 2), np.intp)]
    # if more than two triangles share an edge, all pairs of them are listed
    step = 1
    while step < len(keys) and (same := keys[step:] == keys[:-step]).any():
        pairs.append(np.stack([owner[:-step][same], owner[step:][same]], axis=1))
        step += 1
    both = np.unique(np.sort(np.concatenate(pairs), axis=1), axis=0)
    return np.asarray(both[both[:, 0] != both[:, 1]])


def choose_cameras(
    visible: NDArray[np.int32], covered: NDArray[np.int32], neighbours: Indices
) -> NDArray[np.int32]:
    """Choose the view of each triangle.

    Among the views that see at least half of the pixels of a triangle, the view with most visible pixels is
    chosen. A triangle without such a view takes the view of most of its neighbours. This is repeated in
    rounds, outwards from the triangles that have a view. Each remaining triangle takes the view in which it
    covers most pixels, or else the view of most triangles. If views are equal, the first is taken.

    ``visible``, ``covered``: (C, N) results of :func:`count_faces`. ``neighbours``: (E, 2) pairs of triangles
    with a common edge.

    Returns:
        (N,) index of the view of each triangle; all are -1 if no view shows any.
    """
    views, count = visible.shape
    score = np.where(visible >= _LEAST_VISIBLE * covered, visible, 0)
    chosen = np.where(score.max(axis=0) > 0, score.argmax(axis=0), -1)
    ends = np.concatenate([neighbours, neighbours[:, ::-1]])
    for _ in range(_ROUNDS):
        known = chosen[ends[:, 1]]
        voting = (chosen[ends[:, 0]] < 0) & (known >= 0)
        if not voting.any():
            break
        ballots = np.bincount(ends[voting, 0] * views + known[voting], minlength=count * views)
        votes = ballots.reshape(count, views)
        chosen = np.where(votes.max(axis=1) > 0, votes.argmax(axis=1), chosen)
    if not (chosen >= 0).any():
        return np.full(count, -1, np.int32)
    most = np.bincount(chosen[chosen >= 0]).argmax()
    rest = np.where(covered.max(axis=0) > 0, covered.argmax(axis=0), most)
    return np.where(chosen < 0, rest, chosen).astype(np.int32)


def texture_thesis(human: Human, views: Sequence[TextureView]) -> TexturedPerson:
    """Texture a person. Each triangle takes its colours from the photograph that shows it best.

    The colours of the photographs are not changed, so neighbouring triangles may differ. The faces of the
    result are triangles, in the order of ``human.mesh.triangles``. Its only outfit is ``photographs``.

    ``human``: the person without its texture. ``views``: photographs with the pose of the person in each.

    Raises:
        PhotographError: No view shows the person.
        RenderError: OpenGL is missing or failed.
    """
    visible, covered = count_faces(human, views)
    cameras = choose_cameras(visible, covered, triangle_neighbours(human.mesh))
    if cameras.min() < 0:
        raise PhotographError("no photograph shows the person: check the calibration and the fit")
    triangles = human.mesh.triangles
    # a vertex has one texture coordinate for each view that its triangles take
    pairs = cameras[:, None].astype(np.intp) * len(human.mesh.vertices) + triangles
    used, corners = np.unique(pairs, return_inverse=True)
    view_of, vertex = np.divmod(used, len(human.mesh.vertices))
    texture, uv = _photographs(views, view_of, vertex)
    faces, uv_faces = padded(triangles), padded(corners.reshape(-1, 3))
    whole = replace(human.mesh, colors=None, skin=None, materials=None, hair=None)
    mesh = replace(whole, faces=faces, uv=uv, uv_faces=uv_faces, texture=texture)
    dressed = replace(human, mesh=mesh, looks={OUTFIT: encode_image(texture)}, outfit=OUTFIT)
    names = tuple(view.name for view in views)
    return TexturedPerson(dressed, cameras, np.asarray(visible.any(axis=0)), views=names)


def _photographs(
    views: Sequence[TextureView], view_of: Indices, vertex: Indices
) -> tuple[NDArray[np.uint8], Array]:
    """Texture (H, W, 3) of the used parts of the photographs, and texture coordinates (T, 2), v up.
    ``view_of``, ``vertex``: (T,) view and vertex of each texture coordinate."""
    pixels: Array = np.zeros((len(vertex), 2))
    tiles, corners, numbers = [], [], []
    for number, view in enumerate(views):
        mine = np.flatnonzero(view_of == number)
        if not len(mine):
            continue
        size = np.array(view.camera.size)
        projected = view.camera.project(view.vertices[vertex[mine]])[0]
        # a hidden vertex may be outside the image, or where no ray reaches it
        finite = np.isfinite(projected[:, 0])
        middle = projected[finite].mean(axis=0) if finite.any() else size / 2
        pixels[mine] = np.clip(np.where(finite[:, None], projected, middle), 0, size - 1)
        low = np.maximum(np.floor(pixels[mine].min(axis=0)).astype(int) - _MARGIN, 0)
        high = np.minimum(np.ceil(pixels[mine].max(axis=0)).astype(int) + _MARGIN + 1, size)
        tiles.append(view.image[low[1] : high[1], low[0] : high[0]])
        corners.append(low)
        numbers.append(number)
    texture, boxes = pack_images(tiles)
    height, width = texture.shape[:2]
    uv = np.zeros_like(pixels)
    for number, low, tile, (x, y, w, h) in zip(numbers, corners, tiles, boxes, strict=True):
        mine = np.flatnonzero(view_of == number)
        scale = np.array([w, h]) / (tile.shape[1], tile.shape[0])
        across, down = ((pixels[mine] - low + 0.5) * scale + (x, y)).T
        uv[mine] = np.stack([across / width, 1 - down / height], axis=1)
    return texture, uv
