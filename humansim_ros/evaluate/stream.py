"""The messages of an estimate in the order of their arrival, of a bag or of a live graph."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from operator import itemgetter

import numpy as np

from humansim_ros.errors import EvaluationError, printable
from humansim_ros.evaluate.pose_sequence import Arrivals, PoseSequence, SequenceBuilder
from humansim_ros.messages.people import MAX_PEOPLE, Pose, PoseFrame

#: Most different joint names of an estimate, and most characters of a name: they come from other programs.
MAX_JOINTS, MAX_NAME = 1024, 256


@dataclass
class _Frame:
    """Estimate of one stamp. ``arrival``: that of its last part, nanoseconds; ``latency``: seconds."""

    people: dict[str, Pose] = field(default_factory=dict)
    topics: set[str] = field(default_factory=set)
    arrival: int = 0
    latency: float | None = None


class EstimateStream:
    """Estimate of a tracker, message by message.

    Several messages of one stamp are one frame. A person keeps its first pose of a stamp.

    Args:
        source: Where the messages come from, for errors.
        max_points: Most joint positions that are kept; the oldest frames are forgotten. None: all.
        max_frames: Most frames that are kept. None: all.
    """

    def __init__(self, source: str, max_points: int | None = None, max_frames: int | None = None) -> None:
        self.source = source
        self._max_points, self._max_frames = max_points, max_frames
        self._frames: dict[int, _Frame] = {}
        self._joints: set[str] = set()
        self._points = 0
        self._has_identities = True
        self._newest: dict[str, int] = {}
        self._messages = self._duplicates = self._out_of_order = 0
        #: Number of frames that were forgotten.
        self.forgotten = 0

    def __len__(self) -> int:
        return len(self._frames)

    @property
    def newest(self) -> int:
        """Newest stamp in nanoseconds; -1 before the first message."""
        return max(self._newest.values(), default=-1)

    def add(
        self,
        frame: PoseFrame,
        topic: str,
        arrival: int,
        person: str | None = None,
        latency: float | None = None,
    ) -> bool:
        """Add a message.

        Args:
            frame: Its people.
            topic: Its topic.
            arrival: Nanoseconds of any clock that does not go back.
            person: Name of the person that the topic has; None if it has none.
            latency: Seconds since its frame; None if unknown.

        Returns:
            Whether it adds to the estimate; False for a repeated message, and for one without a stamp.

        Raises:
            EvaluationError: It has too many people or names, or too long names; it is not added.
        """
        if frame.stamp is None:
            return False
        self._check_names(frame.people)
        self._messages += 1
        self._out_of_order += frame.stamp < self._newest.get(topic, 0)
        self._newest[topic] = max(frame.stamp, self._newest.get(topic, 0))
        kept = self._frames.get(frame.stamp, _Frame())
        before = len(kept.people)
        if before + len(frame.people) > MAX_PEOPLE:
            raise EvaluationError(f"more than {MAX_PEOPLE} people at {frame.stamp * 1e-9:.6f} s")
        for pose in frame.people:
            self._add_person(kept, pose, person, alone=len(frame.people) == 1)
        if len(kept.people) == before and topic in kept.topics:
            self._duplicates += 1
            return False
        self._frames[frame.stamp] = kept
        kept.topics.add(topic)
        kept.arrival, kept.latency = arrival, latency
        self._forget()
        return True

    def _check_names(self, people: Sequence[Pose]) -> None:
        new = {name for pose in people for name in pose.names} - self._joints
        words = [*new, *(pose.person for pose in people if pose.person is not None)]
        if long := next((word for word in words if len(word) > MAX_NAME), None):
            raise EvaluationError(f"a name is longer than {MAX_NAME} characters: {printable(long, 40)}")
        if len(self._joints) + len(new) > MAX_JOINTS:
            raise EvaluationError(
                f"more than {MAX_JOINTS} different joints, such as {printable(min(new), 80)}"
            )
        self._joints |= new

    def _add_person(self, frame: _Frame, pose: Pose, topic_person: str | None, alone: bool) -> None:
        """Add a person to a frame if it is not there yet. ``alone``: nobody else is in its message."""
        name = pose.person
        if topic_person is not None:
            name = topic_person if name is None else f"{topic_person}/{name}"
        if name is None:
            if any(_is_same(pose, other) for other in frame.people.values()):
                return
            # one person a message: the first of a stamp is always the same
            self._has_identities = self._has_identities and alone and not frame.people
            name = str(len(frame.people) + 1)
        if name not in frame.people:
            frame.people[name] = pose
            self._points += len(pose.names)

    def _forget(self) -> None:
        """Forget the oldest frames beyond the limits."""
        while len(self._frames) > 1 and (
            (self._max_frames is not None and len(self._frames) > self._max_frames)
            or (self._max_points is not None and self._points > self._max_points)
        ):
            oldest = self._frames.pop(next(iter(self._frames)))
            self._points -= sum(len(pose.names) for pose in oldest.people.values())
            self.forgotten += 1

    def sequence(self, since: int = 0) -> PoseSequence:
        """The poses of frames with stamps from ``since`` on, nanoseconds; also while messages are added.

        Raises:
            EvaluationError: There is no pose, or no position is finite.
        """
        builder = SequenceBuilder(self.source, self._has_identities)
        # copies: other threads may call add
        frames = sorted((each for each in list(self._frames.items()) if each[0] >= since), key=itemgetter(0))
        for stamp, frame in frames:
            builder.add_frame(stamp)
            for person, pose in list(frame.people.items()):
                builder.add(stamp, person, pose.names, pose.positions, pose.score)
        kept = [frame for _, frame in frames]
        latencies = [frame.latency for frame in kept if frame.latency is not None]
        arrivals = Arrivals(
            np.array([frame.arrival for frame in kept], np.int64),
            np.array(latencies, float),
            self._messages,
            self._duplicates,
            self._out_of_order,
        )
        return replace(builder.build(), arrivals=arrivals)


def _is_same(one: Pose, other: Pose) -> bool:
    return one.names == other.names and np.array_equal(one.positions, other.positions, equal_nan=True)
