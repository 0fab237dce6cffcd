"""The home robot's sixty questions: the truth that judges answers, and a script that asks them."""

from __future__ import annotations

import asyncio
import json
import os
import re
from collections import Counter
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from benchmarks.home import flat
from benchmarks.home.__main__ import as_json, made, main
from benchmarks.home.asking import server_over, settings_for
from benchmarks.home.days import Scale
from benchmarks.home.instances import measured
from benchmarks.home.judging import Names, Number, Order, Series, Time, Words, YesNo
from benchmarks.home.questions import KINDS, questions
from benchmarks.home.truth import truth_of
from benchmarks.home.world import START_S

from ros2_memory.tools.replies import Reply

if TYPE_CHECKING:
    from benchmarks.home.instances import Measures
    from benchmarks.home.truth import ThingTruth, Truth

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


@pytest.mark.parametrize(("seed", "days"), [(1, 2), (2, 3), (3, 7)])
def test_other_worlds_have_the_same_questions(seed: int, days: int) -> None:
    asked = questions(Scale(seed=seed, days=days))
    assert {each.id for each in asked} == {each.id for each in questions(SCALE)}


def test_one_day_has_nothing_to_compare_with() -> None:
    with pytest.raises(ValueError, match="2 days"):
        questions(Scale(days=1))


def test_answers_are_judged_within_their_tolerance() -> None:
    assert Number(4.0).accepts(4)
    assert not Number(4.0).accepts(5)
    assert not Number(1.0).accepts(given=True)
    assert Time(START_S - 1, START_S + 1).accepts("2026-03-02T00:00:00")
    assert Time(START_S - 1, START_S + 1).accepts("2026-03-02T01:00:00+01:00")
    assert not Time(START_S - 1, START_S + 1).accepts("yesterday")
    assert Words(("kitchen",)).accepts("the Kitchen")
    assert Words((), ("bumper",)).accepts("nothing recorded")
    assert Words((), ("bumper",)).accepts("Nothing recorded, the bumper was free")
    assert not Words((), ("bumper",)).accepts("/bumper became true")
    assert Words((), ("cancel",)).accepts("no bump, error or cancel was recorded")
    assert Words((), ("bumper",)).accepts("None")
    assert not Words((), ("no way",)).accepts("No way to the goal")
    assert not Words(("abort",)).accepts("none")
    assert Words((), or_none=True).form() == 'a short word, or "none"'
    assert not Words(("kitchen",)).accepts(None)
    names = Names(frozenset({"mug"}), frozenset({"cup"}))
    assert names.accepts(["Mug", "cup"])
    assert not names.accepts(["cup"])
    assert not names.accepts(["mug", "dog"])
    series = Series({"a": Number(0.0), "b": Number(2.0, 0.5)})
    assert series.accepts({"b": 2.2})
    assert not series.accepts({"b": 2.2, "c": 1})
    assert Order(("hall", "study")).accepts(["Hall", "study"])
    assert not Order(("hall", "study")).accepts(["study", "hall"])
    assert YesNo(value=True).accepts(given=True)
    assert not YesNo(value=True).accepts(1)


def test_the_answers_of_a_planner_are_judged(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "answers.json").write_text(
        json.dumps({"count-chair": {"count": 4}, "count-plant": {"count": 4}, "crash": {}})
    )
    assert main(["--judge", str(tmp_path / "answers.json")]) == 0
    said = capsys.readouterr().out
    assert said.startswith("1 of 60 right")
    assert "wrong: count-plant: count" in said
    assert "count-chair" not in said


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
    assert sum(each["characters"] for each in outcomes) <= 60_000
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


def _reported(thing: ThingTruth, **more: object) -> dict[str, object]:
    """A thing as `find_things` should report it."""
    history = [
        {"x": stay.place.x, "y": stay.place.y, "from": stay.sight.first_detected}
        for stay in thing.known()
        if stay.place is not None
    ]
    return {"label": thing.label, **history[-1], "moved": history, **more}


class _Replies:
    """A server whose `find_things` reports what it is given."""

    def __init__(self, things: dict[str, list[dict[str, object]]]) -> None:
        self.dispatcher = self
        self.things = things

    async def answer(self, name: str, given: dict[str, str]) -> Reply:
        found = self.things[given["label"]]
        return Reply(json.dumps({"things": found, "total": len(found)}), is_error=False)


def _all_right() -> dict[str, list[dict[str, object]]]:
    found: dict[str, list[dict[str, object]]] = {}
    for thing in _truth().things:
        found.setdefault(thing.label, []).append(_reported(thing))
    return found


def _measures(things: dict[str, list[dict[str, object]]]) -> Measures:
    server: Any = _Replies(things)
    found = measured(server, _truth(), SCALE.split_s)
    assert found is not None
    return found


def test_the_truth_itself_measures_as_perfect() -> None:
    found = _measures(_all_right())
    assert found.right_labels == found.labels == len({each.label for each in _truth().things})
    assert max(found.away_m) == 0.0
    assert found.moves_in_time == found.moves >= 8
    assert not found.switches
    assert not found.denied


def test_what_is_wrong_with_instances_is_measured() -> None:
    things = _all_right()
    (mug,) = things["mug"]
    history = mug["moved"]
    assert isinstance(history, list)
    history[-1]["from"] += 2 * SCALE.split_s
    things["chair"].append({"label": "chair", "x": 5.0, "y": 5.0, "moved": []})
    things["sofa"][0]["still_there"] = {"not_seen_where_expected": 0.0}
    things["bed"][0]["moved"] = [{"x": 1.0, "y": 1.0, "from": 0.0}]
    found = _measures(things)
    assert found.wrong_numbers == ["chair 5 for 4"]
    assert [each.split(" to ")[0] for each in found.late_moves] == ["mug"]
    assert found.denied == ["sofa at 0.9, 0.9"]
    assert found.switches == ["bed at 1.0, 1.0"]
