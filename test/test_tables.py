"""Tables of the package: each of their rows is used."""

from __future__ import annotations

import importlib
import re
from functools import cache

import pytest
from conftest import ROOT
from pydantic import BaseModel

import humansim_ros
from humansim_ros.files.reading.assets import read_table

_COMMANDS = "\n".join(path.read_text() for path in (ROOT / "humansim_ros" / "cli").glob("*.py"))
_OPTIONS = [f"{command}.{name}" for command, rows in read_table("command_line").items() for name in rows]


def test_each_row_of_the_command_line_is_an_option() -> None:
    assert [row for row in _OPTIONS if f'("{row}"' not in _COMMANDS] == []


@cache
def sections() -> dict[str, type[BaseModel]]:
    """Models of the package by name."""
    for path in (ROOT / "humansim_ros").rglob("*.py"):
        if re.search(r"^class \w+\(.*(Model|Section|Config|Fault)\)", path.read_text(), re.MULTILINE):
            importlib.import_module(".".join(path.relative_to(ROOT).with_suffix("").parts))
    found: dict[str, type[BaseModel]] = {}
    left = BaseModel.__subclasses__()
    while left:
        model = left.pop()
        left += model.__subclasses__()
        if model.__module__.startswith(humansim_ros.__name__):
            found[model.__name__] = model
    return found


@pytest.mark.parametrize("name", read_table("other_words"))
def test_other_words_are_of_keys_that_a_section_has(name: str) -> None:
    model = sections()[name]
    known = {field.alias or key for key, field in model.model_fields.items()} | model.model_fields.keys()
    assert read_table("other_words")[name].keys() <= known
