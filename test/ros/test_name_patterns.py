"""Patterns for names: POSIX extended syntax, and no pattern that takes long."""

from __future__ import annotations

import sys
import time

import pytest
import ros_support  # noqa: F401  (skips where ROS is missing)

from humansim_ros.ros.playing.entities import Refusal, name_filter


@pytest.fixture(autouse=True)
def _re2() -> None:
    pytest.importorskip("re2")


@pytest.mark.parametrize(
    ("pattern", "matching", "other"),
    [
        ("", "anything", None),
        ("walker", "humans/walker", "humans/runner"),
        ("^humans/", "humans/walker", "no humans/walker"),
        ("[[:digit:]]+$", "camera_12", "camera_12b"),
        ("^[[:upper:]_]*$", "LEFT_", "left"),
        (r"a\.b", "a.b", "axb"),
        ("a|b{2}$", "abb", "cb"),
        ("^(a|b)*$", "abba", "abc"),
    ],
)
def test_patterns_are_searched_in_names(pattern: str, matching: str, other: str | None) -> None:
    assert name_filter(pattern)(matching)
    assert other is None or not name_filter(pattern)(other)


@pytest.mark.parametrize(
    "pattern", ["(", ")", "a)", "*", "a{2,1}", "a{9999}", "[a", "[[:foo:]]", "a\\", r"\d", "(?i)a"]
)
def test_other_text_is_refused(pattern: str) -> None:
    with pytest.raises(Refusal, match="no POSIX extended pattern: "):
        name_filter(pattern)


@pytest.mark.parametrize("pattern", ["a" * 257, "(" * 200, "(((a{9}){9}){9}){9}", "(" * 10 + "){200}" * 10])
def test_patterns_of_many_steps_are_refused(pattern: str) -> None:
    with pytest.raises(Refusal):
        name_filter(pattern)


@pytest.mark.parametrize("pattern", ["(a*)*b", "(a|aa)+$", "(a?){100}a{100}", "(.*){100}z", "(.*.*.*)*x"])
def test_no_pattern_takes_long(pattern: str) -> None:
    """Python's own patterns need hours for some of these."""
    begin = time.process_time()
    name_filter(pattern)("a" * 1000)
    assert time.process_time() - begin < 1.0


def test_without_re2_a_filter_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "re2", None)
    assert name_filter("")("anything")
    with pytest.raises(Refusal, match="pip install google-re2"):
        name_filter("a")
