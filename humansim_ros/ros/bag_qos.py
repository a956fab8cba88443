"""Quality of service of recorded and played topics, between publishers, subscriptions and bags."""

from __future__ import annotations

from collections.abc import Sequence

from rclpy.qos import QoSDurabilityPolicy, QoSHistoryPolicy, QoSProfile, QoSReliabilityPolicy

from humansim_ros.bags.topics import Qos

#: Messages that wait until they are recorded. The middleware takes memory only for those that it has.
RECORDED_DEPTH = 1000
#: Messages of a player that wait for slow subscribers.
PLAYED_DEPTH = 1000


def subscription_profile(offers: Sequence[QoSProfile]) -> QoSProfile:
    """Profile of a subscription that gets the messages of all publishers, and as many as they permit.

    ``offers``: profiles of the publishers.
    """
    reliable = all(offer.reliability != QoSReliabilityPolicy.BEST_EFFORT for offer in offers)
    latched = bool(offers) and all(
        offer.durability == QoSDurabilityPolicy.TRANSIENT_LOCAL for offer in offers
    )
    return _profile(reliable, latched, RECORDED_DEPTH)


def recorded_qos(offers: Sequence[QoSProfile]) -> tuple[Qos, ...]:
    """Profiles of publishers for the description of a topic in a bag."""
    return tuple(
        Qos(
            reliable=offer.reliability != QoSReliabilityPolicy.BEST_EFFORT,
            transient_local=offer.durability == QoSDurabilityPolicy.TRANSIENT_LOCAL,
            # not known of publishers of other processes
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
    return _profile(reliable, latched, min(depth, RECORDED_DEPTH) if latched else PLAYED_DEPTH)


def _profile(reliable: bool, latched: bool, depth: int) -> QoSProfile:
    return QoSProfile(
        depth=depth,
        history=QoSHistoryPolicy.KEEP_LAST,
        reliability=QoSReliabilityPolicy.RELIABLE if reliable else QoSReliabilityPolicy.BEST_EFFORT,
        durability=QoSDurabilityPolicy.TRANSIENT_LOCAL if latched else QoSDurabilityPolicy.VOLATILE,
    )
