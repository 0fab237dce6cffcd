"""`.ci/browser`, among commands that play a machine with or without root, apt and a browser."""

from __future__ import annotations

import shutil
import subprocess
from typing import TYPE_CHECKING

import pytest

from tests.support.memories import ROOT

if TYPE_CHECKING:
    from pathlib import Path

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
