"""Keys of scene files: what each may hold, from the schema; values that a file can hold."""

from __future__ import annotations

import math
import types
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Union, get_args, get_origin

import numpy as np
from pydantic import BaseModel, TypeAdapter, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from humansim_ros.errors import SceneError, printable
from humansim_ros.io.schema_errors import needed, show_value, unknown_key
from humansim_ros.io.yaml_edit import YamlKey
from humansim_ros.scene.config import SceneConfig

#: Longest name of a human, object or camera, which becomes part of topics; longest text of a value.
MAX_NAME, MAX_TEXT = 100, 10_000
_MAX_DEPTH, _MAX_VALUES = 20, 10_000


@dataclass(frozen=True)
class SceneKey:
    """A key of scene files.

    Attributes:
        keys: Its path, such as ``("humans", "anna", "motion", "yaw_deg")``.
        annotation: Type of its values.
        field: Field of the schema; None for named sections and items of lists.
    """

    keys: tuple[YamlKey, ...]
    annotation: Any
    field: FieldInfo | None = None

    @property
    def section(self) -> type[BaseModel] | None:
        """Model of its keys, if it is a section."""
        return next(_models(self.annotation), None)

    @property
    def short_key(self) -> str | None:
        """Key of the section that a text alone stands for."""
        return getattr(self.section, "short_key", None)

    @property
    def default(self) -> Any:
        """Value if the key is absent; None if it must be given."""
        if self.field is None:
            return None
        value = self.field.get_default(call_default_factory=True)
        if value is PydanticUndefined:
            return None
        return value.model_dump() if isinstance(value, BaseModel) else value


def split_key(key: str | Sequence[YamlKey]) -> tuple[YamlKey, ...]:
    """Path of a dotted key. Raises SceneError for keys that no scene can have."""
    keys = tuple(key.split(".")) if isinstance(key, str) else tuple(key)
    if not keys or len(keys) > _MAX_DEPTH or any(part == "" for part in keys):
        raise SceneError(f"not a key of a scene: {printable(str(key), 60)!r}")
    return keys


def find_key(key: str | Sequence[YamlKey]) -> SceneKey:
    """Find a key in the schema.

    Args:
        key: Dotted, such as ``humans.anna.motion.yaw_deg``, or its parts.

    Raises:
        SceneError: There is no such key, or a name in it cannot be one.
    """
    keys = split_key(key)
    found = SceneKey((), SceneConfig)
    for part in keys:
        found = _inside(found, part, (*found.keys, part))
    return found


def _inside(outer: SceneKey, part: YamlKey, keys: tuple[YamlKey, ...]) -> SceneKey:
    dotted = ".".join(printable(str(each), 60) for each in keys)
    for annotation in alternatives(outer.annotation):
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            for name, field in annotation.model_fields.items():
                if part == (field.alias or name):
                    return SceneKey(keys, field.annotation, field)
            raise SceneError(
                unknown_key(SceneConfig, [printable(str(each), 60) for each in keys]), key=dotted
            )
        if get_origin(annotation) in (dict, Mapping):
            names, values = get_args(annotation)
            check_name(part, names, dotted)
            return SceneKey(keys, values)
        if get_origin(annotation) in (tuple, list) and str(part).isdecimal():
            items = get_args(annotation)
            item = items[0] if items[-1] is ... else items[min(int(part), len(items) - 1)]
            return SceneKey((*keys[:-1], int(part)), item)
    raise SceneError("this is a single value: it has no keys", key=dotted)


def check_name(name: Any, annotation: Any = str, key: str | None = None) -> None:
    """Raise SceneError for a name that a section cannot have. ``annotation``: type of names."""
    try:
        if not isinstance(name, str):
            raise SceneError(f"a name must be a text; found {show_value(name)}", key=key)
        if len(name) > MAX_NAME:
            raise SceneError(f"a name has at most {MAX_NAME} characters, not {len(name)}", key=key)
        TypeAdapter(annotation).validate_python(name)
    except ValidationError:
        raise SceneError(f"{needed(annotation)}; found {show_value(name)}", key=key) from None


def plain(value: Any, key: str) -> Any:
    """Value as data that a scene file can hold.

    Args:
        value: None, booleans, numbers, texts, arrays, lists and mappings of these.
        key: Its key, for errors.

    Raises:
        SceneError: A number is not finite, or a value is too long or of another kind.
    """
    count = 0

    def convert(part: Any, depth: int) -> Any:
        nonlocal count
        count += 1
        if depth > _MAX_DEPTH or count > _MAX_VALUES:
            raise SceneError("this value has too many levels or parts", key=key)
        if isinstance(part, (np.ndarray, np.generic)):
            part = part.tolist()
        if part is None or isinstance(part, bool):
            return part
        if isinstance(part, int):
            if abs(part) > 1e300:
                raise SceneError("this number is too large", key=key)
            return int(part)
        if isinstance(part, float):
            if not math.isfinite(part):
                raise SceneError(f"give a number; found {part}", key=key)
            return int(part) if part == int(part) and abs(part) < 1e15 else float(part)
        if isinstance(part, str):
            if len(part) > MAX_TEXT:
                raise SceneError(f"a text has at most {MAX_TEXT} characters, not {len(part)}", key=key)
            return str(part)
        if isinstance(part, Mapping):
            return {str(convert(name, depth + 1)): convert(item, depth + 1) for name, item in part.items()}
        if isinstance(part, (list, tuple)):
            return [convert(item, depth + 1) for item in part]
        raise SceneError(f"a scene file cannot hold {show_value(part)}", key=key)

    return convert(value, 0)


def metres(value: Any) -> Any:
    """Metres as they are written: rounded to 1e-4."""
    return _rounded(value, 4)


def degrees(value: Any) -> Any:
    """Degrees as they are written: rounded to 0.01, from -180 to 180."""
    return _rounded((np.asarray(value, dtype=float) + 180) % 360 - 180, 2)


def _rounded(value: Any, digits: int) -> Any:
    return (np.round(np.asarray(value, dtype=float), digits) + 0.0).tolist()


def alternatives(annotation: Any) -> Iterator[Any]:
    """Types of an annotation without metadata, None and unions."""
    if get_origin(annotation) is Annotated:
        yield from alternatives(get_args(annotation)[0])
    elif get_origin(annotation) in (Union, types.UnionType):
        for part in get_args(annotation):
            yield from alternatives(part)
    elif annotation is not type(None):
        yield annotation


def _models(annotation: Any) -> Iterator[type[BaseModel]]:
    for part in alternatives(annotation):
        if isinstance(part, type) and issubclass(part, BaseModel):
            yield part
