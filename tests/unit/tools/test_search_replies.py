"""What a planner reads where it searched: a match, `null`, or what could not be searched."""

from collections.abc import Callable
from pathlib import Path

import pytest
from mcap.opcode import Opcode

from ros2_memory.bag_dir.state_files import Loss, append_losses
from tests.support.bags import (
    boolean,
    detections,
    log_entry,
    octets,
    write_mcap,
)
from tests.support.housekeepers import described, own_all
from tests.support.mcap_surgery import change_index, chunks_of, edit_summary
from tests.support.memories import Remember, asked, each_way, memory_of

S = 10**9
T0_S = 1_784_000_000
T0 = T0_S * S


@pytest.fixture
def bag_dir(tmp_path: Path) -> Path:
    first = [
        log_entry(T0, 20, "driver", "started"),
        boolean(T0 + S, True),
        detections(T0 + 3 * S, ["cup"]),
    ]
    second = [
        log_entry(T0 + 10 * S, 30, "driver", "retry"),
        boolean(T0 + 11 * S, False),
        detections(T0 + 13 * S, []),
    ]
    third = [log_entry(T0 + 20 * S, 20, "driver", "done"), boolean(T0 + 21 * S, False)]
    for nth, messages in enumerate([first, second, third]):
        write_mcap(tmp_path / "rec" / f"rec_{nth}.mcap", messages)
    return tmp_path


def test_that_a_long_array_was_not_searched_is_said_whatever_the_newest_is(
    tmp_path: Path, remember: Remember
) -> None:
    for nth in range(3):
        held = [octets(T0 + (10 * nth + at) * S, [7] * 4) for at in range(3)]
        if nth == 1:
            held.append(octets(T0 + 15 * S, [200] * 60))
        write_mcap(tmp_path / "rec" / f"rec_{nth}.mcap", [*held, boolean(T0 + nth * 10 * S, True)])
    memory = remember()
    note = f"/octets: where data is long it is only summarised, last at {T0_S + 15}.000000"
    for wanted in (
        {"condition_type": "above", "value": 100, "field": "data"},
        {"condition_type": "equals", "value": 200, "field": "data.3"},
        {"condition_type": "equals", "value": 200},
    ):
        given = {"topic": "/octets", **wanted}
        never = asked(memory, "find_last_match", **given)
        assert never["timestamp"] is None
        assert any(said.startswith(note) for said in never["notes"])
        none = asked(memory, "find_matches", **given)
        assert (none["total"], none["notes"]) == (0, never["notes"])
        bumped = {"topic": "/bumper", "condition_type": "equals", "value": True, "while": given}
        noted = asked(memory, "find_matches", **bumped)["notes"]
        assert any(said.startswith(note) for said in noted)
        # After that all was searched.
        later = asked(memory, "find_matches", **given, start=T0_S + 16)
        assert (later["total"], "notes" in later) == (0, False)
        sevens = given | {"condition_type": "equals", "value": 7}
        assert "notes" not in asked(memory, "find_last_match", **sevens)
    window = {"topic": "/octets", "fields": ["data"], "start": T0_S, "end": T0_S + 30}
    for by in ({}, {"by": "hour"}):
        numbers = asked(memory, "get_topic_in_range", **window, **by)
        assert any(said.startswith(note) for said in numbers["notes"])


@each_way
def test_the_oldest_splits_that_our_retention_deleted_are_no_reason_to_doubt_never(
    bag_dir: Path, recalls: bool
) -> None:
    described(bag_dir / "rec")
    own_all(bag_dir)
    (bag_dir / "rec" / "rec_0.mcap").unlink()
    wanted = {"topic": "/rosout", "condition_type": "contains", "value": "never"}
    memory = memory_of(bag_dir, recalls=recalls)
    assert asked(memory, "find_last_match", **wanted) is None
    (bag_dir / "rec" / "rec_1.mcap").rename(bag_dir / "rec" / "rec_0.mcap")
    memory = memory_of(bag_dir, recalls=recalls)
    assert asked(memory, "find_last_match", **wanted)["notes"]


@pytest.mark.parametrize(
    ("tool", "topics"),
    [
        ("find_last_match", {"topic": "/rosout"}),
        ("get_value_when", {"condition_topic": "/rosout", "value_topic": "/bumper"}),
    ],
)
def test_that_recording_was_interrupted_is_said_where_nothing_was_found(
    tmp_path: Path, remember: Remember, tool: str, topics: dict[str, str]
) -> None:
    for nth, begin in enumerate((0, 30)):
        beats = range(begin * S, (begin + 10) * S, S // 10)
        beating = [boolean(T0 + beat, True) for beat in beats]
        told = [log_entry(T0 + beat + 1, 20, "driver", "on its way") for beat in beats]
        write_mcap(tmp_path / "rec" / f"rec_{nth}.mcap", [*beating, *told])
    wanted = {**topics, "condition_type": "contains", "value": "never"}
    memory = remember()
    assert asked(memory, tool, **wanted) is None
    (tmp_path / ".episodic").mkdir(exist_ok=True)
    append_losses(tmp_path, [Loss("*", T0 + 10 * S, T0 + 30 * S, 0, "died")])
    never = asked(remember(), tool, **wanted)
    assert (never["timestamp"], never["value"]) == (None, None)
    [note] = never["notes"]
    assert note.endswith("(20.1 s), because ros2 bag record died")
    early = asked(remember(), tool, **wanted, before=T0_S + 5)
    assert early is None


def lie_in_a_message_index(path: Path) -> None:
    chunk = chunks_of(path)[0]
    change_index(path, chunk, 0, chunk.message_start_time + 1)


def lie_in_the_chunk_indexes(path: Path) -> None:
    def later(body: bytearray) -> None:
        body[0:8] = (int.from_bytes(body[0:8], "little") + 5).to_bytes(8, "little")

    edit_summary(path, Opcode.CHUNK_INDEX, later)


@pytest.mark.parametrize(
    ("tool", "topics"),
    [
        ("find_last_match", {"topic": "/vision/*"}),
        ("get_value_when", {"condition_topic": "/vision/*", "value_topic": "/bumper"}),
    ],
)
@each_way
@pytest.mark.parametrize("lie", [lie_in_a_message_index, lie_in_the_chunk_indexes])
def test_a_bag_that_was_read_in_spite_of_its_lies_was_read(
    bag_dir: Path,
    tool: str,
    topics: dict[str, str],
    recalls: bool,
    lie: Callable[[Path], None],
) -> None:
    lie(bag_dir / "rec" / "rec_1.mcap")
    wanted = {**topics, "condition_type": "contains", "value": "scissors"}
    assert asked(memory_of(bag_dir, recalls=recalls), tool, **wanted) is None
