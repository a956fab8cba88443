"""Settings of the robot in a scene file (docs/robots.md)."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field, model_validator

from humansim_ros.files.yaml import ByteColor, FileName, Section, TopicName
from humansim_ros.scene.config.camera_config import Bounded, NumberSection, TrajectoryConfig

#: Name of the robot among the objects of the scene.
ROBOT = "robot"
_Point = tuple[Bounded, Bounded]
_Size = Annotated[float, Field(gt=0, le=100)]
#: Frames of tf.
_Frame = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_/]*$", max_length=255)]


class PathConfig(Section):
    """Path of a robot: straight lines between points, and turns on the spot."""

    points: tuple[_Point, ...] = Field(
        min_length=2, max_length=10_000, description="points x, y in map, metres; it starts at the first"
    )
    speed: float = Field(default=0.7, gt=0, le=100, description="metres per second")
    turn_deg: float = Field(default=90.0, gt=0, le=3600, description="degrees per second of its turns")
    end: Literal["clamp", "loop", "ping_pong"] = Field(
        default="loop",
        description="after the last point: stay, drive to the first point, or drive back in reverse",
    )

    @model_validator(mode="after")
    def _moves(self) -> PathConfig:
        for number, (a, b) in enumerate(zip(self.points, self.points[1:], strict=False), 2):
            if a == b:
                raise ValueError(f"point {number} is the point before it: leave one of them out")
        return self


class VibrationConfig(NumberSection):
    """Vibration of a robot, which odometry does not show."""

    number_key: ClassVar[str] = "position"

    position: float = Field(
        default=0.0, ge=0, le=0.1, description="standard deviation along each axis, metres"
    )
    rotation_deg: float = Field(
        default=0.0, ge=0, le=10, description="standard deviation about each axis, degrees"
    )
    frequency: float = Field(default=12.0, gt=0, le=500, description="middle of its frequencies, Hz")
    seed: int = Field(default=1, ge=0, description="the same seed gives the same vibration")


class RobotConfig(Section):
    """A robot that carries cameras; it follows ``cmd_vel`` unless a path, trajectory or odometry moves it."""

    mesh: FileName = Field(
        default="robot",
        description="its shape: robot, another built-in mesh, or a file; base_link is its origin",
    )
    color: ByteColor | None = Field(default=None, description="red, green, blue; 0 to 255")
    size: tuple[_Size, _Size, _Size] = Field(
        default=(1.0, 1.0, 1.0),
        description="size along its own x, y, z: metres for box, sphere, cylinder, else factors",
    )
    label: bool = Field(default=False, description="give it an instance label, as humans have")
    position: _Point = Field(default=(0.0, 0.0), description="start: x, y in map, metres")
    yaw_deg: Bounded = Field(default=0.0, description="heading at the start, degrees from +x to the left")
    path: PathConfig | None = Field(default=None, description="drives along points, the same in each run")
    trajectory: TrajectoryConfig | None = Field(
        default=None, description="moves base_link, the same in each run; as cameras have it"
    )
    odometry: TopicName | None = Field(
        default=None,
        description="topic (nav_msgs/Odometry) of another node that moves it; its frame starts at position",
    )
    cmd_vel: TopicName = Field(default="cmd_vel", description="topic of the commands that it follows")
    stamped: bool = Field(
        default=False, description="commands are geometry_msgs/TwistStamped, not geometry_msgs/Twist"
    )
    timeout: float = Field(
        default=0.5, gt=0, le=3600, description="seconds of the scene that a command holds; then it stops"
    )
    max_speed: float = Field(default=2.0, gt=0, le=100, description="limit of commands, metres per second")
    max_turn_deg: float = Field(
        default=180.0, gt=0, le=3600, description="limit of commands, degrees per second"
    )
    vibration: VibrationConfig | None = Field(default=None, description="vibration; none if absent")
    base_frame: _Frame = Field(default="base_link", description="frame of the robot in tf")
    odom_frame: _Frame = Field(default="odom", description="frame of its odometry in tf")

    @model_validator(mode="after")
    def _is_moved_one_way(self) -> RobotConfig:
        ways = [key for key in ("path", "trajectory", "odometry") if getattr(self, key) is not None]
        if len(ways) > 1:
            raise ValueError(f"the robot is moved by {' and by '.join(ways)}: give one of them")
        if ways and ways[0] != "odometry" and {"position", "yaw_deg"} & self.model_fields_set:
            raise ValueError(
                f"position and yaw_deg are of a robot without {ways[0]}, which has its own start"
            )
        if len({"map", self.odom_frame, self.base_frame}) < 3:
            raise ValueError("odom_frame and base_frame must differ from each other and from map")
        return self
