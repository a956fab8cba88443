"""Transports of Fast DDS: shared memory of a size that fits, and the network or only this machine."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass

from humansim_ros.resources import resource_path
from humansim_ros.ros.shared_memory import FULL_SEGMENT, free_memory, segment_size

#: Environment variables that mean that the user has configured the transports of Fast DDS.
_TRANSPORT_SETTINGS = (
    "FASTRTPS_DEFAULT_PROFILES_FILE",
    "FASTDDS_DEFAULT_PROFILES_FILE",
    "FASTDDS_BUILTIN_TRANSPORTS",
    "ROS_DISCOVERY_SERVER",
)
_RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
#: Environment variables that mean that the user has said which hosts may find the nodes.
_DISCOVERY_SETTINGS = (_RANGE, "ROS_STATIC_PEERS", "ROS_LOCALHOST_ONLY", *_TRANSPORT_SETTINGS)
_FAST_DDS = ("", "rmw_fastrtps_cpp", "rmw_fastrtps_dynamic_cpp")
#: Environment variable that profiles of Fast DDS read.
_SEGMENT_BYTES = "HUMANSIM_SEGMENT_BYTES"
#: Bytes of a segment below which large images may be lost.
_SMALL_SEGMENT = 1 << 24
#: Bytes in /dev/shm of a process whose segment has its full size.
_FULL_PROCESS = 70e6


@dataclass(frozen=True)
class Transport:
    """Transport of the nodes that a process starts, and of its own.

    Attributes:
        environment: Environment variables that set it.
        reach: Who can find the nodes, for people.
        warning: Effect of too little shared memory, and the remedy; empty if there is enough.
    """

    environment: dict[str, str]
    reach: str
    warning: str = ""


def choose_transport(participants: int | None = None, network: bool = True) -> Transport:
    """Choose the transport for this machine, unless the user has configured it.

    Args:
        participants: Number of processes that start together; None: this process starts alone.
        network: Other hosts may find the nodes.
    """
    for name in _DISCOVERY_SETTINGS:
        if os.environ.get(name):
            network, reach = True, f"found by other hosts as {name} says"
            break
    else:
        everyone = "found by every host on the network, which can also steer them"
        reach = everyone if network else "visible on this machine only; --network opens it"
    if any(name in os.environ for name in _TRANSPORT_SETTINGS):
        return Transport({}, reach)
    if os.environ.get("RMW_IMPLEMENTATION", "") not in _FAST_DDS:
        return Transport({} if network else {_RANGE: "LOCALHOST"}, reach)
    free = free_memory()
    segment = segment_size(free, participants)
    # with LOCALHOST, the ports would stay open on all interfaces
    limit = {} if network else {_RANGE: "SYSTEM_DEFAULT"}
    environment = {
        "FASTRTPS_DEFAULT_PROFILES_FILE": str(resource_path(f"config/{_profile(segment, network)}.xml")),
        _SEGMENT_BYTES: str(segment),
        **limit,
    }
    return Transport(environment, reach, _warning(segment, free, participants))


def _profile(segment: int, network: bool) -> str:
    """Name of the profile of Fast DDS for segments of a size; 0: without shared memory."""
    if segment == FULL_SEGMENT and network:
        return "fastdds"
    if segment:
        return "fastdds_small" if network else "fastdds_local"
    return "fastdds_udp" if network else "fastdds_local_udp"


def _warning(segment: int, free: float, participants: int | None) -> str:
    if segment >= _SMALL_SEGMENT:
        return ""
    gigabytes = max(1, math.ceil((participants or 1) * _FULL_PROCESS / 1e9))
    effect = (
        f"a process gets {segment / 1e6:.1f} MB of shared memory instead of {FULL_SEGMENT / 1e6:.0f}: "
        f"best-effort subscribers may lose images above {segment / 2e6:.1f} MB"
        if segment
        else "images go over UDP: best-effort subscribers lose many of them, reliable ones get all"
    )
    return f"/dev/shm has {free / 1e6:.0f} MB free, so {effect}. In Docker: --shm-size={gigabytes}g"
