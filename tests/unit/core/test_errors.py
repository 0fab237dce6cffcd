from __future__ import annotations

from ros2_memory.core.errors import (
    NoDataReason,
)


def test_the_reasons_for_no_data_are_those_that_a_client_knows() -> None:
    assert {str(reason) for reason in NoDataReason} == {
        "topic_not_recorded",
        "outside_range",
        "gap",
        "deleted",
        "between_messages",
        "not_closed_yet",
        "undecodable",
        "frame_unknown",
        "frames_not_connected",
        "empty_memory",
        "mixed",
    }
