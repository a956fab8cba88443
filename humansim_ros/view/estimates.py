"""A tracker's estimate beside the truth of the same frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from humansim_ros.errors import EvaluationError, printable
from humansim_ros.evaluate.alignment import axes_matrix, match_people, pair_distances
from humansim_ros.evaluate.joint_names import pair_joints
from humansim_ros.evaluate.live import LiveOptions
from humansim_ros.messages.people import Pose, PoseFrame
from humansim_ros.types import Array

_WORLD = "map"
#: Most people of an estimate that are shown.
_MOST = 64

#: Names and positions (K, 3) of a person of the truth.
TruePoints = tuple[Sequence[str], Array]


def people_of(frame: PoseFrame, person: str | None, options: LiveOptions) -> list[Pose]:
    """People of a message, in ``map`` and metres.

    Args:
        frame: The message.
        person: Name of the person that its topic has; None if it has none.
        options: Scale and axes of the estimate.

    Raises:
        EvaluationError: The positions are in another frame.
    """
    if frame.frame_id not in ("", _WORLD):
        raise EvaluationError(f"frame_id is {printable(frame.frame_id, 80)!r}: publish positions in {_WORLD}")
    matrix = options.scale * axes_matrix(options.axes or "z-up")
    return [
        pose._replace(person=person or pose.person, positions=pose.positions @ matrix.T)
        for pose in frame.people[:_MOST]
    ]


def beside_truth(
    estimate: Sequence[Pose], truth: Mapping[str, TruePoints], options: LiveOptions
) -> tuple[dict[str, Array], dict[str, float]]:
    """People of an estimate under the names of the people of the truth whom they are nearest to.

    People of nobody keep their name after ``?``.

    Args:
        estimate: People of the estimate.
        truth: People of the truth by name.
        options: Names of joints, and greatest distance of a person who is found.

    Returns:
        Points (K, 3) by name, and mean distance from the common joints of the truth by name, millimetres.

    Raises:
        EvaluationError: No joint is common.
    """
    estimate = [pose for pose in estimate if np.isfinite(pose.positions).any()]
    names = list(truth)
    distances = np.full((len(names), len(estimate)), np.inf)
    for row, name in enumerate(names):
        known, positions = truth[name]
        for column, pose in enumerate(estimate):
            pairs = np.array(pair_joints(known, pose.names, options.table))
            found = pair_distances([positions[pairs[:, 0]]], [pose.positions[pairs[:, 1]]])
            distances[row, column] = found[0, 0]
    matched = {column: row for row, column in match_people(distances, options.gate)} if distances.size else {}
    points: dict[str, Array] = {}
    errors: dict[str, float] = {}
    for column, pose in enumerate(estimate):
        if column in matched:
            name = names[matched[column]]
            errors[name] = 1000.0 * float(distances[matched[column], column])
        else:
            name = f"?{printable(pose.person or str(column + 1), 80)}"
        points[name] = pose.positions
    return points, errors
