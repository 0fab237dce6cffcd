"""What `deploy/` promises: units that systemd understands, a user, directories, an environment."""

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
from tests.support.memories import ROOT

DEPLOY = ROOT / "deploy"
BAGS = "/var/lib/ros2-memory/bags"
UNITS = ("recorder", "server", "query", "ship")
EACH = pytest.mark.parametrize("name", UNITS)
NOTIFIES = {"Type": ["notify"], "NotifyAccess": ["main"], "Restart": ["on-failure"]}
PROMISED: dict[str, dict[str, list[str]]] = {
    "recorder": {
        "WatchdogSec": ["90"],
        "StartLimitIntervalSec": ["0"],
        "KillMode": ["control-group"],
        # A child's patience is 15 s, and two of them are ended at once.
        "TimeoutStopSec": ["40"],
        "ReadWritePaths": [BAGS],
        # Not below the mount point of a disk that is not there.
        "RequiresMountsFor": [BAGS],
        "MemoryDenyWriteExecute": ["yes"],
    },
    "server": {
        "IPAddressAllow": ["localhost"],
        "ReadWritePaths": [f"-{BAGS}/{REQUESTS_FOLDER}"],
        "ReadOnlyPaths": ["-/var/lib/ros2-memory"],
    },
    "query": {"Conflicts": ["ros2-memory-server.service"]},
    "ship": {},
}
"""What somebody relies on who is not there when a program fails."""


def unit_of(name: str) -> Path:
    return DEPLOY / f"ros2-memory-{name}.service"


def settings_of(name: str) -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for line in unit_of(name).read_text().splitlines():
        key, is_setting, value = line.partition("=")
        if is_setting and not line.startswith("#"):
            found.setdefault(key, []).append(value)
    return found


def ran(*words: str | Path) -> subprocess.CompletedProcess[str]:
    if shutil.which(str(words[0])) is None:
        pytest.skip(f"{words[0]} is not on this machine")
    return subprocess.run(words, check=False, capture_output=True, text=True)


@EACH
def test_a_unit_is_understood_by_systemd_and_exposed_by_less_than_its_limit(
    name: str, tmp_path: Path
) -> None:
    copy = tmp_path / unit_of(name).name
    # The program is not installed here, and its absence is no fault of the unit.
    copy.write_text(re.sub(r"(?m)^(Exec\w+)=.*", r"\1=/bin/true", unit_of(name).read_text()))
    verified = ran("systemd-analyze", "verify", "--man=no", copy)
    assert [line for line in verified.stderr.splitlines() if copy.name in line] == []
    judged = ran("systemd-analyze", "security", "--offline=true", unit_of(name))
    found = re.search(r"Overall exposure level for \S+: ([\d.]+)", judged.stdout)
    assert found is not None, judged.stdout[-300:] + judged.stderr
    assert float(found[1]) < (3.0 if name == "recorder" else 2.0)


@EACH
def test_a_unit_keeps_its_promises(name: str) -> None:
    settings = settings_of(name)
    assert settings.items() >= (NOTIFIES | PROMISED[name]).items()
    assert settings["MemoryMax"]
    assert settings["TasksMax"]
    if name == "recorder":  # it hears publishers of another user, too
        given = {"FASTDDS_BUILTIN_TRANSPORTS=UDPv4", f"MEMORY_BAG_DIR={BAGS}"}
        assert given <= {*settings["Environment"]}
    lines = unit_of(name).read_text().splitlines()
    own = max(n for n, line in enumerate(lines) if line.startswith("Environment="))
    file = "query-environment" if name == "query" else "environment"
    assert lines.index(f"EnvironmentFile=-/etc/ros2-memory/{file}") > own


def environment_of(file: Path) -> dict[str, str]:
    env: dict[str, str] = {}
    for line in file.read_text().splitlines():
        # The lines that are commented out are to be right when they are not.
        text = re.sub(r"^#(?=[A-Z_]+=)", "", line)
        if text and not text.startswith("#"):
            name, _, value = text.partition("=")
            env[name] = "".join(shlex.split(value))
    del env["ROS_VISION_INTERFACES_PATH"]
    return env


def test_the_environment_files_are_understood_by_the_programs() -> None:
    env = environment_of(DEPLOY / "environment")
    assert {"ROS_DOMAIN_ID", "RMW_IMPLEMENTATION", "FASTDDS_BUILTIN_TRANSPORTS"} <= set(env)
    recorder = load_settings((), env).recorder
    assert isinstance(recorder, Ros2BagNode)
    assert recorder.setup_files == (Path("/opt/ros/jazzy/setup.bash"),)
    env = {"MEMORY_DEPLOYMENT": "query_only"} | environment_of(DEPLOY / "query-environment")
    assert load_settings((), env).data.now == "latest"
    (credential,) = re.findall(r"(?m)^#LoadCredential=(\w+):", unit_of("server").read_text())
    assert credential == CREDENTIAL


def test_the_query_server_alone_listens_whatever_its_settings_say() -> None:
    settings = settings_of("query")
    program, *given = settings["ExecStart"][0].split()
    assert program.endswith("/ros2-memory-server")
    loaded = load_settings(given, {"MEMORY_DEPLOYMENT": "query_only", "MCP_TRANSPORT": "stdio"})
    assert loaded.server.transport == "sse"
    assert isinstance(loaded.recorder, NullRecorderNode)
    assert "ReadWritePaths" not in settings


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
    _, _, image = (ROOT / "Dockerfile").read_text().partition("\nENV PATH=")
    given = re.findall(r"\b((?:MEMORY|MCP)_[A-Z_]+)=(\S+)", image)
    write_db3(tmp_path / "rec" / "rec_0.db3", [odom(10**18, 1.0, 2.0)])
    memory = build_memory(load_settings((), {**dict(given), "MEMORY_BAG_DIR": str(tmp_path)}))
    memory.index.refresh()
    assert memory.index.snapshot().timeline.topics() == ("/odom",)


def test_the_user_of_the_units_is_made() -> None:
    made = ran("systemd-sysusers", "--dry-run", DEPLOY / "ros2-memory.sysusers.conf")
    assert made.returncode == 0, made.stderr
    assert "ros2-memory" in (DEPLOY / "ros2-memory.sysusers.conf").read_text().split()
