"""What closed splits show of a topic, and when that takes a new recording."""

from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.bag_dir.state_files import Loss, read_losses
from ros2_memory.core.timebase import MAX_NS, MIN_NS
from ros2_memory.recorder import measure
from ros2_memory.recorder import reception as reception_module
from ros2_memory.recorder.measure import OfferedQos, TopicFlow, measure_split, offered_by_all
from ros2_memory.recorder.reception import (
    ASK_AGAIN_S,
    ASKED_FOR,
    DEEPEN_EVERY_S,
    Reception,
    Rotation,
    newest_splits,
    plan_queues,
)
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import McapLayout, odom, write_mcap
from tests.support.simulated_recorders import Inline

NS = 10**9
T0 = 1_795_000_000 * NS


def split(path: Path, hz: int, seconds: int, topic: str = "/odom") -> Path:
    ticks = range(hz * seconds)
    return write_mcap(path, [odom(T0 + tick * NS // hz, 1.0, 2.0, topic=topic) for tick in ticks])


def reception(bag_dir: Path, **how: Any) -> Reception:
    given = {"latched": ["/tf_static"], **how}
    return Reception(McapReader(), 2**26, bag_dir=bag_dir, background=Inline(), **given)


def latched_split(path: Path, *topics: str) -> Path:
    """Nine messages of each topic, whose publishers are transient local."""
    messages = [odom(T0 + at * NS, 1.0, 2.0, topic=topic) for at in range(9) for topic in topics]
    return write_mcap(path, messages, McapLayout(latched=frozenset(topics)))


def profiles(of: Reception, recording: str) -> dict[str, dict[str, Any]]:
    found: dict[str, dict[str, Any]] = yaml.safe_load(of.overrides(recording))
    return found


def qos(of: Reception, recording: str) -> dict[str, tuple[str, str]]:
    """Reliability and durability of each topic."""
    asked = profiles(of, recording).items()
    return {topic: (each["reliability"], each["durability"]) for topic, each in asked}


def rotated(of: Reception, recording: str, now_s: float) -> Rotation:
    """The reason for which a recording is rotated then."""
    due = of.rotation_due(recording, now_s)
    assert due is not None
    of.note_rotation(due, now_s)
    return due


def test_a_topic_gets_its_depth_by_one_rotation_after_its_first_split(tmp_path: Path) -> None:
    made = reception(tmp_path)
    assert profiles(made, "a").keys() == {"/tf_static"}
    assert made.rotation_due("a", 0.0) is None
    made.learn("a", split(tmp_path / "a_0.mcap", 50, 4))
    rotation = rotated(made, "a", 10.0)
    assert (rotation.event, {*rotation.topics}) == ("queues_deepened", {"/odom"})
    assert profiles(made, "b")["/odom"]["depth"] == 200
    made.learn("b", split(tmp_path / "b_0.mcap", 50, 4))
    assert made.rotation_due("b", 1000.0) is None
    # Topics that come one by one do not rotate one by one.
    made.learn("b", split(tmp_path / "b_1.mcap", 50, 4, topic="/late"))
    assert made.rotation_due("b", 10.0 + DEEPEN_EVERY_S - 1) is None
    assert rotated(made, "b", 10.0 + DEEPEN_EVERY_S).topics == {"/late"}


def test_a_refused_publisher_is_asked_again_at_most_once_in_five_minutes(tmp_path: Path) -> None:
    made = reception(tmp_path)
    made.recall([split(tmp_path / "old.mcap", 50, 4)])
    assert "/odom" in profiles(made, "a")
    made.note_refused("a", "/odom")
    # The recording that refused it still states what the other publishers offered.
    made.learn("a", split(tmp_path / "a_0.mcap", 50, 4))
    rotation = rotated(made, "a", 50.0)
    assert (rotation.event, {*rotation.topics}) == ("asking_again", {"/odom"})
    assert qos(made, "b")["/odom"] == ("best_effort", "volatile")
    made.note_refused("b", "/odom")
    assert made.rotation_due("b", 50.0 + ASK_AGAIN_S - 1) is None
    assert made.rotation_due("b", 50.0 + ASK_AGAIN_S) is not None


def test_a_topic_taken_for_latched_whose_publisher_is_volatile_adapts_too(tmp_path: Path) -> None:
    made = reception(tmp_path)
    made.overrides("a")
    made.note_refused("a", "/tf_static", best_effort=False)
    assert profiles(made, "b") == {}
    made.learn("a", latched_split(tmp_path / "a.mcap", "/map"))
    made.note_refused("a", "/map", best_effort=False)
    assert qos(made, "b")["/map"] == ("reliable", "volatile")


def test_a_best_effort_publisher_of_a_latched_topic_is_asked_for_until_it_was_heard(
    tmp_path: Path,
) -> None:
    """A split names the publishers that its recording had discovered, often not all."""
    made, topics = reception(tmp_path), ("/map", "/tf_static")
    latched = latched_split(tmp_path / "a.mcap", *topics)
    made.overrides("a")
    made.learn("a", latched)
    for topic in topics:
        made.note_refused("a", topic)
        made.note_refused("a", topic, best_effort=False)  # the other policy of the same publisher
    rotated(made, "a", 50.0)
    for name in ("b", "c"):
        assert {*qos(made, name).values()} == {("best_effort", "volatile")}
        made.learn(name, latched)
    for nth in range(ASKED_FOR - 2):
        profiles(made, f"later_{nth}")
    assert {*qos(made, "d").values()} == {("reliable", "transient_local")}
    # This one had not asked for the weakest: it need not wait.
    made.note_refused("d", "/map")
    assert made.rotation_due("d", 51.0) is not None


def test_a_split_that_does_not_name_the_weaker_publisher_does_not_show_that_it_has_gone(
    tmp_path: Path,
) -> None:
    made = reception(tmp_path)
    splits = [split(tmp_path / f"a_{nth}.mcap", 5, 4) for nth in range(2)]
    made.overrides("a")
    made.learn("a", splits[0])
    weaker = TopicFlow(OfferedQos(reliable=False, latched=False, publishers=2), 10, 700)
    measured = measure_split(McapReader(), splits[0])._replace(flows={"/odom": weaker})
    with patch.object(reception_module, "measure_split", return_value=measured):
        made.learn("a", splits[0])
    made.learn("a", splits[1])
    assert profiles(made, "b")["/odom"]["reliability"] == "best_effort"


def test_what_a_refused_publisher_sent_is_missing_until_its_recording_ends(tmp_path: Path) -> None:
    made = reception(tmp_path)
    made.overrides("a")
    made.learn("a", split(tmp_path / "a_0.mcap", 5, 4))
    made.note_refused("a", "/odom")
    made.overrides("b")
    made.learn("b", split(tmp_path / "b_0.mcap", 5, 4))
    assert read_losses(tmp_path, MIN_NS, MAX_NS) == []
    made.learn("a", split(tmp_path / "a_1.mcap", 5, 8))
    last = T0 + 39 * NS // 5
    assert read_losses(tmp_path, MIN_NS, MAX_NS) == [Loss("/odom", T0, last + 1, 0, "refused")]


def test_of_a_huge_split_the_end_shows_rates_and_no_holes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = split(tmp_path / "a_0.mcap", 50, 10)
    whole = measure_split(McapReader(), path)
    assert len(whole.progress["/odom"].positions) == 500
    monkeypatch.setattr(measure, "SPLIT_BYTES", 1000)
    tail = measure_split(McapReader(), path)
    assert tail.flows == whole.flows
    assert tail.progress == {}
    assert tail.end - tail.start <= measure.TAIL_NS


def test_the_newest_splits_of_an_earlier_run_are_found(tmp_path: Path) -> None:
    assert newest_splits(tmp_path) == []
    assert newest_splits(tmp_path / "none") == []
    older = [split(tmp_path / "rec_20261120T080000Z" / f"x_{n}.mcap", 5, 1) for n in range(3)]
    split(tmp_path / "other" / "x_0.mcap", 5, 1)
    newest = split(tmp_path / "rec_20261120T090000Z" / "x_0.mcap", 5, 1)
    (tmp_path / "rec_20261120T090000Z" / "x_1.mcap").touch()
    elsewhere = split(tmp_path / "other" / "x_1.mcap", 5, 1)
    (tmp_path / "rec_20261120T090000Z" / "x_2.mcap").symlink_to(elsewhere)
    (tmp_path / "rec_20261120T100000Z").symlink_to(elsewhere.parent)
    assert newest_splits(tmp_path) == [*older[1:], newest]


def test_an_earlier_run_shows_the_depth_of_each_topic_also_of_one_that_had_ended(
    tmp_path: Path,
) -> None:
    folder = tmp_path / "rec_20261120T080000Z"
    split(folder / "x_0.mcap", 100, 20)
    (folder / "x_1.mcap").write_bytes(b"nothing")
    split(folder / "x_2.mcap", 50, 1, topic="/scan")
    made = reception(tmp_path)
    made.recall(newest_splits(tmp_path))
    asked = profiles(made, "a")
    assert (asked["/odom"]["depth"], asked["/scan"]["depth"]) == (400, 200)
    assert made.lost_in_last_hour(T0) == {}


def test_a_latched_message_that_is_excluded_is_not_asked_for(tmp_path: Path) -> None:
    """Unless another publisher of the topic may have one, or it is not known who publishes it.

    A log is never asked for what a rule may have excluded.
    """
    made = reception(tmp_path, volatile=["/rosout"])
    topics = ("/map", "/tf_static", "/shared", "/plan", "/rosout")
    made.learn("a", latched_split(tmp_path / "a_0.mcap", *topics))
    made._flows["/shared"] = made._flows["/shared"]._replace(
        offered=OfferedQos(reliable=True, latched=True, publishers=2)
    )
    made.skip_latched(["/map", "/tf_static", "/shared", "/unknown"])
    latched, volatile = ("reliable", "transient_local"), ("reliable", "volatile")
    assert qos(made, "b") == {
        "/map": volatile,
        "/tf_static": volatile,
        "/shared": latched,
        "/plan": latched,
        "/rosout": volatile,
    }
    made.skip_latched([])
    assert qos(made, "c") == dict.fromkeys(topics, latched) | {"/rosout": volatile}


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
        ([("unknown", "unknown")], False, False),
    ],
)
def test_no_more_is_asked_for_than_all_publishers_offer(
    offers: list[tuple[str, str]], reliable: bool, latched: bool
) -> None:
    text = "".join(offer(*each) for each in offers)
    assert offered_by_all([text]) == OfferedQos(reliable, latched, len(offers))


@pytest.mark.parametrize("texts", [[], [""], ["[]"], ["{a: 1}"], ["- 1"], ["- ["], ["text"]])
def test_a_topic_whose_publishers_are_not_stated_gets_no_override(texts: list[str]) -> None:
    assert offered_by_all(texts) is None


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


def test_an_override_names_the_whole_profile_but_no_deadline(tmp_path: Path) -> None:
    made = reception(tmp_path, latched=["/tf_static", "/unseen"])
    made._flows = {
        "/odom": TopicFlow(RELIABLE, 100, 700),
        "/scan": TopicFlow(OfferedQos(reliable=False, latched=False), 20, 700),
        "/map": TopicFlow(OfferedQos(reliable=True, latched=True), 1, 700),
        "/tf_static": TopicFlow(OfferedQos(reliable=True, latched=True), 1, 700),
    }
    every = {"history": "keep_all", "reliability": "reliable", "durability": "transient_local"}
    last = {"history": "keep_last", "reliability": "reliable", "durability": "volatile"}
    assert profiles(made, "a") == {
        "/odom": {**last, "depth": 200},
        "/scan": {**last, "depth": 40, "reliability": "best_effort"},
        "/map": {**last, "depth": 10, "durability": "transient_local"},
        "/tf_static": every,
        "/unseen": every,
    }
