"""Rules of lockstep (each frame waits for its members), its files and its summary, without ROS."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Collection, Iterable, Mapping
from dataclasses import asdict, dataclass
from itertools import count
from pathlib import Path
from typing import Literal

from humansim_ros.files.reading import write_file

#: Most members that may join by sending reports, since anybody in the network could send reports.
MAX_JOINED = 100
#: After a node has joined, the frame is sent again after these times, and then each time after the last
#: number of seconds. One time is not enough, since the endpoints of a node find each other one after the
#: other.
_AGAIN_AFTER, _AGAIN_EVERY = (0.5, 1.0, 2.0, 4.0), 5.0
#: The frame is also sent again after ``_AGAIN_EVERY`` plus this many times the longest recent time of a
#: member, since a message may be lost.
_SLOWER = 3.0
#: If a member answers sooner than its stored longest time, this share of the stored time is kept.
_FORGETTING = 0.9
#: Time that the nodes of a scene have for their start before time-outs count, seconds.
START_LIMIT = 60.0
#: Seconds between two log lines about members that have not finished a frame.
_REMIND_EVERY = 5.0


@dataclass
class Member:
    """A node or topic that frames wait for.

    Attributes:
        name: Name of the node, or name of the topic.
        required: Whether frames wait for this member even before its first report, or when it has left the
            graph.
        since: Time from which frames wait for this member, seconds.
        finished: Number of frames that this member has finished.
        newest: Stamp of the newest frame that this member has finished or reported.
        heard: Whether this member has ever reported.
        absent: Whether this member was given up. Frames wait for it again after its next report.
        seconds: Longest time that this member has recently needed for a frame.
    """

    name: str
    required: bool
    since: float
    finished: int = 0
    newest: int = 0
    heard: bool = False
    absent: bool = False
    seconds: float = 0.0


class Lockstep:
    """Knows the frame in flight (the newest one sent), and which members have finished it.

    A frame is sent at least once. A frame is sent again when a node joins the graph or has never reported,
    since a node that was killed and started again has not seen the frame; and also when a member is silent
    for long. So frame k + 1 is sent only when each member has finished frame k, even a member that was killed
    in between.

    Args:
        required: Names of the members that frames wait for from the start.
        starting: Members that start with the scene. No time-out counts until all of them have reported, at
            most for 60 s.
        timeout: Seconds after which a member is overdue.
        now: Present time. All times are seconds of one clock that never goes back.
    """

    def __init__(
        self, required: Iterable[str], starting: Collection[str], timeout: float, now: float
    ) -> None:
        self.members = {name: Member(name, required=True, since=now) for name in required}
        self._starting = set(starting)
        self._timeout = timeout
        self._started, self._ready = now, now
        #: Time at which a dead node of the scene was last started again; None if a frame has been finished
        #: since.
        self._restarted: float | None = None
        #: Number of finished frames of each member that has left, by name.
        self._left: dict[str, int] = {}
        #: Stamp of the frame in flight; None before the first frame.
        self.stamp: int | None = None
        self._resting: Collection[str] = ()
        self._first = self._sent = 0
        self._sent_at = now
        #: Next time at which the frame is sent again; and further such times after it.
        self._again = float("inf")
        self._row: list[float] = []
        #: Whether the frame is sent again for nodes that have joined.
        self._for_nodes = False
        self._next_reminder = now

    @property
    def sent(self) -> int:
        """Number of different frames that were sent."""
        return self._sent

    @property
    def missing(self) -> list[Member]:
        """Members that have not finished the frame in flight."""
        if self.stamp is None:
            return []
        return [
            each
            for each in self.members.values()
            if not each.absent and each.newest < self.stamp and each.name not in self._resting
        ]

    @property
    def is_finished(self) -> bool:
        """Whether the next frame may be sent."""
        return not self.missing

    @property
    def finished(self) -> dict[str, int]:
        """Number of frames that each member has finished, including members that have left."""
        return {**self._left, **{each.name: each.finished for each in self.members.values()}}

    def begin(self, stamp: int, now: float, resting: Collection[str] = ()) -> None:
        """Note that a new frame is sent.

        Args:
            stamp: Stamp of the frame.
            now: Present time.
            resting: Members that do not report this frame. The frame does not wait for them.

        Raises:
            ValueError: The previous frame is unfinished.
        """
        if self.missing or (self.stamp is not None and stamp <= self.stamp):
            raise ValueError(f"frame {stamp} must not follow {self.stamp} now")
        if self.stamp is None:
            self._first = stamp
        if self._restarted is not None and self._sent_at > self._restarted:
            self._restarted = None  # a whole frame was sent and finished since
        self.stamp, self._sent_at, self._resting = stamp, now, resting
        self._sent += 1
        self._next_reminder = now + _REMIND_EVERY
        self._row, self._again, self._for_nodes = [], now + self._patience(), False
        if any(not each.heard and not each.absent for each in self.members.values()):
            self.add_node(now)

    def withdraw(self) -> None:
        """Forget the frame in flight, which no member has finished. A later frame replaces it."""
        self.stamp = None
        self._sent -= 1

    def add_repeat(self, now: float) -> None:
        """Note that the frame is sent again."""
        self._row = [time for time in self._row if time > now]
        self._for_nodes = bool(self._row)
        self._again = self._row.pop(0) if self._row else now + self._patience()

    def _patience(self) -> float:
        """Seconds after which a frame is sent again although no member seems to have missed it."""
        return _AGAIN_EVERY + _SLOWER * max((each.seconds for each in self.missing), default=0.0)

    def is_due_again(self, now: float, paused: bool = False) -> bool:
        """Whether the frame must be sent again. During a pause (``paused``), nodes that join get even a
        finished frame, since no further frame follows."""
        wanted = not self.is_finished or (paused and self._for_nodes)
        return now >= self._again and wanted and self.stamp is not None

    def add_node(self, now: float) -> None:
        """Note that endpoints have joined the graph. They may have missed the frame, so it will be sent
        again."""
        self._row = [now + seconds for seconds in _AGAIN_AFTER]
        self._again = self._row[0] if self.is_finished else min(self._again, self._row[0])
        self._for_nodes = True

    def add_report(self, name: str, stamp: int, now: float) -> bool:
        """Note that a member has finished the frame with a stamp.

        A stamp newer than that of the frame counts, too. A report with an older stamp does not finish the
        frame, but shows that its sender lives. An unknown sender becomes a member if it reports a frame that
        was sent.

        Returns:
            Whether the sender is a member (maybe since this report).
        """
        if self.stamp is None:
            return name in self.members
        member = self.members.get(name)
        if member is None:
            if not self._first <= stamp <= self.stamp or self._joined() >= MAX_JOINED:
                return False
            finished = self._left.pop(name, 0)
            member = self.members[name] = Member(name, required=False, since=now, finished=finished)
            self.add_node(now)  # it has missed the frames until now
        if not member.heard:
            member.heard = True
            if all(self.members[each].heard for each in self._starting):
                self._ready = now if self._starting else self._started
                self._starting.clear()
        if stamp < self.stamp:
            member.newest = max(member.newest, stamp)
            return True
        if member.absent:
            member.absent, member.since = False, now
        if member.newest < self.stamp:
            member.newest = self.stamp  # not the stamp of the report: it may be far ahead
            member.finished += 1
            member.seconds = max(_FORGETTING * member.seconds, now - self._sent_at)
        return True

    def _joined(self) -> int:
        return sum(not each.required for each in self.members.values())

    def leave(self, name: str) -> bool:
        """Remove a member that has joined by its reports. Returns whether there was such a member."""
        member = self.members.get(name)
        if member is None or member.required:
            return False
        del self.members[name]
        if len(self._left) < MAX_JOINED:
            self._left[name] = member.finished
        return True

    def restart(self, now: float) -> None:
        """Note that a node of the scene has died or is started again, at time ``now``. It has 60 s before a
        time-out counts. A time before that of the last call changes nothing."""
        self._restarted = now if self._restarted is None else max(self._restarted, now)

    def overdue(self, now: float) -> list[Member]:
        """Members with a time-out that has passed."""
        limit = max(self._timeout, START_LIMIT)
        if self._starting and now < self._started + limit:
            return []
        if self._restarted is not None and now < self._restarted + limit:
            return []
        since = max(self._sent_at, self._ready)
        return [each for each in self.missing if now - max(since, each.since) >= self._timeout]

    def give_up(self, overdue: Iterable[Member]) -> bool:
        """Give up some members. Frames do not wait for them until they report again.

        Returns:
            False if no member would be left to see the next frames. Then no member is given up.
        """
        names = {each.name for each in overdue}
        if all(each.absent or each.name in names for each in self.members.values()):
            return False
        for name in names:
            self.members[name].absent = True
        return True

    def is_reminder_due(self, now: float) -> bool:
        """Whether it is time for a log line with the missing members. This is so every five seconds."""
        if now < self._next_reminder or self.is_finished:
            return False
        self._next_reminder = next(
            t for n in count(1) if (t := self._next_reminder + n * _REMIND_EVERY) > now
        )
        return True

    def waited(self, now: float) -> float:
        """Seconds since the frame in flight was sent for the first time."""
        return now - self._sent_at


#: What happens at a time-out: the run stops, or goes on without the overdue members.
OnTimeout = Literal["stop", "continue"]


@dataclass(frozen=True)
class LockstepSummary:
    """Result of a run in lockstep: how many frames were sent and finished.

    Attributes:
        frames: Number of frames of the run.
        sent: Number of frames that this player has sent. Before a restart, an earlier player has sent the
            others.
        finished: Number of the sent frames that each member has finished, by name.
        seconds: Wall-clock time until the last sent frame was finished. 0 if no frame was finished.
        scene_seconds: Simulated time of the sent frames.
        is_complete: Whether all requested frames were sent.
        error: Why the run ended early, or empty.
    """

    frames: int
    sent: int
    finished: Mapping[str, int]
    seconds: float
    scene_seconds: float
    is_complete: bool
    error: str = ""

    @property
    def text(self) -> str:
        """Summary as lines of text for users."""
        again = (
            f" ({self.sent} of them since the player was started again)" if self.sent < self.frames else ""
        )
        members = ", ".join(f"{name} {count}" for name, count in self.finished.items())
        rates = (
            f"{self.sent} in {self.seconds:.1f} s: {self.sent / self.seconds:.1f} frames/s, "
            f"{self.scene_seconds / self.seconds:.2f} times real time"
            if self.seconds and self.sent
            else "none was finished by all members"
        )
        return f"{self.frames} frames in lockstep{again}; {rates}\nfinished: {members}"

    def write(self, path: str) -> None:
        """Write the summary to a file."""
        write_file(path, json.dumps(asdict(self)))

    @classmethod
    def read(cls, path: Path) -> LockstepSummary | None:
        """Read a summary from a file; None if the file is missing."""
        return cls(**json.loads(path.read_text())) if path.is_file() else None


class RestartFile:
    """File by which the process that starts nodes tells the player that a node has died or is started
    again."""

    def __init__(self, summary: str) -> None:
        self._path = Path(f"{summary}.restart")

    def write(self) -> None:
        """Write into the file that a restart happens now."""
        write_file(self._path, repr(time.monotonic()))

    def age(self) -> float | None:
        """Seconds since the newest restart; None if there was no restart."""
        try:
            return time.monotonic() - float(self._path.read_text())
        except (OSError, ValueError):
            return None


class ProgressFile:
    """File with the stamp of the newest frame, for a restarted player. ``path``: the file, created if
    missing."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)

    @property
    def stamp(self) -> int:
        """Stamp that was written last, nanoseconds. 0 if no stamp was written."""
        text = os.pread(self._file, 20, 0)
        return int(text) if text.isdigit() else 0

    def write(self, stamp: int) -> None:
        """Write a stamp. The write of 20 bytes is complete or absent, even if the process is killed."""
        os.pwrite(self._file, b"%020d" % stamp, 0)

    def remove(self) -> None:
        """Close and remove the file, so that a later run begins at its start."""
        os.close(self._file)
        self._path.unlink(missing_ok=True)
