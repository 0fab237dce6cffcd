"""`ros2-memory up`: proposes what to record on a robot, and records and serves it.

It finds out what is offered by two short real recordings. The recorder and the server are its
children; it shows what comes in.
"""

import os
import re
import signal
import sys
import time
from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Final, NamedTuple

import typer
import yaml

from ros2_memory.bag_dir.durable_write import write_durably
from ros2_memory.bag_dir.heartbeat import Heartbeat, read_heartbeat
from ros2_memory.bag_dir.layout import MEMORY_FOLDER, ROS_LOG_DIR
from ros2_memory.bootstrap import build_reader
from ros2_memory.cli.options import BagDir, Overrides, load_for
from ros2_memory.cli.output import (
    escape,
    format_duration,
    format_size,
    print_line,
    spinner,
)
from ros2_memory.cli.proposal import (
    INDEX_BYTES,
    MESSAGE_BYTES,
    Choice,
    Disk,
    Offered,
    Proposal,
    chosen,
    judge,
    propose,
    topics_yaml,
)
from ros2_memory.config import NullRecorderNode, config_dir, is_deployment_chosen
from ros2_memory.config_sources import given_variables, quoted
from ros2_memory.core.errors import ConfigError, RecorderError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.text import counted, listed
from ros2_memory.core.timebase import Ns, WallClock, unix_from_ns
from ros2_memory.recorder.process.child import Child, Patience, end_all
from ros2_memory.recorder.process.command import record_argv, storage_config
from ros2_memory.recorder.process.installation import (
    Installation,
    advice_on_rmw,
    advice_on_silence,
    find_installation,
    rmw_of,
    setup_files_here,
)
from ros2_memory.recorder.process.output import LineKind, parse_line
from ros2_memory.recorder.process.topics import TopicSelection, load_topics
from ros2_memory.recorder.reception import ALL_MESSAGES
from ros2_memory.recorder.supervisor import make_bag_dir
from ros2_memory.retention.policy import GB
from ros2_memory.storage.base import BagReader

SECONDS: Final = 5.0
"""How long topics are measured."""
EVERY_S: Final = 10.0
"""A line is printed so often, and when the state changes."""
_TICK_S: Final = 0.2
_PATIENCE: Final = Patience(interrupt_s=40.0, terminate_s=5.0)
"""The recorder waits for children of its own."""
_KEEP_FOR_A_YEAR: Final = (
    "Keep for a year where the robot drove, and what and whom it saw, after the recordings are "
    "deleted?"
)
LOOK_S: Final = 10.0
"""Topics are waited for so long; discovery takes 0.4 to 3 s on one machine."""
QUIET_S: Final = 2.0
"""No further topic is expected when none has appeared for so long."""
MAX_BYTES: Final = 100 * 2**20
LEAST_RATIO: Final = 0.05
CACHE_BYTES: Final = 16 * 2**20
_POLL_S: Final = 0.05
_EVERYTHING: Final = TopicSelection((*("/*" * n for n in range(1, 12)), "/*/_action/status"))
_OWN: Final = re.compile(r"^/(rosout|parameter_events)$|^/events/|^/rosbag2_|^/ros2_memory_up")
"""Topics that every recorder offers itself."""
_LOGGING: Final = ("logging.level=warning", "logging.format=pretty")


class Survey(NamedTuple):
    """What was found.

    Attributes:
        topics: those that others offer, in the order of their names.
        unknown_types: names of topics that cannot be recorded, for want of their definition.
        ratio: compressed bytes of a byte, over all that was recorded.
        fixed_bytes: what a file without a message has.
    """

    topics: Sequence[Offered]
    unknown_types: Sequence[str]
    ratio: float
    fixed_bytes: int


class _Robot(NamedTuple):
    """What was found on this machine; `words` are the settings for the recorder and the server."""

    ros: Installation
    bag_dir: Path
    list_file: Path
    words: list[str]

    @property
    def where(self) -> str:
        """Where topics are looked for."""
        return f"ROS_DOMAIN_ID={self.ros.env.get('ROS_DOMAIN_ID') or 0} over {rmw_of(self.ros.env)}"


def up(
    words: Overrides = None,
    *,
    bag_dir: BagDir = None,
    yes: Annotated[bool, "Record what is proposed, unasked."] = False,
    install: Annotated[bool, "Install as services, instead of starting here."] = False,
) -> bool:
    """Record this robot and answer questions about it, in one line, until Ctrl-C.

    Finds ROS 2, measures what its topics bring, proposes a topics.yaml beside the bags, and asks.
    A topics.yaml that is there is used, and never changed.
    """
    script = _install_script() if install else None
    words = [*([] if is_deployment_chosen(words or []) else ["deployment=robot"]), *(words or [])]
    settings, sources = load_for(bag_dir, words)
    if isinstance(settings.recorder, NullRecorderNode) or settings.server.transport == "stdio":
        raise ConfigError(
            "`up` records, and serves over HTTP: choose deployment=robot, or recorder=ros2bag and "
            "server.transport=sse"
        )
    bags = settings.recording.bag_dir.absolute()
    list_file = settings.recording.topics_file.absolute()
    shipped = config_dir({}) / "topics.yaml"
    is_chosen = not sources("recording.topics_file").startswith("in ")
    if not is_chosen and list_file.read_bytes() == shipped.read_bytes():
        list_file = bags / shipped.name
    robot = _find_robot(settings.recorder.setup_files, bags, list_file, words)
    print_line(f"{robot.ros.ros2}, {robot.where}, bags in {robot.bag_dir}")
    with spinner("looking which topics there are, and measuring them"):
        measured = survey(robot.ros, build_reader(settings), settings.recorder.chunk_bytes)
    disk = Disk(
        ratio=measured.ratio,
        fixed_bytes=measured.fixed_bytes,
        split_s=settings.recording.split_duration_s,
        session_s=settings.recording.session_duration_s,
        columns_share=settings.store.max_share if settings.store.enabled else 0.0,
        budget_bytes=settings.retention.max_total_gb * GB,
        keep_days=settings.retention.max_age_h / 24,
    )
    if robot.list_file.exists():
        _show_list(robot, measured, disk)
    else:
        _require_messages(robot, measured)
        _write_proposal(robot, measured, disk, yes=yes)
    is_open = not settings.memory.keep and sources("memory.keep").startswith("in ")
    if is_open and _may_keep_memory(bags, yes=yes):
        robot.words.append("memory.keep=true")
        if script is None:  # else the folder would not be that of the service's user
            (bags / MEMORY_FOLDER).mkdir(exist_ok=True)
    if script is not None:
        _hand_over(script, robot)
    return _run_programs(robot.words, robot.bag_dir)


def _find_robot(
    setup_files: Sequence[Path], bags: Path, list_file: Path, words: list[str]
) -> _Robot:
    """Finds ROS 2, and makes the folder of the bags.

    Raises:
        ConfigError: the environment is refused.
        RecorderError: there is no ROS 2, or nothing can be recorded there.
    """
    setup_files = setup_files_here(setup_files, os.environ)
    ros = find_installation(setup_files, bags / ROS_LOG_DIR)
    given_variables(ros.env)  # A setup file may set ROS_DOMAIN_ID.
    make_bag_dir(bags)
    if not os.access(bags, os.W_OK | os.X_OK):
        raise RecorderError(
            f"{bags} cannot be written by this user; name another folder with --bag-dir DIR, or "
            "run as the user who owns it"
        )
    files = ",".join(quoted(str(file.absolute())) for file in setup_files)
    more = [
        f"recording.bag_dir={quoted(str(bags))}",
        f"recording.topics_file={quoted(str(list_file))}",
        f"recorder.setup_files=[{files}]",
    ]
    return _Robot(ros, bags, list_file, [*words, *more])


def _require_messages(robot: _Robot, measured: Survey) -> None:
    """Checks that there is something to propose, and that it can be received.

    Raises:
        RecorderError: there is not; the sentence says what to do.
    """
    light = chosen(judge(measured.topics), Choice.RECORD)
    if not measured.topics and not measured.unknown_types:
        advice = advice_on_rmw(robot.ros.env)
        raise RecorderError(
            f"no topic is offered in {robot.where} (waited {LOOK_S:g} s); start the robot's nodes, "
            "and give this command their ROS_DOMAIN_ID, RMW_IMPLEMENTATION and "
            f"ROS_AUTOMATIC_DISCOVERY_RANGE{f'; {advice}' if advice else ''}"
        )
    if light and not any(topic.messages for topic in light):
        raise RecorderError(
            f"{counted(len(light), 'topic is', 'topics are')} offered in {robot.where}, and no "
            f"message came to user {os.getuid()} in {SECONDS:g} s; "
            f"{advice_on_silence(robot.ros.env)}"
        )


def _write_proposal(robot: _Robot, measured: Survey, disk: Disk, *, yes: bool) -> None:
    """Shows the proposal, asks, and writes it.

    Raises:
        RecorderError: nothing is proposed, or the list cannot be written.
    """
    proposal = propose(measured.topics, disk)
    recorded = chosen(proposal, Choice.RECORD)
    takes = _print_topics(proposal, disk, recorded, measured)
    if not recorded:
        raise RecorderError(
            "nothing of this is proposed; write a list of topics, and name it with "
            "recording.topics_file=FILE"
        )
    if not yes:
        question = f"Write {counted(len(recorded), 'topic')} to {robot.list_file}, and record?"
        typer.confirm(question, default=True, abort=True)
    try:
        write_durably(robot.list_file, topics_yaml(proposal, takes))
    except OSError as error:
        raise RecorderError(
            f"{robot.list_file} cannot be written: {error.strerror or error}; name another file "
            "with recording.topics_file=FILE"
        ) from error
    print_line(f"wrote {robot.list_file}")


def _may_keep_memory(bags: Path, *, yes: bool) -> bool:
    """Returns whether something of the bags is to outlive them: only a person says so, once."""
    if (bags / MEMORY_FOLDER).is_dir():
        print_line(f"{bags / MEMORY_FOLDER} goes on: memory.keep=false would delete it")
        return True
    if yes or not sys.stdin.isatty():
        return False
    if typer.confirm(_KEEP_FOR_A_YEAR, default=False):
        return True
    print_line("no such memory is kept; with memory.keep=false `up` does not ask")
    return False


def _show_list(robot: _Robot, measured: Survey, disk: Disk) -> None:
    """Shows what a list that is there selects, and what it lacks.

    Raises:
        ConfigError: it is refused.
    """
    selection = load_topics(robot.list_file)
    proposal = propose(measured.topics, disk)
    recorded = [topic for topic in measured.topics if selection.matches(topic.topic)]
    _print_topics(proposal, disk, recorded, measured)
    print_line(f"{robot.list_file} is used as it is")
    missing = [topic.topic for topic in chosen(proposal, Choice.RECORD) if topic not in recorded]
    if missing:
        print_line(f"it lacks, of what would be proposed: {', '.join(missing)}")


def _print_topics(proposal: Proposal, disk: Disk, recorded: list[Offered], measured: Survey) -> str:
    """Prints a line for each topic, and returns the estimate, as a sentence, after printing it."""
    width = max((len(topic.topic) for topic in proposal), default=0)
    for topic, (choice, reason) in proposal.items():
        sign = "record" if topic in recorded else choice.replace("record", "-")
        rate = f"{topic.hz:8.3g} Hz {topic.payload_bytes:7.0f} B" if topic.messages else ""
        daily = f"{format_size(disk.bytes_per_day([topic]))} a day" if topic.messages else ""
        detail = f"{topic.type}{f': {reason}' if reason and topic not in recorded else ''}"
        print_line(escape(f"  {sign:<7}{topic.topic:<{width}}{rate:<21}{daily:>17}  {detail}"))
    files = disk.file_bytes_per_day
    silent = [topic.topic for topic in recorded if not topic.messages]
    takes = (
        f"about {format_size(disk.bytes_per_day(recorded) + files)} a day"
        f"{f' without {listed(silent)}' if silent else ''}, {format_size(files)} of it for files "
        f"of {disk.split_s:g} s: the budget of {format_size(disk.budget_bytes)} "
        f"(retention.max_total_gb) holds {disk.days(recorded):.3g} days; bags are deleted after "
        f"{disk.keep_days:g} days (retention.max_age_h)"
    )
    print_line(takes)
    if measured.unknown_types:
        print_line(
            f"ros2 bag record does not know the types of {listed(measured.unknown_types)}; name "
            "the setup.bash of their workspace, too: recorder.setup_files=[FILE,FILE]"
        )
    return takes


def _install_script() -> Path:
    """Returns the path of deploy/install.sh.

    Raises:
        ConfigError: it is not here.
    """
    for folder in (Path(__file__).resolve().parents[3], Path.cwd()):
        script = folder / "deploy/install.sh"
        if script.is_file():
            return script
    raise ConfigError("deploy/install.sh is not here; run `up --install` in a clone of ros2-memory")


def _hand_over(script: Path, robot: _Robot) -> None:
    """Becomes deploy/install.sh, which installs the services with this list of topics."""
    print_line(f"to be set in /etc/ros2-memory/environment: {robot.words[-1]}")
    program = "sudo" if os.geteuid() else "env"
    argv = [program, f"PYTHON={sys.executable}", str(script), "--topics", str(robot.list_file)]
    print_line(" ".join(argv))
    os.execvp(program, argv)  # noqa: S606 - there is nothing for a shell to do


def _run_programs(words: Sequence[str], bag_dir: Path) -> bool:
    """Records and serves until Ctrl-C, and returns whether a program ended itself, or did not end.

    Whatever happens, both are ended, and waited for.
    """
    # A shell that starts this in the background has it ignored.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    programs: dict[str, Child] = {}
    died = ""
    modules = {"recorder": ["recorder"], "server": ["server", "--page", "print"]}
    try:
        for name, (module, *options) in modules.items():
            argv = ["-P", "-m", f"ros2_memory.{module}", *options, *words, *_LOGGING]
            programs[name] = Child.start([sys.executable, *argv], os.environ, patience=_PATIENCE)
        died = _watch(programs, bag_dir)
    except KeyboardInterrupt:
        pass
    finally:
        # A second Ctrl-C would leave them behind; how long they may take is bounded.
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, signal.SIG_IGN)
        left = end_all(programs.values())
    if died:
        print(f"ros2-memory up: {died}", file=sys.stderr)
    elif not left:
        print_line(f"recorder and server have ended; the bags are in {bag_dir}")
    return bool(left or died)


def _watch(programs: Mapping[str, Child], bag_dir: Path) -> str:
    """Shows what comes in, until a program ends; returns which one, and its last words."""
    before, due_s = "", 0.0
    last = dict.fromkeys(programs, "it gave no reason")
    while True:
        for name, child in programs.items():
            status = child.exit_status()
            for line in filter(None, map(escape, child.take_lines())):
                if "http://" not in line:  # the address of the page is no reason
                    last[name] = line
                print_line(f"{name}: {line}")
            if status is not None:
                return f"the {name} ended with status {status}: {last[name]}"
        beat = read_heartbeat(bag_dir).heartbeat
        if beat is not None and beat.pid == programs["recorder"].pid:
            heard = len({*beat.subscribed} - {*beat.silent})
            if before != (before := f"{beat.state} {heard}") or time.monotonic() >= due_s:
                due_s = time.monotonic() + EVERY_S
                print_line(escape(_line_of(beat, heard)))
        time.sleep(_TICK_S)


def _line_of(beat: Heartbeat, heard: int) -> str:
    """Returns a line on what the recorder does, and on how many topics it has heard."""
    for_s = unix_from_ns(WallClock().now() - beat.since)
    line = f"recorder: {beat.state} for {format_duration(for_s)}, {counted(heard, 'topic')}"
    why = beat.waiting_for or (None if beat.recovered else beat.last_error)
    if beat.silent:
        line += f", silent: {listed(beat.silent)}"
    return f"{line}, {format_size(beat.bytes_written)}{f'; {why}' if why else ''}"


def survey(ros: Installation, reader: BagReader, chunk_bytes: int) -> Survey:
    """Finds out which topics there are, and how much comes on each, by two short real recordings.

    The first is paused: it lists all topics with their types, and writes no message. The second
    records those that are not left out by their type, for some seconds and a bounded number of
    bytes. Must be called from the main thread, as every child is.

    Raises:
        BagError: what was recorded cannot be read.
        RecorderError: `ros2 bag record` fails; the sentence has its last words.
    """
    with TemporaryDirectory(prefix="ros2-memory-up-") as name:
        folder = Path(name)
        (folder / "qos.yaml").write_text(yaml.safe_dump({"/tf_static": ALL_MESSAGES}))
        (folder / "storage.yaml").write_text(storage_config(chunk_bytes))
        unknown, empty = _record(
            ros, folder / "look", _EVERYTHING, QUIET_S, options=("--start-paused",)
        )
        offered = {
            channel.topic: Offered(
                channel.topic, re.sub(r"[^\w/]", "?", channel.type), channel.latched
            )
            for channel in reader.channels(empty)
            if not _OWN.match(channel.topic)
        }
        # Neither pixels nor what people say is recorded even now.
        light = tuple(topic.topic for topic in chosen(judge(offered.values()), Choice.RECORD))
        fixed, ratio = empty.stat().st_size, 1.0
        if light:
            _, bag = _record(ros, folder / "measure", TopicSelection(light), SECONDS, light)
            ratio = _measure(reader, bag, offered, fixed)
    return Survey([offered[topic] for topic in sorted(offered)], sorted(unknown), ratio, fixed)


def _measure(reader: BagReader, bag: Path, offered: dict[str, Offered], fixed: int) -> float:
    """Adds to the topics how they came in a bag; returns by how much the bag is compressed."""
    sizes, times = defaultdict[str, list[int]](list), defaultdict[str, list[Ns]](list)
    for batch in reader.batches(bag, offered, TimeWindow.everything()):
        sizes[batch.channel.topic] += batch.sizes.tolist()
        times[batch.channel.topic] += batch.log_times.tolist()
    end = max(map(max, times.values()), default=0)
    for topic, payloads in sizes.items():
        # A topic is heard from its first message on: others may have been subscribed to before.
        span_s = unix_from_ns(end - min(times[topic]))
        count, total = len(payloads), sum(payloads)
        hz = (count - 1) / span_s if count > 1 and span_s else 1 / max(span_s, 1.0)
        offered[topic] = replace(offered[topic], messages=count, hz=hz, payload_bytes=total / count)
    count = sum(map(len, sizes.values()))
    payload = sum(map(sum, sizes.values())) + count * MESSAGE_BYTES
    stored = bag.stat().st_size - fixed - INDEX_BYTES * count
    return min(max(stored / payload, LEAST_RATIO), 1.0) if payload else 1.0


def _record(
    ros: Installation,
    directory: Path,
    topics: TopicSelection,
    quiet_s: float,
    expected: Collection[str] = (),
    *,
    options: Sequence[str] = (),
) -> tuple[set[str], Path]:
    """Records until all that is expected (else anything) came, and nothing new for `quiet_s`.

    Returns the topics of unknown types, and the file.
    """
    argv = record_argv(
        ros2=ros.ros2,
        directory=directory,
        topics=topics,
        split_duration_s=3600,
        qos_file=directory.with_name("qos.yaml"),
        storage_file=directory.with_name("storage.yaml"),
        node_name="ros2_memory_up",
        cache_bytes=CACHE_BYTES,
        known_options=ros.options,
    )
    child = Child.start([*argv, *options], {**ros.env, "ROS_LOG_DIR": str(directory.parent)})
    heard: dict[LineKind, set[str]] = {LineKind.SUBSCRIBED: set(), LineKind.UNKNOWN_TYPE: set()}
    lines: list[str] = []
    began = changed = time.monotonic()
    try:
        while child.exit_status() is None and time.monotonic() < began + LOOK_S + quiet_s:
            for line in map(parse_line, child.take_lines()):
                lines.append(line.text)
                if line.topic and line.kind in heard and not _OWN.match(line.topic):
                    heard[line.kind].add(line.topic)
                    changed = time.monotonic()
            subscribed = heard[LineKind.SUBSCRIBED]
            has_all = subscribed and subscribed.issuperset(expected)
            if has_all and time.monotonic() > changed + quiet_s:
                break
            if sum(file.stat().st_size for file in directory.glob("*")) > MAX_BYTES:
                break
            time.sleep(_POLL_S)
        failed = child.exit_status()
    finally:
        end_all([child])
    file = next(directory.glob("*.mcap"), None)
    if failed is not None or file is None:
        words = "; ".join([*lines, *child.take_lines()][-3:])
        raise RecorderError(
            f"ros2 bag record ended by itself (status {failed}): {words}; `ros2-memory doctor` "
            "checks the installation"
        )
    return heard[LineKind.UNKNOWN_TYPE], file
