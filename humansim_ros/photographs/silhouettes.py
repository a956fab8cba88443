"""Refine a fitted person by the outlines of masks (silhouettes)."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.spatial import cKDTree

from humansim_ros.cameras.camera import Camera
from humansim_ros.errors import HumansimWarning
from humansim_ros.files.mesh import Mesh
from humansim_ros.people.humans import Human
from humansim_ros.people.keypoints import keypoint_set
from humansim_ros.photographs.person_fit import (
    GREATEST_OFFSET,
    PersonFit,
    shaped_human,
    surface_offsets,
    with_proportions,
)
from humansim_ros.photographs.pose_fitting import (
    LEAST_NOISE,
    EdgePoints,
    Settings,
    Sight,
    fields_of_states,
    fit_poses,
    fitted_states,
)
from humansim_ros.photographs.pose_model import Attachments, BodyState, PoseModel
from humansim_ros.photographs.views import EmptyMaskError, PhotoSet, exchanged_back
from humansim_ros.render.frame import make_renderer
from humansim_ros.render.interface import Body
from humansim_ros.types import Array, Float32Array, Indices

#: Number of points along the outlines of a mask: to fit pose and proportions, and to fit the surface.
_COUNT, _SURFACE_COUNT = 160, 600
#: A separate part or a hole of a mask with a smaller area, pixels, is ignored.
_SPECK = 30
#: Distances are smoothed before their slopes are computed, by a Gaussian of this standard deviation, pixels.
_SMOOTH = 1.5
#: A smoothed slope shorter than this has no certain direction.
_LEAST_SLOPE = 0.3
#: Outlines that are farther apart than this share of the size of the person do not belong together.
_FARTHEST = 0.5
#: Margin around two masks, pixels, so that slopes at their outlines are known.
_MARGIN = 8
#: Rounds of rendering and least squares: before offsets of the surface are fitted, and while they are fitted.
_ROUNDS, _SURFACE_ROUNDS = 4, 5
#: Least squares ends after this number of steps in each round, because the outline moves with the body.
_STEPS = 4
#: Standard deviation of outlines, as a share of the side of a square with the area of the person. It is
#: large, because clothes differ from bodies, and because errors of neighbouring points are alike.
_NOISE = 0.022
#: Weight of keypoints on the skin, such as eyes. It is large, since otherwise outlines of hair and hoods
#: would turn and stretch the head.
_SKIN = 2.0
#: For offsets of the surface: their standard deviation, metres; standard deviation of outlines, as a share
#: like _NOISE; outlines farther away than this number of standard deviations count less.
_SPREAD, _SURFACE_NOISE, _ROBUST = 0.02, 0.007, 4.0
Faces = NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class MaskOutline:
    """Outline of a mask (H, W)."""

    mask: NDArray[np.bool_]

    @cached_property
    def distances(self) -> Float32Array:
        """Distances (H, W) from the outline, pixels, negative inside. The border of the image does not count
        as an outline."""
        inside, outside = (
            np.asarray(cv2.distanceTransform(part.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE))
            for part in (self.mask, ~self.mask)
        )
        return np.asarray(np.where(self.mask, 0.5 - inside, outside - 0.5), dtype=np.float32)

    @cached_property
    def slopes(self) -> Float32Array:
        """Directions (H, W, 2) away from the mask: unit vectors, but shorter midway between two outlines,
        where the direction is uncertain."""
        smooth = cv2.GaussianBlur(self.distances, (0, 0), _SMOOTH)
        down, right = np.gradient(smooth)
        return np.stack([right, down], axis=-1).astype(np.float32)

    def pixels(self, count: int = _COUNT) -> NDArray[np.intp]:
        """About ``count`` pixels (N, 2) x, y along the outlines, without the border of the image."""
        height, width = self.mask.shape
        found, _ = cv2.findContours(self.mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
        large = [each[:, 0] for each in found if cv2.contourArea(each) >= _SPECK]
        step = max(sum(map(len, large)) // count, 1)
        kept = [each[::step] for each in large]
        pixels = np.concatenate(kept) if kept else np.zeros((0, 2), np.intp)
        x, y = pixels.T
        within = (x > 1) & (y > 1) & (x < width - 2) & (y < height - 2)
        return np.asarray(pixels[within], dtype=np.intp)


@dataclass(frozen=True, eq=False)
class Edges:
    """Points on the surface of a body. Each should move along a line in an image, to meet the outline.

    Attributes:
        vertices: (N,) number of the vertex nearest to each point.
        normals: (N, 2) directions of the lines in the image.
        distances: (N,) how far the points have to move along the normals, pixels.
        size: Side of a square with the area of the given mask, pixels.
    """

    vertices: Indices
    normals: Array
    distances: Array
    size: float


def find_edges(
    given: MaskOutline,
    camera: Camera,
    vertices: Float32Array,
    mesh: Mesh,
    face: NDArray[np.int32],
    count: int = _COUNT,
) -> Edges:
    """Pair points on the outline of a rendered body with points on the given outline.

    Each point of the rendered outline is paired with the nearest point of the given outline, and each point
    of the given outline with the nearest rendered one. So an arm of the mask that the body does not cover
    attracts the nearest part of the body.

    Args:
        given: Outline of the given mask.
        camera: Camera of the image.
        vertices: Vertices (V, 3) of the body in ``map``.
        mesh: Mesh of the body.
        face: 1 + number of the triangle at each pixel of the rendered body, (H, W).
        count: Number of points along each of the two outlines.
    """
    corner, cut = _cut_around(given.mask, face)
    rendered = MaskOutline(cut > 0)
    own, other, size = rendered.pixels(count) + corner, given.pixels(count), float(np.sqrt(given.mask.sum()))
    if not len(own) or not len(other):
        return Edges(np.zeros(0, np.intp), np.zeros((0, 2)), np.zeros(0), size)
    nearest, there = cKDTree(own).query(other)[1], _at(other - corner)
    rows = [
        # the middle of a pixel on the outline of a mask is half a pixel inside of the outline
        (own, given.slopes[_at(own)], -given.distances[_at(own)] - 0.5),
        (own[nearest], rendered.slopes[there], rendered.distances[there] + 0.5),
    ]
    pixels, normals, distances = (np.concatenate([row[part] for row in rows]) for part in range(3))
    corners = mesh.triangles[face[_at(pixels)] - 1]
    seen = camera.project(vertices[corners].reshape(-1, 3))[0].reshape(-1, 3, 2)
    gaps = np.nan_to_num(np.linalg.norm(seen - pixels[:, None], axis=2), nan=np.inf)
    vertex = corners[np.arange(len(corners)), np.argmin(gaps, axis=1)]
    lengths = np.linalg.norm(normals, axis=1)
    # at a crease, midway between two outlines, the direction is not known
    clear = (lengths > _LEAST_SLOPE) & (np.abs(distances) < _FARTHEST * size)
    unit = normals[clear] / lengths[clear, None]
    own_distances = distances[clear].astype(float)
    return Edges(vertex[clear].astype(np.intp), unit.astype(float), own_distances, size)


def own_parts(mask: NDArray[np.bool_], body: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return those connected parts of a mask (H, W) that a roughly fitted body (H, W) touches. Other parts
    show other people. If the body touches no part of the mask, the whole mask is returned."""
    _, labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
    touched = np.isin(labels, np.unique(labels[mask & body]))
    return np.asarray(touched if touched.any() else mask)


def intersection_over_union(first: NDArray[np.bool_], second: NDArray[np.bool_]) -> float:
    """Intersection over union of two masks: pixels in both, divided by pixels in at least one; 0 if both are
    empty."""
    union = int((first | second).sum())
    return float((first & second).sum() / union) if union else 0.0


def _cut_around(
    mask: NDArray[np.bool_], face: NDArray[np.int32]
) -> tuple[NDArray[np.intp], NDArray[np.int32]]:
    """Crop a face image to the surroundings of the given mask and the body, to save time. Returns the top
    left corner (2,) x, y of the crop, and the crop."""
    both = (face > 0) | mask
    ranges = [np.flatnonzero(both.any(axis=axis)) for axis in (0, 1)]
    if not len(ranges[0]):
        return np.zeros(2, np.intp), face
    low = [max(int(each[0]) - _MARGIN, 0) for each in ranges]
    high = [int(each[-1]) + _MARGIN + 1 for each in ranges]
    return np.array(low, np.intp), face[low[1] : high[1], low[0] : high[0]]


def _at(pixels: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    return pixels[:, 1], pixels[:, 0]


def fit_silhouettes(fit: PersonFit, photos: PhotoSet, frames: Sequence[int] = (0,)) -> PersonFit:
    """Refine the proportions of a person, and the poses of some frames, by the masks of these frames.

    In each round the body is rendered, and points of its outline are paired with the outline of the mask.
    Pose, lengths and girths then follow by least squares of the distances of the pairs and of the keypoints.
    In the last rounds the surface also moves along its normals, since the remaining distances are due to
    clothes and hair.

    ``fit``: person fitted to the keypoints. ``photos``: photographs with masks. Photographs without a mask
    are not used. A HumansimWarning names empty masks. ``frames``: numbers of the frames with masks to use.
    Other frames get the new proportions and keep their poses.

    Returns:
        The refined person. If there is no mask, ``fit`` is returned.

    Raises:
        PhotographError: A mask cannot be read, or has another size than the images of its camera.
    """
    outlines = {number: _outlines(photos, number) for number in frames}
    chosen = [number for number, own in outlines.items() if own]
    if not chosen:
        return fit
    human = shaped_human(fit.human, fit.proportions)
    model = PoseModel(human, keypoint_set(fit.keypoints), fit.proportions)
    all_states = fitted_states(model, fit)
    states = [all_states[number] for number in chosen]
    noise = _noise(fit)
    sights = [_sight(fit, photos, model, number) for number in chosen]
    topology, renderer = human.mesh, make_renderer()

    def faces(number: int, vertices: Float32Array) -> dict[int, Faces]:
        """Face images of the body in the views of a frame that have a mask, by the number of the view."""
        # all rounds have the same topology, so a renderer prepares it once
        surface = Body(topology, vertices, human.triangle_parts, 1)
        return {
            view: renderer.render([surface], photos.frames[number][view].camera, ["face"]).face
            for view in outlines[number]
        }

    def edges(number: int, state: BodyState, count: int = _COUNT) -> dict[int, Edges]:
        """Edges of a frame by the number of the view."""
        vertices = _posed(human, model, state)
        return {
            view: find_edges(outlines[number][view], photos.cameras[view], vertices, topology, face, count)
            for view, face in faces(number, vertices).items()
        }

    try:
        for number, state in zip(chosen, states, strict=True):
            for view, face in faces(number, _posed(human, model, state)).items():
                outline = outlines[number][view]
                outlines[number][view] = MaskOutline(own_parts(outline.mask, face > 0))
        for step in range(_ROUNDS + _SURFACE_ROUNDS):
            if step >= _ROUNDS:
                pairs = zip(chosen, states, strict=True)
                found = [edges(number, state, _SURFACE_COUNT) for number, state in pairs]
                base = replace(model.base, offsets=_fit_offsets(fit.human, model, photos, states, found))
                human = shaped_human(fit.human, base)
                model = PoseModel(human, model.keypoint_set, base)
            with_edges = [
                replace(sight, edges=_points(human, model, state, photos, edges(number, state)))
                for number, state, sight in zip(chosen, states, sights, strict=True)
            ]
            states = fit_poses(model, states, with_edges, Settings(noise, steps=_STEPS))
    finally:
        renderer.close()
    for number, state in zip(chosen, states, strict=True):
        all_states[number] = state
    shape = {name: getattr(states[0], name) for name in ("stature", "lengths", "girths")}
    all_states = [replace(each, **shape) for each in all_states]
    points = [
        exchanged_back(photos.points[number], fit.swapped[number], photos.keypoints)
        for number in range(len(all_states))
    ]
    return replace(fit, **fields_of_states(model, human, all_states, photos.cameras, points))


def _posed(human: Human, model: PoseModel, state: BodyState) -> Float32Array:
    """Vertices (V, 3) of a posed body in ``map``. ``human``: the human before proportions are applied."""
    body = with_proportions(human, model.proportions(state))
    return body.pose(body.skeleton.pose(model.rotations(state), model.root(state, body.skeleton)))


def _fit_offsets(
    name: str,
    model: PoseModel,
    photos: PhotoSet,
    states: Sequence[BodyState],
    edges: Sequence[Mapping[int, Edges]],
) -> tuple[float, ...]:
    """Find offsets of the body surface that move the edges of the body onto the outlines of the masks.

    This is robust least squares, with the Gaussian process of :class:`SurfaceOffsets` as prior.

    ``name``: name or file of the human. ``model``: model of the human with its present offsets. ``edges``:
    for each frame, the edges of the body by number of the view.
    """
    field = surface_offsets(name, model.base.shape)
    plain = shaped_human(name, replace(model.base, offsets=()))
    grown = replace(plain, mesh=replace(plain.mesh, vertices=plain.mesh.vertices + field.normals))
    now = np.zeros(len(field.controls))
    if model.base.offsets:
        now = solve_triangular(field.factor, model.base.offsets, lower=True)
    matrix, right = np.eye(len(now)) / _SPREAD**2, np.zeros(len(now))
    for state, found in zip(states, edges, strict=True):
        positions = _posed(field.moved(plain, field.factor @ now), model, state)
        # positions depend linearly on the offsets
        slopes = _posed(grown, model, state).astype(float) - _posed(plain, model, state)
        for view, each in found.items():
            by_place = photos.cameras[view].project_jacobian(positions[each.vertices])
            slope = np.einsum("ni,nij,nj->n", each.normals, by_place, slopes[each.vertices])
            known = np.isfinite(slope)
            rows = slope[known, None] * (field.shares[each.vertices[known]] @ field.factor)
            noise = max(_SURFACE_NOISE * each.size, LEAST_NOISE)
            distances = each.distances[known]
            weights = 1 / (1 + (distances / noise / _ROBUST) ** 2) / noise**2
            matrix += (weights[:, None] * rows).T @ rows
            right += (weights * (distances + rows @ now)) @ rows
    offsets = field.factor @ np.linalg.solve(matrix, right)
    return tuple(np.clip(offsets, -GREATEST_OFFSET, GREATEST_OFFSET).round(5).tolist())


def silhouette_iou(fit: PersonFit, photos: PhotoSet, frame: int = 0) -> dict[str, float]:
    """Intersection over union of the rendered and the given mask, by the name of each view with a mask.

    Raises:
        PhotographError: A mask cannot be read, or has another size than the images of its camera.
    """
    outlines = _outlines(photos, frame)
    faces = render_faces(fit, photos, frame)
    return {
        photos.names[view]: intersection_over_union(outline.mask, faces[view] > 0)
        for view, outline in outlines.items()
    }


def render_faces(fit: PersonFit, photos: PhotoSet, frame: int = 0) -> list[Faces]:
    """For each view, an image (H, W) with 1 + number of the triangle of the body at each pixel; 0 where no
    body is."""
    body = fit.body
    surface = Body(body.mesh, fit.vertices(frame), body.triangle_parts, 1)
    renderer = make_renderer()
    try:
        return [renderer.render([surface], photo.camera, ["face"]).face for photo in photos.frames[frame]]
    finally:
        renderer.close()


def _outlines(photos: PhotoSet, number: int) -> dict[int, MaskOutline]:
    """Outlines of the masks of a frame by the number of the view."""
    outlines = {}
    for view, photo in enumerate(photos.frames[number]):
        try:
            mask = photo.mask()
        except EmptyMaskError as error:
            message = f"{error}. The fit goes on without it: view {photo.name}, frame {number}"
            warnings.warn(message, HumansimWarning, stacklevel=3)
            continue
        if mask is not None:
            outlines[view] = MaskOutline(mask)
    return outlines


def _points(
    human: Human, model: PoseModel, state: BodyState, photos: PhotoSet, edges: Mapping[int, Edges]
) -> EdgePoints:
    """Attach the points at the outlines to the bones, with the lines that these points should reach.
    ``human``: the human before proportions are applied. ``state``: the state in which the outlines were
    found. ``edges``: edges by the number of the view."""
    points = Attachments.of_vertices(human, np.concatenate([each.vertices for each in edges.values()]))
    views = np.repeat(list(edges), [len(each.vertices) for each in edges.values()])
    normals = np.concatenate([each.normals for each in edges.values()])
    offsets = np.concatenate([each.distances for each in edges.values()])
    positions = model.positions(state, points)
    noise = np.zeros(len(views))
    for view, each in edges.items():
        own = views == view
        noise[own] = max(_NOISE * each.size, LEAST_NOISE)
        offsets[own] += np.einsum("ni,ni->n", normals[own], photos.cameras[view].project(positions[own])[0])
    return EdgePoints(points, views, normals, offsets, noise)


def _sight(fit: PersonFit, photos: PhotoSet, model: PoseModel, number: int) -> Sight:
    """Correct keypoints of a frame, for the fit. Exchanged sides are exchanged back."""
    points = exchanged_back(photos.points[number], fit.swapped[number], photos.keypoints)
    weights = np.where(fit.outliers[number], 0.0, points[..., 2] * np.where(model.trust < 1, _SKIN, 1.0))
    nowhere = np.full((points.shape[1], 3), np.nan)
    return Sight(photos.cameras, points[..., :2], weights, nowhere)


def _noise(fit: PersonFit) -> float:
    """Standard deviation of a coordinate of the keypoints, pixels, from the distances, which have a Rayleigh
    distribution."""
    right = fit.residuals[np.isfinite(fit.residuals) & ~fit.outliers]
    return float(max(np.median(right) / np.sqrt(2 * np.log(2)), LEAST_NOISE)) if len(right) else LEAST_NOISE
