"""The adapter `rosbag2`: the files of a rosbag2 recording, of either storage plugin."""

from __future__ import annotations

from ros2_memory.storage.file_reader import FileReader


class Rosbag2Reader(FileReader):
    """Reads files of all four kinds."""
