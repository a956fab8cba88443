"""Human descriptions (YAML): a mesh or MakeHuman sliders, and outfits."""

from __future__ import annotations

import os
from typing import Annotated, Literal

from pydantic import Field, StringConstraints, model_validator

from humansim_ros.errors import MeshError
from humansim_ros.files.yaml import Axis, ByteColor, Expected, Section, read_yaml, validated
from humansim_ros.people.humans.human import Skinning
from humansim_ros.people.makehuman.shape import MakeHumanConfig, Outfit

OutfitName = Annotated[
    str,
    StringConstraints(pattern=r"^[A-Za-z][A-Za-z0-9_-]*$"),
    Expected("a name of letters, digits, _ and - that begins with a letter"),
]


class Clothes(Section):
    """Outfit of a mesh: a texture, or the colours of skin, hair, shirt, trousers and shoes."""

    texture: str | None = Field(default=None, description="a PNG or JPEG file, from the folder of this file")
    skin: ByteColor = (208, 158, 130)
    hair: ByteColor = (62, 44, 34)
    shirt: ByteColor = (88, 120, 158)
    trousers: ByteColor = (58, 62, 78)
    shoes: ByteColor = (44, 38, 36)


_Metres = Annotated[float, Field(ge=-10, le=10)]
#: Point in body space: x to the person's left, y up, z forward, metres.
BodyPoint = tuple[_Metres, _Metres, _Metres]

#: Outfits for a mesh without colours. With them, person detectors recognise it.
DEFAULT_OUTFITS = {
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


class MeshHuman(Section):
    """Human made from a mesh."""

    mesh: str = Field(default="", description="mesh file (.obj, .glb, .ply, .stl …), or an SMPL model (.npz)")
    betas: tuple[float, ...] = Field(default=(), max_length=400, description="shape of an SMPL model")
    rigging: Literal["heat", "thesis"] = Field(
        default="heat", description="rigging method of a mesh without skeleton"
    )
    skeleton: Literal["fitted", "general"] = Field(
        default="fitted", description="detected joints, or joints of the general skeleton"
    )
    joints: dict[str, BodyPoint] = Field(
        default_factory=dict,
        description="joints of the skeleton at other places than detected, in body space",
    )
    unit: float | None = Field(default=None, gt=0, le=1e6, description="metres per unit of the file")
    stature: float | None = Field(default=None, ge=0.2, le=5, description="height of the person, metres")
    up: Axis | None = Field(default=None, description="the file's up axis; detected if absent")
    facing: Axis | None = Field(
        default=None, description="the file's axis that the person faces; detected if absent"
    )
    skinning: Skinning | None = Field(default=None, description="linear, if absent, or dual_quaternion")
    outfits: dict[OutfitName, Clothes] = Field(default_factory=dict, description="the first is the default")

    @model_validator(mode="after")
    def _one_size(self) -> MeshHuman:
        if self.unit is not None and self.stature is not None:
            raise ValueError("give unit or stature, not both")
        return self


class ParametricHuman(Section):
    """Human made from MakeHuman sliders."""

    makehuman: MakeHumanConfig
    outfits: dict[OutfitName, Outfit] = Field(min_length=1, description="the first is the default")
    skinning: Skinning | None = Field(default=None, description="linear, if absent, or dual_quaternion")


def read_description(path: str | os.PathLike[str]) -> MeshHuman | ParametricHuman:
    """Read a human description. Raises MeshError with file, line and key."""
    data, tree = read_yaml(path, MeshError, "human")
    if not isinstance(data, dict) or ("mesh" in data) == ("makehuman" in data):
        raise MeshError("a human description needs exactly one of the keys 'mesh' and 'makehuman'", path=path)
    model: type[MeshHuman | ParametricHuman] = MeshHuman if "mesh" in data else ParametricHuman
    return validated(model, data, MeshError, path, tree)
