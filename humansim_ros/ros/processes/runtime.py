"""Node processes: transport, start, spinning, errors and shutdown."""

from __future__ import annotations

import gc
import importlib
import os
import signal
import stat
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from humansim_ros.errors import HumansimError, HumansimWarning, RosError, show_warnings
from humansim_ros.render.device import keep_image_blocks
from humansim_ros.ros.graph.transport import Transport, choose_transport, remove_dead_files
from humansim_ros.ros.processes.node_processes import WARNINGS_SHOWN
from humansim_ros.ros.processes.stop_signals import Stopped, StopRequest, end_process, end_process_on_stop

if TYPE_CHECKING:
    from rclpy.context import Context

    from humansim_ros.ros.graph.guarded_node import GuardedNode
    from humansim_ros.scene.core import Scene

#: An idle node notices a stop signal within this time, seconds.
_SPIN_TIMEOUT = 0.1
#: Pause of the executor after a first error; and time with nothing but errors after which a node ends,
#: seconds.
_FIRST_PAUSE, _MAX_SECONDS_OF_ERRORS = 0.001, 10.0
#: A shutdown that hangs is aborted after this time, seconds.
_SHUTDOWN_LIMIT = 5


def require_ros() -> None:
    """Raise RosError with installation advice if rclpy or a message package cannot be imported."""
    try:
        for module in ("rclpy", "sensor_msgs.msg", "shape_msgs.msg", "visualization_msgs.msg"):
            importlib.import_module(module)
    except ImportError as reason:
        raise RosError(
            f"ROS 2 cannot be imported ({reason}). If ROS 2 Jazzy is installed, run: "
            "source /opt/ros/jazzy/setup.bash; otherwise: pip install 'humansim_ros[ros]'"
        ) from None


def prepare_transport(participants: int | None = None, network: bool = True) -> Transport:
    """Enlarge the shared memory of Fast DDS for images, unless the user has configured Fast DDS.

    Call it before ``rclpy.init()``. With Fast DDS's defaults, two of three 640x480 images do not fit and are
    lost for best-effort subscribers. Warns if there is too little shared memory, and removes shared memory
    that killed processes have left. Prepares the folder of logs, too.

    Args:
        participants: Number of processes that start together. If None, this process starts alone.
        network: Whether other hosts may find the nodes, unless the user has set this.

    Returns:
        The transport. It is set for this process and its children.
    """
    prepare_logs()
    remove_dead_files()
    transport = choose_transport(participants, network)
    os.environ.update(transport.environment)
    if transport.warning:
        warnings.warn(transport.warning, HumansimWarning, stacklevel=2)
    keep_image_blocks()
    return transport


def prepare_logs() -> None:
    """If the log folder of ROS cannot be written, use a temporary folder, since ROS would not start
    otherwise.

    Raises:
        RosError: A temporary folder cannot be written either.
    """
    home = os.environ.get("ROS_HOME") or Path("~/.ros").expanduser()
    usual = Path(os.environ.get("ROS_LOG_DIR") or Path(home, "log"))
    with suppress(OSError):
        usual.mkdir(parents=True, exist_ok=True)
        if os.access(usual, os.W_OK):
            return
    folder = Path(tempfile.gettempdir(), f"ros_log_{os.geteuid()}")
    with suppress(OSError):
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
        # not a folder or link that another user has made
        if stat.S_ISDIR(found.st_mode) and found.st_uid == os.geteuid():
            os.environ["ROS_LOG_DIR"] = str(folder)
            if WARNINGS_SHOWN not in os.environ:
                text = f"{usual} cannot be written: ROS logs to {folder} (set ROS_LOG_DIR for another folder)"
                warnings.warn(text, HumansimWarning, stacklevel=2)
            return
    raise RosError(
        f"ROS cannot log to {usual} nor to {folder}: set ROS_LOG_DIR to a folder that it can write"
    )


def make_executor(context: Context | None = None) -> Any:
    """Create rclpy's EventsExecutor or, if this rclpy has none, the default executor.

    ``context``: ROS context. If None, rclpy's default context.

    The default executor polls every service, timer and topic for each callback, which takes a fifth of all
    CPU time.
    """
    try:
        from rclpy.experimental import EventsExecutor
    except ImportError:  # before rclpy 7.1.4
        from rclpy.executors import SingleThreadedExecutor

        return SingleThreadedExecutor(context=context)
    return EventsExecutor(context=context)


def spin(
    node: GuardedNode, executor: Any, stopped: Callable[[], bool], context: Context | None = None
) -> None:
    """Spin until ``stopped()`` is true, or the ROS context is shut down.

    Errors outside callbacks, such as a message that the middleware cannot take, are reported by the node.
    After each error in a row, spinning waits a little longer, so that an error that comes back at once does
    not fill the log or use up a core.

    Args:
        node: The node that reports errors.
        executor: Executor with the node.
        stopped: Called after each callback.
        context: Context of the executor. If None, rclpy's default context.

    Raises:
        RosError: There were only errors for ten seconds.
    """
    import rclpy
    from rclpy.executors import ExternalShutdownException

    last_success, pause = time.monotonic(), _FIRST_PAUSE
    # not executor.spin(), which never sleeps where libstdc++ is old
    while not stopped() and rclpy.ok(context=context):
        with node.guard("executor", "it goes on") as fault:
            try:
                executor.spin_once(_SPIN_TIMEOUT)
            except ExternalShutdownException:
                return
        if not fault.reason:
            last_success, pause = time.monotonic(), _FIRST_PAUSE
            continue
        if time.monotonic() - last_success > _MAX_SECONDS_OF_ERRORS:
            raise RosError(f"the executor of {node.get_name()} fails again and again: {fault.reason}")
        time.sleep(pause)
        pause = min(2 * pause, _SPIN_TIMEOUT)


def run_node_of(name: str, scene: Scene | None = None) -> int:
    """Run the node of a module in :mod:`humansim_ros.ros.nodes`, such as ``camera_rig``; returns its exit
    code. ``scene``: scene that its parameter names, if loaded already."""
    module = importlib.import_module(f"humansim_ros.ros.nodes.{name}")
    kind = getattr(module, f"{name.title().replace('_', '')}Node")
    return run_node(lambda: kind(scene=scene))


def run_node(make: Callable[[], Any]) -> int:
    """Run one node, and nodes that it has created, until a stop signal. A second signal ends the process at
    once.

    Returns:
        Exit code: ``exit_code`` of a node that has ended by itself, 0 after a stop signal, 1 if the
        node cannot go on, 2 after invalid input.
    """
    end_process_on_stop(0)
    show_warnings()
    try:
        require_ros()
        prepare_transport()
    except HumansimError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    # rclpy's own handlers destroy the context while messages are being sent
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = None
    stop = StopRequest(again=end_process)
    try:
        node = make()
        with suppress(OSError):  # for top and ps; only Linux has it
            Path("/proc/self/comm").write_text(node.get_name())
        # objects created until now stay: a garbage collection of them stops a node for a tenth of a second
        gc.collect()
        gc.freeze()
        executor = make_executor()
        for each in node.nodes:
            executor.add_node(each)
        stop.raises = False
        spin(node, executor, lambda: stop.number is not None or node.exit_code is not None)
        node.complete()
    except HumansimError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2 if node is None else 1
    except Stopped:
        pass
    except Exception:
        if stop.number is None:  # else a library has made another exception of Stopped, as pydantic does
            raise
    finally:
        stop.raises = False
        # Fast DDS sometimes spins for ever while its participant is destroyed: then this ends the process
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(_SHUTDOWN_LIMIT)
        if node is not None:
            with suppress(Exception):  # the context may be invalid already
                node.close()
                node.destroy_node()
        rclpy.try_shutdown()
        signal.alarm(0)
    return (node and node.exit_code) or 0
