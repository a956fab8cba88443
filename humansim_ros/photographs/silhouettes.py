"""Refine a fitted person by silhouettes: girths, lengths and poses that bring the outlines together."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from humansim_ros.errors import HumansimWarning
from humansim_ros.humans.human import Human
from humansim_ros.keypoints.sets import keypoint_set
from humansim_ros.photographs.body_shape import shaped_human
from humansim_ros.photographs.outlines import (
    Edges,
    MaskOutline,
    find_edges,
    intersection_over_union,
)
from humansim_ros.photographs.person_fit import PersonFit
from humansim_ros.photographs.pose_fitting import (
    LEAST_NOISE,
    EdgePoints,
    Settings,
    Sight,
    fit_poses,
    fitted_states,
    point_errors,
)
from humansim_ros.photographs.pose_model import Attachments, BodyState, PoseModel
from humansim_ros.photographs.proportions import with_proportions
from humansim_ros.photographs.views import EmptyMaskError, PhotoSet
from humansim_ros.render.make import make_renderer
from humansim_ros.render.renderer import Body
from humansim_ros.types import Array

#: Rounds of rendering and least squares.
_ROUNDS = 6
#: Least squares ends after this number of steps in each round: the outline moves with the body.
_STEPS = 4
#: Standard deviation of outlines, as a share of the side of a square of the area of the person: bodies and
#: clothes differ, and neighbouring points are off alike.
_NOISE = 0.022

Faces = NDArray[np.int32]


def fit_silhouettes(fit: PersonFit, photos: PhotoSet, frames: Sequence[int] = (0,)) -> PersonFit:
    """Refine the proportions of a person, and the poses of some frames, by the masks of these frames.

    The body is rendered, points of its outline are paired with the outline of the mask, and pose, lengths and
    girths follow by least squares of the distances between them, together with the keypoints; then again.

    Args:
        fit: Person fitted to the keypoints.
        photos: Photographs with masks. Those without are not used. A HumansimWarning names empty masks.
        frames: Numbers of frames. The other ones take over the proportions, and their poses remain.

    Returns:
        The refined person; the same one if there is no mask.

    Raises:
        PhotographError: A mask cannot be read, or has another size than the images of its camera.
    """
    outlines = {number: _outlines(photos, number) for number in frames}
    chosen = [number for number, own in outlines.items() if own]
    if not chosen:
        return fit
    human = shaped_human(fit.human, fit.proportions.shape)
    model = PoseModel(human, keypoint_set(fit.keypoints), fit.proportions.shape)
    all_states = fitted_states(model, fit)
    states = [all_states[number] for number in chosen]
    noise = _noise(fit)
    sights = [_sight(fit, photos, model, number) for number in chosen]
    renderer = make_renderer()
    try:
        for _ in range(_ROUNDS):
            body = with_proportions(human, model.proportions(states[0]))
            with_edges = []
            for number, state, sight in zip(chosen, states, sights, strict=True):
                posed = body.skeleton.pose(model.rotations(state), model.root(state, body.skeleton))
                vertices = body.pose(posed)
                # one mesh in all rounds: a renderer prepares its topology once
                surface = Body(human.mesh, vertices, human.triangle_parts, 1)
                found = {}
                for view, outline in outlines[number].items():
                    camera = photos.frames[number][view].camera
                    face = renderer.render([surface], camera, ["face"]).face
                    found[view] = find_edges(outline, camera, vertices, human.mesh, face)
                with_edges.append(replace(sight, edges=_points(human, model, state, photos, found)))
            states = fit_poses(model, states, with_edges, Settings(noise, steps=_STEPS))
    finally:
        renderer.close()
    for number, state in zip(chosen, states, strict=True):
        all_states[number] = state
    first = states[0]
    all_states = [
        replace(each, stature=first.stature, lengths=first.lengths, girths=first.girths)
        for each in all_states
    ]
    return _with_states(fit, photos, human, model, all_states)


def silhouette_iou(fit: PersonFit, photos: PhotoSet, frame: int = 0) -> dict[str, float]:
    """Intersection over union of the rendered and the given mask of each view that has one.

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
    """1 + number of the triangle of the body at each pixel of each view, (H, W); 0 where it is not."""
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
    """Points of the body at the outlines, and the lines that they should reach.

    Args:
        human: The human before it took proportions.
        model: Its model.
        state: Pose and proportions in which the outlines were found.
        photos: Photographs.
        edges: Edges by the number of the view.
    """
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
    """Keypoints of a frame: those that are right, with left and right as they should be."""
    points = _corrected(fit, photos, number)
    weights = np.where(fit.outliers[number], 0.0, points[..., 2] * model.trust)
    nowhere = np.full((points.shape[1], 3), np.nan)
    return Sight(photos.cameras, points[..., :2], weights, nowhere)


def _corrected(fit: PersonFit, photos: PhotoSet, number: int) -> Array:
    """Points (V, K, 3) of a frame, exchanged where left and right are."""
    mirrored = list(photos.keypoints.mirrored)
    points = photos.points[number]
    return np.where(fit.swapped[number][:, None, None], points[:, mirrored], points)


def _noise(fit: PersonFit) -> float:
    """Standard deviation of a coordinate of the keypoints: the median length is that of a Rayleigh one."""
    right = fit.residuals[np.isfinite(fit.residuals) & ~fit.outliers]
    return float(max(np.median(right) / np.sqrt(2 * np.log(2)), LEAST_NOISE)) if len(right) else LEAST_NOISE


def _with_states(
    fit: PersonFit, photos: PhotoSet, human: Human, model: PoseModel, states: Sequence[BodyState]
) -> PersonFit:
    """The fit with other states, and the residuals of its points there."""
    proportions = model.proportions(states[0])
    skeleton = with_proportions(human, proportions).skeleton
    residuals = [
        point_errors(model, state, photos.cameras, _corrected(fit, photos, number))
        for number, state in enumerate(states)
    ]
    return replace(
        fit,
        proportions=proportions,
        root=np.array([model.root(state, skeleton) for state in states]),
        rotations=np.array([model.rotations(state) for state in states]),
        residuals=np.array(residuals),
    )
