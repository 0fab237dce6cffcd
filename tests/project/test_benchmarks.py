"""The benchmark: its worlds are asked as a server is. No time is judged."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest
from benchmarks import worlds
from benchmarks.__main__ import main

if TYPE_CHECKING:
    from pathlib import Path

SEED = 0xC0FFEE


def test_the_command_fills_asks_and_prints_one_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    worlds.made(worlds.SPLITS, SEED, 12, tmp_path)
    told = tmp_path / "figures.json"
    options = ["--world", "splits_week", "--bags", "12", "--seed", f"{SEED:x}"]
    options += ["--dir", str(tmp_path), "--json", str(told)]
    assert main([*options, "--only", "position at a time"]) == 0
    printed = capsys.readouterr().out
    lines = {line["figure"]: line for line in json.loads(told.read_bytes())["lines"]}
    assert len(lines) == 8
    assert all(figure in printed for figure in lines)
    position = lines["position at a time"]
    assert (position["plain"][-2:], position["floor"][-2:]) == ("ms", "ms")
    assert not position["trouble"]
