"""What `deploy/` promises: units that systemd understands, a user, directories, an environment."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest
import yaml

from ros2_memory.bag_dir.layout import REQUESTS_FOLDER
from ros2_memory.bootstrap import build_memory
from ros2_memory.config import NullRecorderNode, Ros2BagNode, load_settings
from ros2_memory.serving.auth import CREDENTIAL
from tests.support.bags import odom, write_db3

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"
RECORDER = DEPLOY / "ros2-memory-recorder.service"
SERVER = DEPLOY / "ros2-memory-server.service"
SHIP = DEPLOY / "ros2-memory-ship.service"
QUERY = DEPLOY / "ros2-memory-query.service"
EACH = pytest.mark.parametrize("unit", [RECORDER, SERVER, QUERY, SHIP], ids=lambda unit: unit.stem)


def settings_of(unit: Path) -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for line in unit.read_text().splitlines():
        name, is_setting, value = line.partition("=")
        if is_setting and not line.startswith("#"):
            found.setdefault(name, []).append(value)
    return found


def exposure(unit: Path) -> float:
    ran = subprocess.run(
        ["systemd-analyze", "security", "--offline=true", unit],
        check=False,
        capture_output=True,
        text=True,
    )
    found = re.search(r"Overall exposure level for \S+: ([\d.]+)", ran.stdout)
    assert found is not None, ran.stdout[-300:] + ran.stderr
    return float(found[1])


needs_analyze = pytest.mark.skipif(
    shutil.which("systemd-analyze") is None, reason="systemd-analyze is not on this machine"
)
needs_sysusers = pytest.mark.skipif(
    shutil.which("systemd-sysusers") is None, reason="systemd-sysusers is not on this machine"
)


@needs_analyze
@pytest.mark.parametrize(
    ("unit", "limit"), [(RECORDER, 3.0), (SERVER, 2.0), (QUERY, 2.0), (SHIP, 2.0)]
)
def test_a_unit_is_exposed_by_less_than_its_limit(unit: Path, limit: float) -> None:
    assert exposure(unit) < limit


@needs_analyze
@EACH
def test_a_unit_is_understood_by_systemd(unit: Path, tmp_path: Path) -> None:
    copy = tmp_path / unit.name
    # The program is not installed here, and its absence is no fault of the unit.
    copy.write_text(re.sub(r"(?m)^(Exec\w+)=.*", r"\1=/bin/true", unit.read_text()))
    ran = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", copy],
        check=False,
        capture_output=True,
        text=True,
    )
    assert [line for line in ran.stderr.splitlines() if unit.name in line] == []


@EACH
def test_a_unit_is_ready_when_it_says_so_and_is_started_again_when_it_fails(unit: Path) -> None:
    settings = settings_of(unit)
    assert (settings["Type"], settings["NotifyAccess"]) == (["notify"], ["main"])
    assert settings["Restart"] == ["on-failure"]
    assert settings["MemoryMax"]
    assert settings["TasksMax"]


@EACH
def test_a_unit_takes_the_settings_of_the_machine_over_its_own(unit: Path) -> None:
    lines = unit.read_text().splitlines()
    own = max(n for n, line in enumerate(lines) if line.startswith("Environment="))
    name = "query-environment" if unit == QUERY else "environment"
    assert lines.index(f"EnvironmentFile=-/etc/ros2-memory/{name}") > own


def test_the_recorder_is_watched_and_tried_for_ever() -> None:
    settings = settings_of(RECORDER)
    assert settings["WatchdogSec"] == ["90"]
    assert settings["StartLimitIntervalSec"] == ["0"]


def test_the_recorder_ends_its_child_in_order() -> None:
    settings = settings_of(RECORDER)
    assert settings["KillMode"] == ["control-group"]
    # A child's patience is 15 s, and two of them are ended at once.
    assert int(settings["TimeoutStopSec"][0]) >= 30


def test_the_recorder_writes_where_it_records_and_nowhere_else() -> None:
    settings = settings_of(RECORDER)
    assert settings["ReadWritePaths"] == ["/var/lib/ros2-memory/bags"]
    assert f"MEMORY_BAG_DIR={settings['ReadWritePaths'][0]}" in settings["Environment"]
    # Not below the mount point of a disk that is not there.
    assert settings["RequiresMountsFor"] == settings["ReadWritePaths"]
    assert settings["MemoryDenyWriteExecute"] == ["yes"]


def test_the_recorder_hears_publishers_of_another_user() -> None:
    assert "FASTDDS_BUILTIN_TRANSPORTS=UDPv4" in settings_of(RECORDER)["Environment"]


def environment_of(file: Path) -> dict[str, str]:
    env: dict[str, str] = {}
    for line in file.read_text().splitlines():
        # The lines that are commented out are to be right when they are not.
        text = re.sub(r"^#(?=[A-Z_]+=)", "", line)
        if text and not text.startswith("#"):
            name, _, value = text.partition("=")
            env[name] = "".join(shlex.split(value))
    return env


def test_the_environment_file_is_understood_by_the_program() -> None:
    env = environment_of(DEPLOY / "environment")
    assert {"ROS_DOMAIN_ID", "RMW_IMPLEMENTATION", "FASTDDS_BUILTIN_TRANSPORTS"} <= set(env)
    env.pop("ROS_VISION_INTERFACES_PATH")
    recorder = load_settings((), env).recorder
    assert isinstance(recorder, Ros2BagNode)
    assert recorder.setup_files == (Path("/opt/ros/jazzy/setup.bash"),)


def test_the_server_listens_on_the_loopback_address_unless_it_is_given_a_token() -> None:
    settings = settings_of(SERVER)
    assert settings["IPAddressAllow"] == ["localhost"]
    assert not [line for line in settings["Environment"] if "MCP_HOST" in line]
    # The lines that are commented out are to be right when they are not.
    (credential,) = re.findall(r"^#LoadCredential=(\w+):", SERVER.read_text(), re.MULTILINE)
    assert credential == CREDENTIAL


def test_the_server_writes_where_it_asks_the_recorder_and_nowhere_else_in_the_bags() -> None:
    settings = settings_of(SERVER)
    asks = f"/var/lib/ros2-memory/bags/{REQUESTS_FOLDER}"
    assert settings["ReadWritePaths"] == [f"-{asks}"]
    assert settings["ReadOnlyPaths"] == ["-/var/lib/ros2-memory"]


def test_the_query_server_alone_listens_whatever_its_settings_say() -> None:
    settings = settings_of(QUERY)
    program, *given = settings["ExecStart"][0].split()
    assert program.endswith("/ros2-memory-server")
    env = {"MEMORY_DEPLOYMENT": "query_only", "MCP_TRANSPORT": "stdio"}
    loaded = load_settings(given, env)
    assert loaded.server.transport == "sse"
    assert isinstance(loaded.recorder, NullRecorderNode)
    assert "ReadWritePaths" not in settings
    assert settings["Conflicts"] == [SERVER.name]


def test_the_settings_of_the_query_server_alone_are_understood() -> None:
    env = {"MEMORY_DEPLOYMENT": "query_only"} | environment_of(DEPLOY / "query-environment")
    env.pop("ROS_VISION_INTERFACES_PATH")
    assert load_settings((), env).data.now == "latest"


def test_the_container_is_published_on_the_loopback_address_and_needs_a_token() -> None:
    compose = yaml.safe_load((DEPLOY / "compose.yaml").read_text())
    (service,) = compose["services"].values()
    assert service["ports"] == ["127.0.0.1:9203:9203"]
    assert service["environment"]["MEMORY_API_TOKEN"].startswith("${MEMORY_API_TOKEN:?")
    assert all(volume.endswith(":ro") for volume in service["volumes"])
    assert service["read_only"] is True
    # The bags of the units are their group's; without one given, a group that owns nothing.
    assert service["group_add"] == ["${MEMORY_BAG_GID:-65534}"]


def test_the_container_reads_bags_of_every_kind(tmp_path: Path) -> None:
    _, _, image = (DEPLOY.parent / "Dockerfile").read_text().partition("\nENV PATH=")
    given = re.findall(r"\b((?:MEMORY|MCP)_[A-Z_]+)=(\S+)", image)
    write_db3(tmp_path / "rec" / "rec_0.db3", [odom(10**18, 1.0, 2.0)])
    settings = load_settings((), {**dict(given), "MEMORY_BAG_DIR": str(tmp_path)})
    memory = build_memory(settings)
    memory.index.refresh()
    assert memory.index.snapshot().timeline.topics() == ("/odom",)


@needs_sysusers
def test_the_user_of_the_units_is_made() -> None:
    ran = subprocess.run(
        ["systemd-sysusers", "--dry-run", DEPLOY / "ros2-memory.sysusers.conf"],
        check=False,
        capture_output=True,
        text=True,
    )
    assert ran.returncode == 0, ran.stderr
    assert "ros2-memory" in (DEPLOY / "ros2-memory.sysusers.conf").read_text().split()
