"""What the heartbeat of a running recorder says, every few seconds."""

from __future__ import annotations

import os
from dataclasses import asdict
from typing import TYPE_CHECKING, Final

from ros2_memory.bag_dir.heartbeat import Heartbeat, RecorderState, process_of

if TYPE_CHECKING:
    from ros2_memory.core.timebase import Ns
    from ros2_memory.recorder.base import HouseStatus
    from ros2_memory.recorder.event_log import EventLog
    from ros2_memory.recorder.orders import Orders
    from ros2_memory.recorder.sessions import RecordingSessions
    from ros2_memory.recorder.shortfall import TopicWatch

HEARTBEAT_S: Final = 5.0
"""How often it is written."""


def heartbeat_of(
    orders: Orders,
    events: EventLog,
    house: HouseStatus,
    sessions: RecordingSessions,
    watch: TopicWatch,
    *,
    now: Ns,
    state: RecorderState,
    since: Ns,
    announced: str | None,
) -> Heartbeat:
    """Returns what `recorder.json` is to say now.

    Args:
        orders: what is recorded.
        events: what was reported.
        house: what it shows of the housekeeper.
        sessions: the recordings.
        watch: knows which topics are not recorded as they should be.
        now: the wall clock.
        state: what the recorder does.
        since: since when it does that.
        announced: a recording that is about to be begun.
    """
    names = [session.name for session in sessions.running]
    if announced is not None and announced not in names:
        names.append(announced)
    subscribed = set[str]().union(*(session.subscribed for session in sessions.running))
    silent = frozenset() if sessions.current is None else sessions.current.silent_topics()
    return Heartbeat(
        pid=os.getpid(),
        updated=now,
        state=state,
        recordings=tuple(names),
        since=since,
        bytes_written=sessions.bytes_written,
        subscribed=tuple(sorted(subscribed)),
        silent=tuple(sorted(silent | watch.gone)),
        last_error=events.last_error,
        last_error_at=events.last_error_at,
        recovered=events.recovered,
        interval_s=HEARTBEAT_S,
        restarts=sessions.restarts,
        missing=watch.missing(sessions),
        lost=orders.reception.lost_in_last_hour(now),
        waiting_for=watch.waiting_for if state is RecorderState.WAITING else None,
        cut_short=tuple(sorted(orders.reception.cut_short)),
        listed=orders.topics.selection.listed,
        list_refused=orders.topics.refused,
        process=process_of(os.getpid()),
        advice=orders.advice() if watch.shortfall.unheard else None,
        **asdict(house),
        **asdict(watch.shortfall),
    )
