"""What a digest says of a bag is what reading the bag says."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ros2_memory.catalogue.digest import Digester
from ros2_memory.core.bag_summary import SummarySchema
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import McapLayout, Msg, odom, text, write_mcap
from tests.support.fakes import FakeReader

if TYPE_CHECKING:
    from ros2_memory.catalogue.digest import Digest

S = 10**9
T0 = 1_700_000_000 * S
BAG = Path("rec/rec_0.mcap")


def digest_of(messages: list[Msg]) -> Digest:
    reader = FakeReader()
    reader.add(BAG, messages)
    return Digester(reader).digest(BAG)


def test_a_message_that_may_be_of_another_recording_is_known(tmp_path: Path) -> None:
    latched = McapLayout(latched=frozenset({"/map_name"}))
    late = [
        replace(text(T0 + 5 * S, "late"), topic=topic, publish_time=T0)
        for topic in ("/map_name", "/chatter")
    ]
    digest = Digester(McapReader()).digest(write_mcap(tmp_path / "a.mcap", late, latched))
    assert {each.topic: each.relatched for each in digest.topics} == {
        "/map_name": True,
        "/chatter": False,
    }


def test_a_summary_schema_is_the_same_after_it_was_encoded() -> None:
    summary = digest_of([odom(T0, 0, 0), text(T0 + S, "a"), text(T0 + 2 * S, "b")]).summary
    assert SummarySchema.from_json(summary.schema.to_json()) == summary.schema
