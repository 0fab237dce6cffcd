"""Which topics are offered and not recorded, and which required ones fall short of it. Pure."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from ros2_memory.recorder.policies import OWN_TOPICS
from ros2_memory.recorder.process.topics import TopicSelection

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping, Sequence

UNHEARD_S: Final = 30.0
"""A topic that is offered for so long, and of which nothing came, is not recorded."""


@dataclass(frozen=True, slots=True)
class Required:
    """An entry of `recording.required`: a name or a glob, and the least messages a second."""

    topic: str
    min_hz: float = 0.0


@dataclass(frozen=True, slots=True)
class Seen:
    """What the recordings show at one time of a monotonic clock.

    Attributes:
        now_s: that time.
        offered: the topics subscribed to, which some publisher offers.
        heard: the topics of which any message was recorded since the start.
        unknown: topics of an unknown type.
        known_s: the time up to which `heard` is known.
        silent: topics that were regular and have stopped.
        rates_hz: messages a second of each topic.
        settled: whether the recording has had the time to find all that is offered.
    """

    now_s: float
    offered: Collection[str]
    heard: Collection[str]
    unknown: Collection[str]
    known_s: float
    silent: Collection[str]
    rates_hz: Mapping[str, float]
    settled: bool = True


@dataclass(frozen=True, slots=True)
class Shortfall:
    """The topics that are not recorded as they should be, as the heartbeat has them."""

    unknown_types: tuple[str, ...] = ()
    unheard: tuple[str, ...] = ()
    fell_silent: tuple[str, ...] = ()
    required_missing: tuple[str, ...] = ()


@dataclass(slots=True)
class TopicWatch:
    """Remembers since when each topic is offered."""

    required: Sequence[Required] = ()
    _since_s: dict[str, float] = field(default_factory=dict)
    _unknown: frozenset[str] = frozenset()
    _began_s: float | None = None

    def look(self, seen: Seen) -> Shortfall:
        """Returns which topics fall short at this time."""
        if self._began_s is None:
            self._began_s = seen.now_s
        offered = {*seen.offered} if seen.settled else {*seen.offered, *self._since_s}
        since = {topic: self._since_s.get(topic, seen.now_s) for topic in offered}
        self._since_s = since
        self._unknown = frozenset(seen.unknown) | (frozenset() if seen.settled else self._unknown)
        unheard = [
            topic
            for topic in {*since} - {*seen.heard} - OWN_TOPICS
            # Services and actions speak when they are used.
            if "/_" not in topic and seen.known_s - since[topic] >= UNHEARD_S
        ]
        started = seen.now_s - self._began_s >= UNHEARD_S
        return Shortfall(
            unknown_types=tuple(sorted(self._unknown)),
            unheard=tuple(sorted(unheard)),
            fell_silent=tuple(sorted({*seen.silent} & {*since})),
            required_missing=tuple(
                sentence
                for each in (self.required if started else ())
                for sentence in self._missing(each, seen)
            ),
        )

    def _missing(self, required: Required, seen: Seen) -> Iterator[str]:
        """Yields why topics of an entry are not recorded as required, a sentence each."""
        entry = TopicSelection((required.topic,))
        known = filter(entry.matches, {*self._since_s, *seen.heard, *self._unknown})
        for topic in sorted({*known, *entry.exact}) or [required.topic]:
            if topic in self._unknown:
                yield f"{topic}: ros2 bag record does not know its type"
            elif topic not in self._since_s:
                yield f"{topic}: no publisher offers it"
            elif topic not in seen.heard:
                yield f"{topic}: it is offered, and nothing has come"
            elif topic in seen.silent:
                yield f"{topic}: it came regularly, and is silent"
            elif seen.now_s - self._since_s[topic] >= UNHEARD_S:
                rate = seen.rates_hz.get(topic, 0.0)
                if rate < required.min_hz:
                    yield f"{topic}: {rate:.3g} Hz, and {required.min_hz:g} are required"
