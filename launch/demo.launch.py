"""Start all nodes of a scene: motion player, skinners, camera processes, bridge, recorder, evaluator."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, LogInfo, OpaqueFunction, Shutdown
from launch.events.process import ProcessExited
from launch.logging import launch_config
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from humansim_ros.files.reading.assets import resource_path
from humansim_ros.ros.graph.transport import choose_transport, remove_dead_files
from humansim_ros.ros.processes.lockstep_settings import TimeOptions
from humansim_ros.ros.processes.node_processes import (
    RECORDER_NODE,
    NodeProcess,
    relative_namespace,
    render_threads,
    scene_processes,
)
from humansim_ros.ros.processes.run_options import (
    EvaluateOptions,
    RecordOptions,
    launch_arguments,
    launch_options,
    true_or_false,
    whole_number,
)
from humansim_ros.ros.processes.scene_names import read_names
from humansim_ros.ros.processes.stop_signals import CANNOT_WRITE, QUIT, TIMED_OUT, WRONG_INPUT
from humansim_ros.ros.tools.viewer_layouts import rviz_layout
from humansim_ros.scene.core.names import BRIDGE_NODE

DEMO_SCENE = resource_path("config/scenes/demo.yaml")
#: Options whose fields are launch arguments.
OPTIONS = (TimeOptions, RecordOptions, EvaluateOptions)


def scene_nodes(context: LaunchContext) -> list[Node | LogInfo]:
    scene = LaunchConfiguration("scene").perform(context)
    number = whole_number("processes", LaunchConfiguration("processes").perform(context))
    frame_prefix = LaunchConfiguration("frame_prefix").perform(context)
    only = LaunchConfiguration("only").perform(context)
    namespace = LaunchConfiguration("namespace").perform(context)
    time, record, evaluate = (
        launch_options(
            kind, {name: LaunchConfiguration(name).perform(context) for name in launch_arguments(kind)}
        )
        for kind in OPTIONS
    )
    processes = scene_processes(
        scene, number, frame_prefix=frame_prefix, only=only, time=time, record=record, evaluate=evaluate
    )
    if any(process.node_name == BRIDGE_NODE for process in processes):
        check_adapters(scene)
    rviz = true_or_false("rviz", LaunchConfiguration("rviz").perform(context))
    remove_dead_files()
    transport = choose_transport(len(processes))
    warnings = [LogInfo(msg=f"warning: {transport.warning}")] if transport.warning else []
    nodes = [
        Node(
            package="humansim_ros",
            executable=process.executable,
            namespace=relative_namespace(namespace),
            # name and parameters; with `parameters`, a camera named off would become a boolean
            arguments=process.ros_arguments,
            additional_env={**render_threads(processes), **transport.environment},
            output="screen",
            respawn=LaunchConfiguration("respawn"),
            respawn_delay=0.5,
            respawn_max_retries=20,  # in all
            sigterm_timeout=str(process.stop_limit),
            on_exit=on_exit(process),
        )
        for process in processes
    ]
    if rviz:
        nodes.append(rviz_node(scene, relative_namespace(namespace), processes))
    return [*warnings, *nodes]


def check_adapters(path: str) -> None:
    """Check the adapters of a scene before a node starts. In a Python without the libraries of the nodes, the
    bridge does it, and all nodes stop after its error.
    """
    try:
        from humansim_ros.data.messages.topics import check_adapters
        from humansim_ros.scene import Scene
    except ImportError:
        return
    check_adapters(Scene.load(path), installed=True)


def rviz_node(scene: str, namespace: str, processes: list[NodeProcess]) -> Node:
    """RViz with the topics of the scene; the others go on when its window is closed."""
    layout = Path(launch_config.log_dir) / "humansim.rviz"
    layout.write_text(rviz_layout(read_names(scene), namespace))
    sim_time = any(process.parameters.get("use_sim_time") for process in processes)
    parameters = ["--ros-args", "-p", "use_sim_time:=true"] if sim_time else []
    return Node(package="rviz2", executable="rviz2", arguments=["-d", str(layout), *parameters])


def on_exit(process: NodeProcess) -> Callable[[ProcessExited, LaunchContext], list[Shutdown]]:
    """Function that decides whether all nodes stop with one."""
    if process.has_end:
        return stop_after_last_frame
    return stop_after_failed_recording if process.node_name == RECORDER_NODE else stop_after_wrong_input


def stop_after_failed_recording(event: ProcessExited, context: LaunchContext) -> list[Shutdown]:
    """Stop all nodes also if the recorder cannot write any more."""
    if event.returncode == CANNOT_WRITE:
        return [Shutdown(reason="the bag cannot be written")]
    return stop_after_wrong_input(event, context)


def stop_after_wrong_input(event: ProcessExited, context: LaunchContext) -> list[Shutdown]:
    """Stop all nodes after wrong input, which would be reported again, a time-out, or a request to quit."""
    reasons = {
        WRONG_INPUT: "wrong input",
        TIMED_OUT: "a frame was not finished in time",
        QUIT: "a request to quit",
    }
    return [Shutdown(reason=reasons[event.returncode])] if event.returncode in reasons else []


def stop_after_last_frame(event: ProcessExited, context: LaunchContext) -> list[Shutdown]:
    """Stop all nodes also if the motion player has ended after its last frame."""
    if event.returncode == 0:
        return [Shutdown(reason="all frames are finished")]
    return stop_after_wrong_input(event, context)


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription(
        [
            DeclareLaunchArgument("scene", default_value=str(DEMO_SCENE), description="Scene file"),
            DeclareLaunchArgument(
                "processes",
                default_value="",
                description="Number of processes that share the cameras; empty: one per core",
            ),
            DeclareLaunchArgument(
                "only",
                default_value="",
                description="Nodes to start here, such as player,skinners or cameras; empty: all",
            ),
            DeclareLaunchArgument("namespace", default_value="", description="Namespace of all nodes"),
            DeclareLaunchArgument(
                "frame_prefix",
                default_value="",
                description="Text before the optical frames of the cameras, such as lab/",
            ),
            DeclareLaunchArgument(
                "respawn", default_value="true", description="Start a node again that has died: true or false"
            ),
            DeclareLaunchArgument(
                "rviz",
                default_value="false",
                description="Start RViz with the topics of the scene: true or false",
            ),
            *(
                DeclareLaunchArgument(name, default_value="", description=description)
                for kind in OPTIONS
                for name, description in launch_arguments(kind).items()
            ),
            OpaqueFunction(function=scene_nodes),
        ]
    )
