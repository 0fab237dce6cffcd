"""Proposes which topics to record, and estimates what they take on the disk. Pure.

What the robot concluded is proposed, not its pixels; what people said is listed, and left to a
person to tick.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable

DAY_S: Final = 86_400
SCAN_SHARE: Final = 0.1
"""Raw readings that take a larger part of a list are left out where the list does not fit."""
MESSAGE_BYTES: Final = 31
"""What MCAP adds to a payload inside of a chunk (its record of a message)."""
INDEX_BYTES: Final = 16
"""What MCAP adds to it outside, uncompressed: an entry of the message index."""
LISTED_BYTES: Final = 342
"""Each split lists the earlier ones of its recording; as measured with rosbag2 0.26."""


class Choice(StrEnum):
    """Whether a topic is recorded."""

    RECORD = "record"
    ASK = "tick?"  # it is left to a person
    LEAVE = "leave"


class Verdict(NamedTuple):
    """What is proposed for a topic, and the reason if it is not simply recorded."""

    choice: Choice
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Offered:
    """A topic that is offered, and how it came while it was measured.

    Attributes:
        latched: whether all of its publishers are transient local.
        payload_bytes: the mean size of a message.
    """

    topic: str
    type: str
    latched: bool = False
    messages: int = 0
    hz: float = 0.0
    payload_bytes: float = 0.0


@dataclass(frozen=True, slots=True)
class Disk:
    """The settings and measurements that decide how much recorded topics take on the disk.

    Attributes:
        ratio: compressed bytes of a byte.
        fixed_bytes: the size of a file without messages: definitions, and metadata.
        columns_share: the bytes that are stored beside the bags, as a part of theirs.
        keep_days: after so many days bags are deleted in any case.
    """

    ratio: float
    fixed_bytes: float
    split_s: float
    session_s: float
    columns_share: float
    budget_bytes: float
    keep_days: float

    def bytes_per_day(self, topics: Iterable[Offered]) -> float:
        """Estimates the bytes of the messages of a day, without `file_bytes_per_day`."""
        per_second = 0.0
        for topic in topics:
            # Each recording has the newest message of a latched topic.
            is_state = topic.latched and topic.messages == 1
            hz = 1 / self.session_s if is_state else topic.hz
            message_bytes = (topic.payload_bytes + MESSAGE_BYTES) * self.ratio + INDEX_BYTES
            per_second += hz * message_bytes
        return per_second * DAY_S * (1 + self.columns_share)

    @property
    def file_bytes_per_day(self) -> float:
        """The bytes of the files of a day, without their messages, if it records all the time."""
        splits_listed = self.session_s / self.split_s / 2  # on average
        file_bytes = self.fixed_bytes + LISTED_BYTES * splits_listed
        return DAY_S / self.split_s * file_bytes * (1 + self.columns_share)

    def days(self, topics: Iterable[Offered]) -> float:
        """Estimates the days of recording that the budget holds."""
        return self.budget_bytes / (self.bytes_per_day(topics) + self.file_bytes_per_day)


Proposal: TypeAlias = "dict[Offered, Verdict]"
"""The verdict on each topic."""


def select(proposal: Proposal, choice: Choice) -> list[Offered]:
    """Returns the topics with this verdict."""
    return [topic for topic, verdict in proposal.items() if verdict.choice is choice]


_RULES: Final = tuple(
    (re.compile(pattern), Verdict(choice, reason))
    for pattern, choice, reason in (
        (
            r"^\S*(Image|CompressedVideo|FFMPEGPacket) |^theora_image_transport/",
            Choice.LEAVE,
            "images: pixels, not what was concluded from them",
        ),
        (r"^\S*PointCloud|^\S*(/Octomap|VelodyneScan|VoxelGrid)|^livox_", Choice.LEAVE, "clouds"),
        (
            r"^\S*/(Costmap|CostmapUpdate|\w*GridMap|OccupancyGridUpdate) |Grid \S*costmap",
            Choice.LEAVE,
            "costmaps",
        ),
        (r"(?i)^\S*audio", Choice.LEAVE, "audio: people's voices"),
        (r"(?i)^\S*(mask|segmentation)", Choice.LEAVE, "segmentation masks"),
        (r"/CameraInfo ", Choice.LEAVE, "the same calibration beside each image"),
        (r"^visualization_msgs/", Choice.LEAVE, "drawings for a screen"),
        (r"^bond/| /clock$", Choice.LEAVE, "beats without content"),
        (
            r"(?i)[/_](live)?(speech|voice|asr|stt|transcri\w+|utterances?|dialogue?)([/_ ]|$)",
            Choice.ASK,
            "what people said",
        ),
        (r"(?i) \S*[/_](audio|microphone|mic)([/_]|$)", Choice.LEAVE, "audio: people's voices"),
        (r"/_(?!action/status$)", Choice.ASK, "inside of an action or a service"),
    )
)
"""Patterns for a type, a space, and a topic; the first that is found decides."""
_RAW: Final = re.compile(r"^sensor_msgs/msg/((MultiEcho)?LaserScan|Imu)$")
_GRID: Final = "nav_msgs/msg/OccupancyGrid"


def judge(topics: Collection[Offered]) -> Proposal:
    """Returns the verdict on each topic by its type and name, whatever the budget is."""
    names = {topic.topic for topic in topics}
    return {topic: _verdict_on(topic, names) for topic in topics}


def _verdict_on(topic: Offered, names: Collection[str]) -> Verdict:
    for pattern, verdict in _RULES:
        if pattern.search(f"{topic.type} {topic.topic}"):
            return verdict
    if f"{topic.topic}_meta" in names:
        return Verdict(Choice.LEAVE, f"masks: {topic.topic}_meta has the same without")
    if topic.type == _GRID and (topic.messages > 1 or not topic.latched):
        return Verdict(Choice.LEAVE, "a grid that comes again and again")
    return Verdict(Choice.RECORD)


def propose(topics: Collection[Offered], disk: Disk) -> Proposal:
    """Returns the verdict on each topic, within the budget.

    If the budget does not last `disk.keep_days`, scans and other raw readings that take more than
    `SCAN_SHARE` of the recorded bytes are left out.
    """
    proposal = judge(topics)
    recorded = select(proposal, Choice.RECORD)
    days, total = disk.days(recorded), disk.bytes_per_day(recorded)
    if days >= disk.keep_days:
        return proposal
    for topic in recorded:
        share = disk.bytes_per_day([topic]) / (total or 1)
        if _RAW.match(topic.type) and share > SCAN_SHARE:
            why = f"{share:.0%} of a list of which the budget would hold {days:.1f} days"
            proposal[topic] = Verdict(Choice.LEAVE, why)
    return proposal


def topics_yaml(proposal: Proposal, estimate: str) -> str:
    """Returns a `topics.yaml` with a comment on top; topics for a person to tick are comments."""
    lines = [f"# Proposed by `ros2-memory up`, and yours to change: {estimate}", "topics:"]
    for choice, tick in ((Choice.RECORD, "- "), (Choice.ASK, "# - ")):
        for topic in select(proposal, choice):
            reason = proposal[topic].reason
            lines.append(f"  {tick}{topic.topic}  # {topic.type}{f': {reason}' if reason else ''}")
    return "\n".join((*lines, ""))
