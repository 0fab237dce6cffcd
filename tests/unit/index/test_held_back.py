"""Files that the recorder holds back: no index serves them, whatever they are."""

from pathlib import Path

import pytest

from ros2_memory.core.model import TimeWindow
from ros2_memory.history.context import QuerySettings, SnapshotSource
from ros2_memory.history.coverage import describe_excluded, unread_spans
from ros2_memory.index.file_state import HELD_BACK
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.insights.status import nothing_here
from ros2_memory.retention.policy import RetentionLimits
from ros2_memory.tools.instructions import instructions
from tests.support.bags import McapLayout
from tests.support.clocks import SettableClock
from tests.support.memories import asked, memory_of
from tests.support.screened_bags import T0, S, ScreenedBags, mode, words

OPEN = McapLayout(latched=frozenset({"/privacy_mode"}), finish=False, chunk_size=256)


def index_of(bags: ScreenedBags, *, include_active: bool = False) -> SnapshotSource:
    an_hour_later = SettableClock(T0 + 3600 * S)
    return memory_of(bags.bag_dir, clock=an_hour_later, include_active=include_active).index


def names(snapshot: Snapshot) -> list[str]:
    return [each.path.name for each in snapshot.bags]


@pytest.mark.parametrize("include_active", [False, True])
def test_a_split_is_found_once_it_is_released(tmp_path: Path, include_active: bool) -> None:
    bags = ScreenedBags(tmp_path / "bags")
    index = index_of(bags, include_active=include_active)
    name = bags.begin(0)
    bags.split(name, [mode(-2, value=False), *words(0, 10)])
    growing = bags.split(name, words(10, 20), OPEN)
    assert names(index.snapshot()) == []
    assert [(each.path.name, each.reason, each.answers) for each in index.snapshot().active] == [
        (f"{name}_{n}.mcap", HELD_BACK, False) for n in range(2)
    ]
    growing.unlink()
    bags.split(name, words(20, 30))
    bags.step()
    assert names(index.snapshot()) == [f"{name}_0.mcap"]
    # What a crash left open is not served either: only the recorder repairs it.
    bags.split(name, words(30, 40), OPEN)
    bags.end()
    assert names(index.snapshot()) == [f"{name}_{n}.mcap" for n in (0, 2)]


def test_what_is_announced_while_a_directory_is_read_is_held_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bags = ScreenedBags(tmp_path / "bags")
    index = index_of(bags, include_active=True)
    context = index._context  # type: ignore[attr-defined]

    def slow() -> object:
        made = context()
        bags.split(bags.begin(0), words(0, 10))
        return made

    monkeypatch.setattr(index, "_context", slow)
    assert names(index.snapshot()) == []


def test_answers_say_what_was_excluded_and_what_is_held_back(tmp_path: Path) -> None:
    bags = ScreenedBags(tmp_path / "bags")
    name = bags.begin(0)
    bags.split(name, [mode(-2, value=False), mode(5, value=True), *words(0, 10)])
    bags.split(name, words(10, 20))
    assert nothing_here(index_of(bags).snapshot()) == (
        "no bag is served yet: recording.exclude_when has still to be applied to 2 splits"
    )
    bags.step()
    window = TimeWindow(T0, T0 + 30 * S)
    [excluded] = describe_excluded(bags.bag_dir, window)
    assert excluded == (
        "excluded by the rules of recording.exclude_when, so there is no data of it: "
        f"{T0 // S + 4}.000000 to {T0 // S + 10}.500001"
    )
    assert [*describe_excluded(bags.bag_dir, TimeWindow(T0, T0 + 3 * S))] == []
    assert f"{HELD_BACK}: {name}/{name}_1.mcap" in [
        *unread_spans(index_of(bags).snapshot(), window, nothing=False, absent=(), odd=())
    ]


def test_what_is_searched_first_answers_later_and_the_words_say_when(tmp_path: Path) -> None:
    bags = ScreenedBags(tmp_path / "bags")
    bags.split(bags.begin(0), [mode(-2, value=False), *words(0, 10)])
    limits = QuerySettings(screened=True, include_active=True, kept=RetentionLimits(10**9, 0))
    memory = memory_of(bags.bag_dir, clock=SettableClock(T0 + 12 * S), limits=limits)
    at = {"topic": "/chatter", "timestamp": T0 // S + 5}
    assert "in 25 s or less" in asked(memory, bags.bag_dir, "get_topic_at_time", **at)["detail"]
    assert "the newest 25 s or so" in instructions(limits)
