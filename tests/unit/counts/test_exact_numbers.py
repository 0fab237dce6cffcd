"""Numbers that are told apart, and counted, as what they are."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.support.bags import Msg, make, write_splits
from tests.support.memories import asked, each_way, memory_of

if TYPE_CHECKING:
    from pathlib import Path

S = 10**9
T0 = 1_790_000_000


def write(bag_dir: Path, *values: tuple[str, float]) -> None:
    """A message of /number each second; of each the type and the number."""
    messages = []
    for second, (name, number) in enumerate(values):
        kind = f"std_msgs/msg/{name}"
        # Its writer takes a byte for signed.
        is_byte = name == "Byte"
        body = bytes([0, 1, 0, 0, int(number)]) if is_byte else make(kind, data=number)
        messages.append(Msg("/number", kind, (T0 + second) * S, body))
    write_splits(bag_dir, messages)


@each_way
@pytest.mark.parametrize(
    ("kind", "numbers"),
    [
        ("Int64", [2**53 + 1, 2**53 + 3, 2**53 + 2]),
        ("UInt64", [2**63 + 1, 2**64 - 3, 2**64 - 1, 2**64 - 2]),
        ("Byte", [3, 200, 100]),
    ],
)
def test_the_least_and_greatest_of_whole_numbers_are_exact(
    tmp_path: Path, kind: str, numbers: list[int], *, recalls: bool
) -> None:
    write(tmp_path, *((kind, number) for number in numbers))
    memory = memory_of(tmp_path, recalls=recalls)
    given = {"topic": "/number", "start": T0, "end": T0 + 9, "fields": ["value"]}
    extremes = asked(memory, tmp_path, "get_topic_in_range", **given)["extremes"]["value"]
    assert (extremes["min"], extremes["max"]) == (min(numbers), max(numbers))
    assert extremes["max_at"] == T0 + numbers.index(max(numbers))
    counted = asked(memory, tmp_path, "get_topic_in_range", **given, by="hour")
    row = dict(zip(counted["columns"], counted["rows"][0], strict=True))
    assert (row["value.min"], row["value.max"]) == (min(numbers), max(numbers))
    assert row["value.max_at_unix"] == extremes["max_at"]


@each_way
def test_equal_numbers_are_one_value_whatever_their_sign_of_zero_or_type(
    tmp_path: Path, *, recalls: bool
) -> None:
    zeros = [("Float64", -0.0 if second % 2 else 0.0) for second in range(6)]
    write(tmp_path, *zeros, ("Float64", 2.0), ("Float64", 2.0), ("Int32", 2), ("Float64", 2.5))
    memory = memory_of(tmp_path, recalls=recalls)
    given = {"topic": "/number", "start": T0, "end": T0 + 9}
    changes = asked(memory, tmp_path, "get_topic_in_range", **given, changes=True)["changes"]
    assert [change["value"] for change in changes] == [0, 2, 2.5]
    rows = asked(memory, tmp_path, "get_topic_in_range", **given, by="value")["rows"]
    assert sorted(row[0] for row in rows) == ["0", "2", "2.5"]


@each_way
def test_a_byte_has_no_sign(tmp_path: Path, *, recalls: bool) -> None:
    write(tmp_path, ("Byte", 200), ("Byte", 3))
    memory = memory_of(tmp_path, recalls=recalls)
    given = {"topic": "/number", "condition_type": "above", "value": 100, "field": "value"}
    found = asked(memory, tmp_path, "find_last_match", **given)
    assert (found["timestamp"], found["value"]["value"]) == (T0, 200)
