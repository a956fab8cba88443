"""HOTA, MOTA and IDF1 beside TrackEval, whose results are in test/data/trackeval.json."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

import numpy as np
import pytest
from conftest import TESTS

from humansim_ros.data.evaluation.tracking import TrackedFrame, similarity, tracking_scores

CASES = json.loads((TESTS / "data" / "trackeval.json").read_text())["cases"]


def tracked(frames: list[dict[str, Any]]) -> list[TrackedFrame]:
    tables: dict[str, dict[int, int]] = {"truth": {}, "estimate": {}}

    def numbers(frame: dict[str, Any], kind: str) -> Any:
        table = tables[kind]
        return np.array([table.setdefault(each, len(table)) for each in frame[kind]], np.intp)

    return [
        TrackedFrame(
            truth := numbers(frame, "truth"),
            estimate := numbers(frame, "estimate"),
            np.array(frame["similarity"], float).reshape(len(truth), len(estimate)),
        )
        for frame in frames
    ]


@pytest.mark.parametrize("case", CASES)
def test_scores_are_those_of_trackeval(case: dict[str, Any]) -> None:
    scores = asdict(tracking_scores(tracked(case["frames"])))
    assert case["scores"]["switches"] > 0 and case["scores"]["fragments"] > 0
    assert scores == pytest.approx(case["scores"], abs=1e-12)


def test_similarity_is_one_half_at_the_gate() -> None:
    np.testing.assert_allclose(similarity(np.array([0.0, 0.25, 0.5, 1.0, np.inf]), 0.5), [1, 0.75, 0.5, 0, 0])
