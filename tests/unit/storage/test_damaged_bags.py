"""Nothing but the error tree leaves a reader, and what it serves of a damaged bag is consistent."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from ros2_memory.core.errors import BagError, EpisodicError, UndecodableError
from ros2_memory.storage.errors import UnreadableError, reading

if TYPE_CHECKING:
    from pathlib import Path


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
