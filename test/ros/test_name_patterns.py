"""Patterns for names: POSIX extended syntax, and no pattern that takes long."""

from __future__ import annotations

import random
import re

import pytest

from humansim_ros.errors import RosError
from humansim_ros.ros.player.name_patterns import MAX_PATTERN, NamePattern


def random_pattern(random: random.Random, depth: int = 0) -> str:
    kind = random.random()
    if depth > 3 or kind < 0.45:
        return random.choice([*"abc.", "[ab]", "[^a]", "[a-b]", "[]b]", "[b-]"])
    if kind < 0.65:
        return random_pattern(random, depth + 1) + random_pattern(random, depth + 1)
    inner = random_pattern(random, depth + 1)
    if kind < 0.8:
        return f"({inner}|{random_pattern(random, depth + 1)})"
    return f"({inner}){random.choice(['*', '+', '?', '{2}', '{1,3}', '{0,2}', '{2,}', '{0}'])}"


def test_patterns_match_as_those_of_re() -> None:
    generator = random.Random(1)
    compared = 0
    for _ in range(3000):
        pattern = random_pattern(generator)
        pattern = generator.choice(["", "^"]) + pattern + generator.choice(["", "$"])
        text = "".join(generator.choice("abcd]-") for _ in range(generator.randint(0, 6)))
        try:
            found = NamePattern(pattern).matches(text)
        except RosError:  # too many positions
            continue
        compared += 1
        assert found == bool(re.search(pattern, text)), (pattern, text)
    assert compared > 2500


@pytest.mark.parametrize(
    ("pattern", "matching", "other"),
    [
        ("", "anything", None),
        ("walker", "humans/walker", "humans/runner"),
        ("^humans/", "humans/walker", "no humans/walker"),
        ("[[:digit:]]+$", "camera_12", "camera_12b"),
        ("^[[:upper:]_]*$", "LEFT_1"[:5], "left"),
        (r"a\.b", "a.b", "axb"),
        ("a|b{2}$", "abb", "cb"),
        ("^(a|b)*$", "abba", "abc"),
    ],
)
def test_patterns_are_searched_in_names(pattern: str, matching: str, other: str | None) -> None:
    assert NamePattern(pattern).matches(matching)
    assert other is None or not NamePattern(pattern).matches(other)


@pytest.mark.parametrize(
    "pattern", ["(", ")", "a)", "*", "a{", "a{,2}", "a{2,1}", "a{9999}", "[a", "[[:foo:]]", "a\\", r"\d"]
)
def test_other_text_is_refused_with_the_place(pattern: str) -> None:
    with pytest.raises(RosError, match=r"before character \d+"):
        NamePattern(pattern)


@pytest.mark.parametrize(
    "pattern",
    ["a" * (MAX_PATTERN + 1), "(" * 200, "(((a{9}){9}){9}){9}", "(" * 10 + "){200}" * 10, "((a|b){200}){2}"],
)
def test_patterns_of_many_steps_are_refused(pattern: str) -> None:
    with pytest.raises(RosError):
        NamePattern(pattern)


@pytest.mark.parametrize("pattern", ["(a*)*b", "(a|aa)+$", "(a?){100}a{100}", "(.*){100}z", "(.*.*.*)*x"])
def test_steps_are_bounded_by_positions_and_characters(pattern: str) -> None:
    steps = 0
    found = NamePattern(pattern)

    class Counted(list[int]):
        def __getitem__(self, index: int) -> int:  # type: ignore[override]
            nonlocal steps
            steps += 1
            return super().__getitem__(index)

    found._next = Counted(found._next)
    found.matches("a" * 1000)
    assert steps <= len(found._next) * 1002
