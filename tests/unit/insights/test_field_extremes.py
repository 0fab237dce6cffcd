from pathlib import Path

import pytest

from ros2_memory.history.context import Call
from ros2_memory.insights import fields
from tests.support.bags import boolean, odom, text, write_mcap
from tests.support.memories import asked, memory_of

S = 10**9
BEGIN = 1_784_000_000 * S


def test_a_window_with_too_many_messages_to_read_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_mcap(tmp_path / "bag.mcap", [odom(BEGIN + n * S, n, 0.0, 0.0) for n in range(9)])
    window = {"start": BEGIN / S, "end": BEGIN / S + 100, "fields": ["pose.covariance"]}
    memory = memory_of(tmp_path)
    whole = asked(memory, tmp_path, "get_topic_in_range", topic="/odom", **window)
    assert whole["extremes"]["pose.covariance"]["min"] == 0.0
    monkeypatch.setattr(fields, "MAX_MESSAGES", 3)
    answer = asked(memory, tmp_path, "get_topic_in_range", topic="/odom", **window)
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
