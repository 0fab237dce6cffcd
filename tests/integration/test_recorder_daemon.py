"""The recorder's program, run whole over a stand-in for `ros2`: `tests/support/stub_ros2.py`.

Moments take both programs: a planner asks the server, and the daemon keeps.
"""

import io
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest

from ros2_memory.bag_dir.heartbeat import Heartbeat, RecorderState, read_heartbeat
from ros2_memory.bag_dir.layout import REQUESTS_FOLDER
from ros2_memory.bag_dir.moment_file import StoredMoment, stored_moments_in
from ros2_memory.config_sources import quoted
from ros2_memory.recorder.__main__ import main
from ros2_memory.storage.mcap_reader import McapReader
from tests.support import stub_ros2
from tests.support.bags import McapLayout, odom, write_mcap
from tests.support.forked_commands import Forked
from tests.support.housekeepers import own_all
from tests.support.live_recorder import LiveRecorder, answer
from tests.support.processes import PATIENCE_S, service_manager, until
from tests.support.served import Served, serving
from tests.support.simulated_recorders import published
from tests.timing import each_in_time

PERIOD_NS = 10_000_000


class Site:
    """A machine with a `ros2` program, on which daemons are started.

    `synchronised` holds what its `timedatectl` prints of the clock: yes or no.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.bag_dir = folder / "bags"
        self.topics = folder / "topics.yaml"
        self.topics.write_text("topics: [/odom, /tf]\n")
        self.daemons: list[LiveRecorder] = []
        programs = folder / "bin"
        programs.mkdir()
        stub_ros2.install(programs / "ros2")
        self.synchronised = folder / "synchronised"
        self.synchronised.write_text("yes\n")
        timedatectl = programs / "timedatectl"
        timedatectl.write_text(f"#!/bin/sh\nexec cat {self.synchronised}\n")
        timedatectl.chmod(0o755)
        self.env = {
            **os.environ,
            "PATH": f"{programs}:{os.environ['PATH']}",
            "STUB_PERIOD_MS": str(PERIOD_NS // 10**6),
        }
        self.settings = (
            f"recording.bag_dir={self.bag_dir}",
            f"recording.topics_file={self.topics}",
            "recording.split_duration_s=1",
            "recording.session_duration_s=3600",
            "retention.min_free_gb=0",
        )

    def run(self, *overrides: str, wait: bool = True) -> LiveRecorder:
        log = self.folder / f"log{len(self.daemons)}"
        given = (*self.settings, *overrides)
        with log.open("wb") as stream:
            process = Forked("ros2-memory-recorder", *given, env=self.env, stderr=stream)
        daemon = LiveRecorder(self.bag_dir, log, process)
        self.daemons.append(daemon)
        if wait:
            daemon.wait_for_state(RecorderState.RECORDING)
        return daemon

    def old_bag(self) -> Path:
        """A bag that was recorded before, by somebody."""
        old = self.bag_dir / "rec_old" / "rec_old_0.mcap"
        old.parent.mkdir(parents=True)
        old.write_bytes(b"old")
        return old

    def refusal(self, *overrides: str) -> tuple[int, str]:
        """Exit code and output of a daemon that does not begin."""
        daemon = self.run(*overrides, wait=False)
        return daemon.process.wait(PATIENCE_S), daemon.log.read_text()

    def refusal_here(self, *overrides: str) -> tuple[object, str]:
        """The same in this process."""
        said = io.StringIO()
        with patch.dict(os.environ, self.env, clear=True), redirect_stderr(said):
            try:
                code: object = main([*self.settings, *overrides])
            except SystemExit as ended:
                code = ended.code
        return code, said.getvalue()


@contextmanager
def sited(folder: Path) -> Iterator[Site]:
    """A site on which no daemon is left running."""
    site = Site(folder)
    try:
        yield site
    finally:
        for daemon in site.daemons:
            if daemon.process.poll() is None:
                daemon.stop()


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    with sited(tmp_path) as site:
        yield site


def assert_nothing_lost_or_doubled(bag_dir: Path) -> None:
    stands, counts = (published(bag_dir, "/odom", counting=each) for each in (False, True))
    assert counts == dict.fromkeys(stands, 1)
    assert len(stands) == (max(stands) - min(stands)) // PERIOD_NS + 1


@each_in_time
def test_over_rotations_no_message_is_lost_or_counts_twice(tmp_path: Path) -> None:
    """Both recorders receive within a second what both of them record."""
    with sited(tmp_path) as site:
        daemon = site.run("recording.session_duration_s=2")
        daemon.wait_for("rotated", 3)
        daemon.stop()
    assert_nothing_lost_or_doubled(site.bag_dir)
    twice = [
        times for times in published(site.bag_dir, "/odom", counting=False).values() if times > 1
    ]
    assert len(twice) > 3 * 100
    beat = read_heartbeat(site.bag_dir).heartbeat
    assert beat is not None
    assert (beat.state, beat.recordings, beat.last_error) == (RecorderState.STOPPED, (), None)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_a_signal_ends_it_and_every_file_is_complete(site: Site, number: int) -> None:
    daemon = site.run()
    daemon.wait_for("split_closed")
    child = daemon.child
    daemon.stop(number)
    assert not Path(f"/proc/{child}").exists()
    (starting,) = daemon.events("starting")
    assert str(site.topics) in starting["files"]
    (recording,) = daemon.recordings()
    assert (recording / "metadata.yaml").exists()
    states = {McapReader().is_finished(path) for path in recording.glob("*.mcap")}
    assert states == {True}


def test_what_a_crash_left_is_repaired_and_bags_of_another_program_outlive_every_limit(
    site: Site,
) -> None:
    messages = [odom(10**18 + number, 1.0, 2.0) for number in range(9)]
    left_open = McapLayout(chunk_size=99, finish=False)
    crashed = write_mcap(site.bag_dir / "rec_crashed" / "0.mcap", messages, left_open)
    own_all(site.bag_dir)
    folder = site.bag_dir / "session_mcap"
    write_mcap(folder / "session_mcap_0.mcap", messages)
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information: {}\n")
    before = {path: path.read_bytes() for path in folder.iterdir()}
    daemon = site.run("retention.max_total_gb=0.000001", "retention.max_age_h=0.001")
    daemon.wait_for("foreign_bags_kept")
    until(lambda: any(event["bags"] for event in daemon.events("retention_applied")))
    [repaired] = daemon.events("bag_repaired")
    daemon.stop()
    assert (repaired["path"], crashed.exists()) == (str(crashed), False)
    assert {path: path.read_bytes() for path in folder.iterdir()} == before


@each_in_time
def test_one_that_starts_while_the_child_of_a_killed_one_still_closes_waits_for_it(
    tmp_path: Path,
) -> None:
    """Not for ever: it gives up after 15 s."""
    with sited(tmp_path) as site:
        daemon = site.run()
        child = daemon.child
        os.kill(child, signal.SIGSTOP)
        daemon.process.kill()
        daemon.process.wait()
        following = site.run(wait=False)
        with pytest.raises(subprocess.TimeoutExpired):
            following.process.wait(1)
        assert following.events("recorder_started") == []
        os.kill(child, signal.SIGCONT)
        following.wait_for_state(RecorderState.RECORDING)
        following.stop()


def test_the_service_manager_is_told(site: Site) -> None:
    address = site.folder / "notify"
    with service_manager(address) as manager:
        site.env |= {"NOTIFY_SOCKET": str(address), "WATCHDOG_USEC": "1000000"}
        daemon = site.run(wait=False)
        assert manager.recv(100) == b"READY=1"
        assert manager.recv(100) == b"WATCHDOG=1"
        assert manager.recv(100) == b"WATCHDOG=1"
        daemon.stop()
        told = b""
        while told != b"STOPPING=1":
            told = manager.recv(100)
        assert "NOTIFY_SOCKET" not in Path(f"/proc/{os.getpid()}/environ").read_text()


def test_the_child_has_the_robots_environment_and_does_what_newer_distributions_can(
    site: Site,
) -> None:
    setup = site.folder / "setup.bash"
    setup.write_text("export FROM_SETUP=yes\n")
    site.env |= {"ROS_DOMAIN_ID": "42", "VIRTUAL_ENV": "/of/ours", "PYTHONHOME": sys.base_prefix}
    site.env["STUB_OPTIONS"] = "--stats_max_publishing_rate"
    daemon = site.run(f"recorder.setup_files=[{setup}]")
    environ = Path(f"/proc/{daemon.child}/environ").read_bytes().split(b"\0")
    assert {b"FROM_SETUP=yes", b"ROS_DOMAIN_ID=42"} <= set(environ)
    names = {entry.partition(b"=")[0] for entry in environ}
    assert {b"VIRTUAL_ENV", b"PYTHONHOME", b"BASH_ENV"}.isdisjoint(names)
    assert f"ROS_LOG_DIR={site.bag_dir}/.ros_log".encode() in environ
    argv = Path(f"/proc/{daemon.child}/cmdline").read_bytes().split(b"\0")
    assert argv[argv.index(b"--stats_max_publishing_rate") + 1] == b"1"
    closed = daemon.wait_for("split_closed")[0]
    declared = McapReader().channels(daemon.bag_dir / closed["recording"] / closed["file"])
    assert "/events/rosbag2_messages_lost" in {each.topic for each in declared}

    def beat() -> Heartbeat | None:
        found = read_heartbeat(daemon.bag_dir).heartbeat
        return found if found is not None and found.bytes_written else None

    # The recorder's own topic, which is silent as long as nothing is lost, is none of the robot's.
    told = until(beat)
    assert (told.subscribed, told.silent) == (("/odom", "/tf"), ())
    daemon.stop()


def test_the_newest_logs_of_ros_are_kept_and_a_second_recorder_is_told_who_records(
    site: Site,
) -> None:
    logs = site.bag_dir / ".ros_log"
    logs.mkdir(parents=True)
    for number in range(50):
        (logs / f"ros2_{number}.log").touch()
        os.utime(logs / f"ros2_{number}.log", (number, number))
    (logs / "a_directory").mkdir()
    os.utime(logs / "a_directory", (0, 0))
    daemon = site.run()
    left = {path.name for path in logs.iterdir()}
    assert left == {"a_directory", *(f"ros2_{n}.log" for n in range(30, 50))}
    code, message = site.refusal()
    assert code == 1
    assert f"process {daemon.process.pid} on {socket.gethostname()}" in message
    daemon.stop()


def test_old_bags_are_cleared_only_when_that_is_asked_for(site: Site) -> None:
    old = site.old_bag().parent
    (site.bag_dir / "notes.txt").write_text("mine")
    site.run().stop()
    assert (old / "rec_old_0.mcap").exists()
    daemon = site.run("recording.clear_on_startup=true")
    first = daemon.recordings()[0]
    daemon.stop()
    # What the first one recorded has gone, and what another program did has not.
    assert daemon.recordings() == [first, old]
    daemon = site.run("recording.clear_on_startup=true", "retention.foreign=delete")
    daemon.stop()
    assert not old.exists()
    assert (site.bag_dir / "notes.txt").exists()


@pytest.mark.parametrize("listed", ["[odom]", "[]"])
def test_a_refused_list_of_topics_is_named_and_touches_no_bag(site: Site, listed: str) -> None:
    old = site.old_bag()
    site.topics.write_text(f"topics: {listed}\n")
    code, message = site.refusal_here("recording.clear_on_startup=true")
    assert code == 2
    assert str(site.topics) in message
    assert "'odom' cannot be recorded" in message or listed == "[]"
    assert [path.name for path in site.bag_dir.rglob("*")] == ["rec_old", old.name]


def test_nothing_is_written_where_clearing_is_refused(site: Site) -> None:
    site.bag_dir.mkdir(parents=True)
    site.env["HOME"] = str(site.bag_dir)
    code, message = site.refusal_here("recording.clear_on_startup=true")
    assert code == 1
    assert "refuses to delete bags" in message
    assert list(site.bag_dir.iterdir()) == []


@pytest.mark.parametrize("cause", ["no ros2", "no setup file"])
def test_a_start_that_is_refused_clears_nothing_and_leaves_no_lock(site: Site, cause: str) -> None:
    old, env, setup = site.old_bag(), site.env, []
    if cause == "no ros2":
        site.env = {**env, "PATH": os.defpath}
    else:
        setup = [f"recorder.setup_files=[{site.folder}/none.bash]"]
    code, message = site.refusal_here("recording.clear_on_startup=true", *setup)
    assert (code, "recorder.setup_files" in message) == (1, True)
    assert old.read_bytes() == b"old"
    # While the process that was refused lives on.
    site.env = env
    site.run().stop()


def test_where_sigchld_is_ignored_a_ros2_that_cannot_record_is_noticed(site: Site) -> None:
    """Shells and supervisors that ignore it hand that on to what they start."""
    old = site.old_bag()
    ros2 = site.folder / "bin" / "ros2"
    ros2.write_text("#!/bin/sh\necho 'package ros2bag not found' >&2\nexit 1\n")
    begin = "import sys; from ros2_memory import programs; sys.exit(programs.recorder())"
    given = [*site.settings, "recording.clear_on_startup=true", "retention.foreign=delete"]
    done = subprocess.run(
        ["env", "--ignore-signal=CHLD", sys.executable, "-c", begin, *given],
        env=site.env,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert (done.returncode, "package ros2bag not found" in done.stderr) == (1, True)
    assert old.read_bytes() == b"old"


def test_a_bag_directory_that_cannot_be_made_or_that_ros2_cannot_take_is_named(site: Site) -> None:
    site.bag_dir.write_text("a file")
    odd = quoted(os.fsdecode(os.fsencode(site.folder) + b"/S\xfcd"))
    for given, said in (
        ([], "recording.bag_dir"),
        ([f"recording.bag_dir={odd}"], "takes no path that is not UTF-8"),
    ):
        code, message = site.refusal_here(*given)
        assert (code, said in message) == (1, True)


def test_ctrl_c_while_it_reads_its_configuration_is_an_interruption() -> None:
    with patch("ros2_memory.recorder.__main__.load_settings", side_effect=KeyboardInterrupt):
        assert main([]) == 130


def test_recorder_none_touches_nothing_and_is_no_failure(site: Site) -> None:
    site.old_bag()
    site.bag_dir.chmod(0o555)
    address = site.folder / "notify"
    with service_manager(address) as manager:
        site.env |= {
            "NOTIFY_SOCKET": str(address),
            "MEMORY_DEPLOYMENT": "robot",
            "MEMORY_CONFIG_OVERRIDES": "recorder=none",
        }
        before = {path: path.stat().st_mtime_ns for path in site.folder.rglob("*")}
        code, message = site.refusal_here("recording.clear_on_startup=true")
        # An exit with 0 before it is ready would be a failure that is tried again for ever.
        assert (code, manager.recv(100)) == (0, b"READY=1")
    assert "recorder=none" in message
    assert "such as robot" not in message
    assert {path: path.stat().st_mtime_ns for path in site.folder.rglob("*")} == before


@pytest.fixture
def served(site: Site) -> Iterator[Served]:
    with asked_about(site) as served:
        yield served


@contextmanager
def asked_about(site: Site) -> Iterator[Served]:
    """A server over the same directory, that may ask for moments to be kept."""
    site.bag_dir.mkdir()
    overrides = ("data.now=wall", "server.write_tools=true", "reader.index_refresh_s=0.2")
    with serving(site.bag_dir, site.folder / "server.log", *overrides) as served:
        yield served


def complete(bag_dir: Path) -> StoredMoment:
    """The one moment that is kept, when nothing of it is waited for any more."""

    def is_complete() -> StoredMoment | None:
        [held] = stored_moments_in(bag_dir).readable.values()
        return None if held.moment.pending else held

    return until(is_complete)


def about(served: Served, reply: dict[str, Any]) -> list[Any]:
    """Answers about the time of a moment; without the notes, which say what is open just now."""
    given = {"topic": "/odom", "start": reply["start"], "end": reply["end"], "max_samples": 7}
    middle = (reply["start"] + reply["end"]) / 2
    answers = [
        answer(served, "get_topic_in_range", **given),
        answer(served, "get_topic_at_time", topic="/tf", timestamp=middle),
    ]
    return [{key: each[key] for key in each if key != "notes"} for each in answers]


@each_in_time
def test_a_moment_is_answered_from_when_its_bags_have_long_been_deleted(tmp_path: Path) -> None:
    """They are deleted after 11 s, and until then the moment must be kept and looked at."""
    with sited(tmp_path) as site, asked_about(site) as served:
        keeps_a_moment(site, served)


def keeps_a_moment(site: Site, served: Served) -> None:
    daemon = site.run("retention.max_age_h=0.003")
    daemon.wait_for("split_closed", 4)
    reply = answer(served, "remember_moment", label="Küche", seconds_before=2.5)
    assert (reply["label"], reply["bags"] >= 2) == ("Küche", True), reply
    held = complete(site.bag_dir)
    assert (held.folder.name, held.moment.missing) == (reply["moment"], ())
    # Where its bags were recorded.
    recorded = [site.bag_dir / bag.relative_to(held.folder) for bag in held.folder.rglob("*.mcap")]
    assert len(recorded) >= 3

    def whole() -> list[Any] | None:
        """Answers in which the newest split has its part, too."""
        answers = about(served, reply)
        return answers if answers[0].get("total", 0) >= 240 else None

    before = until(whole)
    assert all(path.exists() for path in recorded)
    until(lambda: not any(path.exists() for path in recorded))
    assert about(served, reply) == before
    [listed] = answer(served, "memory_status")["moments"]
    assert (listed["label"], listed["bags"], listed["complete"]) == ("Küche", len(recorded), True)
    assert list((site.bag_dir / REQUESTS_FOLDER).iterdir()) == []
    daemon.stop()


def test_a_recorder_that_is_killed_while_a_moment_waits_goes_on_with_it_when_it_is_back(
    site: Site, served: Served
) -> None:
    daemon = site.run()
    daemon.wait_for("split_closed", 2)
    reply = answer(served, "remember_moment", label="fall", seconds_before=1, seconds_after=1)
    assert reply["pending"], reply
    daemon.kill(with_children=False)
    refused = answer(served, "remember_moment", label="later")
    assert refused["error"] == "refused", refused
    following = site.run()
    held = complete(site.bag_dir)
    assert held.moment.missing == ()
    kept = {path.name for path in held.folder.rglob("*.mcap")}
    assert len(kept) == len(held.files) > reply["bags"]
    following.stop()


RULES = """
rules:
  said: {topic: /odom, condition_type: contains, value: "1", before_s: 1, after_s: 1}
  restarted: {kind: recorder_restart, before_s: 1, after_s: 1}
"""


def test_rules_save_moments_over_a_rotation_and_a_kill(site: Site) -> None:
    rules = site.folder / "triggers.yaml"
    rules.write_text(RULES)
    given = (f"recording.keep_when={rules}", "recording.session_duration_s=3")
    daemon = site.run(*given)
    daemon.wait_for("trigger_fired", rule="said")
    daemon.wait_for("rotated")
    daemon.kill(with_children=True)
    following = site.run(*given)
    following.wait_for("trigger_fired", rule="restarted")

    def complete() -> bool:
        moments = [held.moment for held in stored_moments_in(site.bag_dir).readable.values()]
        return {each.rule for each in moments if not each.pending} == {"said", "restarted"}

    until(complete)
    following.stop()
