"""The QoS that topics are subscribed with, from what rosbag2 wrote about their publishers."""

from __future__ import annotations

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.recorder.measure import OfferedQos, TopicFlow, offered_by_all
from ros2_memory.recorder.reception import plan_queues, qos_overrides

MIB = 2**20
RELIABLE = OfferedQos(reliable=True, latched=False)


def offer(reliability: str, durability: str) -> str:
    """One publisher, as rosbag2 0.26 writes it."""
    return (
        f"- history: unknown\n  depth: 0\n  reliability: {reliability}\n"
        f"  durability: {durability}\n  deadline:\n    sec: 9223372036\n    nsec: 854775807\n"
    )


@pytest.mark.parametrize(
    ("offers", "reliable", "latched"),
    [
        ([("reliable", "volatile")], True, False),
        ([("reliable", "transient_local")], True, True),
        ([("reliable", "transient_local"), ("best_effort", "transient_local")], False, True),
        ([("reliable", "transient_local"), ("reliable", "volatile")], True, False),
        ([("1", "1")], True, True),
        ([("2", "2")], False, False),
        ([("unknown", "unknown")], False, False),
    ],
)
def test_no_more_is_asked_for_than_all_publishers_offer(
    offers: list[tuple[str, str]], reliable: bool, latched: bool
) -> None:
    text = "".join(offer(*each) for each in offers)
    assert offered_by_all([text]) == OfferedQos(reliable, latched, len(offers))


@pytest.mark.parametrize("text", ["", "[]", "{a: 1}", "- 1", "- [", "text"])
def test_a_topic_whose_publishers_are_not_stated_gets_no_override(text: str) -> None:
    assert offered_by_all([text]) is None
    assert offered_by_all([]) is None


@given(
    flows=st.dictionaries(
        st.sampled_from("abcdef"),
        st.builds(TopicFlow, st.just(RELIABLE), st.integers(1, 2000), st.integers(0, 8 * MIB)),
    ),
    queue_mb=st.integers(1, 256),
)
def test_queues_hold_two_seconds_or_are_named_and_fit_in_their_memory(
    flows: dict[str, TopicFlow], queue_mb: int
) -> None:
    plan = plan_queues(flows, queue_mb * MIB)
    assert plan.depths.keys() == flows.keys()
    taken = sum(plan.depths[topic] * flow.message_bytes for topic, flow in flows.items())
    single = sum(flow.message_bytes for flow in flows.values())  # one message of each is held
    assert taken <= max(queue_mb * MIB, single)
    for topic, flow in flows.items():
        assert (plan.depths[topic] < flow.burst) == (topic in plan.cut_short)
        assert plan.depths[topic] >= 1


def test_an_override_names_the_whole_profile_but_no_deadline() -> None:
    flows = {
        "/odom": TopicFlow(RELIABLE, 100, 700),
        "/scan": TopicFlow(OfferedQos(reliable=False, latched=False), 20, 700),
        "/map": TopicFlow(OfferedQos(reliable=True, latched=True), 1, 700),
        "/tf_static": TopicFlow(OfferedQos(reliable=True, latched=True), 1, 700),
    }
    text = qos_overrides(flows, plan_queues(flows, MIB), latched=["/tf_static", "/unseen"])
    every = {"history": "keep_all", "reliability": "reliable", "durability": "transient_local"}
    last = {"history": "keep_last", "reliability": "reliable", "durability": "volatile"}
    assert yaml.safe_load(text) == {
        "/odom": {**last, "depth": 200},
        "/scan": {**last, "depth": 40, "reliability": "best_effort"},
        "/map": {**last, "depth": 10, "durability": "transient_local"},
        "/tf_static": every,
        "/unseen": every,
    }
