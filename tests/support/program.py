"""The program `ros2-memory` in this process, held to its exit code."""

import json
import shlex
from typing import Any, NamedTuple

import pytest

from ros2_memory import cli


class Printed(NamedTuple):
    """What a command printed."""

    out: str
    err: str

    @property
    def json(self) -> Any:
        """What it printed for programs."""
        return json.loads(self.out)


class Program:
    """Runs commands, each of which must end with a certain exit code."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys

    def __call__(self, code: int, line: object, *words: object) -> Printed:
        self._capsys.readouterr()
        ended = cli.main([*shlex.split(str(line)), *map(str, words)])
        printed = Printed(*self._capsys.readouterr())
        assert ended == code, printed
        return printed


@pytest.fixture
def exits(capsys: pytest.CaptureFixture[str]) -> Program:
    """`exits(2, "cat /odom", "/a folder")`: the command must end with 2."""
    return Program(capsys)
