"""State files in every wrong shape: nothing more is served or deleted than with the right ones."""

import json
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Final

import pytest

from ros2_memory.bag_dir.heartbeat import HEARTBEAT_FILE
from ros2_memory.bag_dir.layout import OWN_FOLDER
from ros2_memory.bag_dir.own_recordings import LIST, OwnRecordings
from ros2_memory.bag_dir.state_files import (
    DELETED,
    ERASING,
    FORGOTTEN,
    LOST,
    RECORDED,
    SCREENED,
    SHIPPED,
    TRIGGERS,
    Erasure,
    Forgetting,
    Loss,
    Receipt,
    Recorded,
    TriggerState,
    append_deleted,
    deleted_of,
)
from ros2_memory.core.errors import RecorderError
from ros2_memory.history.context import Call
from ros2_memory.insights.status import memory_status
from ros2_memory.observability.prometheus import MemoryGauges, Metrics
from ros2_memory.recorder.index_manager import IndexManager
from ros2_memory.serving.health import Health
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import write_mcap
from tests.support.clocks import SettableClock
from tests.support.housekeepers import keeper_of, recording_now
from tests.support.log_lines import with_checks
from tests.support.memories import memory_of
from tests.support.screened_bags import T0, S, ScreenedBags, mode, words

NAMES: Final = [
    *(f.name for f in (LIST, RECORDED, LOST, DELETED, SHIPPED, FORGOTTEN)),
    *(f.name for f in (SCREENED, TRIGGERS, ERASING)),
    HEARTBEAT_FILE,
]
CLOCK: Final = SettableClock(T0 + 3600 * S)


def world(root: Path) -> Path:
    """Three recordings of ours, of which the last is held back, one of others, all state files."""
    bags = ScreenedBags(root)
    OwnRecordings(root).claim()
    own = OwnRecordings(root)
    made = []
    for nth in range(3):
        name = bags.begin(600 * nth)
        own.begin(name)
        begun = 600 * nth
        bags.split([mode(begun - 2, value=False), *words(begun, begun + 10)])
        own.complete(name)
        made.append(name)
        if nth < 2:
            bags.end()
    write_mcap(root / "theirs" / "theirs_0.mcap", words(-900, -890))
    RECORDED.append(root, [Recorded(name, 600.0 * nth) for nth, name in enumerate(made)])
    LOST.append(root, [Loss("/chatter", T0, T0 + S, 2, "stamps")])
    append_deleted(root, [deleted_of(made[0], [("a_0", T0 - 9 * S, T0 - 5 * S)])])
    SHIPPED.append(root, [Receipt(f"{made[0]}/{made[0]}_0.mcap", "id", 1, "0", "lake", T0)])
    FORGOTTEN.append(root, [Forgetting(T0 - 99 * S, T0 - 98 * S, ("/chatter",))])
    ERASING.write(root, Erasure(("/nothing",), ((1, 2),), files=(f"{made[0]}/none.mcap",)))
    TRIGGERS.write(root, TriggerState())
    for path in root.rglob("*.mcap"):
        os.utime(path, ns=(path.stat().st_atime_ns, T0 + 1800 * S))
    recording_now(root, made[2], clock=CLOCK)
    return root


def served(root: Path) -> set[str]:
    index = IndexManager(root, McapReader(), CLOCK, refresh_s=0.0, split_duration_s=10.0)
    return {bag.path.name for bag in index.snapshot().bags}


def left(root: Path) -> set[str]:
    return {path.name for path in root.rglob("*.mcap")}


def deleted(root: Path) -> set[str]:
    """What a recorder that starts deletes at once, with a budget that holds one bag and no age."""
    before, own = left(root), OwnRecordings(root)
    keeper = keeper_of(
        root,
        max_bytes=1,
        max_age_h=0.01,
        clock=CLOCK,
        keeps_foreign=True,
    )
    try:
        own.claim()
    except RecorderError:
        return set()  # it does not start
    keeper.apply()
    return before - left(root)


@pytest.fixture(scope="module")
def right(tmp_path_factory: pytest.TempPathFactory) -> tuple[set[str], set[str]]:
    """What is served and deleted while all files are right."""
    root = world(tmp_path_factory.mktemp("right") / "bags")
    found = served(root), deleted(root)
    assert [*map(len, found)] == [3, 1]
    return found


def as_directory(path: Path) -> None:
    path.unlink()
    path.mkdir()


def as_link(path: Path) -> None:
    path.rename(path.parent.parent / "elsewhere")
    path.symlink_to(path.parent.parent / "elsewhere")


def huge(path: Path) -> None:
    os.truncate(path, 65 << 20)


def surrogates(path: Path) -> None:
    text, checks = re.subn(', "crc32": "........"', "", path.read_text())
    changed = text.replace('"rec_', '"\\ud800rec_').replace('"/', '"/\\ud800')
    changed = changed.replace(":null", ':"\\ud800"')
    path.write_text(with_checks(changed) if checks else changed)


SHAPES: Final[list[Callable[[Path], object]]] = [
    as_directory,
    as_link,
    huge,
    surrogates,
    lambda path: path.write_bytes(b""),
    lambda path: path.write_bytes(bytes(range(256)) * 9),
    lambda path: path.write_bytes(path.read_bytes().replace(b"/", b"\xed\xa0\x80")),
]


def folder_as_file(root: Path) -> None:
    (root / OWN_FOLDER).rename(root.parent / "aside")
    (root / OWN_FOLDER).write_text("x")


def folder_as_link(root: Path) -> None:
    (root / OWN_FOLDER).rename(root.parent / "aside")
    (root.parent / "empty").mkdir()
    (root / OWN_FOLDER).symlink_to(root.parent / "empty")


def shape(number: int, name: str) -> Callable[[Path], object]:
    return lambda root: SHAPES[number](root / name)


@pytest.mark.parametrize(
    "spoil",
    [
        pytest.param(folder_as_file, id="folder_as_file"),
        pytest.param(folder_as_link, id="folder_as_link"),
        *(
            pytest.param(shape(number, name), id=f"{name}-{number}")
            for name in NAMES
            for number in range(len(SHAPES))
        ),
    ],
)
async def test_nothing_more_is_served_or_deleted(
    tmp_path: Path, right: tuple[set[str], set[str]], spoil: Callable[[Path], object]
) -> None:
    root = world(tmp_path / "bags")
    spoil(root)
    assert served(root) <= right[0]
    memory = memory_of(root, clock=CLOCK)
    memory_status(memory, Call())
    health = Health(memory)
    json.dumps(await health(), ensure_ascii=False).encode()
    health.stop()
    metrics = Metrics(MemoryGauges(memory), timeout_s=60)
    assert b"ros2_memory_bags" in (await metrics.exposition()).body
    metrics.stop()
    assert deleted(root) <= right[1]
