"""The home robot's sixty questions: the truth that judges answers, and a script that asks them."""

from __future__ import annotations

import asyncio
import json
import os
import re
from collections import Counter
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from benchmarks.home import flat
from benchmarks.home.__main__ import as_json, made, main
from benchmarks.home.asking import server_over, settings_for
from benchmarks.home.days import Scale
from benchmarks.home.questions import KINDS, questions
from benchmarks.home.truth import truth_of

if TYPE_CHECKING:
    from benchmarks.home.truth import Truth

pytestmark = pytest.mark.xdist_group("home")

SCALE = Scale()
MOST_CHARS = 6_000
"""Of a reply: what a planner can take in beside much else."""
COMMITTED = Path(__file__).resolve().parents[2] / "benchmarks" / "home" / "questions.json"


def _truth() -> Truth:
    return truth_of(SCALE)


def test_there_are_sixty_questions_of_every_kind_and_the_file_holds_them() -> None:
    asked = questions(SCALE)
    assert len({each.id for each in asked}) == len({each.text for each in asked}) == 60
    assert {each.kind for each in asked} == set(KINDS)
    text = json.dumps(as_json(SCALE), indent=1) + "\n"
    if os.environ.get("UPDATE_DOCS"):
        COMMITTED.write_text(text, encoding="utf-8")
    assert json.loads(COMMITTED.read_text(encoding="utf-8")) == json.loads(text)


def test_the_script_counts_what_is_right_and_what_no_tool_answers_yet(
    tmp_path: Path, worlds: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    told = tmp_path / "outcomes.json"
    assert main(["--dir", str(worlds), "--json", str(told)]) == 0
    said = capsys.readouterr().out
    assert "| all | 60 |" in said
    # Whatever else it measures of things is right, too.
    assert "right number of instances: 22 of 22\n" in said
    assert re.search(r"moves known within one split: (\d+) of \1\n", said)
    assert re.search(r"0\.\d+ m median", said)
    assert "where a thing never stood: 0," in said
    assert "denied where the thing does stand: 0" in said
    assert re.search(r"as of the end of each recorded time: [1-9]", said)
    assert "denied where nobody looked: 0" in said
    assert "denied although it stood there: 0" in said
    outcomes = json.loads(told.read_text(encoding="utf-8"))
    results = Counter(each["result"] for each in outcomes)
    assert results["right"] == 60
    assert not [each for each in outcomes if each["result"] == "wrong"]
    assert sum(each["calls"] for each in outcomes) <= 75
    assert sum(each["characters"] for each in outcomes) <= 62_000
    assert max(each["longest_reply"] for each in outcomes) <= MOST_CHARS


def test_no_reply_about_things_or_differences_is_longer_than_6_kb(worlds: Path) -> None:
    server = server_over(settings_for(made(SCALE, worlds), SCALE.split_s))
    runs = _truth().recorded
    known = runs[0][0], runs[-1][1]
    asked: list[tuple[str, dict[str, object]]] = [("find_things", {})]
    asked += [("find_things", {"where": name}) for name in flat.ROOMS]
    asked += [
        ("compare", {"start": b, "end": d, "with_start": a, "with_end": c})
        for (a, c), (b, d) in [*pairwise(runs), (runs[0], runs[-1]), (runs[0], known)]
    ]
    longest = dict.fromkeys(("find_things", "compare"), 0)
    for tool, given in asked:
        reply = asyncio.run(server.dispatcher.answer(tool, given))
        assert not reply.is_error, (tool, given, reply.text)
        longest[tool] = max(longest[tool], len(reply.text))
    assert all(2_000 < each <= MOST_CHARS for each in longest.values()), longest
