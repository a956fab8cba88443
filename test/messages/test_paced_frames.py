"""Frames are put together whatever else arrives: stamps of other clocks, strays, silence, recordings."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass, field

import pytest

from humansim_ros.data.messages.paced_frames import GivenUpFrame, PacedFrames

SECOND = 1_000_000_000
PERIOD = SECOND // 20
#: Time of the node's clock at the start.
START = 1_700_000_000 * SECOND
ANNA, BOB = ("anna/vertices", "anna/joints"), ("bob/vertices", "bob/joints")


@dataclass
class Receiver:
    """A buffer, and the frames that it completed and gave up. Frames are taken when they are complete."""

    topics: tuple[str, ...] = (*ANNA, *BOB)
    clock_offset: int = 0
    seconds: float = 0.0
    paced: bool = True
    taken: list[int] = field(default_factory=list)
    given_up: list[GivenUpFrame] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.buffer = PacedFrames(self.topics, PERIOD)

    @property
    def now(self) -> int:
        return START + self.clock_offset + round(self.seconds * SECOND)

    def receive(self, topic: str, stamp: int) -> None:
        if self.buffer.add(topic, stamp, topic, self.seconds):
            frame = self.buffer.take(not self.paced, self.now, self.seconds)
            assert frame is not None
            assert dict(frame.contents) == {name: name for name in self.topics}
            self.taken.append(frame.stamp)
        elif frame_given_up := self.buffer.give_up(self.now, self.seconds):
            self.given_up.append(frame_given_up)
        assert len(self.buffer._frames) <= 8

    def play(
        self,
        frames: int,
        first: int,
        offsets: dict[str, int] | None = None,
        silent: tuple[str, ...] = (),
        strays: Callable[[int], list[tuple[str, int]]] = lambda stamp: [],
    ) -> list[int]:
        """Receive frames of all topics, one every period, with strays before each message.

        Args:
            frames: Number of frames.
            first: Stamp of the first one.
            offsets: Nanoseconds by which the clocks of topics are ahead.
            silent: Topics without messages.
            strays: Other messages, by the stamp of the frame.

        Returns:
            Stamps of the frames.
        """
        stamps = [first + number * PERIOD for number in range(frames)]
        for stamp in stamps:
            self.seconds += PERIOD / SECOND
            for topic in self.topics:
                for stray in strays(stamp):
                    self.receive(*stray)
                if topic not in silent:
                    self.receive(topic, stamp + (offsets or {}).get(topic, 0))
        return stamps


@pytest.fixture
def receiver() -> Receiver:
    return Receiver()


@pytest.mark.daily("1-0-1000000000000000000", "5-0--10000000000")
@pytest.mark.parametrize("offset", [10 * SECOND, 10**9 * SECOND, -10 * SECOND, 2 * SECOND])
@pytest.mark.parametrize("before", [0, 50])
@pytest.mark.parametrize("rate", [1, 5])
def test_strays_of_another_clock_cost_no_frame(
    receiver: Receiver, offset: int, before: int, rate: int
) -> None:
    """A host whose clock is off sends for a human, too, before the first frame or later, up to five times
    between two messages of a frame.
    """
    count = [0]

    def strays(stamp: int) -> list[tuple[str, int]]:
        count[0] += rate
        return [(ANNA[0], stamp + offset + count[0] + number) for number in range(rate)]

    played = receiver.play(before, receiver.now)
    played += receiver.play(400, receiver.now, strays=strays)
    assert receiver.taken == played
    assert {topic for frame in receiver.given_up for topic in frame.offsets} == {ANNA[0]}
    for frame in receiver.given_up:
        assert frame.offsets[ANNA[0]] == pytest.approx(offset / SECOND, abs=0.2)


@pytest.mark.parametrize("behind", [False, True])
def test_strays_while_a_recording_is_played_cost_no_frame(receiver: Receiver, behind: bool) -> None:
    """The stamps are years before the node's clock, and strays seconds before or after them."""
    shift = (-1 if behind else 1) * 12_300_000_000
    played = receiver.play(
        400, 5 * SECOND, strays=lambda stamp: [(ANNA[0], stamp + shift + number) for number in range(3)]
    )
    # until the first frame is complete, nothing tells which of two clocks is that of the recording
    assert receiver.taken[-398:] == played[-398:]
    assert receiver.given_up[-1].offsets == {ANNA[0]: pytest.approx(shift / SECOND, abs=0.2)}


@pytest.mark.parametrize("start", [START, 5 * SECOND])
def test_a_human_whose_clock_is_ahead_is_named_with_the_seconds(receiver: Receiver, start: int) -> None:
    """No frame can be complete: its skinner gets stamps of another clock only."""
    receiver.play(100, start, offsets=dict.fromkeys(ANNA, 12_300_000_000))
    assert receiver.taken == []
    assert len(receiver.given_up) > 150
    for frame in receiver.given_up:
        assert set(frame.offsets) <= {*ANNA}
        for seconds in frame.offsets.values():
            assert seconds == pytest.approx(12.3, abs=0.6)
    # its clock is set right
    played = receiver.play(50, start + 100 * PERIOD)
    assert receiver.taken == played


def test_a_human_whose_clock_is_behind_is_named_by_its_distance_from_the_nodes_clock(
    receiver: Receiver,
) -> None:
    receiver.play(100, receiver.now, offsets=dict.fromkeys(BOB, -10 * SECOND))
    assert receiver.taken == []
    assert {topic for frame in receiver.given_up for topic in frame.offsets} == {*BOB}
    assert all(s == pytest.approx(-10, abs=0.6) for f in receiver.given_up for s in f.offsets.values())


def test_one_hostile_stamp_ahead_or_behind_costs_no_frame(receiver: Receiver) -> None:
    played = receiver.play(20, receiver.now)
    sent: set[int] = set()

    def strays(stamp: int) -> list[tuple[str, int]]:
        if stamp in sent:
            return []
        sent.add(stamp)
        return [(BOB[1], stamp + 10**18), (BOB[1], stamp - 10**18), (BOB[1], 0), (BOB[1], stamp - 2 * SECOND)]

    played += receiver.play(100, receiver.now, strays=strays)
    assert receiver.taken == played


def test_a_complete_stray_frame_costs_no_other(receiver: Receiver) -> None:
    """All messages of a human come from two senders, the clock of one of which is ahead."""
    receiver = Receiver(topics=ANNA, paced=False)
    others: list[int] = []

    def strays(stamp: int) -> list[tuple[str, int]]:
        others.append(stamp + 10 * SECOND)
        return [(topic, others[-1]) for topic in ANNA]

    played = receiver.play(100, receiver.now, strays=strays)
    assert [stamp for stamp in receiver.taken if stamp in played] == played
    assert {*receiver.taken} == {*played, *others}


@pytest.mark.parametrize("seconds", [3600, 20, 3])
def test_a_clock_that_is_set_back_costs_no_frame(receiver: Receiver, seconds: int) -> None:
    played = receiver.play(50, receiver.now)
    receiver.receive(ANNA[0], receiver.now + PERIOD)  # a frame that was cut short
    receiver.clock_offset -= seconds * SECOND
    played += receiver.play(100, receiver.now)
    assert receiver.taken == played
    assert not receiver.given_up


@pytest.mark.parametrize("paced", [False, True])
def test_a_recording_is_played_again_and_another_after_it(receiver: Receiver, paced: bool) -> None:
    receiver.paced = paced
    played = receiver.play(50, 100 * SECOND)
    for _ in range(3):
        receiver.play(6, 100 * SECOND + 50 * PERIOD, silent=BOB)  # its end is without a human
        played += receiver.play(50, 100 * SECOND)
    played += receiver.play(50, 10**18)
    played += receiver.play(50, receiver.now)
    assert receiver.taken == played


def test_frames_go_on_when_a_silent_human_is_back(receiver: Receiver) -> None:
    played = receiver.play(20, receiver.now)
    receiver.play(200, receiver.now, silent=BOB)
    assert receiver.taken == played
    assert len(receiver.given_up) == 200 - 8
    assert all(frame.missing == [*BOB] and not frame.offsets for frame in receiver.given_up)
    played += receiver.play(20, receiver.now)
    assert receiver.taken == played


def test_a_recording_at_double_speed_with_a_silent_human_has_no_wrong_clock(receiver: Receiver) -> None:
    receiver.play(50, 0 + SECOND)
    for number in range(200):
        receiver.play(1, 60 * SECOND + 2 * number * PERIOD, silent=BOB if number > 50 else ())
    assert receiver.given_up
    assert not any(frame.offsets for frame in receiver.given_up)


def test_messages_of_random_topics_and_stamps_take_bounded_memory(receiver: Receiver) -> None:
    source = random.Random(3)
    near = [receiver.now + PERIOD * number for number in range(20)]
    for _ in range(5000):
        receiver.seconds += 0.001
        far = source.choice((-1, 1)) * 10 ** source.randrange(20)
        receiver.receive(source.choice(receiver.topics), source.choice([*near, near[0] + far]))
    assert sum(map(len, receiver.buffer._frames.values())) <= 8 * len(receiver.topics)
    played = receiver.play(50, receiver.now)
    assert receiver.taken[-50:] == played


def test_a_topic_holds_frames_only_while_it_is_required(receiver: Receiver) -> None:
    receiver.play(1, START)
    receiver.buffer.require("scene_time", True)
    (held,) = receiver.play(1, START + PERIOD)
    assert held not in receiver.taken
    assert receiver.buffer.add("scene_time", held, 7, receiver.seconds)
    frame = receiver.buffer.take(False, receiver.now, receiver.seconds)
    assert frame is not None
    assert frame.contents["scene_time"] == 7
    (later,) = receiver.play(1, START + 2 * PERIOD)
    assert not receiver.buffer.has_whole
    receiver.buffer.require("scene_time", False)
    frame = receiver.buffer.take(False, receiver.now, receiver.seconds)
    assert frame is not None
    assert (frame.stamp, "scene_time" in frame.contents) == (later, False)


def test_the_last_frame_may_come_again_whole_or_in_part_and_none_counts_as_skipped() -> None:
    """In lockstep a frame is sent again for nodes that have joined."""
    buffer = PacedFrames(("a", "b"), PERIOD)

    def arrives(topic: str, stamp: int) -> bool:
        return buffer.add(topic, stamp, topic, 0.0)

    for stamp in (1, 1, 1):
        assert not arrives("a", stamp) and arrives("b", stamp)
        frame = buffer.take(False, 0, 0.0)
        assert frame is not None and (frame.stamp, frame.skipped) == (1, 0)
    assert not arrives("a", 1)  # the other message does not come again
    assert not arrives("a", 1 + PERIOD) and arrives("b", 1 + PERIOD)
    frame = buffer.take(False, 0, 0.0)
    assert frame is not None and (frame.stamp, frame.skipped) == (1 + PERIOD, 0)
    assert not arrives("a", 1) and not arrives("b", 1)
