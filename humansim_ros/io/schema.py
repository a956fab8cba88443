"""Base model and value types that the schemas of all YAML files share."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, StringConstraints


class Section(BaseModel):
    """Mapping of a YAML file; unknown keys and numbers that are not finite are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


Byte = Annotated[int, Field(ge=0, le=255)]
#: Red, green, blue; sRGB.
ByteColor = tuple[Byte, Byte, Byte]
#: Fraction of a whole.
Share = Annotated[float, Field(ge=0, le=1)]
#: Axis of a file, such as ``y`` or ``-z``.
Axis = Annotated[str, StringConstraints(pattern=r"^[+-]?[xyz]$")]
