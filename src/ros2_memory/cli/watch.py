"""`ros2-memory watch`: what is being recorded, compared with what is usual."""

import itertools
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from threading import TIMEOUT_MAX
from typing import Annotated, Final

import numpy as np
from rich.console import Console

from ros2_memory.bag_dir.heartbeat import RecorderState
from ros2_memory.cli.options import AsJson, Bags
from ros2_memory.cli.output import print_json, print_reply
from ros2_memory.columns.units import GoneError
from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.reply import JsonObject
from ros2_memory.core.text import listed
from ros2_memory.core.timebase import NS_PER_S, Ns, ns_from_unix, unix_from_ns
from ros2_memory.history.context import Call, Memory
from ros2_memory.history.coverage import cut_spans, excluded_spans
from ros2_memory.history.no_data import are_unlisted
from ros2_memory.history.scan import count_messages
from ros2_memory.history.view import View
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.insights.status import memory_status, usual_rate
from ros2_memory.results import Status

WINDOW_NS: Final[Ns] = 10 * NS_PER_S
"""Current rates are those of the newest data of this length, since the newest recording began."""
AS_USUAL: Final = "as usual"
SILENT: Final = "silent"
LIVE_SPLITS: Final = 3
LIVE_NS: Final[Ns] = 60 * NS_PER_S
"""The newest data is live up to this age, or up to `LIVE_SPLITS` splits if these are longer."""
_MIN_MESSAGES: Final = 5
"""Fewer messages give no rate."""
_SILENT_PERIODS: Final = 10


def watch(
    *,
    every: Annotated[float, "S", "Seconds between updates."] = 2.0,
    count: Annotated[int | None, "N", "Exit after N updates."] = None,
    as_json: AsJson = False,
    bags: Bags,
) -> None:
    """Show live what is being recorded: the recorder, the newest data, rates compared with usual.

    Ages count as in the tools' answers (data.now). Rates are checked only while new data arrives.
    Each update is a table, or a line of JSON with --json. Stop it with Ctrl-C.
    """
    if not 0 < every <= TIMEOUT_MAX:
        raise InvalidArgumentsError(f"--every must be more than 0 and at most {TIMEOUT_MAX:.0f}")
    if count is not None and count < 1:
        raise InvalidArgumentsError("--count must be more than 0")
    memory = replace(bags, words=["reader.include_active=true", *(bags.words or ())]).memory()
    with suppress(KeyboardInterrupt):
        for number in itertools.count(1):
            try:
                seen = _observe(memory)
            except GoneError:  # the store has changed since, and is looked at anew
                seen = _observe(memory)
            if as_json:
                print_json(seen)
            else:
                Console().clear()  # of a terminal alone
                print_reply(seen)
            if number == count:
                break
            time.sleep(every)
            memory.index.refresh()


def _observe(memory: Memory) -> JsonObject:
    """Returns the current state: times in Unix seconds, rates in Hz, ages in seconds."""
    snapshot = memory.snapshot()
    status, latest = memory_status(memory, Call()), snapshot.dating.latest
    is_live = latest is not None and _is_live(memory, snapshot, status, latest)
    missing = status.missing if status.live else ()
    unoffered = [f"offered by no publisher: {listed(missing)}"] if missing else []
    return {
        "now": unix_from_ns(status.now),
        "recorder": status.recorder,
        "recorder_alive": status.live,
        "restarts": status.restarts,
        "latest": None if status.latest is None else unix_from_ns(status.latest),
        "is_live": is_live,
        "problems": [*unoffered, *status.problems],
        "topics": [] if latest is None else [*_rates(memory, snapshot, latest, is_live=is_live)],
    }


def _is_live(memory: Memory, snapshot: Snapshot, status: Status, latest: Ns) -> bool:
    """Returns whether new data arrives, judged by the age of the newest data.

    With `data.now=latest`, as in a simulation, that age says nothing: then a recorder at work or a
    file that is being written shows it.
    """
    if memory.limits.now == "latest":
        is_recording = status.live and status.recorder == RecorderState.RECORDING
        return is_recording or bool(snapshot.active)
    splits = ns_from_unix(LIVE_SPLITS * memory.limits.split_duration_s)
    return abs(memory.clock.now() - latest) <= max(splits, LIVE_NS)


def _rates(
    memory: Memory, snapshot: Snapshot, latest: Ns, *, is_live: bool
) -> Iterator[JsonObject]:
    """Yields the current and the usual rate of every topic that is not latched.

    There is no usual rate for logs, for a topic whose newest messages were deleted by request, and
    if some of the newest time was excluded.
    """
    begun = max((stop for _, stop in snapshot.breaks), default=snapshot.dating.earliest or latest)
    length = min(max(latest - begun, NS_PER_S), WINDOW_NS)
    window, window_s = TimeWindow(latest - length + 1, latest + 1), unix_from_ns(length)
    timeline, latching = snapshot.timeline, memory.limits.latching
    bag_dir, view = memory.bag_dir, View(memory, Call())
    is_excluded = bool(excluded_spans(bag_dir, window))
    for topic in timeline.topics():
        if latching.is_latched(snapshot, topic):
            continue
        # A bag that cannot be read now, deleted or not complete yet, counts in the next update.
        count = count_messages(view, topic, window, np.empty(0, np.int64)).messages.sum()
        last = max(totals.last for totals in timeline.totals(topic).values())
        is_cut = bool(cut_spans(bag_dir, topic, TimeWindow(last + 1, latest + 1)))
        usual = usual_rate(snapshot, topic, latching)
        if timeline.is_log(topic) or is_cut or is_excluded:
            usual = None
        age_s, rate = max(unix_from_ns(latest - last), 0.0), int(count) / window_s
        seen = assessment(rate, usual, age_s, window_s)
        if seen == SILENT and are_unlisted(memory, [topic]):
            seen = "not recorded"
        yield {
            "topic": topic,
            "rate_hz": round(rate, 3),
            "usual_hz": usual,
            "age_s": round(age_s, 3),
            "assessment": seen if is_live else None,
        }


def assessment(rate: float, usual: float | None, age_s: float, window_s: float) -> str:
    """Compares a topic's rate with its usual one (Hz): `as usual`, `slow`, `fast` or `silent`.

    `age_s` is how much older its newest message is than the newest of all topics, `window_s` the
    length of the data that the rate is of. Without a usual rate a topic is `as usual`.
    """
    if usual is None:
        return AS_USUAL
    if age_s > max(unix_from_ns(WINDOW_NS), _SILENT_PERIODS / usual):
        return SILENT
    if usual * window_s >= _MIN_MESSAGES and rate < usual / 2:
        return "slow"
    if rate * window_s >= _MIN_MESSAGES and rate > usual * 2:
        return "fast"
    return AS_USUAL
