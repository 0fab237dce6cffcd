"""What to do about a disk that fills up, and how to tell what is amiss. Pure decisions."""

from __future__ import annotations

from enum import Enum, auto
from typing import TYPE_CHECKING, Final

from ros2_memory.core.timebase import NS_PER_S, Ns
from ros2_memory.recorder.handover.plan import set_back

if TYPE_CHECKING:
    from collections.abc import Collection

    from ros2_memory.recorder.handover.plan import ClockReading

RESUME_FACTOR: Final = 1.2
"""Recording that was paused resumes when this many times the least free space is free again."""
SET_BACK_NS: Final[Ns] = 120 * NS_PER_S


class Space(Enum):
    """What the free space asks for."""

    ENOUGH = auto()
    MAKE_ROOM = auto()  # delete more than the budget asks
    WAIT = auto()  # for room that is being made
    PAUSE = auto()
    STAY_PAUSED = auto()
    RESUME = auto()


def resume_bytes(min_free_bytes: int) -> int:
    """How much must be free for recording to resume: more than what it was paused for."""
    return round(min_free_bytes * RESUME_FACTOR)


def space(
    free_bytes: int,
    min_free_bytes: int,
    *,
    paused: bool,
    room_made: bool,
    making: bool = False,
) -> Space:
    """What to do.

    Args:
        free_bytes: what the file system of the bag directory has left for this user.
        min_free_bytes: what it must have for recording to go on.
        paused: whether recording is paused.
        room_made: whether deleting was tried, or begun, for this shortage already.
        making: whether that is still under way; it is waited for while half the least is free.
    """
    if paused:
        return Space.RESUME if free_bytes >= resume_bytes(min_free_bytes) else Space.STAY_PAUSED
    if free_bytes >= min_free_bytes:
        return Space.ENOUGH
    if not room_made:
        return Space.MAKE_ROOM
    return Space.WAIT if making and free_bytes >= min_free_bytes // 2 else Space.PAUSE


def time_was_set_back(before: ClockReading, now: ClockReading) -> bool:
    """Whether the wall clock was set back by so much that the open split would not be closed.

    A split is closed by the time of a message that comes long enough after its first, so it would
    stay open until the clock has caught up. Setting it back by less is waited out.
    """
    return set_back(before, now, SET_BACK_NS)


def silence_told(subscribed: Collection[str], heard: Collection[str]) -> str | None:
    """The sentence on topics that brought nothing in a whole recording; None where all did."""
    silent = sorted(set(subscribed) - set(heard))
    if not silent:
        return None
    if not heard:
        return (
            f"subscribed to {len(silent)} topics and received nothing from any of them; "
            "if the publishers run under another user, set FASTDDS_BUILTIN_TRANSPORTS=UDPv4 "
            "for the recorder: Fast DDS does not share memory between users"
        )
    return f"subscribed, and no message in the whole recording: {', '.join(silent)}"
