"""Frames, sensors, poses and 3D boxes of people in the tables of nuScenes [Caesar 2020].

A sample is a frame that all cameras capture, and at which a sweep of each scanner ends. Data of other frames
are sweeps between samples. The pose of the vehicle (``ego_pose``) is that of the robot; without a robot it is
the origin of ``map``. Points of samples have the labels of nuScenes-lidarseg [Fong 2022].
"""

from __future__ import annotations

import hashlib
import json
from bisect import bisect_left
from collections.abc import Iterable
from typing import Any

import cv2
import numpy as np

from humansim_ros.cameras.camera import Camera
from humansim_ros.data.formats.kitti import MOVING_SPEED, point_classes
from humansim_ros.data.formats.writer import (
    ExportFolder,
    ExportFrame,
    ExportSettings,
    FormatWriter,
    Record,
    warn_of_lenses,
)
from humansim_ros.errors import ExportError
from humansim_ros.geometry import invert_rigid, matrix_to_quaternion, quaternion_to_matrix, transform
from humansim_ros.scene.core import Frame
from humansim_ros.scene.features import Sweep
from humansim_ros.types import Array

#: Version of the tables, and their folder.
VERSION = "v1.0-humansim"
#: Levels of visibility, each with the visible share at which it ends.
_LEVELS = {"v0-40": 0.4, "v40-60": 0.6, "v60-80": 0.8, "v80-100": np.inf}
_ADULT, _CHILD, _CHILD_HEIGHT = "human.pedestrian.adult", "human.pedestrian.child", 1.4
#: Categories, ordered by their numbers in the labels of points, which other programs know.
_CATEGORIES = (
    *("noise", "animal", _ADULT, _CHILD),
    *(
        f"human.pedestrian.{name}"
        for name in ("construction_worker", "personal_mobility", "police_officer", "stroller", "wheelchair")
    ),
    *(f"movable_object.{name}" for name in ("barrier", "debris", "pushable_pullable", "trafficcone")),
    *("static_object.bicycle_rack", "vehicle.bicycle", "vehicle.bus.bendy", "vehicle.bus.rigid"),
    *("vehicle.car", "vehicle.construction", "vehicle.emergency.ambulance", "vehicle.emergency.police"),
    *("vehicle.motorcycle", "vehicle.trailer", "vehicle.truck"),
    *(f"flat.{name}" for name in ("driveable_surface", "other", "sidewalk", "terrain")),
    *("static.manmade", "static.other", "static.vegetation", "vehicle.ego"),
)
#: Number of the category of labelled objects. Points without a label are noise, number 0.
_OBJECT = _CATEGORIES.index("static.other")
_MOVING, _STANDING = "pedestrian.moving", "pedestrian.standing"
_MAP = "maps/blank.png"
_Row = dict[str, Any]


class NuScenesWriter(FormatWriter):
    """Writes ``samples``, ``sweeps``, ``lidarseg``, ``maps`` and the tables of ``v1.0-humansim``.

    ``settings``: settings of the export.

    Raises:
        ExportError: The names of two cameras differ only in case, so their channels (upper case) are equal.
    """

    def __init__(self, settings: ExportSettings) -> None:
        super().__init__(settings)
        if len({name.upper() for name in settings.cameras}) < len(settings.cameras):
            text = "two cameras have names that differ in case only, and nuscenes writes them in upper case"
            raise ExportError(text, key="--format")

    def frame(self, frame: ExportFrame, folder: ExportFolder) -> Record:
        """Write the sweeps that end with a frame, and link its images. Returns rows of the tables."""
        now = frame.frame
        sweeps = {name: listed[-1] for name, listed in now.sweeps.items() if listed}
        key = sweeps.keys() == now.sweeps.keys() and now.cameras.keys() == self.settings.scene.cameras.keys()
        data: dict[str, list[_Row]] = {}
        for name, camera in now.cameras.items():
            channel, pose = f"CAM_{name.upper()}", transform(camera.R.T, camera.center)
            data[channel] = self._data(channel, frame, key, now.stamp, pose, camera)
            folder.link(data[channel][0]["filename"], frame.image(name))
        for name, sweep in sweeps.items():
            number = list(now.sweeps).index(name)  # programs look for the name of the first one
            channel = f"LIDAR_{number}_{name.upper()}" if number else "LIDAR_TOP"
            pose = _pose(sweep.rotation, sweep.position)
            data[channel] = self._data(channel, frame, key, sweep.stamp, pose)
            row = data[channel][0]
            folder.write(row["filename"], _cloud(sweep))
            if key:
                people = {person: _CATEGORIES.index(self._category(person)) for person in now.humans}
                labels = point_classes(self.settings.scene.labels, sweep, people, _OBJECT)
                folder.write(_labels_file(row), labels.astype(np.uint8).tobytes())
        boxes = {name: self._annotation(name, now, sweeps.values()) for name in now.humans}
        return {"stamp": now.stamp, "key": key, "data": data, "people": boxes if key else {}}

    def finish(self, records: Iterable[tuple[int, Record]], folder: ExportFolder) -> None:
        """Write the tables. Raises ExportError if no frame is a sample."""
        frames = dict(records)
        samples = [index for index, record in frames.items() if record["key"]]
        if not samples:
            text = "in none of these frames, a sweep of each scanner ends and all cameras take a picture"
            raise ExportError(text, key="--frames")
        cameras = {name: known.camera for name, known in self.settings.scene.cameras.items()}
        warn_of_lenses("nuScenes", cameras, has_skew=True)
        blank = cv2.imencode(".png", np.full((8, 8), 255, np.uint8))[1]
        folder.write(_MAP, blank.tobytes())
        tables = self._scene(frames, samples) | self._sensors(frames, samples)
        for table, rows in tables.items():
            if rows or table != "lidarseg":  # the devkit looks for the files of this table
                folder.write(f"{VERSION}/{table}.json", json.dumps(rows, indent=0) + "\n")

    def _token(self, *words: object) -> str:
        """Token (id) of a row, made from ``words``. Equal exports have equal tokens."""
        return hashlib.md5(
            repr((self.settings.scene.title, *words)).encode(), usedforsecurity=False
        ).hexdigest()

    def _category(self, person: str) -> str:
        heights = self.settings.scene.humans[person].mesh.vertices[:, 1]
        return _CHILD if np.ptp(heights) < _CHILD_HEIGHT else _ADULT

    def _data(
        self,
        channel: str,
        frame: ExportFrame,
        key: bool,
        stamp: int,
        pose: Array,
        camera: Camera | None = None,
    ) -> list[_Row]:
        """Rows of ``sample_data``, ``ego_pose`` and ``calibrated_sensor`` for a file. The token of its sample
        is added later."""
        robot = frame.frame.robot
        ego = np.eye(4) if robot is None else _pose(robot.rotation, robot.position)
        suffix = ".pcd.bin" if camera is None else self.settings.image_suffix
        width, height = (0, 0) if camera is None else camera.size
        token, mounted = self._token, invert_rigid(ego) @ pose
        own = (mounted.round(9) + 0.0).tolist()
        ego_pose = {"token": token("ego", channel, frame.index), "timestamp": stamp // 1000, **_placed(ego)}
        calibrated = {
            "token": token("calibrated", channel, own),
            "sensor_token": token("sensor", channel),
            **_placed(mounted),
            "camera_intrinsic": [] if camera is None else camera.K,
        }
        data = {
            "token": token("data", channel, frame.index),
            "sample_token": "",
            "ego_pose_token": ego_pose["token"],
            "calibrated_sensor_token": calibrated["token"],
            "timestamp": stamp // 1000,
            "fileformat": "pcd" if camera is None else suffix[1:],
            "is_key_frame": key,
            "height": height,
            "width": width,
            "filename": f"{'samples' if key else 'sweeps'}/{channel}/{frame.name}{suffix}",
        }
        return [data, ego_pose, calibrated]

    def _annotation(self, name: str, frame: Frame, sweeps: Iterable[Sweep]) -> _Row:
        """Row of ``sample_annotation`` for a person: box, visibility, attribute, count of laser points."""
        state, token = frame.humans[name], self._token
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
            "token": token("annotation", name, frame.index),
            "sample_token": token("sample", frame.index),
            "instance_token": token("instance", name),
            "visibility_token": str(1 + sum(share >= limit for limit in _LEVELS.values())),
            "attribute_tokens": [token("attribute", _MOVING if state.speed > MOVING_SPEED else _STANDING)],
            "translation": box.center,
            "size": [width, length, height],
            "rotation": np.roll(box.quaternion, 1),  # wxyz
            "num_lidar_pts": int(sum((sweep.instances == frame.labels[name]).sum() for sweep in sweeps)),
            "num_radar_pts": 0,
        }

    def _scene(self, frames: dict[int, Record], samples: list[int]) -> dict[str, list[_Row]]:
        """Tables of the scene, samples, annotations of people, and names such as categories."""
        token, title = self._token, self.settings.scene.title
        people = {
            name: _chained([frames[index]["people"][name] for index in samples])
            for name in frames[samples[0]]["people"]
        }

        def named(table: str, names: Iterable[str]) -> list[_Row]:
            return [{"token": token(table, name), "name": name, "description": ""} for name in names]

        log = {"logfile": title, "vehicle": "robot", "date_captured": "1970-01-01", "location": title}
        area = {"category": "semantic_prior", "filename": _MAP, "log_tokens": [token("log")]}
        scene = {
            "token": token("scene"),
            "log_token": token("log"),
            "nbr_samples": len(samples),
            "first_sample_token": token("sample", samples[0]),
            "last_sample_token": token("sample", samples[-1]),
            "name": title,
            "description": "synthetic humans, made by humansim_ros",
        }
        times = [
            {"token": token("sample", index), "timestamp": frames[index]["stamp"] // 1000}
            for index in samples
        ]
        return {
            "log": [{"token": token("log"), **log}],
            "map": [{"token": token("map"), **area}],
            "scene": [scene],
            "sample": _chained([{**row, "scene_token": token("scene")} for row in times]),
            "instance": [
                {
                    "token": token("instance", name),
                    "category_token": token("category", self._category(name)),
                    "nbr_annotations": len(rows),
                    "first_annotation_token": rows[0]["token"],
                    "last_annotation_token": rows[-1]["token"],
                }
                for name, rows in people.items()
            ],
            "sample_annotation": [row for rows in people.values() for row in rows],
            "category": [
                {**row, "index": number} for number, row in enumerate(named("category", _CATEGORIES))
            ],
            "attribute": named("attribute", (_MOVING, _STANDING)),
            "visibility": [
                {"token": str(number), "level": level, "description": ""}
                for number, level in enumerate(_LEVELS, 1)
            ],
        }

    def _sensors(self, frames: dict[int, Record], samples: list[int]) -> dict[str, list[_Row]]:
        """Tables of the sensors and their data."""
        channels = dict.fromkeys(channel for record in frames.values() for channel in record["data"])
        data: list[_Row] = []
        ego_poses: list[_Row] = []
        calibrated: dict[str, _Row] = {}
        for channel in channels:
            rows = []
            for index, record in frames.items():
                if channel in record["data"]:
                    row, ego_pose, own = record["data"][channel]
                    # data between two samples belong to the later one, as in nuScenes
                    sample = samples[min(bisect_left(samples, index), len(samples) - 1)]
                    rows.append({**row, "sample_token": self._token("sample", sample)})
                    ego_poses.append(ego_pose)
                    calibrated[own["token"]] = own
            data += _chained(rows)
        return {
            "sensor": [
                {
                    "token": self._token("sensor", channel),
                    "channel": channel,
                    "modality": "lidar" if channel.startswith("LIDAR") else "camera",
                }
                for channel in channels
            ],
            "calibrated_sensor": list(calibrated.values()),
            "ego_pose": ego_poses,
            "sample_data": data,
            "lidarseg": [
                {"token": row["token"], "filename": _labels_file(row), "sample_data_token": row["token"]}
                for row in data
                if row["is_key_frame"] and row["fileformat"] == "pcd"
            ],
        }


def _labels_file(row: _Row) -> str:
    """Path of the file with the labels of the points for a row of ``sample_data``."""
    return f"lidarseg/{VERSION}/{row['token']}_lidarseg.bin"


def _cloud(sweep: Sweep) -> bytes:
    """Content of the file of a sweep: for each point x, y, z, intensity (0 to 255) and ring."""
    intensities = 255 * np.minimum(sweep.returns.intensities, 1.0)
    rings = sweep.rays.rings[sweep.returns.rays]
    return np.column_stack([sweep.points, intensities, rings]).astype("<f4").tobytes()


def _pose(rotation: Array, position: Array) -> Array:
    return transform(quaternion_to_matrix(rotation), position)


def _placed(pose: Array) -> _Row:
    """Fields of a row for a pose (4, 4): translation and rotation (wxyz)."""
    return {"translation": pose[:3, 3], "rotation": np.roll(matrix_to_quaternion(pose[:3, :3]), 1)}


def _chained(rows: list[_Row]) -> list[_Row]:
    """Set ``prev`` and ``next`` of rows to the tokens of the neighbouring rows. Returns the rows."""
    tokens = ["", *(row["token"] for row in rows), ""]
    return [{**row, "prev": tokens[number], "next": tokens[number + 2]} for number, row in enumerate(rows)]
