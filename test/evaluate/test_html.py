"""The HTML report: complete, self-contained, well-formed, and right in what it draws."""

from __future__ import annotations

import re
from dataclasses import replace
from html.parser import HTMLParser
from xml.etree import ElementTree

import numpy as np
import pytest
from evaluate_support import NAMES, changed, walking
from numpy.typing import NDArray

from humansim_ros.cameras import Camera
from humansim_ros.data.evaluation.evaluation import evaluate_poses
from humansim_ros.data.evaluation.html import _ticks, bar_plot, html_report, line_plot, pose_plot
from humansim_ros.data.evaluation.pictures import ESTIMATE_COLOR, TRUTH_COLOR, Shape, draw_over
from humansim_ros.errors import HumansimWarning
from humansim_ros.types import Array


class Grey:
    """A grey image of the camera ``front``, and one of ``away``, which sees nobody."""

    def cameras(self, stamp: int) -> dict[str, Camera]:
        return {
            "away": Camera.look_at((50, 0, 1), (60, 0, 1)),
            "front": Camera.look_at((8, 1, 1.5), (0, 1, 1)),
        }

    def image(self, stamp: int, camera: str) -> NDArray[np.uint8]:
        assert camera == "front"
        return np.full((480, 640, 3), 100, np.uint8)

    def close(self) -> None:
        pass


class Balanced(HTMLParser):
    """Fails at a tag that is closed in the wrong order."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attrs: object) -> None:
        if tag not in ("meta", "br", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_startendtag(self, tag: str, attrs: object) -> None:
        pass


def damaged(frame: int, person: str, joints: Array) -> Array | None:
    return None if frame == 7 and person == "bert" else joints + np.array([0.001 * frame, 0, 0])


def test_the_report_is_one_page_with_everything() -> None:
    page = html_report(evaluate_poses(walking(), changed(walking(), damaged)))
    parser = Balanced()
    parser.feed(page)
    assert parser.open == []
    assert not re.findall(r"(?:src|href)=|url\(|@import|<script", page)
    assert page.count("<svg") == 5 + 10
    for text in ("MPJPE", "IDF1", "anna", "l_knee", "49 of 50", "at 1.960 s: 49.0 mm"):
        assert text in page
    for svg in re.findall(r"<svg.*?</svg>", page):
        ElementTree.fromstring(svg)


def test_the_worst_poses_are_drawn_over_images() -> None:
    truth = walking()
    page = html_report(evaluate_poses(truth, changed(truth, damaged)), Grey())
    parser = Balanced()
    parser.feed(page)
    assert parser.open == [] and page.count("<img ") == page.count("<p>front</p>") == 10
    assert not re.findall(r'(?:src|href)="(?!data:image/jpeg;base64,)|url\(|@import|<script', page)
    assert len(page) < 1 << 20
    without = html_report(evaluate_poses(truth, changed(truth, damaged)))
    assert "<img " not in without


def test_a_point_is_drawn_where_it_is() -> None:
    image = np.zeros((100, 200, 3), np.uint8)
    truth, estimate = np.array([[60.0, 40], [60, 60], [np.nan, np.nan]]), np.array([[80.0, 40], [80, 60]])
    box = Shape((9, 200, 9), np.zeros((0, 2)), box=np.array([50.5, 30.5, 40, 40]))
    drawn = draw_over(
        image, [Shape(TRUTH_COLOR, truth, [(0, 1), (1, 2)]), Shape(ESTIMATE_COLOR, estimate), box]
    )
    # the section is 14 pixels (35 % of 40) around x = 50 to 90 and y = 30 to 70: 36 to 104, 16 to 84
    assert drawn.shape == (480, 480, 3)
    scale = 480 / 69
    for (x, y), color in (
        ((60, 40), TRUTH_COLOR),
        ((60, 50), TRUTH_COLOR),
        ((80, 60), ESTIMATE_COLOR),
        ((80, 50), (0, 0, 0)),
        ((50, 45), (9, 200, 9)),
    ):
        pixel = drawn[round((y - 16 + 0.5) * scale - 0.5), round((x - 36 + 0.5) * scale - 0.5)]
        assert pixel.tolist() == list(color), (x, y)


def test_masks_are_drawn_as_outlines_and_grey_images_in_colours() -> None:
    mask = np.zeros((100, 200), bool)
    mask[20:60, 100:140] = True
    drawn = draw_over(np.zeros((100, 200), np.uint8), [Shape(TRUTH_COLOR, np.zeros((0, 2)), mask=mask)])
    colored = (drawn == np.array(TRUTH_COLOR)).all(axis=2)
    rows, columns = np.nonzero(colored)
    assert 0.01 < colored.mean() < 0.1
    inner = drawn[(rows.min() + rows.max()) // 2, (columns.min() + columns.max()) // 2]
    assert inner.tolist() == [0, 0, 0]


def test_nothing_in_the_image_shows_the_whole_image() -> None:
    drawn = draw_over(np.zeros((100, 200, 3), np.uint8), [Shape(TRUTH_COLOR, np.array([[500.0, 40]]))])
    assert drawn.shape == (240, 480, 3)


def test_names_cannot_be_code() -> None:
    evil = "<script>alert(1)</script>"
    truth = changed(walking(), lambda frame, person, joints: joints)
    people = [{evil: each["anna"]} for each in truth.people]
    page = html_report(evaluate_poses(replace(truth, people=people), walking()))
    assert "<script" not in page and "&lt;script&gt;" in page


def test_a_report_without_matches() -> None:
    away = changed(walking(), lambda frame, person, joints: joints + np.array([50, 80, 0]))
    with pytest.warns(HumansimWarning, match="no person"):
        page = html_report(evaluate_poses(walking(), away))
    assert "No data." in page and "0 of 50" in page


def test_a_line_is_at_its_values_and_breaks_at_gaps() -> None:
    x = np.array([0.0, 1, 2, 3, 4])
    svg = ElementTree.fromstring(line_plot({"a": (x, np.array([0, 10, np.nan, 5, 10.0]))}, "x", "y"))
    lines = [line.get("points", "") for line in svg.iter() if line.tag.endswith("polyline")]
    assert lines == ["56.0,206.0 199.0,14.0", "485.0,110.0 628.0,14.0"]
    assert line_plot({"a": (x, np.full(5, np.nan))}, "x", "y") == ""


def test_bars_are_as_long_as_their_values() -> None:
    svg = ElementTree.fromstring(bar_plot({"a": 10.0, "b": 5.0, "c": None}, "mm"))
    assert [float(bar.get("width", "")) for bar in svg.iter() if bar.tag.endswith("rect")] == [390, 195, 0]


def test_a_drawn_pose_leaves_out_absent_joints() -> None:
    pose = walking(1).people[0]["anna"].copy()
    other = pose.copy()
    other[0] = np.nan
    svg = ElementTree.fromstring(pose_plot(pose, other, [(0, 2), (2, 4)]))
    tags = [each.tag.rpartition("}")[2] for each in svg.iter()]
    assert tags.count("circle") == 2 * (2 * len(NAMES) - 1) and tags.count("line") == 2 * 3


@pytest.mark.parametrize(
    ("span", "ticks"),
    [
        ((0, 18.4), [0, 5, 10, 15]),
        ((0, 2.967), [0, 1, 2]),
        ((-0.2, 0.31), [-0.2, 0, 0.2]),
        ((0, 0.3), [0, 0.1, 0.2, 0.3]),
        ((3, 3), [3]),
    ],
)
def test_axes_have_round_numbers(span: tuple[float, float], ticks: list[float]) -> None:
    assert [str(tick) for tick in _ticks(*map(float, span))] == [str(float(tick)) for tick in ticks]
