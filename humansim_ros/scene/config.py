"""The scene file: which humans, motions and cameras there are (YAML, checked key by key)."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, ValidationError, model_validator

from humansim_ros.errors import SceneError
from humansim_ros.io.files import resolve_relative
from humansim_ros.io.schema import Axis, ByteColor, Section
from humansim_ros.io.yaml import line_of, read_yaml, validation_error
from humansim_ros.render.lighting import Lighting
from humansim_ros.render.make import RendererName
from humansim_ros.resources import resource_path
from humansim_ros.sensor.config import SensorConfig

Vector3 = tuple[float, float, float]
Row4 = tuple[float, float, float, float]
#: Metres or degrees; what is beyond is a mistake.
Bounded = Annotated[float, Field(ge=-1e6, le=1e6)]
#: Linear light.
LinearColor = tuple[
    Annotated[float, Field(ge=0, le=1e4)],
    Annotated[float, Field(ge=0, le=1e4)],
    Annotated[float, Field(ge=0, le=1e4)],
]
Size = Annotated[float, Field(gt=0, le=1e6)]
#: Names become parts of ROS topics and frames.
Name = Annotated[str, StringConstraints(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")]


class MotionConfig(Section):
    """What a human does."""

    file: str = Field(
        default="walk", description="a motion that comes with the package (walk), or a BVH file"
    )
    joint_names: str | None = Field(
        default=None, description="joint table: a built-in name or a YAML file; found by itself if absent"
    )
    unit: float | None = Field(
        default=None, gt=0, description="metres per file unit; found by itself if absent"
    )
    position: tuple[float, float] = Field(
        default=(0.0, 0.0), description="where the anchor goes: x, y in map, metres"
    )
    yaw_deg: float = Field(
        default=0.0, description="heading of the motion's forward direction, degrees from +x to the left"
    )
    anchor: Literal["start", "center", "file"] = Field(default="start", description="what goes to position")
    loop: Literal["none", "repeat", "continue"] = Field(
        default="repeat", description="what follows the last frame"
    )
    offset: float = Field(default=0.0, description="seconds of the scene that the motion is ahead by")
    start: float = Field(default=0.0, ge=0, description="where in the file it starts, seconds of the file")
    end: float | None = Field(
        default=None, gt=0, description="where in the file it ends, seconds of the file; its end if absent"
    )
    speed: float = Field(default=1.0, ge=0, le=100, description="seconds of the file per second")
    blend: float = Field(
        default=0.0, ge=0, description="seconds of the file over which the end fades into the next start"
    )
    mirror: bool = Field(default=False, description="left and right change sides")
    up: Axis | None = Field(default=None, description="the file's up axis; found by itself if absent")
    facing: Axis | None = Field(
        default=None, description="the file's axis that the person faces at rest; found by itself if absent"
    )
    positions: Literal["auto", "replace", "add"] = Field(
        default="auto", description="whether position channels replace the OFFSET or are added to it"
    )
    retarget: Literal["full", "thesis"] = Field(
        default="full", description="whole rotations with twist, or the thesis' bones parallel to links only"
    )
    root_scale: Literal["height", "legs"] | Annotated[float, Field(gt=0, le=100)] | None = Field(
        default=None,
        description="what the root's way is scaled by: legs (if absent; height with retarget: thesis), "
        "height, or a number",
    )
    clamp: bool = Field(default=False, description="bones are kept within the limits of their joints")
    pin_feet: bool = Field(default=False, description="feet that stand are kept from sliding")


class KeyframesConfig(Section):
    """What moves, turns and sizes a human or an object: a file, and which of its objects."""

    file: str = Field(description="a keyframe animation file (XML)")
    object: str | None = Field(
        default=None, description="name in that file; that of the human or object if absent"
    )

    @model_validator(mode="before")
    @classmethod
    def _file_alone(cls, value: Any) -> Any:
        return {"file": value} if isinstance(value, str) else value


class HumanConfig(Section):
    """One person."""

    body: str = Field(
        default="adult_man",
        description="a body that comes with the package, or a file: .npz, .yaml, .obj, .gltf, .glb",
    )
    outfit: str | None = Field(default=None, description="what it wears; the body's first outfit if absent")
    skinning: Literal["linear", "dual_quaternion"] | None = Field(
        default=None, description="how skin follows bones; as the body says if absent"
    )
    motion: MotionConfig = MotionConfig()
    keyframes: KeyframesConfig | None = Field(
        default=None, description="moves, turns and sizes the person on top of the motion"
    )


class ObjectConfig(Section):
    """A thing that stands in the scene or moves."""

    mesh: str = Field(default="box", description="box, sphere, cylinder, or an .obj file (z up, metres)")
    color: ByteColor = Field(default=(170, 150, 130), description="red, green, blue; 0 to 255")
    size: tuple[Size, Size, Size] = Field(
        default=(1.0, 1.0, 1.0), description="along its own x, y, z: metres for a built-in mesh, else factors"
    )
    position: tuple[Bounded, Bounded, Bounded] = Field(
        default=(0.0, 0.0, 0.0), description="where its middle goes (the origin of a file)"
    )
    rotation_deg: tuple[Bounded, Bounded, Bounded] = Field(
        default=(0.0, 0.0, 0.0), description="degrees about the x axis of map, then y, then z"
    )
    keyframes: KeyframesConfig | None = Field(default=None, description="moves, turns and sizes it")
    label: bool = Field(default=False, description="it has an instance label, as humans have")


class TrajectoryConfig(Section):
    """What moves a camera."""

    file: str = Field(description="a trajectory in the form of the TUM RGB-D benchmark")
    end: Literal["clamp", "loop", "ping_pong"] = Field(
        default="clamp", description="after the last pose: it stays, begins anew, or goes back"
    )
    offset: float = Field(default=0.0, description="seconds of the scene that it is ahead by")
    speed: float = Field(default=1.0, ge=0, le=100, description="seconds of the file per second")

    @model_validator(mode="before")
    @classmethod
    def _file_alone(cls, value: Any) -> Any:
        return {"file": value} if isinstance(value, str) else value


class RegionConfig(Section):
    """A part of the sensor, in its pixels."""

    x: int = Field(default=0, ge=0)
    y: int = Field(default=0, ge=0)
    width: int = Field(gt=0)
    height: int = Field(gt=0)


class CameraConfig(Section):
    """One camera: what it sees by (fov_deg, K, P or calibration), and where it is (position and look_at, R
    and t, trajectory, P or calibration).
    """

    model_config = ConfigDict(coerce_numbers_to_str=True)  # files call their cameras 0, 1, 2

    size: tuple[int, int] | None = Field(
        default=None, description="width, height in pixels; as the calibration says, else 640, 480"
    )
    calibration: str | None = Field(
        default=None, description="a calibration file, or file:// or package:// URL"
    )
    camera: str | None = Field(default=None, description="which camera of that file; its only one if absent")
    unit: float | None = Field(
        default=None, gt=0, description="metres per unit of that file; as its form has it if absent"
    )
    up_axis: Axis | None = Field(
        default=None, description="the axis of that file that points up; as its form has it if absent"
    )
    position: Vector3 | None = None
    look_at: Vector3 | None = None
    up: Vector3 = Field(default=(0.0, 0.0, 1.0), description="what is up in the image; goes with look_at")
    fov_deg: float | None = Field(
        default=None, gt=0, lt=180, description="horizontal field of view (without the lens' distortion)"
    )
    K: tuple[Vector3, Vector3, Vector3] | None = None
    R: tuple[Vector3, Vector3, Vector3] | None = None
    t: Vector3 | None = None
    P: tuple[Row4, Row4, Row4] | None = None
    distortion: tuple[float, ...] = Field(default=(), description="coefficients, in ROS's order")
    distortion_model: Literal["plumb_bob", "rational_polynomial", "equidistant"] | None = Field(
        default=None, description="found by the number of coefficients if absent"
    )
    rectification: tuple[Vector3, Vector3, Vector3] | None = Field(
        default=None, description="R of CameraInfo: turns the optical frame to that of image_rect"
    )
    rectified: tuple[Row4, Row4, Row4] | None = Field(
        default=None, description="P of CameraInfo, with the baseline of a stereo camera"
    )
    trajectory: TrajectoryConfig | None = Field(default=None, description="a file that moves it")
    binning: tuple[int, int] = Field(
        default=(1, 1), description="pixels of the sensor per pixel along x and y"
    )
    roi: RegionConfig | None = Field(default=None, description="the part of the sensor that is sent")
    sensor: SensorConfig = Field(default=SensorConfig(), description="what the sensor does to the picture")
    background: str | None = Field(
        default=None, description="a photograph that shows where nothing is; as the world has it if absent"
    )

    @model_validator(mode="after")
    def _one_way(self) -> CameraConfig:
        whole = self.calibration is not None or self.P is not None
        seeing = {"fov_deg": self.fov_deg, "K": self.K, "P": self.P, "calibration": self.calibration}
        given = [key for key, value in seeing.items() if value is not None]
        if len(given) > 1:
            raise ValueError(
                f"what a camera sees by is given as {' and as '.join(given)}: give it in one of them"
            )
        for pair in (("position", "look_at"), ("R", "t")):
            if (getattr(self, pair[0]) is None) != (getattr(self, pair[1]) is None):
                raise ValueError(f"{pair[0]} and {pair[1]} go together: give the whole of it")
        standing = {"position, look_at": self.position, "R, t": self.R, "trajectory": self.trajectory}
        places = [key for key, value in standing.items() if value is not None]
        sources = [*places, "P"] if self.P is not None else places
        if len(sources) > 1:
            raise ValueError(
                f"where a camera is comes from {' and from '.join(sources)}: give it in one of them"
            )
        if not places and not whole:
            raise ValueError(
                "where is this camera? give position and look_at, or R and t, or a trajectory, or P, "
                "or a calibration file: one of them"
            )
        if whole and (self.distortion or self.distortion_model):
            raise ValueError("distortion goes with K or fov_deg only")
        if whole and (self.rectification or self.rectified):
            raise ValueError("rectification and rectified go with K or fov_deg only")
        if self.calibration is None and (self.camera or self.unit or self.up_axis):
            raise ValueError("camera, unit and up_axis go with a calibration file")
        return self


class RigConfig(Section):
    """All cameras of a calibration file."""

    model_config = ConfigDict(coerce_numbers_to_str=True)

    file: str = Field(description="a calibration file, or file:// or package:// URL")
    cameras: tuple[str, ...] | None = Field(
        default=None, min_length=1, description="which of that file; all if absent"
    )
    size: tuple[int, int] | None = Field(
        default=None, description="width, height in pixels where the file does not say"
    )
    unit: float | None = Field(
        default=None, gt=0, description="metres per unit of that file; as its form has it if absent"
    )
    up_axis: Axis | None = Field(
        default=None, description="the axis of that file that points up; as its form has it if absent"
    )
    binning: tuple[int, int] = Field(
        default=(1, 1), description="pixels of the sensor per pixel along x and y"
    )
    sensor: SensorConfig = Field(default=SensorConfig(), description="what their sensors do to the pictures")
    background: str | dict[str, str] | None = Field(
        default=None,
        description="a photograph for all, with {name} for the camera's name in the file, or one for each by "
        "that name; as the world has it if absent",
    )

    @model_validator(mode="before")
    @classmethod
    def _file_alone(cls, value: Any) -> Any:
        return {"file": value} if isinstance(value, str) else value


class RoomConfig(Section):
    """The furnished room."""

    size: tuple[float, float, float] = Field(
        default=(7.0, 6.4, 2.8), description="length along x, width along y, height; metres"
    )
    seed: int = Field(default=1, ge=0, description="another seed, another room")

    @model_validator(mode="after")
    def _big_enough(self) -> RoomConfig:
        if min(self.size[:2]) < 5.0 or max(self.size) > 100 or self.size[2] < 2.2:
            raise ValueError("the furniture needs a room of at least 5 x 5 x 2.2 m (and at most 100 m)")
        return self


class VarietyConfig(Section):
    """People drawn at random from a seed."""

    count: int = Field(ge=0, le=1000, description="how many people")
    seed: int = Field(default=1, ge=0, description="another seed, other people")
    name: Name = Field(default="person", description="they are called person_1, person_2 …")
    bodies: tuple[str, ...] | None = Field(
        default=None, min_length=1, description="bodies to draw from; the built-in ones if absent"
    )
    motions: tuple[str, ...] | None = Field(
        default=None, min_length=1, description="motions to draw from; built-in ones if absent"
    )
    area: tuple[Bounded, Bounded, Bounded, Bounded] | None = Field(
        default=None, description="where they go: x, y of two corners; the middle of the room if absent"
    )
    spacing: float = Field(default=0.9, ge=0, le=100, description="metres between any two at least")
    speed: tuple[Annotated[float, Field(gt=0, le=10)], Annotated[float, Field(gt=0, le=10)]] = Field(
        default=(0.9, 1.1), description="slowest and fastest, times the motion's own"
    )


class LightConfig(Section):
    """How everything is lit, and how that is shown. Colours are linear light: 1 shows a surface as it is."""

    mode: Literal["lit", "shadeless"] = Field(
        default="lit", description="shadeless: colours as they are, without light and shadow"
    )
    sun: Vector3 = Field(default=Lighting.sun, description="direction to the sun")
    sun_color: LinearColor = Field(default=Lighting.sun_color, description="light of the sun")
    sky_color: LinearColor = Field(
        default=Lighting.sky_color,
        description="light from above; with world.environment its mean, if absent",
    )
    ground_color: LinearColor = Field(
        default=Lighting.ground_color,
        description="light from below; with world.environment its mean, if absent",
    )
    strength: float = Field(default=1.0, ge=0, le=1e4, description="times all of these")
    shadows: Literal["contact", "soft", "none"] = Field(
        default="contact",
        description="contact: a dark patch on the floor under everybody; soft: of the sun, on everything",
    )
    sun_size_deg: float = Field(
        default=Lighting.sun_size_deg,
        gt=0,
        le=45,
        description="angle that the sun takes up in the sky: the larger, the softer its shadows",
    )
    tone_mapping: Literal["none", "filmic"] = Field(
        default="none", description="filmic: bright colours fade to white instead of being cut off"
    )
    exposure: float = Field(default=0.0, ge=-20, le=20, description="stops: one more is twice as bright")
    materials: bool = Field(
        default=True, description="skin and cloth answer light as such; false: all surfaces are matt"
    )

    ambient_occlusion: bool = Field(
        default=True,
        description="corners are darker: light from around does not reach where something stands",
    )

    @model_validator(mode="after")
    def _sun_somewhere(self) -> LightConfig:
        if not 1e-9 < sum(x * x for x in self.sun) < 1e18:
            raise ValueError("sun is a direction: it cannot be 0 0 0")
        return self


class WorldMeshConfig(Section):
    """A mesh file that stands in the world."""

    file: str = Field(description="an .obj, .gltf or .glb file, with its materials and textures")
    position: tuple[Bounded, Bounded, Bounded] = Field(
        default=(0.0, 0.0, 0.0), description="where its origin goes"
    )
    rotation_deg: tuple[Bounded, Bounded, Bounded] = Field(
        default=(0.0, 0.0, 0.0), description="degrees about the x axis of map, then y, then z"
    )
    scale: Size = Field(default=1.0, description="metres per unit of the file")
    up_axis: Literal["y", "z"] | None = Field(
        default=None, description="the file's axis that points up; y for glTF and z for OBJ, if absent"
    )

    @model_validator(mode="before")
    @classmethod
    def _file_alone(cls, value: Any) -> Any:
        return {"file": value} if isinstance(value, str) else value


class WorldConfig(Section):
    """What is around the people besides the room."""

    meshes: tuple[WorldMeshConfig, ...] = Field(default=(), description="mesh files that stand still")
    background: ByteColor | str | None = Field(
        default=None, description="where nothing is: red, green, blue, or a photograph for all cameras"
    )
    environment: str | None = Field(
        default=None, description="a panorama (.hdr) endlessly far away; its light is sky and ground light"
    )
    shadow_catcher: bool = Field(
        default=False, description="the ground z = 0 takes shadows where nothing is but a picture behind it"
    )
    environment_yaw_deg: Bounded = Field(
        default=0.0, description="turns the panorama to the left; at 0 its middle is along +x"
    )


class JitterConfig(Section):
    """How far cameras are moved and turned at random."""

    position: float = Field(default=0.0, ge=0, le=100, description="metres along each axis of map at most")
    rotation_deg: float = Field(
        default=0.0, ge=0, le=180, description="degrees about each axis of the camera at most"
    )


class RandomiseConfig(Section):
    """What is drawn at random from a seed."""

    seed: int = Field(default=1, ge=0, description="another seed, another draw; the same, the same")
    light: bool = Field(default=False, description="where the sun is, its colour, and that of sky and ground")
    colours: bool = Field(default=False, description="colours of the room, the world and standing objects")
    textures: bool = Field(default=False, description="patterns in place of their textures")
    clutter: int = Field(
        default=0, ge=0, le=1000, description="boxes, cylinders and balls on the floor, where nobody walks"
    )
    clutter_label: bool = Field(default=False, description="these have instance labels")
    camera_jitter: JitterConfig = JitterConfig()


class SceneConfig(Section):
    """A scene file."""

    rate: float = Field(default=30.0, gt=0, le=1000, description="frames per second")
    renderer: RendererName = Field(default="moderngl", description="what draws; pyrender to compare with")
    room: RoomConfig | None = Field(default=RoomConfig(), description="null for an empty world")
    humans: dict[Name, HumanConfig] = Field(default_factory=dict)
    variety: VarietyConfig | None = Field(default=None, description="more humans, drawn at random")
    objects: dict[Name, ObjectConfig] = Field(default_factory=dict)
    rig: RigConfig | None = Field(default=None, description="cameras of a calibration file")
    cameras: dict[Name, CameraConfig] = Field(default_factory=dict)
    world: WorldConfig = Field(default=WorldConfig(), description="mesh files, and what is behind them")
    light: LightConfig = Field(default=LightConfig(), description="light and shadows")
    randomise: RandomiseConfig | None = Field(default=None, description="looks drawn at random")

    @model_validator(mode="after")
    def _something_to_see(self) -> SceneConfig:
        if not self.cameras and self.rig is None:
            raise ValueError(
                "a scene needs at least one camera: in 'cameras', or in a calibration file as 'rig'"
            )
        labels = len(self.humans) + (self.variety.count if self.variety else 0)
        labels += sum(thing.label for thing in self.objects.values())
        if self.randomise is not None and self.randomise.clutter_label:
            labels += self.randomise.clutter
        if labels > 65535:
            raise ValueError(f"at most 65535 humans and labelled objects, not {labels}")
        return self


def load_config(path: str | os.PathLike[str]) -> SceneConfig:
    """Read and check a scene file. Raises SceneError with file, line and key."""
    data, tree = read_yaml(path, SceneError, "scene")
    if not isinstance(data, dict):
        raise SceneError("a scene is a mapping with 'humans' and 'cameras'", path=path)
    try:
        return SceneConfig.model_validate(data)
    except ValidationError as reason:
        raise validation_error(reason, tree, SceneError, path, _known_keys) from None


def _known_keys(keys: list[Any]) -> str:
    model: type[BaseModel] = SceneConfig
    for key in keys[:-1]:
        if key in model.model_fields:  # a name of a human or camera is none
            model = _section(model.model_fields[key].annotation) or model
    return f"; known here: {', '.join(model.model_fields)}"


def _section(annotation: Any) -> type[BaseModel] | None:
    """The section that a key's type is, has as an alternative, or maps names to."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((found for inner in get_args(annotation) if (found := _section(inner))), None)


def line_of_key(path: str | os.PathLike[str], key: str) -> int | None:
    """Line of a dotted key in a scene file, or of as much of it as is there; None if it cannot be read."""
    try:
        return line_of(read_yaml(path, SceneError, "scene")[1], key.split("."))
    except SceneError:
        return None


def built_in_names(folder: str, suffix: str) -> list[str]:
    """What there is in ``assets/<folder>``."""
    return sorted(path.stem for path in resource_path(f"assets/{folder}").glob(f"*{suffix}"))


def find_human(name: str, scene: Path, key: str) -> Path:
    """A built-in human, or a file with one; SceneError if there is none."""
    return find_file(name, "humans", ".npz", scene, key)


def find_file(name: str, folder: str, suffix: str, scene: Path, key: str) -> Path:
    """A file named in a scene: a built-in of ``assets/<folder>``, or a path from the scene's folder.

    Raises SceneError naming the scene file and ``key`` if there is no such file.
    """
    if name in built_in_names(folder, suffix):
        return resource_path(f"assets/{folder}") / f"{name}{suffix}"
    path, there = resolve_relative(scene, name)
    if not there:
        known = ", ".join(built_in_names(folder, suffix))
        where = f"no such file {str(path)!r}" if Path(name).suffix else f"no {name!r}"
        raise SceneError(f"{where}; the built-in {folder} are {known}", path=scene, key=key)
    return path
