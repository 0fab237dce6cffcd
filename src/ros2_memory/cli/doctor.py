"""`ros2-memory doctor`: checks everything that has to be right, and says what to do.

One function for each concern; each yields findings, and changes nothing.
"""

import http.client
import os
import shlex
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from enum import IntEnum
from functools import partial
from typing import Final, NamedTuple, TypeVar

from ros2_memory.bag_dir.heartbeat import Heartbeat, RecorderState, read_heartbeat
from ros2_memory.bag_dir.layout import ERASING_FILE, MOMENTS_FOLDER, is_derived
from ros2_memory.bag_dir.state_files import describe_leaving, is_shipped, read_receipts
from ros2_memory.bootstrap import build_recorder
from ros2_memory.bootstrap_fleet import ROBOTS_SETTING, lake_location
from ros2_memory.cli.options import AsJson, Bags, open_memory, open_robot, reason_of
from ros2_memory.cli.output import escape, format_size, print_json, print_line, spinner
from ros2_memory.columns.store import relative
from ros2_memory.config import NullRecorderNode, Settings, files_in_use, unused_config
from ros2_memory.core.errors import (
    BagError,
    ConfigError,
    EpisodicError,
    InvalidArgumentsError,
    LakeError,
    NoDataError,
    UndecodableError,
)
from ros2_memory.core.model import MCAP, BagFile, BagState, SetAside
from ros2_memory.core.text import counted, listed, match_topics, similar
from ros2_memory.core.timebase import FUTURE_NS, NS_PER_HOUR, Ns, iso_local, unix_from_ns
from ros2_memory.history.context import Call, Memory, short_name
from ros2_memory.history.coverage import is_whole
from ros2_memory.history.driven_path import (
    frame_of_newest_pose,
    resolve_path_topic,
    root_above,
)
from ros2_memory.history.no_data import nothing_here
from ros2_memory.history.robots import ADVICE, describe_mixed
from ros2_memory.history.transforms import connects
from ros2_memory.history.view import open_view
from ros2_memory.index.bag_table import alike_bags, digest_of
from ros2_memory.index.clock_faults import FIRST_BAGS_NS
from ros2_memory.index.listed_splits import describe_absent
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.insights.status import (
    bags_with_remarks,
    budget_of,
    required_missing,
    unrecorded,
)
from ros2_memory.queries import data_time_range
from ros2_memory.recorder.process.installation import advice_on_rmw, rmw_of, robot_environment
from ros2_memory.recorder.process.topics import TopicSelection, load_topics
from ros2_memory.results import DataTimeRange
from ros2_memory.retention.policy import GB
from ros2_memory.serving.auth import api_token
from ros2_memory.serving.health import read_health

T = TypeVar("T")

_MSG_FOLDERS: Final = "reader.custom_msg_paths"
_READ: Final = "give this user the right to read it, or run as the user of the services"
_WAIT: Final = (
    "it counts as being written; if no program writes it, as a copy, it is read once it is older"
)
_CORRECT: Final = "correct the key that it names"
_LATE_NS: Final[Ns] = NS_PER_HOUR
"""A hub that is reached has confirmed closed bags after this time."""
_START_RECORDER: Final = "start it: ros2-memory-recorder, or systemctl start ros2-memory-recorder"


class Examined(NamedTuple):
    """The robot that a check looks at; `now` is the wall clock's time."""

    settings: Settings
    memory: Memory
    snapshot: Snapshot
    now: Ns

    @property
    def records(self) -> bool:
        """Whether a recorder is configured for the bag directory."""
        return not isinstance(self.settings.recorder, NullRecorderNode)

    @property
    def live(self) -> Heartbeat | None:
        """The heartbeat of a recorder at work; None without one."""
        heartbeat = read_heartbeat(self.settings.recording.bag_dir).heartbeat
        return heartbeat if heartbeat and heartbeat.is_live(self.now) else None


class Level(IntEnum):
    """How bad a finding is; its value is the exit code."""

    OK = 0
    WARNING = 1
    ERROR = 2

    def __str__(self) -> str:
        return self.name.lower()


class Finding(NamedTuple):
    """What a check saw, and what to do about it; `do` is None if all is in order.

    `about` names a concern; if it is empty, the finding is about the concern of its check.
    """

    level: Level
    about: str
    seen: str
    do: str | None = None


ok: Final = partial(Finding, Level.OK, "")
warning: Final = partial(Finding, Level.WARNING, "")
error: Final = partial(Finding, Level.ERROR, "")


def doctor(as_json: AsJson = False, *, bags: Bags) -> int:
    """Check configuration, disk, clock, bags, poses, recorder, ROS environment, topics and server.

    Each finding says how to fix it.
    """
    findings = [*_examine(bags)]
    worst = max(finding.level for finding in findings)
    if as_json:
        rows = [{**finding._asdict(), "level": str(finding.level)} for finding in findings]
        print_json({"status": str(worst), "findings": rows})
        return worst
    for finding in findings:
        print_line(f"{finding.level!s:<8}{finding.about:<9}{escape(finding.seen)}")
        if finding.do:
            print_line(f"{'':17}-> {escape(finding.do)}")
    return worst


def _examine(bags: Bags) -> Iterator[Finding]:
    """Yields all findings; a refused configuration, or recording, is the only one."""
    try:
        settings = bags.settings()
        robots = settings.fleet.robots
        memory = open_memory(settings, verbose=bags.verbose, allows_fleet=True)
    except EpisodicError as refused:
        yield Finding(Level.ERROR, "config", str(refused), _CORRECT)
        return
    yield Finding(Level.OK, "config", f"files in use: {', '.join(files_in_use(settings))}")
    if unused := unused_config():
        do = "set that, or rename the file if it is another program's"
        yield Finding(Level.WARNING, "config", unused, do)
    if robots:
        for name in robots:
            yield from _examine_robot(name, settings, verbose=bags.verbose)
        with spinner("asking the lake"):
            yield from _run_checks({"lake": check_lake} | _OF_SETTINGS, settings)
        return
    with spinner("asking the disk, ros2, the recorder and the server"):
        robot = Examined(settings, memory, memory.snapshot(), memory.clock.now())
        yield from _run_checks(_OF_BAGS, robot)
        if robot.records:
            yield from _run_checks(_OF_RECORDER, robot)
        else:
            yield Finding(Level.OK, "recorder", "recorder=none: nothing is recorded here")
        yield from _run_checks(_OF_SETTINGS, settings)


def _run_checks(
    checks: Mapping[str, Callable[[T], Iterator[Finding]]], subject: T
) -> Iterator[Finding]:
    """Yields the findings of checks, which are given by their concerns."""
    for about, check in checks.items():
        try:
            for finding in check(subject):
                yield finding._replace(about=finding.about or about)
        except OSError as problem:
            do = f"{_READ}; else look after the disk"
            yield Finding(Level.ERROR, about, reason_of(problem), do)


def _examine_robot(name: str, fleet: Settings, *, verbose: bool) -> Iterator[Finding]:
    """Yields what is wrong with a robot of the fleet, and how many of its bags are readable."""
    try:
        own, memory = open_robot(fleet, name, verbose=verbose)
    except EpisodicError as refused:
        yield Finding(Level.ERROR, "robot", f"{name}: {refused}", _CORRECT)
        return
    snapshot, bag_dir = memory.snapshot(), own.recording.bag_dir
    if snapshot.problem or not (snapshot.bags or snapshot.active):
        seen = f"{name}: {bag_dir}: {snapshot.problem or nothing_here(snapshot)}"
        do = f"is the disk mounted? {ROBOTS_SETTING} names its directory"
        yield Finding(Level.WARNING, "robot", seen, do)
        return
    robot = Examined(own, memory, snapshot, memory.clock.now())
    for finding in _run_checks(_OF_BAGS, robot):
        if finding.level is not Level.OK or finding.about == "bags":
            yield finding._replace(about="robot", seen=f"{name}: {finding.seen}")


def check_bag_dir(robot: Examined) -> Iterator[Finding]:
    """Checks that the bag directory exists, and that this user may use it."""
    bag_dir = robot.settings.recording.bag_dir.absolute()
    if not bag_dir.is_dir() and robot.records:
        do = "the recorder makes it when it starts; is its disk mounted?"
        yield warning(f"{bag_dir} is not there", do)
    elif not bag_dir.is_dir():
        do = "name the directory of the bags: MEMORY_BAG_DIR, or recording.bag_dir=DIR"
        yield error(f"{bag_dir} is not a directory", do)
    elif not os.access(bag_dir, os.R_OK | os.X_OK):
        yield error(f"this user may not read {bag_dir}", _READ)
    elif robot.records and not os.access(bag_dir, os.W_OK):
        do = "fine if another user records, who may: sudo -u USER ros2-memory doctor looks as that"
        yield warning(f"{bag_dir}, readable but not writable by this user", do)
    else:
        yield ok(f"{bag_dir}, readable{' and writable' if robot.records else ''}")
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
    free_gb = shutil.disk_usage(existing).free / GB
    budget = budget_of(robot.memory, robot.snapshot, robot.memory.index.heartbeat(), robot.now)
    room_gb = free_gb - limits.min_free_gb + budget.used / GB
    seen = f"{free_gb:.1f} GB free in {existing}; used: {format_size(budget.used)} of "
    seen += f"{limits.max_total_gb:g} GB (retention.max_total_gb)"
    if budget.foreign:
        seen += f"; bags that the recorder did not make take {format_size(budget.foreign)} more, "
        seen += "which is not counted: `ros2-memory adopt DIR` takes those of a folder"
    if free_gb < limits.min_free_gb:
        limit = f"retention.min_free_gb={limits.min_free_gb:g}"
        yield error(seen, f"recording pauses below {limit}; delete other files on this disk")
    elif room_gb < limits.max_total_gb:
        do = "the disk is full before the budget is: lower retention.max_total_gb to "
        yield warning(seen, f"{do}{max(room_gb, 0):.1f}, or make room")
    else:
        yield ok(seen)
    if leaving := describe_leaving(robot.memory.bag_dir):
        yield warning(leaving, "memory.keep=true keeps it")


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
        # Where no bag has a later date, the time is that of a simulation, which was reset.
        if dating.latest is not None and dating.latest < FIRST_BAGS_NS:
            do = "record each run of a simulation in a recording of its own"
        yield warning(f"{faults} dated by a wrong clock: `ros2-memory info` lists them", do)
    else:
        yield ok(f"{iso_local(now)} (this machine)")


def check_bags(robot: Examined) -> Iterator[Finding]:
    """Checks that all bags can be read, and all messages in them decoded."""
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
    names_by_fault: dict[_Fault, list[str]] = {}
    for fault, name in _faults(memory, snapshot, covered, is_recording=bool(robot.live)):
        names_by_fault.setdefault(fault, []).append(name)
    for fault, names in names_by_fault.items():
        yield warning(f"{counted(len(names), fault.kind)} {fault.wrong}: {listed(names)}", fault.do)
    for sentence in describe_absent(memory.absent_splits(snapshot)):
        yield warning(sentence, "copy the missing data from its source")
    for sentence in describe_mixed(memory, Call()):
        do = (
            "give the bags of each robot or run a folder of their own, and a server each; or look "
            "at one of them: --recording NAME, data.recording=NAME"
        )
        yield warning(sentence.removesuffix(ADVICE), do)


def check_poses(robot: Examined) -> Iterator[Finding]:
    """Checks that a topic places the robot, and that its map is the one that is configured."""
    if not robot.snapshot.bags:
        return
    view = open_view(robot.memory, Call(), robot.now)
    if not view.has_poses:
        return
    try:
        frame = frame_of_newest_pose(view, resolve_path_topic(view))
    except (InvalidArgumentsError, NoDataError) as unknown:
        yield warning("where the robot was is not known", str(unknown))
        return
    except UndecodableError:
        return  # the check of the bags names the topic
    map_frame, root = view.limits.map_frame, root_above(view, frame)
    if (
        map_frame
        and root
        and map_frame not in {root, frame}
        and not connects(view, (map_frame, frame))
    ):
        seen = f"no transforms lead from {frame} to data.map_frame, which is {map_frame}"
        yield warning(seen, f"they lead to {root}: if that is a map, set data.map_frame={root}")


class _Fault(NamedTuple):
    """What is wrong with files, bags or topics (`kind`), and what to do about it."""

    kind: str
    wrong: str
    do: str


def _faults(
    memory: Memory, snapshot: Snapshot, covered: DataTimeRange, *, is_recording: bool
) -> Iterator[tuple[_Fault, str]]:
    """Yields each fault, with the name of the file, bag or topic that has it."""
    for unread in covered.unread:
        yield _Fault("file", "not read", unread.reason), unread.path.name
    for wrong, files in (("damaged", covered.damaged), ("unfinished", covered.incomplete)):
        for file in files:
            fault = _Fault("file", wrong, _remedy(file, memory))
            yield fault, f"{file.path.name} ({file.reason})"
    for active in () if is_recording else snapshot.active:
        wrong = "without an end, and changed lately, so not read"
        yield _Fault("file", wrong, _WAIT), active.path.name
    for bag in bags_with_remarks(snapshot):
        wrong = "not whole"
        do = "answers use the readable part; copy the bags again for the rest"
        if is_whole(bag):
            wrong = "in contradiction with what is in it"
            do = "nothing is missing: what it states of itself is wrong, not its messages"
        yield _Fault("bag", wrong, do), f"{bag.path.name} ({'; '.join(bag.summary.notes)})"
    for bag in _copied(snapshot):
        do = "each message counts once; delete the copies, or serve another folder"
        yield _Fault("bag", "copied into a second folder", do), short_name(bag.path)
    for topic in covered.undecodable:
        do = "nothing decodes them here: record them as ROS 2 messages (CDR) or as JSON"
        if _MSG_FOLDERS in topic.reason:  # a definition is missing
            do = f"name the folder with the .msg or .action files in {_MSG_FOLDERS}"
        yield _Fault("topic", "cannot be decoded", do), f"{topic.topic} ({topic.reason})"


def _copied(snapshot: Snapshot) -> Iterator[BagFile]:
    """Yields the bags that are copies of bags in other folders, but for those of the recorder."""
    for alike in alike_bags(snapshot.timeline, anywhere=True):
        digests: set[bytes] = set()
        for bag in alike:
            if is_derived(bag.path) or f"/{MOMENTS_FOLDER}/" in bag.file:
                continue
            with suppress(OSError):
                digest = digest_of(bag)
                if digest in digests:
                    yield bag
                digests.add(digest)


def _remedy(file: SetAside, memory: Memory) -> str:
    """Returns what to do about a file that cannot be read to its end."""
    if not os.access(file.path, os.R_OK):
        return _READ
    with suppress(BagError):
        if file.path.suffix == MCAP and not memory.reader.is_finished(file.path):
            return f"ros2-memory recover {shlex.quote(str(memory.bag_dir))}"
    return "copy them again from their source; what is so there, too, cannot be read"


def check_columns(robot: Examined) -> Iterator[Finding]:
    """Checks that columns can be stored, and names the topics that take more than their share."""
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
        yield ok(f"topics beyond store.max_share, whose bags are read: {', '.join(dropped)}")


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
        yield from _check_topics_of(heartbeat)
        yield from _check_rules_and_files_of(heartbeat)
        yield from _check_last_error_of(heartbeat)


def _check_topics_of(heartbeat: Heartbeat) -> Iterator[Finding]:
    """Yields the topics that a running recorder does not receive."""
    for seen in required_missing(heartbeat):
        yield error(seen, "are their publishers running? compare recording.required")
    for seen in unrecorded(heartbeat):
        do = (
            "name the workspace of an unknown type in recorder.setup_files; compare the others "
            "with `ros2 topic echo`"
        )
        yield warning(seen, do)
    if heartbeat.missing:
        yield warning(
            f"in its list, and offered by no publisher: {listed(heartbeat.missing)}",
            "are their publishers running? compare with `ros2 topic list`",
        )
    silent = {*heartbeat.silent} - {*heartbeat.unheard, *heartbeat.fell_silent}
    if silent:
        do = (
            "is their publisher running? If it runs as another user, the recorder receives it "
            "only over the network: set FASTDDS_BUILTIN_TRANSPORTS=UDPv4 for the recorder; in "
            "the discovery range LOCALHOST that has no effect, see docs/how-to/systemd.md"
        )
        yield warning(f"subscribed, but no messages from: {listed(sorted(silent))}", do)


def _check_rules_and_files_of(heartbeat: Heartbeat) -> Iterator[Finding]:
    """Yields why a running recorder keeps, holds back or does not take what it should."""
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
        yield error(heartbeat.held_back or listed(heartbeat.failing_rules), do)
    elif heartbeat.held_back:
        do = "free the disk, or repair the file; docs/how-to/forget.md says what becomes of it"
        yield warning(heartbeat.held_back, do)


def _check_last_error_of(heartbeat: Heartbeat) -> Iterator[Finding]:
    """Yields the last error of a running recorder."""
    if not heartbeat.last_error:
        return
    at = heartbeat.last_error_at
    seen = f"its last error{'' if at is None else f' ({iso_local(at)})'}: {heartbeat.last_error}"
    if heartbeat.restarts:
        times = counted(heartbeat.restarts, "time")
        seen = f"it restarted ros2 bag record {times}; {seen}"
    if heartbeat.recovered:
        yield ok(f"recording goes on since; {seen}")
    else:
        yield warning(seen, "see its log")


def check_shipping(robot: Examined) -> Iterator[Finding]:
    """Checks that bags are shipped, if age deletes only shipped ones (`require_shipped`)."""
    if not robot.settings.retention.require_shipped:
        return
    bag_dir = robot.settings.recording.bag_dir
    receipts = read_receipts(bag_dir)
    closed: list[BagFile] = []
    waiting: list[BagFile] = []
    for bag in robot.snapshot.bags:
        name = relative(bag.file, str(bag_dir))
        is_moment = name.startswith(f"{MOMENTS_FOLDER}/")
        if bag.state is not BagState.CLOSED or is_derived(bag.path) or is_moment:
            continue
        closed.append(bag)
        if not is_shipped(receipts, name, bag.size):
            waiting.append(bag)
    newest = max((receipt.at for receipt in receipts.values()), default=None)
    seen = f"{len(waiting)} of {counted(len(closed), 'closed bag')} not shipped"
    if newest is None:
        seen += ", and there is no receipt: no bag is deleted for its age"
    else:
        seen += f"; the newest receipt is from {iso_local(newest)}"
    late = robot.now - _LATE_NS
    if any(bag.end < late for bag in waiting) and (newest or 0) < late:
        do = "does ros2-memory ship run, and may it write here? `doctor` there looks after it"
        yield warning(seen, do)
    else:
        yield ok(seen)


def check_lake(settings: Settings) -> Iterator[Finding]:
    """Checks that the lake is reached."""
    if settings.lake.warehouse is None:
        return
    try:
        location = lake_location(settings)
        changed = location.last_change()
    except (ConfigError, LakeError) as problem:
        do = "correct lake.warehouse, lake.uri or what leads there; nothing is lost meanwhile"
        yield error(str(problem), do)
        return
    if changed is None:
        do = "ros2-memory ship makes it; was it there before, is its disk mounted?"
        yield warning(f"{location.warehouse} has no bag yet", do)
    else:
        yield ok(f"{location.warehouse}; its bags last changed {iso_local(changed)}")


def check_ros(robot: Examined) -> Iterator[Finding]:
    """Checks that `ros2 bag record` runs in the environment that the recorder gives it."""
    settings, recorder = robot.settings, robot.settings.recorder
    setup_files = () if isinstance(recorder, NullRecorderNode) else recorder.setup_files
    try:
        unused = dict.fromkeys(("housekeeper", "own", "background"))  # by `check`
        reader = robot.memory.reader
        build_recorder(settings, reader=reader, keep_open=(), excluding={}, **unused).check()
    except EpisodicError as problem:
        reason, _, do = str(problem).partition("; ")
        given = "give this command the settings of the recorder (its environment and arguments)"
        if setup_files or robot.live is None or robot.live.state is RecorderState.STOPPED:
            yield error(reason, do or f"correct recorder.setup_files, or {given}")
        else:
            yield warning(f"{reason} with these settings; the running recorder has others", given)
        return
    files = ", ".join(map(str, setup_files))
    yield ok(f"ros2 bag record can be run{f' after {files}' if files else ''}")
    env = robot_environment(setup_files, settings.recording.bag_dir)
    if advice := advice_on_rmw(env):
        yield ok(f"RMW_IMPLEMENTATION={rmw_of(env)}", advice)


def check_topics(robot: Examined) -> Iterator[Finding]:
    """Checks that each entry of the recorder's list has been recorded, or is received."""
    recorded, live = robot.snapshot.timeline.topics(), robot.live
    heartbeat = read_heartbeat(robot.settings.recording.bag_dir).heartbeat
    try:
        selection = load_topics(robot.settings.recording.topics_file)
    except EpisodicError as problem:
        yield error(str(problem), "correct recording.topics_file")
        return
    if heartbeat is not None and heartbeat.listed:  # the list that it has in use
        selection = TopicSelection(
            tuple(line for line in heartbeat.listed if not line.startswith("not "))
        )
    for glob in robot.settings.retention.topics:
        if not (selection.matches(glob) or match_topics((*selection.entries, *recorded), glob)):
            seen = f"{glob} in retention.topics is no topic that is recorded"
            yield warning(seen, "compare with `ros2-memory topics`")
    received = {*live.subscribed} - {*live.silent} if live else set[str]()
    missing = [
        entry
        for entry in selection.entries
        if not any(map(TopicSelection((entry,)).matches, (*recorded, *received)))
    ]
    if not robot.snapshot.bags or not missing:
        so_far = "all are recorded" if robot.snapshot.bags else "nothing is recorded yet"
        yield ok(f"{counted(len(selection.entries), 'entry', 'entries')} in the list; {so_far}")
        return
    for entry in missing:
        near = similar(entry, recorded, 2)
        hint = f"is it {' or '.join(near)}? " if near else ""
        do = "compare with `ros2 topic list`; a topic without a publisher is not recorded"
        yield warning(f"{entry} is in the list of topics, and was never recorded", f"{hint}{do}")


def check_server(settings: Settings) -> Iterator[Finding]:
    """Checks what the server's `/health` reports."""
    server = settings.server
    address = f"{server.host} port {server.port}"
    if server.transport == "stdio":
        yield ok("server.transport=stdio: each client starts its own server")
        return
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
    if status == http.HTTPStatus.UNAUTHORIZED:
        seen = f"the server on {address} takes another token than MEMORY_API_TOKEN"
        yield warning(seen, "give doctor the token that the server was started with")
    elif reply.get("status") == "ok":
        yield ok(f"ok on {address}")
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
    "poses": check_poses,
    "columns": check_columns,
}
_OF_RECORDER: Final = {
    "ros": check_ros,
    "recorder": check_recorder,
    "shipping": check_shipping,
    "topics": check_topics,
}
_OF_SETTINGS: Final = {"server": check_server}
"""The checks by their concerns, in the order in which they are printed."""
