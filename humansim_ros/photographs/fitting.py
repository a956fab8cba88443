"""Fit a human to calibrated photographs of one or many frames: pose, place, stature and proportions."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from humansim_ros.errors import HumansimWarning, PhotographError, some_of
from humansim_ros.files.reading import built_in_names, find_asset
from humansim_ros.people.humans import Human
from humansim_ros.photographs.person_fit import (
    PersonFit,
    Proportions,
    can_be_shaped,
    fit_shape,
    shaped_human,
)
from humansim_ros.photographs.pose_fitting import (
    GIRTH_LIMIT,
    LEAST_NOISE,
    LENGTH_LIMIT,
    Settings,
    Sight,
    fields_of_states,
    first_state,
    fit_places,
    fit_poses,
    fitted_states,
    relative_size,
    unwound,
    with_possible_hinges,
)
from humansim_ros.photographs.pose_model import BodyState, PoseModel
from humansim_ros.photographs.silhouettes import fit_silhouettes
from humansim_ros.photographs.triangulation import Triangulation, noise_of, triangulate_photos
from humansim_ros.photographs.views import PhotoSet
from humansim_ros.types import Array

#: Most frames that determine the proportions.
SHAPE_FRAMES = 12
#: Most frames with silhouettes that determine the girths.
SILHOUETTE_FRAMES = 4
#: Weight of 2D points that no other view confirms.
_UNCONFIRMED = 0.3
#: Least and greatest stature of people, metres; and of the size of the points, relative to the human at the
#: start.
_STATURES, _SIZES = (0.5, 2.3), (0.3, 3.0)
#: There is a warning if the median distance between given and fitted points is above this share of the longer
#: image side.
_FAR = 0.03
#: Outlier: a point farther away than 6 standard deviations of the noise, and farther than 4 pixels.
_FARTHEST, _LEAST_FARTHEST = 6.0, 4.0

FitProgress = Callable[[str, int, int], None]


def fit_person(
    photos: PhotoSet,
    human: str | None = None,
    start: PersonFit | None = None,
    silhouettes: bool = True,
    progress: FitProgress = lambda step, done, count: None,
) -> PersonFit:
    """Fit a human to photographs of one person.

    Keypoints are triangulated, and wrong points are found by comparison with the other views. Then poses,
    stature and lengths of bones are fitted, so that distances in the photographs are least. Joints stay
    within their limits. All frames have the same proportions. Then the silhouettes of some frames determine
    the girths and refine the lengths. An SMPL model then gets the betas that make it most similar to this
    body, and is fitted again.

    Args:
        photos: Photographs with points.
        human: Name or file of the human to start from; if None, the human of ``start`` or of the views file.
        start: Fit of the same human to start from, such as the fit before some points were corrected.
        silhouettes: Use masks if the photographs have some.
        progress: Function that is called with the name of a step, the number of finished frames and the
            number of all frames.

    Raises:
        PhotographError: The photographs do not determine the person; the message says why.
    """
    name = _stored_name(human or (photos.human if start is None else start.human))
    found = triangulate_photos(photos)
    fit = _fit(photos, name, found, start, silhouettes, progress)
    if not fit.proportions.shape and can_be_shaped(name):
        shape = fit_shape(name, fit.body.mesh.vertices)
        begun = replace(fit, proportions=Proportions(shape=shape))
        fit = _fit(photos, name, found, begun, silhouettes, progress)
    for doubt in find_doubts(fit, photos, silhouettes):
        warnings.warn(f"{photos.path}: {doubt}", HumansimWarning, stacklevel=2)
    return fit


def find_doubts(fit: PersonFit, photos: PhotoSet, silhouettes: bool = True) -> list[str]:
    """Return sentences about what is guessed or implausible in a fit, and what the user can do.
    ``silhouettes``: whether the masks were used."""
    model = PoseModel(shaped_human(fit.human, fit.proportions), photos.keypoints)
    found = []
    masks = silhouettes and any(photo.mask_path is not None for frame in photos.frames for photo in frame)
    used = np.isfinite(fit.residuals) & ~fit.outliers
    turned, _ = model.shown(np.asarray(used.any(axis=(0, 1))))
    shown = dict(zip(model.skeleton.names, turned, strict=True))
    ends = {"head": ("vt3",), "legs": ("l_knee", "r_knee")}
    missing = [part for part, bones in ends.items() if not any(shown.get(bone, True) for bone in bones)]
    stature = float(np.ptp(fit.body.mesh.vertices[:, 1]))
    if missing and not masks:
        parts = " and the ".join(missing)
        found.append(
            f"the stature of {stature:.2f} m is a guess, because no point shows the {parts}: "
            "add such points, or masks"
        )
    if not _STATURES[0] < stature < _STATURES[1]:
        found.append(
            f"the person is {stature:.2f} m tall: check the unit of the calibration (key unit) and the points"
        )
    distance = float(np.median(fit.residuals[used])) if used.any() else 0.0
    if distance > _FAR * max(max(camera.size) for camera in photos.cameras):
        found.append(
            f"half of the points are {distance:.0f} pixels or more from the fitted body: check the points, "
            "and that calibration and photographs belong together"
        )
    for kind, factors, limit in (
        ("length", fit.proportions.lengths, LENGTH_LIMIT),
        ("girth", fit.proportions.girths, GIRTH_LIMIT),
    ):
        names = [f"{name} ({value:.2f})" for name, value in factors.items() if abs(np.log(value)) > limit]
        if names:
            found.append(
                f"the {kind} of {some_of(names, 4)} is at the limit for people, relative to {photos.human}: "
                "check points, masks and calibration, or start from a human that is more alike "
                "(key human of the views file)"
            )
    return found


def _fit(
    photos: PhotoSet,
    name: str,
    found: Sequence[Triangulation],
    start: PersonFit | None,
    silhouettes: bool,
    progress: FitProgress,
) -> PersonFit:
    """Fit a human to the triangulated points of all frames. The betas and offsets of ``start`` are kept."""
    base = Proportions() if start is None else start.proportions
    body = shaped_human(name, base)
    model = PoseModel(body, photos.keypoints, base)
    _check_size(photos, model, body, found)
    sights = [_sight(photos, model, each) for each in found]
    errors, inliers = (
        np.hstack(rows) for rows in zip(*((each.errors, each.inliers) for each in found), strict=True)
    )
    noise = max(noise_of(errors, inliers), LEAST_NOISE)
    states = _initial(model, found, start, progress)

    def result() -> PersonFit:
        return _result(photos, name, body, model, states, found, noise)

    shape_frames = _spread(np.array([(sight.weights > 0).sum() for sight in sights]), SHAPE_FRAMES)
    begun, seen = [states[number] for number in shape_frames], [sights[number] for number in shape_frames]
    chosen = fit_poses(model, begun, seen, Settings(noise))
    progress("shape", len(states), len(states))
    for number, state in zip(shape_frames, chosen, strict=True):
        states[number] = state
    shape = chosen[0]
    states = [replace(state, stature=shape.stature, lengths=shape.lengths) for state in states]
    refined: list[int] = []
    if silhouettes and any(photo.mask_path is not None for frame in photos.frames for photo in frame):
        refined = [shape_frames[row] for row in _spread(np.zeros(len(shape_frames)), SILHOUETTE_FRAMES)]
        fine = fit_silhouettes(result(), photos, refined)
        body = shaped_human(name, fine.proportions)
        model = PoseModel(body, photos.keypoints, fine.proportions)
        states = fitted_states(model, fine)
        progress("silhouettes", len(states), len(states))
    if len(states) > max(len(refined), 1):
        period = photos.period / 1e9 if len(states) > 2 else 0.0
        states = fit_poses(model, states, sights, Settings(noise, free_shape=False, period=period))
    progress("poses", len(states), len(states))
    return result()


def _check_size(photos: PhotoSet, model: PoseModel, body: Human, found: Sequence[Triangulation]) -> None:
    """Raise PhotographError if the triangulated points are much larger or smaller than a person."""
    sizes = np.array([relative_size(model, each.positions) for each in found])
    size = float(np.median(sizes[np.isfinite(sizes)])) if np.isfinite(sizes).any() else 1.0
    if not _SIZES[0] < size < _SIZES[1]:
        stature = size * float(np.ptp(body.mesh.vertices[:, 1]))
        raise PhotographError(
            f"the points are of a person of {stature:.3g} m: check the unit of the calibration (key unit), "
            "and the points",
            path=photos.path,
            key="unit",
        )


def _stored_name(human: str) -> str:
    """Name that a file of the fit stores: that of a built-in human, or the absolute path of a file."""
    return human if human in built_in_names("humans") else str(find_asset(human, "humans").absolute())


def _sight(photos: PhotoSet, model: PoseModel, found: Triangulation) -> Sight:
    """Points of a frame with their weights, for the fit."""
    points = found.points
    confirmed = np.isfinite(found.positions[:, 0])
    weights = points[..., 2] * model.trust * np.where(confirmed, found.inliers, _UNCONFIRMED)
    return Sight(photos.cameras, points[..., :2], weights, found.positions)


def _initial(
    model: PoseModel, found: Sequence[Triangulation], start: PersonFit | None, progress: FitProgress
) -> list[BodyState]:
    """Guess the states of all frames from the triangulated points, or take them from ``start``."""
    if start is not None and len(start.root) == len(found):
        return fitted_states(model, start)
    states, last = list[BodyState](), None
    for number, each in enumerate(found):
        state = first_state(model, each.positions)
        if last is not None:  # limbs move little between frames
            state = replace(state, vectors=last.vectors, stature=last.stature, lengths=last.lengths)
        if np.isfinite(each.positions[:, 0]).sum() >= 3:
            state = last = with_possible_hinges(model, unwound(fit_places(model, state, each.positions)))
        elif last is not None:
            state = last
        states.append(state)
        progress("first guess", number + 1, len(found))
    return states


def _spread(counts: Array, most: int) -> list[int]:
    """Choose at most ``most`` frames, spread over the sequence; return their numbers. Of frames close
    together, the one with most points is taken."""
    edges = np.linspace(0, len(counts), min(most, len(counts)) + 1).astype(int)
    return [int(low + np.argmax(counts[low:high])) for low, high in itertools.pairwise(edges)]


def _result(
    photos: PhotoSet,
    name: str,
    human: Human,
    model: PoseModel,
    states: Sequence[BodyState],
    found: Sequence[Triangulation],
    noise: float,
) -> PersonFit:
    """Create the result of the fit. ``human``: the human before its proportions are applied. ``noise``:
    standard deviation of the points, pixels."""
    posed = fields_of_states(model, human, states, photos.cameras, [each.points for each in found])
    residuals: Array = posed["residuals"]
    given = np.isfinite(residuals)
    if not given.any():
        raise PhotographError("no view has points: there is nothing to fit", path=photos.path, key="views")
    farthest = max(_FARTHEST * noise, _LEAST_FARTHEST)
    wrong = np.array([~each.inliers & np.isfinite(each.positions[:, 0]) for each in found])
    return PersonFit(
        human=name,
        bones=human.skeleton.names,
        period=photos.period,
        keypoints=photos.keypoints.name,
        views=photos.names,
        outliers=given & (wrong | (np.nan_to_num(residuals) > 5 * farthest)),
        swapped=np.array([each.swapped for each in found]),
        **posed,
    )
