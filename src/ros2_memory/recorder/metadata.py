"""`metadata.yaml` of a recording, written anew after some of its files were deleted.

rosbag2 and its readers refuse a recording whose metadata.yaml lists a file that is not there. The
format is rosbag2's (rosbag2_storage, `yaml.hpp`), versions 5 and later, which tell of each file
what it holds; `ros2 bag reindex` would write the same from the files themselves.
"""

from __future__ import annotations

from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Final

import yaml

from ros2_memory.recorder.layout import METADATA_FILE
from ros2_memory.recorder.sync import read_small_file, write_durably

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    Counts = Mapping[str, int]

_ROOT: Final = "rosbag2_bagfile_information"
_ZSTD: Final = ".zstd"
_LOADER: Final[type[yaml.SafeLoader | yaml.CSafeLoader]] = getattr(
    yaml, "CSafeLoader", yaml.SafeLoader
)


def take_out(recording: Path, gone: Mapping[str, Counts]) -> bool:
    """Writes metadata.yaml anew, at once, without files that were deleted.

    `gone` has for the name of each how many messages of which topic it held. Gives whether
    anything had to be written; a recording without metadata.yaml has nothing to correct.

    Raises:
        OSError: it cannot be read or written; the one before stands.
        ValueError: it is none that this can be done with, and why; it stands as it is.
    """
    path = recording / METADATA_FILE
    try:
        text = read_small_file(path)
    except FileNotFoundError:
        return False
    written = without(text, gone)
    if written is None:
        return False
    write_durably(path, written)
    return True


def without(text: str, gone: Mapping[str, Counts]) -> str | None:
    """The text of a metadata.yaml without these files; None where it lists none of them.

    Raises:
        ValueError: it is no metadata.yaml of a known form, nothing would be left of it, or its
            numbers are not those of the files.
    """
    try:
        content: object = yaml.load(text, _LOADER)  # noqa: S506 - a safe one
    except (yaml.YAMLError, RecursionError) as error:
        raise ValueError("it is no YAML") from error
    info = _mapping(_mapping(content, "it").get(_ROOT), _ROOT)
    names = {_bare(name): counts for name, counts in gone.items()}
    files = [_mapping(each, "files") for each in _list(info, "files")]
    paths = _list(info, "relative_file_paths")
    deleted = [each for each in files if _bare(each.get("path")) in names]
    left = [each for each in files if _bare(each.get("path")) not in names]
    left_paths = [each for each in paths if _bare(each) not in names]
    if len(left_paths) == len(paths) and not deleted:
        return None
    if not left or len(left) != len(left_paths):
        raise ValueError("it does not list the files that are left")
    held: dict[str, int] = {}
    for each in deleted:
        counts = names[_bare(each.get("path"))]
        if sum(counts.values()) != _int(each, "message_count"):
            raise ValueError("its numbers are not those of the files")
        for topic, count in counts.items():
            held[topic] = held.get(topic, 0) + count
    topics = [_mapping(each, "topics") for each in _list(info, "topics_with_message_count")]
    for each in topics:
        name = _mapping(each.get("topic_metadata"), "topic_metadata").get("name")
        each["message_count"] = _int(each, "message_count") - held.pop(str(name), 0)
    start = min(_start(each) for each in left)
    end = max(_start(each) + _duration(each) for each in left)
    info["message_count"] = sum(_int(each, "message_count") for each in left)
    if held or info["message_count"] != sum(_int(each, "message_count") for each in topics):
        raise ValueError("its numbers are not those of the files")
    info["starting_time"] = {"nanoseconds_since_epoch": start}
    info["duration"] = {"nanoseconds": end - start}
    info["relative_file_paths"], info["files"] = left_paths, left
    return yaml.safe_dump(content, sort_keys=False, allow_unicode=True)


def _bare(path: object) -> str:
    """A file's name, whether it is compressed or not."""
    return PurePosixPath(str(path)).name.removesuffix(_ZSTD)


def _start(file: dict[object, object]) -> int:
    return _int(_mapping(file.get("starting_time"), "starting_time"), "nanoseconds_since_epoch")


def _duration(file: dict[object, object]) -> int:
    return _int(_mapping(file.get("duration"), "duration"), "nanoseconds")


def _mapping(value: object, name: str) -> dict[object, object]:
    if not isinstance(value, dict):
        raise ValueError(f"{name} holds no keys")  # noqa: TRY004 - what a text says
    return value


def _list(fields: dict[object, object], key: str) -> list[object]:
    value = fields.get(key)
    if not isinstance(value, list):
        raise ValueError(f"it has no list {key}")  # noqa: TRY004 - as above
    return value


def _int(fields: dict[object, object], key: str) -> int:
    value = fields.get(key)
    if isinstance(value, bool) or not isinstance(value, int):
        raise ValueError(f"{key} is no whole number")  # noqa: TRY004 - as above
    return value
