"""Profiles of quality of service: for topics of this package (REP-2003), for recording and playing bags."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rclpy.duration import Duration
from rclpy.qos import (
    QoSDurabilityPolicy,
    QoSHistoryPolicy,
    QoSLivelinessPolicy,
    QoSProfile,
    QoSReliabilityPolicy,
)

from humansim_ros.data.bags import Qos
from humansim_ros.data.messages import DATA_DEPTH, LATCHED_DEPTH, Topic
from humansim_ros.data.messages import SCENE_TIME as SCENE_TIME


def _profile(depth: int, latched: bool = False, reliable: bool = True, **more: Any) -> QoSProfile:
    return QoSProfile(
        depth=depth,
        history=QoSHistoryPolicy.KEEP_LAST,
        reliability=QoSReliabilityPolicy.RELIABLE if reliable else QoSReliabilityPolicy.BEST_EFFORT,
        durability=QoSDurabilityPolicy.TRANSIENT_LOCAL if latched else QoSDurabilityPolicy.VOLATILE,
        **more,
    )


#: Profile of publishers of frame data, as camera drivers use it. It matches reliable and best-effort
#: subscribers.
DATA = _profile(DATA_DEPTH)

#: Profile of subscriptions between nodes of this package. A late node finds only the newest frames in its
#: queue.
NEWEST = _profile(3)

#: Profile of publishers of messages that are sent once. Nodes that join later get the last message.
LATCHED = _profile(LATCHED_DEPTH, latched=True)

#: Topic with liveliness, by which the motion player learns within half a second that a camera process has
#: died. A restarted player also gets the newest report from it. ``frame_done`` offers neither, since other
#: nodes may report there, too.
CAMERA_ALIVE = "_camera_alive"
ALIVE = _profile(
    1,
    latched=True,
    liveliness=QoSLivelinessPolicy.AUTOMATIC,
    liveliness_lease_duration=Duration(seconds=0.5),
)

#: Topic on which nodes report the frames that they have finished.
FRAME_DONE = "frame_done"
#: Profile of the publishers of reports on ``frame_done``.
DONE = DATA
#: Profile of subscriptions to these reports. Each camera process sends one per frame. If a report is lost,
#: the next one replaces it.
REPORTS = _profile(50)


def offered_profile(topic: Topic[Any]) -> QoSProfile:
    """Return the profile of the publisher of a topic of the scene."""
    return LATCHED if topic.latched else DATA


#: Most messages that wait until they are recorded. The middleware uses memory only for existing messages.
RECORDED_DEPTH = 1000
#: Most messages of a bag player that wait for slow subscribers.
PLAYED_DEPTH = 1000


def subscription_profile(offers: Sequence[QoSProfile]) -> QoSProfile:
    """Profile of a subscription that gets the messages of all publishers, with the best quality that all of
    them offer. ``offers``: profiles of the publishers."""
    reliable = all(offer.reliability != QoSReliabilityPolicy.BEST_EFFORT for offer in offers)
    latched = bool(offers) and all(
        offer.durability == QoSDurabilityPolicy.TRANSIENT_LOCAL for offer in offers
    )
    return _profile(RECORDED_DEPTH, latched, reliable)


def recorded_qos(offers: Sequence[QoSProfile]) -> tuple[Qos, ...]:
    """Convert the profiles of publishers to the form in which a bag describes a topic."""
    return tuple(
        Qos(
            reliable=offer.reliability != QoSReliabilityPolicy.BEST_EFFORT,
            transient_local=offer.durability == QoSDurabilityPolicy.TRANSIENT_LOCAL,
            # unknown for publishers of other processes
            **({"depth": offer.depth} if offer.history == QoSHistoryPolicy.KEEP_LAST and offer.depth else {}),
            keep_all=offer.history == QoSHistoryPolicy.KEEP_ALL,
        )
        for offer in offers
    )


def publisher_profile(recorded: Sequence[Qos]) -> QoSProfile:
    """Profile of a publisher that matches every subscription that one of the recorded publishers matches."""
    reliable = not recorded or any(qos.reliable for qos in recorded)
    latched = any(qos.transient_local for qos in recorded)
    # late subscribers get the last messages of all publishers, which one publisher replaces
    depth = sum(max(1, qos.depth) for qos in recorded if qos.transient_local)
    return _profile(min(depth, RECORDED_DEPTH) if latched else PLAYED_DEPTH, latched, reliable)
