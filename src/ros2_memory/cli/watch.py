"""`ros2-memory watch`: what is being recorded just now, against what is usual."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, Final

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from ros2_memory.bag_dir.heartbeat import RecorderState
from ros2_memory.cli.info import usual_rate
from ros2_memory.cli.options import (
    BagDir,
    Overrides,
    Verbose,
    load_for,
    open_memory,
    print_line,
    reported_errors,
    stdout_console,
)
from ros2_memory.cli.output import escape, format_duration, format_time
from ros2_memory.core.errors import BagError, InvalidArgumentsError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.text import counted, listed
from ros2_memory.core.timebase import NS_PER_S, Ns, ns_from_unix, unix_from_ns
from ros2_memory.history.context import Call, Memory
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.insights.status import memory_status
from ros2_memory.results import Status

WINDOW_NS: Final[Ns] = 10 * NS_PER_S
"""The newest data of this length is what goes on just now."""
AS_USUAL: Final = "as usual"
FRESH_SPLITS: Final = 3
"""Data is live while it is no older than so many splits (and than `FRESH_NS`)."""
FRESH_NS: Final[Ns] = 60 * NS_PER_S
_FEW: Final = 5
"""So few messages make no rate."""
_SILENT_PERIODS: Final = 10
_STYLES: Final = {AS_USUAL: "green", "slow": "yellow", "fast": "yellow", "silent": "red"}


@dataclass(frozen=True, slots=True)
class Course:
    """How one topic goes: rates in Hz, `age_s` of its newest message before the newest of all."""

    topic: str
    rate: float
    usual: float | None
    age_s: float

    @property
    def judged(self) -> str:
        """What there is to say of it: `as usual`, `slow`, `fast`, `silent`."""
        usual, span = self.usual, unix_from_ns(WINDOW_NS)
        if usual is None:
            return AS_USUAL
        if self.age_s > max(span, _SILENT_PERIODS / usual):
            return "silent"
        if usual * span >= _FEW and self.rate < usual / 2:
            return "slow"
        if self.rate * span >= _FEW and self.rate > usual * 2:
            return "fast"
        return AS_USUAL


@dataclass(frozen=True, slots=True)
class Look:
    """What was seen at one moment.

    `now` is that of the wall clock; ages count from the status's own. Where `live` is False the
    newest data is old, and rates in it say nothing of what is recorded just now.
    """

    now: Ns
    status: Status
    courses: tuple[Course, ...]
    live: bool

    @property
    def recorder(self) -> str:
        """The recorder's state, in some words."""
        status = self.status
        if status.recorder is None:
            return "none"
        times = f", restarted {counted(status.restarts, 'time')}" if status.restarts else ""
        return f"{status.recorder}{times}{'' if status.live else ', not alive'}"

    @property
    def troubles(self) -> list[str]:
        """Why answers may be missing something."""
        missing = self.status.missing if self.status.live else ()
        never = [f"offered by no publisher: {listed(missing)}"] if missing else []
        return [escape(each) for each in (*never, *self.status.problems)]

    @property
    def newest(self) -> str:
        """How old the newest data is."""
        latest = self.status.latest
        if latest is None:
            return "no data"
        if self.status.now == latest != self.now:
            return f"{format_time(unix_from_ns(latest))}, which is now (data.now=latest)"
        return f"{format_duration(unix_from_ns(self.status.now - latest))} old"


def watch(
    overrides: Overrides = None,
    *,
    every: Annotated[float, typer.Option(metavar="S", help="Seconds between two looks.")] = 2.0,
    count: Annotated[
        int | None, typer.Option(metavar="N", help="Leave after so many looks.")
    ] = None,
    bag_dir: BagDir = None,
    verbose: Verbose = False,
) -> None:
    """Watch what is being recorded: the recorder, the newest data, rates against the usual ones.

    Ages count as in the tools' answers (data.now). Rates are judged only while data comes in.
    On a terminal a table that is kept up to date, elsewhere a line for each look. Ends with Ctrl-C.
    """
    with reported_errors("watch"):
        if not every > 0 or (count is not None and count < 1):
            raise InvalidArgumentsError("--every and --count must be more than 0")
        settings = load_for(bag_dir, ["reader.include_active=true", *(overrides or ())])
        memory = open_memory(settings, verbose=verbose)
        console = stdout_console()
        try:
            if console.is_terminal:
                _live(console, _looks(memory, every, count))
            else:
                for look in _looks(memory, every, count):
                    print_line(line(look))
        except KeyboardInterrupt:
            raise typer.Exit from None


def _live(console: Console, looks: Iterator[Look]) -> None:
    with Live(console=console, auto_refresh=False) as live:
        for look in looks:
            live.update(Group(*shown(look)), refresh=True)


def _looks(memory: Memory, every_s: float, count: int | None) -> Iterator[Look]:
    number = 0
    while True:
        yield looked(memory)
        number += 1
        if number == count:
            return
        time.sleep(every_s)
        memory.index.refresh()


def looked(memory: Memory) -> Look:
    """What there is to see now."""
    snapshot, wall = memory.index.snapshot(), memory.clock.now()
    status = memory_status(memory, Call())
    live = _is_live(memory, snapshot, status, wall)
    return Look(wall, status, (*_courses(memory, snapshot),), live)


def _is_live(memory: Memory, snapshot: Snapshot, status: Status, wall: Ns) -> bool:
    """Whether the newest data is what is being recorded.

    Where its own time is the present, as in a simulation, only a recorder or a file that grows can
    tell.
    """
    latest = snapshot.dating.latest
    if latest is None:
        return False
    if memory.limits.now == "latest":
        recording = status.live and status.recorder == RecorderState.RECORDING
        return recording or bool(snapshot.active)
    splits = ns_from_unix(FRESH_SPLITS * memory.limits.split_duration_s)
    return abs(wall - latest) <= max(splits, FRESH_NS)


def _courses(memory: Memory, snapshot: Snapshot) -> Iterator[Course]:
    latest = snapshot.dating.latest
    if latest is None:
        return
    window = TimeWindow(latest - WINDOW_NS + 1, latest + 1)
    for topic in snapshot.topics():
        if memory.limits.latching.is_latched(snapshot, topic):
            continue
        last = max(each.last for each in snapshot.totals(topic).values())
        heard = _heard(memory, snapshot, topic, window)
        age_s = max(unix_from_ns(latest - last), 0.0)
        yield Course(
            topic,
            heard / unix_from_ns(WINDOW_NS),
            usual_rate(snapshot, topic, memory.limits.latching),
            age_s,
        )


def _heard(memory: Memory, snapshot: Snapshot, topic: str, window: TimeWindow) -> int:
    """How many messages of a topic lie in a window, as far as they can be read."""
    heard = 0
    for bag in dict.fromkeys(bag for bag, *_ in snapshot.extents(topic, window)):
        try:
            heard += len(memory.reader.log_times(bag.path, topic, window))
        except BagError:
            continue  # it was deleted, or is not whole yet; the next look sees what became of it
    return heard


def line(look: Look) -> str:
    """One look in one line, for logs: what is not as usual is named."""
    if look.live:
        odd = [each for each in look.courses if each.judged != AS_USUAL]
        usual = counted(len(look.courses) - len(odd), "topic")
        said = [f"{usual} as usual", *(f"{escape(each.topic)} {_rates(each)}" for each in odd)]
    else:
        said = [_not_live(look)] if look.courses else []
    return (
        f"{format_time(unix_from_ns(look.now))} recorder: {look.recorder}; newest: {look.newest}"
        f"{''.join(f'; {each}' for each in [*said, *look.troubles])}"
    )


def _not_live(look: Look) -> str:
    return f"nothing comes in: {counted(len(look.courses), 'topic')} not judged"


def _rates(course: Course) -> str:
    usual = "" if course.usual is None else f", usually {course.usual:.3g}"
    return f"{course.judged} ({course.rate:.3g} Hz{usual})"


def shown(look: Look) -> Sequence[Text | Table]:
    """One look on a screen."""
    budget, gigabyte = look.status.budget, 1e9
    most = "" if budget.most is None else f" of {budget.most / gigabyte:.3g}"
    head = Text.assemble(
        (format_time(unix_from_ns(look.now)), "bold"),
        f"  recorder: {look.recorder}  newest: {look.newest}  "
        f"used: {budget.used / gigabyte:.3g}{most} GB",
    )
    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    table.add_column("topic")
    for name in ("Hz", "usually", "last"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("")
    for each in look.courses:
        table.add_row(
            Text(escape(each.topic)),
            f"{each.rate:.1f}",
            "-" if each.usual is None else f"{each.usual:.1f}",
            f"{each.age_s:.1f} s",
            Text(each.judged, style=_STYLES[each.judged]) if look.live else Text(""),
        )
    problems = [Text(each, style="red") for each in look.troubles]
    if look.courses and not look.live:
        told = f"{_not_live(look)}; the rates are those of the last 10 s of data"
        problems.insert(0, Text(told, style="yellow"))
    return (head, table, *problems)
