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
from ros2_memory.cli.options import BagDir, Overrides
from ros2_memory.cli.output import (
    escape,
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
    judge,
    propose,
    select,
    topics_yaml,
)
from ros2_memory.config import (
    NullRecorderNode,
    Settings,
    config_dir,
    is_deployment_chosen,
    load_explained,
)
from ros2_memory.config_sources import given_variables, quoted
from ros2_memory.core.errors import ConfigError, RecorderError
from ros2_memory.core.model import MCAP, TimeWindow
from ros2_memory.core.text import counted, listed
from ros2_memory.core.timebase import Ns, iso_local, unix_from_ns
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
_SET_BY_UNITS: Final = re.compile(r"deployment=robot$|recording\.(bag_dir|topics_file)=")
"""Settings that the installed services have."""


class Survey(NamedTuple):
    """The topics that a robot offers, measured.

    Attributes:
        topics: by name; without those that a recorder offers itself.
        ratio: compressed bytes of a byte, over all that was recorded.
        fixed_bytes: the size of a file without messages.
    """

    topics: Sequence[Offered]
    ratio: float
    fixed_bytes: int


class _Robot(NamedTuple):
    """ROS 2 and the files of this machine; `words` are settings for the recorder and the server."""

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
    words = [*(words or ())]
    if not is_deployment_chosen(words):
        words.insert(0, "deployment=robot")
    if bag_dir is not None:
        words.append(f"recording.bag_dir={quoted(str(bag_dir.absolute()))}")
    settings, sources = load_explained(words)
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
        survey = survey_topics(robot.ros, build_reader(settings), settings.recorder.chunk_bytes)
    disk = _disk_of(settings, survey)
    if robot.list_file.exists():
        _show_list(robot, survey, disk)
    else:
        _require_messages(robot, survey)
        _write_proposal(robot, survey, disk, yes=yes)
    is_undecided = not settings.memory.keep and sources("memory.keep").startswith("in ")
    if is_undecided and _may_keep_memory(bags, yes=yes):
        robot.words.append("memory.keep=true")
        if script is None:  # else the folder would not be that of the service's user
            (bags / MEMORY_FOLDER).mkdir(exist_ok=True)
    if script is not None:
        _become_installer(script, robot)
    return _run_programs(robot.words, robot.bag_dir)


def _disk_of(settings: Settings, survey: Survey) -> Disk:
    return Disk(
        ratio=survey.ratio,
        fixed_bytes=survey.fixed_bytes,
        split_s=settings.recording.split_duration_s,
        session_s=settings.recording.session_duration_s,
        columns_share=settings.store.max_share if settings.store.enabled else 0.0,
        budget_bytes=settings.retention.max_total_gb * GB,
        keep_days=settings.retention.max_age_h / 24,
    )


def _find_robot(
    setup_files: Sequence[Path], bags: Path, list_file: Path, words: Sequence[str]
) -> _Robot:
    """Finds ROS 2, and makes the folder of the bags.

    Raises:
        ConfigError: the environment is refused.
        RecorderError: ROS 2 is not found, or the folder cannot be written.
    """
    setup_files = setup_files_here(setup_files, os.environ)
    ros = find_installation(setup_files, bags / ROS_LOG_DIR)
    given_variables(ros.env)  # a setup file may set ROS_DOMAIN_ID
    make_bag_dir(bags)
    if not os.access(bags, os.W_OK | os.X_OK):
        raise RecorderError(
            f"{bags} cannot be written by this user; name another folder with --bag-dir DIR, or "
            "run as the user who owns it"
        )
    files = ",".join(quoted(str(file.absolute())) for file in setup_files)
    own_words = [
        f"recording.bag_dir={quoted(str(bags))}",
        f"recording.topics_file={quoted(str(list_file))}",
        f"recorder.setup_files=[{files}]",
    ]
    return _Robot(ros, bags, list_file, [*words, *own_words])


def _require_messages(robot: _Robot, survey: Survey) -> None:
    """Checks that topics are offered, and that their messages are received.

    Raises:
        RecorderError: they are not; the sentence says what to do.
    """
    light = select(judge(survey.topics), Choice.RECORD)
    if not survey.topics:
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


def _write_proposal(robot: _Robot, survey: Survey, disk: Disk, *, yes: bool) -> None:
    """Shows the proposal, asks, and writes it.

    Raises:
        RecorderError: nothing is proposed, or the list cannot be written.
    """
    proposal = propose(survey.topics, disk)
    recorded = select(proposal, Choice.RECORD)
    _print_topics(proposal, disk, recorded)
    if not recorded:
        raise RecorderError(
            "nothing of this is proposed; write a list of topics, and name it with "
            "recording.topics_file=FILE"
        )
    if not yes:
        question = f"Write {counted(len(recorded), 'topic')} to {robot.list_file}, and record?"
        typer.confirm(question, default=True, abort=True)
    try:
        write_durably(robot.list_file, topics_yaml(proposal, _describe_estimate(disk, recorded)))
    except OSError as error:
        raise RecorderError(
            f"{robot.list_file} cannot be written: {error.strerror or error}; name another file "
            "with recording.topics_file=FILE"
        ) from error
    print_line(f"wrote {robot.list_file}")


def _may_keep_memory(bags: Path, *, yes: bool) -> bool:
    """Returns whether `memory.keep` may be set: if it was before, or a person now says so."""
    if (bags / MEMORY_FOLDER).is_dir():
        print_line(f"{bags / MEMORY_FOLDER} goes on: memory.keep=false would delete it")
        return True
    if yes or not sys.stdin.isatty():
        return False
    return typer.confirm(_KEEP_FOR_A_YEAR, default=False)


def _show_list(robot: _Robot, survey: Survey, disk: Disk) -> None:
    """Shows which topics an existing list selects, and which it lacks.

    Raises:
        ConfigError: the list is refused.
    """
    selection = load_topics(robot.list_file)
    proposal = propose(survey.topics, disk)
    recorded = [topic for topic in survey.topics if selection.matches(topic.topic)]
    _print_topics(proposal, disk, recorded)
    print_line(f"{robot.list_file} is used as it is")
    missing = [topic.topic for topic in select(proposal, Choice.RECORD) if topic not in recorded]
    if missing:
        print_line(f"it lacks, of what would be proposed: {', '.join(missing)}")


def _print_topics(proposal: Proposal, disk: Disk, recorded: Sequence[Offered]) -> None:
    """Prints a line for each topic, and what the recorded ones take."""
    width = max((len(topic.topic) for topic in proposal), default=0)
    for topic, verdict in proposal.items():
        sign, detail = "record", topic.type
        if topic not in recorded:
            sign = "-" if verdict.choice is Choice.RECORD else verdict.choice
            detail += f": {verdict.reason}" if verdict.reason else ""
        rate = daily = ""
        if topic.messages:
            rate = f"{topic.hz:8.3g} Hz {topic.payload_bytes:7.0f} B"
            daily = f"{format_size(disk.bytes_per_day([topic]))} a day"
        print_line(escape(f"  {sign:<7}{topic.topic:<{width}}{rate:<21}{daily:>17}  {detail}"))
    print_line(_describe_estimate(disk, recorded))


def _describe_estimate(disk: Disk, recorded: Sequence[Offered]) -> str:
    """Returns a sentence on the bytes that topics take a day, and how long the budget lasts."""
    files = disk.file_bytes_per_day
    silent = [topic.topic for topic in recorded if not topic.messages]
    return (
        f"about {format_size(disk.bytes_per_day(recorded) + files)} a day"
        f"{f' without {listed(silent)}' if silent else ''}, {format_size(files)} of it for files "
        f"of {disk.split_s:g} s: the budget of {format_size(disk.budget_bytes)} "
        f"(retention.max_total_gb) holds {disk.days(recorded):.3g} days; bags are deleted after "
        f"{disk.keep_days:g} days (retention.max_age_h)"
    )


def _install_script() -> Path:
    """Returns the path of deploy/install.sh in this clone or the working directory.

    Raises:
        ConfigError: neither has it.
    """
    for folder in (Path(__file__).resolve().parents[3], Path.cwd()):
        script = folder / "deploy/install.sh"
        if script.is_file():
            return script
    raise ConfigError("deploy/install.sh is not here; run `up --install` in a clone of ros2-memory")


def _become_installer(script: Path, robot: _Robot) -> None:
    """Replaces this process by deploy/install.sh, which installs services for this list."""
    words = [word for word in robot.words if not _SET_BY_UNITS.match(word)]
    print_line(f"to be set in /etc/ros2-memory/environment: {' '.join(words)}")
    program = "sudo" if os.geteuid() else "env"
    argv = [program, f"PYTHON={sys.executable}", str(script), "--topics", str(robot.list_file)]
    print_line(" ".join(argv))
    os.execvp(program, argv)  # noqa: S606 - there is nothing for a shell to do


def _run_programs(words: Sequence[str], bag_dir: Path) -> bool:
    """Records and serves until Ctrl-C; ends both programs, and waits for them, in any case.

    Returns whether a program ended by itself, or could not be ended.
    """
    # A shell that starts this in the background has it ignored.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    programs: dict[str, Child] = {}
    died = ""
    modules = {"recorder": [], "server": ["--page", "print"]}
    try:
        for name, options in modules.items():
            argv = ["-P", "-m", f"ros2_memory.{name}", *options, *words, *_LOGGING]
            programs[name] = Child.start([sys.executable, *argv], os.environ, patience=_PATIENCE)
        died = _show_until_one_ends(programs, bag_dir)
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


def _show_until_one_ends(programs: Mapping[str, Child], bag_dir: Path) -> str:
    """Shows what is recorded until a program ends; returns which one."""
    shown, due_s = "", 0.0
    while True:
        for name, child in programs.items():
            status = child.exit_status()
            for line in filter(None, map(escape, child.take_lines())):
                print_line(f"{name}: {line}")
            if status is not None:
                return f"the {name} ended with status {status}"
        heartbeat = read_heartbeat(bag_dir).heartbeat
        if heartbeat is not None and heartbeat.pid == programs["recorder"].pid:
            topics = len({*heartbeat.subscribed} - {*heartbeat.silent})
            state = f"{heartbeat.state} {topics}"
            if state != shown or time.monotonic() >= due_s:
                shown, due_s = state, time.monotonic() + EVERY_S
                print_line(escape(_describe_recorder(heartbeat, topics)))
        time.sleep(_TICK_S)


def _describe_recorder(heartbeat: Heartbeat, topics: int) -> str:
    """Returns a line on the recorder's state, and the number of topics that it receives."""
    since = iso_local(heartbeat.since)
    line = f"recorder: {heartbeat.state} since {since}, {counted(topics, 'topic')}"
    if heartbeat.silent:
        line += f", silent: {listed(heartbeat.silent)}"
    line += f", {format_size(heartbeat.bytes_written)}"
    why = heartbeat.waiting_for or (None if heartbeat.recovered else heartbeat.last_error)
    return f"{line}; {why}" if why else line


def survey_topics(ros: Installation, reader: BagReader, chunk_bytes: int) -> Survey:
    """Finds out which topics there are, and how much comes on each, by two short real recordings.

    The first is paused: it lists all topics with their types, and writes no message. The second
    records those whose types are light, for some seconds and a bounded number of bytes. Must be
    called from the main thread, as every child is.

    Raises:
        BagError: a recording cannot be read.
        RecorderError: `ros2 bag record` fails; the sentence has its last words.
    """
    with TemporaryDirectory(prefix="ros2-memory-up-") as name:
        folder = Path(name)
        (folder / "qos.yaml").write_text(yaml.safe_dump({"/tf_static": ALL_MESSAGES}))
        (folder / "storage.yaml").write_text(storage_config(chunk_bytes))
        empty = _record(ros, folder / "look", _EVERYTHING, QUIET_S, options=("--start-paused",))
        offered = {
            channel.topic: Offered(
                channel.topic, re.sub(r"[^\w/]", "?", channel.type), channel.latched
            )
            for channel in reader.channels(empty)
            if not _OWN.match(channel.topic)
        }
        # Neither pixels nor what people say is recorded even now.
        light = tuple(topic.topic for topic in select(judge(offered.values()), Choice.RECORD))
        fixed, ratio = empty.stat().st_size, 1.0
        if light:
            bag = _record(ros, folder / "measure", TopicSelection(light), SECONDS, light)
            topics, ratio = _measure(reader, bag, offered, fixed)
            offered |= topics
    return Survey([offered[topic] for topic in sorted(offered)], ratio, fixed)


def _measure(
    reader: BagReader, bag: Path, offered: Mapping[str, Offered], fixed_bytes: int
) -> tuple[dict[str, Offered], float]:
    """Returns the topics in a bag with their rates and sizes, and how much the bag is compressed.

    That is the compressed bytes of a byte, from `LEAST_RATIO` to 1.
    """
    sizes, times = defaultdict[str, list[int]](list), defaultdict[str, list[Ns]](list)
    for batch in reader.batches(bag, offered, TimeWindow.everything()):
        sizes[batch.channel.topic] += batch.sizes.tolist()
        times[batch.channel.topic] += batch.log_times.tolist()
    end = max(map(max, times.values()), default=0)
    measured: dict[str, Offered] = {}
    messages = payload_bytes = 0
    for topic, payloads in sizes.items():
        # A topic is heard from its first message on: others may have been subscribed to before.
        span_s = unix_from_ns(end - min(times[topic]))
        count, total = len(payloads), sum(payloads)
        hz = (count - 1) / span_s if count > 1 and span_s else 1 / max(span_s, SECONDS)
        measured[topic] = replace(
            offered[topic], messages=count, hz=hz, payload_bytes=total / count
        )
        messages += count
        payload_bytes += total
    if not messages:
        return measured, 1.0
    stored = bag.stat().st_size - fixed_bytes - INDEX_BYTES * messages
    ratio = stored / (payload_bytes + MESSAGE_BYTES * messages)
    return measured, min(max(ratio, LEAST_RATIO), 1.0)


def _record(
    ros: Installation,
    directory: Path,
    topics: TopicSelection,
    quiet_s: float,
    expected: Collection[str] = (),
    *,
    options: Sequence[str] = (),
) -> Path:
    """Records until all expected topics (or any) are subscribed, and no further one for `quiet_s`.

    Returns the bag file.

    Raises:
        RecorderError: `ros2 bag record` ended by itself, or wrote no file.
    """
    argv = record_argv(
        ros2=ros.ros2,
        directory=directory,
        topics=topics,
        split_duration_s=3600,  # longer than any of these recordings
        qos_file=directory.with_name("qos.yaml"),
        storage_file=directory.with_name("storage.yaml"),
        node_name="ros2_memory_up",
        cache_bytes=CACHE_BYTES,
        known_options=ros.options,
    )
    child = Child.start([*argv, *options], {**ros.env, "ROS_LOG_DIR": str(directory.parent)})
    subscribed = set[str]()
    lines: list[str] = []
    began = changed = time.monotonic()
    try:
        while child.exit_status() is None and time.monotonic() < began + LOOK_S + quiet_s:
            for line in map(parse_line, child.take_lines()):
                lines.append(line.text)
                topic = line.topic if line.kind is LineKind.SUBSCRIBED else None
                if topic and not _OWN.match(topic):
                    subscribed.add(topic)
                    changed = time.monotonic()
            has_all = subscribed and subscribed.issuperset(expected)
            if has_all and time.monotonic() > changed + quiet_s:
                break
            if sum(file.stat().st_size for file in directory.glob("*")) > MAX_BYTES:
                break
            time.sleep(_POLL_S)
        status = child.exit_status()
    finally:
        end_all([child])
    file = next(directory.glob(f"*{MCAP}"), None)
    if status is not None or file is None:
        words = "; ".join([*lines, *child.take_lines()][-3:])
        raise RecorderError(
            f"ros2 bag record ended by itself (status {status}): {words}; `ros2-memory doctor` "
            "checks the installation"
        )
    return file
