"""The names of what the recorder puts into the bag directory."""

from pathlib import Path

from ros2_memory.bag_dir.layout import (
    has_own_name,
    recording_name,
)
from ros2_memory.core.timebase import NS_PER_S

NOW = 1_795_150_800 * NS_PER_S + 999_999_999


def test_a_name_that_is_taken_gets_a_number(tmp_path: Path) -> None:
    names = []
    for _ in range(4):
        name = recording_name(NOW, tmp_path, ())
        (tmp_path / name).mkdir()
        names.append(name.removeprefix("rec_20261120T050000Z"))
    assert names == ["", "_2", "_3", "_4"]
    assert recording_name(-1, tmp_path, ()) == "rec_19691231T235959Z"
    for path in tmp_path.iterdir():
        assert has_own_name(path.name)
        assert not has_own_name(f"{path.name}_x")
