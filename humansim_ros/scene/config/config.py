"""Schema of scene files: sections, keys, defaults and limits; imports no renderer and no OpenCV."""

from __future__ import annotations

import datetime
import json
import os
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from pydantic import BeforeValidator, Field, StringConstraints, field_validator, model_validator

from humansim_ros.errors import MAX_FRAMES, SceneError, printable
from humansim_ros.files.yaml import (
    Axis,
    ByteColor,
    Expected,
    FileName,
    NamedFile,
    SceneName,
    Section,
    ShortSection,
    TopicName,
    alone_in_list,
    line_of,
    one_or_more,
    read_yaml,
    validated,
)
from humansim_ros.motion.files import MOTION_TITLES
from humansim_ros.render.interface import Lighting, RendererName
from humansim_ros.scene.config.camera_config import Bounded, BoundedVector3, CameraConfig, RigConfig, Vector3
from humansim_ros.scene.features.crowd import CrowdConfig
from humansim_ros.scene.features.face import FaceConfig
from humansim_ros.scene.features.hands import HandKeyConfig
from humansim_ros.scene.features.held import HoldConfig
from humansim_ros.scene.features.keyframes import KeyframesConfig
from humansim_ros.scene.features.reach import ReachConfig
from humansim_ros.scene.features.robot import ROBOT, RobotConfig
from humansim_ros.scene.features.room import RoomConfig
from humansim_ros.scene.features.scanners import ScannerConfig
from humansim_ros.scene.features.variety import VarietyConfig

if TYPE_CHECKING:
    import yaml


#: Address by which editors know the schema. It need not exist.
SCHEMA_ID = "https://humansim-ros.invalid/scene.schema.json"
#: Motion of a human that another node moves, such as live motion capture. It stands at rest until then.
LIVE = "live"
#: Key that makes a YAML file a recipe of many scenes, not a scene.
RECIPE = "recipe"
#: Most characters of a licence.
MAX_LICENSE = 200


_Radiance = Annotated[float, Field(ge=0, le=1e4)]
_LinearColor = tuple[_Radiance, _Radiance, _Radiance]
_Size = Annotated[float, Field(gt=0, le=1e6)]


#: Name of a ROS node, with or without its namespace.
_NodeName = Annotated[
    str,
    StringConstraints(pattern=r"^/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*$", max_length=255),
    Expected("the name of a node, such as tracker"),
]


class MotionConfig(ShortSection):
    """Motion of a human."""

    file: FileName = Field(
        default="walk",
        description="name of a built-in motion, an activity (activity#4), or a file "
        f"({MOTION_TITLES}); live: joints from another ROS node",
    )
    joint_names: FileName | None = Field(
        default=None, description="name of a built-in joint table, or a YAML file; detected if absent"
    )
    unit: float | None = Field(default=None, gt=0, description="metres per file unit; detected if absent")
    position: tuple[float, float] = Field(
        default=(0.0, 0.0), description="position of the anchor: x, y in map, metres"
    )
    yaw_deg: float = Field(
        default=0.0, description="heading of the motion's forward direction, degrees from +x to the left"
    )
    anchor: Literal["start", "center", "file"] = Field(
        default="start", description="the point that is placed at position"
    )
    loop: Literal["none", "repeat", "continue"] = Field(
        default="repeat", description="behaviour after the last frame"
    )
    offset: float = Field(default=0.0, description="time that the motion is ahead of the scene, seconds")
    start: float = Field(default=0.0, ge=0, description="first time that is played, seconds of the file")
    end: float | None = Field(
        default=None, gt=0, description="last time that is played, seconds of the file; its end if absent"
    )
    speed: float = Field(default=1.0, ge=0, le=100, description="seconds of the file per second")
    blend: float = Field(
        default=0.0,
        ge=0,
        description="time over which the end fades into the next start, seconds of the file",
    )
    mirror: bool = Field(default=False, description="exchange left and right")
    up: Axis | None = Field(default=None, description="up axis of the file; detected if absent")
    facing: Axis | None = Field(
        default=None, description="axis of the file that the person faces at rest; detected if absent"
    )
    positions: Literal["auto", "replace", "add"] = Field(
        default="auto", description="whether position channels replace the OFFSET or are added to it"
    )
    min_confidence: float | None = Field(
        default=None,
        ge=0,
        le=1,
        description="lowest confidence that the motion belongs to a person, 0.12 if absent; 0 for animals",
    )
    retarget: Literal["full", "thesis"] = Field(
        default="full", description="full rotations with twist, or bones parallel to links as in the thesis"
    )
    root_scale: Literal["height", "legs"] | Annotated[float, Field(gt=0, le=100)] | None = Field(
        default=None,
        description="scale of the root's path: legs (if absent; height with retarget: thesis), height, or a "
        "number",
    )
    clamp: bool = Field(default=False, description="clamp bones to the limits of their joints")
    pin_feet: bool = Field(default=False, description="keep standing feet from sliding")
    floor: Literal["soles", "skin"] | None = Field(
        default=None,
        description="what is on the floor: soles, or at each time the lowest skin, of somebody who lies or "
        "crawls; if absent, skin for lie, fall and crawl",
    )
    hands: Annotated[tuple[HandKeyConfig, ...] | None, BeforeValidator(alone_in_list)] = Field(
        default=None,
        max_length=1000,
        json_schema_extra=one_or_more,
        description="poses of the hands over time; if absent, hands are relaxed, open with a raised arm, and "
        "hold what a built-in motion holds",
    )


class HumanConfig(ShortSection):
    """One human."""

    short_key: ClassVar[str] = "body"

    body: FileName = Field(
        default="adult_man",
        description="name of a built-in human, or a file: .npz, .yaml, .obj, .glb, .vrm, .ply, .stl …",
    )
    outfit: str | None = Field(default=None, description="name of an outfit; the first if absent")
    skinning: Literal["linear", "dual_quaternion"] | None = Field(
        default=None, description="skinning function; as the human's file says if absent"
    )
    motion: MotionConfig = MotionConfig.model_construct()
    keyframes: KeyframesConfig | None = Field(
        default=None, description="move, rotate and scale the human on top of the motion"
    )
    face: FaceConfig | None = Field(
        default=None, description="move the face: life, expressions, gaze and speech; stiff if absent"
    )
    reach: tuple[ReachConfig, ...] = Field(
        default=(), max_length=1000, description="what the hands reach for over the time of the scene"
    )
    seat: Literal["chair", "none"] = Field(
        default="chair",
        description="chair: put a chair where the human sits on nothing, and a table in front of it if it "
        "writes or eats; none: put nothing there",
    )


class ObjectConfig(ShortSection):
    """One object, static or moving."""

    short_key: ClassVar[str] = "mesh"

    mesh: FileName = Field(
        default="box",
        description="box, sphere, cylinder, table, chair, door, screen, shelf, robot, doorway, door_leaf, "
        "cart, or a mesh file: .obj (z up, metres), .glb, .ply, .stl, .dae …",
    )
    color: ByteColor = Field(default=(170, 150, 130), description="red, green, blue; 0 to 255")
    size: tuple[_Size, _Size, _Size] = Field(
        default=(1.0, 1.0, 1.0),
        description="size along its own x, y, z: metres for box, sphere and cylinder, else factors",
    )
    position: BoundedVector3 = Field(
        default=(0.0, 0.0, 0.0),
        description="position of its center (of the origin of a file; of the floor of furniture)",
    )
    rotation_deg: BoundedVector3 = Field(
        default=(0.0, 0.0, 0.0), description="degrees about the x axis of map, then y, then z"
    )
    keyframes: KeyframesConfig | None = Field(default=None, description="move, rotate and scale the object")
    held_by: HoldConfig | None = Field(
        default=None,
        description="a human who holds it in both hands: position and rotation_deg are then in the frame "
        "between the palms (x ahead, y to the left hand); or who takes it along (by: path)",
    )
    label: bool = Field(default=False, description="give it an instance label, as humans have")

    @model_validator(mode="after")
    def _moves_in_one_way(self) -> ObjectConfig:
        if self.keyframes is not None and self.held_by is not None:
            raise ValueError("give keyframes or held_by, not both")
        return self


class LightConfig(Section):
    """Light, shadows and tone mapping. Colours are linear light: 1 shows a surface in its own colour."""

    mode: Literal["lit", "shadeless"] = Field(
        default="lit", description="shadeless: colours of surfaces without light and shadow"
    )
    sun: Vector3 = Field(default=Lighting.sun, description="direction to the sun")
    sun_color: _LinearColor = Field(default=Lighting.sun_color, description="light of the sun")
    sky_color: _LinearColor = Field(
        default=Lighting.sky_color,
        description="light from above; if absent, with world.environment the mean of its upper half",
    )
    ground_color: _LinearColor = Field(
        default=Lighting.ground_color,
        description="light from below; if absent, with world.environment the mean of its lower half",
    )
    strength: float = Field(default=1.0, ge=0, le=1e4, description="factor of all three")
    shadows: Literal["contact", "soft", "none"] = Field(
        default="contact",
        description="contact: a dark patch on the floor under each body; soft: shadows of the sun",
    )
    sun_size_deg: float = Field(
        default=Lighting.sun_size_deg,
        gt=0,
        le=45,
        description="angular diameter of the sun: the larger, the softer its shadows",
    )
    tone_mapping: Literal["none", "filmic"] = Field(
        default="none", description="filmic: bright colours fade to white instead of being clipped"
    )
    exposure: float = Field(
        default=0.0, ge=-20, le=20, description="exposure in stops: one more is twice as bright"
    )
    materials: bool = Field(
        default=True, description="materials of skin and cloth; false: all surfaces are matt"
    )

    ambient_occlusion: bool = Field(
        default=True, description="darken corners that less light from sky and ground reaches"
    )

    @model_validator(mode="after")
    def _has_sun_direction(self) -> LightConfig:
        if not 1e-9 < sum(x * x for x in self.sun) < 1e18:
            raise ValueError("sun is a direction: it must not be 0 0 0")
        return self


class WorldMeshConfig(ShortSection):
    """A static mesh file."""

    file: FileName = Field(
        description="a mesh file (.obj, .glb, .ply, .stl …), with its materials and textures"
    )
    position: BoundedVector3 = Field(default=(0.0, 0.0, 0.0), description="position of its origin")
    rotation_deg: BoundedVector3 = Field(
        default=(0.0, 0.0, 0.0), description="degrees about the x axis of map, then y, then z"
    )
    scale: _Size = Field(default=1.0, description="metres per unit of the file")
    up_axis: Literal["y", "z"] | None = Field(
        default=None, description="up axis of the file; if absent, as the format has it (z for OBJ, PLY, STL)"
    )


class WorldConfig(Section):
    """Static surroundings besides the room."""

    meshes: tuple[WorldMeshConfig, ...] = Field(default=(), description="static mesh files")
    background: ByteColor | FileName | None = Field(
        default=None, description="background: red, green, blue, or an image for all cameras"
    )
    environment: FileName | None = Field(
        default=None, description="panorama (.hdr) at infinity; its light is the light of sky and ground"
    )
    shadow_catcher: bool = Field(
        default=False, description="show shadows on the invisible ground z = 0 in front of a backdrop"
    )
    environment_yaw_deg: Bounded = Field(
        default=0.0, description="rotation of the panorama to the left, degrees; at 0 its center is along +x"
    )


class JitterConfig(Section):
    """Random changes of camera poses."""

    position: float = Field(default=0.0, ge=0, le=100, description="most metres along each axis of map")
    rotation_deg: float = Field(
        default=0.0, ge=0, le=180, description="most degrees about each axis of the camera"
    )


class RandomiseConfig(Section):
    """Random variations from a seed."""

    seed: int = Field(default=1, ge=0, description="the same seed gives the same variations")
    light: bool = Field(
        default=False, description="random direction and colour of the sun, random colours of sky and ground"
    )
    colours: bool = Field(
        default=False, description="random colours of the room, the world and static objects"
    )
    textures: bool = Field(default=False, description="random patterns instead of their textures")
    clutter: int = Field(
        default=0, ge=0, le=1000, description="number of random objects on the floor where nobody walks"
    )
    clutter_label: bool = Field(default=False, description="give these objects instance labels")
    camera_jitter: JitterConfig = JitterConfig.model_construct()


class MemberConfig(ShortSection):
    """A node or a topic that frames wait for."""

    short_key: ClassVar[str] = "node"

    node: _NodeName | None = Field(default=None, description="name of a node that reports on frame_done")
    topic: TopicName | None = Field(
        default=None, description="topic of any message type that begins with a header"
    )

    @model_validator(mode="after")
    def _is_one(self) -> MemberConfig:
        if (self.node is None) == (self.topic is None):
            raise ValueError("give the name of a node, such as tracker, or {topic: /tracker/poses}")
        return self


class TimeConfig(Section):
    """How time goes on: in real time, or in lockstep with all nodes (docs/lockstep.md)."""

    mode: Literal["realtime", "lockstep"] = Field(
        default="realtime",
        description="lockstep: the next frame waits until all nodes have finished this one",
    )
    wait_for: tuple[MemberConfig, ...] = Field(
        default=(),
        max_length=100,
        description="nodes that a frame waits for besides the cameras: names that report on frame_done, or "
        "topics as {topic: /tracker/poses}",
    )
    timeout: float = Field(
        default=30.0, ge=0.1, le=1e6, description="time after which a frame waits no longer, seconds"
    )
    on_timeout: Literal["stop", "continue"] = Field(
        default="stop", description="stop, or continue without the nodes that are late"
    )
    rate: float | None = Field(
        default=None,
        gt=0,
        le=1000,
        description="most frames per second of the wall clock; as fast as possible if absent",
    )
    frames: int | None = Field(
        default=None, ge=1, le=MAX_FRAMES, description="number of frames; without end if absent"
    )


def checked_license(text: str | None) -> str | None:
    """A licence without spaces around it. Raises ValueError if it is no line of text, or too long."""
    if text is None:
        return None
    if len(text) > MAX_LICENSE or text != printable(text, MAX_LICENSE):
        raise ValueError(f"a licence is one line of at most {MAX_LICENSE} characters, such as CC-BY-4.0")
    return text.strip()


_Line = Annotated[str, StringConstraints(min_length=1, max_length=2000)]


class AboutConfig(Section):
    """What a data card says of a data set: section ``about`` of a scene and of a recipe."""

    title: _Line | None = Field(default=None, description="title; the name of the file or recipe if absent")
    description: _Line | None = Field(default=None, description="what the data set is for")
    creators: tuple[_Line, ...] = Field(default=(), max_length=100, description="people or organisations")
    citation: _Line | None = Field(default=None, description="how to cite it, as text or BibTeX")
    date: (
        Annotated[
            str,
            BeforeValidator(lambda value: value.isoformat() if isinstance(value, datetime.date) else value),
            StringConstraints(pattern=r"^\d{4}-\d{2}-\d{2}$"),
            Expected("a date, such as 2026-11-28"),
        ]
        | None
    ) = Field(default=None, description="date of publication")
    version: Annotated[
        str,
        StringConstraints(pattern=r"^\d+\.\d+\.\d+$"),
        Expected("a text with three numbers, such as 1.0.0"),
    ] = Field(default="1.0.0", description="version of the data set")
    url: (
        Annotated[
            str,
            StringConstraints(pattern=r"^https?://\S+$", max_length=2000),
            Expected("an address, such as https://example.org"),
        ]
        | None
    ) = Field(default=None, description="address of its page")

    @field_validator("date")
    @classmethod
    def _is_a_day(cls, date: str | None) -> str | None:
        if date is not None:
            datetime.date.fromisoformat(date)
        return date


#: Name of a frame of tf.
_Frame = Annotated[
    str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_/]*$", max_length=255), Expected("a frame of tf, such as map")
]


class FramedConfig(ShortSection):
    """Messages of people in a frame of tf."""

    short_key: ClassVar[str] = "frame"

    frame: _Frame = Field(
        default="map", description="frame of the numbers: map, of a camera or scanner, or of the robot"
    )
    topic: TopicName | None = Field(default=None, description="topic in place of the usual one")


class TrackedConfig(FramedConfig):
    """Tracks of people."""

    camera: str | None = Field(
        default=None, description="camera that sees the people: others are occluded; none if absent"
    )


class BoxesConfig(Section):
    """Boxes of people in images."""

    cameras: tuple[str, ...] | None = Field(
        default=None, min_length=1, description="names of the cameras; all if absent"
    )
    box: Literal["visible", "whole"] = Field(
        default="visible", description="box of the visible pixels, or of the whole body"
    )
    topic: TopicName | None = Field(
        default=None, description="topic below the name of the camera in place of the usual one"
    )


class HriConfig(ShortSection):
    """People as a camera sees them, for ROS4HRI."""

    short_key: ClassVar[str] = "camera"

    camera: str = Field(description="camera that sees the people")


class AdaptersConfig(Section):
    """Messages for other people stacks; a key for each row of the table of adapters but ``hri``."""

    detections_2d: BoxesConfig | None = Field(default=None, description="vision_msgs/Detection2DArray")
    detections_3d: FramedConfig | None = Field(default=None, description="vision_msgs/Detection3DArray")
    people: FramedConfig | None = Field(default=None, description="people_msgs/People")
    tracked_persons: TrackedConfig | None = Field(
        default=None, description="spencer_tracking_msgs/TrackedPersons"
    )


class SceneConfig(Section):
    """Content of a scene file."""

    rate: float = Field(default=30.0, gt=0, le=1000, description="frames per second")
    renderer: RendererName = Field(default="moderngl", description="pyrender is for comparisons")
    room: RoomConfig | None = Field(
        default=RoomConfig.model_construct(), description="furnished room; null for none"
    )
    humans: dict[SceneName, HumanConfig] = Field(default_factory=dict)
    variety: VarietyConfig | None = Field(default=None, description="random humans besides these")
    crowd: CrowdConfig | None = Field(default=None, description="people who walk among each other")
    objects: dict[SceneName, ObjectConfig] = Field(default_factory=dict)
    robot: RobotConfig | None = Field(default=None, description="a robot that carries cameras")
    rig: RigConfig | None = Field(default=None, description="cameras of a calibration file")
    cameras: dict[SceneName, CameraConfig] = Field(default_factory=dict)
    scanners: dict[SceneName, ScannerConfig] = Field(default_factory=dict, description="laser scanners")
    world: WorldConfig = Field(default=WorldConfig.model_construct(), description="mesh files and background")
    light: LightConfig = Field(default=LightConfig.model_construct(), description="light and shadows")
    randomise: RandomiseConfig | None = Field(default=None, description="random looks")
    time: TimeConfig = Field(default=TimeConfig.model_construct(), description="real time, or lockstep")
    adapters: AdaptersConfig = Field(
        default=AdaptersConfig.model_construct(), description="messages for other people stacks"
    )
    hri: HriConfig | None = Field(default=None, description="topics and frames of ROS4HRI")
    license: str | None = Field(
        default=None, description="licence of data sets of the scene, such as CC-BY-4.0"
    )

    about: AboutConfig = Field(
        default=AboutConfig.model_construct(), description="title, creators, citation and date of data sets"
    )

    _license_is_a_line = field_validator("license")(checked_license)

    @property
    def adapter_settings(self) -> dict[str, Section]:
        """Settings of the rows of the table of adapters that the scene has, by name."""
        settings = {name: getattr(self.adapters, name) for name in type(self.adapters).model_fields}
        return {name: each for name, each in {**settings, "hri": self.hri}.items() if each is not None}

    @model_validator(mode="after")
    def _has_cameras_and_labels(self) -> SceneConfig:
        if not self.cameras and self.rig is None:
            raise ValueError(
                "a scene needs at least one camera: in 'cameras', or in a calibration file as 'rig'"
            )
        labels = len(self.humans) + sum(part.count for part in (self.variety, self.crowd) if part)
        labels += sum(item.label for item in self.objects.values())
        if self.robot is not None:
            if ROBOT in self.objects:
                raise ValueError(f"the robot is an object named {ROBOT}: give objects.{ROBOT} another name")
            labels += self.robot.label
        if self.randomise is not None and self.randomise.clutter_label:
            labels += self.randomise.clutter
        if labels > 65535:
            raise ValueError(f"at most 65535 humans and labelled objects, not {labels}")
        return self


def load_config(path: str | os.PathLike[str]) -> SceneConfig:
    """Read and check a scene file. Raises SceneError with file, line and key."""
    data, tree = read_yaml(path, SceneError, "scene")
    return check_config(data, path, tree)


def check_config(
    data: Any, path: str | os.PathLike[str] | None = None, tree: yaml.Node | None = None
) -> SceneConfig:
    """Check the content of a scene file. ``tree``: its YAML nodes. Raises SceneError with line and key."""
    if isinstance(data, dict) and RECIPE in data:
        raise SceneError(
            "this is a recipe of many scenes: `humansim export` draws them, and each has a scene.yaml",
            path=path,
            line=line_of(tree, [RECIPE]),
            key=RECIPE,
        )
    if not isinstance(data, dict):
        raise SceneError("a scene is a mapping with 'humans' and 'cameras'", path=path)
    return validated(SceneConfig, data, SceneError, path, tree)


def map_files(value: Any, change: Callable[[str], str]) -> Any:
    """Copy of a configuration, as ``model_dump`` gives it, with all file names changed."""
    if isinstance(value, NamedFile):
        return change(value)
    if isinstance(value, dict):
        return {key: map_files(part, change) for key, part in value.items()}
    return [map_files(part, change) for part in value] if isinstance(value, (list, tuple)) else value


def file_keys(value: Any, keys: tuple[str | int, ...] = ()) -> Iterator[tuple[tuple[str | int, ...], str]]:
    """Path and value of each key of a configuration that names a file or a built-in."""
    if isinstance(value, Section):
        for name, info in type(value).model_fields.items():
            yield from file_keys(getattr(value, name), (*keys, info.alias or name))
    elif isinstance(value, dict):
        for name, part in value.items():
            yield from file_keys(part, (*keys, name))
    elif isinstance(value, (list, tuple)):
        for number, part in enumerate(value):
            yield from file_keys(part, (*keys, number))
    elif isinstance(value, NamedFile):
        yield keys, str(value)


def schema_text() -> str:
    """JSON schema (draft 2020-12) of scene files, as text."""
    schema = SceneConfig.model_json_schema()
    top = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$id": SCHEMA_ID,
        "title": "Scene of humansim_ros",
    }
    return json.dumps(top | {key: value for key, value in schema.items() if key != "title"}, indent=1) + "\n"
