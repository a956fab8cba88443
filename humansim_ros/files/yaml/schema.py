"""Schemas of all YAML files: base model, value types, and errors in words of this package.

An error says what a key needs and what was given. The messages are made from the annotations of the schema,
not from the messages of the validation library.
"""

from __future__ import annotations

import collections.abc
import os
import types
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    ClassVar,
    Literal,
    TypeVar,
    Union,
    cast,
    get_args,
    get_origin,
)

import annotated_types
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    StringConstraints,
    ValidationError,
    model_validator,
)
from pydantic.fields import FieldInfo
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

from humansim_ros.errors import HumansimError, SceneError, did_you_mean, near_names
from humansim_ros.files.reading.assets import read_table
from humansim_ros.files.yaml.yaml import line_of

if TYPE_CHECKING:
    import yaml

Model = TypeVar("Model", bound=BaseModel)
_COUNTS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")
#: Longest value and longest description that a message shows, characters.
_LONGEST_VALUE, _LONGEST_DESCRIPTION = 60, 70
_MAPPINGS = (dict, collections.abc.Mapping)
_LISTS = (tuple, list, collections.abc.Sequence)


@dataclass(frozen=True)
class Expected:
    """Words for a value in error messages. Use it in ``Annotated``. ``one``: for one value, such as ``an
    axis``. ``many``: for several values, such as ``axes``."""

    one: str
    many: str = ""


@dataclass(frozen=True)
class _Place:
    """Place of an error: the key path, the annotation with the need of the key, and the field with this
    annotation."""

    keys: tuple[Any, ...]
    annotation: Any
    field: FieldInfo | None
    is_name: bool = False


def validated(
    model: type[Model],
    data: Any,
    error: type[HumansimError],
    path: str | os.PathLike[str] | None = None,
    tree: yaml.Node | None = None,
) -> Model:
    """Check the content of a file against a model, and return it as an object of this model.

    Args:
        model: The model.
        data: Content of the file.
        error: Error class to raise.
        path: File, for messages.
        tree: YAML nodes of the file, for the line.

    Raises:
        HumansimError: ``error`` with key and line, made by :func:`schema_errors`.
    """
    try:
        return model.model_validate(data)
    except ValidationError as reason:
        raise schema_errors(reason, model, error, path, tree)[0] from None


def schema_errors(
    reason: ValidationError,
    model: type[BaseModel],
    error: type[HumansimError],
    path: str | os.PathLike[str] | None = None,
    tree: yaml.Node | None = None,
) -> list[HumansimError]:
    """Make an error with key and line for each key that the validation of a model has found wrong. The
    messages say which value is needed and which was found.

    Args:
        reason: Exception of the validation.
        model, error, path, tree: The same as in :func:`validated`.
    """
    groups: dict[tuple[Any, ...], list[Any]] = {}
    for fault in reason.errors(include_url=False):
        unknown = fault["type"] == "extra_forbidden"
        keys = tuple(fault["loc"]) if unknown else _place(model, tuple(fault["loc"])).keys
        # the alternatives of a key count as one error
        known = next((other for other in groups if keys[: len(other)] == other), keys)
        groups.setdefault(known, []).append(fault)
    errors = []
    for fault in map(_best, groups.values()):
        keys, message = _key_and_message(fault, model)
        line = line_of(tree, [key for key in fault["loc"] if key != "[key]"])
        errors.append(error(message, path=path, line=line, key=".".join(map(str, keys)) or None))
    return errors


def _key_and_message(fault: Any, model: type[BaseModel]) -> tuple[tuple[Any, ...], str]:
    location = tuple(fault["loc"])
    if fault["type"] == "extra_forbidden":
        return location, unknown_key(model, location)
    place = _place(model, location)
    # for values in lists: their numbers, without the names of alternatives in between
    inner = [part for part in location[len(place.keys) :] if isinstance(part, int)]
    if fault["type"] == "value_error":
        return (*place.keys, *inner), str(fault["msg"]).removeprefix("Value error, ")
    need = needed(place.annotation, place.field)
    if fault["type"] == "missing" and not isinstance(location[-1], int):
        return place.keys, f"this key is missing: {need}"
    return (*place.keys, *inner), f"{need}; found {_found(fault, place, inner)}"


def allowed(annotation: Any, field: FieldInfo | None = None) -> str:
    """The values that a key accepts: ``two whole numbers``, ``a number of 0 or more``."""
    return _Words.of(annotation, () if field is None else field.metadata).one


def needed(annotation: Any, field: FieldInfo | None = None) -> str:
    """What a key needs, as a request: ``give two whole numbers (width, height), such as [640, 480]``."""
    text = f"give {allowed(annotation, field)}"
    if field is None:
        return text
    description = (field.description or "").split(";")[0].split(":")[0].strip()
    if description and len(description) <= _LONGEST_DESCRIPTION and description not in text:
        text += f" ({description})"
    example = _example(annotation, field)
    return f"{text}, such as {example}" if example else text


def show_value(value: Any) -> str:
    """A value of a file as a short text."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (int, float)):
        text = str(value)
        return text if len(text) <= _LONGEST_VALUE else "a very long number"
    if isinstance(value, str):
        text = repr(str(value)[: _LONGEST_VALUE + 1])
        return text if len(value) <= _LONGEST_VALUE else f"a text of {len(value)} characters"
    if isinstance(value, Mapping):
        names = ", ".join(str(key)[:20] for key in list(value)[:5])
        return f"a mapping with the keys {names}{' …' if len(value) > 5 else ''}" if value else "{}"
    if isinstance(value, Sequence) and not isinstance(value, (bytes, bytearray)):
        few = [show_value(part) for part in value[:10]]
        text = f"[{', '.join(few)}]"
        return text if len(value) <= 10 and len(text) <= _LONGEST_VALUE else f"a list of {len(value)} values"
    if isinstance(value, (bytes, bytearray)):
        return "binary data"
    name = type(value).__name__
    return f"the {name} {value}" if name in ("date", "datetime") else f"a value of type {name}"


# --- the place of an error


def _best(faults: Sequence[Any]) -> Any:
    """The fault to report: the first one or, if a key accepts alternatives, that of the alternative with
    names."""
    first, alternative = faults[0], len(faults[0]["loc"]) - 1
    if isinstance(first["input"], (str, list)):
        return first
    for fault in faults:
        *above, name = fault["loc"][: alternative + 1] or ("",)
        is_deeper = len(fault["loc"]) > len(first["loc"]) and tuple(above) == first["loc"][:-1]
        if is_deeper and str(name).startswith("dict["):
            return fault
    return first


def _place(model: type[BaseModel], location: tuple[Any, ...]) -> _Place:
    """The place of an error at a ``location`` in a model. A list of plain values is one place."""
    place = _Place((), model, None)
    for number, part in enumerate(location):
        annotation = _plain(place.annotation)
        if part == "[key]":
            return place
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            found = _field(annotation, part)
            if found is None:
                return place
            place = _Place((*place.keys, part), found.annotation, found)
        elif get_origin(annotation) in _MAPPINGS:
            names, values = get_args(annotation)
            is_name = location[number + 1 : number + 2] == ("[key]",)
            place = _Place((*place.keys, part), names if is_name else values, None, is_name)
        elif get_origin(annotation) in _LISTS and _has_sections(annotation) and isinstance(part, int):
            place = _Place((*place.keys, part), get_args(annotation)[0], None)
        elif _is_union(annotation) and str(part).startswith("dict["):
            mapping = next(each for each in get_args(annotation) if get_origin(_plain(each)) in _MAPPINGS)
            place = _Place(place.keys, mapping, place.field)
        else:
            return place
    return place


def _field(model: type[BaseModel], name: Any) -> FieldInfo | None:
    by_alias = {info.alias or key: info for key, info in model.model_fields.items()}
    return by_alias.get(name) or model.model_fields.get(name)


def _found(fault: Any, place: _Place, inner: Sequence[int]) -> str:
    """Text of the value that was found at a place. For a list, the item at the indices ``inner``."""
    if place.is_name:
        return f"the name {show_value(place.keys[-1])}"
    value = show_value(fault["input"])
    if fault["type"] == "missing":  # a list is too short
        return value
    if fault["type"] == "string_type" and isinstance(fault["input"], bool):
        value += ' (quote a text such as "off", "on", "yes" or "no")'
    if not inner:
        return value + did_you_mean(str(fault["input"]), _choices(place.annotation))
    return f"{value} as number {' of row '.join(str(part + 1) for part in reversed(inner))}"


def _choices(annotation: Any) -> list[str]:
    """Texts that an annotation allows."""
    if get_origin(annotation) is Literal:
        return [choice for choice in get_args(annotation) if isinstance(choice, str)]
    return [choice for part in get_args(annotation) for choice in _choices(part)]


# --- what an annotation needs


@dataclass(frozen=True)
class _Words:
    """What one value needs, and what several values need: ``a number above 0``, ``numbers above 0``."""

    one: str
    many: str

    @classmethod
    def of(cls, annotation: Any, metadata: Sequence[Any] = ()) -> _Words:
        """Words for an annotation with the metadata of its field."""
        if get_origin(annotation) is Annotated:
            inner, *more = get_args(annotation)
            return cls.of(inner, [*metadata, *more])
        metadata = list(_flat(metadata))
        for part in metadata:
            if isinstance(part, Expected):
                return cls(part.one, part.many or part.one)
        if _is_union(annotation):
            members = _members(annotation)
            words = [cls.of(member, metadata if len(members) == 1 else ()) for member in members]
            return cls(either([w.one for w in words]), either([w.many for w in words]))
        origin = get_origin(annotation)
        if origin is Literal:
            choices = either([str(choice) for choice in get_args(annotation)])
            return cls(choices, choices)
        if origin in _LISTS:
            return cls._of_list(annotation, metadata)
        if origin in _MAPPINGS or annotation in _MAPPINGS:
            values = cls.of(get_args(annotation)[1]).many if get_args(annotation) else "values"
            one = f"a mapping of names to {values}"
            return cls(one + _at_least_one(metadata), f"mappings of names to {values}")
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            return cls._of_section(annotation)
        if annotation is Any:
            return cls("a value", "values")
        if annotation is bool:
            return cls("true or false", "true or false")
        if annotation in (int, float):
            whole, limits = "whole " if annotation is int else "", _limits(metadata)
            return cls(f"a {whole}number{limits}", f"{whole}numbers{limits}")
        return cls("a text", "texts")

    @classmethod
    def _of_list(cls, annotation: Any, metadata: Sequence[Any]) -> _Words:
        parts = [part for part in get_args(annotation) if part is not Ellipsis]
        many = cls.of(parts[0]).many
        shortest = [part.min_length for part in metadata if isinstance(part, annotated_types.MinLen)]
        longest = [part.max_length for part in metadata if isinstance(part, annotated_types.MaxLen)]
        count = shortest[0] if shortest and shortest == longest else None
        if get_origin(annotation) is tuple and Ellipsis not in get_args(annotation):
            count = len(parts)
        if count is None:
            return cls(f"a list of {many}{_at_least_one(metadata)}", f"lists of {many}")
        number = _COUNTS[count] if count < len(_COUNTS) else str(count)
        if get_origin(_plain(parts[0])) in _LISTS:
            inner = cls.of(parts[0]).one
            return cls(f"{number} rows of {inner}", f"lists of {number} rows of {inner}")
        return cls(f"{number} {many}", f"lists of {number} {many}")

    @classmethod
    def _of_section(cls, model: type[BaseModel]) -> _Words:
        names = key_names(model)
        listed = ", ".join(names[:6]) + (" …" if len(names) > 6 else "")
        alone = getattr(model, "short_key", None)
        one = f"a mapping with the keys {listed}"
        return cls(one + (f", or a text, its {alone}" if alone else ""), f"mappings with the keys {listed}")


def _at_least_one(metadata: Sequence[Any]) -> str:
    return ", at least one" if any(isinstance(part, annotated_types.MinLen) for part in metadata) else ""


def _limits(metadata: Sequence[Any]) -> str:
    """Limits of a number, in words: `` from 0 to 1``."""
    forms = {"ge": "of {} or more", "gt": "above {}", "le": "at most {}", "lt": "below {}"}
    limits = {key: _number(getattr(part, key)) for part in metadata for key in forms if hasattr(part, key)}
    if {"ge", "le"} <= limits.keys():
        return f" from {limits['ge']} to {limits['le']}"
    text = " and ".join(form.format(limits[key]) for key, form in forms.items() if key in limits)
    return f" {text}" if text else ""


def _number(value: Any) -> str:
    return f"{value:g}" if abs(value) < 1e15 else str(value)


def _flat(metadata: Sequence[Any]) -> Iterator[Any]:
    """Metadata, including metadata inside a ``Field`` of an annotation."""
    for part in metadata:
        if isinstance(part, FieldInfo):
            yield from _flat(part.metadata)
        elif isinstance(part, annotated_types.GroupedMetadata) and not isinstance(part, StringConstraints):
            yield from part
        else:
            yield part


def _example(annotation: Any, field: FieldInfo) -> str:
    """An example of a list of numbers. Empty for other values."""
    if field.examples:
        return str(field.examples[0])
    plain = _plain(annotation)
    default = field.default if isinstance(field.default, tuple) else ()
    is_list = get_origin(plain) in _LISTS and not _has_sections(plain)
    return show_value(list(default)) if is_list and default else ""


def _plain(annotation: Any) -> Any:
    """Annotation without metadata and without None."""
    while True:
        if get_origin(annotation) is Annotated:
            annotation = get_args(annotation)[0]
        elif _is_union(annotation) and len(members := _members(annotation)) == 1:
            annotation = members[0]
        else:
            return annotation


def _members(annotation: Any) -> list[Any]:
    return [member for member in get_args(annotation) if member is not type(None)]


def _is_union(annotation: Any) -> bool:
    return get_origin(annotation) in (Union, types.UnionType)


def _has_sections(annotation: Any) -> bool:
    """Whether an annotation contains a section."""
    return any(True for _ in _models(annotation))


# --- unknown keys: the key that was probably meant

#: Least similarity to a key that was probably meant.
_NEAR = 0.6


def unknown_key(model: type[BaseModel], keys: Sequence[Any]) -> str:
    """Message about an unknown key. ``keys``: path from the top of the file to the unknown key."""
    section = _section_at(model, keys[:-1])
    known, word = key_names(section), str(keys[-1]).lower().replace("-", "_").replace(" ", "_")
    meant = next((key for key in known if key.lower() == word), None) or _other_words(section).get(word)
    meant = meant or next(iter(near_names(word, known, _NEAR)), None)
    listed = ", ".join(known)
    return f"unknown key; {f'did you mean `{meant}`? Known' if meant else 'known'} here: {listed}"


def either(texts: Sequence[str]) -> str:
    """Join the different texts as alternatives: ``a, b or c``."""
    unique = list(dict.fromkeys(texts))
    return unique[0] if len(unique) == 1 else f"{', '.join(unique[:-1])} or {unique[-1]}"


def key_names(section: type[BaseModel]) -> list[str]:
    """Keys of a section, as they are spelled in files."""
    return [info.alias or name for name, info in section.model_fields.items()]


def _other_words(section: type[BaseModel]) -> dict[str, str]:
    """Keys of a section by words that people use for them, from config/other_words.json or from the
    section."""
    table = read_table("other_words")
    rows = (vars(each).get("other_words") or table.get(each.__name__) for each in section.__mro__)
    by_key: dict[str, str] = next(filter(None, rows), {})
    return {word: key for key, words in by_key.items() for word in words.split()}


def _section_at(model: type[BaseModel], keys: Sequence[Any]) -> type[BaseModel]:
    """Section at a path of keys. Names (of humans, cameras …) and numbers in the path do not change the
    section."""
    for key in keys:
        if key in model.model_fields:
            model = next(_models(model.model_fields[key].annotation), model)
    return model


def _models(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for inner in get_args(annotation):
        yield from _models(inner)


if TYPE_CHECKING:
    from pydantic._internal._model_construction import ModelMetaclass
else:
    ModelMetaclass = type(BaseModel)


#: Keys of a pydantic core schema that have no schemas below them.
_NO_SCHEMAS = ("default", "metadata", "serialization")


def _refusing_booleans(part: Any) -> Any:
    """Add a check to each number of a schema. The check refuses booleans."""
    if isinstance(part, (list, tuple)):
        return type(part)(_refusing_booleans(item) for item in part)
    if not isinstance(part, dict):
        return part
    if part.get("type") in ("int", "float"):
        return core_schema.no_info_before_validator_function(_refuse_boolean, cast(Any, part))
    if part.get("type") == "function-before" and part["function"]["function"] is _refuse_boolean:
        return part  # the schema of a model within the model
    return {key: item if key in _NO_SCHEMAS else _refusing_booleans(item) for key, item in part.items()}


def _refuse_boolean(value: Any) -> Any:
    if isinstance(value, bool):
        raise PydanticCustomError("boolean", "a number is needed")
    return value


class Checked(BaseModel):
    """Base of all models. It refuses true and false as numbers, although Python counts them as 1 and 0."""

    @classmethod
    def __get_pydantic_core_schema__(
        cls, source: Any, handler: GetCoreSchemaHandler
    ) -> core_schema.CoreSchema:
        """Schema of the model, with numbers that refuse booleans."""
        return cast("core_schema.CoreSchema", _refusing_booleans(handler(source)))


class _SectionType(ModelMetaclass):
    """Converts errors of constructors to errors of this package, but not errors of ``model_validate``."""

    def __call__(cls, *values: Any, **keys: Any) -> Any:
        try:
            return super().__call__(*values, **keys)
        except ValidationError as reason:
            raise schema_errors(reason, cast("type[BaseModel]", cls), SceneError)[0] from None


class Section(Checked, metaclass=_SectionType):
    """Mapping of a YAML file. Unknown keys and numbers that are not finite are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, defer_build=True)
    #: For each key of this section: words that people use for the key, separated by spaces, in addition to
    #: those of config/other_words.json.
    other_words: ClassVar[dict[str, str]] = {}


Byte = Annotated[int, Field(ge=0, le=255)]
#: Red, green, blue; sRGB.
ByteColor = tuple[Byte, Byte, Byte]
#: Fraction, from 0 to 1.
Share = Annotated[float, Field(ge=0, le=1)]
#: Axis of a file, such as ``y`` or ``-z``.
Axis = Annotated[
    str,
    StringConstraints(pattern=r"^[+-]?[xyz]$"),
    Expected("an axis, such as y or -z", "axes, such as y or -z"),
]


#: Name of a ROS topic, absolute or relative.
TopicName = Annotated[
    str,
    StringConstraints(pattern=r"^/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*$", max_length=255),
    Expected("the name of a topic, such as /tracker/poses"),
]


#: Name of a human, an object, a camera or a scanner. It becomes a part of names of ROS nodes, topics and
#: frames, which may have 255 characters.
SceneName = Annotated[
    str,
    StringConstraints(pattern=r"^[A-Za-z][A-Za-z0-9_]*$", max_length=100),
    Expected("a name of letters, digits and _ that begins with a letter, at most 100 characters"),
]


class NamedFile(str):
    """Value of a key that names a file."""


#: Path of a file or, if the key allows it, name of a built-in file. Relative paths start from the folder of
#: the scene.
FileName = Annotated[str, AfterValidator(NamedFile), Expected("a name or path", "names or paths")]


def one_or_more(schema: dict[str, Any]) -> None:
    """Change the JSON schema of a list so that it accepts a single item of the list, too."""
    options = schema.pop("anyOf", None) or [
        {key: schema.pop(key) for key in ("type", "items", "maxItems") if key in schema}
    ]
    item = next(each["items"] for each in options if "items" in each)
    schema["anyOf"] = [*options, item]


def alone_in_list(value: Any) -> Any:
    """Put a single text or section into a tuple. Return other values unchanged."""
    return (value,) if isinstance(value, (str, dict)) else value


class ShortSection(Section):
    """Section that can be written as a single text. The text is the value of one of its keys, such as the
    name of its file."""

    #: The key that gets this text.
    short_key: ClassVar[str] = "file"

    @model_validator(mode="before")
    @classmethod
    def _text_alone(cls, value: Any) -> Any:
        return {cls.short_key: value} if isinstance(value, str) else value

    @classmethod
    def __get_pydantic_json_schema__(
        cls, core_schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        section = handler.resolve_ref_schema(handler(core_schema))
        return {"anyOf": [{"type": "string"}, section]}
