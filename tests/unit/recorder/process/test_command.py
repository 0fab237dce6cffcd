"""`ros2 bag record`: its installation, its command line, and what it says."""

import re
import tempfile
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.core.errors import RecorderError
from ros2_memory.recorder.process.command import STATISTICS, options_in_help, record_argv
from ros2_memory.recorder.process.installation import (
    advice_on_rmw,
    advice_on_silence,
    find_installation,
    setup_files_here,
)
from ros2_memory.recorder.process.output import LineKind, parse_line
from ros2_memory.recorder.process.topics import TopicSelection
from tests.support.shared_bags import RECORDED, needs_recorded

TOPICS = TopicSelection(("/odom", "/tf", "/tf_static"))
OPTIONAL = ("--disable-keyboard-controls", "--node-name")


def argv_for(
    known: frozenset[str] = frozenset(),
    *,
    topics: TopicSelection = TOPICS,
    use_sim_time: bool = False,
    repeat_latched: tuple[str, ...] = (),
) -> list[str]:
    return record_argv(
        ros2="/opt/ros/jazzy/bin/ros2",
        directory=Path("/bags/rec_1"),
        topics=topics,
        split_duration_s=10,
        qos_file=Path("/bags/q.yaml"),
        storage_file=Path("/bags/s.yaml"),
        node_name="ros2_memory_rec_1",
        cache_bytes=64 * 2**20,
        use_sim_time=use_sim_time,
        repeat_latched=repeat_latched,
        known_options=known,
    )


def test_the_argv_is_this_to_the_letter_and_then_what_a_distribution_knows() -> None:
    known = frozenset((*OPTIONAL, "--repeat-transient-local", "--max-cache-size"))
    added = argv_for(known, use_sim_time=True, repeat_latched=("/tf_static=32", "/map"))
    assert " ".join(argv_for()) == (
        "/opt/ros/jazzy/bin/ros2 bag record -s mcap -d 10 -o /bags/rec_1 "
        "-e ^(/odom|/tf|/tf_static)$ --qos-profile-overrides-path /bags/q.yaml "
        "--storage-config-file /bags/s.yaml"
    )
    assert " ".join(added).removeprefix(" ".join(argv_for())) == (
        " --use-sim-time --max-cache-size 67108864 --disable-keyboard-controls "
        "--node-name ros2_memory_rec_1 --repeat-transient-local /tf_static=32 /map"
    )


@pytest.mark.parametrize("known", [(), (STATISTICS,)], ids=["plain", "with statistics"])
def test_what_is_excluded_is_recorded_by_no_distribution(known: tuple[str, ...]) -> None:
    argv = argv_for(frozenset(known), topics=TopicSelection(("/a/*",), ("/a/secret",)))
    recorded = re.compile(argv[argv.index("-e") + 1])
    assert recorded.search("/a/speed")
    assert not recorded.search("/a/secret")


def test_an_installation_without_mcap_is_refused() -> None:
    usage = "usage: ros2 bag record [-h] [-s {sqlite3,my_plugin}]\n\noptions: mcap\n"
    with pytest.raises(RecorderError, match="rosbag2-storage-mcap"):
        options_in_help(usage)
    usage = "usage: x [-s {mcap,sqlite3}] [--node-name N]\n\n  --node-name N  like --no-other\n"
    assert options_in_help(usage) == {"--node-name"}


NOTHING = {"PATH": "/nonexistent"}


def distribution(root: Path, name: str, *, ros2: bool = True) -> Path:
    folder = root / name
    (folder / "bin").mkdir(parents=True)
    if ros2:
        (folder / "bin" / "ros2").touch(mode=0o755)
    (folder / "setup.bash").touch()
    return folder / "setup.bash"


def test_the_newest_distribution_is_taken_and_ros_1_never(tmp_path: Path) -> None:
    distribution(tmp_path, "humble")
    jazzy = distribution(tmp_path, "jazzy")
    distribution(tmp_path, "noetic", ros2=False)
    assert setup_files_here((), NOTHING, tmp_path) == (jazzy,)


def test_an_environment_that_is_sourced_wins_and_the_setting_over_it(tmp_path: Path) -> None:
    sourced = {"PATH": str(distribution(tmp_path, "jazzy").parent / "bin")}
    mine = Path("/home/me/ws/install/setup.bash")
    assert setup_files_here((), sourced, tmp_path) == ()
    assert setup_files_here((mine,), sourced, tmp_path) == (mine,)


def test_without_ros_2_it_is_said_where_it_was_looked_for_and_what_to_do(tmp_path: Path) -> None:
    distribution(tmp_path, "noetic", ros2=False)
    with pytest.raises(RecorderError, match="there is no ROS 2: `ros2` is not on PATH") as told:
        setup_files_here((), NOTHING, tmp_path)
    assert str(tmp_path) in str(told.value)
    assert "recorder.setup_files=[FILE]" in str(told.value)


def test_an_rmw_that_is_not_installed_is_named_with_its_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path / "ros2"
    program.write_text("#!/bin/sh\necho expected $RMW_IMPLEMENTATION >&2; exit 102\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_zenoh_cpp")
    with pytest.raises(RecorderError, match="status 102") as told:
        find_installation((), tmp_path)
    assert "install the package ros-$ROS_DISTRO-rmw-zenoh-cpp" in str(told.value)


def test_where_no_temporary_folder_can_be_made_it_is_said_and_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "ros2").write_text("#!/bin/sh\n")
    (tmp_path / "ros2").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", "/dev/null")
    with pytest.raises(RecorderError, match="Not a directory; free its disk, or name another"):
        find_installation((), tmp_path)


def test_what_zenoh_and_cyclone_need_is_said_of_them_alone() -> None:
    zenoh, cyclone, fast = (
        {"RMW_IMPLEMENTATION": f"rmw_{name}_cpp"} for name in ("zenoh", "cyclonedds", "fastrtps")
    )
    assert "ros2 run rmw_zenoh_cpp rmw_zenohd" in str(advice_on_rmw(zenoh))
    assert "CYCLONEDDS_URI" in str(advice_on_rmw(cyclone))
    assert advice_on_rmw({}) is advice_on_rmw(fast) is None
    assert advice_on_silence(zenoh) == advice_on_rmw(zenoh)


ROBOTS_TOPICS = {
    "/battery_state",
    "/bumper",
    "/cmd_vel",
    "/odom",
    "/scan",
    "/tf",
    "/tf_static",
    "/vision/scene/scene_description",
    "/vision/scene/scene_objects",
}


@needs_recorded
@pytest.mark.parametrize(
    ("name", "ended"),
    [
        ("session_mcap", True),
        ("session_sqlite3", True),
        ("session_zstd", True),
        ("session_zstd_file", True),
        ("session_killed", False),
        ("session_killed_chunk64k", False),
    ],
)
def test_the_logs_of_real_recorders_are_understood(name: str, ended: bool) -> None:
    lines = [parse_line(raw) for raw in (RECORDED / f"logs/{name}.log").read_text().splitlines()]
    said = [line.kind for line in lines]
    subscribed = {line.topic for line in lines if line.kind is LineKind.SUBSCRIBED}
    assert subscribed == ROBOTS_TOPICS
    assert said.count(LineKind.STOPPED) == ended
    assert said.index(LineKind.READY) < said.index(LineKind.SUBSCRIBED)
    assert {
        LineKind.WARNING,
        LineKind.ERROR,
        LineKind.QOS_REFUSED,
        LineKind.UNKNOWN_TYPE,
    }.isdisjoint(said)


# What a line reports, the topic if it names one, and the line.
LINES = """
recording - [INFO] [1.5] [rosbag2_recorder]: Recording...
recording - [INFO] [1.5] [rosbag2_recorder]: Listening for topics...
recording - \x1b[32m[INFO] [1.5] [n]: Recording...\x1b[0m
subscribed /odom stdin is not a terminal device.[INFO] [1.5] [n]: Subscribed to topic '/odom'
subscribed /tf [INFO] [1.5] [n]: Subscribed to topic '/tf' (repeat-transient-local, depth=3)
error - [ERROR] [ros2bag]: Output folder '/bags/rec_1' already exists.
qos_refused /scan [WARN] [1] [n]: A new publisher for subscribed topic /scan was found offering RMW
qos_refused /a [WARN] [1.5] [n]: New publisher discovered on topic '/a', offering incompatible QoS.
unknown_type /x [WARN] [1.5] [T]: Topic '/x' has unknown type 'my_msgs/msg/X' . Only topics with
several_types /y [ERROR] [1.5] [T]: Topic '/y' has more than one type associated. Only topics with
messages_lost - [WARN] [1.5] [rosbag2_cpp]: Cache buffers lost messages per topic:
messages_lost - Total lost: 12
other - Total lost: 0
warning - [WARN] [1.5] [n]: something else
error - [FATAL] [1.5] [n]: it is over
other - [DEBUG] [1.5] [n]: detail
other - ros2 bag record: error: unrecognized arguments: --x
"""


@pytest.mark.parametrize("line", LINES.strip().split("\n"))
def test_a_line_is_classified(line: str) -> None:
    kind, topic, raw = line.split(" ", 2)
    parsed = parse_line(raw)
    assert (parsed.kind, parsed.topic or "-") == (kind, topic)


@given(st.text())
def test_no_line_is_too_odd(raw: str) -> None:
    assert parse_line(raw).kind in LineKind
