"""The first commands of README and of the how-to for Ubuntu 22.04, where nothing else is installed.

A fresh clone, an empty home, and a PATH with the system's commands and one Python. They install
from the network, so they run with EPISODIC_LONG=1 alone: in `.ci/run` and in the workflow.
"""

import os
import re
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Sequence
from pathlib import Path

import pytest

from tests.support.examples import LONG
from tests.support.memories import ROOT

pytestmark = pytest.mark.skipif(
    not LONG,
    reason="installs from the network, for a minute: EPISODIC_LONG=1",
)
FIRST = re.search(
    r"^python3 -m venv .+ros2-memory demo$",
    (ROOT / "README.md").read_text(),
    re.MULTILINE,
)
HUMBLE = re.search(
    r"## Ubuntu 22\.04 and Humble\n.*?```sh\n(.+?)```",
    (ROOT / "docs/how-to/robot.md").read_text(),
    re.DOTALL,
)
MANAGED = "[externally-managed]\nError=To install Python packages, use a virtual environment.\n"
"""As Debian's file, in fewer words (PEP 668)."""
OF_THE_NETWORK = re.compile(
    r"(https?|no)_proxy|(SSL|PIP|REQUESTS)_\w*(CERT|BUNDLE)\w*", re.IGNORECASE
)
SPARING = {"PIP_NO_COMPILE": "1"}
"""Python compiles what is imported; pip would compile all modules of all packages."""
BOUND_S = 600


def debian_like(folder: Path) -> Path:
    """A Python that its distribution manages; returns the folder of its program."""
    library = Path(sysconfig.get_path("stdlib"))
    own = folder / "lib" / library.name
    for path, target in ((own.parent, library.parent), (own, library)):
        path.mkdir(parents=True)
        for each in target.iterdir():
            if each != library and each.name != "EXTERNALLY-MANAGED":
                (path / each.name).symlink_to(each)
    (own / "EXTERNALLY-MANAGED").write_text(MANAGED)
    (folder / "bin").mkdir()
    program = Path(sys.base_prefix) / "bin" / f"python{sysconfig.get_python_version()}"
    shutil.copy2(program.resolve(), folder / "bin/python3")
    return folder / "bin"


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    subprocess.run(["git", "clone", "--quiet", ROOT, tmp_path / "clone"], check=True)
    return tmp_path / "clone"


def ran(script: str, clone: Path, programs: Path) -> subprocess.CompletedProcess[str]:
    home = clone.parent / "home"
    home.mkdir(exist_ok=True)
    network = {name: each for name, each in os.environ.items() if OF_THE_NETWORK.fullmatch(name)}
    return subprocess.run(
        ["/bin/bash", "-c", script],
        cwd=clone,
        env={**network, **SPARING, "HOME": str(home), "PATH": f"{programs}:/usr/bin:/bin"},
        capture_output=True,
        text=True,
        timeout=BOUND_S,
        check=False,
    )


def test_readmes_first_line_works_where_the_distribution_manages_python(
    clone: Path, tmp_path: Path
) -> None:
    programs = debian_like(tmp_path / "debian")
    refused = ran("python3 -m pip install .", clone, programs)
    assert "externally-managed-environment" in refused.stderr
    require_the_demo(clone, programs)


def require_the_demo(clone: Path, programs: Path) -> None:
    assert FIRST
    done = ran(f"{FIRST[0]} --once --port 0", clone, programs)
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(r"^(\d+) of \1 answers are right", done.stdout, re.MULTILINE)


def python_of(minors: Sequence[int], folder: Path) -> Path:
    """A folder whose `python3` is of one of these minor versions, the first that is here."""
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv"))
    places = [*map(Path, os.get_exec_path()), *pyenv.glob("versions/3.*/bin")]
    for program in (place / f"python3.{minor}" for minor in minors for place in places):
        # A shim of pyenv may be there and lead nowhere.
        if program.exists() and not subprocess.run([program, "-c", ""], check=False).returncode:
            folder.mkdir()
            (folder / "python3").symlink_to(program)
            return folder
    names = ", ".join(f"3.{minor}" for minor in minors)
    pytest.skip(f"none of these versions of Python is on this machine: {names}")


def test_readmes_first_line_works_with_the_python_of_ubuntu_24_04(
    clone: Path, tmp_path: Path
) -> None:
    """Or with a newer one: some of what 3.11 takes, these do not."""
    require_the_demo(clone, python_of((12, 13, 14), tmp_path / "newer"))


def test_an_older_python_is_refused_by_name_and_the_how_to_gets_a_newer_one(
    clone: Path, tmp_path: Path
) -> None:
    assert FIRST
    assert HUMBLE
    programs = python_of((10, 9), tmp_path / "older")
    refused = ran(FIRST[0], clone, programs)
    assert refused.returncode != 0
    assert re.search(r"requires a different Python: 3\.\d+\.\d+ not in '>=3\.11'", refused.stderr)
    done = ran(f"set -e\n{HUMBLE[1]}~/.local/bin/ros2-memory --version", clone, programs)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.splitlines()[-1].startswith("ros2-memory ")
