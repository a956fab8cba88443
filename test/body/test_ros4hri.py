"""Links of ROS4HRI: frames, the URDF as MuJoCo reads it, and joint angles."""

from __future__ import annotations

import math
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from humansim_ros import Scene, Simulation
from humansim_ros.data.messages.stacks.ros4hri import JOINTS, LINKS, URDF_JOINTS, HriLinks
from humansim_ros.motion import Skeleton, hanim_skeleton
from humansim_ros.people import Human
from humansim_ros.scene import HumanState
from humansim_ros.types import Array

#: Names of the angles of ROS4HRI's body detectors (hri_fullbody 2.1, jointstate.py), in their order.
PUBLISHED_JOINTS = [
    *("waist", "r_head", "y_head", "p_head"),
    *(f"{side}_{name}" for side in "lr" for name in ("y_shoulder", "p_shoulder", "r_shoulder", "elbow")),
    *(f"{side}_{name}" for side in "lr" for name in ("y_hip", "p_hip", "r_hip", "knee")),
]


@pytest.fixture(scope="module")
def walker() -> tuple[Human, list[HumanState]]:
    """The person of the demo scene, who walks and waves."""
    with Simulation(Scene.load(), channels=()) as simulation:
        frames = [simulation.frame(index) for index in range(0, 300, 50)]
    (name,) = frames[0].humans
    return frames[0].models[name], [frame.humans[name] for frame in frames]


def mujoco_poses(urdf: str, angles: dict[str, float]) -> dict[str, Array]:
    """Poses (4, 4) of the links in the axes of the root, as MuJoCo computes them from a URDF."""
    mujoco: Any = pytest.importorskip("mujoco", reason="reads URDF")
    spec = mujoco.MjSpec.from_string(urdf)
    spec.compiler.fusestatic = 0
    spec.compiler.boundmass = spec.compiler.boundinertia = 1e-3
    model = spec.compile()
    data = mujoco.MjData(model)
    for name, angle in angles.items():
        data.qpos[model.jnt_qposadr[model.joint(name).id]] = angle
    mujoco.mj_kinematics(model, data)
    out = {}
    for number in range(1, model.nbody):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = data.xmat[number].reshape(3, 3), data.xpos[number]
        out[model.body(number).name] = pose
    return out


def model_poses(links: HriLinks, angles: Array, size: float = 1.0) -> dict[str, Array]:
    named = {f"{name}_x": angle for name, angle in zip(JOINTS, angles.tolist(), strict=True)}
    found = mujoco_poses(links.urdf("x", size), named)
    return {"body": np.eye(4), **{name.removesuffix("_x"): pose for name, pose in found.items()}}


def between(a: Array, b: Array) -> float:
    """Angle of the rotation between two poses, radians."""
    return float(np.linalg.norm(a[:3, :3] - b[:3, :3]) / math.sqrt(2))


def test_joints_have_the_names_and_the_order_of_ros4hri() -> None:
    assert list(JOINTS) == PUBLISHED_JOINTS


def test_body_is_midway_between_the_hips_and_faces_forward(
    walker: tuple[Human, list[HumanState]],
) -> None:
    human, states = walker
    links = HriLinks.of(human.skeleton)
    assert links is not None
    for state in states:
        places = dict(zip(state.joint_names, state.positions, strict=True))
        body = links.poses(state.joints)["body"]
        across = places["l_hip"] - places["r_hip"]
        np.testing.assert_allclose(body[:3, 3], (places["l_hip"] + places["r_hip"]) / 2, atol=1e-12)
        np.testing.assert_allclose(body[:3, 1], across / np.linalg.norm(across), atol=1e-6)
        assert body[:3, 2] @ (places["vt3"] - body[:3, 3]) > 0.4  # z to the head
        toes = (places["l_ankle_end"] + places["r_ankle_end"] - places["l_ankle"] - places["r_ankle"]) / 2
        assert body[:3, 0] @ toes > 0.05  # x forward


def test_links_are_at_the_true_joints_with_limbs_along_their_axes(
    walker: tuple[Human, list[HumanState]],
) -> None:
    human, states = walker
    links = HriLinks.of(human.skeleton)
    assert links is not None
    for state in states:
        poses = links.poses(state.joints)
        assert set(poses) == set(LINKS)
        places = dict(zip(state.joint_names, state.positions, strict=True))
        for side in "lr":
            for link in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle"):
                np.testing.assert_array_equal(poses[f"{side}_{link}"][:3, 3], places[f"{side}_{link}"])
            for link, next_one in (
                ("shoulder", "elbow"),
                ("elbow", "wrist"),
                ("hip", "knee"),
                ("knee", "ankle"),
            ):
                limb = places[f"{side}_{next_one}"] - places[f"{side}_{link}"]
                along = -poses[f"{side}_{link}"][:3, 2]
                np.testing.assert_allclose(along, limb / np.linalg.norm(limb), atol=1e-6)
        for pose in poses.values():
            np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-9)
            assert np.linalg.det(pose[:3, :3]) > 0


def test_urdf_has_the_true_lengths(walker: tuple[Human, list[HumanState]]) -> None:
    human, (state, *_) = walker
    links = HriLinks.of(human.skeleton)
    assert links is not None
    robot = ElementTree.fromstring(links.urdf("x"))
    origins = {
        joint.get("name"): np.array(joint.find("origin").get("xyz").split(), float)  # type: ignore[union-attr]
        for joint in robot.iter("joint")
    }
    places = dict(zip(state.joint_names, state.positions, strict=True))
    for side in "lr":
        for joint, link, next_one in (
            ("elbow", "shoulder", "elbow"),
            ("wrist", "elbow", "wrist"),
            ("knee", "hip", "knee"),
            ("ankle", "knee", "ankle"),
        ):
            length = np.linalg.norm(places[f"{side}_{next_one}"] - places[f"{side}_{link}"])
            np.testing.assert_allclose(origins[f"{side}_{joint}_x"], np.array([0, 0, -length]), atol=1e-6)
    assert len(robot.findall("link")) == len(LINKS)
    assert {joint.get("type") for joint in robot.iter("joint")} == {"revolute", "fixed"}


def test_model_at_its_angles_is_the_pose_but_for_spine_and_clavicles(
    walker: tuple[Human, list[HumanState]],
) -> None:
    human, states = walker
    links = HriLinks.of(human.skeleton)
    assert links is not None
    errors: dict[str, list[float]] = {}
    for state in states:
        poses = links.poses(state.joints)
        model = model_poses(links, links.angles(state.joints), links.size(state.joints))
        for link, pose in poses.items():
            placed = poses["body"] @ model[link]
            errors.setdefault(link, []).append(float(np.linalg.norm(placed[:3, 3] - pose[:3, 3])))
            if link in ("head", "l_shoulder", "r_shoulder", "l_elbow", "r_elbow"):
                assert between(placed, pose) < 2e-3
            if link.endswith(("hip", "knee")):
                assert between(placed, pose) < 5e-3
    for side in "lr":
        for link in ("hip", "knee", "ankle"):
            assert max(errors[f"{side}_{link}"]) < 1e-4
    # docs/ros4hri.md has these figures
    assert max(errors["torso"]) < 0.06
    assert max(errors["head"]) < 0.08
    assert max(errors["l_wrist"] + errors["r_wrist"]) < 0.08


def test_angles_of_the_model_are_found_again() -> None:
    """MuJoCo poses the model by random angles; a body in that pose has these angles."""
    skeleton = hanim_skeleton()
    links = HriLinks.of(skeleton)
    assert links is not None
    random = np.random.default_rng(5)
    for _ in range(20):
        angles = random.uniform(-0.9, 0.9, len(JOINTS))
        for name in ("l_p_shoulder", "r_p_shoulder"):
            angles[JOINTS.index(name)] = random.uniform(0.2, 2.9)
        for side in "lr":
            angles[JOINTS.index(f"{side}_elbow")] = random.uniform(0.5, 2.3)
            angles[JOINTS.index(f"{side}_knee")] = -random.uniform(0.5, 2.3)
        model = model_poses(links, angles)
        np.testing.assert_allclose(links.angles(bones_of(links, skeleton, model)), angles, atol=1e-6)


def bones_of(links: HriLinks, skeleton: Skeleton, model: dict[str, Array]) -> Array:
    """Bones (B, 4, 4) of a body whose links have some poses, found from the links of the body at rest."""
    rest = links.poses(skeleton.rest)
    bones = skeleton.rest.copy()
    moved = {
        **{f"{side}_{name}": f"{side}_{name}" for side in "lr" for name in ("hip", "knee", "ankle")},
        **{f"{side}_{name}": f"{side}_{name}" for side in "lr" for name in ("shoulder", "elbow", "wrist")},
        "HumanoidRoot": "body",
        "vl5": "waist",
        "vt3": "p_head",
    }
    for bone, name in enumerate(skeleton.names):
        parent = int(skeleton.parents[bone])
        if name in moved:
            bones[bone] = model[moved[name]] @ np.linalg.inv(rest[moved[name]]) @ skeleton.rest[bone]
        else:
            bones[bone] = bones[parent] @ np.linalg.inv(skeleton.rest[parent]) @ skeleton.rest[bone]
    return bones


def test_signs_of_angles_are_those_of_human_description() -> None:
    """Published axes: elbows bend forward by positive angles, knees back by negative ones, and so on."""
    links = HriLinks.of(hanim_skeleton())
    assert links is not None

    def moves(link: str, **angles: float) -> Array:
        values = np.array([angles.get(name, 0.0) for name in JOINTS])
        return np.asarray(
            model_poses(links, values)[link][:3, 3] - model_poses(links, values * 0)[link][:3, 3]
        )

    assert moves("l_wrist", l_elbow=1.0)[0] > 0.1
    assert moves("r_ankle", r_knee=-1.0)[0] < -0.1
    assert moves("l_wrist", l_p_shoulder=1.0)[1] > 0.1  # out to the left
    assert moves("r_wrist", r_p_shoulder=1.0)[1] < -0.1
    assert moves("l_knee", l_r_hip=0.5)[0] > 0.1  # forward
    assert moves("torso", waist=0.5)[0] > 0.1  # bows
    assert moves("head", p_head=0.5)[0] < 0  # looks up
    assert moves("l_ankle", l_p_hip=0.4)[1] > 0.1
    assert moves("r_ankle", r_p_hip=0.4)[1] < -0.1


def test_a_straight_leg_keeps_its_twist_and_bends_a_little_forward() -> None:
    """Hyperextension of two degrees is a small positive angle, not a leg that is turned round."""
    skeleton = hanim_skeleton()
    links = HriLinks.of(skeleton)
    assert links is not None
    model = model_poses(links, np.array([math.radians(2) if "knee" in name else 0.0 for name in JOINTS]))
    found = dict(zip(JOINTS, links.angles(bones_of(links, skeleton, model)), strict=True))
    assert math.degrees(found["l_knee"]) == pytest.approx(2, abs=1e-3)
    assert abs(found["l_y_hip"]) < 1e-3


def test_a_scaled_person_has_a_scaled_model(walker: tuple[Human, list[HumanState]]) -> None:
    human, (state, *_) = walker
    links = HriLinks.of(human.skeleton)
    assert links is not None
    grown = state.joints.copy()
    grown[:, :3, 3] *= 1.2
    assert links.size(grown) == pytest.approx(1.2)
    np.testing.assert_allclose(links.angles(grown), links.angles(state.joints), atol=1e-9)
    large, small = (model_poses(links, np.zeros(len(JOINTS)), size)["l_wrist"] for size in (1.2, 1.0))
    np.testing.assert_allclose(large[:3, 3], 1.2 * small[:3, 3], atol=1e-9)


def test_gaze_looks_where_the_eyes_look(walker: tuple[Human, list[HumanState]]) -> None:
    human, (state, *_) = walker
    links = HriLinks.of(human.skeleton)
    assert links is not None
    gaze, places = links.gaze(state.joints), dict(zip(state.joint_names, state.positions, strict=True))
    ahead = sum(places[f"{side}_eyeball_joint_end"] - places[f"{side}_eyeball_joint"] for side in "lr")
    np.testing.assert_allclose(gaze[:, 2], ahead / np.linalg.norm(ahead), atol=1e-6)
    right = places["r_eyeball_joint"] - places["l_eyeball_joint"]
    assert gaze[:, 0] @ right / np.linalg.norm(right) > 0.99
    assert gaze[:, 1] @ (places["vt3_end"] - places["vt3"]) < 0  # y down
    assert np.linalg.det(gaze) == pytest.approx(1)


def test_a_skeleton_without_the_bones_has_no_links() -> None:
    whole = hanim_skeleton()
    part = Skeleton(whole.names[:6], whole.parents[:6], whole.heads[:6], whole.tails[:6], whole.rolls[:6])
    assert HriLinks.of(part) is None


def test_each_link_has_one_parent_and_the_root_none() -> None:
    children = [joint.child for joint in URDF_JOINTS]
    assert len(set(children)) == len(children) == len(LINKS) - 1
    assert "body" not in children
