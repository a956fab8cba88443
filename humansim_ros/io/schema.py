"""Base model and value types that the schemas of all YAML files share."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, ClassVar, cast

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, ValidationError

from humansim_ros.errors import SceneError
from humansim_ros.io.schema_errors import Expected, schema_error

if TYPE_CHECKING:
    from pydantic._internal._model_construction import ModelMetaclass
else:
    ModelMetaclass = type(BaseModel)


class _SectionType(ModelMetaclass):
    """Makes errors of constructors errors of this package; ``model_validate`` raises those of the library."""

    def __call__(cls, *values: Any, **keys: Any) -> Any:
        try:
            return super().__call__(*values, **keys)
        except ValidationError as reason:
            raise schema_error(reason, cast("type[BaseModel]", cls), SceneError) from None


class Section(BaseModel, metaclass=_SectionType):
    """Mapping of a YAML file; unknown keys and numbers that are not finite are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    #: Words that others use for keys of this section, separated by spaces, by key.
    other_words: ClassVar[dict[str, str]] = {}


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
