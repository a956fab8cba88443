"""Settings of laser scanners in a scene file (docs/scanners.md)."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from humansim_ros.files.yaml import Section, Share
from humansim_ros.scene.config.camera_config import BoundedVector3, Mount, TrajectoryConfig

#: Most rays of a sweep, and of a second: more keep no pace, and need much memory.
MAX_RAYS, MAX_RAYS_PER_SECOND = 1 << 19, 6_000_000
ScannerName = Literal[
    "velodyne_vlp16",
    "velodyne_hdl32e",
    "ouster_os0_128",
    "ouster_os1_64",
    "hesai_xt32",
    "robosense_m1",
    "livox_mid40",
    "livox_mid360",
    "hokuyo_utm30lx",
    "hokuyo_urg04lx",
    "sick_lms111",
    "sick_tim571",
]
_Angle = Annotated[float, Field(ge=-360, le=360)]
_Elevation = Annotated[float, Field(ge=-90, le=90)]
_Distance = Annotated[float, Field(ge=0, le=1e4)]
_Microseconds = Annotated[float, Field(ge=0, le=1e6)]


class PatternConfig(Section):
    """A scan pattern of your own."""

    kind: Literal["spinning", "raster"] = Field(
        default="spinning",
        description="spinning: lasers that turn about z; raster: solid state, row after row",
    )
    elevations_deg: tuple[_Elevation, ...] = Field(
        default=(0.0,),
        min_length=1,
        max_length=1024,
        description="elevation of each laser or row, in the order in which they fire",
    )
    columns: int = Field(ge=1, le=1 << 17, description="columns of a sweep")
    azimuth_deg: tuple[_Angle, _Angle] = Field(
        default=(180.0, -180.0),
        description="azimuth of the first column, and of the last or of a whole turn; from x to y",
    )
    firing_us: _Microseconds = Field(
        default=0.0, description="time from column to column, microseconds; evenly spread if 0"
    )
    channel_us: _Microseconds = Field(
        default=0.0, description="time from laser to laser of a column, microseconds"
    )

    @model_validator(mode="after")
    def _turns(self) -> PatternConfig:
        if self.azimuth_deg[0] == self.azimuth_deg[1] and self.columns > 1:
            raise ValueError("azimuth_deg needs two different angles, such as [180, -180]")
        if abs(self.azimuth_deg[0] - self.azimuth_deg[1]) > 360:
            raise ValueError("azimuth_deg is more than a turn")
        if self.kind == "raster" and (self.firing_us or self.channel_us):
            raise ValueError("firing_us and channel_us go with spinning patterns: a raster fires evenly")
        return self


class ScannerConfig(Section):
    """One laser scanner: its model or pattern, and its pose. Other keys replace values of the model."""

    model: ScannerName | None = Field(default=None, description="a scanner by name")
    pattern: PatternConfig | None = Field(default=None, description="a pattern of your own, without a model")
    position: BoundedVector3 | None = Field(
        default=None, examples=[[0, 0, 1.2]], description="position in map, metres"
    )
    rotation_deg: BoundedVector3 = Field(
        default=(0.0, 0.0, 0.0),
        description="degrees about the x axis of map, then y, then z; without it x is forward and z up",
    )
    trajectory: TrajectoryConfig | None = Field(
        default=None, description="moves the scanner: poses of its frame (x forward, z up) in map"
    )
    mount: Mount | None = Field(
        default=None, description="robot: the scanner moves with it, and its pose is in base_link, not in map"
    )
    rate: float | None = Field(default=None, ge=0.1, le=200, description="sweeps per second")
    range: tuple[_Distance, _Distance] | None = Field(
        default=None, description="least and greatest distance, metres"
    )
    layout: Literal["velodyne", "ouster", "livox", "autoware", "xyzi", "scan"] | None = Field(
        default=None, description="fields of the points, as a driver has them; scan: sensor_msgs/LaserScan"
    )
    stamp: Literal["start", "end"] | None = Field(
        default=None, description="whether the stamp of a sweep is of its first ray, or of its end"
    )
    returns: Literal["single", "strongest", "last", "dual"] = Field(
        default="single", description="single: rays without width; others: returns of a beam with a width"
    )
    divergence_mrad: float | None = Field(
        default=None, gt=0, le=100, description="opening angle of a beam, milliradians; with returns"
    )
    noise: float | None = Field(
        default=None, ge=0, le=100, description="standard deviation of distances, metres"
    )
    dropout: Share = Field(default=0.0, description="share of returns that are lost at random")
    range_10: float | None = Field(
        default=None,
        gt=0,
        le=1e4,
        description="distance up to which a surface that reflects 10 % is seen, metres; darker surfaces and "
        "grazing angles are lost before; all are seen if absent",
    )
    intensity: Literal["calibrated", "raw"] = Field(
        default="calibrated", description="calibrated: reflectivity; raw: divided by the squared distance"
    )
    seed: int = Field(default=0, ge=0, description="seed of noise and drop-outs")

    @model_validator(mode="after")
    def _is_possible(self) -> ScannerConfig:
        if (self.model is None) == (self.pattern is None):
            raise ValueError("give a model, such as velodyne_vlp16, or a pattern")
        if (self.position is None) == (self.trajectory is None):
            raise ValueError("give a position or a trajectory")
        if self.mount is not None and self.trajectory is not None:
            raise ValueError("a scanner with a mount cannot have a trajectory: the robot moves it")
        if self.range is not None and self.range[0] >= self.range[1]:
            raise ValueError("range is the least and the greatest distance, such as [0.4, 100]")
        if self.pattern is not None and self.rate is None:
            raise ValueError("a pattern needs a rate, in sweeps per second")
        if self.pattern is not None and self.range is None:
            raise ValueError("a pattern needs a range, such as [0.4, 100]")
        if self.layout == "scan" and self.returns == "dual":
            raise ValueError("a LaserScan has one return of each ray: returns is single, strongest or last")
        return self
