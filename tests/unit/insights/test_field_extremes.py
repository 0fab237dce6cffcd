from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from ros2_memory import queries
from ros2_memory.history.context import Call
from ros2_memory.history.view import TimeRange
from ros2_memory.insights import fields
from ros2_memory.tools.replies import Replies, as_json
from tests.support.bags import Msg, boolean, detections, odom, text, write_mcap
from tests.support.memories import memory_of

if TYPE_CHECKING:
    from ros2_memory.core.model import JsonValue
    from ros2_memory.results import TopicRange

S = 10**9
BEGIN = 1_784_000_000 * S
WHOLE = TimeRange(start_s=BEGIN / S, end_s=BEGIN / S + 100)


def asked(folder: Path, messages: list[Msg], *fields: str, most: int = 2) -> TopicRange:
    write_mcap(folder / "bag.mcap", messages)
    topic = messages[0].topic
    return queries.topic_range(
        memory_of(folder), Call(), topic, WHOLE, max_samples=most, fields=fields
    )


def test_extremes_are_of_all_messages_and_not_of_the_samples(tmp_path: Path) -> None:
    heights = [0.0, 3.0, -2.0, 3.0, -2.0, 1.0]
    driven = [odom(BEGIN + n * S, x, 1.0, 0.0) for n, x in enumerate(heights)]
    answer = asked(tmp_path, driven, "position.x", "position.y")
    [x, y] = answer.extremes
    assert (x.field, x.least, x.most) == ("position.x", -2.0, 3.0)
    assert (x.least_at, x.most_at) == (BEGIN + 2 * S, BEGIN + S)
    assert (y.least, y.most, y.least_at) == (1.0, 1.0, BEGIN)
    reply: JsonValue = json.loads(Replies(tmp_path, 24_000).answer(answer).text)
    assert isinstance(reply, dict)
    assert reply["extremes"] == {
        "position.x": {
            "min": -2.0,
            "min_at": BEGIN / S + 2,
            "max": 3.0,
            "max_at": BEGIN / S + 1,
        },
        "position.y": {"min": 1.0, "min_at": BEGIN / S, "max": 1.0, "max_at": BEGIN / S},
    }


def test_without_fields_and_of_what_is_no_number_there_are_none(tmp_path: Path) -> None:
    said = [text(BEGIN + n * S, f"word {n}") for n in range(3)]
    assert asked(tmp_path, said).extremes == ()
    answer = asked(tmp_path, said, "value")
    assert answer.extremes == ()
    assert "extremes" not in str(as_json(answer, Path()))
    assert asked(tmp_path, [boolean(BEGIN, data=True)], "value").extremes == ()


def test_fields_that_only_the_messages_have_have_extremes(tmp_path: Path) -> None:
    driven = [odom(BEGIN + n * S, n, 0.0, 0.0) for n in range(3)]
    paths = "position.x", "pose.pose.position.x", "header.stamp.sec", "pose.pose.orientation.w"
    own, full, second, w = asked(tmp_path, driven, *paths).extremes
    assert full.field == "pose.pose.position.x"
    assert (full.least, full.most) == (own.least, own.most) == (0.0, 2.0)
    assert (second.least, second.most) == (BEGIN // S, BEGIN // S + 2)
    assert (w.least, w.most, w.most_at) == (1.0, 1.0, BEGIN)


def test_a_field_that_leads_into_a_list_means_all_of_it(tmp_path: Path) -> None:
    seen = [detections(BEGIN, ["cup", "fork"]), detections(BEGIN + S, [])]
    [score] = asked(tmp_path, seen, "detections.point.x").extremes
    assert score.least <= score.most
    assert score.least_at == score.most_at == BEGIN


def test_a_window_of_any_length_has_extremes_of_fields_that_columns_hold(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fields, "MAX_MESSAGES", 3)
    driven = [odom(BEGIN + n * S, n, 0.0, 0.0) for n in range(9)]
    [x] = asked(tmp_path, driven, "position.x").extremes
    assert (x.least, x.least_at, x.most, x.most_at) == (0.0, BEGIN, 8.0, BEGIN + 8 * S)


def test_a_window_with_too_many_messages_to_read_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    driven = [odom(BEGIN + n * S, n, 0.0, 0.0) for n in range(9)]
    [covariance] = asked(tmp_path, driven, "pose.covariance").extremes
    assert (covariance.least, covariance.least_at) == (0.0, BEGIN)
    monkeypatch.setattr(fields, "MAX_MESSAGES", 3)
    answer = asked(tmp_path, driven, "pose.covariance")
    assert answer.extremes == ()
    assert fields.TOO_MANY in answer.notes


@pytest.mark.parametrize("apart", [True, False])
def test_a_type_that_a_topic_had_before_is_described(tmp_path: Path, apart: bool) -> None:
    """Also where the last message of it and one of the new type have the same log time."""
    said, flag = text(BEGIN, "a word", "/t"), boolean(BEGIN + apart * S, True, "/t")
    if apart:
        write_mcap(tmp_path / "a.mcap", [said])
        write_mcap(tmp_path / "b.mcap", [flag])
    else:
        write_mcap(tmp_path / "a.mcap", [said, flag])
    for message, kind in ((said, "text"), (flag, "boolean")):
        answer = fields.describe_type(memory_of(tmp_path), Call(), message.type)
        assert (answer.topics, answer.fields) == (("/t",), (("value", kind),))
