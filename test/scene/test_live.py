"""Live motion capture: retargeting of joints that are known from messages only."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from conftest import ROOT, SHARED_DATA
from ros_support import Client, write_scene
from scipy.spatial.transform import Rotation
from stand_ins import motion_path
from waiting import end_process

from humansim_ros.data import messages
from humansim_ros.data.messages.humans import motion_message
from humansim_ros.errors import HumansimError, MotionError, RosError
from humansim_ros.motion import read_bvh
from humansim_ros.motion.body.kinematics import JointPoses
from humansim_ros.scene import Scene
from humansim_ros.scene.config.config import MotionConfig
from humansim_ros.scene.core.actor import Actor
from humansim_ros.scene.core.live import JointSource, LiveRetargeter
from humansim_ros.scene.core.source import SceneSource

LINKS = {
    "l_elbow": ("LeftForeArm", "LeftHand"),
    "r_knee": ("RightLeg", "RightFoot"),
    "l_hip": ("LeftUpLeg", "LeftLeg"),
}


@pytest.fixture
def actor(tmp_path: Path) -> Actor:
    return Scene.load(write_scene(tmp_path)).actors["first"]


def renamed(poses: JointPoses, names: dict[str, str]) -> JointPoses:
    return replace(poses, names=tuple(names.get(name, name) for name in poses.names))


#: The walk's joints as Mixamo calls them.
MIXAMO = {
    **{f"{side}{old}": f"{side}{new}" for side in ("Left", "Right") for old, new in (
        ("Collar", "Shoulder"), ("Shoulder", "Arm"), ("Elbow", "ForeArm"), ("Wrist", "Hand"),
        ("Hip", "UpLeg"), ("Knee", "Leg"), ("Ankle", "Foot"),
    )}, "Chest": "Spine",
}  # fmt: skip


def refused(live_retargeter: LiveRetargeter, poses: JointPoses) -> int:
    """Number of times that a pose is rejected before it is accepted."""
    for times in range(50):
        try:
            live_retargeter.retarget(poses)
        except MotionError:
            continue
        return times
    raise AssertionError("never followed")


def test_the_scenes_own_motion_is_followed_as_it_is(actor: Actor) -> None:
    poses = actor.joint_poses(0.7)
    state = LiveRetargeter(actor).retarget(poses)
    np.testing.assert_array_equal(state.joints, actor.state(poses).joints)


def test_other_names_and_sizes_are_found_by_the_first_message(actor: Actor) -> None:
    live_retargeter = LiveRetargeter(actor)
    for seconds in (0.3, 0.9):
        poses = renamed(actor.joint_poses(seconds), MIXAMO)
        poses = replace(poses, positions=1.3 * poses.positions)
        state = live_retargeter.retarget(poses)
        bones = actor.human.skeleton
        for bone, (start, end) in LINKS.items():
            link = poses.positions[0, poses.names.index(end)] - poses.positions[0, poses.names.index(start)]
            along = state.joints[bones.bone(bone), :3, 1]
            assert along @ link / np.linalg.norm(link) > np.cos(np.radians(1))
        assert state.vertices[:, 2].min() == pytest.approx(0.0, abs=0.06)
    assert "by table" in live_retargeter.detected_source
    # the scene's own comes back: as if nothing had been
    own = actor.joint_poses(0.5)
    np.testing.assert_array_equal(live_retargeter.retarget(own).joints, actor.state(own).joints)
    assert live_retargeter.detected_source == ""


def test_joints_in_another_order_are_the_same_joints(actor: Actor) -> None:
    poses = actor.joint_poses(0.4)
    order = np.random.default_rng(3).permutation(len(poses.names))
    assert poses.linear is not None and poses.angular is not None
    shuffled = JointPoses(
        tuple(poses.names[j] for j in order),
        *(part[:, order] for part in (poses.positions, poses.rotations, poses.linear, poses.angular)),
    )
    np.testing.assert_allclose(
        LiveRetargeter(actor).retarget(shuffled).joints, actor.state(poses).joints, atol=1e-12
    )


def test_missing_or_unknown_joints_are_refused_and_the_old_is_kept(actor: Actor) -> None:
    live_retargeter = LiveRetargeter(actor)
    poses = actor.joint_poses(0.4)
    live_retargeter.retarget(poses)
    short = JointPoses(poses.names[:-3], poses.positions[:, :-3], poses.rotations[:, :-3])
    with pytest.raises(MotionError, match="joints are missing"):
        live_retargeter.retarget(short)
    unknown = renamed(poses, {name: f"x{n}" for n, name in enumerate(poses.names)})
    for _ in range(2):
        with pytest.raises(MotionError, match=r"joint table.*parameter joint_names"):
            live_retargeter.retarget(unknown)
    with pytest.raises(MotionError, match="twice: Head"):
        live_retargeter.retarget(renamed(poses, {"Neck": "Head"}))
    np.testing.assert_array_equal(live_retargeter.retarget(poses).joints, actor.state(poses).joints)


def test_a_joint_table_in_the_scenes_folder_matches_unknown_names(ros: None, tmp_path: Path) -> None:
    from rclpy.parameter import Parameter

    from humansim_ros.ros.nodes.skinner import SkinnerNode

    table = yaml.safe_load((ROOT / "config" / "joint_names" / "biovision.yaml").read_text())
    joints = {role: [f"q{name}" for name in names] for role, names in table["joints"].items()}
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump({**table, "name": "mine", "joints": joints}))
    scene = Parameter("scene", value=str(write_scene(tmp_path)))

    def skinner(names: str) -> Any:
        return SkinnerNode(
            parameter_overrides=[scene, Parameter("joint_names", value=names)], namespace="table"
        )

    node = skinner("mine.yaml")
    poses = node._actor.joint_poses(0.4)
    node._live_retargeter.retarget(renamed(poses, {name: f"q{name}" for name in poses.names}))
    assert "by table mine" in node._live_retargeter.detected_source
    node.destroy_node()
    with pytest.raises(MotionError, match=r"yours\.yaml"):
        skinner("yours.yaml")


def test_a_legend_gives_the_truth_of_a_changed_motion(actor: Actor, tmp_path: Path) -> None:
    """Motion of another person with other names: with its legend it gives the same as in the scene."""
    config = MotionConfig(file="walk_straight", retarget="thesis", root_scale="height", mirror=True)
    other = actor.with_motion(config, SceneSource(folder=tmp_path))
    names = {name: MIXAMO.get(name, name) for name in other.motion.names}
    legend = JointSource.of_actor(other).to_dict()
    legend["joint_names"] = [names[name] for name in legend["joint_names"]]
    live_retargeter = LiveRetargeter(actor)
    live_retargeter.add_legend(json.loads(json.dumps(legend)))
    poses = other.joint_poses(0.8)
    state = live_retargeter.retarget(renamed(poses, names))
    np.testing.assert_allclose(state.joints, other.state(poses).joints, atol=1e-12)
    # joints of these names but of somebody taller are no longer the legend's
    taller = renamed(replace(poses, positions=1.2 * poses.positions), names)
    assert refused(live_retargeter, taller) == 4
    assert "by table" in live_retargeter.detected_source


def test_a_legend_holds_from_its_stamp_on(actor: Actor) -> None:
    """Frames that were sent before the motion changed belong to the previous motion."""
    higher = replace(actor, retargeter=replace(actor.retargeter, lift=actor.retargeter.lift + 0.5))
    live_retargeter = LiveRetargeter(actor)
    for source in (JointSource.of_actor(actor), JointSource.of_actor(higher, since=1000)):
        live_retargeter.add_legend(json.loads(json.dumps(source.to_dict())))
    poses = actor.joint_poses(0.4)
    for stamp, expected in ((999, actor), (1000, higher), (998, actor), (2000, higher)):
        state = live_retargeter.retarget(poses, stamp)
        np.testing.assert_allclose(state.joints, expected.state(poses).joints, atol=1e-12)


def test_a_bad_frame_changes_nothing(actor: Actor) -> None:
    """Tracker glitches: one wrong joint, all joints at the origin; the frames after them are as before."""
    live_retargeter = LiveRetargeter(actor)
    poses = renamed(actor.joint_poses(0.4), MIXAMO)
    before = live_retargeter.retarget(poses).joints
    found = live_retargeter.detected_source
    glitch = poses.positions.copy()
    glitch[0, poses.names.index("LeftLeg")] += 0.4
    for wrong in (glitch, 0 * glitch, glitch * 1e5):
        for _ in range(3):
            with pytest.raises(MotionError, match="bad frame"):
                live_retargeter.retarget(replace(poses, positions=wrong))
        np.testing.assert_array_equal(live_retargeter.retarget(poses).joints, before)
    assert live_retargeter.detected_source == found


def test_known_joint_names_with_other_rotation_conventions_are_a_new_source(
    actor: Actor,
) -> None:
    """Joints of the scene's motion with other joint axes, as a suit may send the same file."""
    own = Rotation.random(len(actor.motion.names), random_state=5)
    live_retargeter = LiveRetargeter(actor)
    for seconds in (0.1, 0.6):
        poses = actor.joint_poses(seconds)
        turned = (Rotation.from_quat(poses.rotations[0]) * own).as_quat()[None]
        state = live_retargeter.retarget(replace(poses, rotations=turned))
        assert "with rotations" in live_retargeter.detected_source
        bones = actor.human.skeleton
        shin = (
            poses.positions[0, poses.names.index("LeftAnkle")]
            - poses.positions[0, poses.names.index("LeftKnee")]
        )
        along = state.joints[bones.bone("l_knee"), :3, 1]
        assert along @ shin / np.linalg.norm(shin) > np.cos(np.radians(1))
        feet = actor.state(poses).joints[bones.bone("l_ankle"), :3, 1]
        assert state.joints[bones.bone("l_ankle"), :3, 1] @ feet > np.cos(np.radians(35))


def test_a_suit_that_starts_in_its_rest_pose_is_followed_with_rotations_when_it_moves(actor: Actor) -> None:
    """At rest all rotations are the identity; they count as soon as they differ."""
    rest = actor.motion.motion.rest_positions() * 0.01
    still = JointPoses(
        actor.motion.names, rest[None][..., [2, 0, 1]], np.tile([0.0, 0, 0, 1], (1, len(rest), 1))
    )
    live_retargeter = LiveRetargeter(actor)
    live_retargeter.retarget(renamed(still, MIXAMO))
    assert "positions only" in live_retargeter.detected_source
    times = [refused(live_retargeter, renamed(actor.joint_poses(0.01 * n), MIXAMO)) for n in range(6)]
    assert (times[0], sum(times[1:])) == (4, 0)
    assert "with rotations" in live_retargeter.detected_source


def test_a_source_is_fitted_better_when_thirty_messages_are_known(actor: Actor) -> None:
    """The motion starts slightly above the floor; the floor is detected later."""
    live_retargeter = LiveRetargeter(actor)
    lift = np.zeros((1, 1, 3))
    lift[..., 2] = 0.1
    heights = []
    for n in range(32):
        poses = renamed(actor.joint_poses(n / 15), MIXAMO)
        up = lift if n < 5 else 0 * lift
        heights.append(
            live_retargeter.retarget(replace(poses, positions=poses.positions + up)).vertices[:, 2].min()
        )
    assert min(heights[5:28]) < -0.05
    assert heights[-1] == pytest.approx(0.0, abs=0.03)


@pytest.mark.daily("broken0", "broken3")
@pytest.mark.parametrize(
    "broken",
    [
        {},
        {"joint_names": []},
        {"roles": {"Hips": 99}},
        {"scale": None},
        {"since": float("inf")},
        {"links": [[0, 1, 2]]},
        {"slack": "none"},
    ],
)
def test_a_broken_legend_is_refused(actor: Actor, broken: dict[str, Any]) -> None:
    legend = {**JointSource.of_actor(actor).to_dict(), **broken} if broken else {}
    live_retargeter = LiveRetargeter(actor)
    with pytest.raises(MotionError, match=r"legend|constants"):
        live_retargeter.add_legend(legend)
    poses = actor.joint_poses(0.1)
    np.testing.assert_array_equal(live_retargeter.retarget(poses).joints, actor.state(poses).joints)


def test_unset_rotations_are_no_rotations(actor: Actor) -> None:
    message = motion_message(actor.joint_poses(0.2), 5)
    for transform in message.transforms:
        transform.rotation.w = transform.rotation.x = transform.rotation.y = transform.rotation.z = 0.0
    message.joint_names = [MIXAMO.get(name, name) for name in message.joint_names]
    live_retargeter = LiveRetargeter(actor)
    state = live_retargeter.retarget(messages.read_joints(message))
    assert "positions only" in live_retargeter.detected_source
    assert np.isfinite(state.vertices).all()
    message.transforms[3].rotation.w = 1.0
    with pytest.raises(HumansimError, match="quaternion"):
        messages.read_joints(message)


def test_a_noisy_tracker_loses_no_frame(actor: Actor) -> None:
    """Noise of two millimetres and one degree in every joint and frame."""
    random = np.random.default_rng(7)
    live_retargeter = LiveRetargeter(actor)
    for n in range(60):
        poses = renamed(actor.joint_poses(n / 30), MIXAMO)
        shape = poses.positions.shape
        turns = Rotation.from_rotvec(random.normal(0, np.radians(1), shape[1:]))
        rotations = (turns * Rotation.from_quat(poses.rotations[0])).as_quat()[None]
        positions = poses.positions + random.normal(0, 0.002, shape)
        live_retargeter.retarget(replace(poses, positions=positions, rotations=rotations))
    assert "with rotations" in live_retargeter.detected_source


def test_messages_that_are_none_are_refused(actor: Actor) -> None:
    poses = actor.joint_poses(0.2)

    def message() -> Any:
        return motion_message(poses, 5)

    wrong = [message() for _ in range(5)]
    wrong[0].header.frame_id = "mocap"
    wrong[1].transforms = wrong[1].transforms[:-1]
    wrong[2].joint_names, wrong[2].transforms = [], []
    wrong[3].transforms[0].translation.x = float("nan")
    wrong[4].transforms[0].translation.x = 1e9
    for broken in wrong:
        with pytest.raises(RosError):
            messages.read_joints(broken)
    unknown = message()
    unknown.twist[2].linear.x = float("nan")
    assert messages.read_joints(unknown).linear is None


@pytest.mark.daily("walk")
@pytest.mark.slow
@pytest.mark.parametrize(
    "stem", ["walk", "own_mixamo", *(["mixamo_freebvh"] if SHARED_DATA.is_dir() else [])]
)
def test_the_example_drives_a_skinner_in_another_process(ros: None, tmp_path: Path, stem: str) -> None:
    """Bones are parallel to the links of the example's joints, upright, on the floor."""
    from rclpy.parameter import Parameter
    from sensor_msgs.msg import MultiDOFJointState, PointCloud2

    from humansim_ros.ros.nodes.skinner import SkinnerNode

    human = f"human_{stem}"
    scene = tmp_path / "scene.yaml"
    scene.write_text(
        f"humans: {{{human}: {{}}}}\ncameras: {{c: {{position: [3, 0, 1], look_at: [0, 0, 1]}}}}\n"
    )
    file = motion_path(stem)
    if stem == "walk":
        # as another program would call its joints
        text = (ROOT / "assets" / "motions" / "walk.bvh").read_text()
        file = tmp_path / "suit.bvh"
        file.write_text(re.sub(r"(?<=JOINT )\w+", lambda name: f"suit:{MIXAMO.get(name[0], name[0])}", text))
    skinner = SkinnerNode(parameter_overrides=[Parameter("scene", value=str(scene))])
    client = Client(f"watcher_{stem}")
    client.executor.add_node(skinner)
    motion_topic, joints_topic = (f"/humans/{human}/{kind}" for kind in ("motion", "joints"))
    client.subscribe(MultiDOFJointState, [motion_topic, joints_topic], 500)
    client.subscribe(PointCloud2, [f"/humans/{human}/vertices"], 500)
    process = subprocess.Popen(
        [sys.executable, str(ROOT / "examples" / "live_mocap.py"), str(file), human],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        done = client.spin_until(lambda: len(client.received) == 3 and len(client.common_stamps()) >= 5)
    finally:
        end_process(process)
        error = process.communicate()[1]
    assert done, error
    names = read_bvh(file).joint_names
    ends = {bone: [next(n for n in names if n.endswith(e)) for e in link] for bone, link in LINKS.items()}
    for stamp in client.common_stamps():
        sent = messages.read_joints(client.received[motion_topic][stamp])
        got = messages.read_joints(client.received[joints_topic][stamp])
        for bone, (start, end) in ends.items():
            link = sent.positions[0, sent.names.index(end)] - sent.positions[0, sent.names.index(start)]
            turn = Rotation.from_quat(got.rotations[0, got.names.index(bone)])
            cosine = turn.apply([0, 1, 0]) @ link / np.linalg.norm(link)
            assert np.degrees(np.arccos(min(cosine, 1))) < 1.0
        vertices = messages.read_vertices(client.received[f"/humans/{human}/vertices"][stamp])
        assert vertices[:, 2].min() == pytest.approx(0.0, abs=0.12)
        assert 1.5 < vertices[:, 2].max() < 2.0
    skinner.destroy_node()
    client.close()
