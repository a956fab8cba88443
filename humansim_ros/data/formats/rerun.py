"""A recording of Rerun: images, cameras, people and lasers on the time of the scene.

Entities are ``cameras/<camera>/image``, ``people/<person>``, ``scanners/<scanner>/points`` and ``robot``; all
are in ``map``. Rerun numbers its chunks at random, so two equal exports differ in bytes, but not in content.
"""

from __future__ import annotations

import uuid
from collections.abc import Iterable, Mapping
from functools import partial
from io import BytesIO
from typing import Any

import numpy as np

from humansim_ros.data.formats.images import encoded_image
from humansim_ros.data.formats.writer import (
    FROM_CORNER,
    ExportFolder,
    ExportFrame,
    FormatWriter,
    Record,
    corner_matrix,
)
from humansim_ros.errors import ExportError
from humansim_ros.files.reading import ANY_SIZE, read_bytes
from humansim_ros.people.keypoints import keypoint_set
from humansim_ros.scene.truth import OUTSIDE

#: Names of the timelines: time since the start of the scene, and number of the frame.
TIME, NUMBER = "scene_time", "frame"
_MEDIA = {".png": "image/png", ".jpg": "image/jpeg"}
_Arrays = Mapping[str, np.ndarray[Any, Any]]


class RerunWriter(FormatWriter):
    """Writes ``rerun.rrd``."""

    def frame(self, frame: ExportFrame, folder: ExportFolder) -> Record:
        """Write the arrays of a frame to a temporary file for :meth:`finish`. Returns the scene time."""
        now, chosen = frame.frame, self.settings.keypoints
        arrays: dict[str, Any] = {}
        for name, camera in now.cameras.items():
            encoding = self.settings.scene.cameras[name].encoding
            image = encoded_image(now.views[name].rgb, encoding, self.settings.image_suffix)
            boxes = now.truth[name].boxes
            seen = [person for person in now.humans if boxes[person].pixels]
            arrays |= {
                f"camera/{name}/image": np.frombuffer(image, np.uint8),
                f"camera/{name}/K": corner_matrix(camera),
                f"camera/{name}/R": camera.R,
                f"camera/{name}/center": camera.center,
                f"camera/{name}/people": np.array([now.labels[person] for person in seen], np.uint16),
                f"camera/{name}/boxes": FROM_CORNER
                + np.array([boxes[person].visible for person in seen]).reshape(-1, 4),
            }
            for person, view in now.keypoints[chosen][name].items():
                pixels = np.where((view.visible != OUTSIDE)[:, None], view.pixels + FROM_CORNER, np.nan)
                arrays[f"camera/{name}/keypoints/{person}"] = pixels
        for name, state in now.humans.items():
            box = state.upright_box
            arrays |= {
                f"person/{name}/vertices": state.vertices,
                f"person/{name}/keypoints": now.keypoint_positions[chosen][name],
                f"person/{name}/box": np.concatenate([box.center, box.size, box.quaternion]),
            }
        for name, sweeps in now.sweeps.items():
            for sweep in sweeps[-1:]:
                arrays |= {
                    f"scanner/{name}/points": sweep.points.astype(np.float32),
                    f"scanner/{name}/instances": sweep.instances,
                    f"scanner/{name}/pose": np.concatenate([sweep.position, sweep.rotation]),
                }
        if now.robot is not None:
            arrays["robot/base/pose"] = np.concatenate([now.robot.position, now.robot.rotation])
        content = BytesIO()
        np.savez(content, **arrays)
        folder.write_temporary(f"{frame.name}.npz", content.getvalue())
        return now.scene_time

    def finish(self, records: Iterable[tuple[int, Record]], folder: ExportFolder) -> None:
        """Write the recording from the temporary files."""
        import rerun as rr

        title = self.settings.scene.title
        # the same recording for the same export: viewers replace it
        identity = uuid.uuid5(uuid.NAMESPACE_URL, f"humansim_ros {title} {self.settings.frames}")
        with folder.path("rerun.rrd") as path:
            stream = rr.RecordingStream(f"humansim_ros {title}", recording_id=identity, send_properties=False)
            stream.set_log_time_enabled(False)
            stream.set_log_tick_enabled(False)
            stream.save(path)
            log = partial(stream.log, strict=True)
            self._log_fixed(rr, log)
            for index, scene_time in records:
                content = read_bytes(folder.temporary(f"{index:06d}.npz"), ExportError, "frame", ANY_SIZE)
                stream.set_time(TIME, duration=np.timedelta64(scene_time, "ns"))
                stream.set_time(NUMBER, sequence=index)
                with np.load(BytesIO(content)) as arrays:
                    self._log_frame(rr, log, arrays)
            stream.flush()
            stream.disconnect()

    def _log_fixed(self, rr: Any, log: Any) -> None:
        """Log the data that are the same in all frames: axes, names of labels, and triangles."""
        scene = self.settings.scene
        log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        infos = [rr.AnnotationInfo(id=label, label=name) for name, label in scene.labels.items()]
        log("/", rr.AnnotationContext(infos), static=True)
        for name, human in scene.humans.items():
            triangles = rr.Mesh3D.from_fields(triangle_indices=human.mesh.triangles)
            log(f"people/{name}/body", triangles, static=True)

    def _log_frame(self, rr: Any, log: Any, arrays: _Arrays) -> None:
        """Log the arrays of a frame."""
        things: dict[tuple[str, str], dict[str, Any]] = {}
        for key in arrays:
            kind, name, part = key.split("/", 2)
            things.setdefault((kind, name), {})[part] = arrays[key]
        for (kind, name), parts in things.items():
            if kind == "camera":
                self._log_camera(rr, log, f"cameras/{name}", parts)
            elif kind == "person":
                self._log_person(rr, log, name, parts)
            elif kind == "scanner":
                log(f"scanners/{name}", _placed(rr, parts["pose"]))
                points = rr.Points3D(parts["points"], class_ids=parts["instances"], radii=0.01)
                log(f"scanners/{name}/points", points)
            else:
                log("robot", _placed(rr, parts["pose"]))

    def _log_person(self, rr: Any, log: Any, name: str, parts: _Arrays) -> None:
        """Log vertices, keypoints and box of a person."""
        label, points, box = self.settings.scene.labels[name], parts["keypoints"], parts["box"]
        log(f"people/{name}/body", rr.Mesh3D.from_fields(vertex_positions=parts["vertices"]))
        log(f"people/{name}/keypoints", rr.Points3D(points, radii=0.02, class_ids=label))
        strips = points[np.array(keypoint_set(self.settings.keypoints).edges)]
        log(f"people/{name}/skeleton", rr.LineStrips3D(strips, radii=0.008, class_ids=label))
        places = {"centers": [box[:3]], "sizes": [box[3:6]], "quaternions": [box[6:]]}
        log(f"people/{name}/box", rr.Boxes3D(**places, labels=[name], class_ids=[label]))

    def _log_camera(self, rr: Any, log: Any, path: str, parts: _Arrays) -> None:
        """Log pose, lens, image, boxes and keypoints of a camera."""
        boxes, size = parts["boxes"], self.settings.scene.cameras[path.removeprefix("cameras/")].camera.size
        log(path, rr.Transform3D(translation=parts["center"], mat3x3=parts["R"].T))
        axes = rr.ViewCoordinates.RDF
        log(f"{path}/image", rr.Pinhole(image_from_camera=parts["K"], resolution=size, camera_xyz=axes))
        media = _MEDIA[self.settings.image_suffix]
        log(f"{path}/image", rr.EncodedImage(contents=parts["image"].tobytes(), media_type=media))
        corners = {"mins": boxes[:, :2], "sizes": boxes[:, 2:] - boxes[:, :2]}
        log(f"{path}/image/boxes", rr.Boxes2D(**corners, class_ids=parts["people"]))
        for part, pixels in parts.items():
            if part.startswith("keypoints/"):
                person = part.removeprefix("keypoints/")
                known, label = np.isfinite(pixels).all(axis=1), self.settings.scene.labels[person]
                log(f"{path}/image/{person}", rr.Points2D(pixels[known], class_ids=label, radii=2.0))


def _placed(rr: Any, pose: Any) -> Any:
    """Transform of a position and quaternion (7,)."""
    return rr.Transform3D(translation=pose[:3], quaternion=pose[3:])
