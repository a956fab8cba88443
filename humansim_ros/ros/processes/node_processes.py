"""List the processes that ``humansim run`` and the launch file start for a scene."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from humansim_ros.errors import RosError, unknown
from humansim_ros.files.reading import cores, thread_limits
from humansim_ros.ros.processes.lockstep_settings import TOPIC_PREFIX, ParameterValue, TimeOptions
from humansim_ros.ros.processes.run_options import EvaluateOptions, RecordOptions
from humansim_ros.ros.processes.scene_names import SceneNames, read_names
from humansim_ros.ros.processes.stop_signals import CANNOT_WRITE, QUIT, TIMED_OUT, WRONG_INPUT
from humansim_ros.scene.core import BRIDGE_NODE, LOCKSTEP, PLAYER_NODE, skinner_node

#: Environment variable that tells nodes that their parent has already shown the warnings of the scene.
WARNINGS_SHOWN = "HUMANSIM_SCENE_WARNINGS_SHOWN"
#: Name of the node that receives the frames for all cameras of a process. ROS tools hide names that begin
#: with ``_``, so users see the same nodes for any number of processes.
RIG_NODE = "_camera_rig"
#: Name of the node that creates the skinners of a process. It is hidden like the node for the cameras.
SKINNER_RIG_NODE = "_skinner_rig"
#: Words of the option ``only`` that stand for several nodes of a scene, or for a node instead of its name.
_PLAYER, _SKINNERS, _CAMERAS, _SCANNERS = "player", "skinners", "cameras", "scanners"
#: Name of the node that records the topics of a run.
RECORDER_NODE = "recorder"
#: Name of the node that evaluates an estimate.
EVALUATOR_NODE = "evaluator"


@dataclass(frozen=True)
class NodeProcess:
    """A process to start.

    Attributes:
        executable: Executable of this package.
        node_name: Name of the node that the process starts. This node may create more nodes.
        parameters: Parameters of all nodes of the process.
        log_level: Log level of the nodes.
        namespace: ROS namespace of the nodes, without the first /.
        stop_limit: Seconds until a process that does not stop is killed, more than its shutdown may take.
        final_codes: Exit codes after which the process is not started again.
        stops_last: Whether to stop the process after all others, so that it receives their last messages.
    """

    executable: str
    node_name: str
    parameters: Mapping[str, ParameterValue]
    log_level: str = "info"
    namespace: str = ""
    stop_limit: float = 6.0
    final_codes: frozenset[int] = frozenset({WRONG_INPUT, TIMED_OUT, QUIT})
    stops_last: bool = False

    @property
    def renders(self) -> bool:
        """Whether the nodes of the process are cameras."""
        return self.executable in ("camera", "camera_rig")

    @property
    def has_end(self) -> bool:
        """Whether the process can end by itself after a number of frames."""
        return self.parameters.get("mode") == LOCKSTEP

    @property
    def visible_nodes(self) -> tuple[str, ...]:
        """Names of the nodes of the process, without hidden nodes."""
        cameras, humans = (self.parameters.get(name) for name in ("cameras", "humans"))
        if isinstance(humans, list):
            return tuple(skinner_node(str(name)) for name in humans)
        return tuple(cameras) if isinstance(cameras, list) else (self.node_name,)

    @property
    def ros_arguments(self) -> list[str]:
        """Command-line arguments that set name, namespace and parameters of the node."""
        arguments = ["--ros-args", "-r", f"__node:={self.node_name}"]
        if self.namespace:
            arguments += ["-r", f"__ns:=/{self.namespace}"]
        for name, value in self.parameters.items():
            # quoted, because ROS parses values as YAML: a camera named off would be a boolean
            arguments += ["-p", f"{name}:={json.dumps(value, ensure_ascii=False)}"]
        return arguments if self.log_level == "info" else [*arguments, "--log-level", self.log_level]


def relative_namespace(text: str) -> str:
    """A ROS namespace without its first /. Empty for no namespace. Raises RosError if it is not valid."""
    namespace = text.strip("/")
    if namespace and not re.fullmatch(r"[A-Za-z_]\w*(/[A-Za-z_]\w*)*", namespace, re.ASCII):
        raise RosError(
            f"namespace {text!r}: each name between slashes may have only letters, digits and _, and must "
            "not begin with a digit"
        )
    return namespace


def scene_processes(
    scene_path: str | os.PathLike[str],
    processes: int | None = None,
    namespace: str = "",
    frame_prefix: str = "",
    only: str = "",
    time: TimeOptions | None = None,
    record: RecordOptions | None = None,
    evaluate: EvaluateOptions | None = None,
) -> list[NodeProcess]:
    """List the processes of a scene: motion player, skinners, cameras, laser scanners (one process each),
    bridge (if the scene has adapters), and on request recorder and evaluator.

    The humans are divided among at most as many skinner processes as this machine has cores.

    Args:
        scene_path: Scene file.
        processes: Number of processes that share the cameras. If None, one per core.
        namespace: ROS namespace of all nodes.
        frame_prefix: Text that is put before the tf frames of all cameras and scanners.
        only: Nodes to list, separated by commas: ``player``, ``skinners``, ``cameras``, ``scanners`` and
            names of nodes. If empty, all nodes.
        time: How time advances. If None, as the scene says.
        record: What is recorded. If None, there is no recorder.
        evaluate: Estimate that is evaluated. If None, there is no evaluator.

    Raises:
        HumansimError: The namespace or a name in the scene is not valid in ROS, the scene has no node with a
            name in ``only``, or the path of the bag exists.
    """
    path = Path(scene_path).resolve()
    names = read_names(path)
    chosen = _chosen_nodes(names, only, path)
    # with their numbers in the scene: on several hosts, no two processes have a number in common
    cameras = [(i, name) for i, name in enumerate(names.cameras, 1) if name in chosen]
    humans = [(i, name) for i, name in enumerate(names.humans, 1) if skinner_node(name) in chosen]
    namespace = relative_namespace(namespace)
    time = time or TimeOptions()
    in_lockstep = names.lockstep if time.lockstep is None else time.lockstep
    if in_lockstep:
        time = replace(time, lockstep=True)
    scene_file: dict[str, ParameterValue] = {"scene": str(path)}
    scene = {**scene_file, **({"use_sim_time": True} if in_lockstep else {})}
    recorder = {"recorder": RECORDER_NODE} if record is not None and in_lockstep else {}
    of_cameras = {**scene, **({"frame_prefix": frame_prefix} if frame_prefix else {})}
    listed = [
        NodeProcess("motion_player", PLAYER_NODE, {**scene_file, **time.parameters, **recorder}),
        *_skinner_processes(humans, scene),
        *_camera_processes(cameras, cores() if processes is None else processes, of_cameras),
        *(
            NodeProcess("scanner", name, {**of_cameras, "scanner": name, "start_scene": False})
            for name in names.scanners
        ),
    ]
    if names.adapters:
        listed.append(NodeProcess("bridge", BRIDGE_NODE, of_cameras))
    here = [process for process in listed if not chosen.isdisjoint(process.visible_nodes)]
    if record is not None:
        here.append(_recorder(record, names, scene, time.wait_for))
    if evaluate is not None:
        here.append(_evaluator(evaluate, names, in_lockstep))
    return [replace(process, namespace=namespace) for process in here]


def _chosen_nodes(names: SceneNames, only: str, path: Path) -> set[str]:
    """Names of the nodes that ``only`` selects; all nodes if ``only`` is empty. Raises RosError for unknown
    names."""
    groups = {
        _PLAYER: [PLAYER_NODE],
        _SKINNERS: [skinner_node(name) for name in names.humans],
        _CAMERAS: list(names.cameras),
        _SCANNERS: list(names.scanners),
        **({BRIDGE_NODE: [BRIDGE_NODE]} if names.adapters else {}),
    }
    nodes = {name: [name] for group in groups.values() for name in group}
    known = {**groups, **nodes}  # a camera may be called cameras: the node of a name has priority
    if not only.strip():
        return set(nodes)
    chosen: set[str] = set()
    for name in (each.strip() for each in only.split(",")):
        if name not in known:
            raise RosError(unknown("node to start", name, known, "the scene"), path=path)
        chosen.update(known[name])
    if not chosen:
        raise RosError(f"no node to start: the scene has no {only.strip()}", path=path)
    return chosen


def _recorder(
    record: RecordOptions,
    names: SceneNames,
    scene: Mapping[str, ParameterValue],
    wait_for: Sequence[str] | None,
) -> NodeProcess:
    """Process of the recorder of a run. If the process is started again, it continues the bag.

    Args:
        record: What is recorded.
        names: Names of the scene.
        scene: Parameters of all nodes that follow the player.
        wait_for: Members of lockstep. If None, the members of the scene.

    Raises:
        RosError: The path of the bag exists, or a camera has the name of the recorder.
    """
    output = record.folder.resolve()
    if output.exists():
        raise RosError("this path exists; choose another name for the bag", path=record.folder)
    _check_free(RECORDER_NODE, "records", names)
    parameters: dict[str, ParameterValue] = {**scene, "output": str(output), "resume": True}
    parameters["compression"] = record.compression
    parameters["lockstep"] = "use_sim_time" in scene
    if record.topics:
        parameters["topics"] = list(record.topics)
    if awaited := [
        each.removeprefix(TOPIC_PREFIX) for each in wait_for or () if each.startswith(TOPIC_PREFIX)
    ]:
        parameters["awaited"] = awaited
    # it writes what it has received, and cannot do so on another start after it has failed
    return NodeProcess(
        "recorder",
        RECORDER_NODE,
        parameters,
        stop_limit=120.0,
        final_codes=frozenset({CANNOT_WRITE, WRONG_INPUT}),
        stops_last=True,  # cameras send then the images that faults hold back
    )


def _evaluator(evaluate: EvaluateOptions, names: SceneNames, in_lockstep: bool) -> NodeProcess:
    """Process of the evaluator of a run. Raises RosError if a camera has the name of the evaluator."""
    _check_free(EVALUATOR_NODE, "evaluates", names)
    parameters: dict[str, ParameterValue] = {"topic": evaluate.topic, "keypoints": evaluate.keypoints}
    if evaluate.scale != 1:
        parameters["scale"] = evaluate.scale
    if evaluate.axes:
        parameters["axes"] = evaluate.axes
    if evaluate.output is not None:
        parameters["output"] = str(evaluate.output.resolve())
    if in_lockstep:
        parameters["use_sim_time"] = True
    # the result of a long run takes long
    return NodeProcess("evaluator", EVALUATOR_NODE, parameters, stop_limit=120.0)


def _check_free(node: str, verb: str, names: SceneNames) -> None:
    if node in names.cameras:
        text = f"the node of a camera has its name, and {node} is the node that {verb}"
        raise RosError(f"{text}: give the camera another name", key=f"cameras.{node}")


def _skinner_processes(
    humans: Sequence[tuple[int, str]], scene: Mapping[str, ParameterValue]
) -> Iterator[NodeProcess]:
    """Processes of the skinners. ``humans``: number and name of each human."""
    for number, names in _shares(humans, cores()):
        if len(names) == 1:
            yield NodeProcess("skinner", skinner_node(names[0]), {**scene, "human": names[0]})
        else:
            yield NodeProcess("skinner_rig", f"{SKINNER_RIG_NODE}_{number}", {**scene, "humans": names})


def _shares(numbered: Sequence[tuple[int, str]], most: int) -> Iterator[tuple[int, list[str]]]:
    """Divide numbered names among at most ``most`` processes. Yields for each process the number of its first
    name, and its names."""
    count = min(most, len(numbered))
    for i in range(count):
        yield numbered[i][0], [name for _, name in numbered[i::count]]


def _camera_processes(
    cameras: Sequence[tuple[int, str]], processes: int, scene: Mapping[str, ParameterValue]
) -> Iterator[NodeProcess]:
    """Processes of the cameras. ``cameras``: number and name of each camera."""
    scene = {**scene, "start_scene": False}  # the skinners will come
    for number, names in _shares(cameras, processes):
        if len(names) == 1:
            yield NodeProcess("camera", names[0], {**scene, "camera": names[0]})
        else:
            yield NodeProcess("camera_rig", f"{RIG_NODE}_{number}", {**scene, "cameras": names})


def render_threads(processes: Sequence[NodeProcess]) -> dict[str, str]:
    """Environment variables that limit the threads of processes that render, so that these share the cores.

    Variables that the user has set are left out.
    """
    return thread_limits(sum(process.renders for process in processes))
