"""Support for tests: long waits on a slow machine, environment variables, and rclpy's default context."""

from __future__ import annotations

import functools
import os
import time
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any


@contextmanager
def environment(**values: str) -> Iterator[None]:
    """Context manager for tests that set environment variables. It restores all variables at its end."""
    before = dict(os.environ)
    os.environ.update(values)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


@contextmanager
def running_rclpy() -> Iterator[None]:
    """Context manager that initialises rclpy's default context, with a transport for images. At the end,
    remaining nodes of this context are destroyed, since nodes of an EventsExecutor would stay in the graph
    for ever. If other code has initialised the context already, nothing is done."""
    import rclpy

    from humansim_ros.ros.processes import prepare_transport

    if rclpy.ok():
        yield
        return
    with environment():
        prepare_transport()
        rclpy.init()
        with _recorded_nodes() as nodes:
            try:
                yield
            finally:
                for node in list(nodes):
                    _destroy(node)
                rclpy.try_shutdown()


@contextmanager
def _recorded_nodes() -> Iterator[weakref.WeakSet[Any]]:
    """Context manager that yields the set of nodes which are created within it in rclpy's default context."""
    import rclpy
    from rclpy.node import Node

    default = rclpy.get_default_context()
    nodes: weakref.WeakSet[Node] = weakref.WeakSet()
    initialise = Node.__init__

    @functools.wraps(initialise)
    def recorded(node: Node, *arguments: Any, **options: Any) -> None:
        if options.get("context") in (None, default):
            nodes.add(node)
        initialise(node, *arguments, **options)

    Node.__init__ = recorded
    try:
        yield nodes
    finally:
        Node.__init__ = initialise


def _destroy(node: Any) -> None:
    with suppress(Exception):  # a node that has failed at its start
        if node.executor is not None:
            node.executor.remove_node(node)
            node.executor.shutdown()
        node.destroy_node()


def patience(seconds: float) -> float:
    """Time after which a test gives up waiting, seconds. HUMANSIM_TEST_PATIENCE multiplies it for slow
    machines."""
    return seconds * float(os.environ.get("HUMANSIM_TEST_PATIENCE") or 1)


def wait_until(
    condition: Callable[[], object], limit: float, step: Callable[[], object] = lambda: time.sleep(0.05)
) -> bool:
    """Call ``step`` until ``condition`` is true. Returns False if it is still not true after ``limit``
    seconds."""
    end = time.monotonic() + limit
    while not condition():
        if time.monotonic() > end:
            return False
        step()
    return True
