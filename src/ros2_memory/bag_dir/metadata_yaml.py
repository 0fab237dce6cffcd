"""`metadata.yaml` of a recording: reading what it lists, and correcting it.

rosbag2 and its readers refuse a recording whose metadata.yaml lists a file that does not exist, and
trust the counts and times in it, so it is written again after files were deleted or repaired. The
format is rosbag2's (rosbag2_storage, `yaml.hpp`), from version 5 on, which describes each file;
`ros2 bag reindex` would write the same from the files themselves.
"""

from __future__ import annotations

import posixpath
import re
from collections import Counter, defaultdict
from contextlib import suppress
from operator import itemgetter
from typing import TYPE_CHECKING, Final, NamedTuple

import yaml

from ros2_memory.bag_dir.durable_write import open_plain, read_small_file, write_durably
from ros2_memory.bag_dir.layout import METADATA_FILE, bag_kind, bags_in, split_number
from ros2_memory.core.errors import BagError
from ros2_memory.core.model import COMPRESSED

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from ros2_memory.core.bag_summary import BagSummary
    from ros2_memory.storage.base import BagReader, Channel

_MAX_BYTES: Final = 64 << 20
_STORAGES: Final = {"mcap": ".mcap", "sqlite3": ".db3"}
_ROOT: Final = "rosbag2_bagfile_information"
# Patterns, not YAML: parsing the list of a day of splits takes 0.8 s (8640 files).
# Nothing is tried twice: a line may have thousands of spaces.
_NAME: Final = r"[ \t]*+['\"]?+([^'\"\r\n]++)['\"]?+$"
_BAG_NAME: Final = re.compile(rf"[ \t]*+(?:- )?(?:- |path:){_NAME}")
_PATH_KEY: Final = re.compile(rf"path:{_NAME}")
_COUNT_KEY: Final = re.compile(r"message_count:[ ]*(\d+)")
_NAMED_POLICY: Final = re.compile(r"reliability:\s*[a-z]")
_FIRST_OF_FILES: Final = 5
_FIRST_OF_TYPE_HASHES: Final = 7
_FIRST_OF_NAMED_QOS: Final = 9
"""Versions of the format in which these came."""
_LOADER: Final[type[yaml.SafeLoader | yaml.CSafeLoader]] = getattr(
    yaml, "CSafeLoader", yaml.SafeLoader
)


class Listing(NamedTuple):
    """What a metadata.yaml lists.

    Attributes:
        names: of the bag files, in order.
        messages: in each file, by its name without `.zstd`; empty before version 5.
        total: messages in all files; None where it is not given.
    """

    names: tuple[str, ...]
    messages: dict[str, int]
    total: int | None


def parse_listing(text: str) -> Listing:
    """Returns what a metadata.yaml lists; nothing if it is not one."""
    names: list[str] = []
    totals: list[tuple[int, int | None]] = []
    messages: dict[str, int] = {}
    path: str | None = None
    count: int | None = None
    # Line by line: patterns over the whole text take twice as long, and a week has 1,000 of them.
    for line in (*text.split("\n"), "- "):
        key = line.lstrip(" ")
        is_item = key.startswith("- ")
        if is_item:
            # What is known of the item before; of any order of keys: not only rosbag2 writes YAML.
            if path is not None and count is not None:
                messages[bare_name(path)] = count
            path = count = None
            key = key[2:].lstrip(" ")
        if key.startswith("path:"):
            path_key = _PATH_KEY.match(key.rstrip())
            path = path_key[1] if path_key and path is None else path
        elif key.startswith("message_count:") and (count_key := _COUNT_KEY.match(key)):
            number = int(count_key[1])
            count = number if count is None else count
            if not is_item:
                totals.append((len(line) - len(key), number))
        if "." in line:
            bag_name = _BAG_NAME.match(line.rstrip())
            if bag_name and bag_kind(bag_name[1]):
                names.append(posixpath.basename(bag_name[1]))
    # That of the whole recording is indented least.
    _, total = min(totals, key=itemgetter(0), default=(0, None))
    return Listing(tuple(names), messages, total)


def read_listing(path: Path | str, directory: int | None = None) -> Listing:
    """Returns what a file lists; its path may be relative to an open directory.

    Raises:
        OSError: it cannot be read.
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

    If it is absent or empty, it is created if the files are named as rosbag2 names them.

    Returns:
        Whether it was written.

    Raises:
        BagError: one of the files cannot be read.
        OSError: metadata.yaml cannot be read or written; the old one remains.
        ValueError: a file is incomplete, or metadata.yaml is of an unknown form; it is unchanged.
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
    """Corrects metadata.yaml where there is one; returns why that failed, or None."""
    try:
        if (recording / METADATA_FILE).exists():
            correct(recording, reader)
    except (BagError, OSError, ValueError) as error:
        return str(error)
    return None


def is_named_by_rosbag2(recording: Path) -> bool:
    """Returns whether the bags of a recording are MCAP files with the names that rosbag2 gives."""
    numbers = (split_number(recording.name, path.name) for path in bags_in(recording))
    return None not in numbers


def describing(text: str, files: Mapping[str, Contents]) -> str:
    """Returns the text of a metadata.yaml that describes these files.

    Args:
        text: the old one, whose descriptions of topics remain; empty where there was none.
        files: the files of the recording by name, at least one.

    Raises:
        ValueError: the old one is no metadata.yaml of a known form.
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
    """Sets times, paths and the description of each file, in order of time."""
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
    """Sets the count of each topic, by name and type, and its QoS where no channel has that."""
    topics = [_mapping(item, "topics") for item in _list(info, "topics_with_message_count")]
    # A day of splits has a million channels, and few QoS.
    offered_qos: defaultdict[tuple[str, str], dict[str, None]] = defaultdict(dict)
    for channel in channels:
        offered_qos[channel.topic, channel.type][_qos(channel)] = None
    listed = set()
    for topic in topics:
        topic_metadata = _mapping(topic.get("topic_metadata"), "topic_metadata")
        key = str(topic_metadata.get("name")), str(topic_metadata.get("type"))
        listed.add(key)
        topic["message_count"] = counts[key]
        offered = [_offered(text, version) for text in offered_qos[key]]
        # rosbags returns no message of a channel whose profiles differ from these.
        if offered and topic_metadata.get("offered_qos_profiles") not in offered:
            topic_metadata["offered_qos_profiles"] = offered[0]
    for channel in channels:
        key = channel.topic, channel.type
        if key not in listed:
            listed.add(key)
            new: dict[object, object] = {
                "name": channel.topic,
                "type": channel.type,
                "serialization_format": channel.encoding,
                "offered_qos_profiles": _offered(_qos(channel), version),
            }
            if version >= _FIRST_OF_TYPE_HASHES:
                type_hash = dict(channel.metadata).get("topic_type_hash", "")
                new["type_description_hash"] = type_hash
            topics.append({"topic_metadata": new, "message_count": counts[key]})
    info["topics_with_message_count"] = topics


def _new_information(channels: Sequence[Channel]) -> dict[str, object]:
    """Returns the content of a new metadata.yaml, before counts, times and topics are set.

    The version is the oldest one that fits the QoS profiles in the files: from 9 on rosbag2 writes
    policies by name, before by number.
    """
    is_named = any(_NAMED_POLICY.search(_qos(channel)) for channel in channels)
    return {
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
        **({"custom_data": None, "ros_distro": ""} if is_named else {}),
    }


def _offered(text: str, version: int) -> object:
    """Returns the QoS profiles as this version has them: as a list, before version 9 as text."""
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
        ValueError: it is no YAML.
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
