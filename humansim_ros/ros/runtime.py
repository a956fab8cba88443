"""What every node process does around its node: transports, start, spin, errors and a clean end."""

from __future__ import annotations

import gc
import importlib
import os
import signal
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

from humansim_ros.errors import HumansimError, RosError, show_warnings
from humansim_ros.render.memory import keep_image_blocks
from humansim_ros.resources import resource_path

#: Whoever sets one of these has configured Fast DDS's transports.
_TRANSPORT_SETTINGS = (
    "FASTRTPS_DEFAULT_PROFILES_FILE",
    "FASTDDS_DEFAULT_PROFILES_FILE",
    "FASTDDS_BUILTIN_TRANSPORTS",
    "ROS_DISCOVERY_SERVER",
)
#: Signals that stop a node, and seconds after which it heeds them, if nothing happens meanwhile.
_STOPPING = (signal.SIGINT, signal.SIGTERM)
_LOOK_UP = 0.1
#: Seconds that taking a node down may take.
_LAST_WORDS = 5


def require_ros() -> None:
    """RosError with the way to install it where rclpy or a message package cannot be imported."""
    try:
        for module in ("rclpy", "sensor_msgs.msg", "shape_msgs.msg", "visualization_msgs.msg"):
            importlib.import_module(module)
    except ImportError as reason:
        raise RosError(
            f"ROS 2 is not there ({reason}). With ROS 2 Jazzy installed: source /opt/ros/jazzy/setup.bash; "
            "without: pip install 'humansim_ros[ros]'"
        ) from None


def prepare_transport() -> None:
    """Make room for images in Fast DDS's shared memory; before ``rclpy.init()``. The user's own settings win.

    By default two of three 640x480 images of a best-effort subscriber are lost: they do not fit.
    """
    if not any(name in os.environ for name in _TRANSPORT_SETTINGS):
        os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(resource_path("config/fastdds.xml"))
    keep_image_blocks()


def make_executor() -> Any:
    """What runs the callbacks of a process's nodes: the executor that is told of events, where rclpy has it.
    The default one asks every service, timer and topic anew for each callback, which takes a fifth of all
    CPU time.
    """
    try:
        from rclpy.experimental import EventsExecutor
    except ImportError:  # before rclpy 7.1.4
        from rclpy.executors import SingleThreadedExecutor

        return SingleThreadedExecutor()
    return EventsExecutor()


def _interrupt(number: int, _: Any) -> None:
    raise KeyboardInterrupt


def run_node(make: Callable[[], Any], arguments: Sequence[str] | None = None) -> int:
    """Run one node, and those it has made, until SIGINT or SIGTERM. Returns the exit code: 0 stopped, 2 the
    input was wrong.
    """
    show_warnings()
    try:
        require_ros()
    except HumansimError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    prepare_transport()
    import rclpy
    from rclpy.executors import ExternalShutdownException
    from rclpy.signals import SignalHandlerOptions

    # rclpy's own handlers take the context away from under whatever is being sent
    options = SignalHandlerOptions.NO
    rclpy.init(args=None if arguments is None else list(arguments), signal_handler_options=options)
    node = None
    try:
        for number in _STOPPING:
            signal.signal(number, _interrupt)
        node = make()
        # what was made until now stays: looking through it for garbage stops a node for a tenth of a second
        gc.collect()
        gc.freeze()
        executor = make_executor()
        for member in node.members:
            executor.add_node(member)
        told: list[int] = []
        for number in _STOPPING:
            signal.signal(number, lambda number, _: told.append(number))
        while not told:  # not spin(), which never sleeps where libstdc++ is old
            executor.spin_once(_LOOK_UP)
    except HumansimError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        # Fast DDS has been seen to spin for ever while its participant is taken down: then this ends the
        # process
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(_LAST_WORDS)
        if node is not None:
            with suppress(Exception):  # the context may be gone already
                node.close()
                node.destroy_node()
        rclpy.try_shutdown()
        signal.alarm(0)
    return 0
