"""A robot of MuJoCo drives among the people of a scene, in lockstep; its cameras are ours.

    humansim export scene.yaml --frames 1 --format mujoco -o robot_world
    python examples/mujoco_robot.py scene.yaml robot_world/mujoco/scene.xml &
    humansim run scene.yaml --lockstep

``scene.yaml`` is in docs/simulators.md: its robot has ``odometry: /odom``, and frames wait for this topic.

Frame k begins when the joints of all people have its stamp. The people of MuJoCo take these poses, physics
goes on to frame k + 1, and the pose of the robot is sent with the stamp of that frame. So our cameras show
people from where MuJoCo has the robot at the stamp of each image.
"""

from __future__ import annotations

import math
import sys
from typing import Any

import mujoco
import numpy as np
import rclpy
from nav_msgs.msg import Odometry
from rclpy.node import Node
from sensor_msgs.msg import MultiDOFJointState

from humansim_ros import HumansimError, Scene
from humansim_ros.data import messages

try:
    from geometry_msgs.msg import TransformStamped
    from tf2_msgs.msg import TFMessage
except ImportError:  # not among the wheels of ROS: make tf2_msgs
    TFMessage = None

#: A differential drive with three rangefinders at the height of hips. Its frame is base_link, on the floor.
ROBOT = """
<mujoco>
  <worldbody>
    <body name="base_link">
      <freejoint name="free"/>
      <geom type="box" size="0.2 0.15 0.06" pos="0 0 0.12" mass="12" rgba="0.9 0.9 0.92 1"/>
      <geom type="cylinder" size="0.015 0.35" pos="-0.1 0 0.55" mass="0.3" rgba="0.2 0.2 0.2 1"/>
      <geom type="sphere" size="0.04" pos="0.16 0 0.045" mass="0.2" condim="1"/>
      <geom type="sphere" size="0.04" pos="-0.16 0 0.045" mass="0.2" condim="1"/>
      <site name="ahead" pos="0.21 0 0.95" zaxis="1 0 0"/>
      <site name="to_left" pos="0.21 0.1 0.95" zaxis="1 0.25 0"/>
      <site name="to_right" pos="0.21 -0.1 0.95" zaxis="1 -0.25 0"/>
      <body name="left" pos="0 0.18 0.08">
        <joint name="left" axis="0 1 0" damping="0.01"/>
        <geom type="cylinder" size="0.08 0.02" zaxis="0 1 0" mass="0.5" friction="1.2"/>
      </body>
      <body name="right" pos="0 -0.18 0.08">
        <joint name="right" axis="0 1 0" damping="0.01"/>
        <geom type="cylinder" size="0.08 0.02" zaxis="0 1 0" mass="0.5" friction="1.2"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <velocity name="left" joint="left" kv="0.5" forcerange="-0.6 0.6"/>
    <velocity name="right" joint="right" kv="0.5" forcerange="-0.6 0.6"/>
  </actuator>
  <sensor>
    <rangefinder name="ahead" site="ahead"/>
    <rangefinder site="to_left"/>
    <rangefinder site="to_right"/>
  </sensor>
</mujoco>
"""
#: Radians per second of the wheels, and the distance in metres at which the robot turns away.
FAST, SLOW, NEAR = 7.0, 2.0, 1.2


class World:
    """The people of a scene and a robot in MuJoCo. ``model``: scene.xml of ``humansim export``."""

    def __init__(self, scene: Scene, model: str) -> None:
        assert scene.robot is not None
        world = mujoco.MjSpec.from_file(model)
        if (ours := world.body("robot")) is not None:  # MuJoCo's robot stands in its place
            world.delete(ours)
        x, y = scene.robot.config.position
        self.start = np.array([x, y, 0.0])
        half = math.radians(scene.robot.config.yaw_deg) / 2
        self.turn = np.array([math.cos(half), 0.0, 0.0, math.sin(half)])
        place = world.worldbody.add_frame(pos=self.start, quat=self.turn)
        world.attach(mujoco.MjSpec.from_string(ROBOT), frame=place, prefix="mujoco_")
        world.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        self.model = world.compile()
        self.steps = math.ceil(scene.period / 0.002)
        self.model.opt.timestep = scene.period / self.steps
        self.data = mujoco.MjData(self.model)
        mujoco.mj_forward(self.model, self.data)

    def take(self, person: str, joints: MultiDOFJointState) -> None:
        """Put a person's bodies where the joints are."""
        for name, transform in zip(joints.joint_names, joints.transforms, strict=True):
            body = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_BODY, f"{person}_{name}")
            if body >= 0:  # ends of fingers, toes and head have no body
                p, q = transform.translation, transform.rotation
                number = self.model.body_mocapid[body]
                self.data.mocap_pos[number] = p.x, p.y, p.z
                self.data.mocap_quat[number] = q.w, q.x, q.y, q.z

    def drive(self) -> None:
        """Go on to the next frame: straight ahead, and to the left of what is near."""
        seen = self.data.sensordata
        self.data.ctrl[:] = SLOW if ((seen >= 0) & (seen < NEAR)).any() else FAST, FAST
        mujoco.mj_step(self.model, self.data, self.steps)
        mujoco.mj_forward(self.model, self.data)

    @property
    def touched(self) -> list[str]:
        """Names of the bodies that the robot touches, but for the ground."""
        geoms = np.unique(self.data.contact.geom).tolist()
        bodies = [self.model.body(self.model.geom_bodyid[geom]).name for geom in geoms]
        return sorted({name for name in bodies if name != "world" and not name.startswith("mujoco_")})

    def odometry(self, stamp: int) -> Odometry:
        """Pose and velocity of the robot, in the frame of its start."""
        message = Odometry(header=messages.header(stamp, "odom"), child_frame_id="base_link")
        free = self.data.joint("mujoco_free")
        start, turn = np.zeros(3), np.zeros(4)
        mujoco.mju_negPose(start, turn, self.start, self.turn)
        position, rotation = np.zeros(3), np.zeros(4)
        mujoco.mju_mulPose(position, rotation, start, turn, free.qpos[:3], free.qpos[3:])
        place, twist = message.pose.pose, message.twist.twist
        place.position.x, place.position.y, place.position.z = position.tolist()
        w, x, y, z = rotation.tolist()
        place.orientation.x, place.orientation.y, place.orientation.z, place.orientation.w = x, y, z, w
        forward = self.data.body("mujoco_base_link").xmat.reshape(3, 3).T @ free.qvel[:3]
        twist.linear.x, twist.linear.y, twist.linear.z = forward.tolist()
        twist.angular.x, twist.angular.y, twist.angular.z = free.qvel[3:].tolist()
        return message


class MujocoRobot(Node):
    """Steps MuJoCo with the frames of the scene, and publishes ``odom`` and, where tf2_msgs is, ``/tf``."""

    def __init__(self, scene: Scene, model: str) -> None:
        super().__init__("mujoco_robot")
        self.scene, self.world = scene, World(scene, model)
        self.joints: dict[str, MultiDOFJointState] = {}
        #: Stamp of the newest frame, and the odometry of the frame after it.
        self.stamp, self.next = 0, Odometry()
        assert scene.robot is not None and scene.robot.config.odometry is not None
        self.odom = self.create_publisher(Odometry, scene.robot.config.odometry, 10)
        self.tf: Any = None if TFMessage is None else self.create_publisher(TFMessage, "/tf", 10)
        for person in scene.actors:
            self.create_subscription(
                MultiDOFJointState,
                f"humans/{person}/joints",
                lambda message, person=person: self.on_joints(person, message),
                10,
            )

    def on_joints(self, person: str, message: MultiDOFJointState) -> None:
        """Go on when all people have the stamp of a new frame; a frame that comes again is answered again."""
        self.joints[person] = message
        stamps = {messages.to_nanoseconds(each.header.stamp) for each in self.joints.values()}
        if len(self.joints) < len(self.scene.actors) or len(stamps) > 1:
            return
        if (stamp := stamps.pop()) > self.stamp:
            for name, joints in self.joints.items():
                self.world.take(name, joints)
            self.world.drive()
            # frame k has the stamp 1 + round(k period): errors do not accumulate
            number = round((stamp - 1) * 1e-9 * self.scene.config.rate)
            self.stamp, self.next = stamp, self.world.odometry(1 + self.scene.frame_time(number + 1))
            if touched := self.world.touched:
                self.get_logger().info(f"the robot touches {', '.join(touched)}")
        if self.tf is not None:
            pose = self.next.pose.pose
            link = TransformStamped(header=self.next.header, child_frame_id="base_link")
            link.transform.rotation = pose.orientation
            link.transform.translation.x, link.transform.translation.y = pose.position.x, pose.position.y
            link.transform.translation.z = pose.position.z
            self.tf.publish(TFMessage(transforms=[link]))
        self.odom.publish(self.next)


def main() -> None:
    rclpy.init()
    arguments = rclpy.utilities.remove_ros_args(sys.argv)[1:]
    if len(arguments) != 2:
        sys.exit(__doc__)
    try:
        scene = Scene.load(arguments[0])
        if scene.robot is None or scene.robot.config.odometry is None:
            sys.exit(f"error: {arguments[0]}: give the scene a robot with odometry: /odom")
        node = MujocoRobot(scene, arguments[1])
    except (HumansimError, ValueError, OSError) as error:
        sys.exit(f"error: {error}")
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
