"""The robot of a scene: its drive, its vibration, and cameras that it carries."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np
import pytest
import scipy

from humansim_ros.data.messages import read_command, read_odometry
from humansim_ros.data.messages.robot import in_odometry, odometry_message
from humansim_ros.data.messages.types import Twist, Vector3
from humansim_ros.errors import HumansimError, RosError, SceneError
from humansim_ros.geometry import ObjectPose
from humansim_ros.scene import Scene
from humansim_ros.scene.core.objects import Robot
from humansim_ros.scene.core.playback import Playback

#: A camera in base_link: 0.1 m forward, 0.9 m up, looking forward; 0.2 m to the left.
MOUNT = {"mount": "robot", "position": [0.1, 0.2, 0.9], "look_at": [1.1, 0.2, 0.9], "size": [64, 48]}


def scene(robot: dict[str, Any], **camera: Any) -> Scene:
    cameras = {"front": {**MOUNT, **camera}}
    return Scene.from_dict({"room": None, "humans": {}, "rate": 10, "robot": robot, "cameras": cameras})


def robot(settings: dict[str, Any]) -> Robot:
    built = scene(settings).robot
    assert built is not None
    return built


def base_at(playback: Playback, seconds: float) -> ObjectPose:
    base = playback.show(round(seconds * 1e9)).robot
    assert base is not None
    return base


def heading(rotation: np.ndarray) -> float:
    return float(scipy.spatial.transform.Rotation.from_quat(rotation).as_euler("xyz")[2])


class TestPath:
    #: One second to the corner, one second of turn, one second to the second point.
    PATH: ClassVar = {"points": [[0, 0], [1, 0], [1, 1]], "speed": 1.0, "turn_deg": 90, "end": "clamp"}

    @pytest.mark.parametrize(
        ("seconds", "place", "yaw"),
        [(0.25, (0.25, 0), 0), (1.5, (1, 0), 45), (2.75, (1, 0.75), 90), (9, (1, 1), 90)],
    )
    def test_it_drives_lines_and_turns_on_the_spot(
        self, seconds: float, place: tuple[float, float], yaw: float
    ) -> None:
        base = robot({"path": self.PATH}).base_at(seconds)
        np.testing.assert_allclose(base.position, [*place, 0], atol=1e-9)
        assert math.degrees(heading(base.rotation)) == pytest.approx(yaw, abs=1e-6)

    def test_its_velocity_is_along_its_heading(self) -> None:
        base = robot({"path": self.PATH}).base_at(2.5)
        np.testing.assert_allclose(base.velocity.linear, [0, 1, 0], atol=1e-6)
        turning = robot({"path": self.PATH}).base_at(1.5)
        np.testing.assert_allclose(turning.velocity.angular, [0, 0, math.pi / 2], atol=1e-6)

    def test_a_loop_returns_to_its_start_and_a_turn_back_takes_two_quarters(self) -> None:
        route = robot({"path": {"points": [[0, 0], [2, 0]], "speed": 1, "turn_deg": 90}}).route
        assert route is not None
        assert route.duration == pytest.approx(2 + 2 + 2 + 2)
        np.testing.assert_allclose(route.at(8.5).position, [0.5, 0, 0], atol=1e-9)


class TestCommands:
    def test_it_drives_the_way_of_the_differential_equation(self) -> None:
        playback = Playback(scene({"position": [0.3, -0.2], "yaw_deg": 20, "timeout": 10}))
        commands = [(0.0, 0.8, 0.0), (0.7, 0.5, 1.3), (1.9, -0.4, -0.6)]
        for seconds, speed, turn in commands:
            playback.show(round(seconds * 1e9))
            playback.command(speed, turn)

        def derivative(seconds: float, state: np.ndarray) -> list[float]:
            speed, turn = next(c[1:] for c in reversed(commands) if c[0] <= seconds)
            return [speed * math.cos(state[2]), speed * math.sin(state[2]), turn]

        start = [0.3, -0.2, math.radians(20)]
        wanted = scipy.integrate.solve_ivp(derivative, (0, 3), start, max_step=1e-3, rtol=1e-10, atol=1e-12)
        base = base_at(playback, 3.0)
        np.testing.assert_allclose(base.position[:2], wanted.y[:2, -1], atol=1e-4)
        assert heading(base.rotation) == pytest.approx(wanted.y[2, -1], abs=1e-4)

    def test_it_stops_after_the_timeout_and_keeps_its_limits(self) -> None:
        playback = Playback(scene({"timeout": 0.5, "max_speed": 1.0}))
        playback.show(0)
        playback.command(50.0, 0.0)
        base = base_at(playback, 2.0)
        np.testing.assert_allclose(base.position, [0.5, 0, 0])
        assert not base.velocity.linear.any()

    def test_a_jump_back_shows_the_same_place_again(self) -> None:
        playback = Playback(scene({}))
        playback.show(100_000_000)
        playback.command(1.0, 0.5)
        later = base_at(playback, 0.4).position
        assert not base_at(playback, 0.05).position.any()
        np.testing.assert_array_equal(base_at(playback, 0.4).position, later)
        playback.rewind()
        assert not base_at(playback, 0.4).position.any()

    def test_a_robot_with_a_path_takes_no_commands(self) -> None:
        playback = Playback(scene({"path": TestPath.PATH}))
        with pytest.raises(SceneError, match="no robot that takes commands"):
            playback.command(1.0, 0.0)


class TestMount:
    VIBRATION: ClassVar = {"position": 0.004, "rotation_deg": 0.5, "frequency": 9}

    def test_a_camera_is_where_the_product_of_the_transforms_puts_it(self) -> None:
        made = scene({"path": TestPath.PATH})
        shown = Playback(made).show(2_500_000_000)  # at (1, 0.5), facing +y
        camera = made.scene_cameras["front"].camera_at(shown.cameras["front"])
        np.testing.assert_allclose(camera.center, [0.8, 0.6, 0.9], atol=1e-9)
        ahead, depth = camera.project(np.array([[0.8, 3.6, 0.9]]))
        np.testing.assert_allclose(ahead, [[31.5, 23.5]], atol=1e-6)
        np.testing.assert_allclose(depth, [3.0], atol=1e-9)

    @pytest.mark.parametrize("seconds", [0.4, 1.3, 2.6])
    def test_velocities_are_derivatives_of_the_pose(self, seconds: float) -> None:
        made = scene({"path": TestPath.PATH, "vibration": self.VIBRATION})
        step = 1e-5
        camera = made.scene_cameras["front"]
        before, now, after = (camera.pose(seconds + k * step) for k in (-1, 0, 1))
        linear = (after.position - before.position) / (2 * step)
        turn = scipy.spatial.transform.Rotation.from_quat
        angular = (turn(after.rotation) * turn(before.rotation).inv()).as_rotvec() / (2 * step)
        np.testing.assert_allclose(now.velocity.linear, linear, atol=2e-4)
        np.testing.assert_allclose(now.velocity.angular, angular, atol=2e-3)

    def test_vibration_has_its_deviation_and_odometry_does_not_show_it(self) -> None:
        made = scene({"vibration": self.VIBRATION})
        playback = Playback(made)
        shown = [playback.show(round(t * 1e9)) for t in np.arange(0, 20, 0.037)]
        bodies = np.array([each.objects["robot"].position for each in shown])
        np.testing.assert_allclose(bodies.std(axis=0), 0.004, rtol=0.1)
        assert not any(each.robot.position.any() for each in shown if each.robot is not None)

    def test_a_rig_is_carried_as_a_whole(self, tmp_path: Any) -> None:
        (tmp_path / "rig.toml").write_text(
            '[cam_0]\nname="left"\nsize=[64.0,48.0]\nmatrix=[[60.0,0.0,32.0],[0.0,60.0,24.0],[0.0,0.0,1.0]]\n'
            "distortions=[0.0,0.0,0.0,0.0]\nrotation=[1.2,-1.2,1.2]\ntranslation=[0.0,1.0,0.0]\n"
        )
        sections = {"room": None, "humans": {}, "robot": {"position": [2.0, 0.0], "yaw_deg": 90}}
        free, carried = (
            Scene.from_dict({**sections, "rig": {"file": "rig.toml", **mount}}, tmp_path)
            for mount in ({}, {"mount": "robot"})
        )
        x, y, z = free.cameras["left"].center
        np.testing.assert_allclose(carried.cameras["left"].center, [2 - y, x, z], atol=1e-9)


class TestMessages:
    def test_odometry_is_read_as_it_was_written(self) -> None:
        carrier = robot({"path": {**TestPath.PATH, "points": [[1, 2], [1, 5]]}})
        base = carrier.base_at(1.7)
        np.testing.assert_allclose(in_odometry(carrier, base).position, [1.7, 0, 0], atol=1e-9)
        message = odometry_message(carrier, base, 17)
        assert message.header.frame_id == "odom"
        assert message.child_frame_id == "base_link"
        assert message.twist.twist.linear.x == pytest.approx(1.0, abs=1e-6)
        stamp, read = read_odometry(message, carrier)
        assert stamp == 17
        np.testing.assert_allclose(read.position, base.position, atol=1e-9)
        np.testing.assert_allclose(read.velocity.linear, base.velocity.linear, atol=1e-9)

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            (lambda m: setattr(m.pose.pose.position, "x", math.nan), "not finite"),
            (lambda m: setattr(m.twist.twist.angular, "z", math.inf), "not finite"),
            (lambda m: setattr(m.pose.pose.orientation, "w", 3.0), "length 1"),
            (lambda m: setattr(m, "child_frame_id", "other"), "robot.base_frame is 'base_link'"),
            (lambda m: setattr(m.header.stamp, "sec", -3), "stamp"),
        ],
    )
    def test_hostile_odometry_is_refused(self, change: Any, message: str) -> None:
        carrier = robot({})
        odometry = odometry_message(carrier, carrier.base_at(0), 17)
        change(odometry)
        with pytest.raises(RosError, match=message):
            read_odometry(odometry, carrier)

    def test_a_command_that_is_not_finite_is_refused(self) -> None:
        assert read_command(Twist(linear=Vector3(x=0.5), angular=Vector3(z=-1.0))) == (0.5, -1.0)
        with pytest.raises(RosError, match=r"linear\.x is nan"):
            read_command(Twist(linear=Vector3(x=math.nan)))


@pytest.mark.parametrize(
    ("sections", "message"),
    [
        ({"robot": None}, r"cameras\.front\.mount: the scene has no robot"),
        ({"objects": {"robot": "box"}}, "give objects.robot another name"),
        ({"robot": {"path": TestPath.PATH, "odometry": "/odom"}}, "moved by path and by odometry"),
        ({"robot": {"path": TestPath.PATH, "yaw_deg": 3}}, "has its own start"),
        ({"robot": {"path": {"points": [[0, 0], [0, 0]]}}}, "point 2 is the point before it"),
        ({"robot": {"path": {"points": [[0, 0]]}}}, "path.points"),
        ({"robot": {"speed": 1}}, "max_speed"),
        ({"robot": {"odom_frame": "map"}}, "must differ from each other and from map"),
        ({"robot": {"base_frame": "odom"}}, "must differ from each other and from map"),
        ({"robot": {"mesh": "no_robot.glb"}}, "no_robot.glb"),
        ({"robot": {"trajectory": "no_way.txt"}}, "no_way.txt"),
        (
            {"cameras": {"front": {"mount": "robot", "trajectory": "way.txt"}}},
            "with a mount cannot have a trajectory",
        ),
    ],
)
def test_wrong_settings_are_told(sections: dict[str, Any], message: str) -> None:
    base = {"room": None, "humans": {}, "robot": {}, "cameras": {"front": MOUNT}}
    with pytest.raises(HumansimError, match=message):
        Scene.from_dict({**base, **sections})
