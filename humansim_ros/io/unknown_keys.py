"""Unknown keys of a file: the key that was probably meant, or the section that it belongs to."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, get_args

from pydantic import BaseModel

from humansim_ros.errors import near_names

#: Least similarity to a key of the same section: before the same key of another section, and after it.
_VERY_NEAR, _NEAR = 0.8, 0.6
#: Most sections that a message names, and depth of sections.
_MOST_PLACES, _DEPTH = 3, 6


def unknown_key(model: type[BaseModel], keys: Sequence[Any]) -> str:
    """Message about an unknown key.

    Args:
        model: Model of the file.
        keys: Keys from the top of the file to the unknown one.
    """
    section = _section_at(model, keys[:-1])
    known = key_names(section)
    hint = _hint(model, section, keys)
    listed = ", ".join(known)
    return f"unknown key; {hint} Known here: {listed}" if hint else f"unknown key; known here: {listed}"


def _hint(model: type[BaseModel], section: type[BaseModel], keys: Sequence[Any]) -> str:
    name = str(keys[-1])
    word = name.lower().replace("-", "_").replace(" ", "_")
    known = key_names(section)
    meant = next((key for key in known if key.lower() == word), None) or _other_words(section).get(word)
    meant = meant or next(iter(near_names(word, known, _VERY_NEAR)), None)
    if meant:
        return f"did you mean `{meant}`?"
    places: dict[str, list[str]] = {}
    nearest = None
    for place, other in sorted(_sections(model, ""), key=lambda pair: _distance(pair[0], keys)):
        found = name if name in key_names(other) else _other_words(other).get(word)
        distance = _distance(place, keys)
        if found and other is not section and (nearest is None or distance <= nearest + 1):
            nearest = distance if nearest is None else nearest
            places.setdefault(found, []).append(_actual(place, keys) or "the top of the file")
    if name in places:
        return f"`{name}` belongs to {_some(places[name])}."
    if places:
        found, where = next(iter(places.items()))
        return f"did you mean `{found}`, which belongs to {_some(where)}?"
    meant = next(iter(near_names(word, known, _NEAR)), None)
    return f"did you mean `{meant}`?" if meant else ""


def _some(places: Sequence[str]) -> str:
    return either(list(dict.fromkeys(places))[:_MOST_PLACES])


def either(texts: Sequence[str]) -> str:
    """Different texts as alternatives: ``a, b or c``."""
    unique = list(dict.fromkeys(texts))
    return unique[0] if len(unique) == 1 else f"{', '.join(unique[:-1])} or {unique[-1]}"


def key_names(section: type[BaseModel]) -> list[str]:
    """Keys of a section, as files have them."""
    return [info.alias or name for name, info in section.model_fields.items()]


def _other_words(section: type[BaseModel]) -> dict[str, str]:
    """Keys of a section by the words that others use for them."""
    by_key: dict[str, str] = getattr(section, "other_words", {})
    return {word: key for key, words in by_key.items() for word in words.split()}


def _section_at(model: type[BaseModel], keys: Sequence[Any]) -> type[BaseModel]:
    """Section of a path of keys; keys that are names of humans, cameras … or numbers do not change it."""
    for key in keys:
        if key in model.model_fields:
            model = next(_models(model.model_fields[key].annotation), model)
    return model


def _sections(model: type[BaseModel], place: str) -> Iterator[tuple[str, type[BaseModel]]]:
    """Place and model of each section: ``humans.<name>.motion``."""
    yield place, model
    if place.count(".") > _DEPTH:
        return
    for name, info in model.model_fields.items():
        for inner in _models(info.annotation):
            named = f"{name}.<name>" if "dict[" in str(info.annotation) else name
            yield from _sections(inner, f"{place}.{named}".removeprefix("."))


def _models(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for inner in get_args(annotation):
        yield from _models(inner)


def _common(place: str, keys: Sequence[Any]) -> int:
    """Number of parts of a place that the keys share."""
    shared = 0
    for part, key in zip(place.split("."), keys[:-1], strict=False):
        if part not in ("<name>", str(key)):
            break
        shared += 1
    return shared


def _distance(place: str, keys: Sequence[Any]) -> int:
    """Number of sections between a place and the section of the unknown key."""
    length = len(place.split(".")) if place else 0
    return length + len(keys) - 1 - 2 * _common(place, keys)


def _actual(place: str, keys: Sequence[Any]) -> str:
    """A place with the names that the keys have."""
    parts, shared = place.split("."), _common(place, keys)
    return ".".join([*(str(key) for key in keys[:shared]), *parts[shared:]])
