"""Reads and corrects the `metadata.yaml` of a recording.

rosbag2 and its readers refuse a recording whose metadata.yaml lists a file that does not exist, and
trust its counts and times. So it is written again after files were deleted or repaired. The format
is that of rosbag2 (rosbag2_storage, `yaml.hpp`) from version 5 on, which describes each file. `ros2
bag reindex` would write the same.
"""

from __future__ import annotations

import posixpath
import re
import sys
from collections import Counter, defaultdict
from contextlib import suppress
from itertools import chain
from typing import TYPE_CHECKING, Final, NamedTuple

import yaml

from ros2_memory.bag_dir.durable_write import open_plain, read_small_file, write_durably
from ros2_memory.bag_dir.layout import METADATA_FILE, bag_kind, bags_in, split_number
from ros2_memory.core.errors import BagError
from ros2_memory.core.model import COMPRESSED, MCAP, SQLITE

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.core.bag_summary import BagSummary
    from ros2_memory.storage.base import BagReader, Channel

_MAX_BYTES: Final = 64 << 20
_STORAGES: Final = {"mcap": MCAP, "sqlite3": SQLITE}
_ROOT: Final = "rosbag2_bagfile_information"
# Patterns: a YAML parser takes 0.8 s for the list of a day of splits (8640 files). They do not
# backtrack: a line may have thousands of spaces.
_NAME: Final = r"[ \t]*+['\"]?+([^'\"\r\n]++)['\"]?+$"
_BAG_NAME: Final = re.compile(rf"[ \t]*+(?:- )?(?:- |path:){_NAME}")
_PATH_KEY: Final = re.compile(rf"path:{_NAME}")
_COUNT_KEY: Final = re.compile(r"message_count:[ ]*(\d+)")
_NAMED_POLICY: Final = re.compile(r"reliability:\s*[a-z]")
_FIRST_OF_FILES: Final = 5
_FIRST_OF_TYPE_HASHES: Final = 7
_FIRST_OF_NAMED_QOS: Final = 9
"""The versions of the format that introduced these."""
_LOADER: Final[type[yaml.SafeLoader | yaml.CSafeLoader]] = getattr(
    yaml, "CSafeLoader", yaml.SafeLoader
)


class Listing(NamedTuple):
    """The files that a metadata.yaml lists.

    Attributes:
        names: the names of the bag files, in order.
        messages: the number of messages in each file, by its name without `.zstd`; empty before
            version 5.
        total: the number of messages in all files; None if it is not given.
    """

    names: tuple[str, ...]
    messages: dict[str, int]
    total: int | None


def parse_listing(text: str) -> Listing:
    """Returns the files that a metadata.yaml lists; none if the text is no metadata.yaml."""
    lines = text.split("\n")
    messages, total = _message_counts(lines)
    return Listing(tuple(_bag_names(lines)), messages, total)


def _bag_names(lines: Iterable[str]) -> Iterator[str]:
    for line in lines:
        if "." in line:
            bag_name = _BAG_NAME.match(line.rstrip())
            if bag_name and bag_kind(bag_name[1]):
                yield posixpath.basename(bag_name[1])


def _message_counts(lines: Iterable[str]) -> tuple[dict[str, int], int | None]:
    """Returns the number of messages in each file, and in the whole recording."""
    messages: dict[str, int] = {}
    total: int | None = None
    total_indent = sys.maxsize
    path: str | None = None
    count: int | None = None
    # Line by line: patterns over the whole text take twice as long, and a week has 1,000 of them.
    for line in chain(lines, ["- "]):
        key = line.lstrip(" ")
        is_item = key.startswith("- ")
        if is_item:
            # The keys of an item come in any order: not only rosbag2 writes these files.
            if path is not None and count is not None:
                messages[bare_name(path)] = count
            path = count = None
            key = key[2:].lstrip(" ")
        if key.startswith("path:"):
            path_key = _PATH_KEY.match(key.rstrip())
            if path_key and path is None:
                path = path_key[1]
        elif key.startswith("message_count:") and (count_key := _COUNT_KEY.match(key)):
            number, indent = int(count_key[1]), len(line) - len(key)
            if count is None:
                count = number
            # The count of the whole recording is indented least.
            if not is_item and indent < total_indent:
                total, total_indent = number, indent
    return messages, total


def read_listing(path: Path | str, directory: int | None = None) -> Listing:
    """Returns the files that a metadata.yaml lists.

    Args:
        path: its path, which may be relative to `directory`.
        directory: the descriptor of an open directory.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is not a regular file.
    """
    with open_plain(path, directory) as stream:
        return parse_listing(stream.read(_MAX_BYTES).decode("utf-8", errors="replace"))


class Contents(NamedTuple):
    """The content of a complete bag file of a recording."""

    summary: BagSummary
    channels: Sequence[Channel]


def correct(recording: Path, reader: BagReader) -> bool:
    """Corrects metadata.yaml by the content of the recording's files, all of one kind.

    A missing or empty one is created if the files have names of rosbag2.

    Returns:
        Whether metadata.yaml was written.

    Raises:
        BagError: a bag cannot be read.
        OSError: metadata.yaml cannot be read or written; the old one remains.
        ValueError: a bag is incomplete, or metadata.yaml has an unknown form; it is unchanged.
    """
    path = recording / METADATA_FILE
    files = bags_in(recording)
    text = ""
    with suppress(FileNotFoundError):
        text = read_small_file(path, _MAX_BYTES)
    if not files or not (text or is_named_by_rosbag2(recording)):
        return False
    contents: dict[str, Contents] = {}
    for file in files:
        contents[file.name] = Contents(reader.summarize(file), reader.channels(file))
        if not contents[file.name].summary.complete:
            raise ValueError(f"{file.name} is not whole")
    written = describing(text, contents)
    if written != text:
        write_durably(path, written)
    return written != text


def why_not_corrected(recording: Path, reader: BagReader) -> str | None:
    """Corrects metadata.yaml if it exists; returns why that failed, or None."""
    try:
        if (recording / METADATA_FILE).exists():
            correct(recording, reader)
    except (BagError, OSError, ValueError) as error:
        return str(error)
    return None


def is_named_by_rosbag2(recording: Path) -> bool:
    """Returns whether all bags of a recording are MCAP files with names of rosbag2."""
    numbers = (split_number(recording.name, path.name) for path in bags_in(recording))
    return None not in numbers


def describing(text: str, files: Mapping[str, Contents]) -> str:
    """Returns the text of a metadata.yaml that describes these files.

    Args:
        text: the old text, whose descriptions of topics remain; empty if there was none.
        files: the files of the recording by name, at least one.

    Raises:
        ValueError: the old text is no metadata.yaml of a known form.
    """
    channels = [channel for contents in files.values() for channel in contents.channels]
    content: object = _parse(text) if text else {_ROOT: _new_information(channels)}
    info = _mapping(_mapping(content, "it").get(_ROOT), _ROOT)
    kind = _STORAGES.get(str(info.get("storage_identifier")), "")
    kind += COMPRESSED if info.get("compression_mode") == "FILE" else ""
    if any(bag_kind(name) != kind for name in files):
        raise ValueError("the files are not of the storage and compression that it states")
    version = info.get("version")
    if not isinstance(version, int) or version < _FIRST_OF_FILES:
        raise ValueError(f"it is of version {version}, which lists no messages of files")
    counts = Counter[tuple[str, str]]()
    for summary, _ in files.values():
        for topic in summary.topics:
            counts[topic.topic, topic.type] += topic.count
    info["message_count"] = counts.total()
    _set_files(info, files)
    _set_topics(info, channels, counts, version)
    return yaml.safe_dump(content, sort_keys=False, allow_unicode=True)


def _set_files(info: dict[object, object], files: Mapping[str, Contents]) -> None:
    """Sets the times, paths and descriptions of the files, in order of time."""
    paths = {bare_name(path): str(path) for path in _list(info, "relative_file_paths")}
    spans = {
        name: (summary.start, summary.end)
        for name, (summary, _) in files.items()
        if not summary.empty
    }
    first = min((start for start, _ in spans.values()), default=0)
    last = max((end for _, end in spans.values()), default=first)
    order = sorted(files, key=lambda name: (spans.get(name, (last, last)), name))
    info.update(_span(first, last))
    info["relative_file_paths"] = [paths.get(bare_name(name), name) for name in order]
    info["files"] = [
        {
            "path": name,
            **_span(*spans.get(name, (first, first))),
            "message_count": files[name].summary.count,
        }
        for name in order
    ]


def _set_topics(
    info: dict[object, object],
    channels: Sequence[Channel],
    counts: Counter[tuple[str, str]],
    version: int,
) -> None:
    """Sets the message count of each topic, and its QoS if no channel has the stated one."""
    topics = [_mapping(item, "topics") for item in _list(info, "topics_with_message_count")]
    # A day of splits has a million channels, but few different ones.
    unlisted: dict[tuple[str, str], Channel] = {}
    offered_qos: defaultdict[tuple[str, str], dict[str, None]] = defaultdict(dict)
    for channel in channels:
        key = channel.topic, channel.type
        unlisted.setdefault(key, channel)
        offered_qos[key][_qos(channel)] = None
    for topic in topics:
        topic_metadata = _mapping(topic.get("topic_metadata"), "topic_metadata")
        key = str(topic_metadata.get("name")), str(topic_metadata.get("type"))
        unlisted.pop(key, None)
        topic["message_count"] = counts[key]
        offered = [_offered(text, version) for text in offered_qos[key]]
        # rosbags returns no message of a channel whose profiles differ from these.
        if offered and topic_metadata.get("offered_qos_profiles") not in offered:
            topic_metadata["offered_qos_profiles"] = offered[0]
    for key, channel in unlisted.items():
        new: dict[object, object] = {
            "name": channel.topic,
            "type": channel.type,
            "serialization_format": channel.encoding,
            "offered_qos_profiles": _offered(_qos(channel), version),
        }
        if version >= _FIRST_OF_TYPE_HASHES:
            new["type_description_hash"] = dict(channel.metadata).get("topic_type_hash", "")
        topics.append({"topic_metadata": new, "message_count": counts[key]})
    info["topics_with_message_count"] = topics


def _new_information(channels: Sequence[Channel]) -> dict[str, object]:
    """Returns the content of a new metadata.yaml, before counts, times and topics are set.

    The version is the oldest one that fits the QoS profiles in the files: before version 9 rosbag2
    writes policies by number, then by name.
    """
    is_named = any(_NAMED_POLICY.search(_qos(channel)) for channel in channels)
    information: dict[str, object] = {
        "version": _FIRST_OF_NAMED_QOS if is_named else _FIRST_OF_FILES,
        "storage_identifier": "mcap",
        "duration": {},
        "starting_time": {},
        "message_count": 0,
        "topics_with_message_count": [],
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [],
        "files": [],
    }
    if is_named:
        information |= {"custom_data": None, "ros_distro": ""}
    return information


def _offered(text: str, version: int) -> object:
    """Returns QoS profiles as a version has them: text before version 9, then a list."""
    return text if version < _FIRST_OF_NAMED_QOS else _parse(text) or []


def _qos(channel: Channel) -> str:
    return dict(channel.metadata).get("offered_qos_profiles", "")


def bare_name(path: object) -> str:
    """Returns the name of a bag file without the suffix of its compressed form."""
    return posixpath.basename(str(path)).removesuffix(COMPRESSED)


def _span(start: int, end: int) -> dict[str, object]:
    return {
        "starting_time": {"nanoseconds_since_epoch": start},
        "duration": {"nanoseconds": end - start},
    }


def _parse(text: str) -> object:
    """Returns the value of a YAML text.

    Raises:
        ValueError: the text is no YAML.
    """
    try:
        value: object = yaml.load(text, _LOADER)  # noqa: S506 - a safe one
    except (yaml.YAMLError, RecursionError) as error:
        raise ValueError("it is not YAML") from error
    return value


def _mapping(value: object, name: str) -> dict[object, object]:
    if not isinstance(value, dict):
        raise ValueError(f"{name} holds no keys")  # noqa: TRY004 - a value in a text
    return value


def _list(fields: dict[object, object], key: str) -> list[object]:
    value = fields.get(key)
    if not isinstance(value, list):
        raise ValueError(f"it has no list {key}")  # noqa: TRY004 - a value in a text
    return value
