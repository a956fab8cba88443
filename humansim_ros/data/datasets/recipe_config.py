"""Content of a recipe file."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, StringConstraints, field_validator

from humansim_ros.data.datasets.draws import MAX_OPTIONS
from humansim_ros.files.yaml import Expected, Section, Share
from humansim_ros.scene.config import AboutConfig, checked_license

#: Most scenes of a data set, and frames of a scene.
MAX_SCENES, MAX_SCENE_FRAMES = 1_000_000, 100_000

_Name = Annotated[
    str,
    StringConstraints(pattern=r"^[A-Za-z][A-Za-z0-9_-]*$", max_length=60),
    Expected("a name of letters, digits, - and _ that begins with a letter"),
]
_Split = Annotated[
    str,
    StringConstraints(pattern=r"^[a-z][a-z0-9_]*$", max_length=40),
    Expected("a name of small letters, digits and _"),
]


class DataSetAbout(AboutConfig):
    """What a data card says about a data set of many scenes."""

    license: str | None = Field(default=None, description="licence, such as CC-BY-4.0, or its address")

    _license_is_a_line = field_validator("license")(checked_license)


class RingConfig(Section):
    """Cameras around the people. All values may be distributions. The names are ``camera_1`` and so on."""

    count: Any = Field(default=4, description="number of cameras")
    radius: Any = Field(description="metres from the point that they look at; drawn for each camera")
    height: Any = Field(description="metres above the floor; drawn for each camera")
    look_at: Any = Field(default=[0, 0, 0.9], description="a point in map; drawn for each camera")
    scatter_deg: Any = Field(default=0, description="most degrees from even places on the ring")
    camera: dict[str, Any] = Field(default_factory=dict, description="keys of all cameras, drawn once")
    each: dict[str, Any] = Field(default_factory=dict, description="keys drawn for each camera")


class RequireConfig(Section):
    """Conditions that each scene must fulfil. A scene that does not is drawn again."""

    cameras: int = Field(default=0, ge=0, le=100, description="cameras that see each person in each frame")
    visible: Share = Field(default=0.1, description="visible share of a person from which a camera sees it")
    pixels: float = Field(default=0, ge=0, le=1e5, description="height in the image from which it does")
    clean: bool = Field(default=False, description="neither warnings nor findings of humansim check")


class RecipeConfig(Section):
    """Content of a recipe file."""

    recipe: _Name = Field(description="name of the data set")
    seed: int = Field(default=1, ge=0, description="the same seed gives the same data set")
    scenes: int = Field(ge=1, le=MAX_SCENES, description="number of scenes")
    frames: int = Field(ge=1, le=MAX_SCENE_FRAMES, description="frames of each scene, from its start")
    splits: dict[_Split, Annotated[float, Field(ge=0, le=1e9)]] = Field(
        default_factory=lambda: {"train": 1.0},
        min_length=1,
        max_length=20,
        description="shares of the scenes",
    )
    formats: tuple[str, ...] = Field(default=(), description="formats beside images (docs/export.md)")
    keypoints: str = Field(default="coco17", description="keypoint set")
    images: Literal["png", "jpg"] = Field(default="png", description="format of the images")
    pool: int | None = Field(
        default=None,
        ge=1,
        le=MAX_OPTIONS,
        description="number of different people whom variety.people draws; new ones in each scene if absent",
    )
    attempts: int = Field(default=20, ge=1, le=10_000, description="draws of a scene before it is given up")
    about: DataSetAbout = DataSetAbout()
    require: RequireConfig = RequireConfig()
    ring: RingConfig | None = Field(default=None, description="cameras around the people")
    scene: dict[str, Any] = Field(description="keys of a scene; each value may be a distribution")

    @field_validator("splits")
    @classmethod
    def _has_splits(cls, splits: dict[str, float]) -> dict[str, float]:
        if not sum(splits.values()) > 0:
            raise ValueError("the shares sum to 0: no scene has a split")
        return splits
