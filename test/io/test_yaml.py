"""Limits of all readers of YAML files."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import pytest

from humansim_ros.cameras import read_calibration
from humansim_ros.errors import HumansimError
from humansim_ros.files.yaml.yaml import parse_yaml
from humansim_ros.motion.matching.joint_tables import load_table
from humansim_ros.motion.pose.limits import load_limits
from humansim_ros.people.loading.loading import read_description
from humansim_ros.ros.processes.node_processes import scene_processes
from humansim_ros.scene.config.config import load_config


def laughs(how: str) -> str:
    """Nine keys; each repeats the key before it ten times."""
    keys = ["a0: &a0 {b: 1, c: 2}"]
    keys += [f"a{n}: &a{n} {how.format(', '.join([f'*a{n - 1}'] * 10))}" for n in range(1, 10)]
    return "\n".join(keys) + "\n"


CHAIN = "a0: &a0 [0]\n" + "".join(f"a{n}: &a{n} [*a{n - 1}]\n" for n in range(1, 60))
HOSTILE = {
    "aliases": (laughs("[{}]"), 6, "more than 100000 keys and values, with all"),
    "merge keys": (laughs("{{<<: [{}]}}"), 6, "more than 100000 keys and values, with all"),
    "itself": ("a: &a\n  b: [*a]\n", 1, "contains itself"),
    "a chain": (CHAIN, 48, "more than 50 nested levels"),
    "a deep list": ("a: " + "[" * 51 + "]" * 51, 1, "more than 50 nested levels"),
    "a very deep list": ("a: " + "[" * 5000, 1, "more than 50 nested levels"),
    "a key of many": (laughs("[{}]") + "? [*a9]\n: 1\n", 6, "more than 100000 keys and values, with all"),
    "a great many": ("a: [" + "0," * 150_000 + "]", 1, "more than 100000 keys and values"),
}
READERS = (load_config, scene_processes, read_description, read_calibration, load_table, load_limits)


# many keys take seconds to read: one reader stands for all
CASES = [
    (name, read) for name in HOSTILE for read in READERS if name != "a great many" or read is load_config
]


@pytest.mark.daily(
    "aliases-load_config",
    "a deep list-load_config",
    "merge keys-read_calibration",
    "itself-load_table",
    "a chain-read_description",
)
@pytest.mark.slow
@pytest.mark.parametrize(("name", "read"), CASES)
def test_repetition_in_files_is_limited(tmp_path: Path, name: str, read: Callable[[Path], object]) -> None:
    text, line, message = HOSTILE[name]
    path = tmp_path / "hostile.yaml"
    path.write_text(text)
    start = time.process_time()
    with pytest.raises(HumansimError) as caught:
        read(path)
    assert message in caught.value.message
    assert (caught.value.path, caught.value.line) == (str(path), line)
    assert time.process_time() - start < 60  # seconds; without a limit it never ends


def test_a_file_that_is_far_too_large_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "huge.yaml"
    path.write_text("#" * (1 << 21))
    with pytest.raises(HumansimError, match="the scene file is too large: 2 MB; at most 1 MB are read"):
        load_config(path)


@pytest.mark.parametrize("read", READERS, ids=lambda read: read.__name__)
def test_a_tag_that_does_not_fit_its_value_is_an_error_of_the_file(
    tmp_path: Path, read: Callable[[Path], object]
) -> None:
    """For a date that is a mapping, PyYAML raises a TypeError."""
    path = tmp_path / "date.yaml"
    path.write_text("name: !!timestamp {=: 1}\n")
    with pytest.raises(HumansimError, match="not valid YAML") as caught:
        read(path)
    assert caught.value.path == str(path)


@pytest.mark.parametrize(
    ("text", "line", "message"),
    [
        ("cameras:\n  off: {}\n", 2, 'quote the name "off"'),
        ("humans: {anna: {}, Yes: {}}\n", 1, 'quote the name "Yes"'),
        ("hri: {camera: off}\n", 1, 'found false (quote a text such as "off", "on", "yes" or "no")'),
    ],
)
def test_a_name_that_yaml_reads_as_a_boolean_needs_quotes(
    tmp_path: Path, text: str, line: int, message: str
) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(text)
    with pytest.raises(HumansimError) as caught:
        load_config(path)
    assert message in caught.value.message
    assert caught.value.line == line
    parse_yaml(text.replace("off", "'off'").replace("Yes", "'Yes'"), HumansimError, path)
