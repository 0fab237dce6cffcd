"""What the demo prints, which fits a terminal and leaves nothing unsaid; and what it refuses."""

from pathlib import Path

import pytest

from ros2_memory.core.errors import ConfigError
from ros2_memory.demo.run import run_demo


@pytest.mark.parametrize("duration_s", [89.9, 86_401.0, float("nan")])
def test_a_history_too_short_for_a_lap_or_endless_is_refused(duration_s: float) -> None:
    with pytest.raises(ConfigError, match="--duration"):
        run_demo(print, duration_s=duration_s)


def test_a_folder_that_holds_something_is_refused(tmp_path: Path) -> None:
    (tmp_path / "theirs.mcap").write_bytes(b"")
    with pytest.raises(ConfigError, match=r"--bag-dir .* not an empty folder"):
        run_demo(print, bag_dir=tmp_path)
