"""BVH files of an export: joints as in the scene, also for people of another size."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from keyframe_text import keyframes

from humansim_ros import Scene, read_bvh
from humansim_ros.data.formats.animation import AnimatedHuman
from humansim_ros.data.formats.glb import BvhWriter, posed_bones
from humansim_ros.data.formats.writer import ExportFolder, ExportFrame, ExportScene, ExportSettings
from humansim_ros.errors import HumansimWarning
from humansim_ros.geometry import WORLD_FROM_BODY
from humansim_ros.scene import Frame


def export(folder: Path, first_size: float, last_size: float) -> tuple[ExportSettings, list[Frame]]:
    """Write BVH files of the frames 10 to 15 of a scene, as with another process between frames and files."""
    first = {"position": (1, 0, 0), "rotation": (0, 0, 90), "size": (first_size,) * 3}
    last = {"position": (0, 1, 0), "rotation": (0, 0, 0), "size": (last_size,) * 3}
    (folder / "moves.xml").write_text(keyframes(30, 30, ben=(first, last)))
    human: dict[str, Any] = {"body": "child", "motion": {"file": "wave"}}
    scene = Scene.from_dict(
        {
            "humans": {"anna": human, "ben": {**human, "keyframes": str(folder / "moves.xml")}},
            "cameras": {"front": {"position": [3, 0, 1.5], "look_at": [0, 0, 1]}},
        }
    )
    settings = ExportSettings(ExportScene.of(scene), range(10, 15))
    frames = [
        Frame(index, 1, {name: actor.at(index / 30) for name, actor in scene.actors.items()}, {})
        for index in settings.frames
    ]
    writer, out = BvhWriter(settings), ExportFolder(folder)
    records = [(frame.index, writer.frame(ExportFrame(frame, settings), out)) for frame in frames]
    plain = [
        (index, json.loads(json.dumps(record, default=lambda value: value.tolist())))
        for index, record in records
    ]
    writer.finish(plain, out)
    return settings, frames


def test_joints_of_bvh_files_are_those_of_the_people(tmp_path: Path) -> None:
    settings, frames = export(tmp_path, 0.8, 0.8)
    for name, human in settings.scene.humans.items():
        motion = read_bvh(tmp_path / f"{name}.bvh")
        assert motion.n_frames == 5 and motion.frame_time == pytest.approx(1 / 30)
        names = list(human.skeleton.joint_names)
        order = [motion.joint_names.index(joint) for joint in names]
        for index, frame in enumerate(frames):
            found = motion.world_positions(index)[order] / 100 @ WORLD_FROM_BODY.T
            np.testing.assert_allclose(found, frame.humans[name].positions, atol=1e-9)


def test_a_size_that_changes_is_warned_of(tmp_path: Path) -> None:
    with pytest.warns(HumansimWarning, match="size of ben changes"):
        export(tmp_path, 0.8, 1.2)


def test_rotations_stay_away_from_gimbal_lock(tmp_path: Path) -> None:
    """With the order of the other joints, Blender is 15 µm off at an elbow that bends to 90 degrees."""
    scene = Scene.from_dict(
        {
            "humans": {"ben": {"body": "child", "motion": {"file": "wave"}}},
            "cameras": {"front": {"position": [3, 0, 1.5], "look_at": [0, 0, 1]}},
        }
    )
    states = [scene.actors["ben"].at(index / 30) for index in range(60)]
    skeleton = scene.actors["ben"].human.skeleton
    bones = np.array([state.joints[: len(skeleton)] for state in states])
    motion = posed_bones(
        "ben", AnimatedHuman(scene.actors["ben"].human, bones, np.ones(60)), 1 / 30
    ).to_motion()
    orders = {
        name: "".join(channel[0] for channel in channels[-3:])
        for name, channels in zip(motion.joint_names, motion.channels, strict=True)
        if channels
    }
    assert set(orders.values()) == {"ZXY", "XZY"} and orders["r_elbow"] == "XZY"
    column = 0
    for channels in motion.channels:
        middle = motion.values[:, column + len(channels) - 2] if channels else np.zeros(1)
        assert (np.abs(np.cos(np.radians(middle))) > 0.19).all()
        column += len(channels)
    for index, state in enumerate(states):
        found = motion.world_positions(index) / 100 @ WORLD_FROM_BODY.T
        order = [motion.joint_names.index(joint) for joint in skeleton.joint_names]
        np.testing.assert_allclose(found[order], state.positions, atol=1e-9)
