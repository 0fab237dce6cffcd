"""What is told of a topic over a window: where the robot stood, and what came, went and flipped.

Whole bags by what is kept of them, the others message by message; see `portions`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from ros2_memory.analysis.odometry import is_place
from ros2_memory.analysis.sights import MotionDecoder
from ros2_memory.analysis.standstills import (
    CONTEXT_NS,
    StandstillBuilder,
    StandstillCollector,
    StandstillDigest,
)
from ros2_memory.analysis.topic_events import (
    MOST_TOLD,
    NO_EVENTS,
    TopicEvents,
    TopicEventsBuilder,
    state_of,
)
from ros2_memory.catalogue.codec import (
    decode_topic_events,
    encode_topic_events,
    packed_standstills,
    unpacked_standstills,
)
from ros2_memory.core.errors import UndecodableError
from ros2_memory.core.timebase import AT_OR_BEFORE_SLACK_NS, START_SLACK_NS
from ros2_memory.history.driven_path import add_poses
from ros2_memory.history.stored_parts import DigestKind, StoredPart, is_whole

if TYPE_CHECKING:
    from collections.abc import Iterable

    from ros2_memory.analysis.standstills import Standstill
    from ros2_memory.core.model import Pose, TimeWindow
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.duplicates import StoredMessage
    from ros2_memory.history.view import View

_STANDSTILLS: Final = DigestKind(
    "standstills",
    ask=lambda notes, topic, among: notes.standstills(topic, among),
    packed=lambda digest: packed_standstills(digest).hex(),
    unpacked=lambda text: unpacked_standstills(bytes.fromhex(text)),
)
_STORIES: Final = DigestKind(
    "story",
    ask=lambda notes, topic, among: notes.stories(topic, among),
    packed=lambda story: "" if story is None else encode_topic_events(story).hex(),
    unpacked=lambda text: decode_topic_events(bytes.fromhex(text)) if text else None,
)


class _Standing:
    """Takes poses for what only asks where they are."""

    def __init__(self, to: StandstillBuilder | StandstillCollector) -> None:
        self._to = to

    def add(self, time: Ns, pose: Pose, _speed_mps: float | None = None) -> None:
        """Takes the next pose, if it is one."""
        if is_place(pose.position):
            self._to.add(time, pose.position)


def standstills_in(
    view: View, topic: str, window: TimeWindow
) -> tuple[tuple[Standstill, bool], ...]:
    """Return where the poses of a topic stand still, in order, as far as it is in a window.

    With each comes whether it goes on after the window, or up to the last pose that is known.

    Poses outside of the window count too: a standstill that goes on beyond an end of the window
    ends there, however little of it is inside. So those of windows that follow each other add up.

    Raises:
        InvalidArgumentsError: a message of the topic carries no position.
    """
    start, end = window.start + START_SLACK_NS, window.stop - 1 - AT_OR_BEFORE_SLACK_NS
    window = window.widened(CONTEXT_NS)
    builder = StandstillBuilder()
    kept: StoredPart[StandstillDigest] = StoredPart(view, topic, _STANDSTILLS, window)
    sights = MotionDecoder(view.memory.reader, view.memory.extractor)
    for group in view.groups(topic, window):
        failures: list[UndecodableError] = []
        if not is_whole(group, window):
            add_poses(view, _Standing(builder), sights, group.once(), failures)
        elif (known := kept.of(group)) is not None:
            builder.join(known[0])
        else:
            collector = StandstillCollector()
            span = add_poses(view, _Standing(collector), sights, group.once(), failures)
            digest = collector.digest()
            if digest is not None:
                builder.join(digest)
                if span is not None and not failures:
                    kept.keep(group, digest, span)
    found = builder.standstills()
    return tuple(
        (
            each._replace(start=max(each.start, start), end=min(each.end, end)),
            each.end > end or each.end == builder.last,
        )
        for each in found
        if each.start < end and each.end > start
    )


def events_in(view: View, topic: str, window: TimeWindow) -> TopicEvents | None:
    """What the messages of a topic say in a window; None where there is no message."""
    builder = TopicEventsBuilder()
    kept: StoredPart[TopicEvents | None] = StoredPart(view, topic, _STORIES, window)
    for group in view.groups(topic, window):
        if not is_whole(group, window):
            _hear(view, builder, group.once())
            continue
        known = kept.of(group)
        if known is None:
            collector = TopicEventsBuilder()
            _hear(view, collector, group.once())
            story = collector.story(MOST_TOLD)
            if story is not None:
                kept.keep(group, story, (story.first, story.last))
        else:
            story, span = known
            story = TopicEvents(*span) if story is NO_EVENTS else story
        if story is not None:
            builder.join(story)
    return builder.story()


def _hear(view: View, builder: TopicEventsBuilder, messages: Iterable[StoredMessage]) -> None:
    """Adds what messages say."""
    for found in messages:
        channel = found.record.channel
        try:
            message = view.memory.reader.decode(found.record)
        except UndecodableError:
            builder.miss()
            continue
        value = view.memory.extractor.exact(message, channel.type)
        builder.add(found.time, state_of(value, channel.type))
