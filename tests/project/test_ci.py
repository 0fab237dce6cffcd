"""What `.ci` looks for on a machine, among commands that play one with or without it."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.support.memories import ROOT

BASH = shutil.which("bash")
INSTALLS = """case "$*" in
  *--download-only*|update*) ;;
  *install*chromium*)
    for name in chromium chromedriver; do echo >"{bin}/$name"; chmod +x "{bin}/$name"; done ;;
esac"""


def command(folder: Path, name: str, script: str) -> None:
    path = folder / name
    path.write_text(f"#!{BASH}\n{script}\n")
    path.chmod(0o755)


@pytest.fixture
def machine(tmp_path: Path) -> Path:
    """A folder of commands: root, without a browser and without apt."""
    folder = tmp_path / "bin"
    folder.mkdir()
    command(folder, "id", "echo 0")
    command(folder, "timeout", 'shift; exec "$@"')
    chmod = shutil.which("chmod")
    assert chmod
    (folder / "chmod").symlink_to(chmod)
    return folder


def told(machine: Path) -> str:
    """The line that it prints; its exit code is always 0."""
    assert BASH
    ran = subprocess.run(
        [BASH, ROOT / ".ci/browser"],
        env={"PATH": str(machine)},
        check=False,
        capture_output=True,
        text=True,
    )
    assert ran.returncode == 0, ran.stderr
    [line] = ran.stdout.splitlines()
    return line


def test_a_browser_that_is_there_is_taken(machine: Path) -> None:
    for name in ("chromium", "chromedriver"):
        command(machine, name, "")
    command(machine, "apt-get", "exit 1")
    assert told(machine) == "is there"


def test_root_installs_the_one_of_debian(machine: Path) -> None:
    command(machine, "apt-get", INSTALLS.format(bin=machine))
    assert told(machine) == "installed"


@pytest.mark.parametrize("failing", ["update", "--download-only", "--no-download"])
def test_what_cannot_be_installed_is_said_and_fails_nothing(machine: Path, failing: str) -> None:
    refusal = f'echo "from apt"; case "$*" in *{failing}*) exit 100 ;; esac\n'
    command(machine, "apt-get", refusal + INSTALLS.format(bin=machine))
    assert told(machine).startswith("not there, and apt could not install it in time; ")


def test_an_installation_that_brings_no_browser_is_none(machine: Path) -> None:
    command(machine, "apt-get", "")
    assert told(machine).endswith("the tests of the page in a browser are skipped")


@pytest.mark.parametrize("lacking", ["root", "apt"])
def test_without_root_or_apt_nothing_is_tried(machine: Path, lacking: str) -> None:
    if lacking == "root":
        command(machine, "id", "echo 1000")
        command(machine, "apt-get", INSTALLS.format(bin=machine))
    assert told(machine).startswith("not there, and installed only by root with apt; ")
    assert not (machine / "chromium").exists()


INSTALLER = """mkdir -p "$1/bin"; echo set up >&2; echo once >>"$1/../times"
printf '#!%s\\nexit 0\\n' "$BASH" >"$1/bin/ros2"; chmod +x "$1/bin/ros2"
echo "export PATH='$1/bin':\\$PATH" | sed "s|'build|'$PWD/build|" >"$1/setup.bash"
"""
no_distribution = pytest.mark.skipif(
    any(Path("/opt/ros").glob("*/setup.bash")), reason="this machine has a distribution, which wins"
)


def recorder(folder: Path, **known: str) -> tuple[int, str]:
    """Exit code and line of `.ci/real-recorder` in a checkout of nothing else."""
    script = folder / "checkout" / ".ci" / "real-recorder"
    script.parent.mkdir(parents=True, exist_ok=True)
    shutil.copy(ROOT / ".ci/real-recorder", script)
    ran = subprocess.run(
        [script],
        env={"PATH": os.environ["PATH"], **known},
        check=False,
        capture_output=True,
        text=True,
    )
    [line] = ran.stdout.splitlines()
    return ran.returncode, line


@pytest.fixture
def bundle(tmp_path: Path) -> Path:
    """A bundle beside the checkout, where it is looked for."""
    folder = tmp_path / "shared" / "ros2-jazzy"
    folder.mkdir(parents=True)
    command(folder, "install.sh", INSTALLER)
    return folder


def test_the_real_recorder_is_the_one_that_is_named(tmp_path: Path, bundle: Path) -> None:
    setup = tmp_path / "setup.bash"
    command(tmp_path, "ros2", "exit 0")
    setup.write_text(f"export PATH={tmp_path}:$PATH\n")
    assert recorder(tmp_path, EPISODIC_ROS_SETUP=str(setup)) == (0, str(setup))
    command(tmp_path, "ros2", "echo 'no plugin'; exit 1")
    code, reason = recorder(tmp_path, EPISODIC_ROS_SETUP=str(setup))
    assert (code, reason.partition(" of ")[2]) == (1, f"{setup} does not run: no plugin")
    assert recorder(tmp_path, EPISODIC_ROS_SETUP="/not") == (1, "there is no file /not")


@no_distribution
def test_the_bundle_is_set_up_once_for_each_content_of_it(tmp_path: Path, bundle: Path) -> None:
    first, again = recorder(tmp_path), recorder(tmp_path)
    assert first == again
    (bundle / "prefix.tar.xz").write_text("another\n")
    other = recorder(tmp_path, EPISODIC_ROS_BUNDLE=str(bundle))
    assert (first[0], other[0]) == (0, 0)
    assert first[1] != other[1]
    assert (tmp_path / "checkout/build/times").read_text() == "once\n" * 2


@no_distribution
def test_a_bundle_that_is_not_there_or_cannot_be_set_up_is_said(
    tmp_path: Path, bundle: Path
) -> None:
    command(bundle, "install.sh", "echo '  no wheels'; echo; exit 3")
    code, reason = recorder(tmp_path)
    assert (code, reason.endswith("install.sh failed:   no wheels")) == (1, True)
    command(bundle, "install.sh", "sleep 60")
    code, reason = recorder(tmp_path, EPISODIC_ROS_INSTALL_S="0.1")
    assert (code, reason.endswith("install.sh took too long")) == (1, True)
    code, reason = recorder(tmp_path, EPISODIC_ROS_BUNDLE="/not")
    assert (code, reason.endswith("and /not no install.sh")) == (1, True)
