"""Rerun: a recording as the library's own reader has it, against the simulation."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from export_support import exported, small_scene

from humansim_ros import Scene, Simulation
from humansim_ros.people import keypoint_set

chunks = pytest.importorskip("rerun.chunk", reason="rerun-sdk reads the recording")

SCANNER = {"pattern": {"elevations_deg": [-10, 0], "columns": 180}, "rate": 20, "range": [0.2, 30]}
PLACE = {"position": [2.0, -0.5, 1.0], "stamp": "end"}


def contents(path: Path) -> dict[tuple[str, str], dict[int | None, Any]]:
    """Values by entity and component, then by number of the frame; None for those that always hold."""
    found: dict[tuple[str, str], dict[int | None, Any]] = {}
    for chunk in chunks.RrdReader(path).stream():
        batch = chunk.to_record_batch()
        names = batch.schema.names
        frames = [None] * batch.num_rows if chunk.is_static else batch.column("frame").to_pylist()
        if not chunk.is_static:
            times = batch.column("scene_time").cast("int64").to_pylist()
            assert times == [frame * 50_000_000 for frame in frames]
        for name in names:
            if ":" in name:
                values = found.setdefault((chunk.entity_path, name), {})
                values.update(zip(frames, batch.column(name).to_pylist(), strict=True))
    return found


@pytest.mark.slow
def test_a_recording_has_what_the_simulation_has(tmp_path: Path) -> None:
    config = small_scene().config.model_dump(mode="json", exclude_defaults=True)
    scene = Scene.from_dict({**config, "scanners": {"lidar": {**SCANNER, **PLACE}}})
    root = exported(tmp_path / "out", "rerun", scene, frames="3:5")
    found = contents(root / "rerun" / "rerun.rrd")
    with Simulation(scene, ("rgb", "depth", "instance", "part", "amodal")) as simulation:
        frames = [simulation.frame(index) for index in (3, 4)]
    for frame in frames:

        def of(entity: str, component: str, index: int | None = frame.index) -> Any:
            return np.array(found[entity, component][index])

        for name, camera in frame.cameras.items():
            image = np.frombuffer(
                bytes(of(f"/cameras/{name}/image", "EncodedImage:blob").ravel().tolist()), np.uint8
            )
            pixels = cv2.imdecode(image, cv2.IMREAD_COLOR)[..., ::-1]
            np.testing.assert_array_equal(pixels, frame.views[name].rgb)
            matrix = (
                of(f"/cameras/{name}/image", "Pinhole:image_from_camera").reshape(3, 3).T
            )  # columns first
            turn = of(f"/cameras/{name}", "Transform3D:mat3x3").reshape(3, 3).T
            center = of(f"/cameras/{name}", "Transform3D:translation")[0]
            point = np.array([0.1, 0.2, 0.9])
            seen = matrix @ turn.T @ (point - center)
            bare = camera.K @ (camera.R @ point + camera.t)
            np.testing.assert_allclose(seen[:2] / seen[2], bare[:2] / bare[2] + 0.5, atol=1e-3)
            halves = of(f"/cameras/{name}/image/boxes", "Boxes2D:half_sizes")
            boxes = [frame.truth[name].boxes[person] for person in frame.humans]
            widths = [(box.visible[2] - box.visible[0]) / 2 for box in boxes if box.pixels]
            np.testing.assert_allclose(halves[:, 0], widths, atol=1e-4)
        for name, state in frame.humans.items():
            vertices = of(f"/people/{name}/body", "Mesh3D:vertex_positions")
            np.testing.assert_array_equal(vertices.astype(np.float32), state.vertices)
            triangles = of(f"/people/{name}/body", "Mesh3D:triangle_indices", None)
            np.testing.assert_array_equal(triangles, scene.actors[name].human.mesh.triangles)
            points = frame.keypoint_positions["coco17"][name]
            np.testing.assert_allclose(
                of(f"/people/{name}/keypoints", "Points3D:positions"), points, atol=1e-6
            )
            strips = of(f"/people/{name}/skeleton", "LineStrips3D:strips")
            np.testing.assert_allclose(strips, points[np.array(keypoint_set("coco17").edges)], atol=1e-6)
            box = state.upright_box
            np.testing.assert_allclose(of(f"/people/{name}/box", "Boxes3D:centers")[0], box.center, atol=1e-6)
            np.testing.assert_allclose(
                of(f"/people/{name}/box", "Boxes3D:half_sizes")[0] * 2, box.size, atol=1e-6
            )
        (sweep,) = frame.sweeps["lidar"]
        np.testing.assert_allclose(
            of("/scanners/lidar/points", "Points3D:positions"), sweep.points, atol=1e-5
        )
        np.testing.assert_array_equal(of("/scanners/lidar/points", "Points3D:class_ids"), sweep.instances)


@pytest.mark.nightly
def test_two_recordings_have_the_same_content(tmp_path: Path) -> None:
    files = [exported(tmp_path / name, "rerun") / "rerun" / "rerun.rrd" for name in "ab"]
    assert contents(files[0]) == contents(files[1])
    stores = [
        [(store.application_id, store.recording_id) for store in chunks.RrdReader(file).recordings()]
        for file in files
    ]
    assert stores[0] == stores[1] and len(stores[0]) == 1
