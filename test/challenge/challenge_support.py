"""Support of the tests of the challenge: a small suite, and reports with made results."""

from __future__ import annotations

from pathlib import Path

from humansim_ros.ros.challenge.results import CaseResult, Report
from humansim_ros.ros.challenge.suite import Suite, load_suite

SUITE = """
name: small
version: "1"
frames: 4
breaks_below: 0.7
quick: {frames: 2, strengths: [3]}
scene:
  rate: 20
  room: null
  humans: {anna: {body: adult_woman, motion: wave}}
  cameras: {left: {size: [64, 48], position: [3, 2, 2], look_at: [0, 0, 1]}}
axes:
  size:
    title: Small images
    group: Image
    patience: 0.5
    strengths:
      - {label: half, scene: {cameras: {"*": {size: [32, 24]}}}}
      - {label: quarter, scene: {cameras: {"*": {size: [16, 12]}}}}
      - {label: tiny, scene: {cameras: {"*": {size: [8, 6]}}}}
"""


def small_suite(folder: Path, text: str = SUITE) -> Suite:
    path = folder / "suite.yaml"
    path.write_text(text)
    return load_suite(path)


def made_report(suite: Suite, tracker: str = "my tracker", failure: str = "") -> Report:
    """Report whose scores fall from 90 by 20 for each strength."""
    report = Report.of_suite(suite, tracker, {"is_quick": False})
    for case in suite.cases:
        pck = 0.9 - 0.2 * case.strength
        report.results[case.name] = CaseResult(
            case.axis,
            case.strength,
            case.label,
            failure=failure if case.strength == 3 else "",
            frames=4,
            estimates=4,
            mpjpe=0.012,
            pck=pck,
            recall=1.0,
            precision=1.0,
            idf1=0.95,
            switches=0,
        )
    return report
