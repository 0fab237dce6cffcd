"""The events of one topic in a window, from digests of whole bags and the messages of others."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Final

from ros2_memory.analysis.topic_events import (
    MAX_PER_BAG,
    NO_EVENTS,
    TopicEvents,
    TopicEventsBuilder,
    state_of,
)
from ros2_memory.catalogue.codec import decode_topic_events, encode_topic_events
from ros2_memory.core.errors import UndecodableError
from ros2_memory.core.text import Reason, counted
from ros2_memory.history.bag_fold import Fold
from ros2_memory.history.bag_groups import DigestKind, store_shared
from ros2_memory.history.context import Note

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from ros2_memory.analysis.topic_events import Toggle
    from ros2_memory.core.model import TimeWindow
    from ros2_memory.history.bag_groups import Span
    from ros2_memory.history.duplicates import StoredMessage
    from ros2_memory.history.view import View

TOPIC_EVENTS: Final = DigestKind(
    "story",
    look_up=lambda digests, topic, among: digests.catalogue.topic_events(topic, among),
    encode=encode_topic_events,
    decode=decode_topic_events,
)

_NOTHING: Final = b"-"
_UNDECODED: Final = Reason("could not be decoded, so their content is missing", "topic")


def toggled(topic: str, toggle: Toggle) -> str:
    """Returns a sentence for a boolean of a topic that toggled."""
    name = topic if toggle.path == "value" else f"{topic} {toggle.path}"
    return f"{name} became {'true' if toggle.value else 'false'}"


def events_in(view: View, topic: str, window: TimeWindow) -> TopicEvents | None:
    """Returns what the messages of a topic report in a window; None where there is no message."""
    builder = TopicEventsBuilder()
    Fold(
        TOPIC_EVENTS,
        add=lambda messages: add_events(view, builder, messages),
        collect=partial(collect_events, view),
        join=partial(_join, builder),
        reduce=_reduced,
        encode=_encoded,
        decode=_decoded,
    ).over(view, topic, window)
    return builder.events()


def _join(builder: TopicEventsBuilder, events: TopicEvents | None, span: Span) -> None:
    if events is NO_EVENTS:
        builder.join_uneventful(*span)
    elif events is not None:
        builder.join(events)


def _reduced(
    found: Sequence[tuple[TopicEvents | None, Span]],
) -> Sequence[tuple[TopicEvents | None, Span]]:
    """Returns the events of several bags as of one, unless something would be left out."""
    builder = TopicEventsBuilder()
    for events, span in found:
        _join(builder, events, span)
    whole = builder.events()
    parts = [each for each, _ in found if each is not None]
    if whole is None or whole.all_left_out > sum(each.all_left_out for each in parts):
        return found
    return [(whole, (found[0][1][0], found[-1][1][1]))]


def _encoded(events: TopicEvents | None) -> bytes:
    return _NOTHING if events is NO_EVENTS else encode_topic_events(events)


def _decoded(packed: bytes) -> TopicEvents | None:
    return NO_EVENTS if packed == _NOTHING else decode_topic_events(packed)


def store_shared_events(view: View, topic: str, window: TimeWindow) -> int:
    """Stores the events of recordings that touch each other; returns of how many groups of bags."""
    return store_shared(view, topic, TOPIC_EVENTS, partial(collect_events, view), window)


def collect_events(
    view: View, messages: Iterable[StoredMessage], at_most: int | None = MAX_PER_BAG
) -> tuple[TopicEvents | None, Span | None]:
    """Returns the digest of some messages, and the times of the first and the last, if any.

    It has at most so many events of each kind, as that of a bag, unless all are wanted.
    """
    collector = TopicEventsBuilder()
    add_events(view, collector, messages)
    events = collector.events(at_most)
    return events, None if events is None else (events.first, events.last)


def add_events(view: View, to: TopicEventsBuilder, messages: Iterable[StoredMessage]) -> None:
    """Adds what messages of one topic report, in log-time order."""
    stated = view.memory.stated
    for found in messages:
        channel = found.record.channel
        state = None if stated is None else stated(found.record)
        if state is not None:
            to.add(found.time, state)
            continue
        try:
            message = view.memory.reader.decode(found.record)
        except UndecodableError:
            to.add_undecodable()
            continue
        value = view.memory.extractor.exact(message, channel.type)
        to.add(found.time, state_of(value, channel.type))


def note_limits(view: View, topic: str, events: TopicEvents) -> None:
    """Adds a note on events of a topic that are left out: too many, or undecodable."""
    if events.undecodable:
        messages = counted(events.undecodable, "message")
        view.notes.add(Note(_UNDECODED, f"{messages} of {topic}"))
    if events.left_out:
        view.notes.add(f"{topic} changes too often to list each change: {events.left_out} more")
    if events.beyond:
        view.notes.add(
            f"{topic} has too many booleans or things in one message: {events.beyond} more are "
            "not followed"
        )
