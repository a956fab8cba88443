"""Counts of what a data set shows: people, poses, cameras, light and visibility.

All counts have fixed bins, so that the counts of many scenes can be added.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar

import numpy as np

from humansim_ros.cameras.camera import Camera
from humansim_ros.data.formats.writer import ExportFolder, ExportFrame, FormatWriter, Record
from humansim_ros.files.reading import read_table
from humansim_ros.geometry import matrix_to_quaternion
from humansim_ros.motion.pose import JointLimits, load_limits
from humansim_ros.people.humans import Human
from humansim_ros.people.makehuman import is_person, read_person
from humansim_ros.scene.config import HumanConfig
from humansim_ros.scene.truth import BodyBox, HumanState

#: Name of the file, in the root of the export.
STATISTICS = "statistics.json"
_Value = TypeVar("_Value", int, str)
_TABLE = read_table("statistics")
#: Joint angles that are counted, with their titles. Angles of left and right are counted together.
ANGLES: dict[str, str] = _TABLE["angles"]


@dataclass(frozen=True)
class Histogram:
    """A quantity that is counted.

    Attributes:
        title: Name of the quantity for readers.
        unit: Unit of the quantity. Empty for a share or a number.
        of: In words, which things have this quantity.
        low: Start of the first bin. This bin also counts smaller values.
        width: Width of a bin.
        bins: Number of bins. The last bin also counts larger values.
    """

    title: str
    unit: str
    of: str
    low: float
    width: float
    bins: int

    def count(self, values: Iterable[float]) -> dict[int, int]:
        """Count the finite values in each bin. Returns the number of values by bin, without empty bins."""
        known = np.array([value for value in values if np.isfinite(value)])
        # a value at an edge belongs to the bin above it, even if the division rounds down
        bins = np.clip(np.floor((known - self.low) / self.width + 1e-9), 0, self.bins - 1).astype(int)
        return _counted(bins.tolist())

    def edge(self, number: float) -> float:
        """Lower end of a bin."""
        return round(self.low + self.width * number, 9)


#: All quantities by their keys in the file.
HISTOGRAMS = {name: Histogram(**row) for name, row in _TABLE["histograms"].items()} | {
    name: Histogram(title, "°", "joints", -180, 5, 72) for name, title in ANGLES.items()
}


class StatisticsWriter(FormatWriter):
    """Writes the counts of an export."""

    @cached_property
    def _limits(self) -> dict[str, JointLimits]:
        """By person: the joint limits that define the joint angles."""
        return {
            name: load_limits(skeleton=human.skeleton) for name, human in self.settings.scene.humans.items()
        }

    def frame(self, frame: ExportFrame, folder: ExportFolder) -> Record:
        """Values of a frame by quantity."""
        shown, scene = frame.frame, self.settings.scene
        values: dict[str, list[float]] = {name: [] for name in HISTOGRAMS}
        for name, state in shown.humans.items():
            if name in scene.humans:
                for angle, value in _angles(state, self._limits[name]):
                    values[angle].append(value)
        for name, truth in shown.truth.items():
            camera = shown.cameras[name]
            values["people"].append(sum(truth.boxes[each].pixels > 0 for each in scene.people))
            values["brightness"].append(float(truth.view.rgb.mean()) / 255)
            for person in scene.people:
                box = truth.boxes[person]
                if box.pixels:
                    for key, value in _seen(box, camera, shown.humans.get(person)):
                        values[key].append(value)
        return {name: each for name, each in values.items() if each}

    def finish(self, records: Iterable[tuple[int, Record]], folder: ExportFolder) -> None:
        """Write the counts."""
        scene = self.settings.scene
        values: dict[str, list[float]] = {name: [] for name in HISTOGRAMS}
        for _, record in records:
            for name, each in record.items():
                values[name] += each
        cameras = [each.camera for each in scene.cameras.values()]
        values["cameras"] = [len(cameras)]
        values["camera_height"] = [float(camera.center[2]) for camera in cameras]
        values["fov"] = [
            float(np.degrees(2 * np.arctan(camera.size[0] / 2 / camera.K[0, 0]))) for camera in cameras
        ]
        if scene.simulated is not None:
            up = scene.simulated.environment.lighting.direction[2]
            values["sun"] = [float(np.degrees(np.arcsin(np.clip(up, -1, 1))))]
        content = {
            "scenes": 1,
            "frames": len(self.settings.frames),
            "images": sum(len(self.settings.frames_of(name)) for name in self.settings.cameras),
            "people": {
                name: traits(config, scene.humans.get(name)) for name, config in scene.configs.items()
            },
            "sizes": _counted("x".join(map(str, camera.size)) for camera in cameras),
            "lenses": _counted(_lens(camera) for camera in cameras),
            "histograms": {name: HISTOGRAMS[name].count(each) for name, each in values.items() if each},
        }
        folder.root_folder().write(STATISTICS, json.dumps(content) + "\n")


def _counted(values: Iterable[_Value]) -> dict[_Value, int]:
    """Number of each value, in the order of the values."""
    return dict(sorted(Counter(values).items()))


def _lens(camera: Camera) -> str:
    return camera.model or "" if camera.distorted else "pinhole"


def traits(config: HumanConfig, human: Human | None) -> dict[str, Any]:
    """Traits of a person: body, motion and outfit; for people drawn at random also age, sex, skin and
    clothes."""
    body = str(config.body)
    known: dict[str, Any] = {"body": body, "motion": str(config.motion.file).split("#")[0]}
    if is_person(body):
        person = read_person(body)
        known |= {"age": round(person.age, 1), "sex": person.sex, "stature": round(person.stature, 3)}
        known |= {"weight": round(person.weight, 1), "skin": person.tone}
        worn = (person.clothes.top, person.clothes.bottom)
        known["clothes"] = [name for name in worn if name != "none"]
    elif human is not None:
        heights = human.mesh.vertices[:, 1]
        known |= {"stature": round(float(heights.max() - heights.min()), 3), "clothes": [human.outfit]}
    return known


def _seen(box: BodyBox, camera: Camera, state: HumanState | None) -> Iterator[tuple[str, float]]:
    """Yield the quantities of a person in an image: key and value."""
    yield "visible", box.visible_fraction
    yield "truncation", box.truncation
    yield "height", float(box.visible[3] - box.visible[1])
    if state is None or not {"l_hip", "r_hip"} <= set(state.joint_names):
        return
    left, right = (state.positions[state.joint_names.index(name)] for name in ("l_hip", "r_hip"))
    towards = camera.center - (left + right) / 2
    distance = float(np.linalg.norm(towards))
    yield "distance", distance
    yield "elevation", float(np.degrees(np.arcsin(towards[2] / max(distance, 1e-9))))
    x, y = left[:2] - right[:2]  # to the left of the person, who faces (y, -x)
    ahead = np.array([y, -x])
    cross = ahead[0] * towards[1] - ahead[1] * towards[0]
    yield "heading", float(np.degrees(np.arctan2(cross, ahead @ towards[:2])))


def _angles(state: HumanState, limits: JointLimits) -> Iterator[tuple[str, float]]:
    """Yield the joint angles of a pose: key of the quantity, and degrees."""
    skeleton = limits.skeleton
    rest = skeleton.rest[:, :3, :3]
    poses = state.joints[: len(skeleton), :3, :3]
    turned = poses / np.linalg.norm(poses, axis=1, keepdims=True) @ np.swapaxes(rest, -1, -2)
    above = np.where((skeleton.parents >= 0)[:, None, None], turned[skeleton.parents], np.eye(3))
    own = np.swapaxes(above, -1, -2) @ turned
    rotations = matrix_to_quaternion(np.swapaxes(rest, -1, -2) @ own @ rest)[None]
    for name, value in limits.angles(rotations).items():
        key = name[2:] if name[:2] in ("l_", "r_") else name
        if key in ANGLES:
            yield key, float(value[0])


class Totals:
    """Sums of the statistics of many scenes.

    Attributes:
        scenes: Number of scenes. ``frames`` and ``images`` are the numbers in these scenes.
        people: Traits of each different person by body and outfit.
        motions: Number of people of the scenes by motion.
        sizes: Number of cameras by image size.
        lenses: Number of cameras by model of the lens.
        histograms: For each quantity, the number of values by bin.
    """

    def __init__(self) -> None:
        self.scenes = self.frames = self.images = self.appearances = 0
        self.people: dict[str, dict[str, Any]] = {}
        self.motions: Counter[str] = Counter()
        self.sizes: Counter[str] = Counter()
        self.lenses: Counter[str] = Counter()
        self.histograms: dict[str, Counter[int]] = {name: Counter() for name in HISTOGRAMS}

    def add(self, content: Mapping[str, Any]) -> None:
        """Add the content of a file of :class:`StatisticsWriter`."""
        self.scenes += content["scenes"]
        self.frames += content["frames"]
        self.images += content["images"]
        for person in content["people"].values():
            self.appearances += 1
            self.people.setdefault(person["body"], person)
            self.motions[person["motion"]] += 1
        self.sizes.update(content["sizes"])
        self.lenses.update(content["lenses"])
        for name, counts in content["histograms"].items():
            self.histograms[name].update({int(number): count for number, count in counts.items()})

    def quantile(self, name: str, share: float) -> float:
        """Value of a quantity below which ``share`` of its values lie, interpolated within a bin. NaN if
        there are no values."""
        row, counts = HISTOGRAMS[name], self.histograms[name]
        left = share * sum(counts.values())
        for number in sorted(counts):
            if left <= counts[number]:
                return row.edge(number + left / counts[number])
            left -= counts[number]
        return float("nan")
