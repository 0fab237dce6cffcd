"""`deploy/install.sh --root DIR`: what it makes, and what it leaves as it is when it runs again."""

from __future__ import annotations

import os
import re
import subprocess
from pathlib import Path

import pytest

from tests.support.memories import ROOT

DEPLOY = ROOT / "deploy"
SCRIPT = DEPLOY / "install.sh"
ENVIRONMENT = "etc/ros2-memory/environment"
RECORDER = "etc/systemd/system/ros2-memory-recorder.service"
SERVER = "etc/systemd/system/ros2-memory-server.service"
BAGS = "var/lib/ros2-memory/bags"


def install(root: Path, *options: str, script: Path = SCRIPT) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["sh", script, "--root", root, *options], check=False, capture_output=True, text=True
    )


def installed(root: Path, *options: str, script: Path = SCRIPT) -> str:
    ran = install(root, *options, script=script)
    assert ran.returncode == 0, ran.stderr
    return ran.stdout


def tree(root: Path) -> dict[str, tuple[int, int, int, int, bytes]]:
    """Mode, owner, group, change and content of all below a folder."""
    found = {}
    for path in sorted(root.rglob("*")):
        stat = path.lstat()
        content = path.read_bytes() if path.is_file() else b""
        found[str(path.relative_to(root))] = (
            stat.st_mode,
            stat.st_uid,
            stat.st_gid,
            stat.st_ctime_ns,
            content,
        )
    return found


def release(folder: Path, unit: str) -> Path:
    """The script of another release, in which a unit is another one."""
    for part in ("deploy", "config"):
        (folder / part).mkdir(parents=True)
    for source in (*DEPLOY.iterdir(), ROOT / "config/topics.yaml"):
        copy = folder / source.relative_to(ROOT)
        copy.write_bytes(source.read_bytes())
    (folder / "deploy" / unit).write_text("[Service]\nExecStart=/bin/newer\n")
    return folder / "deploy/install.sh"


def test_a_clean_root_has_all_that_the_units_need(tmp_path: Path) -> None:
    installed(tmp_path)
    for name in (ENVIRONMENT, RECORDER, SERVER):
        assert (tmp_path / name).read_bytes() == (DEPLOY / Path(name).name).read_bytes()
        assert (tmp_path / name).stat().st_mode & 0o777 == 0o644
    topics = tmp_path / "etc/ros2-memory/topics.yaml"
    assert topics.read_bytes() == (ROOT / "config/topics.yaml").read_bytes()
    for folder in ("", ".episodic", ".episodic/requests"):
        assert (tmp_path / BAGS / folder).stat().st_mode & 0o777 == 0o750
    assert (tmp_path / "etc/ros2-memory").stat().st_mode & 0o777 == 0o755


def test_a_list_of_topics_that_is_given_is_installed_and_replaces_none(tmp_path: Path) -> None:
    mine, root = tmp_path / "mine.yaml", tmp_path / "root"
    mine.write_text("topics: [/odom]\n")
    installed(root, "--topics", str(mine))
    listed = root / "etc/ros2-memory/topics.yaml"
    assert listed.read_text() == "topics: [/odom]\n"
    assert (root / ENVIRONMENT).read_bytes() == (DEPLOY / "environment").read_bytes()
    mine.write_text("topics: [/tf]\n")
    installed(root, "--topics", str(mine))
    assert listed.read_text() == "topics: [/odom]\n"
    assert listed.with_name("topics.yaml.new").read_text() == "topics: [/tf]\n"
    refused = install(tmp_path / "other", "--topics", str(tmp_path / "missing"))
    assert (refused.returncode, refused.stderr) == (1, "install.sh: --topics needs a file\n")
    assert not (tmp_path / "other").exists()


def test_every_folder_that_the_units_name_is_made(tmp_path: Path) -> None:
    installed(tmp_path)
    for unit in (RECORDER, SERVER):
        lines = (tmp_path / unit).read_text().splitlines()
        named = [re.sub(r"^\w+=-?", "", line) for line in lines if re.match("Read.*Paths=", line)]
        assert named
        assert [path for path in named if not (tmp_path / path.lstrip("/")).is_dir()] == []


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give files away")
def test_bags_belong_to_the_user_and_the_folder_above_to_root(tmp_path: Path) -> None:
    installed(tmp_path)
    passwd = tmp_path / "etc/passwd"
    if not passwd.exists():
        pytest.skip("systemd-sysusers is not on this machine")
    [line] = [line for line in passwd.read_text().splitlines() if line.startswith("ros2-memory:")]
    uid, gid = map(int, line.split(":")[2:4])
    for folder in ("", ".episodic", ".episodic/requests"):
        stat = (tmp_path / BAGS / folder).stat()
        assert (stat.st_uid, stat.st_gid) == (uid, gid)
    above = (tmp_path / BAGS).parent.stat()
    assert (above.st_uid, above.st_mode & 0o777) == (0, 0o755)


def test_run_again_it_changes_nothing_and_names_nothing(tmp_path: Path) -> None:
    installed(tmp_path)
    before = tree(tmp_path / "var") | tree(tmp_path / "etc/ros2-memory")
    said = installed(tmp_path)
    assert tree(tmp_path / "var") | tree(tmp_path / "etc/ros2-memory") == before
    assert "NAME.new" not in said
    assert not [*tmp_path.rglob("*.new"), *tmp_path.rglob("*.part")]


@pytest.mark.parametrize("name", [ENVIRONMENT, RECORDER])
def test_what_was_edited_stays_and_ours_is_put_beside_it_and_named(
    tmp_path: Path, name: str
) -> None:
    installed(tmp_path)
    (tmp_path / name).write_text("# mine\n")
    for _ in range(2):
        said = installed(tmp_path)
        assert (tmp_path / name).read_text() == "# mine\n"
        beside = tmp_path / f"{name}.new"
        assert beside.read_bytes() == (DEPLOY / Path(name).name).read_bytes()
        assert f"  /{name}\n" in said


def test_a_newer_unit_replaces_the_one_that_nobody_changed(tmp_path: Path) -> None:
    newer = release(tmp_path / "newer", "ros2-memory-server.service")
    root = tmp_path / "root"
    installed(root)
    said = installed(root, script=newer)
    assert "ExecStart=/bin/newer" in (root / SERVER).read_text()
    assert f"replaced /{SERVER}" in said
    assert not [*root.rglob("*.new")]


def test_a_newer_unit_does_not_replace_one_that_was_changed(tmp_path: Path) -> None:
    newer = release(tmp_path / "newer", "ros2-memory-server.service")
    root = tmp_path / "root"
    installed(root)
    (root / SERVER).write_text("# mine\n")
    for _ in range(2):
        assert f"  /{SERVER}\n" in installed(root, script=newer)
        assert (root / SERVER).read_text() == "# mine\n"
        assert "ExecStart=/bin/newer" in (root / f"{SERVER}.new").read_text()


def test_a_newer_configuration_never_replaces_the_one_in_use(tmp_path: Path) -> None:
    newer = release(tmp_path / "newer", "environment")
    root = tmp_path / "root"
    installed(root)
    before = (root / ENVIRONMENT).read_bytes()
    assert f"  /{ENVIRONMENT}\n" in installed(root, script=newer)
    assert (root / ENVIRONMENT).read_bytes() == before


def test_existing_bags_keep_their_owner_and_mode(tmp_path: Path) -> None:
    recording = tmp_path / BAGS / "rec_1"
    recording.mkdir(parents=True, mode=0o777)
    (recording / "rec_1_0.mcap").write_bytes(b"kept")
    (tmp_path / BAGS).chmod(0o777)
    before = tree(tmp_path / BAGS), (tmp_path / BAGS).stat().st_ctime_ns
    installed(tmp_path)
    assert (tree(tmp_path / BAGS), (tmp_path / BAGS).stat().st_ctime_ns) == before


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
    before = tree(root)
    ran = install(root)
    assert ran.returncode == 1
    assert str(root / link) in ran.stderr
    assert tree(root) == before
    assert [*elsewhere.iterdir()] == []


def test_the_query_server_alone_comes_without_a_recorder(tmp_path: Path) -> None:
    said = installed(tmp_path, "--query-only")
    assert {path.name for path in (tmp_path / "etc/systemd/system").iterdir()} == {
        "ros2-memory-query.service"
    }
    assert {path.name for path in (tmp_path / "etc/ros2-memory").iterdir()} == {"query-environment"}
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


def test_no_service_is_started_stopped_or_restarted() -> None:
    calls = re.findall(r"^ *(?:if )?systemctl (.+)$", SCRIPT.read_text(), re.MULTILINE)
    assert [call.split()[0] for call in calls] == ["daemon-reload", "is-active"]
    assert SCRIPT.read_text().startswith("#!/bin/sh\n")
    assert "\nset -eu\n" in SCRIPT.read_text()
    assert os.access(SCRIPT, os.X_OK)
