"""Files of fits (.yaml): proportions, and the pose of each frame."""

from __future__ import annotations

import os
from typing import Annotated, Any

import numpy as np
import yaml
from pydantic import Field

from humansim_ros.errors import MAX_COORDINATE, PhotographError, located
from humansim_ros.files.reading import atomic_path
from humansim_ros.files.yaml import Section, read_yaml, validated
from humansim_ros.geometry import matrix_to_quaternion, quaternion_to_matrix, transform, unit_quaternions
from humansim_ros.people.keypoints import keypoint_set
from humansim_ros.photographs.person_fit import (
    GREATEST_OFFSET,
    LARGEST,
    MOST_CONTROLS,
    SMALLEST,
    PersonFit,
    Proportions,
)
from humansim_ros.photographs.views import MAX_FRAMES

_HEADER = "# Fit of `humansim human fit`; docs/from_photographs.md describes the keys.\n"
_Number = Annotated[float, Field(ge=-MAX_COORDINATE, le=MAX_COORDINATE)]
_Factor = Annotated[float, Field(ge=SMALLEST, le=LARGEST)]
_Offset = Annotated[float, Field(ge=-GREATEST_OFFSET, le=GREATEST_OFFSET)]
_Quaternion = tuple[_Number, _Number, _Number, _Number]


class _ProportionsSection(Section):
    """Section ``proportions``."""

    stature: _Factor = 1.0
    lengths: dict[str, _Factor] = Field(default_factory=dict)
    girths: dict[str, _Factor] = Field(default_factory=dict)
    shape: tuple[_Number, ...] = Field((), max_length=400)
    offsets: tuple[_Offset, ...] = Field((), max_length=MOST_CONTROLS)


class _FrameSection(Section):
    """One frame: place and rotation of the body, rotations of bones, errors of points by view."""

    position: tuple[_Number, _Number, _Number]
    rotation: _Quaternion
    bones: dict[str, _Quaternion] = Field(default_factory=dict)
    residuals: dict[str, dict[str, _Number]] = Field(default_factory=dict)
    outliers: dict[str, dict[str, _Number]] = Field(default_factory=dict)
    swapped: tuple[str, ...] = ()


class _FitSection(Section):
    """Content of a file."""

    human: str = Field(min_length=1)
    keypoints: str = "coco17"
    period: Annotated[float, Field(gt=0, le=3600)] = 0.04
    views: tuple[str, ...] = ()
    bones: tuple[str, ...] = Field(min_length=1, max_length=255)
    proportions: _ProportionsSection = _ProportionsSection()
    frames: tuple[_FrameSection, ...] = Field(min_length=1, max_length=MAX_FRAMES)


def write_fit(path: str | os.PathLike[str], fit: PersonFit) -> None:
    """Write a fit atomically. Lengths are metres and pixels, rotations quaternions xyzw."""
    names = keypoint_set(fit.keypoints).names
    shape = fit.proportions
    content: dict[str, Any] = {
        "human": fit.human,
        "keypoints": fit.keypoints,
        "period": fit.period / 1e9,
        "views": list(fit.views),
        "bones": list(fit.bones),
        "proportions": {
            "stature": round(float(shape.stature), 6),
            "lengths": {name: round(float(value), 6) for name, value in shape.lengths.items()},
            "girths": {name: round(float(value), 6) for name, value in shape.girths.items()},
            "shape": list(shape.shape),
            "offsets": list(shape.offsets),
        },
        "frames": [_frame(fit, number, names) for number in range(len(fit.root))],
    }
    with atomic_path(path) as part, part.open("w", encoding="utf-8") as file:
        file.write(_HEADER)
        yaml.safe_dump(content, file, sort_keys=False, default_flow_style=None, width=110, allow_unicode=True)


def _frame(fit: PersonFit, number: int, names: tuple[str, ...]) -> dict[str, Any]:
    root = fit.root[number]
    frame: dict[str, Any] = {
        "position": np.round(root[:3, 3], 6).tolist(),
        "rotation": np.round(matrix_to_quaternion(root[:3, :3]), 7).tolist(),
        "bones": {
            bone: np.round(rotation, 7).tolist()
            for bone, rotation in zip(fit.bones, fit.rotations[number], strict=True)
            if abs(rotation[3]) < 1
        },
    }
    for key, chosen in (("residuals", ~fit.outliers[number]), ("outliers", fit.outliers[number])):
        by_view = {
            view: {
                name: round(float(value), 3)
                for name, value, used in zip(names, fit.residuals[number, row], chosen[row], strict=True)
                if used and np.isfinite(value)
            }
            for row, view in enumerate(fit.views)
        }
        frame[key] = {view: values for view, values in by_view.items() if values}
    frame["swapped"] = [view for view, swapped in zip(fit.views, fit.swapped[number], strict=True) if swapped]
    return frame


def read_fit(path: str | os.PathLike[str]) -> PersonFit:
    """Read a fit.

    Raises:
        PhotographError: The file is wrong; the message has line and key.
    """
    data, tree = read_yaml(path, PhotographError, "fit")
    if not isinstance(data, dict):
        raise PhotographError("a fit is a mapping with the keys human, bones and frames", path=path)
    section = validated(_FitSection, data, PhotographError, path, tree)
    with located(PhotographError, path, key="keypoints"):
        keypoints = keypoint_set(section.keypoints)
    if len(set(section.bones)) < len(section.bones):
        raise PhotographError("a bone is repeated", path=path, key="bones")
    frames, views, points = section.frames, section.views, keypoints.names
    shape = len(frames), len(views), len(points)
    root = np.tile(np.eye(4), (len(frames), 1, 1))
    rotations = np.tile([0.0, 0.0, 0.0, 1.0], (len(frames), len(section.bones), 1))
    residuals, outliers = np.full(shape, np.nan), np.zeros(shape, bool)
    swapped = np.zeros(shape[:2], bool)

    def place(known: tuple[str, ...], name: str, key: str) -> int:
        if name not in known:
            raise PhotographError(f"{name!r} is not one of {', '.join(known)}", path=path, key=key)
        return known.index(name)

    def quaternion(value: _Quaternion, key: str) -> Any:
        if not 0.99 < np.linalg.norm(value) < 1.01:
            raise PhotographError("a rotation is a quaternion x, y, z, w of length 1", path=path, key=key)
        return unit_quaternions(np.array(value))

    for number, frame in enumerate(frames):
        key = f"frames.{number}"
        turn = quaternion(frame.rotation, f"{key}.rotation")
        root[number] = transform(quaternion_to_matrix(turn), np.array(frame.position))
        for bone, value in frame.bones.items():
            row = place(section.bones, bone, f"{key}.bones")
            rotations[number, row] = quaternion(value, f"{key}.bones.{bone}")
        for part, errors in (("residuals", frame.residuals), ("outliers", frame.outliers)):
            for view, values in errors.items():
                row = place(views, view, f"{key}.{part}")
                for name, error in values.items():
                    column = place(points, name, f"{key}.{part}.{view}")
                    residuals[number, row, column] = error
                    outliers[number, row, column] = part == "outliers"
        for view in frame.swapped:
            swapped[number, place(views, view, f"{key}.swapped")] = True
    own = section.proportions
    return PersonFit(
        section.human,
        Proportions(own.stature, own.lengths, own.girths, own.shape, own.offsets),
        section.bones,
        root,
        rotations,
        round(section.period * 1e9),
        section.keypoints,
        views,
        residuals,
        outliers,
        swapped,
    )
