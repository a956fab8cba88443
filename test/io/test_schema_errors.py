"""Errors of all schemas are in words of their own, with the need of a key and the value found."""

from __future__ import annotations

import datetime
import re
from collections.abc import Iterator, Mapping
from types import UnionType
from typing import Annotated, Any, ClassVar, Literal, Union, get_args, get_origin

import pytest
from pydantic import BaseModel, Field, ValidationError

from humansim_ros.cameras import SensorConfig
from humansim_ros.cameras.camera.placement import _File as FloorPoints
from humansim_ros.errors import HumansimError
from humansim_ros.files.mesh.gltf_format import Document
from humansim_ros.files.yaml.schema import Axis, Section, schema_errors, show_value
from humansim_ros.motion.matching.joint_tables import JointTable
from humansim_ros.motion.pose.limits import LimitTable
from humansim_ros.people.loading.loading import MeshHuman, ParametricHuman
from humansim_ros.scene.config.config import SceneConfig

#: Wrong values of all types that YAML has.
VALUES: tuple[Any, ...] = (
    *(None, True, -7, 0, 5, 2.5, 1e300, 10**400, float("nan"), float("inf"), "", "some words", "x" * 500),
    *([], [1], [1, 2, 3, 4], ["a", "b", "c"], [[1, 2], [3]], [[]], [None], [{}], list(range(500))),
    *({}, {"a": 1}, {1: 2}, {"colour of it": [1]}, {"file": 5}, {"a": {"b": 1}}),
    *(datetime.date(2020, 1, 2), datetime.datetime(2020, 1, 2, 3), b"bytes", {1, 2}),
)
#: Words of messages of pydantic.
FOREIGN = re.compile(
    r"input should|field required|extra inputs|valid |validat|pydantic|type=|value error"
    r"|instance of|should (be|have|match)|unable to|is not permitted|constrained|function-|union|literal"
    r"|tuple|dict|NoneType|\bstr\b|\bint\b|\bfloat\b|\bbool\b",
    re.IGNORECASE,
)


def paths(annotation: Any, at: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Key paths of a schema: of its sections, of names in mappings, and of entries of lists."""
    origin = get_origin(annotation)
    if origin is Annotated:
        yield from paths(get_args(annotation)[0], at)
    elif origin in (Union, UnionType):
        for member in get_args(annotation):
            yield from paths(member, at)
    elif isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield at
        for name, info in annotation.model_fields.items():
            yield (*at, info.alias or name)
            yield from paths(info.annotation, (*at, info.alias or name))
    elif origin in (dict, Mapping) or (isinstance(origin, type) and issubclass(origin, Mapping)):
        yield (*at, "some_name")
        yield from paths(get_args(annotation)[1], (*at, "some_name"))
    elif origin is not Literal and get_args(annotation):
        yield (*at, 0)
        for member in get_args(annotation)[:1]:
            yield from paths(member, (*at, 0))


def nested(path: tuple[Any, ...], value: Any) -> Any:
    for part in reversed(path):
        value = [value] if part == 0 else {part: value}
    return value


def faults(model: type[BaseModel], value: Any) -> HumansimError | None:
    try:
        model.model_validate(value)
    except ValidationError as reason:
        return schema_errors(reason, model, HumansimError)[0]
    return None


MODELS = (SceneConfig, MeshHuman, ParametricHuman, JointTable, LimitTable, Document, FloorPoints)


@pytest.mark.slow
@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.__name__)
def test_no_message_has_words_of_the_library(model: type[BaseModel]) -> None:
    count = 0
    for path in dict.fromkeys(paths(model)):
        for value in VALUES:
            error = faults(model, nested(path, value))
            if error is None:
                continue
            count += 1
            # names and values of the file are not words of the message
            words = re.sub(r"'[^']*'|`[^`]*`|with the keys .*|nown here: .*|found .*", "", error.message)
            assert not FOREIGN.search(words), f"{path} {value!r:.80}: {error}"
            assert error.message[0] not in "'[{", error
            assert len(str(error)) < 1000, error
            if error.key:
                assert not re.search(r"\[|\(|-", error.key), f"{path} {value!r:.80}: {error.key}"
    assert count > 100


class Inner(Section):
    """A section."""

    size: tuple[int, int] = Field(description="width, height; in pixels", examples=[[640, 480]])
    up: Axis = "z"


class Outer(Section):
    """Another section."""

    other_words: ClassVar[dict[str, str]] = {"rate": "fps"}

    rate: float = Field(default=30.0, gt=0, le=100, description="frames per second")
    mode: Literal["lit", "shadeless"] = "lit"
    names: tuple[str, ...] = ()
    matrix: tuple[tuple[float, float], tuple[float, float]] | None = None
    parts: dict[str, Inner] = Field(default_factory=dict)
    choice: Literal["height"] | Annotated[float, Field(ge=0)] | None = None


@pytest.mark.parametrize(
    ("value", "key", "message"),
    [
        ({"rate": "fast"}, "rate", "give a number above 0 and at most 100 (frames per second); found 'fast'"),
        ({"rate": 200}, "rate", "give a number above 0 and at most 100 (frames per second); found 200"),
        ({"mode": "shadles"}, "mode", "give lit or shadeless; found 'shadles'; did you mean 'shadeless'?"),
        ({"names": "a"}, "names", "give a list of texts; found 'a'"),
        ({"names": ["a", 5]}, "names.1", "give a list of texts; found 5 as number 2"),
        (
            {"matrix": [[1, 2], [3, "x"]]},
            "matrix.1.1",
            "give two rows of two numbers; found 'x' as number 2 of row 2",
        ),
        ({"matrix": [[1, 2]]}, "matrix.1", "give two rows of two numbers; found [[1, 2]]"),
        (
            {"parts": {"a": {"size": 640}}},
            "parts.a.size",
            "give two whole numbers (width, height), such as [640, 480]; found 640",
        ),
        (
            {"parts": {"a": {}}},
            "parts.a.size",
            "this key is missing: give two whole numbers (width, height), such as [640, 480]",
        ),
        ({"parts": {"a": 3}}, "parts.a", "give a mapping with the keys size, up; found 3"),
        ({"parts": 3}, "parts", "give a mapping of names to mappings with the keys size, up; found 3"),
        (
            {"parts": {"a": {"size": [1, 2], "up": "w"}}},
            "parts.a.up",
            "give an axis, such as y or -z; found 'w'",
        ),
        ({"choice": -1}, "choice", "give height or a number of 0 or more; found -1"),
        (
            {"choice": "heigt"},
            "choice",
            "give height or a number of 0 or more; found 'heigt'; did you mean 'height'?",
        ),
        (
            {"rats": 3},
            "rats",
            "unknown key; did you mean `rate`? Known here: rate, mode, names, matrix, parts, choice",
        ),
        (
            {"fps": 3},
            "fps",
            "unknown key; did you mean `rate`? Known here: rate, mode, names, matrix, parts, choice",
        ),
        ({"size": 3}, "size", "unknown key; known here: rate, mode, names"),
        (
            {"parts": {"a": {"size": [1, 2], "rate": 3}}},
            "parts.a.rate",
            "unknown key; known here: size, up",
        ),
        ({"zzz": 3}, "zzz", "unknown key; known here: rate, mode"),
    ],
)
def test_a_message_says_what_is_needed_and_what_was_found(value: Any, key: str, message: str) -> None:
    error = faults(Outer, value)
    assert error is not None
    assert error.key == key
    assert error.message.startswith(message)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "null"),
        (True, "true"),
        (2.5, "2.5"),
        ("a", "'a'"),
        ("a" * 100, "a text of 100 characters"),
        ([1, "a", [None]], "[1, 'a', [null]]"),
        (list(range(100)), "a list of 100 values"),
        ({"a": 1, "b": 2}, "a mapping with the keys a, b"),
        ({}, "{}"),
        (b"a", "binary data"),
        (datetime.date(2020, 1, 2), "the date 2020-01-02"),
        (10**400, "a very long number"),
    ],
)
def test_values_are_shown_as_in_a_file_and_never_at_length(value: Any, text: str) -> None:
    assert show_value(value) == text


def test_a_constructor_in_python_has_the_same_errors() -> None:
    with pytest.raises(HumansimError) as caught:
        SensorConfig(exposure_time="long", noise={"full_well": 5})
    assert str(caught.value) == (
        "exposure_time: give a number from 0 to 10 (exposure time of a row, seconds); found 'long'"
    )
    with pytest.raises(HumansimError, match=r"noise.full_well: give a number from 10 to 1e\+07 .*; found 5"):
        SensorConfig(noise={"full_well": 5})
    assert SensorConfig(noise={"full_well": 50}).noise is not None


def unguarded_numbers(schema: Any) -> Iterator[str]:
    """Kinds of the numbers in a schema of the library that accept true and false."""
    if isinstance(schema, Mapping):
        inner = schema.get("schema")
        if schema.get("type") == "function-before" and isinstance(inner, Mapping):
            if inner.get("type") in ("int", "float"):
                return
        elif schema.get("type") in ("int", "float"):
            yield str(schema["type"])
        for key, part in schema.items():
            if key not in ("metadata", "serialization", "default"):
                yield from unguarded_numbers(part)
    elif isinstance(schema, (list, tuple)):
        for part in schema:
            yield from unguarded_numbers(part)


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.__name__)
def test_no_number_of_any_schema_is_true_or_false(model: type[BaseModel]) -> None:
    assert list(unguarded_numbers(model.__pydantic_core_schema__)) == []


@pytest.mark.parametrize(
    ("value", "key", "message"),
    [
        ({"rate": True}, "rate", "give a number above 0 and at most 1000 (frames per second); found true"),
        ({"variety": {"count": False}}, "variety.count", "give a whole number from 0 to 1000"),
        ({"room": {"size": [7, True, 3]}}, "room.size.1", "give three numbers"),
        ({"humans": {"a": {"motion": {"root_scale": True}}}}, "humans.a.motion.root_scale", "give height or"),
    ],
)
def test_yes_and_no_are_no_numbers_of_a_scene(value: Any, key: str, message: str) -> None:
    error = faults(SceneConfig, value)
    assert error is not None
    assert error.key == key
    assert error.message.startswith(message)
