"""Base model and value types that the schemas of all YAML files share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

from pydantic import BaseModel, ConfigDict, Field, StringConstraints


class Section(BaseModel):
    """Mapping of a YAML file; unknown keys and numbers that are not finite are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    #: Words that others use for keys of this section, separated by spaces, by key.
    other_words: ClassVar[dict[str, str]] = {}


@dataclass(frozen=True)
class Expected:
    """What a value must be, for error messages; for use in ``Annotated``.

    ``one``: such as ``an axis``. ``many``: of several such values, such as ``axes``.
    """

    one: str
    many: str = ""


Byte = Annotated[int, Field(ge=0, le=255)]
#: Red, green, blue; sRGB.
ByteColor = tuple[Byte, Byte, Byte]
#: Fraction of a whole.
Share = Annotated[float, Field(ge=0, le=1)]
#: Axis of a file, such as ``y`` or ``-z``.
Axis = Annotated[
    str,
    StringConstraints(pattern=r"^[+-]?[xyz]$"),
    Expected("an axis, such as y or -z", "axes, such as y or -z"),
]
