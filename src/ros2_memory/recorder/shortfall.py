"""Finds the topics that are not recorded as they should be."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.core.text import counted, listed
from ros2_memory.core.timebase import ns_from_unix
from ros2_memory.recorder.policies import OWN_TOPICS, WAITING_S, ClockReading
from ros2_memory.recorder.process.topics import TopicSelection

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping

    from ros2_memory.recorder.sessions import RecordingSession, RecordingSessions

UNHEARD_S: Final = 30.0
"""A topic that is offered for so long, and never came, is not recorded."""
TYPES_S: Final = 15.0
"""After so long a recording has subscribed to all offered topics of known types."""
IDLE_SPLITS: Final = 2
"""Recordings that have not grown for so many splits are idle."""


class Shortfall(NamedTuple):
    """The topics that are not recorded as they should be: fields of the heartbeat."""

    unknown_types: tuple[str, ...] = ()
    unheard: tuple[str, ...] = ()
    fell_silent: tuple[str, ...] = ()
    required_missing: tuple[str, ...] = ()


class TopicWatch:
    """Watches the topics of all recordings, and reports each fault once.

    Attributes:
        waiting_for: a sentence on why no message has arrived since the start; None if one has.
        gone: the topics that a publisher has offered since the start, and none offers any more.
    """

    def __init__(self, sessions: RecordingSessions) -> None:
        self._sessions = sessions
        self._orders = sessions.orders
        self._topics = sessions.orders.topics
        self._events = sessions.events
        self.waiting_for: str | None = None
        self.gone = frozenset[str]()
        self.shortfall = Shortfall()
        self._offered = set[str]()
        self._named_missing = frozenset[str]()
        self._unheard_from_s: float | None = None
        self._began_s: float | None = None
        self._offered_since_s: dict[str, float] = {}

    def note_begin(self, now: ClockReading) -> None:
        """Notes that a recording begins, and no other one runs."""
        self._unheard_from_s = now.monotonic_s

    def look(self, now: ClockReading) -> None:
        """Looks at all topics, about once a second."""
        current = self._sessions.current
        self._look_for_messages(now)
        if current is None:
            return
        if current.age_s(now) >= WAITING_S and self._sessions.handover is None:
            self._name_absent(current)
        before, after = self.shortfall, self._current_shortfall(now, current)
        self.shortfall = after
        if new := sorted({*after.unheard} - {*before.unheard}):
            sentence = f"offered, and no message has come: {listed(new)}; {self._orders.advice()}"
            self._events.remark("topics_unheard", sentence, topics=new)
        if new := sorted({*after.fell_silent} - {*before.fell_silent}):
            sentence = f"regular until now, and silent: {listed(new)}"
            self._events.remark("topics_stopped", sentence, topics=new)
        if after.required_missing and not before.required_missing:
            sentence = f"required, and not recorded: {listed(after.required_missing)}"
            self._events.remark("required_missing", sentence)

    def missing(self) -> tuple[str, ...]:
        """Returns the topics that no publisher has offered; none before a child records."""
        running = self._sessions.running
        self._offered |= self._sessions.subscribed.union(
            *(each.splits.received for each in running)
        )
        if not any(session.has_recorded for session in running):
            return ()
        unknown = (session.of_unknown_type for session in running)
        offered = self._offered.union(self.shortfall.unknown_types, *unknown)
        return tuple(sorted({*self._topics.selection.exact} - offered))

    def _look_for_messages(self, now: ClockReading) -> None:
        """Reports that no message has arrived since recording started.

        A robot that was heard once and is silent now is not waited for.
        """
        current = self._sessions.current
        if any(map(self._hears, self._sessions.running)):
            self._unheard_from_s = None
        self.waiting_for = None
        if current is None:
            self._events.lasting("recording_waits", "", None)
            return
        patience_s = max(WAITING_S, self._orders.split_duration_s)
        if current.splits.bytes_written:
            # Its messages are known when its first split is closed.
            patience_s += self._orders.split_duration_s
        since_s = self._unheard_from_s
        if since_s is not None and now.monotonic_s - since_s >= patience_s:
            self.waiting_for = self._describe_waiting(current)
        self._events.lasting("recording_waits", "", self.waiting_for, recording=current.name)

    def _describe_waiting(self, current: RecordingSession) -> str:
        if self._orders.simulated:
            return (
                "nothing has been recorded: recording.use_sim_time is on, and nothing is written "
                "before /clock arrives"
            )
        others = current.subscribed - OWN_TOPICS
        if others:
            topics = counted(len(others), "topic is", "topics are")
            return (
                f"nothing has been recorded, although {topics} subscribed to; "
                f"{self._orders.advice()}"
            )
        return (
            "nothing has been recorded of the robot: no publisher offers any of the listed "
            "topics in this ROS_DOMAIN_ID; compare it, ROS_AUTOMATIC_DISCOVERY_RANGE and "
            "topics.yaml with the robot's"
        )

    def _hears(self, session: RecordingSession) -> bool:
        """Whether a session has recorded messages that may come from the robot."""
        splits = session.splits
        if splits.received - OWN_TOPICS:
            return True
        # Other bytes may come from nodes of the recorder's own user, as /rosout does.
        others = session.subscribed.union(self._topics.selection.exact) - OWN_TOPICS
        if others and (not session.subscribed or session.subscribed & OWN_TOPICS):
            return False
        return bool(splits.messages or splits.bytes_written)

    def _name_absent(self, current: RecordingSession) -> None:
        """Reports topics that no publisher has offered, or that none offers any more.

        Each is reported once; a topic that comes back may be reported again.
        """
        missing = frozenset(self.missing())
        if new := sorted(missing - self._named_missing):
            self._events.remark(
                "topic_not_offered",
                f"no publisher offers {', '.join(new)}: recorded as soon as one does; "
                "compare topics.yaml with the robot's topics",
                topics=new,
            )
        self._named_missing |= missing
        offered = self._offered - current.subscribed - {*self.shortfall.unknown_types} - OWN_TOPICS
        gone = frozenset(filter(self._topics.selection.matches, offered))
        if new := sorted(gone - self.gone):
            sentence = f"no publisher offers {', '.join(new)} any more"
            self._events.remark("topic_silent", sentence, topics=new)
        self.gone = gone

    def _current_shortfall(self, now: ClockReading, current: RecordingSession) -> Shortfall:
        sessions, now_s = self._sessions, now.monotonic_s
        if self._began_s is None:
            self._began_s = now_s
        offered = sessions.subscribed
        unknown = current.refused_types(now)
        if len(sessions.running) > 1 or current.age_s(now) < TYPES_S:
            # A new recording has not discovered all topics yet.
            offered.update(self._offered_since_s)
            unknown.update({*self.shortfall.unknown_types} - current.subscribed)
        self._offered_since_s = {
            topic: self._offered_since_s.get(topic, now_s) for topic in offered
        }
        split_s = self._orders.split_duration_s
        # Slow topics reach the disk only when their split is closed.
        written_until_s = sessions.closed_s if current.splits.bytes_written else now_s - split_s
        idle_s = max(0.0, now_s - sessions.grew_s - IDLE_SPLITS * split_s)
        silent, rates_hz = self._orders.reception.arrivals(ns_from_unix(idle_s))
        shortfall = Shortfall(
            unknown_types=tuple(sorted(unknown)),
            unheard=tuple(
                topic
                for topic in sorted({*offered} - sessions.heard - OWN_TOPICS)
                # Services and actions publish only when they are used.
                if "/_" not in topic and written_until_s - self._offered_since_s[topic] >= UNHEARD_S
            ),
            fell_silent=tuple(sorted(silent & offered)),
        )
        if now_s - self._began_s < UNHEARD_S:
            return shortfall
        unmet = self._unmet_requirements(shortfall, now_s, sessions.heard, rates_hz)
        return shortfall._replace(required_missing=tuple(unmet))

    def _unmet_requirements(
        self,
        shortfall: Shortfall,
        now_s: float,
        heard: Collection[str],
        rates_hz: Mapping[str, float],
    ) -> Iterator[str]:
        """Yields a sentence for each topic that is not recorded as `recording.required` asks."""
        for required in self._orders.required:
            entry = TopicSelection((required.topic,))
            unknown = shortfall.unknown_types
            matching = filter(entry.matches, {*self._offered_since_s, *heard, *unknown})
            for topic in sorted({*matching, *entry.exact}) or [required.topic]:
                rate = rates_hz.get(topic, 0.0)
                if topic in unknown:
                    yield f"{topic}: ros2 bag record does not know its type, or knows several"
                elif topic not in self._offered_since_s:
                    yield f"{topic}: no publisher offers it"
                elif topic not in heard:
                    yield f"{topic}: it is offered, and nothing has come"
                elif topic in shortfall.fell_silent:
                    yield f"{topic}: it came regularly, and is silent"
                elif now_s - self._offered_since_s[topic] >= UNHEARD_S and rate < required.min_hz:
                    yield f"{topic}: {rate:.3g} Hz, and {required.min_hz:g} are required"
