"""`ros2-memory watch`: what is being recorded, compared with what is usual."""

import itertools
import time
from collections.abc import Iterator
from contextlib import nullcontext, suppress
from dataclasses import dataclass, replace
from typing import Annotated, Final

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from ros2_memory.bag_dir.heartbeat import RecorderState
from ros2_memory.cli.options import AsJson, Bags
from ros2_memory.cli.output import (
    escape,
    format_duration,
    format_size,
    format_time,
    print_json,
    stdout_console,
)
from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.model import JsonValue, TimeWindow
from ros2_memory.core.text import counted, listed
from ros2_memory.core.timebase import NS_PER_S, Ns, ns_from_unix, unix_from_ns
from ros2_memory.history.context import Call, Memory
from ros2_memory.history.coverage import cut_spans
from ros2_memory.history.scan import count_messages
from ros2_memory.history.view import View
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.insights.status import memory_status, usual_rate
from ros2_memory.results import Status

WINDOW_NS: Final[Ns] = 10 * NS_PER_S
"""Current rates are those of the newest data of this length."""
AS_USUAL: Final = "as usual"
LIVE_SPLITS: Final = 3
LIVE_NS: Final[Ns] = 60 * NS_PER_S
"""The newest data is live up to this age, or to that of `LIVE_SPLITS` splits if they are longer."""
_MIN_MESSAGES: Final = 5
"""Fewer messages give no rate."""
_SILENT_PERIODS: Final = 10
_STYLES: Final = {AS_USUAL: "green", "slow": "yellow", "fast": "yellow", "silent": "red"}


@dataclass(frozen=True, slots=True)
class TopicRate:
    """The current and the usual rate (Hz) of a topic.

    `age_s` is how much older its newest message is than the newest of all topics.
    """

    topic: str
    rate: float
    usual: float | None
    age_s: float

    @property
    def assessment(self) -> str:
        """`as usual`, `slow`, `fast` or `silent`; `as usual` without a usual rate."""
        usual, window_s = self.usual, unix_from_ns(WINDOW_NS)
        if usual is None:
            return AS_USUAL
        if self.age_s > max(window_s, _SILENT_PERIODS / usual):
            return "silent"
        if usual * window_s >= _MIN_MESSAGES and self.rate < usual / 2:
            return "slow"
        if self.rate * window_s >= _MIN_MESSAGES and self.rate > usual * 2:
            return "fast"
        return AS_USUAL


@dataclass(frozen=True, slots=True)
class Observation:
    """What the command shows at one time.

    `now` is the wall clock's time; ages count from the status's own. If `live` is False the newest
    data is old, and its rates do not describe what is being recorded.
    """

    now: Ns
    status: Status
    rates: tuple[TopicRate, ...]
    live: bool

    def head(self) -> str:
        """Returns the recorder's state, and how old the newest data is."""
        status, latest = self.status, self.status.latest
        times = f", restarted {counted(status.restarts, 'time')}" if status.restarts else ""
        recorder = "none" if status.recorder is None else f"{status.recorder}{times}"
        if latest is None:
            newest = "no data"
        elif status.now == latest != self.now:
            newest = f"{format_time(unix_from_ns(latest))}, which is now (data.now=latest)"
        else:
            age_s = unix_from_ns(status.now - (status.heard or latest))
            newest = f"{format_duration(age_s)} old"
            if age_s < 0:
                newest = f"dated {format_duration(-age_s)} ahead of the clock"
        return f"recorder: {recorder}  newest: {newest}"

    @property
    def problems(self) -> list[str]:
        """Why answers may be incomplete."""
        missing = self.status.missing if self.status.live else ()
        unoffered = [f"offered by no publisher: {listed(missing)}"] if missing else []
        return [escape(line) for line in (*unoffered, *self.status.problems)]


def watch(
    *,
    every: Annotated[float, "S", "Seconds between updates."] = 2.0,
    count: Annotated[int | None, "N", "Exit after N updates."] = None,
    as_json: AsJson = False,
    bags: Bags,
) -> None:
    """Show live what is being recorded: the recorder, the newest data, rates compared with usual.

    Ages count as in the tools' answers (data.now). Rates are checked only while new data arrives.
    On a terminal, watch updates a table; elsewhere it prints one for each update, or a line of JSON
    with --json. Stop it with Ctrl-C.
    """
    if not every > 0 or (count is not None and count < 1):
        raise InvalidArgumentsError("--every and --count must be more than 0")
    memory = replace(bags, words=["reader.include_active=true", *(bags.words or ())]).memory()
    console = stdout_console()
    is_screen = console.is_terminal and not as_json
    screen = Live(console=console, auto_refresh=False) if is_screen else nullcontext()
    with suppress(KeyboardInterrupt), screen as live:
        for number in itertools.count(1):
            seen = _observe(memory)
            if as_json:
                print_json(_as_object(seen))
            elif live is not None:
                live.update(_screen(seen), refresh=True)
            else:
                console.print(_screen(seen))
            if number == count:
                break
            time.sleep(every)
            memory.index.refresh()


def _observe(memory: Memory) -> Observation:
    """Returns the current state.

    Where `data.now=latest`, as in a simulation, the age of the newest data says nothing on whether
    it is live: a live recorder does, or a file that grows.
    """
    snapshot, wall = memory.index.snapshot(), memory.clock.now()
    status, latest = memory_status(memory, Call()), snapshot.dating.latest
    splits = ns_from_unix(LIVE_SPLITS * memory.limits.split_duration_s)
    live = latest is not None and abs(wall - latest) <= max(splits, LIVE_NS)
    if memory.limits.now == "latest":
        is_recording = status.live and status.recorder == RecorderState.RECORDING
        live = latest is not None and (is_recording or bool(snapshot.active))
    rates = () if latest is None else tuple(_rates(memory, snapshot, latest))
    return Observation(wall, status, rates, live)


def _rates(memory: Memory, snapshot: Snapshot, latest: Ns) -> Iterator[TopicRate]:
    """Yields the rate of every topic that is not latched.

    Without a usual rate for logs, and for topics whose last messages were deleted by request.
    """
    window = TimeWindow(latest - WINDOW_NS + 1, latest + 1)
    timeline, latching = snapshot.timeline, memory.limits.latching
    view = View(memory, Call())
    for topic in timeline.topics():
        if latching.is_latched(snapshot, topic):
            continue
        # Of a bag that was deleted, or is not complete yet, the next observation sees more.
        count = count_messages(view, topic, window, np.empty(0, np.int64)).messages.sum()
        last = max(totals.last for totals in timeline.totals(topic).values())
        usual = usual_rate(snapshot, topic, latching)
        since = TimeWindow(last + 1, latest + 1)
        if timeline.is_log(topic) or cut_spans(memory.index.bag_dir, topic, since):
            usual = None
        age_s = max(unix_from_ns(latest - last), 0.0)
        yield TopicRate(topic, int(count) / unix_from_ns(WINDOW_NS), usual, age_s)


def _as_object(seen: Observation) -> dict[str, JsonValue]:
    """Returns an observation for programs: times in Unix seconds, rates in Hz, ages in seconds."""
    status = seen.status
    return {
        "now": unix_from_ns(seen.now),
        "recorder": status.recorder,
        "recorder_alive": status.live,
        "latest": None if status.latest is None else unix_from_ns(status.latest),
        "is_live": seen.live,
        "topics": [
            {
                "topic": rate.topic,
                "rate_hz": round(rate.rate, 3),
                "usual_hz": rate.usual,
                "age_s": round(rate.age_s, 3),
                "assessment": rate.assessment if seen.live else None,
            }
            for rate in seen.rates
        ],
        "problems": [*seen.problems],
    }


def _screen(seen: Observation) -> Group:
    """Returns an observation as a screen: a headline, a table of topics, and problems."""
    budget = seen.status.budget
    most = "" if budget.most is None else f" of {format_size(budget.most)}"
    head = Text.assemble(
        (format_time(unix_from_ns(seen.now)), "bold"),
        f"  {seen.head()}  used: {format_size(budget.used)}{most}",
    )
    table = Table("topic", box=SIMPLE_HEAD, pad_edge=False)
    for name in ("Hz", "usually", "last"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("")
    for rate in seen.rates:
        table.add_row(
            Text(escape(rate.topic)),
            f"{rate.rate:.1f}",
            "-" if rate.usual is None else f"{rate.usual:.1f}",
            f"{rate.age_s:.1f} s",
            Text(rate.assessment, style=_STYLES[rate.assessment]) if seen.live else Text(""),
        )
    problems = [Text(line, style="red") for line in seen.problems]
    if seen.rates and not seen.live:
        note = "no new data: the rates are those of the last 10 s of data, and not checked"
        problems.insert(0, Text(note, style="yellow"))
    return Group(head, table, *problems)
