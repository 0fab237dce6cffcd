"""Nothing but the error tree leaves a reader, and what it serves of a damaged bag is consistent."""

from pathlib import Path

import pytest

from ros2_memory.core.errors import BagError, UndecodableError
from ros2_memory.storage.errors import UnreadableError, reading


@pytest.mark.parametrize(
    "foreign",
    [
        MemoryError(),
        KeyError(1),
        OSError(5, "Input/output error"),
        RuntimeError("LZ4F_decompress\nfailed"),
        AssertionError(),
        UnreadableError("its reason"),
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


@pytest.mark.parametrize("error", [UndecodableError("/t", "a/msg/B", "no"), KeyboardInterrupt()])
def test_errors_of_the_tree_and_interruptions_pass_as_they_are(error: BaseException) -> None:
    with pytest.raises(type(error)) as caught, reading(Path("bag.mcap")):
        raise error
    assert caught.value is error
