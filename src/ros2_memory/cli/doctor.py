"""`ros2-memory doctor`: checks everything that has to be right, and says what to do.

One function for each concern; each yields findings, and changes nothing.
"""

import getpass
import http.client
import os
import shutil
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from difflib import get_close_matches
from importlib.util import find_spec
from itertools import filterfalse
from pathlib import Path
from typing import Final, TypeVar

from rich.text import Text

from ros2_memory.bag_dir.heartbeat import Heartbeat, RecorderState, read_heartbeat
from ros2_memory.bag_dir.layout import ERASING_FILE
from ros2_memory.bag_dir.state_files import describe_leaving
from ros2_memory.bootstrap import build_recorder
from ros2_memory.bootstrap_fleet import ROBOTS_SETTING
from ros2_memory.cli.findings import (
    Examined,
    Finding,
    Level,
    check_lake,
    check_shipping,
    error,
    ok,
    warning,
)
from ros2_memory.cli.info import assumed_active, describe_budget
from ros2_memory.cli.options import AsJson, Bags, open_memory, open_robot, reason_of
from ros2_memory.cli.output import escape, print_json, spinner, stdout_console
from ros2_memory.config import NullRecorderNode, Settings, config_dir, files_in_use, unused_config
from ros2_memory.core.errors import BagError, ConfigError, EpisodicError
from ros2_memory.core.model import SetAside
from ros2_memory.core.text import MAX_NAMED, counted, listed, match_topics
from ros2_memory.core.timebase import FUTURE_NS, NS_PER_S, Ns, iso_local, unix_from_ns
from ros2_memory.history.context import Call, Memory
from ros2_memory.history.coverage import is_whole
from ros2_memory.history.robots import are_of_one_recorder, contradicting_frames, mixed_recordings
from ros2_memory.index.clock_faults import FIRST_BAGS_NS
from ros2_memory.index.listed_splits import describe_absent
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.insights.status import (
    bags_with_remarks,
    budget_of,
    nothing_here,
    required_missing,
    unrecorded,
)
from ros2_memory.queries import data_time_range
from ros2_memory.recorder.process.installation import advice_on_rmw, rmw_of, robot_environment
from ros2_memory.recorder.process.topics import TopicSelection, load_topics
from ros2_memory.results import Undecodable
from ros2_memory.retention.policy import GB, SMALL_BUDGET_GB, small_budget
from ros2_memory.serving.auth import api_token
from ros2_memory.serving.health import read_health
from ros2_memory.storage.base import Closing

T = TypeVar("T")

_RECENT_NS: Final[Ns] = 3600 * NS_PER_S
"""A topic without a message in the newest data of this length is not being recorded."""
_COMMANDS_OF_EXTRAS: Final = (
    ("export --parquet", "pyarrow", "parquet"),
    ("plot", "matplotlib", "plot"),
)
_MSG_FOLDERS: Final = "reader.custom_msg_paths"
_NOT_REPAIRED: Final = "copy them again from their source; what is so there, too, cannot be read"
_READ: Final = "give this user the right to read it, or run as the user of the services"
_UNOFFERED: Final = "no publisher has offered it since the recorder started"
_START_RECORDER: Final = "start it: ros2-memory-recorder, or systemctl start ros2-memory-recorder"
_LIST_TAKEN: Final = "a changed list is taken within seconds"
_STYLES: Final = {Level.OK: "green", Level.WARNING: "yellow", Level.ERROR: "red"}


def doctor(as_json: AsJson = False, *, bags: Bags) -> int:
    """Check configuration, disk, clock, bags, recorder, ROS environment, topics and server.

    Each finding says how to fix it.
    """
    findings = [*_examine(bags)]
    worst = max(finding.level for finding in findings)
    if as_json:
        rows = [{**finding._asdict(), "level": str(finding.level)} for finding in findings]
        print_json({"status": str(worst), "findings": rows})
        return worst
    console = stdout_console()
    for level, about, seen, do in findings:
        styled = (f"{level!s:<8}", _STYLES[level]), (f"{about:<9}", "bold")
        console.print(Text.assemble(*styled, escape(seen)), soft_wrap=True)
        if do:
            console.print(Text(f"{'':17}-> {escape(do)}"), soft_wrap=True)
    return worst


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
            yield from _of_robot(name, *open_robot(settings, name, verbose=bags.verbose))
        with spinner("asking the lake"):
            yield from _findings_of({"lake": check_lake} | _OF_SETTINGS, settings)
        return
    with spinner("asking the disk, ros2, the recorder and the server"):
        robot = Examined(settings, memory, memory.index.snapshot(), memory.clock.now())
        yield from _findings_of(_OF_BAGS, robot)
        if robot.records:
            yield from _findings_of(_OF_RECORDER, robot)
        else:
            yield Finding(Level.OK, "recorder", "recorder=none: nothing is recorded here")
        yield from _findings_of(_OF_SETTINGS, settings)


def _findings_of(
    checks: Mapping[str, Callable[[T], Iterator[Finding]]], what: T
) -> Iterator[Finding]:
    """Yields the findings of checks by their concerns."""
    for about, check in checks.items():
        try:
            for finding in check(what):
                yield finding._replace(about=finding.about or about)
        except OSError as problem:
            do = f"{_READ}; else look after the disk"
            yield Finding(Level.ERROR, about, reason_of(problem), do)


def _of_robot(name: str, own: Settings, memory: Memory) -> Iterator[Finding]:
    """Yields what is wrong with the bags of a robot of a fleet; else how many there are."""
    snapshot, bag_dir = memory.index.snapshot(), own.recording.bag_dir
    findings: Iterable[Finding]
    if snapshot.problem:
        do = "is the disk mounted? The other robots are answered for meanwhile"
        findings = [warning(f"{bag_dir}: {snapshot.problem}", do)]
    elif not (snapshot.bags or snapshot.active):
        do = f"{ROBOTS_SETTING} names another directory for it"
        findings = [warning(f"{bag_dir}: {nothing_here(snapshot)}", do)]
    else:
        findings = _findings_of(_OF_BAGS, Examined(own, memory, snapshot, memory.clock.now()))
    for finding in findings:
        if finding.level is not Level.OK or finding.about == "bags":
            yield finding._replace(about="robot", seen=f"{name}: {finding.seen}")


def check_bag_dir(robot: Examined) -> Iterator[Finding]:
    """Checks that the bag directory exists, and that this user may use it."""
    bag_dir = robot.settings.recording.bag_dir.absolute()
    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # a container's user without an entry
        user = f"user {os.getuid()}"
    if not bag_dir.is_dir():
        if not robot.records:
            do = "name the directory of the bags: MEMORY_BAG_DIR, or recording.bag_dir=DIR"
            yield error(f"{bag_dir} is not a directory", do)
            return
        do = "the recorder makes it when it starts; is its disk mounted?"
        yield warning(f"{bag_dir} is not there", do)
    elif not os.access(bag_dir, os.R_OK | os.X_OK):
        yield error(f"{user} may not read {bag_dir}", _READ)
        return
    elif robot.records and not os.access(bag_dir, os.W_OK):
        do = (
            "fine if the recorder runs as another user, who may: "
            "sudo -u USER ros2-memory doctor looks as that one"
        )
        yield warning(f"{bag_dir}, readable but not writable by {user}", do)
    else:
        yield ok(f"{bag_dir}, readable{' and writable' if robot.records else ''} by {user}")
    if (bag_dir / ERASING_FILE).exists():
        yield warning(
            "an earlier `ros2-memory forget` was interrupted: some data to delete is still there",
            "run any `ros2-memory forget`: it finishes that first",
        )


def check_disk(robot: Examined) -> Iterator[Finding]:
    """Checks that the disk has room for the budget, where bags are recorded."""
    if not robot.records:
        return
    bag_dir, limits = robot.settings.recording.bag_dir.absolute(), robot.settings.retention
    existing = next(path for path in (bag_dir, *bag_dir.parents) if path.is_dir())
    mount = next(path for path in (existing, *existing.parents) if os.path.ismount(path))
    free = shutil.disk_usage(existing).free / GB
    budget = budget_of(robot.memory, robot.snapshot, robot.memory.index.heartbeat(), robot.now)
    used = budget.used / GB
    seen = f"{free:.1f} GB free on {mount}; used: {describe_budget(budget)}"
    if free < limits.min_free_gb:
        do = f"recording pauses below retention.min_free_gb={limits.min_free_gb:g}; delete "
        yield error(seen, f"{do}other files on this disk")
    elif free - limits.min_free_gb < limits.max_total_gb - used:
        do = "the disk is full before the budget is: lower retention.max_total_gb to "
        yield warning(seen, f"{do}{max(free - limits.min_free_gb + used, 0):.1f}, or make room")
    else:
        yield ok(seen)
    if leaving := describe_leaving(robot.memory.index.bag_dir):
        yield warning(leaving, "memory.keep=true keeps it")
    if limits.max_total_gb < SMALL_BUDGET_GB:
        do = f"raise retention.max_total_gb to {SMALL_BUDGET_GB:g} or more"
        yield warning(small_budget(limits.max_total_gb), do)


def check_clock(robot: Examined) -> Iterator[Finding]:
    """Checks this machine's clock, and those of the machines that dated the bags."""
    dating, now = robot.snapshot.dating, robot.now
    do = "set the clock (timedatectl, chrony); bags keep the dates they were given"
    if now < FIRST_BAGS_NS:
        yield error(f"it shows {iso_local(now)}: it was never set", do)
    elif dating.latest is not None and dating.latest > now + FUTURE_NS:
        ahead_s = unix_from_ns(dating.latest - now)
        yield error(f"the newest data is dated {ahead_s:.0f} s after the present", do)
    elif dating.faults:
        faults = counted(len(dating.faults), "bag was", "bags were")
        yield warning(f"{faults} dated by a wrong clock: `ros2-memory info` lists them", do)
    else:
        yield ok(f"{iso_local(now)} (this machine)")


def check_bags(robot: Examined) -> Iterator[Finding]:
    """Checks that all bags can be read, and all messages in them decoded; and what they hold."""
    memory, snapshot = robot.memory, robot.snapshot
    covered = data_time_range(memory, Call())
    if snapshot.problem:
        yield error(snapshot.problem, "see bag_dir above; is the disk mounted?")
        return
    if covered.bags or covered.active:
        newest = "" if covered.latest is None else f"; newest: {iso_local(covered.latest)}"
        yield ok(f"{counted(covered.bags, 'bag file is', 'bag files are')} readable{newest}")
    else:
        do = "recording.bag_dir=DIR names another directory; a recorder fills this one"
        yield warning(nothing_here(snapshot), do)
    aside: dict[tuple[str, str], list[str]] = {}
    for bag in covered.unread:
        aside.setdefault(("not read", bag.reason), []).append(bag.path.name)
    for state, files in (("damaged", covered.damaged), ("unfinished", covered.incomplete)):
        for bag in files:
            names = aside.setdefault((state, _remedy(bag, memory)), [])
            names.append(f"{bag.path.name} ({bag.reason})")
    for (state, do), names in aside.items():
        yield warning(f"{counted(len(names), 'file is', 'files are')} {state}: {listed(names)}", do)
    yield from _check_content(memory, snapshot, covered.undecodable)
    yield from _check_recordings(memory, snapshot)


def _check_content(
    memory: Memory, snapshot: Snapshot, undecodable: Iterable[Undecodable]
) -> Iterator[Finding]:
    """Checks that bags are whole, as they state, and that their messages can be decoded."""
    for whole, forms, do in (
        (
            False,
            ("bag is not whole", "bags are not whole"),
            "answers use the readable part; copy the bags again for the rest",
        ),
        (
            True,
            ("bag contradicts itself", "bags contradict themselves"),
            "nothing is missing: what it states of itself is wrong, not its messages",
        ),
    ):
        odd = [bag for bag in bags_with_remarks(snapshot) if is_whole(bag) is whole]
        names = listed([f"{bag.path.name} ({'; '.join(bag.summary.notes)})" for bag in odd])
        if odd:
            yield warning(f"{counted(len(odd), *forms)}: {names}", do)
    for sentence in describe_absent(memory.absent_splits(snapshot)):
        yield warning(sentence, "copy the missing data from its source")
    for is_mended, do in (
        (True, f"name the folder with the .msg files in {_MSG_FOLDERS}"),
        (False, "nothing decodes them here: record them as ROS 2 messages (CDR) or as JSON"),
    ):
        # The reason names the key where a configured folder would help.
        topics = [topic for topic in undecodable if (_MSG_FOLDERS in topic.reason) is is_mended]
        names = listed([f"{topic.topic} ({topic.reason})" for topic in topics])
        if topics:
            yield warning(f"{counted(len(topics), 'topic')} cannot be decoded: {names}", do)


def _remedy(bag: SetAside, memory: Memory) -> str:
    """Returns what to do about a file; `ros2-memory recover` repairs MCAP without an end."""
    if not os.access(bag.path, os.R_OK):
        return _READ
    with suppress(BagError):
        if bag.path.suffix == ".mcap" and memory.reader.closing(bag.path) is Closing.OPEN:
            return f"ros2-memory recover {memory.index.bag_dir}"
    return _NOT_REPAIRED


def _check_recordings(memory: Memory, snapshot: Snapshot) -> Iterator[Finding]:
    """Checks that the recordings are one history, and that no file counts as active by mistake."""
    pairs = sorted(mixed_recordings(memory, Call()), key=lambda pair: pair[1] is None)
    do = (
        "give the bags of each robot or run a folder of their own, and a server each; or look at "
        "one of them: --recording NAME, data.recording=NAME"
    )
    for pair, topic in pairs[:MAX_NAMED]:
        first, second = pair.names
        why = (
            "after a clock was set back" if are_of_one_recorder(memory, pair) else "from two robots"
        )
        differ = f"; each has different messages on {topic}, as {why}" if topic else ""
        yield warning(
            f"recordings {first} and {second} overlap from {iso_local(pair.start)} to "
            f"{iso_local(pair.end)}, and are answered together{differ}",
            do,
        )
    for contradiction in contradicting_frames(memory, Call())[:MAX_NAMED]:
        yield warning(str(contradiction), do)
    if len(pairs) > MAX_NAMED:
        more = counted(len(pairs) - MAX_NAMED, "more pair overlaps", "more pairs overlap")
        yield warning(more, "`ros2-memory info` lists them all")
    for path, until in assumed_active(memory, snapshot):
        yield warning(
            f"{path.parent.name}/{path.name} has no end and was written lately: until "
            f"{iso_local(until)} it counts as still being written",
            "if no program writes it (a copy), wait until then: answers use its readable part",
        )


def check_columns(robot: Examined) -> Iterator[Finding]:
    """Checks that columns can be stored, and names topics that are beyond their share."""
    store = robot.memory.scanner.store
    if store is None:
        return
    if store.trouble is not None:
        do = "answers are right, and slower; free the disk, or let it be written"
        yield warning(f"the store of columns {store.trouble}", do)
    if store.refusals:
        do = "answers are right, and slower; please report this as a defect, with the reason"
        bags = counted(store.refusals, "bag")
        yield warning(f"{bags} could not be stored ({store.refused_for})", do)
    if dropped := store.dropped():
        since = iso_local(min(dropped.values()))
        seen = f"topics beyond store.max_share since {since}, whose bags are read: "
        yield ok(f"{seen}{', '.join(dropped)}")


def check_recorder(robot: Examined) -> Iterator[Finding]:
    """Checks what the recorder's heartbeat reports."""
    heartbeat, reason = read_heartbeat(robot.settings.recording.bag_dir)
    if heartbeat is None:
        yield error(str(reason), _START_RECORDER)
        return
    age = f"{unix_from_ns(abs(robot.now - heartbeat.updated)):.0f} s ago"
    if heartbeat.state is RecorderState.STOPPED:
        yield warning(f"it was stopped {age}", _START_RECORDER)
    elif not heartbeat.is_live(robot.now):
        do = f"journalctl -u ros2-memory-recorder says why it ended; {_START_RECORDER}"
        yield error(f"its last heartbeat was {age}, and gives no reason to end", do)
    elif heartbeat.state is RecorderState.PAUSED:
        yield error(
            f"it is paused: {heartbeat.last_error or 'it gives no reason'}", "see disk above"
        )
    elif heartbeat.state is RecorderState.WAITING:
        yield error("it waits, and has recorded nothing", str(heartbeat.waiting_for))
    else:
        yield ok(f"{heartbeat.state}, {counted(len(heartbeat.subscribed), 'topic')} subscribed")
        yield from _reported(heartbeat)


def _reported(beat: Heartbeat) -> Iterator[Finding]:
    """Yields what a recorder that records reports of itself."""
    for seen in required_missing(beat):
        yield error(seen, "are their publishers running? compare recording.required")
    for seen in unrecorded(beat):
        do = (
            "name the workspace of an unknown type in recorder.setup_files; compare the others "
            "with `ros2 topic echo`"
        )
        yield warning(seen, do)
    silent = sorted({*beat.silent} - {*beat.unheard, *beat.fell_silent})
    failing = listed(beat.failing_rules) if beat.failing_rules else ""
    for finding, reported, do in (
        (
            warning,
            f"subscribed, but no messages from: {listed(silent)}" if silent else "",
            (
                "is their publisher running? If it runs as another user, the recorder receives it "
                "only over the network: set FASTDDS_BUILTIN_TRANSPORTS=UDPv4 for the recorder; in "
                "the discovery range LOCALHOST that has no effect, see docs/how-to/systemd.md"
            ),
        ),
        (
            warning,
            beat.age_held,
            "synchronise the clock (timedatectl set-ntp true, or chrony); the budget still holds",
        ),
        (
            warning,
            beat.unshipped,
            "does ros2-memory ship run? raise retention.max_total_gb until it has caught up",
        ),
        (error, beat.list_refused, "correct the list of topics"),
        (
            error,
            failing and (beat.held_back or failing),
            (
                "correct the rule in the file that recording.exclude_when names, and restart the "
                "recorder: it then reads the splits that are held back; see docs/how-to/forget.md"
            ),
        ),
        (
            warning,
            "" if failing else beat.held_back,
            "free the disk, or repair the file; docs/how-to/forget.md says what becomes of it",
        ),
    ):
        if reported:
            yield finding(reported, do)
    if beat.last_error:
        when = "" if beat.last_error_at is None else f" ({iso_local(beat.last_error_at)})"
        seen = f"its last error{when}: {beat.last_error}"
        if beat.restarts:
            times = counted(beat.restarts, "time")
            seen = f"it restarted ros2 bag record {times}; {seen}"
        if beat.recovered:
            yield ok(f"recording goes on since; {seen}")
        else:
            yield warning(seen, "see its log")


def check_ros(robot: Examined) -> Iterator[Finding]:
    """Checks that `ros2 bag record` runs in the environment that the recorder gives it.

    A recorder that is running may have its setup files by its own arguments.
    """
    settings, recorder = robot.settings, robot.settings.recorder
    setup_files = () if isinstance(recorder, NullRecorderNode) else recorder.setup_files
    try:
        build_recorder(settings, reader=robot.memory.reader).check()
    except EpisodicError as problem:
        reason, _, do = str(problem).partition("; ")
        if setup_files or robot.live is None or robot.live.state is RecorderState.STOPPED:
            yield error(reason, do or "correct recorder.setup_files")
            return
        seen = f"{reason} with these settings, but the running recorder has it by its own"
        yield warning(
            seen, "give this command the recorder's settings (its environment and arguments)"
        )
        return
    files = ", ".join(map(str, setup_files))
    yield ok(f"ros2 bag record can be run{f' after {files}' if files else ''}")
    env = robot_environment(setup_files, settings.recording.bag_dir)
    if advice := advice_on_rmw(env):
        yield ok(f"RMW_IMPLEMENTATION={rmw_of(env)}", advice)


def check_topics(robot: Examined) -> Iterator[Finding]:
    """Checks that the topics of `topics.yaml` have been recorded lately."""
    file, live = _list_file(robot.settings), robot.live
    try:
        selection = load_topics(file)
    except EpisodicError as problem:
        yield error(str(problem), "correct recording.topics_file")
        return
    if live is not None and (finding := _other_list(file, selection, live)):
        yield finding
        return
    yield from _lives_of_others(robot, selection)
    heard = {*live.subscribed} - {*live.silent} if live else set[str]()
    missing = _unheard_entries(robot, selection, heard)
    unoffered = live.missing if live else ()
    unknown = live.unknown_types if live else ()
    entries = counted(len(selection.entries), "entry", "entries")
    if not robot.snapshot.bags:
        yield ok(f"{file} lists {entries}; nothing is recorded yet")
    elif not missing and not unoffered:
        yield ok(f"{entries} of {file}: all are in the newest hour of data, or latched")
    # ros2 bag record names one topic of each unknown type.
    unseen = f"{_UNOFFERED}, or its type is unknown, too" if unknown else _UNOFFERED
    for entry, similar in missing.items():
        if of_unknown := [*filter(TopicSelection((entry,)).matches, unknown)]:
            seen = f"{entry} is in {file}; ros2 bag record does not know the type of"
            do = "name the workspace that defines it in recorder.setup_files"
            yield warning(f"{seen} {listed(of_unknown)}", do)
            continue
        hint = f"is it {' or '.join(similar)}? " if similar else ""
        why = f"; {unseen}" if entry in unoffered else ""
        do = "compare with `ros2 topic list`; a topic without a publisher is not recorded"
        seen = f"{entry} is in {file}, and not in the newest hour of data{why}"
        yield warning(seen, f"{hint}{do}")
    for entry in unoffered:
        if entry not in missing:
            do = "is its publisher running? compare with `ros2 topic list`"
            yield warning(f"{entry} is in {file}; {unseen}", do)


def _lives_of_others(robot: Examined, selection: TopicSelection) -> Iterator[Finding]:
    """Yields a finding on each key of `retention.topics` that no topic has."""
    names = (*selection.entries, *robot.snapshot.timeline.topics())
    for glob in robot.settings.retention.topics:
        if not (selection.matches(glob) or match_topics(names, glob)):
            do = "compare with `ros2-memory topics`"
            yield warning(f"{glob} in retention.topics is no topic that is recorded", do)


def _list_file(settings: Settings) -> Path:
    """Returns the list of topics that the recorder has: what `up` wrote, where none was chosen."""
    listed = settings.recording.topics_file
    written, shipped = settings.recording.bag_dir / listed.name, config_dir({}) / listed.name
    with suppress(OSError):
        if written.is_file() and listed.read_bytes() == shipped.read_bytes():
            return written
    return listed


def _other_list(file: Path, selection: TopicSelection, live: Heartbeat) -> Finding | None:
    """Returns the finding on a running recorder whose list is not this one; else None."""
    here, there = {*selection.listed}, {*live.listed}
    differences = ("adds", here - there), ("lacks", there - here)
    if there and here != there:
        what = [f"{file} {how} {listed(sorted(names))}" for how, names in differences if names]
        do = f"{_LIST_TAKEN}; if the recorder has another file, give this command its settings"
        return warning(f"the running recorder has another list: {'; '.join(what)}", do)
    waited = [name for name in live.missing if name not in selection.entries]
    others = [name for name in (*live.subscribed, *waited) if not selection.matches(name)]
    if not others:
        return None
    seen = f"the running recorder records or waits for {listed(others)}, not listed in {file}"
    do = "give this command the recorder's settings (its environment and key=value arguments); "
    return warning(seen, f"{do}{_LIST_TAKEN}")


def _unheard_entries(
    robot: Examined, selection: TopicSelection, received: Collection[str]
) -> Mapping[str, list[str]]:
    """Returns the entries without a recent message, with similar names among recorded topics.

    `received`: of those the recorder has messages, in a split that may not be closed yet.
    """
    snapshot, latching = robot.snapshot, robot.memory.limits.latching
    timeline, latest, heard = snapshot.timeline, snapshot.dating.latest, [*received]
    for topic in timeline.topics():
        last = max(totals.last for totals in timeline.totals(topic).values())
        # Nobody expects a latched topic or a log to have a message in every hour.
        is_seldom = latching.is_latched(snapshot, topic) or timeline.is_log(topic)
        if latest is None or is_seldom or last > latest - _RECENT_NS:
            heard.append(topic)
    return {
        entry: get_close_matches(entry, timeline.topics(), n=2)
        for entry in selection.entries
        if snapshot.bags and not any(map(TopicSelection((entry,)).matches, heard))
    }


def check_extras(settings: Settings) -> Iterator[Finding]:
    """Checks whether the optional packages are installed that the configuration asks for."""
    server = settings.server
    for is_on, key, modules in (
        (server.metrics, "server.metrics", ["prometheus_client"]),
        (
            server.traces,
            "server.traces",
            ["opentelemetry.sdk", "opentelemetry.exporter.otlp.proto.http"],
        ),
    ):
        missing = ", ".join(filterfalse(_is_installed, modules))
        if is_on and missing:
            do = "pip install '.[observability]', or set it to false: the server does not start"
            yield error(f"{key}=true needs {missing}, which cannot be imported", do)
        elif is_on:
            yield ok(f"what {key}=true needs is installed")
    if server.metrics and server.transport == "stdio":
        yield error(
            "server.metrics=true with server.transport=stdio, which has no /metrics",
            "choose server.transport=sse, or set server.metrics to false",
        )
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
    address = f"{server.host} port {server.port}"
    if server.transport == "stdio":
        yield ok("server.transport=stdio: each client starts its own server")
        with suppress(OSError, http.client.HTTPException, ValueError, EpisodicError):
            _, reply = read_health(server.host, server.port)  # it may be another program
            yield ok(
                f"one that was started otherwise answers on {address}: {reply['status']}",
                "to examine it, give this command its settings, such as deployment=robot",
            )
        return
    start = time.monotonic()
    try:
        token = api_token(os.environ)
        status, reply = read_health(
            server.host, server.port, token.get_secret_value() if token else ""
        )
    except (OSError, http.client.HTTPException) as problem:
        do = "start it: ros2-memory-server, or systemctl start ros2-memory-server"
        yield error(f"nothing answers on {address}: {problem}", do)
        return
    except (ValueError, EpisodicError) as problem:
        do = "give the server another port: server.port"
        yield error(f"another program answers on {address}: {problem}", do)
        return
    duration_ms = (time.monotonic() - start) * 1000
    if status == http.HTTPStatus.UNAUTHORIZED:
        seen = f"the server on {address} takes another token than MEMORY_API_TOKEN"
        yield warning(seen, "give doctor the token that the server was started with")
    elif reply.get("status") == "ok":
        yield ok(f"ok on {address}, in {duration_ms:.0f} ms")
    else:
        problems = reply.get("problems")
        why = "; ".join(map(str, problems)) if isinstance(problems, list) else ""
        seen = f"{reply.get('status', f'HTTP {status}')}: {why or 'it gives no reason'}"
        yield warning(seen, "the findings above and its log have the cause")


_OF_BAGS: Final = {
    "bag_dir": check_bag_dir,
    "disk": check_disk,
    "clock": check_clock,
    "bags": check_bags,
    "columns": check_columns,
}
_OF_RECORDER: Final = {
    "ros": check_ros,
    "recorder": check_recorder,
    "shipping": check_shipping,
    "topics": check_topics,
}
_OF_SETTINGS: Final = {"extras": check_extras, "server": check_server}
"""The checks by their concerns, in the order in which they are printed."""
