"""`deploy/install.sh --root DIR`: what it makes, and what it leaves as it is when it runs again."""

import os
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
from ros2_memory.serving.given_tokens import CREDENTIAL
from tests.support.bags import odom, write_db3
from tests.support.housekeepers import state
from tests.support.memories import ROOT

DEPLOY = ROOT / "deploy"
SCRIPT = DEPLOY / "install.sh"
ENVIRONMENT = "etc/ros2-memory/environment"
RECORDER = "etc/systemd/system/ros2-memory-recorder.service"
SERVER = "etc/systemd/system/ros2-memory-server.service"
BAGS = "var/lib/ros2-memory/bags"
OF_BAGS = ("", ".episodic", ".episodic/requests")


def install(root: Path, *options: str, script: Path = SCRIPT) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["sh", script, "--root", root, *options], check=False, capture_output=True, text=True
    )


def installed(root: Path, *options: str, script: Path = SCRIPT) -> str:
    ran = install(root, *options, script=script)
    assert ran.returncode == 0, ran.stderr
    return ran.stdout


def release(folder: Path, unit: str) -> Path:
    """The script of another release, in which a file is another one."""
    for source in (*DEPLOY.iterdir(), ROOT / "config/topics.yaml"):
        copy = folder / source.relative_to(ROOT)
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_bytes(source.read_bytes())
    (folder / "deploy" / unit).write_text("[Service]\nExecStart=/bin/newer\n")
    return folder / "deploy/install.sh"


def test_a_clean_root_has_all_that_the_units_need(tmp_path: Path) -> None:
    installed(tmp_path)
    for name in (ENVIRONMENT, RECORDER, SERVER):
        assert (tmp_path / name).read_bytes() == (DEPLOY / Path(name).name).read_bytes()
        assert (tmp_path / name).stat().st_mode & 0o777 == 0o644
        lines = (tmp_path / name).read_text().splitlines()
        named = [re.sub(r"^\w+=-?", "", line) for line in lines if re.match("Read.*Paths=", line)]
        assert [path for path in named if not (tmp_path / path.lstrip("/")).is_dir()] == []
    topics = tmp_path / "etc/ros2-memory/topics.yaml"
    assert topics.read_bytes() == (ROOT / "config/topics.yaml").read_bytes()
    for folder in OF_BAGS:
        assert (tmp_path / BAGS / folder).stat().st_mode & 0o777 == 0o750
    assert (tmp_path / "etc/ros2-memory").stat().st_mode & 0o777 == 0o755


def test_a_list_of_topics_that_is_given_is_installed_and_replaces_none(tmp_path: Path) -> None:
    mine, root = tmp_path / "mine.yaml", tmp_path / "root"
    listed = root / "etc/ros2-memory/topics.yaml"
    for topic in ("/odom", "/tf"):
        mine.write_text(f"topics: [{topic}]\n")
        installed(root, "--topics", str(mine))
        assert listed.read_text() == "topics: [/odom]\n"
    assert listed.with_name("topics.yaml.new").read_text() == "topics: [/tf]\n"
    refused = install(tmp_path / "other", "--topics", str(tmp_path / "missing"))
    assert (refused.returncode, refused.stderr) == (1, "install.sh: --topics needs a file\n")
    assert not (tmp_path / "other").exists()


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give files away")
def test_bags_belong_to_the_user_and_the_folder_above_to_root(tmp_path: Path) -> None:
    installed(tmp_path)
    passwd = tmp_path / "etc/passwd"
    if not passwd.exists():
        pytest.skip("systemd-sysusers is not on this machine")
    [ids] = re.findall(r"^ros2-memory:[^:]*:(\d+):(\d+):", passwd.read_text(), re.MULTILINE)
    for folder in OF_BAGS:
        stat = (tmp_path / BAGS / folder).stat()
        assert (stat.st_uid, stat.st_gid) == (*map(int, ids),)
    above = (tmp_path / BAGS).parent.stat()
    assert (above.st_uid, above.st_mode & 0o777) == (0, 0o755)


def test_run_again_it_changes_nothing_and_names_nothing(tmp_path: Path) -> None:
    installed(tmp_path)
    folders = tmp_path / "var", tmp_path / "etc/ros2-memory"
    before = [state(folder) for folder in folders]
    assert "NAME.new" not in installed(tmp_path)
    assert [state(folder) for folder in folders] == before
    assert not [*tmp_path.rglob("*.new"), *tmp_path.rglob("*.part")]


@pytest.mark.parametrize(
    ("name", "is_edited", "is_replaced"),
    [
        (ENVIRONMENT, True, False),
        (ENVIRONMENT, False, False),  # a configuration is somebody's, also when nobody edited it
        (SERVER, True, False),
        (SERVER, False, True),
    ],
)
def test_a_newer_release_replaces_only_a_unit_that_nobody_changed(
    tmp_path: Path, name: str, is_edited: bool, is_replaced: bool
) -> None:
    newer, root = release(tmp_path / "newer", Path(name).name), tmp_path / "root"
    installed(root)
    if is_edited:
        (root / name).write_text("# mine\n")
    before = (root / name).read_bytes()
    for _ in range(1 if is_replaced else 2):
        said = installed(root, script=newer)
        if is_replaced:
            assert "ExecStart=/bin/newer" in (root / name).read_text()
            assert f"replaced /{name}" in said
            assert not [*root.rglob("*.new")]
        else:
            assert (root / name).read_bytes() == before
            assert "ExecStart=/bin/newer" in (root / f"{name}.new").read_text()
            assert f"  /{name}\n" in said


def test_existing_bags_keep_their_owner_and_mode(tmp_path: Path) -> None:
    recording = tmp_path / BAGS / "rec_1"
    recording.mkdir(parents=True, mode=0o777)
    (recording / "rec_1_0.mcap").write_bytes(b"kept")
    (tmp_path / BAGS).chmod(0o777)
    before = state(tmp_path / BAGS)
    installed(tmp_path)
    assert state(tmp_path / BAGS) == before


@pytest.mark.parametrize(
    "link",
    [
        ENVIRONMENT,
        f"{ENVIRONMENT}.new",
        RECORDER,
        "etc/ros2-memory",
        "etc/systemd",
        "usr/share/ros2-memory",
        "usr/lib/sysusers.d/ros2-memory.conf",
        "var/lib/ros2-memory",
        BAGS,
    ],
)
def test_a_link_on_the_way_is_named_and_nothing_is_installed(tmp_path: Path, link: str) -> None:
    root, elsewhere = tmp_path / "root", tmp_path / "elsewhere"
    elsewhere.mkdir()
    (root / link).parent.mkdir(parents=True)
    (root / link).symlink_to(elsewhere)
    before = state(tmp_path)
    ran = install(root)
    assert ran.returncode == 1
    assert str(root / link) in ran.stderr
    assert state(tmp_path) == before


def test_the_query_server_alone_comes_without_a_recorder(tmp_path: Path) -> None:
    said = installed(tmp_path, "--query-only")
    for folder, names in (
        ("etc/systemd/system", ["ros2-memory-query.service"]),
        ("etc/ros2-memory", ["query-environment"]),
    ):
        assert [path.name for path in (tmp_path / folder).iterdir()] == names
    assert not (tmp_path / BAGS).exists()
    assert "systemctl enable --now ros2-memory-query\n" in said


def test_an_interrupted_run_is_gone_on_with(tmp_path: Path) -> None:
    (tmp_path / f"{BAGS}.part/.episodic").mkdir(parents=True)
    (tmp_path / ENVIRONMENT).parent.mkdir(parents=True)
    (tmp_path / f"{ENVIRONMENT}.part").write_text("half")
    installed(tmp_path)
    assert (tmp_path / BAGS / ".episodic/requests").is_dir()
    assert not [*tmp_path.rglob("*.part")]


@pytest.mark.parametrize("options", [["--root"], ["--root", ""], ["--unknown"], ["x"]])
def test_what_it_does_not_know_is_refused(options: list[str]) -> None:
    ran = subprocess.run(["sh", SCRIPT, *options], check=False, capture_output=True, text=True)
    assert ran.returncode in {1, 2}
    assert ran.stderr


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
        "ReadWritePaths": [f"/{BAGS}"],
        # Not below the mount point of a disk that is not there.
        "RequiresMountsFor": [f"/{BAGS}"],
        "MemoryDenyWriteExecute": ["yes"],
    },
    "server": {
        "IPAddressAllow": ["localhost"],
        "ReadWritePaths": [f"-/{BAGS}/{REQUESTS_FOLDER}"],
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
        given = {"FASTDDS_BUILTIN_TRANSPORTS=UDPv4", f"MEMORY_BAG_DIR=/{BAGS}"}
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
