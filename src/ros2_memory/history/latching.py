"""Which topics are latched: their last message holds until the next one, however long ago it was.

Durability alone does not say so: PX4 publishes telemetry of 100 Hz as transient local, and
`/rosout` is transient local everywhere. A topic is latched where it is transient local, no log, and
has a message every 5 s or less often over its recording (see `pace`); so are the topics of static
transforms, which some writers record without QoS. The configuration may say otherwise of any topic.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from ros2_memory.bag_dir.carried_origin import origin_of
from ros2_memory.bag_dir.layout import CARRY_FOLDER, is_carried
from ros2_memory.core.text import match_topics
from ros2_memory.index.pace import is_rare

if TYPE_CHECKING:
    from pathlib import Path

    from ros2_memory.history.duplicates import StoredMessage
    from ros2_memory.index.snapshot import Snapshot


@dataclass(frozen=True, slots=True)
class Latching:
    """Judges topics.

    Attributes:
        static_topics: those of static transforms.
        include: names or globs of topics that are latched whatever their publishers offer.
        exclude: names or globs of topics that are not; it wins.
    """

    static_topics: tuple[str, ...] = ()
    include: tuple[str, ...] = ()
    exclude: tuple[str, ...] = ()

    def may_hold(self, snapshot: Snapshot, topic: str) -> bool:
        """Whether some message of a topic may be latched."""
        said = self._configured(topic)
        return snapshot.is_held(topic) if said is None else said

    def holds(self, snapshot: Snapshot, found: StoredMessage) -> bool:
        """Whether a message is latched, by the pace of its topic in its own recording."""
        channel = found.record.channel
        said = self._configured(channel.topic)
        if said is not None or not snapshot.is_held(channel.topic):
            return bool(said)
        if is_carried(found.bag.path):
            origin = origin_of(channel)
            return origin is None or not origin.often
        return is_rare(snapshot.pace(channel.topic, found.bag.recording))

    def is_latched(self, snapshot: Snapshot, topic: str) -> bool:
        """Whether a topic is latched, by its pace in the newest recording that holds it."""
        said = self._configured(topic)
        if said is not None or not snapshot.is_held(topic):
            return bool(said)
        newest = _newest(snapshot, topic)
        return newest is not None and is_rare(snapshot.pace(topic, newest))

    def _configured(self, topic: str) -> bool | None:
        """What the configuration says of a topic; None where it says nothing."""
        if any(match_topics((topic,), glob) for glob in self.exclude):
            return False
        if topic in self.static_topics or any(
            match_topics((topic,), glob) for glob in self.include
        ):
            return True
        return None


def _newest(snapshot: Snapshot, topic: str) -> Path | None:
    """The recording with the newest message of a topic; that of carried ones where no other is."""
    spans = {
        recording: last
        for recording, (_, last) in snapshot.recordings(topic).items()
        if recording.name != CARRY_FOLDER
    } or {recording: last for recording, (_, last) in snapshot.recordings(topic).items()}
    return max(spans, key=lambda each: (spans[each], str(each)), default=None)
