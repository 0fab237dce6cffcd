"""Nothing but the error tree leaves a reader, and what it serves of a damaged bag is consistent."""

from __future__ import annotations

import zlib
from typing import TYPE_CHECKING

import pytest

from ros2_memory.core.errors import BagError, EpisodicError, UndecodableError
from ros2_memory.core.model import TimeWindow
from ros2_memory.storage.errors import UnreadableError, reading
from tests.support.bags import Msg, detections, odom, text, tf, transform
from tests.support.mcap_surgery import damaged
from tests.support.reader_cases import FILES, Shelf

if TYPE_CHECKING:
    from collections.abc import Collection
    from pathlib import Path

    from ros2_memory.storage.base import BagReader

ACCIDENTS = 40
EVERYTHING = TimeWindow.everything()


def _messages() -> list[Msg]:
    return [
        message
        for step in range(8)
        for message in (
            odom(step * 10, step, 0.0),
            text(step * 10 + 3, f"hello {step}"),
            detections(step * 10 + 5, ["cup"]),
            tf(step * 10 + 7, transform(step, "odom", "base_link", (1.0, 2.0, 0.0))),
        )
    ]


@pytest.mark.parametrize("shelf", FILES, ids=str)
def test_whatever_happened_to_a_bag_only_the_error_tree_escapes(
    shelf: Shelf, tmp_path: Path
) -> None:
    reader, path = shelf.stocked(tmp_path, _messages())
    whole = path.read_bytes()
    read = 0
    for accident in range(ACCIDENTS):
        # The seed depends on the shelf, so that the shelves do not all meet the same accidents.
        seed = accident + zlib.crc32(shelf.name.encode())
        path.write_bytes(damaged(whole, seed))
        error = _error_of_reading(reader, path)
        if error is not None:
            assert (error.path, bool(error.reason)) == (str(path), True)
        read += error is None
    assert read


def _error_of_reading(reader: BagReader, path: Path) -> BagError | None:
    try:
        reader.closing(path)
        summary = reader.summarize(path)
        _compare(reader, path, {topic.topic for topic in summary.topics}, summary.count)
    except BagError as error:
        return error
    return None


def _compare(reader: BagReader, path: Path, topics: Collection[str], count: int) -> None:
    records = list(reader.records(path, topics, EVERYTHING))
    assert len(records) == count
    assert list(reader.records(path, topics, EVERYTHING, newest_first=True)) == records[::-1]
    times = [record.log_time for record in records]
    assert times == sorted(times)
    for record in records:
        try:
            reader.decode(record)
        except UndecodableError:
            continue


@pytest.mark.parametrize(
    "foreign",
    [
        MemoryError(),
        RecursionError("deep"),
        KeyError(1),
        OSError(5, "Input/output error"),
        RuntimeError("LZ4F_decompress failed"),
        AssertionError(),
        UnreadableError("its reason"),
        OverflowError("too large"),
        UnicodeDecodeError("utf-8", b"\xff", 0, 1, "invalid start byte"),
    ],
    ids=lambda error: type(error).__name__,
)
def test_every_foreign_exception_becomes_an_error_about_the_file(
    foreign: Exception, tmp_path: Path
) -> None:
    path = tmp_path / "bag.mcap"
    with pytest.raises(BagError) as caught, reading(path):
        raise foreign
    assert caught.value.path == str(path)
    assert caught.value.reason
    assert "\n" not in caught.value.reason
    assert caught.value.__cause__ is foreign


def test_errors_of_the_tree_and_interruptions_pass_as_they_are(tmp_path: Path) -> None:
    for error in (UndecodableError("/t", "a/msg/B", "no"), KeyboardInterrupt()):
        with pytest.raises((EpisodicError, KeyboardInterrupt)) as caught, reading(tmp_path):
            raise error
        assert caught.value is error
