"""How often a topic has messages over its recording: often, as telemetry, or rarely, as a map."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.core.timebase import NS_PER_MS, NS_PER_S, Ns

if TYPE_CHECKING:
    from ros2_memory.index.segment import Stated

RARE_NS: Final[Ns] = 5 * NS_PER_S
"""A topic with a message so often, or less often, is a rare one."""
_JITTER_NS: Final[Ns] = 50 * NS_PER_MS
"""So much less may lie between two messages on average: publishers and transports are not exact."""
_FEW: Final = 5
"""Fewer messages have no usual spacing: a map may be published twice when its node starts."""


class Pace(NamedTuple):
    """What a recording holds of a topic, and the times (inclusive) between which it has bags."""

    topic: Stated
    begin: Ns
    end: Ns


def is_rare(pace: Pace) -> bool:
    """Whether a topic has a message every `RARE_NS` or less often over its recording.

    By the time between its first and last message, so that telemetry which fell silent stays what
    it was; of a few messages by the length of the recording, if that went on for long enough.
    """
    messages, span = pace.topic.messages, pace.topic.last - pace.topic.first
    if span >= (messages - 1) * (RARE_NS - _JITTER_NS):
        return True
    length = pace.end - pace.begin
    return messages < _FEW and length >= messages * RARE_NS and length - span >= 2 * RARE_NS
