"""Results of the cases of a challenge: read and write them, compute scores, and find the strength of a
difficulty that breaks a tracker."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from humansim_ros.errors import ChallengeError
from humansim_ros.files.reading import read_json, write_file
from humansim_ros.ros.challenge.suite import BASELINE, STRENGTHS, Suite

#: Version of the keys of ``results.json``.
JSON_VERSION = 1
#: Name of the file in a report folder that has all results.
RESULTS = "results.json"
#: Largest file of results, bytes.
_MAX_BYTES = 16 << 20


@dataclass(frozen=True)
class CaseResult:
    """Result of one case. Lengths are metres, shares 0 to 1. A value that cannot be measured is None.

    Attributes:
        axis: Name of the difficulty. ``baseline`` for no difficulty.
        strength: 1 to 3. 0 for the baseline.
        label: Text that describes the strength.
        failure: Why the case failed, for example since the tracker ended. Empty if it did not fail.
        frames: Number of frames that were sent.
        estimates: Number of frames with an estimate.
        mpjpe: Mean joint error of people who were found.
        pck: Share of joints within 150 mm. Joints of missed people count as wrong.
        recall: Share of people who were found.
        precision: Share of estimated people who are real.
        idf1: Score of identities. None if the tracker has no identities.
        switches: Number of changes of identity. None if the tracker has no identities.
        seconds: Wall-clock time in which the frames were sent.
        latency: Median time from the start of a frame to its estimate, seconds.
        sees: Whether any node subscribed to images. None if unknown.
    """

    axis: str
    strength: int
    label: str
    failure: str = ""
    frames: int = 0
    estimates: int = 0
    mpjpe: float | None = None
    pck: float | None = None
    recall: float | None = None
    precision: float | None = None
    idf1: float | None = None
    switches: int | None = None
    seconds: float = 0.0
    latency: float | None = None
    sees: bool | None = None

    @property
    def name(self) -> str:
        """Name of the case."""
        return f"{self.axis}_{self.strength}" if self.strength else self.axis

    @property
    def score(self) -> float:
        """Score from 0 to 100: share of correct joints (PCK) times share of real people among the estimated
        ones, as a percentage."""
        return 100.0 * (self.pck or 0.0) * (1.0 if self.precision is None else self.precision)


@dataclass(frozen=True)
class AxisInfo:
    """A difficulty (axis) in a report: title, group, and label of each strength."""

    title: str
    group: str
    labels: Sequence[str]


@dataclass
class Report:
    """All results of a tracker.

    Attributes:
        tracker: Command line of the tracker.
        suite: Name and version of the suite.
        settings: Everything else that the results depend on.
        breaks_below: Share of the baseline's score below which the tracker is broken.
        axes: The difficulties by name.
        results: Results by name of the case.
    """

    tracker: str
    suite: str
    settings: Mapping[str, Any]
    breaks_below: float
    axes: Mapping[str, AxisInfo]
    results: dict[str, CaseResult] = field(default_factory=dict)

    @classmethod
    def of_suite(cls, suite: Suite, tracker: str, settings: Mapping[str, Any]) -> Report:
        """New report of a suite, without results."""
        axes = {
            name: AxisInfo(axis.title, axis.group, [each.label for each in axis.strengths])
            for name, axis in suite.axes.items()
        }
        return cls(tracker, f"{suite.name} {suite.version}", settings, suite.breaks_below, axes)

    @property
    def key(self) -> Mapping[str, Any]:
        """Everything that the results depend on."""
        return {"tracker": self.tracker, "suite": self.suite, **self.settings}

    @property
    def baseline(self) -> CaseResult | None:
        """Result of the case without a difficulty."""
        return self.results.get(BASELINE)

    @property
    def is_blind(self) -> bool:
        """Whether it is known that no node subscribed to images in any case."""
        known = [each.sees for each in self.results.values() if each.sees is not None]
        return bool(known) and not any(known)

    def of_axis(self, axis: str) -> list[CaseResult]:
        """Results of an axis, the weakest strength first."""
        found = (self.results.get(f"{axis}_{strength}") for strength in range(1, STRENGTHS + 1))
        return [each for each in found if each is not None]

    def is_broken(self, result: CaseResult) -> bool:
        """Whether a case broke the tracker: it failed, or has too low a score or IDF1 next to the
        baseline."""
        base = self.baseline
        if result.failure or base is None:
            return bool(result.failure)
        if result.score < self.breaks_below * base.score:
            return True
        return base.idf1 is not None and (result.idf1 or 0.0) < self.breaks_below * base.idf1

    def breaks_at(self, axis: str) -> CaseResult | None:
        """Result of the weakest strength of an axis that breaks the tracker; None if no strength does."""
        return next((each for each in self.of_axis(axis) if self.is_broken(each)), None)

    @property
    def points(self) -> float | None:
        """Robustness from 0 to 100: mean score of all cases with a difficulty. A broken case counts as 0."""
        cases = [each for each in self.results.values() if each.strength]
        scores = [0.0 if self.is_broken(each) else each.score for each in cases]
        return sum(scores) / len(scores) if scores else None

    def write(self, folder: Path) -> None:
        """Write ``results.json`` atomically.

        Raises:
            HumansimError: The file cannot be written, for example on a full disk.
        """
        data = {"version": JSON_VERSION, **asdict(self), "points": self.points}
        write_file(folder / RESULTS, json.dumps(data, indent=1, allow_nan=False) + "\n")

    @classmethod
    def read(cls, folder: Path) -> Report:
        """Read the results of a folder, or of a ``results.json``.

        Raises:
            ChallengeError: There are no results, or they are damaged.
        """
        path = folder / RESULTS if folder.is_dir() else folder
        try:
            data = read_json(path, ChallengeError, "results", _MAX_BYTES)
            if data["version"] != JSON_VERSION:
                raise ChallengeError(f"version {data['version']} of results is not known", path=path)
            return TypeAdapter(cls).validate_python(data)
        except (ValueError, LookupError, TypeError, AttributeError, RecursionError):
            raise ChallengeError(
                "these are no results of a challenge, or they are damaged", path=path
            ) from None
