"""Plans the QoS that each topic is subscribed with. Pure.

rosbag2 subscribes with a queue of 10 messages, so a stall of 200 ms loses messages of 50 Hz. An
override makes the queue deeper, and fixes the whole profile with it: what the override does not
name is rclcpp's default, which refuses weaker publishers. So an override is only made for topics
whose offered QoS a closed split has shown, and asks for no more than all publishers offer.

No deadline is requested: a subscription without one fits every publisher, and one with a deadline
refuses all that offer a longer one or none (`DEADLINE_QOS_POLICY`), for nothing in return.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import yaml

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

HOLD_S: Final = 2.0
"""A queue holds what arrives within so many seconds."""
DEFAULT_DEPTH: Final = 10
"""The depth with which rosbag2 subscribes by itself."""
HEADROOM: Final = 2
"""Queues are made so many times as deep as measured, where memory allows."""
MESSAGE_BYTES: Final = 256
"""What a queued message takes besides its payload, in bytes: sample, change and allocation."""

# Enumerations are numbers up to Iron (rmw/types.h), names since.
_RELIABLE: Final = frozenset({"reliable", 1})
_LATCHED: Final = frozenset({"transient_local", 1})


@dataclass(frozen=True, slots=True)
class OfferedQos:
    """What all publishers of a topic offer: `reliable`, and `latched` (transient local)."""

    reliable: bool
    latched: bool
    publishers: int = 1


@dataclass(frozen=True, slots=True)
class TopicFlow:
    """How a topic arrives.

    Attributes:
        offered: what all of its publishers offer.
        burst: the most messages within `HOLD_S`.
        largest: the largest payload in bytes.
    """

    offered: OfferedQos
    burst: int
    largest: int

    @property
    def message_bytes(self) -> int:
        """What one of its messages may take in a queue, in bytes."""
        return self.largest + MESSAGE_BYTES

    def joined(self, newer: TopicFlow) -> TopicFlow:
        """Returns the newer flow, with peaks of this one that fade by a tenth with each split."""
        return TopicFlow(
            newer.offered,
            max(newer.burst, self.burst * 9 // 10),
            max(newer.largest, self.largest * 9 // 10),
        )


@dataclass(frozen=True, slots=True)
class QueuePlan:
    """The depth of each queue. `cut_short` hold less than `HOLD_S`, for want of memory."""

    depths: Mapping[str, int]
    cut_short: frozenset[str] = frozenset()

    def depth(self, topic: str) -> int:
        """Returns the depth of a topic's queue; without a plan it is rosbag2's own."""
        return self.depths.get(topic, DEFAULT_DEPTH)


def offered_by_all(texts: Collection[str]) -> OfferedQos | None:
    """Returns what all publishers offer, by rosbag2's `offered_qos_profiles` in one bag.

    Best effort if any publisher is, volatile if any is; None where the texts list no publisher, as
    those of other programs.
    """
    profiles: list[Mapping[str, object]] = []
    for text in texts:
        try:
            listed: object = yaml.safe_load(text)
        except yaml.YAMLError:
            return None
        if not isinstance(listed, list) or not all(isinstance(each, dict) for each in listed):
            return None
        profiles += listed
    if not profiles:
        return None
    return OfferedQos(
        reliable=all(each.get("reliability") in _RELIABLE for each in profiles),
        latched=all(each.get("durability") in _LATCHED for each in profiles),
        publishers=len(profiles),
    )


def plan_queues(flows: Mapping[str, TopicFlow], queue_bytes: int) -> QueuePlan:
    """Returns depths that hold `HOLD_S` of each topic and together take at most `queue_bytes`.

    Where that is not enough, no topic takes more than an equal share of what the smaller ones
    leave. At least one message of each is held, however large.
    """
    depths: dict[str, int] = {}
    for factor in (HEADROOM, 1):
        depths = {topic: max(DEFAULT_DEPTH, factor * flow.burst) for topic, flow in flows.items()}
        if (
            sum(depth * flows[topic].message_bytes for topic, depth in depths.items())
            <= queue_bytes
        ):
            return QueuePlan(depths)
    wanted = {topic: max(1, flow.burst) for topic, flow in flows.items()}
    # One message of each, and shares of what is then left.
    left, topics = queue_bytes - sum(each.message_bytes for each in flows.values()), len(wanted)
    for topic in sorted(wanted, key=lambda each: wanted[each] * flows[each].message_bytes):
        size = flows[topic].message_bytes
        more = min(wanted[topic] - 1, max(0, left) // topics // size)
        depths[topic] = 1 + more
        left -= more * size
        topics -= 1
    short = frozenset(topic for topic, depth in depths.items() if depth < flows[topic].burst)
    return QueuePlan(depths, short)


def too_shallow_topics(
    flows: Mapping[str, TopicFlow], planned: QueuePlan, active: QueuePlan
) -> frozenset[str]:
    """Returns the topics whose queues hold less than `HOLD_S`, and would be deeper as planned."""
    return frozenset(
        topic
        for topic, flow in flows.items()
        if active.depth(topic) < flow.burst and active.depth(topic) < planned.depth(topic)
    )


def qos_overrides(
    flows: Mapping[str, TopicFlow],
    plan: QueuePlan,
    *,
    latched: Collection[str],
    weakest: Collection[str] = (),
    volatile: Collection[str] = (),
) -> str:
    """Returns YAML for `--qos-profile-overrides-path`.

    Args:
        flows: the topics whose QoS is known.
        plan: the depths of their queues.
        latched: the topics that count as latched and may have many publishers. All of their
            messages are asked for, unless their publishers are known to be volatile, or it is one
            of `volatile`.
        weakest: topics with a publisher that was refused. They are asked for with what fits every
            publisher: rosbag2 itself asks for more where it knows none of them yet.
        volatile: topics whose earlier messages are not asked for again, though they are latched.
    """
    profiles: dict[str, dict[str, str | int]] = {
        topic: {
            "history": "keep_last",
            "depth": DEFAULT_DEPTH,
            "reliability": "best_effort",
            "durability": "volatile",
        }
        for topic in weakest
    }
    for topic, flow in flows.items():
        profiles[topic] = {
            "history": "keep_last",
            "depth": plan.depth(topic),
            "reliability": "reliable" if flow.offered.reliable else "best_effort",
            "durability": (
                "transient_local" if flow.offered.latched and topic not in volatile else "volatile"
            ),
        }
    for topic in latched:
        if topic not in flows or (flows[topic].offered.latched and topic not in volatile):
            reliable = topic not in flows or flows[topic].offered.reliable
            profiles[topic] = {
                "history": "keep_all",
                "reliability": "reliable" if reliable else "best_effort",
                "durability": "transient_local",
            }
    return yaml.safe_dump(profiles, sort_keys=True)
