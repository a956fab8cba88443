"""The commands ``record``, ``export`` and ``evaluate`` as functions: ``from humansim_ros import record``."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

from humansim_ros.io.files import atomic_path


@dataclass(frozen=True)
class Comparison:
    """Result of :func:`evaluate`; ``print`` shows the table that ``humansim evaluate`` prints.

    Attributes:
        data: All metrics with the keys of docs/evaluation.md; metres, seconds, and shares from 0 to 1.
        table: The table.
        page: Makes the HTML page.
    """

    data: dict[str, Any]
    table: str
    page: Callable[[], str]

    def __str__(self) -> str:
        return self.table

    def write_report(self, path: str | os.PathLike[str]) -> None:
        """Write tables, plots and the worst frames to an HTML file."""
        text = self.page()
        with atomic_path(Path(path)) as temporary:
            temporary.write_text(text, encoding="utf-8")


def evaluate(
    truth: str | os.PathLike[str],
    estimate: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    *,
    keypoints: str | None = None,
    names: str | os.PathLike[str] | None = None,
    scale: float = 1.0,
    axes: str | None = None,
    offset: float | Literal["auto"] = 0.0,
    gate: float | None = None,
    min_score: float | None = None,
) -> Comparison:
    """Compare estimated 3D poses of people, or detections in images, with the truth.

    Args:
        truth: Scene file, bag with the topics ``/humans/<id>/joints``, or folder of an export.
        estimate: File or folder of poses or detections, or ``BAG:TOPIC``; or several of them.
        keypoints: Keypoint set of the estimate, such as ``coco17``; None: as its names say.
        names: YAML file: name of a joint in the truth by name in the estimate.
        scale: Metres of a unit of the estimate.
        axes: Axes of the estimate, such as ``y-up``; None: the axes of ``map``.
        offset: Seconds by which the stamps of the estimate are late, or ``"auto"`` to measure them.
        gate: Greatest mean joint distance of a person who is found, metres; None: 0.5.
        min_score: Detections in images with a lower score count for average precision only.

    Raises:
        HumansimError: A file cannot be read, or truth and estimate cannot be compared.

    Example:
        >>> result = evaluate("scene.yaml", "poses.csv", offset="auto")  # doctest: +SKIP
        >>> result.data["position"]["mpjpe"]  # doctest: +SKIP
        0.031
        >>> result.write_report("report.html")  # doctest: +SKIP
    """
    several = [estimate] if isinstance(estimate, (str, os.PathLike)) else estimate
    compared: Comparison = _work().compare(
        Path(truth),
        [os.fspath(each) for each in several],
        keypoints,
        names,
        scale,
        axes,
        offset,
        gate,
        min_score,
    )
    return compared


def _work() -> Any:
    # not by an import statement: type checkers would put all modules into one circle
    return import_module("humansim_ros.apps.work")
