"""Tables of the package: each of their rows is used."""

from __future__ import annotations

import importlib
import inspect
import re
from functools import cache

import pytest
from conftest import ROOT
from pydantic import BaseModel

import humansim_ros
from humansim_ros.cli.main import COMMANDS, load_command
from humansim_ros.files.reading.assets import read_table


def test_each_row_of_the_command_line_is_an_option() -> None:
    """A row of a command is a parameter of it; a shared row is one of some command, or the row of one."""
    table = read_table("command_line")
    names = {
        command: {name.rstrip("_") for name in inspect.signature(load_command(command)).parameters}
        for command in COMMANDS
    }
    names["humansim"] = {"version"}
    named = {row for rows in table.values() for row in rows.values() if isinstance(row, str)}
    names["shared"] = named.union(*names.values())
    assert [(key, row) for key, rows in table.items() for row in rows if row not in names[key]] == []


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
