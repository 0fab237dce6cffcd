"""The text of `metadata.yaml`, and of the copy of it that every file carries.

Metadata version 9, in the order and spelling of yaml-cpp, as the real recorder writes it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from textwrap import indent
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterable

NEVER: Final = 2**63 - 1  # the starting time of what holds no message


@dataclass
class Span:
    """When the first message came, how long it went on (ns), and how many there were."""

    start: int = NEVER
    duration: int = 0
    count: int = 0

    def take(self, log_time: int) -> None:
        self.start = min(self.start, log_time)
        self.duration = max(self.duration, log_time - self.start)
        self.count += 1


@dataclass
class Topic:
    """A topic that was subscribed. `qos` is the text of what its publishers offer."""

    name: str
    type: str
    qos: str
    type_hash: str
    count: int = 0


@dataclass
class Info:
    """What a recording is known to hold."""

    custom: dict[str, str]
    whole: Span = field(default_factory=Span)
    files: list[tuple[str, Span]] = field(default_factory=list)


def qos_text(profiles: Iterable[dict[str, str | int]]) -> str:
    """What the publishers of a topic offer, one entry each; durations are in nanoseconds."""
    return "\n".join(map(_profile_text, profiles)) or "[]"


def metadata_text(info: Info, topics: Iterable[Topic] = ()) -> str:
    """The text without its outermost key. The copies in the files name no topics."""
    listed = "\n".join(map(_topic_text, topics)) or "[]"
    paths = "\n".join(f"- {path}" for path, _ in info.files)
    files = "\n".join(
        f"- path: {path}\n  starting_time:\n    nanoseconds_since_epoch: {span.start}\n"
        f"  duration:\n    nanoseconds: {span.duration}\n  message_count: {span.count}"
        for path, span in info.files
    )
    custom = "\n".join(f"  {key}: {value}" for key, value in info.custom.items())
    return "\n".join(
        (
            "version: 9",
            "storage_identifier: mcap",
            f"duration:\n  nanoseconds: {info.whole.duration}",
            f"starting_time:\n  nanoseconds_since_epoch: {info.whole.start}",
            f"message_count: {info.whole.count}",
            f"topics_with_message_count:\n{indent(listed, '  ')}",
            'compression_format: ""',
            'compression_mode: ""',
            f"relative_file_paths:\n{indent(paths, '  ')}",
            f"files:\n{indent(files, '  ')}",
            f"custom_data:\n{custom}" if custom else "custom_data: ~",
            "ros_distro: jazzy",
        )
    )


def whole_file(text: str) -> str:
    """`metadata.yaml`."""
    return "rosbag2_bagfile_information:\n" + indent(text, "  ")


def _topic_text(topic: Topic) -> str:
    return (
        "- topic_metadata:\n"
        f"    name: {topic.name}\n    type: {topic.type}\n    serialization_format: cdr\n"
        f"    offered_qos_profiles:\n{indent(topic.qos, '      ')}\n"
        f"    type_description_hash: {topic.type_hash}\n"
        f"  message_count: {topic.count}"
    )


def _profile_text(profile: dict[str, str | int]) -> str:
    return "- " + "\n  ".join(
        (
            f"history: {profile['history']}",
            f"depth: {profile['depth']}",
            f"reliability: {profile['reliability']}",
            f"durability: {profile['durability']}",
            f"deadline:\n{_duration_text(profile['deadline'])}",
            f"lifespan:\n{_duration_text(profile['lifespan'])}",
            f"liveliness: {profile['liveliness']}",
            f"liveliness_lease_duration:\n{_duration_text(profile['liveliness_lease_duration'])}",
            "avoid_ros_namespace_conventions: false",
        )
    )


def _duration_text(duration: str | int) -> str:
    seconds, nanoseconds = divmod(int(duration), 10**9)
    return f"    sec: {seconds}\n    nsec: {nanoseconds}"
