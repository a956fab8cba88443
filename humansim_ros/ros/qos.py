"""Quality of service profiles (REP-2003)."""

from __future__ import annotations

from typing import Any

from rclpy.duration import Duration
from rclpy.qos import (
    QoSDurabilityPolicy,
    QoSHistoryPolicy,
    QoSLivelinessPolicy,
    QoSProfile,
    QoSReliabilityPolicy,
)

from humansim_ros.messages.topics import DATA_DEPTH, LATCHED_DEPTH, Topic
from humansim_ros.messages.topics import SCENE_TIME as SCENE_TIME


def _profile(depth: int, durability: QoSDurabilityPolicy) -> QoSProfile:
    return QoSProfile(
        depth=depth,
        history=QoSHistoryPolicy.KEEP_LAST,
        reliability=QoSReliabilityPolicy.RELIABLE,
        durability=durability,
    )


#: Publishers of frame data, as camera drivers have it: matches reliable and best-effort subscribers.
DATA = _profile(DATA_DEPTH, QoSDurabilityPolicy.VOLATILE)

#: Subscriptions between nodes of this package: a late node finds only the newest frames in its queue.
NEWEST = _profile(3, QoSDurabilityPolicy.VOLATILE)

#: Publishers of messages that are sent once; late joiners get the last one.
LATCHED = _profile(LATCHED_DEPTH, QoSDurabilityPolicy.TRANSIENT_LOCAL)

#: Topic whose quality of service tells the motion player half a second after a camera process has died, and
#: gives its newest report to a player that is started again. Reports on ``frame_done`` have neither, because
#: other nodes may report, too.
CAMERA_ALIVE = "_camera_alive"
ALIVE = QoSProfile(
    depth=1,
    history=QoSHistoryPolicy.KEEP_LAST,
    reliability=QoSReliabilityPolicy.RELIABLE,
    durability=QoSDurabilityPolicy.TRANSIENT_LOCAL,
    liveliness=QoSLivelinessPolicy.AUTOMATIC,
    liveliness_lease_duration=Duration(seconds=0.5),
)

#: Topic on which everybody reports the frames that it has finished.
FRAME_DONE = "frame_done"
#: Publishers of these reports.
DONE = DATA
#: Subscriptions to reports: one for each camera process and frame; a lost one is replaced by the next.
REPORTS = _profile(50, QoSDurabilityPolicy.VOLATILE)


def offered_profile(topic: Topic[Any]) -> QoSProfile:
    """Return the profile of the publisher of a topic of the scene."""
    return LATCHED if topic.latched else DATA
