"""What metadata.yaml lists is read once, also by processes that come later."""

from __future__ import annotations

import json
import os
from typing import TYPE_CHECKING

import pytest

from ros2_memory.index import listed_splits
from ros2_memory.index.listed_splits import Absent, absent_splits
from tests.support.bags import text, write_mcap
from tests.support.memories import memory_of, with_store

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from ros2_memory.history.context import Memory

T0 = 1_700_000_000 * 10**9
LONG_AGO = (T0 / 1e9, T0 / 1e9)
ABSENT = ("r_1.mcap", "r_3.mcap")


class Texts:
    """A `Store` in memory."""

    def __init__(self) -> None:
        self.stored: dict[str, str] = {}

    def text(self, name: str) -> str | None:
        return self.stored.get(name)

    def store_text(self, name: str, text: str) -> None:
        self.stored[name] = text


def recording(bag_dir: Path, name: str = "r", *, messages: int = 1) -> Memory:
    """A recording of five splits, of which two are missing, as another program left it."""
    for n in (0, 2, 4):
        write_mcap(bag_dir / name / f"r_{n}.mcap", [text(T0 + n, "a")])
    files = "".join(f"  - path: r_{n}.mcap\n    message_count: {messages}\n" for n in range(5))
    listing = bag_dir / name / "metadata.yaml"
    listing.write_text(f"rosbag2_bagfile_information:\n  files:\n{files}")
    for each in (listing, listing.parent):
        os.utime(each, LONG_AGO)
    return memory_of(bag_dir)


def found(memory: Memory, store: Texts | None) -> Sequence[Absent]:
    """What a process that has read nothing yet finds."""
    listed_splits._KNOWN.clear()
    return absent_splits(memory.index.snapshot(), memory.index.bag_dir, store)


@pytest.mark.parametrize("messages", [1, 0, 7])
def test_a_later_process_need_not_read_what_did_not_change(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, messages: int
) -> None:
    memory, store = recording(tmp_path, messages=messages), Texts()
    [absent] = found(memory, store)
    assert absent.files == ABSENT
    assert found(memory, None) == [absent]
    monkeypatch.setattr(listed_splits, "read_listing", None)
    assert found(memory, store) == [absent]


def test_what_changed_since_is_read_again(tmp_path: Path) -> None:
    memory, store = recording(tmp_path), Texts()
    found(memory, store)
    write_mcap(tmp_path / "r" / "r_1.mcap", [text(T0 + 1, "a")])
    assert [each.files for each in found(memory, store)] == [("r_3.mcap",)]
    (tmp_path / "r" / "metadata.yaml").unlink()
    assert found(memory, store) == []


def test_a_folder_that_changed_just_now_is_not_stored(tmp_path: Path) -> None:
    memory, store = recording(tmp_path), Texts()
    now = memory.clock.now()
    os.utime(tmp_path / "r", ns=(now, now))
    assert [each.files for each in found(memory, store)] == [ABSENT]
    assert store.stored == {}


@pytest.mark.parametrize("damage", ["", "[1]", '{"r": 1}', '{"r": [[1, 2], []]}', "{"])
def test_what_is_damaged_is_read_again(tmp_path: Path, damage: str) -> None:
    memory, store = recording(tmp_path), Texts()
    before = found(memory, store)
    [name] = store.stored
    store.stored[name] = damage
    assert found(memory, store) == before
    assert json.loads(store.stored[name])


def test_one_changed_recording_of_many_is_not_worth_storing_all_again(tmp_path: Path) -> None:
    for n in range(40):
        memory = recording(tmp_path, f"r{n}")
    store = Texts()
    before = found(memory, store)
    stored = dict(store.stored)
    os.utime(tmp_path / "r0" / "metadata.yaml", (1, 1))
    assert found(memory, store) == before
    assert store.stored == stored


def test_a_catalogue_stores_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    memory = recording(tmp_path)
    known = with_store(memory, tmp_path)
    listed_splits._KNOWN.clear()
    [absent] = known.absent_splits(known.index.snapshot())
    monkeypatch.setattr(listed_splits, "read_listing", None)
    listed_splits._KNOWN.clear()
    assert known.absent_splits(known.index.snapshot()) == [absent]
