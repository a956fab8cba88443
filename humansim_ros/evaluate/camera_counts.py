"""Errors by the number of cameras that have a joint in their image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from humansim_ros.evaluate.evaluation import CameraCountScore, Evaluation
from humansim_ros.evaluate.metrics import mean_error
from humansim_ros.evaluate.truth import FIRST_STAMP
from humansim_ros.scene.scene import Scene
from humansim_ros.types import Array, Indices


def with_camera_counts(evaluation: Evaluation, scene: Scene) -> Evaluation:
    """The result with errors by the number of cameras of its scene whose image a joint is in.

    Nothing is rendered: a joint that is hidden by something counts as one in the image.
    """
    counts = camera_counts(scene, evaluation.matches.stamp, evaluation.matches.truth)
    known = np.isfinite(evaluation.errors)
    scores = {
        str(count): CameraCountScore(len(own), mean_error(own))
        for count in np.unique(counts[known]).tolist()
        if len(own := evaluation.errors[known & (counts == count)])
    }
    return replace(evaluation, by_cameras=scores)


def camera_counts(scene: Scene, stamps: Indices, joints: Array) -> Indices:
    """Number of cameras (M, C) whose image each joint is in.

    ``stamps``: (M,) nanoseconds. ``joints``: (M, C, 3) in ``map``, metres; NaN is in no image.
    """
    counts = np.zeros(joints.shape[:2], np.intp)
    for camera in scene.scene_cameras.values():
        blocks = [(camera.camera, np.arange(len(stamps)))]
        if camera.moves:
            blocks = [
                (camera.camera_at(camera.pose((stamp - FIRST_STAMP) * 1e-9)), np.flatnonzero(stamps == stamp))
                for stamp in np.unique(stamps).tolist()
            ]
        for placed, rows in blocks:
            pixels = placed.project(joints[rows].reshape(-1, 3))[0]
            counts[rows] += _inside(pixels, placed.size).reshape(len(rows), -1)
    return counts


def _inside(pixels: Array, size: tuple[int, int]) -> Indices:
    """1 for pixels (..., 2) in an image of some width and height, 0 for others and NaN."""
    inside = ((pixels >= -0.5) & (pixels < np.array(size) - 0.5)).all(axis=-1)
    return np.asarray(inside, np.intp)
