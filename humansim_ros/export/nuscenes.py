"""Frames, sensors, poses and 3D boxes of people in the tables of nuScenes [Caesar 2020].

A sample is a frame in which all cameras take a picture and a sweep of each scanner ends. Data of other frames
are sweeps between samples. The pose of the vehicle (``ego_pose``) is that of the robot, or ``map``.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from typing import Any

import cv2
import numpy as np

from humansim_ros.errors import ExportError
from humansim_ros.export.kitti import MOVING_SPEED
from humansim_ros.export.writer import (
    ExportFolder,
    ExportFrame,
    ExportSettings,
    FormatWriter,
    Record,
    frame_name,
    warn_of_lenses,
)
from humansim_ros.rotations import invert_rigid, matrix_to_quaternion, quaternion_to_matrix, transform
from humansim_ros.scene import Frame
from humansim_ros.scene.sweeps import Sweep
from humansim_ros.types import Array

#: Version of the tables, and their folder.
VERSION = "v1.0-humansim"
#: Levels of visibility and their shares.
_LEVELS = {"v0-40": 0.4, "v40-60": 0.6, "v60-80": 0.8, "v80-100": np.inf}
_ADULT, _CHILD, _CHILD_HEIGHT = "human.pedestrian.adult", "human.pedestrian.child", 1.4
_MOVING, _STANDING = "pedestrian.moving", "pedestrian.standing"
_MAP = "maps/blank.png"


class NuScenesWriter(FormatWriter):
    """``samples``, ``sweeps``, ``maps`` and the tables of ``v1.0-humansim``.

    ``settings``: settings of the export.

    Raises:
        ExportError: The names of two cameras differ in case only: channels are upper case.
    """

    def __init__(self, settings: ExportSettings) -> None:
        super().__init__(settings)
        if len({name.upper() for name in settings.cameras}) < len(settings.cameras):
            text = "two cameras have names that differ in case only, and nuscenes writes them in upper case"
            raise ExportError(text, key="--format")

    def frame(self, frame: ExportFrame, folder: ExportFolder) -> Record:
        """Write the sweeps that end with a frame; return poses of sensors, and boxes of people."""
        now = frame.frame
        sweeps = {name: listed[-1] for name, listed in now.sweeps.items() if listed}
        cameras = self.settings.scene.cameras
        key = sweeps.keys() == now.sweeps.keys() and now.cameras.keys() == cameras.keys()
        ego = np.eye(4) if now.robot is None else _pose(now.robot.rotation, now.robot.position)
        back = invert_rigid(ego)
        sensors = {}
        for name, camera in now.cameras.items():
            pose = back @ transform(camera.R.T, camera.center)
            sensors[_camera(name)] = {"pose": pose, "stamp": now.stamp, "K": camera.K, "size": camera.size}
        for number, name in enumerate(now.sweeps):
            if name not in sweeps:
                continue
            channel, sweep = _scanner(name, number), sweeps[name]
            pose = back @ _pose(sweep.rotation, sweep.position)
            sensors[channel] = {"pose": pose, "stamp": sweep.stamp, "K": None, "size": (0, 0)}
            folder.write(f"{_place(key)}/{channel}/{frame.name}.pcd.bin", _cloud(sweep))
        people = [_annotation(name, now, sweeps.values()) for name in now.humans] if key else []
        return {"stamp": now.stamp, "key": key, "ego": ego, "sensors": sensors, "people": people}

    def finish(self, records: Iterable[tuple[int, Record]], folder: ExportFolder) -> None:
        """Link the images, and write the tables. Raises ExportError if no frame is a sample."""
        frames = dict(records)
        samples = [index for index, record in frames.items() if record["key"]]
        if not samples:
            text = "in none of these frames, a sweep of each scanner ends and all cameras take a picture"
            raise ExportError(text, key="--frames")
        cameras = {name: known.camera for name, known in self.settings.scene.cameras.items()}
        warn_of_lenses("nuScenes", cameras, has_skew=True)
        files = {_camera(name): name for name in self.settings.cameras}
        for index, record in frames.items():
            for channel, name in files.items():
                if channel in record["sensors"]:
                    link = (
                        f"{_place(record['key'])}/{channel}/{frame_name(index)}{self.settings.image_suffix}"
                    )
                    folder.link(link, self.settings.image(name, index))
        blank = cv2.imencode(".png", np.full((8, 8), 255, np.uint8))[1]
        folder.write(_MAP, blank.tobytes())
        tables = self._tables(frames, samples)
        for table, rows in tables.items():
            folder.write(f"{VERSION}/{table}.json", json.dumps(rows, indent=0) + "\n")

    def _token(self, *words: object) -> str:
        """Token of a row: the same for the same export."""
        return hashlib.md5(
            repr((self.settings.scene.title, *words)).encode(), usedforsecurity=False
        ).hexdigest()

    def _tables(self, frames: Mapping[int, Record], samples: list[int]) -> dict[str, list[dict[str, Any]]]:
        """Rows of all tables by name."""
        token, title = self._token, self.settings.scene.title
        rows = {"sample_data": self._data(frames, samples), **self._annotations(frames, samples)}
        sensors = {row["calibrated"]: row for row in rows["sample_data"]}
        channels = dict.fromkeys(row["channel"] for row in sensors.values())
        tables: dict[str, list[dict[str, Any]]] = {
            "log": [
                {
                    "token": token("log"),
                    "logfile": title,
                    "vehicle": "robot",
                    "date_captured": "1970-01-01",
                    "location": title,
                }
            ],
            "map": [
                {
                    "token": token("map"),
                    "category": "semantic_prior",
                    "filename": _MAP,
                    "log_tokens": [token("log")],
                }
            ],
            "scene": [
                {
                    "token": token("scene"),
                    "log_token": token("log"),
                    "nbr_samples": len(samples),
                    "first_sample_token": token("sample", samples[0]),
                    "last_sample_token": token("sample", samples[-1]),
                    "name": title,
                    "description": "synthetic humans, made by humansim_ros",
                }
            ],
            "sample": _chained(
                [
                    {
                        "token": token("sample", index),
                        "timestamp": _microseconds(frames[index]["stamp"]),
                        "scene_token": token("scene"),
                    }
                    for index in samples
                ]
            ),
            "sensor": [
                {
                    "token": token("sensor", channel),
                    "channel": channel,
                    "modality": "lidar" if channel.startswith("LIDAR") else "camera",
                }
                for channel in channels
            ],
            "calibrated_sensor": [
                {
                    "token": calibrated,
                    "sensor_token": token("sensor", row["channel"]),
                    **_placed(row["pose"]),
                    "camera_intrinsic": row["K"] or [],
                }
                for calibrated, row in sensors.items()
            ],
            "ego_pose": [
                {
                    "token": row["ego_pose_token"],
                    "timestamp": row["timestamp"],
                    **_placed(frames[row["frame"]]["ego"]),
                }
                for row in rows["sample_data"]
            ],
            "category": [
                {"token": token("category", name), "name": name, "description": ""}
                for name in (_ADULT, _CHILD)
            ],
            "attribute": [
                {"token": token("attribute", name), "name": name, "description": ""}
                for name in (_MOVING, _STANDING)
            ],
            "visibility": [
                {"token": str(number), "level": level, "description": ""}
                for number, level in enumerate(_LEVELS, 1)
            ],
        }
        own = ("frame", "channel", "pose", "K", "calibrated")  # of sample_data, for the other tables
        rows["sample_data"] = [
            {key: value for key, value in row.items() if key not in own} for row in rows["sample_data"]
        ]
        return tables | rows

    def _data(self, frames: Mapping[int, Record], samples: list[int]) -> list[dict[str, Any]]:
        """Rows of ``sample_data``, with what other tables need of them."""
        rows: dict[str, list[dict[str, Any]]] = {}
        # data between two samples belong to the later one, as in nuScenes
        following = {index: next((s for s in samples if s >= index), samples[-1]) for index in frames}
        for index, record in frames.items():
            for channel, sensor in record["sensors"].items():
                suffix = ".pcd.bin" if sensor["K"] is None else self.settings.image_suffix
                pose = np.array(sensor["pose"]).round(9) + 0.0
                rows.setdefault(channel, []).append(
                    {
                        "token": self._token("data", channel, index),
                        "sample_token": self._token("sample", following[index]),
                        "ego_pose_token": self._token("ego", channel, index),
                        "calibrated_sensor_token": (
                            calibrated := self._token("calibrated", channel, pose.tolist())
                        ),
                        "timestamp": _microseconds(sensor["stamp"]),
                        "fileformat": "pcd" if sensor["K"] is None else suffix[1:],
                        "is_key_frame": record["key"],
                        "height": sensor["size"][1],
                        "width": sensor["size"][0],
                        "filename": f"{_place(record['key'])}/{channel}/{frame_name(index)}{suffix}",
                        "frame": index,
                        "channel": channel,
                        "pose": sensor["pose"],
                        "K": sensor["K"],
                        "calibrated": calibrated,
                    }
                )
        return [row for listed in rows.values() for row in _chained(listed)]

    def _annotations(
        self, frames: Mapping[int, Record], samples: list[int]
    ) -> dict[str, list[dict[str, Any]]]:
        """Rows of ``sample_annotation`` and ``instance``."""
        token = self._token
        by_person: dict[str, list[dict[str, Any]]] = {}
        for index in samples:
            for person in frames[index]["people"]:
                name = person["name"]
                by_person.setdefault(name, []).append(
                    {
                        "token": token("annotation", name, index),
                        "sample_token": token("sample", index),
                        "instance_token": token("instance", name),
                        "visibility_token": person["visibility"],
                        "attribute_tokens": [token("attribute", each) for each in person["attributes"]],
                        **{key: person[key] for key in ("translation", "size", "rotation")},
                        "num_lidar_pts": person["points"],
                        "num_radar_pts": 0,
                    }
                )
        instances = [
            {
                "token": token("instance", name),
                "category_token": token("category", self._category(name)),
                "nbr_annotations": len(listed),
                "first_annotation_token": listed[0]["token"],
                "last_annotation_token": listed[-1]["token"],
            }
            for name, listed in by_person.items()
        ]
        rows = [row for listed in by_person.values() for row in _chained(listed)]
        return {"sample_annotation": rows, "instance": instances}

    def _category(self, name: str) -> str:
        heights = self.settings.scene.humans[name].mesh.vertices[:, 1]
        return _CHILD if np.ptp(heights) < _CHILD_HEIGHT else _ADULT


def _annotation(name: str, frame: Frame, sweeps: Iterable[Sweep]) -> Record:
    """Box of a person, with its visibility, attributes and number of laser points."""
    state = frame.humans[name]
    box = state.upright_box
    length, width, height = box.size
    seen = whole = 0.0
    for truth in frame.truth.values():
        own = truth.boxes[name]
        if own.pixels:
            seen += own.pixels
            whole += own.pixels / max(own.visible_fraction * (1 - own.truncation), 1e-6)
    share = seen / whole if whole else 0.0
    return {
        "name": name,
        "translation": box.center,
        "size": [width, length, height],
        "rotation": np.roll(box.quaternion, 1),  # wxyz
        "visibility": str(1 + sum(share >= limit for limit in _LEVELS.values())),
        "attributes": [_MOVING if state.speed > MOVING_SPEED else _STANDING],
        "points": int(sum((sweep.instances == frame.labels[name]).sum() for sweep in sweeps)),
    }


def _cloud(sweep: Sweep) -> bytes:
    """Points of a sweep: x, y, z, intensity of 0 to 255, and ring."""
    intensities = 255 * np.minimum(sweep.returns.intensities, 1.0)
    rings = sweep.rays.rings[sweep.returns.rays]
    return np.column_stack([sweep.points, intensities, rings]).astype("<f4").tobytes()


def _camera(name: str) -> str:
    return f"CAM_{name.upper()}"


def _scanner(name: str, number: int) -> str:
    """Channel of a scanner; the first one has the name that programs look for."""
    return f"LIDAR_{number}_{name.upper()}" if number else "LIDAR_TOP"


def _place(key: bool) -> str:
    return "samples" if key else "sweeps"


def _microseconds(stamp: int) -> int:
    return stamp // 1000


def _pose(rotation: Array, position: Array) -> Array:
    return transform(quaternion_to_matrix(rotation), position)


def _placed(pose: Any) -> dict[str, Any]:
    """Translation and rotation wxyz of a pose (4, 4)."""
    matrix = np.array(pose)
    quaternion = matrix_to_quaternion(matrix[:3, :3])
    return {"translation": matrix[:3, 3].tolist(), "rotation": np.roll(quaternion, 1).tolist()}


def _chained(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows with ``prev`` and ``next``."""
    tokens = ["", *(row["token"] for row in rows), ""]
    return [{**row, "prev": tokens[number], "next": tokens[number + 2]} for number, row in enumerate(rows)]
