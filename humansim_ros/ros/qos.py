"""Qualities of service (REP-2003)."""

from __future__ import annotations

from rclpy.qos import QoSDurabilityPolicy, QoSHistoryPolicy, QoSProfile, QoSReliabilityPolicy


def _profile(depth: int, durability: QoSDurabilityPolicy) -> QoSProfile:
    return QoSProfile(
        depth=depth,
        history=QoSHistoryPolicy.KEEP_LAST,
        reliability=QoSReliabilityPolicy.RELIABLE,
        durability=durability,
    )


#: Publishers of what changes every frame, as camera drivers have it: reliable and best-effort subscribers
#: both match.
DATA = _profile(5, QoSDurabilityPolicy.VOLATILE)

#: Subscribers between our own nodes: a node that is late finds only the newest frames waiting.
NEWEST = _profile(3, QoSDurabilityPolicy.VOLATILE)

#: What is sent once and kept for those who come later.
LATCHED = _profile(1, QoSDurabilityPolicy.TRANSIENT_LOCAL)
