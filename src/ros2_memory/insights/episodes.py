"""Episodes: what a robot did, as texts that hold until the next text.

A topic of plain texts (`std_msgs/msg/String`) says episodes if one of its newest values is an empty
text, which ends the episode before, or if it is rare and its texts name states. An episode belongs
to a window if it held in it, and to a scope with the parts of its time in that.
"""

from __future__ import annotations

import re
from collections import deque
from dataclasses import replace
from itertools import groupby, islice
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.core.errors import InvalidArgumentsError, QueryTimeoutError
from ros2_memory.core.text import shortened
from ros2_memory.core.timebase import MAX_NS, Ns
from ros2_memory.history.condition_hints import names_of_numbers
from ros2_memory.history.coverage import note_edges, note_unread, unix_text
from ros2_memory.history.held_values import HeldValue, HeldValues
from ros2_memory.history.lasting import holds_on, is_latched, is_text
from ros2_memory.history.no_data import no_value_between, resolve_topic
from ros2_memory.history.reverse_search import ReverseSearch, out_of_time
from ros2_memory.history.robots import note_robots
from ros2_memory.history.view import TimeRange, View, open_span
from ros2_memory.places.pose_frames import recording_at, robot_at
from ros2_memory.results import Changes, Episode, Spell

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ros2_memory.analysis.conditions import Condition
    from ros2_memory.core.timebase import Span
    from ros2_memory.history.context import Call, Memory
    from ros2_memory.places.where import Scope

_MOST_LOOKED_AT: Final = 50
"""The newest values of a topic that are looked at for an empty text."""
_LONGEST_STATE: Final = 10_000
"""A longer text (characters) does not say what a robot does."""
_CONSTANT: Final = re.compile(r"(?=.*[A-Z])[A-Z0-9_.:/ -]+")
_NAME: Final = re.compile(r"[^\W\d][\w.:/-]*")
_IDENTIFIER: Final = re.compile(r"\d{3}")
_AGAIN: Final = 3
"""Identifiers that come so many times on average are states, as rooms that a robot enters are."""
_LONGEST_TEXT: Final = 200
MOST_COUNTED: Final = 20_000
"""Episodes that are counted over time."""


class FoundEpisodes(NamedTuple):
    """Episodes that a search found.

    Attributes:
        episodes: the newest ones, newest first, or the oldest, oldest first.
        total: how many there are; None if the search ended before it counted all.
        since: the log time (ns) since when all was searched; None for all of the window.
    """

    episodes: list[Episode]
    total: int | None
    since: Ns | None


def says_episodes(view: View, topics: Sequence[str]) -> bool:
    """Returns whether topics are one topic of texts that hold until the next one.

    Raises:
        QueryTimeoutError: the call's time is over.
    """
    if len(topics) != 1 or not is_text(view, topics[0]):
        return False
    # A view of its own: its notes are of values that may lie outside of the window.
    values = HeldValues(View(view.memory, view.call, view.reach), topics[0])
    said: list[HeldValue] = []
    try:
        for held in islice(values.back(MAX_NS), _MOST_LOOKED_AT):
            if held.is_blank:
                return True
            if len(held.word) > _LONGEST_STATE:
                return False
            said.append(held)
    except QueryTimeoutError:
        if view.call.deadline.expired():
            raise
        # Messages can still be found one by one.
        view.notes.add_lack(
            f"out of time before it was known whether an empty text ends those on {topics[0]}: "
            "each message counts alone, and may have held for longer than duration_s"
        )
        return False
    if not said:
        return False
    # What a latched topic said holds in sightings, too, and a frequent topic repeats its state.
    is_on_change = holds_on(view, topics[0], said[0].start) and not is_latched(view, topics[0])
    return is_on_change and _name_states([str(held.exact) for held in said])


def _name_states(texts: Sequence[str]) -> bool:
    """Returns whether texts name states: constants such as IDLE, or a few words that come again.

    What people say seldom does, nor do identifiers that are read now and then (PAL-004711).
    """
    changes = [text for text, _ in groupby(texts)]
    if all(map(_CONSTANT.fullmatch, texts)):
        are_read = 2 * sum(map(bool, map(_IDENTIFIER.search, texts))) > len(texts)
        return not are_read or len(changes) >= _AGAIN * len({*changes})
    return all(map(_NAME.fullmatch, texts)) and len(changes) >= 2 * len({*changes})


def find_episodes(
    view: View, topic: str, condition: Condition, scope: Scope, *, limit: int, oldest_first: bool
) -> FoundEpisodes:
    """Returns the newest episodes whose text meets a condition, or the oldest.

    Raises:
        InvalidArgumentsError: no text can meet the condition.
        QueryTimeoutError: the call's time is over before one was found.
    """
    search = ReverseSearch(view, topic, condition)
    values = HeldValues(view, topic)
    # One more than asked for shows that there are more.
    episodes: deque[Episode] = deque(maxlen=limit if oldest_first else limit + 1)
    total, since = 0, None
    try:
        for episode in _matching_episodes(values, condition, scope):
            episodes.append(episode)
            total += 1
            if total > limit and not oldest_first:
                since = episodes[limit - 1].first
                break
    except QueryTimeoutError as error:
        if values.complete_since >= scope.window.stop:
            raise
        if not episodes:
            raise out_of_time(view, values.complete_since) from error
        since = values.complete_since
        view.notes.add_lack(
            f"the search ran out of time at {unix_text(since)}: to continue, pass that time as end"
        )
    if not episodes:
        search.require_testable()
    chosen = [*reversed(episodes)] if oldest_first else [*episodes][:limit]
    return FoundEpisodes(chosen, total if since is None else None, since)


def _matching_episodes(values: HeldValues, condition: Condition, scope: Scope) -> Iterator[Episode]:
    """Yields the episodes of a scope that meet a condition, newest first.

    An episode waits until the text before it is known, or until that cannot be read in time.
    """
    start, _ = scope.window.asked()
    waiting: Episode | None = None
    newer: HeldValue | None = None
    texts = (held for held in values.back(scope.window.stop) if not held.is_blank)
    while True:
        try:
            held = next(texts, None)
        except QueryTimeoutError:
            if waiting is not None:
                yield waiting
            raise
        if waiting is not None:
            yield waiting if held is None else replace(waiting, previous=spell_of(held))
            waiting = None
        if held is None or (held.stop <= start and held.start < scope.window.start):
            return
        parts = _parts_of(held, scope) if condition.matches({"value": held.exact}) else ()
        if parts:
            # What no message ended may stop with its own last one.
            following = newer or values.named_after(held.stop + (not held.ended))
            after = None if following is None else spell_of(following)
            waiting = Episode(spell_of(held), parts, None, after)
        newer = held


def _parts_of(held: HeldValue, scope: Scope) -> Sequence[Span]:
    """Returns the parts of the time of a value that lie in a scope; their ends are inclusive."""
    if not scope.is_bounded:
        return [(held.start, held.stop)]
    start, end = scope.window.asked()
    parts = scope.parts_of(max(held.start, start), min(held.stop, end))
    # At the moment at which another value begins this one does not hold.
    return [(first, last) for first, last in parts if first < last or first == held.start]


def spell_of(held: HeldValue) -> Spell:
    """Returns a value that held, as replies show it."""
    value = held.value
    shown = shortened(value, _LONGEST_TEXT) if isinstance(value, str) else value
    return Spell(shown, held.start, held.stop, held.ended)


def with_robot(view: View, topic: str, episode: Episode, frame_id: str | None) -> Episode:
    """Returns an episode with the robot's pose when it began."""
    recording = recording_at(view, topic, episode.first)
    if recording is None:
        return episode
    return replace(episode, robot=robot_at(view, episode.first, recording, frame_id))


class MeanwhileReader:
    """Reads the values that another topic, or a field of it (`/task.state`), held during intervals.

    Raises:
        InvalidArgumentsError: its messages have more than one value.
        NoDataError: there is no such topic.
    """

    def __init__(self, view: View, topic: str) -> None:
        self._view = view
        # No name of a ROS 2 topic has a dot; one of another program may.
        recorded = {name.removeprefix("/") for name in view.timeline.topics()}
        parts = topic.split(".")
        lengths = range(len(parts), 0, -1)
        named = (n for n in lengths if ".".join(parts[:n]).removeprefix("/") in recorded)
        length = next(named, 1)
        self._topic = resolve_topic(view, ".".join(parts[:length]))
        field = ".".join(parts[length:]) or None
        self._values = HeldValues(view, self._topic, field, asked="with")
        self._is_over = False

    def during(self, first: Ns, until: Ns) -> tuple[Spell, ...] | None:
        """Returns the values that held at some time of an interval; None if time is over."""
        if self._is_over:
            return None
        try:
            values = self._values.during(first, max(until, first + 1))
        except QueryTimeoutError as error:
            self._is_over = True
            self._view.notes.add_lack(
                f"what {self._topic} said was not read for all of them: {error}"
            )
            return None
        return tuple(spell_of(held) for held in values if not held.is_blank)


def topic_changes(
    memory: Memory,
    call: Call,
    topic: str,
    span: TimeRange,
    *,
    max_samples: int = 100,
    fields: Sequence[str] = (),
) -> Changes:
    """Returns the values that a topic held in a window, in order; an empty text only ends one.

    Raises:
        InvalidArgumentsError: more than one field is named, or there is no single value.
        NoDataError: there is no such topic, or it said nothing in the window.
        QueryTimeoutError: the call's time is over before any value was found.
    """
    if len(fields) > 1:
        raise InvalidArgumentsError("changes are of one field: name one in fields")
    view, window = open_span(memory, call, span)
    topic = resolve_topic(view, topic)
    field = fields[0] if fields else None
    values = HeldValues(view, topic, field, asked="changes", until=window.stop)
    start, _ = window.asked()
    is_all = True
    try:
        held = values.during(start, window.stop)
    except QueryTimeoutError as error:
        held, is_all = values.known[::-1], False
        if not held:
            raise
        view.notes.add_lack(
            f"only what is after {unix_text(values.complete_since)} is listed: {error}; to see the "
            "rest, ask again with that as end"
        )
    if not held:
        raise no_value_between(view, topic, field, window)
    view.notes.add(*names_of_numbers(view, topic, field, {value.word for value in held}))
    elapsed = view.elapsed_in(window)
    spells = [
        replace(spell_of(value), skipped=elapsed.skipped_between(value.start, value.stop))
        for value in held
        if not value.is_blank
    ]
    if len(spells) > max_samples:
        view.notes.add(
            f"the first {max_samples} of {len(spells)} changes: to continue, ask again with "
            f"start={unix_text(spells[max_samples].first)}"
        )
    note_unread(view, window)
    note_edges(view, window)
    note_robots(view, topic, window)
    types = view.timeline.types_of(topic)
    return Changes(
        topic,
        ", ".join(sorted(types)),
        (len(spells), is_all),
        tuple(spells[:max_samples]),
        notes=view.notes.sentences(),
    )
