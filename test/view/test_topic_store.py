"""The newest messages of topics: bounded, by stamp, and the frame that is whole."""

from __future__ import annotations

import pytest

from humansim_ros.view.topic_store import MAX_MESSAGES, TopicStore, place_at

SECOND = 10**9


@pytest.mark.parametrize(
    ("stamp", "lasts", "place"),
    [
        (20, False, 1),  # its stamp
        (22, False, 1),  # the nearest one, before
        (27, False, 2),  # the nearest one, after
        (31 + SECOND, False, None),  # the last one is too old
        (30 + SECOND, False, 2),
        (4, False, None),
        (5, True, 0),
        (29, True, 1),
        (3 * SECOND, True, 2),
    ],
)
def test_the_message_of_a_frame(stamp: int, lasts: bool, place: int | None) -> None:
    assert place_at([10, 20, 30], stamp, 4, lasts) == place
    assert place_at([], stamp, 4, lasts) is None


def store(**topics: list[int]) -> TopicStore:
    found = TopicStore()
    for stamp, topic in sorted((stamp, topic) for topic, stamps in topics.items() for stamp in stamps):
        found.add(topic, stamp, f"{topic}{stamp}".encode())
    return found


def test_a_frame_waits_for_its_topics_but_not_for_long() -> None:
    found = store(joints=[1, 2, 3, 4], image=[1, 2], silent=[1])
    found._heard["silent"] -= 60
    assert found.whole_frame(["joints"], ["joints", "image", "silent", "never"], 10) == 2
    assert found.whole_frame(["joints"], ["joints", "image"], 1) == 4
    assert found.whole_frame(["joints"], ["joints"], 10) == 4
    assert found.whole_frame(["nothing"], [], 10) is None
    found.add("image", 4, b"late")
    assert found.whole_frame(["joints"], ["joints", "image"], 10) == 4


def test_memory_is_bounded_but_what_lasts_is_kept() -> None:
    found = TopicStore(max_bytes=1000)
    found.add("mesh", None, bytes(5000))
    found.add("pose", 1, b"pose", lasts=True)
    for stamp in range(1, 500):
        found.add("image", stamp, bytes(300))
        assert found.size <= 1000
    assert found.stamps(["image"]) == [497, 498, 499]
    for stamp in range(1000, 1000 + 3 * MAX_MESSAGES):
        found.add("small", stamp, b"")
    assert len(found.stamps(["small"])) == MAX_MESSAGES
    assert found.messages_of(499, {"mesh": True, "pose": True}, 0) == {"mesh": bytes(5000), "pose": b"pose"}
    found.add("huge", 1, bytes(2000))
    assert found.stamps(["huge"]) == [1] and not found.stamps(["image"])
    found.forget("huge")
    assert found.size == 0


def test_stamps_that_go_back_begin_a_new_run() -> None:
    found = TopicStore()
    found.add("pose", 100 * SECOND, b"pose", lasts=True)
    for second in (100, 101):
        found.add("joints", second * SECOND, b"old")
        found.add("image", second * SECOND, b"old")
    found.add("joints", 100 * SECOND + 1, b"a little late")
    assert found.stamps(["joints"]) == [100 * SECOND, 100 * SECOND + 1, 101 * SECOND]
    found.add("joints", 2 * SECOND, b"new")
    assert found.stamps(["joints", "image"]) == [2 * SECOND]
    assert found.messages_of(2 * SECOND, {"joints": False, "pose": True}, 1) == {
        "joints": b"new",
        "pose": b"pose",
    }


def test_a_message_that_comes_again_replaces_the_first() -> None:
    found = TopicStore()
    found.add("joints", 5, b"one")
    found.add("joints", 5, b"other")
    assert found.newest() == {"joints": b"other"} and found.size == 5
    assert found.silence(["joints"]) is not None and found.silence(["nothing"]) is None
