"""Scores, where an axis breaks, the table, the picture, and the files of a report."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import pytest
from challenge_support import made_report, small_suite

from humansim_ros.errors import ChallengeError, HumansimError
from humansim_ros.ros.challenge.report import (
    PAGE,
    PICTURE,
    color_of,
    html_page,
    picture,
    show_table,
    write_pages,
)
from humansim_ros.ros.challenge.results import RESULTS, CaseResult, Report

_SVG = "{http://www.w3.org/2000/svg}"


def test_the_score_counts_missed_and_invented_people() -> None:
    assert CaseResult("a", 1, "", pck=0.8, precision=0.5).score == pytest.approx(40)
    assert CaseResult("a", 1, "", pck=0.8).score == pytest.approx(80)
    assert CaseResult("a", 1, "", failure="the tracker died").score == 0


def test_an_axis_breaks_at_the_first_strength_below_the_limit(tmp_path: Path) -> None:
    report = made_report(small_suite(tmp_path))  # 90, then 70, 50, 30; the limit is 63
    broken = report.breaks_at("size")
    assert broken is not None and broken.label == "quarter"
    assert report.points == pytest.approx(70 / 3)


def test_lost_identities_and_failures_break_a_tracker_too(tmp_path: Path) -> None:
    report = made_report(small_suite(tmp_path))
    good = report.results["size_1"]
    assert not report.is_broken(good)
    assert report.is_broken(replace(good, idf1=0.6))
    assert report.is_broken(replace(good, failure="the tracker died"))


def test_results_are_read_back_as_they_were_written(tmp_path: Path) -> None:
    report = made_report(small_suite(tmp_path))
    report.write(tmp_path)
    again = Report.read(tmp_path)
    assert again.results == report.results
    assert (again.tracker, again.suite, again.points) == (report.tracker, report.suite, report.points)


@pytest.mark.parametrize(
    "text",
    ["", "{", "[]", "{}", '{"version": 1}', '{"version": 99}', "[" * 100_000, '{"version": 1, "results": 3}'],
)
def test_damaged_results_are_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / RESULTS).write_text(text)
    with pytest.raises(ChallengeError, match=RESULTS):
        Report.read(tmp_path)


def test_a_number_of_another_type_in_results_is_refused(tmp_path: Path) -> None:
    made_report(small_suite(tmp_path)).write(tmp_path)
    data = json.loads((tmp_path / RESULTS).read_text())
    data["results"]["size_1"]["pck"] = "much"
    (tmp_path / RESULTS).write_text(json.dumps(data))
    with pytest.raises(ChallengeError, match="damaged"):
        Report.read(tmp_path)


def test_the_table_shows_scores_the_break_and_failures(tmp_path: Path) -> None:
    lines = show_table(made_report(small_suite(tmp_path), failure="the tracker died")).splitlines()
    row = next(line for line in lines if line.startswith("Small images"))
    assert row.split() == ["Small", "images", "70", "50*", "30*", "12", "mm", "100%", "95%", "quarter"]
    assert "size_3: the tracker died" in lines


def test_two_trackers_stand_side_by_side(tmp_path: Path) -> None:
    suite = small_suite(tmp_path)
    one, two = made_report(suite, "one"), made_report(suite, "two", "the tracker hangs")
    two.results["size_1"] = replace(two.results["size_1"], pck=0.1)
    row = next(line for line in show_table(one, two).splitlines() if line.startswith("Small images"))
    assert row.split()[2:5] == ["70", "50*", "30*"]
    assert row.split()[10:13] == ["10*", "50*", "30*"]
    drawn = picture(one, two)
    assert (
        "A  one" in drawn and "B  two" in drawn and "breaks at half" in drawn and "breaks at quarter" in drawn
    )


def test_the_picture_has_a_tile_for_each_case_with_its_colour_and_number(tmp_path: Path) -> None:
    report = made_report(small_suite(tmp_path), failure="the tracker <died>")
    root = ElementTree.fromstring(picture(report))
    tiles = root.findall(f"{_SVG}g")
    fills = [tile.find(f"{_SVG}rect").get("fill") for tile in tiles]  # type: ignore[union-attr]
    assert fills == [color_of(70 / 90), color_of(50 / 90), color_of(0)]
    texts = [[text.text for text in tile.findall(f"{_SVG}text")] for tile in tiles]
    assert texts == [["half", "70"], ["quarter", "✕ 50"], ["tiny", "✕ failed"]]


def test_everything_in_the_picture_is_inside_of_it(tmp_path: Path) -> None:
    root = ElementTree.fromstring(picture(made_report(small_suite(tmp_path))))
    width, height = float(root.attrib["width"]), float(root.attrib["height"])
    for shape in root.iter(f"{_SVG}text"):
        assert 0 <= float(shape.attrib["x"]) <= width and 0 <= float(shape.attrib["y"]) <= height


def test_the_page_is_one_file_with_every_case(tmp_path: Path) -> None:
    report = made_report(small_suite(tmp_path), "tracker <b>", failure="died & gone")
    content = html_page(report)
    assert "tracker &lt;b&gt;" in content and "died &amp; gone" in content
    assert content.count("<tr") == 1 + len(report.results)
    assert "src=" not in content and "href=" not in content
    assert [path.name for path in write_pages(tmp_path, report)] == [PICTURE, PAGE]


@pytest.mark.parametrize(("sees", "is_said"), [(True, False), (False, True), (None, False)])
def test_a_tracker_that_looks_at_no_image_is_told(tmp_path: Path, sees: bool | None, is_said: bool) -> None:
    report = made_report(small_suite(tmp_path))
    report.results = {name: replace(result, sees=sees) for name, result in report.results.items()}
    for text in (html_page(report), show_table(report)):
        assert ("subscribes to no topic of images" in text) == is_said


def test_pages_and_results_that_cannot_be_written_are_an_error(tmp_path: Path) -> None:
    report = made_report(small_suite(tmp_path))
    missing = tmp_path / "missing"
    with pytest.raises(HumansimError, match="missing"):
        report.write(missing)
    with pytest.raises(HumansimError, match="missing"):
        write_pages(missing, report)


def test_a_report_without_a_finished_case_can_be_shown(tmp_path: Path) -> None:
    report = Report.of_suite(small_suite(tmp_path), "tracker", {})
    assert "baseline" in show_table(report)
    assert ElementTree.fromstring(picture(report)).tag == f"{_SVG}svg"
