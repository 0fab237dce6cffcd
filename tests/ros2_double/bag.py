"""A recording: a directory of splits, and `metadata.yaml` once it was closed."""

from __future__ import annotations

from copy import deepcopy
from typing import TYPE_CHECKING, Final

from tests.ros2_double.definitions import full_text
from tests.ros2_double.mcap_file import DISK_FULL, McapFile
from tests.ros2_double.metadata import Info, Span, Topic, metadata_text, whole_file

if TYPE_CHECKING:
    from collections.abc import Callable

    from tests.ros2_double.arguments import Options

_FLUSHING: Final = "Writing remaining messages from cache to the bag. It may take a while"


class Bag:
    """An open recording. Making it makes the directory; `say` logs as (level, logger, text)."""

    def __init__(self, options: Options, say: Callable[[str, str, str], None]) -> None:
        self._options = options
        self._say = say
        self._topics: dict[str, Topic] = {}
        self._info = Info(options.custom)
        options.output.mkdir(parents=True)
        self._file = self._opened()
        self._list()
        self._file.metadata(metadata_text(self._info))

    @property
    def count(self) -> int:
        return sum(topic.count for topic in self._topics.values())

    def subscribe(self, topic: Topic) -> None:
        self._topics[topic.name] = topic
        self._declare(topic)

    def write(self, topic: str, payload: bytes, log_time: int, publish_time: int) -> None:
        """Writes a message; one that comes too late for this split opens the next one."""
        span = self._info.files[-1][1]
        limit = self._options.duration_s * 10**9
        if limit and log_time - span.start > limit:
            self._split()
            span = self._info.files[-1][1]
        span.take(log_time)
        whole = self._info.whole
        whole.start = min(whole.start, log_time)
        whole.duration = max(whole.duration, log_time - whole.start)
        self._topics[topic].count += 1
        self._file.message(topic, payload, log_time, publish_time)

    def close(self) -> None:
        self._flush()
        closing = deepcopy(self._info)
        closing.whole.count = self.count
        # The copy in the last file differs from those before it: it knows the topics.
        self._file.metadata(metadata_text(closing, self._topics.values()))
        self._file.close()
        text = whole_file(metadata_text(closing, self._topics.values()))
        try:
            (self._options.output / "metadata.yaml").write_text(text, "utf-8")
        except OSError as error:
            if error.errno not in DISK_FULL:
                raise

    def _declare(self, topic: Topic) -> None:
        metadata = {"offered_qos_profiles": topic.qos, "topic_type_hash": topic.type_hash}
        self._file.declare(topic.name, topic.type, full_text(topic.type), metadata)

    def _split(self) -> None:
        """The next file is there before the footer of this one is."""
        self._flush()
        self._file.metadata(metadata_text(self._info))
        closed, self._file = self._file, self._opened()
        closed.close()
        self._file.metadata(metadata_text(self._info))
        self._list()
        # The real recorder declares in the order of a hash table: ids differ between files.
        for topic in reversed(self._topics.values()):
            self._declare(topic)

    def _flush(self) -> None:
        self._say("info", "rosbag2_cpp", _FLUSHING)

    def _opened(self) -> McapFile:
        self._name = f"{self._options.output.name}_{len(self._info.files)}.mcap"
        return McapFile(self._options.output / self._name, self._options.layout)

    def _list(self) -> None:
        self._info.files.append((self._name, Span()))
