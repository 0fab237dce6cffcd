"""`ros2-memory doctor`: checks everything that has to be right, and says what to do.

One function for each concern; each yields findings, and changes nothing.
"""

import getpass
import http.client
import json
import os
import shutil
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from difflib import get_close_matches
from importlib.util import find_spec
from itertools import filterfalse
from pathlib import Path
from typing import Final, TypeAlias, TypeVar

import typer
from rich.console import Console
from rich.text import Text

from ros2_memory.bag_dir.heartbeat import Heartbeat, RecorderState, read_heartbeat
from ros2_memory.bag_dir.layout import ERASING_FILE
from ros2_memory.bootstrap import build_recorder, query_settings_of
from ros2_memory.bootstrap_fleet import ROBOTS_SETTING, robot_settings
from ros2_memory.cli.doctor_lake import check_lake, check_shipping
from ros2_memory.cli.findings import Examined, Finding, Level, error, ok, warning
from ros2_memory.cli.listing.info import assumed_active
from ros2_memory.cli.options import (
    AsJson,
    Bags,
    open_memory,
    print_line,
    spinner,
    stdout_console,
)
from ros2_memory.cli.output import escape
from ros2_memory.config import NullRecorderNode, Settings, files_in_use, unused_config
from ros2_memory.core import directories
from ros2_memory.core.errors import BagError, ConfigError, EpisodicError
from ros2_memory.core.model import JsonValue, SetAside
from ros2_memory.core.text import MAX_NAMED, counted, listed
from ros2_memory.core.timebase import NS_PER_S, Ns, iso_local, unix_from_ns
from ros2_memory.history.context import Call, Latching, Memory
from ros2_memory.history.coverage import is_whole
from ros2_memory.history.robots import contradicting_frames, mixed_recordings
from ros2_memory.index.clock_faults import FIRST_BAGS_NS, FUTURE_NS
from ros2_memory.index.listed_splits import describe_absent
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.insights.status import (
    bags_with_remarks,
    nothing_here,
    required_missing,
    unrecorded,
)
from ros2_memory.queries import data_time_range
from ros2_memory.recorder.process.environment import advice_on_rmw, rmw_of, robot_environment
from ros2_memory.recorder.process.topics import TopicSelection, load_topics
from ros2_memory.retention.inventory import state_bytes_in
from ros2_memory.retention.policy import GB, SMALL_BUDGET_GB, small_budget
from ros2_memory.serving.auth import api_token
from ros2_memory.storage.base import BagReader, Closing

T = TypeVar("T")
Check: TypeAlias = Callable[[Examined], Iterator[Finding]]

_RECENT_NS: Final[Ns] = 3600 * NS_PER_S
"""A topic without a message in the newest data of this length is not being recorded."""
_HEALTH_TIMEOUT_S: Final = 5.0
_MAX_HEALTH_BYTES: Final = 1 << 20
_COMMANDS_OF_EXTRAS: Final = (
    ("export --parquet", "pyarrow", "parquet"),
    ("plot", "matplotlib", "plot"),
)
_MSG_FOLDERS: Final = "reader.custom_msg_paths"
_COPY_AGAIN: Final = "answers use the readable part; copy the bags again for the rest"
_NOTHING_MISSING: Final = "nothing is missing: what it states of itself is wrong, not its messages"
_NOT_DECODED: Final = "nothing decodes them here: record them as ROS 2 messages (CDR) or as JSON"
_NOT_REPAIRED: Final = "copy them again from their source, or delete them"
_UNRECORDED: Final = (
    "name the workspace of an unknown type in recorder.setup_files; compare the others with "
    "`ros2 topic echo`"
)
_UNOFFERED: Final = "no publisher has offered it since the recorder started"
_START_RECORDER: Final = "start it: ros2-memory-recorder, or systemctl start ros2-memory-recorder"


_STYLES: Final = {Level.OK: "green", Level.WARNING: "yellow", Level.ERROR: "red"}


def doctor(as_json: AsJson = False, *, bags: Bags) -> None:
    """Check configuration, disk, clock, bags, recorder, ROS environment, topics and server.

    Each finding says how to fix it.
    """
    findings = [*_examine(bags)]
    worst = max(each.level for each in findings)
    if as_json:
        rows = [asdict(each) | {"level": each.level.name.lower()} for each in findings]
        print_line(json.dumps({"status": worst.name.lower(), "findings": rows}))
    else:
        _print(stdout_console(), findings)
    raise typer.Exit(int(worst))


def _examine(bags: Bags) -> Iterator[Finding]:
    """Yields all findings; one alone where the configuration is refused."""
    try:
        settings = bags.settings()
        robots = settings.fleet.robots
        memory = None if robots else open_memory(settings, verbose=bags.verbose)
    except ConfigError as refused:
        yield Finding(Level.ERROR, "config", str(refused), "correct the key that it names")
        return
    yield Finding(Level.OK, "config", f"files in use: {', '.join(files_in_use(settings))}")
    if unused := unused_config():
        do = "set that, or rename the file if it is another program's"
        yield Finding(Level.WARNING, "config", unused, do)
    if memory is None:
        for name in robots:
            yield from _of_robot(name, robot_settings(settings, name), verbose=bags.verbose)
        with spinner("asking the lake"):
            yield from _found({"lake": check_lake} | _OF_SETTINGS, settings)
        return
    with spinner("asking the disk, ros2, the recorder and the server"):
        robot = Examined(settings, memory, memory.index.snapshot(), memory.clock.now())
        yield from _found(_OF_BAGS, robot)
        if isinstance(settings.recorder, NullRecorderNode):
            yield Finding(Level.OK, "recorder", "recorder=none: nothing is recorded here")
        else:
            yield from _found(_OF_RECORDER, robot)
        yield from _found(_OF_SETTINGS, settings)


def _found(checks: Mapping[str, Callable[[T], Iterator[Finding]]], what: T) -> Iterator[Finding]:
    """Yields the findings of checks by their concerns."""
    for about, check in checks.items():
        for each in check(what):
            yield replace(each, about=each.about or about)


def _of_robot(name: str, own: Settings, *, verbose: bool) -> Iterator[Finding]:
    """Yields what is wrong with the bags of a robot of a fleet; else how many there are."""
    memory = open_memory(own, verbose=verbose, setting=ROBOTS_SETTING)
    snapshot, bag_dir = memory.index.snapshot(), own.recording.bag_dir
    found: Iterable[Finding]
    if snapshot.problem:
        do = "is the disk mounted? The other robots are answered for meanwhile"
        found = [warning(f"{bag_dir}: {snapshot.problem}", do)]
    elif not (snapshot.bags or snapshot.active):
        do = f"{ROBOTS_SETTING} names another directory for it"
        found = [warning(f"{bag_dir}: {nothing_here(snapshot)}", do)]
    else:
        found = _found(_OF_BAGS, Examined(own, memory, snapshot, memory.clock.now()))
    for each in found:
        if each.level is not Level.OK or each.about == "bags":
            yield replace(each, about="robot", seen=f"{name}: {each.seen}")


def _print(console: Console, findings: Sequence[Finding]) -> None:
    for each in findings:
        line = Text.assemble(
            (f"{each.level.name.lower():<8}", _STYLES[each.level]),
            (f"{each.about:<9}", "bold"),
            escape(each.seen),
        )
        console.print(line, soft_wrap=True)
        if each.do:
            console.print(Text(f"{'':17}-> {escape(each.do)}"), soft_wrap=True)


def check_bag_dir(robot: Examined) -> Iterator[Finding]:
    """Checks that the bag directory exists, and that this user may use it."""
    bag_dir = robot.settings.recording.bag_dir.absolute()
    records = not isinstance(robot.settings.recorder, NullRecorderNode)
    if not bag_dir.is_dir():
        if not records:
            do = "name the directory of the bags: MEMORY_BAG_DIR, or recording.bag_dir=DIR"
            yield error(f"{bag_dir} is not a directory", do)
            return
        do = "the recorder makes it when it starts; is its disk mounted?"
        yield warning(f"{bag_dir} is not there", do)
    else:
        yield _check_permissions(bag_dir, records=records)
    if (bag_dir / ERASING_FILE).exists():
        seen = "an earlier `ros2-memory forget` was interrupted: some data to delete is still there"
        yield warning(seen, "run any `ros2-memory forget`: it finishes that first")


def _check_permissions(bag_dir: Path, *, records: bool) -> Finding:
    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # a container's user without an entry
        user = f"user {os.getuid()}"
    if not os.access(bag_dir, os.R_OK | os.X_OK):
        do = "give this user the right to read it, or run as the user of the services"
        return error(f"{user} may not read {bag_dir}", do)
    if not records:
        return ok(f"{bag_dir}, readable by {user}")
    if os.access(bag_dir, os.R_OK | os.W_OK | os.X_OK):
        return ok(f"{bag_dir}, readable and writable by {user}")
    do = (
        "fine if the recorder runs as another user, who may: "
        "sudo -u USER ros2-memory doctor looks as that one"
    )
    return warning(f"{bag_dir}, readable but not writable by {user}", do)


def check_disk(robot: Examined) -> Iterator[Finding]:
    """Checks that the disk has room for the budget, where bags are recorded."""
    if isinstance(robot.settings.recorder, NullRecorderNode):
        return
    yield _room(robot)
    if (budget := robot.settings.retention.max_total_gb) < SMALL_BUDGET_GB:
        do = f"raise retention.max_total_gb to {SMALL_BUDGET_GB:g} or more"
        yield warning(small_budget(budget), do)


def _room(robot: Examined) -> Finding:
    bag_dir, limits = robot.settings.recording.bag_dir.absolute(), robot.settings.retention
    existing = next(each for each in (bag_dir, *bag_dir.parents) if each.is_dir())
    try:
        disk = shutil.disk_usage(existing)
    except OSError as problem:
        return error(f"{existing} cannot be measured: {problem}", "look after the disk")
    mount = next(each for each in (existing, *existing.parents) if os.path.ismount(each))
    foreign = robot.memory.foreign(robot.snapshot)
    foreign_bytes = 0 if foreign is None else foreign.total_bytes
    free, used = disk.free / GB, max(_size(bag_dir) - foreign_bytes, 0) / GB
    state = state_bytes_in(bag_dir) / GB
    seen = (
        f"{free:.1f} GB free on {mount}; {used:.1f} of {limits.max_total_gb:g} GB used: "
        f"bags {max(used - state, 0):.2g} GB, what is stored beside them {state:.2g} GB"
    )
    if foreign_bytes:
        seen += (
            f"; bags that this recorder did not make take {foreign_bytes / GB:.2g} GB more, and "
            "are neither deleted nor counted: `ros2-memory adopt DIR` takes those of a directory"
        )
    if free < limits.min_free_gb:
        do = (
            f"recording pauses below retention.min_free_gb={limits.min_free_gb:g}; delete "
            "other files on this disk"
        )
        return error(seen, do)
    if free - limits.min_free_gb < limits.max_total_gb - used:
        do = (
            "the disk is full before the budget is: lower retention.max_total_gb to "
            f"{max(free - limits.min_free_gb + used, 0):.1f}, or make room"
        )
        return warning(seen, do)
    return ok(seen)


def _size(folder: Path) -> int:
    """Returns the bytes of all readable files below a folder; hard links count once."""
    sizes: dict[tuple[int, int], int] = {}
    for _, entries in directories.walk(folder):
        for entry in entries:
            with suppress(OSError):
                if not entry.is_dir(follow_symlinks=False):
                    status = entry.stat(follow_symlinks=False)
                    sizes[status.st_dev, status.st_ino] = status.st_size
    return sum(sizes.values())


def check_clock(robot: Examined) -> Iterator[Finding]:
    """Checks this machine's clock, and those of the machines that dated the bags."""
    snapshot, now = robot.snapshot, robot.now
    do = "set the clock (timedatectl, chrony); bags keep the dates they were given"
    latest = snapshot.dating.latest
    if now < FIRST_BAGS_NS:
        yield error(f"it shows {iso_local(now)}: it was never set", do)
    elif latest is not None and latest > now + FUTURE_NS:
        seen = f"the newest data is dated {unix_from_ns(latest - now):.0f} s after the present"
        yield error(seen, do)
    elif snapshot.dating.faults:
        faults = counted(len(snapshot.dating.faults), "bag was", "bags were")
        seen = f"{faults} dated by a wrong clock: `ros2-memory info` lists them"
        yield warning(seen, do)
    else:
        yield ok(f"{iso_local(now)} (this machine)")


def check_bags(robot: Examined) -> Iterator[Finding]:
    """Checks that all bags can be read, and all messages in them decoded; and what they hold."""
    settings, memory, snapshot, _ = robot
    covered = data_time_range(memory, Call())
    if snapshot.problem:
        yield error(snapshot.problem, "see bag_dir above; is the disk mounted?")
        return
    if covered.bags or covered.active:
        newest = "" if covered.latest is None else f"; newest: {iso_local(covered.latest)}"
        files = counted(covered.bags, "bag file is", "bag files are")
        yield ok(f"{files} readable{newest}")
    else:
        do = "recording.bag_dir=DIR names another directory; a recorder fills this one"
        yield warning(nothing_here(snapshot), do)
    if broken := (*covered.damaged, *covered.incomplete):
        names = listed([f"{each.path.name} ({each.reason})" for each in broken])
        seen = f"{len(covered.damaged)} damaged and {len(covered.incomplete)} unfinished: {names}"
        yield warning(seen, _how_to_repair(broken, memory.reader, settings))
    if covered.unread:
        names = listed([each.path.name for each in covered.unread])
        files = counted(len(covered.unread), "file is", "files are")
        do = "storage=rosbag2 reads sqlite and compressed bags, too"
        yield warning(f"{files} not read: {names}", do)
    yield from _check_remarks(snapshot)
    for sentence in describe_absent(memory.absent_splits(snapshot)):
        yield warning(sentence, "copy the missing data from its source")
    # The reason names the key where a configured folder would help.
    missing = [each for each in covered.undecodable if _MSG_FOLDERS in each.reason]
    others = [each for each in covered.undecodable if _MSG_FOLDERS not in each.reason]
    name_them = f"name the folder with the .msg files in {_MSG_FOLDERS}"
    for topics, do in ((missing, name_them), (others, _NOT_DECODED)):
        if topics:
            names = listed([f"{each.topic} ({each.reason})" for each in topics])
            yield warning(f"{counted(len(topics), 'topic')} cannot be decoded: {names}", do)
    yield from _check_recordings(memory, snapshot)


def _check_remarks(snapshot: Snapshot) -> Iterator[Finding]:
    """Checks that bags are whole, and state of themselves what they hold."""
    odd = bags_with_remarks(snapshot)
    for one, many, some, do in (
        ("bag is not whole", "bags are not whole", [*filterfalse(is_whole, odd)], _COPY_AGAIN),
        (
            "bag contradicts itself",
            "bags contradict themselves",
            [*filter(is_whole, odd)],
            _NOTHING_MISSING,
        ),
    ):
        if some:
            names = listed([f"{each.path.name} ({'; '.join(each.summary.notes)})" for each in some])
            yield warning(f"{counted(len(some), one, many)}: {names}", do)


def _how_to_repair(broken: Sequence[SetAside], reader: BagReader, settings: Settings) -> str:
    others = sum(not _is_repairable(each.path, reader) for each in broken)
    if others == len(broken):
        return _NOT_REPAIRED
    rest = f"; {others} of them it cannot repair: {_NOT_REPAIRED}" if others else ""
    return f"ros2-memory recover {settings.recording.bag_dir}{rest}"


def _is_repairable(path: Path, reader: BagReader) -> bool:
    """Returns whether `ros2-memory recover` repairs a file: MCAP that its writer did not finish."""
    try:
        return path.suffix == ".mcap" and reader.closing(path) is Closing.OPEN
    except BagError:
        return False


def _check_recordings(memory: Memory, snapshot: Snapshot) -> Iterator[Finding]:
    """Checks that the recordings are one history, and that no file counts as active by mistake."""
    pairs = sorted(mixed_recordings(memory, Call()), key=lambda each: each.topic is None)
    do = (
        "give the bags of each robot or run a folder of their own, and a server each; or look at "
        "one of them: --recording NAME, data.recording=NAME"
    )
    for pair, topic in pairs[:MAX_NAMED]:
        first, second = pair.names
        seen = (
            f"recordings {first} and {second} overlap from {iso_local(pair.start)} to "
            f"{iso_local(pair.end)}, and are answered together"
        )
        if topic is not None:
            seen += f"; each has different messages on {topic}, as from two robots"
        yield warning(seen, do)
    for contradiction in contradicting_frames(memory, Call())[:MAX_NAMED]:
        yield warning(str(contradiction), do)
    if len(pairs) > MAX_NAMED:
        seen = counted(len(pairs) - MAX_NAMED, "more pair overlaps", "more pairs overlap")
        yield warning(seen, "`ros2-memory info` lists them all")
    for path, until in assumed_active(memory, snapshot):
        seen = (
            f"{path.parent.name}/{path.name} has no end and was written lately: until "
            f"{iso_local(until)} it counts as still being written"
        )
        do = "if no program writes it (a copy), wait until then: answers use its readable part"
        yield warning(seen, do)


def check_columns(memory: Memory) -> Iterator[Finding]:
    """Checks that columns can be stored, and names topics that are beyond their share."""
    store = memory.columns.store
    if store is None:
        return
    dropped = store.dropped()
    if store.trouble is not None:
        do = "answers are right, and slower; free the disk, or let it be written"
        yield warning(f"the store of columns {store.trouble}", do)
    if store.refusals:
        bags = counted(store.refusals, "bag")
        do = "answers are right, and slower; please report this as a defect, with the reason"
        yield warning(f"{bags} could not be stored ({store.refused_for})", do)
    if dropped:
        since = iso_local(min(dropped.values()))
        seen = f"topics beyond store.max_share since {since}, whose bags are read: "
        yield ok(f"{seen}{', '.join(dropped)}")


def check_recorder(robot: Examined) -> Iterator[Finding]:
    """Checks what the recorder's heartbeat reports."""
    now = robot.now
    heartbeat, reason = read_heartbeat(robot.settings.recording.bag_dir)
    if heartbeat is None:
        yield error(str(reason), _START_RECORDER)
        return
    age = f"{unix_from_ns(abs(now - heartbeat.updated)):.0f} s ago"
    if heartbeat.state is RecorderState.STOPPED:
        yield warning(f"it was stopped {age}", _START_RECORDER)
    elif not heartbeat.is_live(now):
        do = f"journalctl -u ros2-memory-recorder says why it ended; {_START_RECORDER}"
        yield error(f"its last heartbeat was {age}, and gives no reason to end", do)
    elif heartbeat.state is RecorderState.PAUSED:
        why = heartbeat.last_error or "it gives no reason"
        yield error(f"it is paused: {why}", "see disk above")
    elif heartbeat.state is RecorderState.WAITING:
        yield error("it waits, and has recorded nothing", str(heartbeat.waiting_for))
    else:
        subscribed = counted(len(heartbeat.subscribed), "topic")
        yield ok(f"{heartbeat.state}, {subscribed} subscribed")
        yield from _check_heartbeat(heartbeat)


def _check_heartbeat(heartbeat: Heartbeat) -> Iterator[Finding]:
    for seen in required_missing(heartbeat):
        yield error(seen, "are their publishers running? compare recording.required")
    for seen in unrecorded(heartbeat):
        yield warning(seen, _UNRECORDED)
    if silent := sorted({*heartbeat.silent} - {*heartbeat.unheard, *heartbeat.fell_silent}):
        do = (
            "is their publisher running? If it runs as another user, the recorder receives it only "
            "over the network: set FASTDDS_BUILTIN_TRANSPORTS=UDPv4 for the recorder; in the "
            "discovery range LOCALHOST that has no effect, see docs/how-to/systemd.md"
        )
        yield warning(f"subscribed, but no messages from: {listed(silent)}", do)
    if heartbeat.age_held:
        do = "synchronise the clock (timedatectl set-ntp true, or chrony); the budget still holds"
        yield warning(heartbeat.age_held, do)
    if heartbeat.unshipped:
        do = "does ros2-memory ship run? raise retention.max_total_gb until it has caught up"
        yield warning(heartbeat.unshipped, do)
    if heartbeat.list_refused:
        yield error(heartbeat.list_refused, "correct the list of topics")
    if heartbeat.failing_rules:
        do = (
            "correct the rule in the file that recording.exclude_when names, and restart the "
            "recorder: it then reads the splits that are held back; see docs/how-to/forget.md"
        )
        found = heartbeat.held_back or listed(heartbeat.failing_rules)
        yield error(found, do)
    elif heartbeat.held_back:
        do = "free the disk, or repair the file; docs/how-to/forget.md says what becomes of it"
        yield warning(heartbeat.held_back, do)
    yield from _check_error(heartbeat)


def _check_error(heartbeat: Heartbeat) -> Iterator[Finding]:
    if heartbeat.last_error:
        at = heartbeat.last_error_at
        when = "" if at is None else f" ({iso_local(at)})"
        seen = f"its last error{when}: {heartbeat.last_error}"
        if heartbeat.restarts:
            times = counted(heartbeat.restarts, "time")
            seen = f"it restarted ros2 bag record {times}; {seen}"
        if heartbeat.recovered:
            yield ok(f"recording goes on since; {seen}")
        else:
            yield warning(seen, "see its log")


def check_ros(robot: Examined) -> Iterator[Finding]:
    """Checks that `ros2 bag record` runs in the environment that the recorder gives it.

    A recorder that is running may have its setup files by its own arguments.
    """
    settings, memory, _, now = robot
    recorder = settings.recorder
    setup_files = () if isinstance(recorder, NullRecorderNode) else recorder.setup_files
    try:
        build_recorder(settings, reader=memory.reader).check()
    except EpisodicError as problem:
        reason, _, do = str(problem).partition("; ")
        heartbeat = read_heartbeat(settings.recording.bag_dir).heartbeat
        runs = heartbeat is not None and heartbeat.state is not RecorderState.STOPPED
        if not setup_files and heartbeat is not None and runs and heartbeat.is_live(now):
            seen = f"{reason} with these settings, but the running recorder has it by its own"
            do = "give this command the recorder's settings (its environment and arguments)"
            yield warning(seen, do)
            return
        yield error(reason, do or "correct recorder.setup_files")
    else:
        files = ", ".join(map(str, setup_files))
        yield ok(f"ros2 bag record can be run{f' after {files}' if files else ''}")
        env = robot_environment(setup_files, settings.recording.bag_dir)
        if advice := advice_on_rmw(env):
            yield Finding(Level.OK, "", f"RMW_IMPLEMENTATION={rmw_of(env)}", advice)


def check_topics(robot: Examined) -> Iterator[Finding]:
    """Checks that the topics of `topics.yaml` have been recorded lately."""
    settings, _, snapshot, now = robot
    file = settings.recording.topics_file
    try:
        selection = load_topics(file)
    except EpisodicError as problem:
        yield error(str(problem), "correct recording.topics_file")
        return
    heartbeat = read_heartbeat(settings.recording.bag_dir).heartbeat
    live = heartbeat if heartbeat and heartbeat.is_live(now) else None
    heard = {*live.subscribed} - {*live.silent} if live else set[str]()
    missing = _unheard_entries(selection, snapshot, query_settings_of(settings).latching, heard)
    unoffered = live.missing if live else ()
    other = _other_list(file, selection, live) if live else None
    if other is not None:
        yield other
        return
    entries = counted(len(selection.entries), "entry", "entries")
    if not snapshot.bags:
        yield ok(f"{file} lists {entries}; nothing is recorded yet")
    elif not missing and not unoffered:
        seen = f"{entries} of {file}: all are in the newest hour of data, or latched"
        yield ok(seen)
    unknown = live.unknown_types if live else ()
    # ros2 bag record names one topic of each unknown type.
    unseen = f"{_UNOFFERED}, or its type is unknown, too" if unknown else _UNOFFERED
    for entry, similar in missing.items():
        hint = f"is it {' or '.join(similar)}? " if similar else ""
        why = f"; {unseen}" if entry in unoffered else ""
        if of_unknown := [*filter(TopicSelection((entry,)).matches, unknown)]:
            seen = f"{entry} is in {file}; ros2 bag record does not know the type of"
            do = "name the workspace that defines it in recorder.setup_files"
            yield warning(f"{seen} {listed(of_unknown)}", do)
            continue
        seen = f"{entry} is in {file}, and not in the newest hour of data{why}"
        do = "compare with `ros2 topic list`; a topic without a publisher is not recorded"
        yield warning(seen, f"{hint}{do}")
    for entry in unoffered:
        if entry not in missing:
            do = "is its publisher running? compare with `ros2 topic list`"
            yield warning(f"{entry} is in {file}; {unseen}", do)


def _other_list(file: Path, selection: TopicSelection, live: Heartbeat) -> Finding | None:
    """Returns the finding on a running recorder whose list is not this one; else None."""
    if live.listed and {*live.listed} != {*selection.listed}:
        return _changed_list(file, selection, live)
    others = _of_another_list(selection, live)
    if not others:
        return None
    seen = f"the running recorder records or waits for {listed(others)}, not listed in {file}"
    do = (
        "give this command the recorder's settings (its environment and key=value arguments); "
        "a changed list is taken within seconds"
    )
    return warning(seen, do)


def _changed_list(file: Path, selection: TopicSelection, live: Heartbeat) -> Finding:
    """Returns the finding on a list that is not the one that the running recorder read."""
    added = sorted({*selection.listed} - {*live.listed})
    dropped = sorted({*live.listed} - {*selection.listed})
    what = [
        f"{file} {how} {listed(each)}"
        for how, each in (("adds", added), ("lacks", dropped))
        if each
    ]
    do = (
        "a changed list is taken within seconds; if the recorder has another file, give this "
        "command its settings"
    )
    return warning(f"the running recorder has another list: {'; '.join(what)}", do)


def _of_another_list(selection: TopicSelection, heartbeat: Heartbeat) -> list[str]:
    """Returns what a running recorder records, or waits for, that the list does not have."""
    waited = [each for each in heartbeat.missing if each not in selection.entries]
    recorded = [each for each in heartbeat.subscribed if not selection.matches(each)]
    return [*recorded, *(each for each in waited if not selection.matches(each))]


def _unheard_entries(
    selection: TopicSelection, snapshot: Snapshot, latching: Latching, received: Collection[str]
) -> Mapping[str, list[str]]:
    """Returns the entries without a recent message, with similar names among recorded topics.

    `received`: of those the recorder has messages, in a split that may not be closed yet.
    """
    if not snapshot.bags:
        return {}
    latest = snapshot.dating.latest
    heard = [*received]
    for topic in snapshot.timeline.topics():
        last = max(each.last for each in snapshot.timeline.totals(topic).values())
        # Nobody expects a latched topic or a log to have a message in every hour.
        is_seldom = latching.is_latched(snapshot, topic) or snapshot.timeline.is_log(topic)
        if latest is None or is_seldom or last > latest - _RECENT_NS:
            heard.append(topic)
    return {
        entry: get_close_matches(entry, snapshot.timeline.topics(), n=2)
        for entry in selection.entries
        if not any(TopicSelection((entry,)).matches(topic) for topic in heard)
    }


def check_extras(settings: Settings) -> Iterator[Finding]:
    """Checks whether the optional packages are installed that the configuration asks for."""
    server = settings.server
    wanted: dict[str, tuple[str, ...]] = {}
    if server.metrics:
        wanted["server.metrics"] = ("prometheus_client",)
    if server.traces:
        wanted["server.traces"] = ("opentelemetry.sdk", "opentelemetry.exporter.otlp.proto.http")
    do = "pip install '.[observability]', or set it to false: the server does not start"
    for key, modules in wanted.items():
        if missing := [name for name in modules if not _is_installed(name)]:
            seen = f"{key}=true needs {', '.join(missing)}, which cannot be imported"
            yield error(seen, do)
        else:
            yield ok(f"what {key}=true needs is installed")
    if server.metrics and server.transport == "stdio":
        seen = "server.metrics=true with server.transport=stdio, which has no /metrics"
        do = "choose server.transport=sse, or set server.metrics to false"
        yield error(seen, do)
    states = [
        f"{what} is installed"
        if _is_installed(module)
        else f"{what} is not installed: pip install '.[{extra}]' adds it"
        for what, module, extra in _COMMANDS_OF_EXTRAS
    ]
    yield ok("; ".join(states))


def _is_installed(module: str) -> bool:
    """Returns whether a module can be found; imports only the packages above it."""
    try:
        return find_spec(module) is not None
    except (ImportError, ValueError):  # a package above it is missing
        return False


def check_server(settings: Settings) -> Iterator[Finding]:
    """Checks what the server's `/health` reports."""
    server = settings.server
    if server.transport == "stdio":
        seen = "server.transport=stdio: each client starts its own server"
        yield ok(seen)
        return
    address = f"{server.host} port {server.port}"
    start = time.monotonic()
    try:
        status, reply = _health(server.host, server.port)
    except (OSError, http.client.HTTPException) as problem:
        do = "start it: ros2-memory-server, or systemctl start ros2-memory-server"
        yield error(f"nothing answers on {address}: {problem}", do)
        return
    except (ValueError, EpisodicError) as problem:
        seen = f"another program answers on {address}: {problem}"
        yield error(seen, "give the server another port: server.port")
        return
    duration_ms = (time.monotonic() - start) * 1000
    problems = reply.get("problems")
    if status == http.HTTPStatus.UNAUTHORIZED:
        seen = f"the server on {address} takes another token than MEMORY_API_TOKEN"
        yield warning(seen, "give doctor the token that the server was started with")
    elif reply.get("status") == "ok":
        yield ok(f"ok on {address}, in {duration_ms:.0f} ms")
    else:
        why = "; ".join(map(str, problems)) if isinstance(problems, list) else ""
        seen = f"{reply.get('status', f'HTTP {status}')}: {why or 'it gives no reason'}"
        yield warning(seen, "the findings above and its log have the cause")


def _health(host: str, port: int) -> tuple[int, dict[str, JsonValue]]:
    """Returns the status and the reply of `/health`; an empty reply if it refuses the token.

    Linux connects to the loopback address where `host` is that of all interfaces.

    Raises:
        OSError: nothing answers.
        HTTPException: the reply is not HTTP.
        ValueError: the reply is not a JSON object with a status.
        ConfigError: the token to show cannot be read.
    """
    token = api_token(os.environ)
    headers = {"Authorization": f"Bearer {token.get_secret_value()}"} if token else {}
    connection = http.client.HTTPConnection(host, port, timeout=_HEALTH_TIMEOUT_S)
    try:
        connection.request("GET", "/health", headers=headers)
        response = connection.getresponse()
        if response.status == http.HTTPStatus.UNAUTHORIZED and token:
            return response.status, {}
        reply: JsonValue = json.loads(response.read(_MAX_HEALTH_BYTES))
    finally:
        connection.close()
    if not isinstance(reply, dict) or "status" not in reply:
        raise ValueError("it gives no status")
    return response.status, reply


_OF_BAGS: Final[Mapping[str, Check]] = {
    "bag_dir": check_bag_dir,
    "disk": check_disk,
    "clock": check_clock,
    "bags": check_bags,
    "columns": lambda robot: check_columns(robot.memory),
}
_OF_RECORDER: Final[Mapping[str, Check]] = {
    "ros": check_ros,
    "recorder": check_recorder,
    "shipping": check_shipping,
    "topics": check_topics,
}
_OF_SETTINGS: Final = {"extras": check_extras, "server": check_server}
"""The checks by their concerns, in the order in which they are printed."""
