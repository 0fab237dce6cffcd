"""The conformance run asks what its description lists, of pinned versions."""

from __future__ import annotations

import json
import re

import pytest

from tests.conformance import __main__ as conformance
from tests.support.memories import ROOT

HERE = ROOT / "tests" / "conformance"


def test_its_versions_are_exact() -> None:
    wanted = json.loads((HERE / "package.json").read_text())["dependencies"]
    assert [each for each in wanted.values() if not re.fullmatch(r"\d+\.\d+\.\d+", each)] == []


def test_its_readme_tells_of_every_scenario_that_applies() -> None:
    rows = re.findall(r"^\| (`.+?`) \|", (HERE / "README.md").read_text(), re.MULTILINE)
    assert {name for row in rows for name in re.findall(r"`(.+?)`", row)} == {*conformance.APPLYING}


def test_it_is_a_gate_that_may_say_that_it_was_not_evaluated() -> None:
    assert "tests/conformance/run" in (ROOT / ".ci/run").read_text()
    assert (HERE / "run").stat().st_mode & 0o111


def test_without_npm_it_says_that_nothing_was_evaluated(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(conformance, "NODE", ROOT / "nowhere" / "node")
    monkeypatch.setenv("PATH", "")
    assert conformance.main() == 3
    assert capsys.readouterr().out == ("conformance: not evaluated (npm is not on this machine)\n")
