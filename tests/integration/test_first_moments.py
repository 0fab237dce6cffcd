"""Ctrl-C before a program has begun."""

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.processes import PATIENCE_S

INTERRUPTING = """
import os, signal, sys
class Interrupting:
    def find_spec(self, name, path=None, target=None):
        if name == os.environ["INTERRUPTED_AT"]:
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Interrupting())
"""


@pytest.mark.parametrize(
    ("program", "module"),
    [
        pytest.param("ros2-memory", "typer", id="ros2-memory"),
        pytest.param("ros2-memory-recorder", "structlog", id="recorder"),
        pytest.param("ros2-memory-server", "structlog", id="server"),
    ],
)
def test_ctrl_c_while_a_program_imports_ends_it_without_a_traceback(
    tmp_path: Path, program: str, module: str
) -> None:
    (tmp_path / "sitecustomize.py").write_text(INTERRUPTING, encoding="utf-8")
    path = shutil.which(program, path=Path(sys.executable).parent)
    assert path is not None
    ended = subprocess.run(
        [path, "--help"],
        env=os.environ | {"PYTHONPATH": str(tmp_path), "INTERRUPTED_AT": module},
        capture_output=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert (ended.returncode, ended.stdout, ended.stderr) == (-signal.SIGINT, b"", b"")
