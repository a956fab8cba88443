"""Entities of simulation_interfaces: how they are found, their states, and how they are moved."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from simulation_driver import (  # noqa: F401  # fixtures
    FAILED,
    NOT_FOUND,
    OK,
    UNSUPPORTED,
    Driver,
    driver_fixture,
    entity_state,
    paused_fixture,
    running_fixture,
    scene_fixture,
    set_flags,
    yaw,
)

from humansim_ros.data import messages
from humansim_ros.ros.graph.qos import DATA
from humansim_ros.scene import Scene

pytestmark = pytest.mark.usefixtures("interfaces")


EVERYTHING = [
    "humans/walker",
    "humans/carried",
    "humans/other",
    "objects/box",
    "objects/post",
    "left",
    "dolly",
]


def test_entities_are_found_by_name_category_and_tag(driver: Driver) -> None:
    from simulation_interfaces.msg import EntityCategory, TagsFilter

    assert driver.entities() == EVERYTHING
    assert driver.entities(filter="^humans/[[:alpha:]]+er$") == ["humans/walker", "humans/other"]
    assert driver.entities(filter="o[sx]") == ["objects/box", "objects/post"]
    human, static = EntityCategory(category=2), EntityCategory(category=5)
    assert driver.entities(categories=[human, static], filter="o") == ["humans/other", "objects/post"]
    tags = ["camera", "static"]
    assert driver.entities(tags=TagsFilter(tags=tags)) == ["objects/post", "left", "dolly"]
    assert driver.entities(tags=TagsFilter(tags=tags, filter_mode=1)) == ["left"]
    assert driver.entities(tags=TagsFilter(tags=["no such tag"])) == []


def test_entities_have_their_standard_categories(driver: Driver) -> None:
    categories = {"humans/walker": 2, "objects/box": 4, "objects/post": 5, "left": 0}
    for entity, category in categories.items():
        info = driver.call("GetEntityInfo", entity=entity).info
        assert info.category.category == category and info.description
    assert list(info.tags) == ["camera", "static"]


@pytest.mark.parametrize("pattern", ["(", "a" * 10**6, "[[:foo:]]", "x{9999}", "(" * 200])
def test_a_pattern_that_is_none_is_refused(driver: Driver, pattern: str) -> None:
    from simulation_interfaces.msg import EntityFilters

    for service in ("GetEntities", "GetEntitiesStates"):
        code, text = driver.code(service, filters=EntityFilters(filter=pattern))
        assert code == FAILED and "pattern" in text and len(text) < 500


def test_filters_that_are_not_supported_say_so(driver: Driver) -> None:
    from simulation_interfaces.msg import Bounds, EntityCategory, EntityFilters

    assert driver.code("GetEntities", filters=EntityFilters(bounds=Bounds(type=3)))[0] == UNSUPPORTED
    many = [EntityCategory(category=2)] * 2000
    assert driver.code("GetEntities", filters=EntityFilters(categories=many))[0] == FAILED


def test_states_are_those_of_the_frame(paused: Driver, scene: Path) -> None:
    driver = paused
    driver.code("StepSimulation", steps=5)
    truth = Scene.load(scene)
    seconds = driver.player.playback_clock.elapsed * 1e-9
    poses = truth.actors["walker"].joint_poses(seconds)
    hips = poses.names.index("Hips")
    position, rotation, twist = driver.pose("humans/walker")
    np.testing.assert_allclose(position[:2], poses.positions[0, hips, :2], atol=1e-9)
    assert position[2] == 0 and not rotation[:2].any()
    facing = Rotation.from_quat(poses.rotations[0, hips]).as_matrix()[:, 0]
    np.testing.assert_allclose(
        Rotation.from_quat(rotation).as_matrix()[:2, 0], facing[:2] / np.linalg.norm(facing[:2]), atol=1e-9
    )
    moving = driver.mode == "lockstep"  # velocities are those of the messages: 0 during a pause in real time
    speed = np.array([twist.linear.x, twist.linear.y])
    np.testing.assert_allclose(speed, moving * poses.linear[0, hips, :2], atol=1e-9)
    early, late = (truth.actors["walker"].joint_poses(seconds + step) for step in (-1e-4, 1e-4))
    yaws = []
    for each in (early, late):
        x, y, _ = Rotation.from_quat(each.rotations[0, hips]).as_matrix()[:, 0]
        yaws.append(math.atan2(y, x))
    assert twist.angular.z == pytest.approx(moving * (yaws[1] - yaws[0]) / 2e-4, abs=0.05)
    box = truth.objects["box"].at(seconds)
    position, rotation, twist = driver.pose("objects/box")
    np.testing.assert_allclose([*position, *rotation], [*box.position, *box.rotation], atol=1e-9)
    assert twist.linear.y == pytest.approx(moving * box.velocity.linear[1])
    for name in ("left", "dolly"):
        camera = truth.scene_cameras[name].pose(seconds)
        position, rotation, _ = driver.pose(name)
        np.testing.assert_allclose(Rotation.from_quat(rotation).as_matrix(), camera.R.T, atol=1e-9)
        np.testing.assert_allclose(position, -camera.R.T @ camera.t, atol=1e-9)
    answer = driver.call("GetEntitiesStates")
    assert list(answer.entities) == [name for name in EVERYTHING if name != "humans/other"]
    assert len(answer.states) == len(answer.entities)
    code, text = driver.code("GetEntityState", entity="humans/other")
    assert code == FAILED and "another node" in text


@pytest.mark.parametrize(("position", "degrees"), [((1.5, -2.5, 0), 0), ((-3, 0.25, 0), 170)])
def test_a_human_is_put_somewhere_else_and_walks_on(paused: Driver, position: Any, degrees: float) -> None:
    driver = paused
    driver.code("StepSimulation", steps=3)
    before, facing, _ = driver.pose("humans/walker")
    assert driver.place("humans/walker", position, yaw(degrees)) == (OK, "")
    now, rotation, _ = driver.pose("humans/walker")
    np.testing.assert_allclose(now, position, atol=1e-9)
    np.testing.assert_allclose(abs(rotation @ yaw(degrees)), 1, atol=1e-9)
    turn = Rotation.from_quat(rotation) * Rotation.from_quat(facing).inv()
    elapsed = driver.player.playback_clock.elapsed
    driver.code("StepSimulation", steps=10)
    old = Scene.load(driver.player.scene.path).actors["walker"].joint_poses(elapsed * 1e-9 + 0.5)
    hips = old.positions[0, old.names.index("Hips")] * (1, 1, 0)
    expected = now + turn.apply(hips - before)
    np.testing.assert_allclose(driver.pose("humans/walker")[0], expected, atol=1e-6)


def test_an_object_is_put_somewhere_else_and_its_keyframes_go_on(paused: Driver) -> None:
    driver = paused
    driver.client.subscribe(marker_type(), ["/objects/box/marker"])
    assert driver.place("objects/box", (1, 2, 3), yaw(90)) == (OK, "")
    position, rotation, _ = driver.pose("objects/box")
    np.testing.assert_allclose([*position, *rotation], [1, 2, 3, *yaw(90)], atol=1e-9)
    driver.client.spin_until_matched(driver.player)
    driver.code("StepSimulation", steps=4)
    driver.spin_until(
        lambda: driver.player.playback_clock.last in driver.client.received["/objects/box/marker"]
    )
    shown = messages.read_object(
        driver.client.received["/objects/box/marker"][driver.player.playback_clock.last]
    )
    position, rotation, _ = driver.pose("objects/box")
    np.testing.assert_allclose([*shown.position, *shown.rotation], [*position, *rotation], atol=1e-9)
    assert np.linalg.norm(position - [1, 2, 3]) == pytest.approx(0.2, rel=0.05)  # 1 m/s
    assert driver.code("ResetSimulation", scope=2) == (OK, "")  # the state, not the time
    seconds = driver.player.playback.elapsed * 1e-9
    position, _, _ = driver.pose("objects/box")
    np.testing.assert_allclose(position, driver.player.scene.objects["box"].at(seconds).position, atol=1e-9)
    assert seconds > 0


def marker_type() -> Any:
    from visualization_msgs.msg import Marker

    return Marker


def test_a_static_camera_is_moved_from_the_next_frame_on(paused: Driver) -> None:
    from geometry_msgs.msg import PoseStamped

    driver = paused
    driver.client.subscribe(PoseStamped, ["/left/pose"], DATA)
    driver.client.spin_until_matched(driver.player)
    driver.spin_until(lambda: driver.player.playback_clock.last)
    rotation = Rotation.from_euler("xyz", (10, 20, 30), degrees=True).as_quat()
    for position in ((1, 2, 3), (4, 5, 6)):
        last = driver.player.playback_clock.last
        assert driver.place("left", position, rotation) == (OK, "")
        now, turned, twist = driver.pose("left")
        np.testing.assert_allclose([*now, *turned], [*position, *rotation], atol=1e-9)
        assert twist.linear.x == 0
        poses = driver.client.received["/left/pose"]
        driver.spin_until(lambda poses=poses, last=last: max(poses, default=0) > last)
        pose = messages.read_pose(poses[max(poses)])
        np.testing.assert_allclose(-pose.R.T @ pose.t, position, atol=1e-9)
    held = sorted(poses)[-2]  # no way between the places is shown
    np.testing.assert_allclose(poses[held].pose.position.x, 1, atol=1e-9)
    assert max(poses) - held == 1
    driver.spin_until(lambda: not driver.player._simulation._echoes["left"])
    assert driver.pose("left")[0] == pytest.approx([4, 5, 6])
    assert driver.code("ResetSimulation") == (OK, "")
    assert driver.pose("left")[0] == pytest.approx([5, 0, 1.5])


BAD_POSES = {
    "nan": ((math.nan, 0, 0), (0, 0, 0, 1), "finite"),
    "infinite": ((0, math.inf, 0), (0, 0, 0, 1), "finite"),
    "far": ((0, 1e9, 0), (0, 0, 0, 1), "1000 km"),
    "quaternion of zeros": ((0, 0, 0), (0, 0, 0, 0), "length 1"),
    "long quaternion": ((0, 0, 0), (0, 0, 0, 2), "length 1"),
    "nan quaternion": ((0, 0, 0), (0, 0, 0, math.nan), "finite"),
}


def invalid_pose() -> int:
    """Code for a pose that is none; versions before 2.1 have no code of their own for it."""
    from simulation_interfaces.srv import SetEntityState

    return int(getattr(SetEntityState.Response, "INVALID_POSE", FAILED))


@pytest.mark.parametrize("entity", ["humans/walker", "objects/box", "left"])
def test_poses_that_are_none_are_refused(paused: Driver, entity: str) -> None:
    before = paused.pose(entity)[0]
    for position, rotation, reason in BAD_POSES.values():
        code, text = paused.place(entity, position, rotation)
        assert code == invalid_pose() and reason in text
    for changes, reason in (({"frame": "odom"}, "must be in map"), ({"speed": 1.0}, "twist must be zero")):
        code, text = paused.place(entity, (0, 0, 0), **changes)
        assert code == (FAILED if "speed" in changes else invalid_pose()) and reason in text
    np.testing.assert_array_equal(paused.pose(entity)[0], before)


@pytest.mark.parametrize(
    ("entity", "position", "rotation", "reason"),
    [
        ("humans/walker", (0, 0, 0.5), (0, 0, 0, 1), "stands on the floor"),
        ("humans/walker", (0, 0, 0), (1, 0, 0, 0), "stands on the floor"),
        ("humans/carried", (0, 0, 0), (0, 0, 0, 1), "keyframes"),
        ("humans/other", (0, 0, 0), (0, 0, 0, 1), "another node"),
        ("objects/post", (0, 0, 0), (0, 0, 0, 1), "static"),
        ("dolly", (0, 0, 0), (0, 0, 0, 1), "trajectory"),
    ],
)
def test_entities_that_cannot_be_moved_say_why(
    driver: Driver, entity: str, position: Any, rotation: Any, reason: str
) -> None:
    code, text = driver.place(entity, position, rotation)
    assert code == (invalid_pose() if "floor" in reason else FAILED) and reason in text


@pytest.mark.parametrize("name", ["", "walker", "x" * 10**6, "humans/walker\n"])
def test_unknown_entities_are_not_found(driver: Driver, name: str) -> None:
    for service, fields in (
        ("GetEntityState", {}),
        ("GetEntityInfo", {}),
        ("SetEntityState", {"state": entity_state((0, 0, 0))}),
    ):
        code, text = driver.code(service, entity=name, **fields)
        assert code == NOT_FOUND and len(text) < 200


def test_flags_choose_what_is_set(paused: Driver) -> None:
    if not set_flags():
        pytest.skip("versions of simulation_interfaces before 2.1 have no flags")
    state = entity_state((1.0, 1.0, 0.0), speed=1.0)
    code, text = paused.code("SetEntityState", entity="humans/walker", state=state, **set_flags(twist=False))
    assert (code, text) == (OK, "")
    code, text = paused.code("SetEntityState", entity="humans/walker", state=state, **set_flags())
    assert code == FAILED and "twist must be zero" in text
    flags = set_flags(pose=False, twist=False)
    code, text = paused.code("SetEntityState", entity="humans/walker", state=state, **flags)
    assert code == FAILED and "set_pose is false" in text
