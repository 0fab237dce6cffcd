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
    """What becomes of a topic."""

    RECORD = "record"
    ASK = "tick?"  # it is left to a person
    LEAVE = "leave"


class Verdict(NamedTuple):
    """What is proposed of a topic, and why where it is not simply recorded."""

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
    """What decides how much the recorded topics take on the disk.

    Attributes:
        ratio: compressed bytes of a byte.
        fixed_bytes: what a file of no message has: definitions, and metadata.
        columns_share: what is stored beside the bags, as a part of them.
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
        """Estimates the bytes that the messages of these topics take in a day, without files."""
        return sum(
            self._rate(topic)
            * ((topic.payload_bytes + MESSAGE_BYTES) * self.ratio + INDEX_BYTES)
            * DAY_S
            * (1 + self.columns_share)
            for topic in topics
        )

    @property
    def file_bytes_per_day(self) -> float:
        """The bytes that files take in a day which record all the time, whatever is in them."""
        in_each = self.fixed_bytes + LISTED_BYTES * self.session_s / self.split_s / 2
        return DAY_S / self.split_s * in_each * (1 + self.columns_share)

    def days(self, topics: Iterable[Offered]) -> float:
        """Estimates the days of recording that the budget holds."""
        return self.budget_bytes / (self.bytes_per_day(topics) + self.file_bytes_per_day)

    def _rate(self, topic: Offered) -> float:
        # Of a latched topic each recording has the newest message.
        return 1 / self.session_s if topic.latched and topic.messages == 1 else topic.hz


Proposal: TypeAlias = "dict[Offered, Verdict]"
"""All topics, each with what is proposed of it."""


def chosen(proposal: Proposal, choice: Choice) -> list[Offered]:
    """Returns the topics of which this is proposed."""
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
    """Returns what is proposed of each topic, whatever the budget is."""
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
    """Returns what is proposed of each topic.

    Where the budget does not hold `disk.keep_days`, scans and other raw readings that take more
    than `SCAN_SHARE` of the list are left out.
    """
    proposal = judge(topics)
    recorded = chosen(proposal, Choice.RECORD)
    days, in_all = disk.days(recorded), disk.bytes_per_day(recorded)
    for topic in recorded if days < disk.keep_days else ():
        share = disk.bytes_per_day([topic]) / (in_all or 1)
        if _RAW.match(topic.type) and share > SCAN_SHARE:
            why = f"{share:.0%} of a list of which the budget would hold {days:.1f} days"
            proposal[topic] = Verdict(Choice.LEAVE, why)
    return proposal


def topics_yaml(proposal: Proposal, head: str) -> str:
    """Returns a `topics.yaml` with a comment on top; what a person has to tick is a comment."""
    lines = [f"# Proposed by `ros2-memory up`, and yours to change: {head}", "topics:"]
    for choice, tick in ((Choice.RECORD, "- "), (Choice.ASK, "# - ")):
        for topic in chosen(proposal, choice):
            why = proposal[topic].reason
            lines.append(f"  {tick}{topic.topic}  # {topic.type}{f': {why}' if why else ''}")
    return "\n".join((*lines, ""))
