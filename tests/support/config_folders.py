"""What the tests of the configuration share: a folder of it to change, and its refusals."""

import shutil
from pathlib import Path

import pytest

from ros2_memory.config import load_settings
from ros2_memory.core.errors import ConfigError

ROOT = Path(__file__).resolve().parents[2]
MCAP = "ros2_memory.storage.mcap_reader.McapReader"
ROSBAG2 = "ros2_memory.storage.rosbag2_reader.Rosbag2Reader"
ROS2BAG = "ros2_memory.recorder.ros2bag.Ros2BagRecorder"
NONE = "ros2_memory.recorder.null.NullRecorder"


def refusal(*overrides: str, **env: str) -> str:
    with pytest.raises(ConfigError) as caught:
        load_settings(overrides, env)
    return str(caught.value)


def copied(folder: Path) -> Path:
    """The shipped configuration, copied into a folder."""
    return shutil.copytree(ROOT / "config", folder / "config")


def edit(file: Path, old: str, new: str) -> None:
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))
