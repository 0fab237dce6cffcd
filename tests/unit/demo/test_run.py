"""What the demo prints, which fits a terminal and leaves nothing unsaid; and what it refuses."""

from pathlib import Path

import pytest

from ros2_memory.config import load_settings
from ros2_memory.core.errors import ConfigError
from ros2_memory.demo.run import PLACES_NAME, run_demo, server_environment


def test_a_folder_that_holds_something_is_refused(tmp_path: Path) -> None:
    (tmp_path / "theirs.mcap").write_bytes(b"")
    with pytest.raises(ConfigError, match=r"--bag-dir .* not an empty folder"):
        run_demo(print, bag_dir=tmp_path)


@pytest.mark.parametrize(
    "name", ["bags", "it's", "x=[1,2]", "bags (1)", "josé", 'a "b", {c: d}', "back\\slash", "#1~"]
)
def test_a_folder_may_have_any_name(tmp_path: Path, name: str) -> None:
    folder = tmp_path / name
    folder.mkdir()
    (folder / PLACES_NAME).write_text("places: {hall: {x: [0, 1], y: [0, 1]}}")
    settings = load_settings(env=server_environment({}, folder, 0, str(tmp_path / "cache")))
    assert settings.recording.bag_dir == folder
    assert settings.data.places_file == folder / PLACES_NAME
