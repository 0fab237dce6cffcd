"""Notes on damage are of the asked window, whatever else of the history is read to answer."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.support.memories import asked, memory_of
from tests.support.moving_map import BEGIN, S, write_moving_map

if TYPE_CHECKING:
    from pathlib import Path

_BEGIN_S = BEGIN // S


def within(start: int, end: int) -> dict[str, int]:
    return {"start": _BEGIN_S + start, "end": _BEGIN_S + end}


@pytest.fixture(scope="module")
def damaged(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two minutes in splits of 10 s; chunks of the second and the last but three are damaged."""
    folder = tmp_path_factory.mktemp("damaged")
    write_moving_map(folder, 3)
    for number in (1, 8):
        (split,) = folder.rglob(f"*_{number}.mcap")
        data = bytearray(split.read_bytes())
        for at in range(len(data) // 3, len(data) // 3 + 60):
            data[at] ^= 0xFF
        split.write_bytes(data)
    return folder


_ABOVE = {"topic": "/odom", "field": "position.x", "condition_type": "above", "value": 1.0}
_COMPARED = {"with_start": _BEGIN_S + 40, "with_end": _BEGIN_S + 50}


@pytest.mark.parametrize(
    ("tool", "given"),
    [
        ("visits", {"x": 4.0, "y": 0.0, "radius_m": 1.0}),
        ("find_things", {}),
        ("recap", {}),
        ("compare", _COMPARED),
        ("trajectory_summary", {"frame_id": "map"}),
        ("find_matches", _ABOVE),
        ("get_topic_in_range", {"topic": "/odom"}),
    ],
)
def test_a_reply_names_the_damage_of_its_window_alone(
    damaged: Path, tool: str, given: dict[str, object]
) -> None:
    memory = memory_of(damaged)
    reply = asked(memory, damaged, tool, **given, **within(50, 70))
    assert "error" not in reply
    assert not [note for note in reply.get("notes", ()) if "damaged" in note]
    if tool not in {"visits", "trajectory_summary"}:  # of the stored path nothing is lost
        reply = asked(memory, damaged, tool, **given, **within(50, 100))
        (note,) = [note for note in reply["notes"] if "damaged" in note]
        assert "rec_8.mcap" in note
        assert "rec_1.mcap" not in note
