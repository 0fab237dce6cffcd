"""`metadata.yaml` of a recording, written anew after some of its files were deleted or repaired.

rosbag2 and its readers refuse a recording whose metadata.yaml lists a file that is not there, and
believe the counts and times in it. The format is rosbag2's (rosbag2_storage, `yaml.hpp`), versions
5 and later, which tell of each file what it holds; `ros2 bag reindex` would write the same from the
files themselves.
"""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Final, NamedTuple

import yaml

from ros2_memory.bag_dir.durable_write import read_small_file, write_durably
from ros2_memory.bag_dir.layout import COMPRESSED, METADATA_FILE, bag_kind

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from ros2_memory.core.bag_summary import BagSummary
    from ros2_memory.storage.base import BagReader, Channel

    Counts = Mapping[str, int]

_ROOT: Final = "rosbag2_bagfile_information"
# Lines, not YAML: parsing what a day of splits lists takes a second (8640 files: 0.8 s).
_BAG_NAME: Final = re.compile(
    r"^[ \t]*(?:- )?(?:- |path:)[ \t]*['\"]?([^'\"\r\n]+?)['\"]?\s*$", re.MULTILINE
)
_FILE_ENTRY: Final = re.compile(
    r"^[ ]*- path:[ ]*['\"]?([^'\"\r\n]+?)['\"]?[ \r]*\n"
    r"(?:(?![ ]*- ).*\n)*?"
    r"[ ]*message_count:[ ]*(\d+)",
    re.MULTILINE,
)
_MESSAGE_COUNT: Final = re.compile(r"^ {2,4}message_count:\s*(\d+)\s*$", re.MULTILINE)
_NAMED_POLICY: Final = re.compile(r"reliability:\s*[a-z]")
_FIRST_OF_FILES: Final = 5
_FIRST_OF_TYPE_HASHES: Final = 7
_FIRST_OF_NAMED_QOS: Final = 9
"""Versions of the format that first have these."""
_LOADER: Final[type[yaml.SafeLoader | yaml.CSafeLoader]] = getattr(
    yaml, "CSafeLoader", yaml.SafeLoader
)


class Contents(NamedTuple):
    """What a whole MCAP file of a recording holds."""

    summary: BagSummary
    channels: Sequence[Channel]


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
    """Returns what a metadata.yaml lists; nothing where it is none."""
    total = _MESSAGE_COUNT.search(text)
    return Listing(
        tuple(PurePosixPath(name).name for name in _BAG_NAME.findall(text) if bag_kind(name)),
        {bare_name(path): int(count) for path, count in _FILE_ENTRY.findall(text)},
        None if total is None else int(total[1]),
    )


def correct(recording: Path, reader: BagReader) -> bool:
    """Writes metadata.yaml by what the MCAP files of a recording hold; whether it had to.

    Where there is none, or an empty one, it is made if the files bear the names that rosbag2 gives
    them; else there stays none.

    Raises:
        BagError: one of the files cannot be read, or not whole.
        OSError: it cannot be read or written; the one before stands.
        ValueError: it is none that this can be done with, and why; it stands as it is.
    """
    path = recording / METADATA_FILE
    files = [each for each in recording.glob("*.mcap") if not each.name.startswith(".")]
    text = ""
    with suppress(FileNotFoundError):
        text = read_small_file(path)
    if not files or not (text or all(_is_of_rosbag2(each) for each in files)):
        return False
    held: dict[str, Contents] = {}
    for each in files:
        held[each.name] = Contents(reader.summarize(each), reader.channels(each))
        if not held[each.name].summary.complete:
            raise ValueError(f"{each.name} is not whole")
    written = describing(text, held)
    if written != text:
        write_durably(path, written)
    return written != text


def _is_of_rosbag2(file: Path) -> bool:
    """Whether rosbag2 gives such a name to a file of this recording."""
    number = file.stem.removeprefix(f"{file.parent.name}_")
    return number != file.stem and number.isdecimal()


def describing(text: str, files: Mapping[str, Contents]) -> str:
    """The text of a metadata.yaml with the counts and times of these MCAP files, and no others.

    Args:
        text: the one before, whose descriptions of topics stay; empty where there was none.
        files: the files of the recording by name, at least one.

    Raises:
        ValueError: the one before is no metadata.yaml of a known form.
    """
    channels = [channel for each in files.values() for channel in each.channels]
    content: object = _parsed(text) if text else {_ROOT: _beginning(channels)}
    info = _mapping(_mapping(content, "it").get(_ROOT), _ROOT)
    if info.get("storage_identifier") != "mcap" or info.get("compression_mode") == "FILE":
        raise ValueError("it is not of plain MCAP files")
    version = _int(info, "version")
    if version < _FIRST_OF_FILES:
        raise ValueError(f"it is of version {version}, which is older than MCAP files")
    before = [str(each) for each in _list(info, "relative_file_paths")]
    held = {name: each.summary for name, each in files.items()}
    spans = {name: (each.start, each.end) for name, each in held.items() if not each.empty}
    first = min((start for start, _ in spans.values()), default=0)
    last = max((end for _, end in spans.values()), default=first)
    order = sorted(files, key=lambda name: (spans.get(name, (last, last)), name))
    paths = {bare_name(each): each for each in before}
    counts: dict[tuple[str, str], int] = {}
    for summary in held.values():
        for topic in summary.topics:
            key = topic.topic, topic.type
            counts[key] = counts.get(key, 0) + topic.count
    total = sum(counts.values())
    info["message_count"] = total
    info["starting_time"] = {"nanoseconds_since_epoch": first}
    info["duration"] = {"nanoseconds": last - first}
    info["relative_file_paths"] = [paths.get(name, name) for name in order]
    info["files"] = [
        {
            "path": name,
            "starting_time": {"nanoseconds_since_epoch": spans.get(name, (first, first))[0]},
            "duration": {"nanoseconds": span[1] - span[0] if (span := spans.get(name)) else 0},
            "message_count": held[name].count,
        }
        for name in order
    ]
    topics = [_mapping(each, "topics") for each in _list(info, "topics_with_message_count")]
    known: set[tuple[str, str]] = set()
    for each in topics:
        about = _mapping(each.get("topic_metadata"), "topic_metadata")
        key = str(about.get("name")), str(about.get("type"))
        known.add(key)
        each["message_count"] = counts.get(key, 0)
        offered = [_offered(channel, version) for channel in channels if _key(channel) == key]
        # rosbags gives no message of a channel whose profiles differ from these.
        if offered and about.get("offered_qos_profiles") not in offered:
            about["offered_qos_profiles"] = offered[0]
    for channel in channels:
        key = _key(channel)
        if key not in known:
            known.add(key)
            new = _topic_metadata(channel, version)
            topics.append({"topic_metadata": new, "message_count": counts.get(key, 0)})
    info["topics_with_message_count"] = topics
    return yaml.safe_dump(content, sort_keys=False, allow_unicode=True)


def _beginning(channels: Sequence[Channel]) -> dict[str, object]:
    """What a metadata.yaml holds beside counts, times and topics.

    The version is the oldest that the QoS profiles in the files fit: from 9 on rosbag2 writes the
    names of policies, before their numbers.
    """
    named = any(_NAMED_POLICY.search(_qos(channel)) for channel in channels)
    return {
        "version": _FIRST_OF_NAMED_QOS if named else _FIRST_OF_FILES,
        "storage_identifier": "mcap",
        "duration": {},
        "starting_time": {},
        "message_count": 0,
        "topics_with_message_count": [],
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [],
        "files": [],
        **({"custom_data": None, "ros_distro": ""} if named else {}),
    }


def _topic_metadata(channel: Channel, version: int) -> dict[str, object]:
    about: dict[str, object] = {
        "name": channel.topic,
        "type": channel.type,
        "serialization_format": channel.encoding,
        "offered_qos_profiles": _offered(channel, version),
    }
    if version >= _FIRST_OF_TYPE_HASHES:
        about["type_description_hash"] = dict(channel.metadata).get("topic_type_hash", "")
    return about


def _key(channel: Channel) -> tuple[str, str]:
    return channel.topic, channel.type


def _offered(channel: Channel, version: int) -> object:
    """The QoS profiles as a metadata.yaml of this version holds them: as a list, before as text."""
    text = _qos(channel)
    return text if version < _FIRST_OF_NAMED_QOS else _parsed(text) or []


def _qos(channel: Channel) -> str:
    return dict(channel.metadata).get("offered_qos_profiles", "")


def _parsed(text: str) -> object:
    """The value of a YAML text.

    Raises:
        ValueError: it is none.
    """
    try:
        value: object = yaml.load(text, _LOADER)  # noqa: S506 - a safe one
    except (yaml.YAMLError, RecursionError) as error:
        raise ValueError("it is no YAML") from error
    return value


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
    content = _parsed(text)
    info = _mapping(_mapping(content, "it").get(_ROOT), _ROOT)
    names = {bare_name(name): counts for name, counts in gone.items()}
    files = [_mapping(each, "files") for each in _list(info, "files")]
    paths = _list(info, "relative_file_paths")
    deleted = [each for each in files if bare_name(each.get("path")) in names]
    left = [each for each in files if bare_name(each.get("path")) not in names]
    left_paths = [each for each in paths if bare_name(each) not in names]
    if len(left_paths) == len(paths) and not deleted:
        return None
    if not left or len(left) != len(left_paths):
        raise ValueError("it does not list the files that are left")
    held: dict[str, int] = {}
    for each in deleted:
        counts = names[bare_name(each.get("path"))]
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


def bare_name(path: object) -> str:
    """Returns the name of a bag file without the suffix of its compressed form."""
    return PurePosixPath(str(path)).name.removesuffix(COMPRESSED)


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
