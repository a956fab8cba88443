"""Descriptions of humans (YAML): what they are made from, and how they look."""

from __future__ import annotations

import os
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, ValidationError, model_validator

from humansim_ros.errors import MeshError
from humansim_ros.humans.human import Skinning
from humansim_ros.humans.makehuman.paint import Outfit
from humansim_ros.humans.makehuman.shape import MakeHumanConfig
from humansim_ros.io.yaml import read_yaml, validation_error

Name = Annotated[str, StringConstraints(pattern=r"^[A-Za-z][A-Za-z0-9_-]*$")]
Axis = Annotated[str, StringConstraints(pattern=r"^[+-]?[xyz]$")]
Byte = Annotated[int, Field(ge=0, le=255)]
Color = tuple[Byte, Byte, Byte]


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Clothes(_Section):
    """How a mesh looks: a texture, or a colour for what would be skin, hair, shirt, trousers and shoes."""

    texture: str | None = Field(default=None, description="a PNG or JPEG file, from the folder of this file")
    skin: Color = (208, 158, 130)
    hair: Color = (62, 44, 34)
    shirt: Color = (88, 120, 158)
    trousers: Color = (58, 62, 78)
    shoes: Color = (44, 38, 36)


#: Looks of a mesh that brings none, so that a grey export looks dressed (a detector finds it so).
DRESSED = {
    "blue": Clothes(),
    "red": Clothes(
        skin=(150, 104, 78), hair=(28, 24, 24), shirt=(168, 58, 52), trousers=(96, 84, 66), shoes=(70, 46, 30)
    ),
    "green": Clothes(
        skin=(232, 190, 166),
        hair=(140, 96, 54),
        shirt=(70, 124, 78),
        trousers=(44, 46, 52),
        shoes=(120, 116, 110),
    ),
}


class MeshHuman(_Section):
    """How a mesh becomes a human."""

    mesh: str = Field(default="", description=".obj, .gltf, .glb, or an SMPL model (.npz)")
    betas: tuple[float, ...] = Field(default=(), max_length=400, description="shape of an SMPL model")
    rigging: Literal["heat", "thesis"] = Field(
        default="heat", description="how an unrigged mesh gets its weights"
    )
    skeleton: Literal["fitted", "general"] = Field(
        default="fitted", description="joints found in the mesh, or those of the general skeleton"
    )
    unit: float | None = Field(default=None, gt=0, le=1e6, description="metres per unit of the file")
    stature: float | None = Field(default=None, ge=0.2, le=5, description="height of the person, metres")
    up: Axis | None = Field(default=None, description="the file's up axis; found by itself if absent")
    facing: Axis | None = Field(
        default=None, description="the file's axis that the person faces; found by itself if absent"
    )
    skinning: Skinning | None = Field(default=None, description="linear, if absent, or dual_quaternion")
    outfits: dict[Name, Clothes] = Field(default_factory=dict, description="the first is worn by itself")

    @model_validator(mode="after")
    def _one_size(self) -> MeshHuman:
        if self.unit is not None and self.stature is not None:
            raise ValueError("give unit or stature, not both")
        return self


class ParametricHuman(_Section):
    """A person made of MakeHuman's sliders."""

    makehuman: MakeHumanConfig
    outfits: dict[Name, Outfit] = Field(min_length=1, description="the first is worn by itself")
    skinning: Skinning | None = Field(default=None, description="linear, if absent, or dual_quaternion")


def read_description(path: str | os.PathLike[str]) -> MeshHuman | ParametricHuman:
    """Read a description. Raises MeshError with file, line and key."""
    data, tree = read_yaml(path, MeshError, "human")
    if not isinstance(data, dict) or ("mesh" in data) == ("makehuman" in data):
        raise MeshError("a human is described by 'mesh' or by 'makehuman', one of them", path=path)
    model: type[MeshHuman | ParametricHuman] = MeshHuman if "mesh" in data else ParametricHuman
    try:
        return model.model_validate(data)
    except ValidationError as reason:
        known = f"; known here: {', '.join(model.model_fields)}"
        raise validation_error(
            reason, tree, MeshError, path, lambda keys: known if len(keys) == 1 else ""
        ) from None
