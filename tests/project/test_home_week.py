"""The benchmark of a home robot's week: it asks every tool, and measures what is stored."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from benchmarks.home_week import calls, main

if TYPE_CHECKING:
    from pathlib import Path

    import pytest

_OF_THE_DAY = {
    "find_things", "compare", "visits", "find_matches", "trajectory_summary",
    "get_topic_in_range", "recap", "memory_status", "data_time_range",
}  # fmt: skip


def test_each_call_has_a_name_of_its_own_and_names_a_tool() -> None:
    asked = calls(7)
    assert len({each.words for each in asked}) == len(asked)
    assert {each.tool for each in asked} >= _OF_THE_DAY


def test_a_short_day_is_asked_and_what_is_stored_of_it_is_counted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    told = tmp_path / "told.json"
    small = ["--days", "1", "--compression", "60", "--dir", str(tmp_path), "--json", str(told)]
    assert main([*small, "--only", "visits, all"]) == 0
    facts = json.loads(told.read_text(encoding="utf-8"))
    assert len(facts["speeds"]) == sum("visits, all" in each.words for each in calls(1))
    assert not [each for each in facts["speeds"] if each["trouble"]]
    content = {(each["table"], each["column"]): each["bytes_each"] for each in facts["stored"]}
    assert content["bags", "path"] > 0
    assert "catalogue:" in capsys.readouterr().out
