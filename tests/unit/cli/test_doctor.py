"""`ros2-memory doctor`: every fault has a finding that says what to do, and an exit code."""

import os
import re
import shutil
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from mcap.writer import Writer

from ros2_memory.bag_dir.heartbeat import RecorderState
from ros2_memory.bag_dir.state_files import Receipt, append_receipts
from ros2_memory.cli import doctor
from ros2_memory.core.timebase import NS_PER_S, iso_local
from tests.support import heartbeats, stub_ros2
from tests.support.bags import McapLayout, Msg, along_x, in_order, odom, tf_of, write_mcap
from tests.support.mcap_surgery import raw_mcap
from tests.support.program import Program
from tests.unit.cli.conftest import Using, left

Examined = Callable[..., dict[str, list[dict[str, str]]]]


class Answering(BaseHTTPRequestHandler):
    """What stands for the server's `/health`."""

    reply = b'{"status": "ok"}'
    asks_for: str | None = None

    def do_GET(self) -> None:
        shown = self.headers["Authorization"]
        taken = shown is None or self.asks_for in (None, shown)
        self.send_response(200 if taken else 401)
        self.end_headers()
        self.wfile.write(self.reply)

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002
        pass


@pytest.fixture
def port() -> Iterator[int]:
    Answering.reply, Answering.asks_for = b'{"status": "ok"}', None
    with HTTPServer(("127.0.0.1", 0), Answering) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        yield server.server_port
        server.shutdown()
        thread.join()


@pytest.fixture
def robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, using: Using, port: int) -> Path:
    """A bag directory of a robot with which all is well, and the settings that lead there."""
    bag_dir = tmp_path / "bags"
    now = time.time_ns()
    messages = [odom(now - (60 - n) * NS_PER_S, n / 10, 0.0) for n in range(50)]
    write_mcap(bag_dir / "rec" / "rec_0.mcap", messages)
    (tmp_path / "bin").mkdir()
    stub_ros2.install(tmp_path / "bin" / "ros2")
    (tmp_path / "topics.yaml").write_text("topics: [/odom]\n")
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}{os.pathsep}{os.environ['PATH']}")
    using(bag_dir, "robot")
    monkeypatch.setenv("MCP_PORT", str(port))
    overrides = [f"recording.topics_file={tmp_path / 'topics.yaml'}", "retention.max_total_gb=0.1"]
    monkeypatch.setenv("MEMORY_CONFIG_OVERRIDES", " ".join([*overrides, "retention.min_free_gb=0"]))
    beat(bag_dir)
    return bag_dir


def beat(bag_dir: Path, state: RecorderState = RecorderState.RECORDING, **more: Any) -> None:
    now = more.pop("at", time.time_ns())
    given: dict[str, Any] = {"recordings": ("rec",), "subscribed": ("/odom",)}
    heartbeats.beat(bag_dir, now, state, **(given | more))


@pytest.fixture
def examined(exits: Program) -> Examined:
    """Runs doctor, which must end with a code; returns what is not in order by its concern."""

    def run(code: int, settings: str = "") -> dict[str, list[dict[str, str]]]:
        wrong: dict[str, list[dict[str, str]]] = {}
        for each in exits(code, f"doctor --json {settings}").json["findings"]:
            if each["level"] != "ok":
                assert each["do"], each
                wrong.setdefault(each["about"], []).append(each)
        return wrong

    return run


def test_the_files_in_use_are_named_and_a_configuration_that_is_not(
    robot: Path, exits: Program, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    beside = tmp_path / "beside" / "config"
    beside.mkdir(parents=True)
    (beside / "places.yaml").write_text("places: {}\n")
    monkeypatch.chdir(beside.parent)
    [line, *_] = exits(0, "doctor").out.splitlines()
    assert f"{beside}/places.yaml" in line
    for name in ("config", "topics", "message_schemas", "labels", "triggers", "exclusions"):
        assert f"/{name}.yaml" in line
    (beside / "config.yaml").write_text("server: {}\n")
    output = exits(1, "doctor").out
    assert f"{beside}/config.yaml is not used" in output
    assert f"MEMORY_CONFIG_DIR={beside}" in output


def test_a_simulation_that_was_reset_needs_no_other_clock(
    tmp_path: Path, examined: Examined
) -> None:
    run = along_x(0, 60, mps=0.1)
    write_mcap(tmp_path / "run" / "run_0.mcap", [*run, *run[:40]])
    [clock] = examined(1, str(tmp_path))["clock"]
    assert clock["do"] == "record each run of a simulation in a recording of its own"


def test_data_from_the_future_means_that_the_clock_is_wrong(
    robot: Path, examined: Examined
) -> None:
    ahead = time.time_ns() + 7200 * NS_PER_S
    for path in robot.glob("rec/*.mcap"):
        path.unlink()
    write_mcap(robot / "rec" / "rec_1.mcap", [odom(ahead, 0.0, 0.0)])
    wrong = examined(2)
    assert "chrony" in wrong["clock"][0]["do"]


class Fault(NamedTuple):
    """What is wrong with the heartbeat, the list of topics or the settings; and what is told."""

    code: int
    told: Sequence[str]
    beats: dict[str, Any] | None = None
    topics: str = "/odom"
    setting: str = ""


@pytest.mark.parametrize(
    "fault",
    [
        Fault(1, ["recorder: it was stopped"], {"state": RecorderState.STOPPED}),
        Fault(
            2,
            ["recorder: it is paused: the disk is full"],
            {"state": RecorderState.PAUSED, "last_error": "the disk is full"},
        ),
        Fault(
            2,
            ["recorder: its last heartbeat was"],
            {"at": time.time_ns() - 3600 * NS_PER_S},
        ),
        Fault(1, ["recorder: .*no messages from: /scan"], {"silent": ("/scan",)}),
        Fault(1, ["recorder: its last error: it died"], {"last_error": "it died"}),
        Fault(
            2,
            [
                "recorder: .*/odom: 2 Hz, and 10 are required",
                "recorder: .*no message has come: /scan",
            ],
            {"required_missing": ("/odom: 2 Hz, and 10 are required",), "unheard": ("/scan",)},
        ),
        Fault(
            2,
            ["recorder: topics.yaml: it is not YAML"],
            {"listed": ("/odom",), "list_refused": "topics.yaml: it is not YAML; it stays"},
        ),
        Fault(
            1,
            [r"topics: /odom_ is in .* -> is it /odom\?", r"topics: /vision/\*/objects is in"],
            topics="/odom, /odom_, /vision/*/objects",
        ),
        Fault(
            1,
            [
                "recorder: in its list, and offered by no publisher: /odom, /gone -> ",
                "recorder: it restarted ros2 bag record 1 time; its last error",
                "topics: /gone is in .*was never recorded",
            ],
            {"missing": ("/odom", "/gone"), "restarts": 1, "last_error": "it died"},
            "/odom, /gone",
        ),
        Fault(
            1,
            ["recorder: .*does not know the type, or .*: /arm -> name the workspace"],
            {"unknown_types": ("/arm",)},
        ),
        Fault(
            1,
            ["topics: /gone is in .*was never recorded"],
            {"listed": ("/odom", "/gone")},
            "/odom, /said",
        ),
        Fault(
            2,
            ["ros: .*/opt/ros/none/setup.bash.* -> .*recorder.setup_files"],
            setting="recorder.setup_files=[/opt/ros/none/setup.bash]",
        ),
        Fault(2, ["config: server.prot: .*-> correct the key"], setting="server.prot=1"),
        Fault(
            2, [r"config: .*no bag is named typo \(data.recording\)"], setting="data.recording=typo"
        ),
        Fault(
            1,
            ["topics: /mic in retention.topics is no topic that is recorded -> compare"],
            setting="'retention.topics={/odom: {max_age_h: 1}, /o*: {max_age_h: 1}, "
            "/mic: {max_age_h: 1}}'",
        ),
        Fault(2, ["server: .*-> .*ros2-memory-server"], setting="server.port=1"),
        Fault(2, ["disk: .*-> recording pauses"], setting="retention.min_free_gb=1000000.0"),
        Fault(
            1,
            ["disk: .*-> .*lower retention.max_total_gb"],
            setting="retention.max_total_gb=1000000.0",
        ),
    ],
    ids=lambda fault: fault.told[0],
)
def test_a_fault_is_reported_with_what_to_do(robot: Path, examined: Examined, fault: Fault) -> None:
    (robot.parent / "topics.yaml").write_text(f"topics: [{fault.topics}]\n")
    beat(robot, **(fault.beats or {}))
    wrong = examined(fault.code, fault.setting)
    found = [
        f"{about}: {finding['seen']} -> {finding['do']}"
        for about, findings in sorted(wrong.items())
        for finding in findings
    ]
    for line, pattern in zip(found, fault.told, strict=True):
        assert re.match(pattern, line)


def lay(robot: Path, name: str, content: bytes) -> None:
    path = robot / name / f"{name}_0.mcap"
    path.parent.mkdir()
    path.write_bytes(content)
    left(path)


def test_what_is_wrong_with_bags_is_reported_with_what_would_mend_that_alone(
    robot: Path, examined: Examined
) -> None:
    lay(robot, "letter", b"a letter")
    whole = (robot / "rec" / "rec_0.mcap").read_bytes()
    lay(robot, "cut", whole[: len(whole) // 2])
    same_time = [odom(time.time_ns() - (60 - n) * NS_PER_S, 0.0, 0.0) for n in range(50)]
    write_mcap(robot / "twin" / "twin_0.mcap", same_time)
    for name in ("a_0.db3", "b_0.db3", "c_0.MCAP"):
        (robot / "rec" / name).write_bytes(b"any")
    now = time.time_ns() - 3600 * NS_PER_S
    raw_mcap(robot / "other" / "other_0.mcap", partial(enveloped, at=now))
    foreign = Msg("/foreign", "nobody_msgs/msg/Unknown", now, b"\x00\x01\x00\x00abc")
    write_mcap(robot / "odd" / "odd_0.mcap", [foreign], McapLayout(definitions=False))
    told = {each["seen"]: each["do"] for each in examined(1)["bags"]}

    def advice(seen: str) -> str:
        [found] = [advised for told_of, advised in told.items() if seen in told_of]
        return found

    assert advice("letter_0.mcap (not an MCAP file").startswith("copy them again")
    assert "recover" not in advice("letter_0.mcap")
    assert f"ros2-memory recover {robot}" in told.values()
    assert advice("rec, twin overlap in time (from 20")
    assert advice("2 files not read: a_0.db3, b_0.db3").endswith(
        ": choose storage=rosbag2, which does"
    )
    assert advice("1 file not read: c_0.MCAP").endswith(": rename it")
    assert "reader.custom_msg_paths" in advice("1 topic cannot be decoded: /foreign ")
    protobuf = "1 topic cannot be decoded: /keelson (its message encoding 'protobuf' is not read"
    assert ".msg" not in advice(protobuf)


def enveloped(writer: Writer, at: int) -> None:
    schema = writer.register_schema("keelson.Envelope", "protobuf", b"")
    channel = writer.register_channel("/keelson", "protobuf", schema)
    writer.add_message(channel, at, b"\x08\x01", at)


def test_a_folder_that_lies_there_twice_is_named_and_a_run_of_equal_times_is_not(
    tmp_path: Path, examined: Examined
) -> None:
    for name, mps in (("run", 0.1), ("other", 0.2)):
        for nth in range(2):
            path = tmp_path / "bags" / name / f"{name}_{nth}.mcap"
            write_mcap(path, along_x((1000 + 60 * nth) * NS_PER_S, 60, mps=mps))
    shutil.copytree(tmp_path / "bags" / "run", tmp_path / "bags" / "run copied")
    wrong = examined(1, f"recorder=none {tmp_path}/bags")["bags"]
    [copied] = [each for each in wrong if "second folder" in each["seen"]]
    assert copied["seen"] == (
        "2 bags copied into a second folder: run copied/run_0.mcap, run copied/run_1.mcap"
    )


def test_places_that_are_refused_are_of_one_robot_of_a_fleet(
    tmp_path: Path, exits: Program, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MEMORY_DEPLOYMENT", "fleet")
    for name in ("r1", "r2", "r3"):
        write_mcap(tmp_path / "robots" / name / "rec.mcap", [odom(NS_PER_S, 0.0, 0.0)])
    (tmp_path / "places_r2.yaml").write_text("places: {kitchen: {x: [0, 5]}}\n")
    words = [f"fleet.robots={tmp_path}/robots/*", f"fleet.places={tmp_path}/places_*.yaml"]
    found = exits(2, "doctor --json", *words).json["findings"]
    seen = {row["seen"][:3]: row["level"] for row in found if row["about"] == "robot"}
    assert seen == {"r1:": "ok", "r2:": "error", "r3:": "ok"}


def test_what_this_user_may_not_read_is_not_advised_to_be_copied_and_ends_no_report(
    robot: Path, monkeypatch: pytest.MonkeyPatch, examined: Examined
) -> None:
    lay(robot, "letter", b"a letter")
    access = os.access
    monkeypatch.setattr(
        os, "access", lambda path, mode: "letter" not in str(path) and access(path, mode)
    )
    assert examined(1)["bags"][0]["do"].startswith("give this user the right to read it")

    def refuses(_: object) -> str:
        raise PermissionError(13, "Permission denied", "leaving.json")

    monkeypatch.setattr(doctor, "describe_leaving", refuses)
    found = examined(2)
    assert found["disk"][-1]["seen"] == "leaving.json: Permission denied"
    assert "bags" in found


def test_where_bags_must_be_shipped_it_counts_those_that_are_not_and_dates_the_newest_receipt(
    robot: Path, examined: Examined
) -> None:
    old = time.time_ns() - 2 * 3600 * NS_PER_S
    path = write_mcap(robot / "old" / "old_0.mcap", [odom(old, 0.0, 0.0)])
    assert "shipping" not in examined(0)
    required = "retention.require_shipped=true"
    [finding] = examined(1, required)["shipping"]
    assert "2 of 2 closed bags not shipped" in finding["seen"]
    assert "no receipt" in finding["seen"]
    other = Receipt("old/old_1.mcap", "id", 1, "00", "lake", old)
    append_receipts(robot, [other])
    seen = examined(1, required)["shipping"][0]["seen"]
    assert seen == f"2 of 2 closed bags not shipped; the newest receipt is from {iso_local(old)}"
    append_receipts(robot, [replace(other, bag="old/old_0.mcap", size=path.stat().st_size)])
    # The other one has just been closed, and no thinned day is ever shipped.
    write_mcap(robot / "memory" / "20261120.thinned.mcap", [odom(old, 0.0, 0.0)])
    assert examined(0, required) == {}


def test_poses_that_are_to_be_chosen_and_a_map_of_another_name_are_told(
    robot: Path, examined: Examined
) -> None:
    [bag] = robot.glob("rec/*.mcap")
    now = time.time_ns()
    placed = [odom(now - n * NS_PER_S, n / 10, 0.0, topic="/odometry") for n in range(20, 40)]
    site = [tf_of(message.log_time, "site", "odom", (1.0, 0.0, 0.0)) for message in placed]
    others = [replace(message, topic="/fused") for message in placed]
    write_mcap(bag, in_order([*placed, *others, *site]))
    beat(robot, subscribed=("/odometry",))
    [unknown] = examined(1)["poses"]
    assert unknown["do"].startswith("data.pose_topic is /odom, which these bags do not have; ")
    [elsewhere] = examined(1, "data.pose_topic=/odometry")["poses"]
    assert elsewhere["seen"] == "no transforms lead from odom to data.map_frame, which is map"
    assert elsewhere["do"] == "they lead to site: if that is a map, set data.map_frame=site"
    assert "poses" not in examined(1, "data.pose_topic=/odometry data.map_frame=site")


def test_a_running_recorder_has_a_ros_that_these_settings_do_not_name(
    robot: Path, examined: Examined, monkeypatch: pytest.MonkeyPatch
) -> None:
    (robot.parent / "bin" / "ros2").unlink()
    monkeypatch.setenv("PATH", str(robot.parent / "bin"))
    [finding] = examined(1)["ros"]
    assert finding["level"] == "warning"
    assert "the running recorder has others" in finding["seen"]
    beat(robot, RecorderState.STOPPED)
    assert examined(2)["ros"][0]["level"] == "error"


def test_another_program_in_place_of_the_server_and_a_token_that_it_does_not_take_are_told(
    robot: Path, monkeypatch: pytest.MonkeyPatch, examined: Examined
) -> None:
    Answering.asks_for = f"Bearer {'s' * 32}"
    monkeypatch.setenv("MEMORY_API_TOKEN", "t" * 32)
    assert "takes another token" in examined(1)["server"][0]["seen"]
    monkeypatch.setenv("MEMORY_API_TOKEN", "s" * 32)
    assert examined(0) == {}
    Answering.reply = b"<html>a printer</html>"
    assert "another program" in examined(2)["server"][0]["seen"]


@pytest.mark.parametrize(("recorder", "is_active"), [("none", False), ("ros2bag", True)])
def test_a_copy_without_an_end_is_named_while_it_counts_as_being_written(
    robot: Path, examined: Examined, recorder: str, is_active: bool
) -> None:
    (robot / "recorder.json").unlink()
    path = write_mcap(
        robot / "copy" / "copy_0.mcap", [odom(10**18 + n, 0.0, 0.0) for n in range(9)]
    )
    path.write_bytes(path.read_bytes()[:-20])
    code = 1 if recorder == "none" else 2
    seen = " ".join(each["seen"] for each in examined(code, f"recorder={recorder}")["bags"])
    assert ("so not read: copy_0.mcap" in seen) is is_active
    assert ("1 file unfinished: copy_0.mcap" in seen) is not is_active


def test_what_the_recorder_receives_by_now_is_not_missed_in_closed_bags(
    robot: Path, examined: Examined
) -> None:
    (robot.parent / "topics.yaml").write_text("topics: [/odom, /said]\n")
    beat(robot, listed=("/odom", "/said"), subscribed=("/odom", "/said"), silent=("/said",))
    assert any("/said" in each["seen"] for each in examined(1)["topics"])
    beat(robot, listed=("/odom", "/said"), subscribed=("/odom", "/said"))
    assert "topics" not in examined(0)
