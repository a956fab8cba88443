"""A bag as the source of a page: its topics, frame by frame."""

from __future__ import annotations

import os
import warnings
from collections import OrderedDict
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from humansim_ros import messages
from humansim_ros.bags.reader import BagReader
from humansim_ros.errors import HumansimError, HumansimWarning
from humansim_ros.evaluate.live import LiveOptions
from humansim_ros.humans import Human
from humansim_ros.messages.frames import Frames
from humansim_ros.messages.types import begins_with_stamp, readable_type
from humansim_ros.types import Indices
from humansim_ros.view.picking import PIXEL_CHANNELS
from humansim_ros.view.seen_topics import seen_topics
from humansim_ros.view.source import IMAGE_WIDTH, JOINTS, PixelInfo, ViewFrame
from humansim_ros.view.topic_frames import (
    PERIOD,
    SAMPLES,
    TopicFrame,
    TopicFrames,
    TopicSource,
)

#: Nanoseconds between log times of messages that are read together.
_TOGETHER = 250_000_000
#: Bytes of messages that are kept.
_MAX_KEPT = 256 << 20


class BagViewSource(TopicSource):
    """A bag that plays in the page; it is read once at the start, to find its frames.

    A frame is a stamp of the joints of people; without people, of the topic with the most messages. What the
    bag does not have is not shown, and ``messages`` says so.

    Args:
        path: The bag.
        estimate: Topic of a tracker's estimate; ``*`` stands for the name of a person.
        options: How the estimate is read and compared.
        humans: Bodies that people may have, beside the built-in ones.
        image_width: Width to which wider images are scaled down, pixels.

    Raises:
        BagError: The bag cannot be read.
        HumansimError: The bag has no topic of the estimate.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        estimate: str | None = None,
        options: LiveOptions | None = None,
        humans: Sequence[Human] = (),
        image_width: int = IMAGE_WIDTH,
    ) -> None:
        self.path = Path(path)
        super().__init__(TopicFrames(humans, options, image_width))
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", HumansimWarning)
            self._reader = BagReader(path)
        try:
            self._note_warnings(caught)
            names = self._reader.topics
            counts = self._reader.info.counts
            types = {topic.name: topic.type for n, topic in enumerate(names) if counts.get(n)}
            self._topics = seen_topics(types, estimate, (options or LiveOptions()).keypoints)
            if estimate is not None and not self._topics.estimate:
                raise HumansimError(f"the bag has no topic {estimate} with poses", path=path)
            self._number = [topic.name for topic in names]
            #: Messages that were read last, by topic and log time.
            self._kept: OrderedDict[tuple[str, int], bytes] = OrderedDict()
            self._size = 0
            #: Log times of the messages.
            self._logs = self._survey()
            self._stamps = self._frame_stamps()
            self._last = 0
            self._shown.see(self._topics, self._read(self._logs.first()))
            for name in self._shown.skinless:
                self._shown.add_skin(name, self._samples(name))
            self._note_missing()
        except BaseException:
            self._reader.close()
            raise

    def _note_warnings(self, caught: Iterable[warnings.WarningMessage]) -> None:
        for each in caught:
            if issubclass(each.category, HumansimWarning):
                self._shown.note(str(each.message))
            else:
                warnings.warn_explicit(each.message, each.category, each.filename, each.lineno)

    def _note_missing(self) -> None:
        topics = self._topics
        if not topics.cameras:
            self._shown.note("The bag has no cameras: no topic is a camera_info.")
        elif not any(camera.images for camera in topics.cameras.values()):
            self._shown.note("The bag has no images.")
        if not topics.people:
            self._shown.note("The bag has no people: no topic is humans/<name>/joints.")

    # --- the source

    @property
    def title(self) -> str:
        return self.path.stem

    @property
    def period(self) -> int:
        steps = np.diff(self._stamps)
        return max(1, int(np.median(steps))) if len(steps) else PERIOD

    @property
    def frames(self) -> int:
        return len(self._stamps)

    def frame(
        self, index: int, cameras: Collection[str] = (), channels: Collection[str] = (), wait: bool = False
    ) -> ViewFrame:
        self._last = min(max(index, 0), self.frames - 1)
        found = self._frame(self._last, cameras, channels)
        return self._shown.frame(found, cameras, channels)

    def describe(self, camera: str, x: int, y: int) -> PixelInfo:
        return self._shown.describe(self._frame(self._last, [camera], PIXEL_CHANNELS), camera, x, y)

    def close(self) -> None:
        self._reader.close()

    # --- messages

    def _survey(self) -> Frames[int]:
        """Log times of the messages of all topics that can be shown."""
        found: Frames[int] = Frames()
        lasting = self._topics.lasting
        stamped = {name: _has_stamp(self._topics.types[name]) for name in self._topics.topics}
        for message in self._reader.messages(self._topics.topics):
            name = self._number[message.topic]
            if name in self._topics.transforms:
                try:
                    self._shown.transforms.add(bytes(message.data))
                except HumansimError as error:
                    self._shown.note(f"{name}: {error.message}")
                continue
            stamp = message.stamp
            if stamped[name]:
                try:
                    stamp = messages.serialised_stamp(bytes(message.data[:12]))
                except HumansimError as error:
                    self._shown.note(f"{name}: {error.message}")
                    continue
            (found.keep if name in lasting else found.add)(name, stamp, message.stamp)
        return found

    def _frame_stamps(self) -> Indices:
        """Stamps of the frames; one frame at least."""
        found = self._logs.stamps([topics["joints"] for topics in self._topics.people.values()])
        if not found:
            stamps = [self._logs.stamps([topic]) for topic in self._logs.first()]
            found = max(reversed(stamps), key=len, default=[])
        return np.array(found or [0], np.int64)

    def _frame(self, index: int, cameras: Collection[str], channels: Collection[str]) -> TopicFrame:
        """Messages of a frame, with the images of some channels and cameras."""
        topics, stamp = self._topics, int(self._stamps[index])
        wanted = {"rgb" if channel == JOINTS else channel for channel in channels}
        left_out = topics.on_demand
        for name in cameras:
            if name in topics.cameras:
                camera = topics.cameras[name]
                left_out -= {topic for channel, topic in camera.images.items() if channel in wanted}
                left_out -= {camera.joints}
        shown = [topic for topic in topics.topics if topic not in left_out]
        logs = self._logs.near(stamp, shown, self.period // 2)
        return TopicFrame(index, stamp, int(self._stamps[0]), self._read(logs))

    def _samples(self, name: str) -> list[tuple[bytes, bytes]]:
        """Joints and vertices of a person in some frames."""
        topics = self._topics.people[name]
        pair = [topics["joints"], topics["vertices"]]
        common = sorted(set(self._logs.stamps(pair[:1])) & set(self._logs.stamps(pair[1:])))
        found = []
        places = np.unique(np.linspace(0, len(common) - 1, SAMPLES).astype(int)) if common else ()
        for place in places:
            data = self._read(self._logs.near(common[place], pair, 0))
            if data.keys() == set(pair):
                found.append((data[pair[0]], data[pair[1]]))
        return found

    def _read(self, places: Mapping[str, int]) -> dict[str, bytes]:
        """Messages by topic, from their log times; damaged ones are left out."""
        found: dict[str, bytes] = {}
        lacking: list[tuple[int, str]] = []
        for topic, log in places.items():
            content = self._kept.get((topic, log))
            if content is None:
                lacking.append((log, topic))
            else:
                self._kept.move_to_end((topic, log))
                found[topic] = content
        lacking.sort()
        groups: list[list[tuple[int, str]]] = []
        for each in lacking:
            if groups and each[0] - groups[-1][-1][0] <= _TOGETHER:
                groups[-1].append(each)
            else:
                groups.append([each])
        for group in groups:
            wanted = {topic: log for log, topic in group}
            for message in self._reader.messages(list(wanted), start=group[0][0], end=group[-1][0] + 1):
                topic = self._number[message.topic]
                if message.stamp == wanted[topic] and topic not in found:
                    found[topic] = bytes(message.data)
                    self._keep((topic, message.stamp), found[topic])
        return found

    def _keep(self, key: tuple[str, int], content: bytes) -> None:
        self._kept[key] = content
        self._size += len(content)
        while self._size > _MAX_KEPT and len(self._kept) > 1:
            self._size -= len(self._kept.popitem(last=False)[1])


def _has_stamp(kind: str) -> bool:
    try:
        return begins_with_stamp(readable_type(kind))
    except HumansimError:  # a type that is not installed and that rosbags does not know
        return False
