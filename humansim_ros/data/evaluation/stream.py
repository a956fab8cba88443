"""Collect the messages of an estimate as they arrive, from a bag or from a live ROS graph."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from humansim_ros.data.evaluation.pose_sequence import Arrivals, PoseSequence, SequenceBuilder
from humansim_ros.data.messages.frames import Frames
from humansim_ros.data.messages.people import MAX_PEOPLE, Pose, PoseFrame
from humansim_ros.errors import EvaluationError, printable

#: Most different joint names of an estimate, and most characters of a name. Limits, since other programs send
#: them.
MAX_JOINTS, MAX_NAME = 1024, 256


class _Part(NamedTuple):
    """People with the same stamp on one topic; with arrival (nanoseconds) and latency (seconds) of the last
    message."""

    people: Mapping[str, Pose]
    arrival: int
    latency: float | None

    @property
    def points(self) -> int:
        """Number of joint positions."""
        return sum(len(pose.names) for pose in self.people.values())


class EstimateStream:
    """Collects the estimate of a tracker message by message, and makes a sequence of it.

    Messages with the same stamp make up one frame. If a frame gets a person twice, the first pose counts.

    Args:
        source: Where the messages come from, for errors.
        max_points: Most joint positions that are stored. The oldest frames are forgotten first. If None, no
            limit.
        max_frames: Most frames that are stored. If None, no limit.
        check: Called with each message that has a stamp. It raises EvaluationError for a message that must
            not be added.
    """

    def __init__(
        self,
        source: str,
        max_points: int | None = None,
        max_frames: int | None = None,
        check: Callable[[PoseFrame], None] = lambda frame: None,
    ) -> None:
        self.source, self._check = source, check
        self._frames: Frames[_Part] = Frames(
            max_frames=max_frames, max_size=max_points, size_of=lambda part: part.points
        )
        self._joints: set[str] = set()
        self._has_identities = True
        self._newest: dict[str, int] = {}
        self._messages = self._duplicates = self._out_of_order = 0

    def __len__(self) -> int:
        return len(self._frames)

    @property
    def forgotten(self) -> int:
        """Number of frames that were forgotten."""
        return self._frames.forgotten

    @property
    def first(self) -> int:
        """Smallest stamp of all frames that are not forgotten, nanoseconds; -1 before the first message."""
        return min(self._frames.stamps(), default=-1)

    @property
    def newest(self) -> int:
        """Largest stamp of all frames, nanoseconds; -1 before the first message."""
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
            frame: People of the message.
            topic: Topic of the message.
            arrival: Nanoseconds of any clock that does not go back.
            person: Name that the topic gives to the person. None if the message has the names.
            latency: Seconds since the frame of the message. None if unknown.

        Returns:
            Whether the message adds to the estimate. False for a repeated message, and for one without a
            stamp.

        Raises:
            EvaluationError: There are too many people or names, or a name is too long. The message is not
                added.
        """
        if frame.stamp is None:
            return False
        self._check(frame)
        self._check_names(frame.people)
        self._messages += 1
        self._out_of_order += frame.stamp < self._newest.get(topic, 0)
        self._newest[topic] = max(frame.stamp, self._newest.get(topic, 0))
        parts = self._frames.frame(frame.stamp)
        known = _people_of(parts)
        if len(known) + len(frame.people) > MAX_PEOPLE:
            raise EvaluationError(f"more than {MAX_PEOPLE} people at {frame.stamp * 1e-9:.6f} s")
        new: dict[str, Pose] = {}
        for pose in frame.people:
            if name := self._new_name(known, pose, person, alone=len(frame.people) == 1):
                known[name] = new[name] = pose
        if not new and topic in parts:
            self._duplicates += 1
            return False
        before = parts[topic].people if topic in parts else {}
        self._frames.add(topic, frame.stamp, _Part({**before, **new}, arrival, latency))
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

    def _new_name(
        self, known: Mapping[str, Pose], pose: Pose, topic_person: str | None, alone: bool
    ) -> str | None:
        """Choose the name of a person who is added to a frame; None if the frame has the person already.

        Args:
            known: People that the frame has already, by name.
            pose: The person to add.
            topic_person: Name that the topic gives to the person, or None.
            alone: Whether the message has no other person.
        """
        name = pose.person
        if topic_person is not None:
            name = topic_person if name is None else f"{topic_person}/{name}"
        if name is None:
            if any(_is_same(pose, other) for other in known.values()):
                return None
            # one person per message: the first one of a stamp is always the same
            self._has_identities = self._has_identities and alone and not known
            name = str(len(known) + 1)
        return None if name in known else name

    def sequence(self, since: int = 0) -> PoseSequence:
        """Poses of frames from the stamp ``since`` on, nanoseconds. Messages may be added at the same time.

        Raises:
            EvaluationError: There is no frame, or no position is finite.
        """
        builder = SequenceBuilder(self.source, self._has_identities)
        last = []
        for stamp in self._frames.stamps():
            parts = self._frames.frame(stamp) if stamp >= since else {}
            if parts:  # another thread may have removed it
                builder.add_frame(stamp)
                last.append(list(parts.values())[-1])
            for person, pose in _people_of(parts).items():
                builder.add(stamp, person, pose.names, pose.positions, pose.score)
        if not last:
            raise EvaluationError("there are no poses in it", path=self.source)
        latencies = [part.latency for part in last if part.latency is not None]
        arrivals = Arrivals(
            np.array([part.arrival for part in last], np.int64),
            np.array(latencies, float),
            self._messages,
            self._duplicates,
            self._out_of_order,
        )
        return replace(builder.build(), arrivals=arrivals)


def _is_same(one: Pose, other: Pose) -> bool:
    return one.names == other.names and np.array_equal(one.positions, other.positions, equal_nan=True)


def _people_of(parts: Mapping[str, _Part]) -> dict[str, Pose]:
    """People with one stamp, from all topics, by name. ``parts``: people by topic."""
    return {name: pose for part in parts.values() for name, pose in part.people.items()}
