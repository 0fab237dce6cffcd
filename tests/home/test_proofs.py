"""`ros2-memory prove`: over the messages that an answer rests on, the answer is the same."""

from pathlib import Path
from unittest.mock import patch

import pytest

from ros2_memory.history.context import QuerySettings
from ros2_memory.things import known
from ros2_memory.tools.build import build_tools
from tests.support.examples import LONG
from tests.support.program import Program, exits

__all__ = ["exits"]

pytestmark = pytest.mark.xdist_group("home")

FROM, UNTIL = ("", "") if LONG else ("T10:20", "T10:50")
"""A long run asks about whole days, another one about half an hour of each."""
DAY = f"start=2026-03-02{FROM} end=2026-03-02{UNTIL}"
OTHER_DAY = f"with_start=2026-03-03{FROM} with_end=2026-03-03{UNTIL}"
SEEN = "topic=*/scene_objects condition_type=contains value=mug"
QUESTIONS = {
    "get_topic_at_time": "topic=/battery_state timestamp=2026-03-02T10:35 tolerance_s=5",
    "get_topic_seconds_ago": "topic=/is_docked seconds_ago=20 tolerance_s=2",
    "get_topic_in_range": f"topic=/bumper {DAY} max_samples=5",
    "get_topic_in_last": "topic=/battery_state seconds=10m fields=percentage",
    "get_position_at": 'timestamps=["2026-03-02T10:35", "2026-03-03T10:26"] tolerance_s=2',
    "get_position_seconds_ago": "seconds_ago=60",
    "get_velocity_at": "timestamp=2026-03-02T10:35 tolerance_s=2",
    "get_velocity_seconds_ago": "seconds_ago=60",
    "get_transform_at": "parent=map child=base_link timestamp=2026-03-02T10:35",
    "get_transform_seconds_ago": "parent=odom child=base_link seconds_ago=60",
    "find_last_match": SEEN,
    "get_value_when": f"value_topic=/odom condition_{SEEN}",
    "trajectory_summary": f'{DAY} farthest_from={{"x": 0, "y": 0}}',
    "recent_trajectory_summary": "seconds=10m where=kitchen",
    "find_matches": f"{SEEN} limit=20",
    "find_things": f'near={{"label": "table", "radius_m": 2}} {DAY}',
    "compare": f"{DAY} {OTHER_DAY}",
    "recap": DAY,
    "visits": f"where=kitchen {DAY}",
}
"""What a tool is asked; the others need no argument."""
TOOLS = [tool.name for tool in build_tools(QuerySettings())]
LIKE_OTHERS = (
    *("list_recorded_topics", "data_time_range", "list_frames"),
    *("get_topic_in_last", "recent_trajectory_summary"),
    *(tool for tool in TOOLS if tool.endswith("_seconds_ago")),
)
"""Their proof is all messages, as that of `memory_status` is, or they ask as others do."""


@pytest.mark.usefixtures("in_utc")
@pytest.mark.parametrize("tool", [each for each in TOOLS if LONG or each not in LIKE_OTHERS])
@patch.object(known, "READING_S", 60.0)
@patch.object(known, "_ESTIMATING_S", 60.0)
def test_the_same_question_over_the_proof_has_the_same_answer(
    home: Path, tmp_path: Path, exits: Program, tool: str
) -> None:
    # However busy the machine is: bags that there was no time for are in the next answer.
    settings = [f"data.{kind}_file={home / kind}.yaml" for kind in ("places", "labels")]
    question, proof = f"{tool} {QUESTIONS.get(tool, '')}".strip(), tmp_path / "proof"
    proved = exits(0, "prove", question, "-o", proof, "--json", home / "bags", *settings)
    assert proved.json["same"]
