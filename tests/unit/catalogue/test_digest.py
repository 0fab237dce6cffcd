"""What a digest says of a bag is what reading the bag says."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from ros2_memory.catalogue.digest import Digester
from ros2_memory.catalogue.topic_digest import MAX_STORED
from ros2_memory.core.bag_summary import SummarySchema
from tests.support.bags import Msg, odom, text, tf, transform
from tests.support.fakes import FakeReader
from tests.support.memories import extractor

if TYPE_CHECKING:
    from ros2_memory.catalogue.digest import Digest
    from ros2_memory.catalogue.topic_digest import TopicDigest

S = 10**9
MS = 10**6
T0 = 1_700_000_000 * S
BAG = Path("rec/rec_0.mcap")


def digest_of(messages: list[Msg]) -> Digest:
    reader = FakeReader()
    reader.add(BAG, messages)
    return Digester(reader, extractor()).digest(BAG)


def topic_of(messages: list[Msg]) -> TopicDigest:
    [topic] = digest_of(messages).topics
    return topic


def test_one_message_that_cannot_be_decoded_leaves_edges_unknown() -> None:
    broken = Msg("/chatter", "std_msgs/msg/String", T0 + S, b"\x00\x01\x00\x00\xff\xff\xff\x7f")
    seen = topic_of([text(T0, "hello"), broken])
    assert seen.edges is None


# The rest


def test_edges_are_all_pairs_and_the_stamps_of_the_ends() -> None:
    seen = topic_of(
        [
            tf(T0 + 5 * S, transform(T0 + 2 * S, "odom", "base_link", (0, 0, 0))),
            tf(T0 + 6 * S, transform(T0, "map", "odom", (0, 0, 0))),
            tf(T0 + 7 * S, transform(T0 + 4 * S, "odom", "base_link", (0, 0, 0))),
        ]
    )
    assert seen.edges is not None
    assert seen.edges.pairs == (("map", "odom"), ("odom", "base_link"))
    assert (seen.edges.first_stamp, seen.edges.last_stamp) == (T0 + 2 * S, T0 + 4 * S)


def test_few_latched_messages_are_stored_whole_and_many_are_not() -> None:
    fixed = transform(T0, "base_link", "laser", (0.1, 0, 0))
    sent = [tf(T0 + n, fixed, topic="/tf_static") for n in range(MAX_STORED + 1)]
    few = topic_of(sent[:MAX_STORED])
    assert few.kept is not None
    assert [record.log_time for record in few.kept] == [T0 + n for n in range(MAX_STORED)]
    assert (
        topic_of([tf(T0 + n, fixed, topic="/tf_static") for n in range(MAX_STORED + 1)]).kept
        is None
    )
    assert topic_of([text(T0, "not latched")]).kept is None


def test_a_summary_schema_is_the_same_after_it_was_encoded() -> None:
    summary = digest_of([odom(T0, 0, 0), text(T0 + S, "a"), text(T0 + 2 * S, "b")]).summary
    assert SummarySchema.from_json(summary.schema.to_json()) == summary.schema
