"""Base model and value types for the schemas of all YAML files."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, ClassVar, cast

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
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

from humansim_ros.errors import SceneError
from humansim_ros.files.yaml.schema_messages import Expected, schema_error

if TYPE_CHECKING:
    from pydantic._internal._model_construction import ModelMetaclass
else:
    ModelMetaclass = type(BaseModel)


#: Keys of a schema with content that is no schema.
_NO_SCHEMAS = ("default", "metadata", "serialization")


def _refusing_booleans(part: Any) -> Any:
    """Add a check before each number of a schema, which refuses booleans."""
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
            raise schema_error(reason, cast("type[BaseModel]", cls), SceneError) from None


class Section(Checked, metaclass=_SectionType):
    """Mapping of a YAML file. Unknown keys and numbers that are not finite are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, defer_build=True)
    #: For each key of this section: words that people use for the key, separated by spaces, in addition to
    #: those of config/other_words.json.
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


#: A path. If the key allows it, the name of a built-in. Relative paths start from the folder of the scene.
FileName = Annotated[str, AfterValidator(NamedFile), Expected("a name or path", "names or paths")]


def one_or_more(schema: dict[str, Any]) -> None:
    """Let the JSON schema of a list accept a single item of the list, too."""
    options = schema.pop("anyOf", None) or [
        {key: schema.pop(key) for key in ("type", "items", "maxItems") if key in schema}
    ]
    item = next(each["items"] for each in options if "items" in each)
    schema["anyOf"] = [*options, item]


def alone_in_list(value: Any) -> Any:
    """Put a single text or section into a list."""
    return (value,) if isinstance(value, (str, dict)) else value


class ShortSection(Section):
    """Section that can be written as a single text. The text is the value of one of its keys, such as the
    name of its file."""

    #: The key with this value.
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
