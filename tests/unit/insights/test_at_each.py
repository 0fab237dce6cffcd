"""Several moments in one question: each is answered as if it were asked alone."""

from pathlib import Path

import pytest

from ros2_memory.core.errors import NoDataReason
from ros2_memory.history.context import Call, Memory
from ros2_memory.insights import fields
from tests.support.bags import boolean, detections, odom, text, tf, transform, write_mcap
from tests.support.memories import asked, memory_of

S = 10**9
T0 = 1_700_000_000


@pytest.fixture(scope="module")
def memory(tmp_path_factory: pytest.TempPathFactory) -> Memory:
    """Odometry along x at 1 m/s in two bags, with a hole of 10 s between them."""
    folder = tmp_path_factory.mktemp("bags")
    for number, begin in enumerate((0, 20)):
        messages = [
            each
            for at in range(begin, begin + 10)
            for each in (
                odom((T0 + at) * S, float(at)),
                tf((T0 + at) * S, transform((T0 + at) * S, "odom", "base_link", (at, 0.0, 0.0))),
                detections((T0 + at) * S, ["cup"]),
            )
        ]
        write_mcap(folder / "a" / f"a_{number}.mcap", messages)
    return memory_of(folder)


def test_an_error_takes_the_place_of_what_is_not_there(memory: Memory) -> None:
    times = [T0 + 5, T0 + 14.5, T0 + 15.5, T0 + 25, T0 + 5000]
    told = asked(memory, "get_position_at", timestamps=times)
    first, hole, again, last, beyond = told["results"]
    assert (first["x"], last["x"]) == (5.0, 25.0)
    assert (hole["at"], hole["error"], hole["reason"]) == (T0 + 14.5, "no_data", NoDataReason.GAP)
    assert "tolerance_s" in hole["detail"]
    # What one reason means is told once.
    assert again == {"at": T0 + 15.5, "error": "no_data", "reason": "gap"}
    assert (beyond["at"], beyond["reason"]) == (T0 + 5000, "outside_range")
    assert "detail" in beyond


def test_what_is_nowhere_is_an_error_as_for_one_moment(memory: Memory) -> None:
    for timestamps in ({"timestamps": [T0, T0 + 1]}, {"timestamp": T0}):
        told = asked(memory, "get_topic_at_time", topic="/nope", **timestamps)
        assert (told["error"], told["reason"]) == ("no_data", "topic_not_recorded")
    refused = asked(memory, "get_position_at", timestamps=[T0], topic="/vision/*")
    assert "error" in refused


def test_a_note_on_several_of_them_is_told_once(tmp_path: Path) -> None:
    messages = [odom((T0 + at) * S, float("nan")) for at in range(3)]
    messages.append(odom((T0 + 3) * S, 1.0))
    write_mcap(tmp_path / "a" / "a_0.mcap", messages)
    memory = memory_of(tmp_path)
    told = asked(memory, "get_position_at", timestamps=[T0, T0 + 1, T0 + 3])
    assert told["notes"] == ["the recorded position is not a number"]
    assert all("notes" not in each for each in told["results"])
    alone = asked(memory, "get_position_at", timestamps=[T0, T0 + 3])
    assert [each.get("notes") for each in alone["results"]] == [told["notes"], None]
    assert "notes" not in alone


BEGIN = 1_784_000_000 * S


def test_a_window_with_too_many_messages_to_read_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_mcap(tmp_path / "bag.mcap", [odom(BEGIN + n * S, n) for n in range(9)])
    window = {"start": BEGIN / S, "end": BEGIN / S + 100, "fields": ["pose.covariance"]}
    memory = memory_of(tmp_path)
    whole = asked(memory, "get_topic_in_range", topic="/odom", **window)
    assert whole["extremes"]["pose.covariance"]["min"] == 0.0
    monkeypatch.setattr(fields, "MAX_MESSAGES", 3)
    answer = asked(memory, "get_topic_in_range", topic="/odom", **window)
    assert "extremes" not in answer
    assert fields.TOO_MANY in answer["notes"]


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
