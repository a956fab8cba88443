"""Start every node of a scene: one motion_player, one skinner per human, one camera per camera."""

from pathlib import Path

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from humansim_ros.ros.processes import scene_processes

# launch/ and config/ lie side by side, in the checkout as in share/humansim_ros
DEMO_SCENE = Path(__file__).resolve().parents[1] / "config" / "scenes" / "demo.yaml"


def scene_nodes(context: LaunchContext) -> list[Node]:
    scene = LaunchConfiguration("scene").perform(context)
    return [
        Node(
            package="humansim_ros",
            executable=process.executable,
            name=process.node_name,
            # typed, or launch would turn a camera called off into a boolean
            parameters=[
                {key: ParameterValue(value, value_type=str) for key, value in process.parameters.items()}
            ],
            output="screen",
        )
        for process in scene_processes(scene)
    ]


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription(
        [
            DeclareLaunchArgument("scene", default_value=str(DEMO_SCENE), description="Path of a scene file"),
            OpaqueFunction(function=scene_nodes),
        ]
    )
