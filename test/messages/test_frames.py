"""Frames: which are whole, what they lack, and which messages belong to a stamp; in bounded memory."""

from __future__ import annotations

import pytest

from humansim_ros.data.messages.frames import Frames, due_stamps, place_at
from humansim_ros.data.messages.recorded_frames import RecordedFrames

SECOND = 10**9
MAX_MESSAGES = 90
#: Seconds of a monotonic clock.
NOW = 60.0


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


def frames(max_size: int | None = None) -> Frames[bytes]:
    """Frames with the limits of the page that shows a running graph."""
    return Frames(max_of_topic=MAX_MESSAGES, max_size=max_size, size_of=len, new_run=SECOND)


def store(**topics: list[int]) -> Frames[bytes]:
    found = frames()
    for stamp, topic in sorted((stamp, topic) for topic, stamps in topics.items() for stamp in stamps):
        found.add(topic, stamp, f"{topic}{stamp}".encode(), 0.0 if topic == "silent" else NOW)
    return found


def test_a_frame_waits_for_its_topics_but_not_for_long() -> None:
    found = store(joints=[1, 2, 3, 4], image=[1, 2], silent=[1])
    assert found.newest_whole(["joints"], ["joints", "image", "silent", "never"], 10, NOW) == 2
    assert found.newest_whole(["joints"], ["joints", "image"], 1, NOW) == 4
    assert found.newest_whole(["joints"], ["joints"], 10, NOW) == 4
    assert found.newest_whole(["nothing"], [], 10, NOW) is None
    found.add("image", 4, b"late", NOW)
    assert found.newest_whole(["joints"], ["joints", "image"], 10, NOW) == 4


def test_frames_in_which_a_camera_takes_pictures_at_a_rate_of_its_own() -> None:
    grid = [1 + round(k * 1e9 / 30) for k in range(60)]
    for step, first, lost in ((2, 0, ()), (3, 2, (11, 17)), (6, 5, (11,)), (1, 0, (7,))):
        pictures = range(first, 60, step)
        own = [grid[k] for k in pictures if k not in lost]
        assert due_stamps(grid, own) == {grid[k] for k in pictures}
    # two cameras alone: their stamps are no regular grid
    stamps = sorted({*grid[::2], *grid[::3]})
    assert due_stamps(stamps, grid[::3]) == {*grid[::3]}


def test_a_frame_is_whole_without_a_camera_that_rests() -> None:
    found: Frames[None] = Frames(["joints", "image", "info"])
    for stamp in range(10, 100, 10):
        found.add("joints", stamp, None)
        for topic in ("image", "info") if stamp % 20 == 0 else ():
            if (topic, stamp) != ("image", 60):
                found.add(topic, stamp, None)
    assert found.whole() == [20, 40, 80]
    assert found.require_when_due(["image", "info"]) == {20, 40, 60, 80}
    assert found.whole() == [10, 20, 30, 40, 50, 70, 80, 90]
    assert found.lacking() == {"image": 1}


def test_a_page_does_not_wait_for_a_camera_that_rests() -> None:
    found = store(joints=[*range(1, 10)], slow=[1, 4, 7], fast=[*range(1, 9)])
    assert found.newest_whole(["joints"], ["joints", "slow", "fast"], 10, NOW) == 8
    late = store(joints=[*range(1, 11)], slow=[1, 4, 7], fast=[*range(1, 11)])
    assert late.newest_whole(["joints"], ["joints", "slow", "fast"], 10, NOW) == 9


def test_memory_is_bounded_but_what_lasts_is_kept() -> None:
    found = frames(max_size=1000)
    found.keep("mesh", None, bytes(5000))
    found.keep("pose", 1, b"pose")
    for stamp in range(1, 500):
        found.add("image", stamp, bytes(300))
        assert found.size <= 1000
    assert found.stamps(["image"]) == [497, 498, 499]
    for stamp in range(1000, 1000 + 3 * MAX_MESSAGES):
        found.add("small", stamp, b"")
    assert len(found.stamps(["small"])) == MAX_MESSAGES
    assert found.near(499, ["mesh", "pose"], 0) == {"mesh": bytes(5000), "pose": b"pose"}
    found.add("huge", 1, bytes(2000))
    assert found.stamps(["huge"]) == [1] and not found.stamps(["image"])
    found.forget("huge")
    assert found.size == 0


def test_stamps_that_go_back_begin_a_new_run() -> None:
    found = frames()
    found.keep("pose", 100 * SECOND, b"pose")
    for second in (100, 101):
        found.add("joints", second * SECOND, b"old")
        found.add("image", second * SECOND, b"old")
    found.add("joints", 100 * SECOND + 1, b"a little late")
    assert found.stamps(["joints"]) == [100 * SECOND, 100 * SECOND + 1, 101 * SECOND]
    found.add("joints", 2 * SECOND, b"new")
    assert found.stamps(["joints", "image"]) == [2 * SECOND]
    assert found.near(2 * SECOND, ["joints", "pose"], 1) == {
        "joints": b"new",
        "pose": b"pose",
    }


def test_a_message_that_comes_again_replaces_the_first() -> None:
    found = frames()
    found.add("joints", 5, b"one")
    found.add("joints", 5, b"other", 1.0)
    assert found.newest() == {"joints": b"other"} and found.size == 5
    assert found.silence(["joints"], 3.0) == 2.0 and found.silence(["nothing"], 3.0) is None


def test_whole_frames_and_what_the_others_lack() -> None:
    found: Frames[int] = Frames(["image", "joints"], max_frames=3)
    assert [found.add("image", stamp, 1) for stamp in (3, 1, 2)] == [False] * 3
    assert found.add("joints", 1, 2) and not found.add("other", 3, 3)
    assert found.whole() == [1] and found.lacking() == {"joints": 2}
    assert found.frame(1) == {"image": 1, "joints": 2} and found.frame(7) == {}
    found.add("joints", 9, 4)  # the frame that has waited longest for a message goes
    assert found.stamps() == [1, 3, 9] and found.forgotten == 1
    assert found.pop(1) == {"image": 1, "joints": 2} and found.whole() == []
    found.require("joints", False)
    assert found.whole() == [3]


# Recordings in lockstep


class FakeMessages:
    """Messages of topics ``a`` and ``b``, which have one for each frame, and of others."""

    def __init__(self) -> None:
        self.frames = RecordedFrames(["a", "b"], ["tracker"])

    def add(self, topic: str, stamp: int, data: bytes = b"") -> bool:
        return self.frames.add(topic, stamp, data)


def test_a_frame_is_whole_when_all_topics_have_delivered_it() -> None:
    given = FakeMessages()
    for topic in ("a", "tracker"):
        assert given.add(topic, 1)
        assert given.frames.take_whole() is None
    assert given.frames.missing == ["b"]
    assert given.add("b", 1)
    assert given.frames.take_whole() == 1
    assert given.frames.take_whole() is None
    assert given.frames.is_finished(1)


def test_a_repeated_stamp_is_kept_once_per_topic() -> None:
    given = FakeMessages()
    assert [given.add("a", 5), given.add("a", 5), given.add("a", 4), given.add("a", 6)] == [1, 0, 0, 1]


def test_another_topic_may_have_several_messages_of_a_stamp() -> None:
    given = FakeMessages()
    sent = [(5, b"first"), (5, b"second"), (5, b"first"), (6, b"first"), (5, b"late"), (6, b"first")]
    assert [given.add("tracker", *each) for each in sent] == [1, 1, 0, 1, 1, 0]


def test_a_topic_whose_node_is_gone_is_not_awaited_until_it_delivers_again() -> None:
    given = FakeMessages()
    for topic in ("a", "b", "tracker"):
        given.add(topic, 1)
    given.frames.begin(2)
    given.add("a", 2)
    given.add("tracker", 2)
    assert given.frames.missing == ["b"]
    given.frames.begin(3)  # the player has given the node up
    given.add("a", 3)
    given.add("tracker", 3)
    assert given.frames.take_whole() == 3
    given.add("b", 4)
    given.frames.begin(5)
    given.add("a", 5)
    given.add("tracker", 5)
    assert given.frames.missing == ["b"]


def test_a_recording_does_not_await_topics_that_rest_in_a_frame() -> None:
    given = FakeMessages()
    for stamp, resting in ((1, ()), (2, ("b", "tracker")), (3, ())):
        given.add("a", stamp)  # before the frame is known
        assert given.frames.take_whole() is None
        given.frames.begin(stamp, resting)
        for topic in {"b", "tracker"}.difference(resting):
            assert given.frames.take_whole() is None
            given.add(topic, stamp)
        assert given.frames.take_whole() == stamp


def test_nothing_is_given_up_before_the_first_frame() -> None:
    given = FakeMessages()
    given.frames.begin(1)
    assert given.frames.missing == ["a", "b", "tracker"]
    assert given.frames.take_whole() is None
