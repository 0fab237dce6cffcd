"""Rules beside the real `ros2 bag record`: through rotations, and a kill of everything."""

import os
import re
import time
from datetime import datetime
from pathlib import Path
from typing import Final

import pytest

from ros2_memory.bag_dir.moment_file import StoredMoment, stored_moments_in
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.live_recorder import Machine, bag_files
from tests.support.processes import until
from tests.support.ros_processes import publishing_robot

SPLIT_S: Final = 2
ISO_TIME: Final = r"\d{4}-\d\d-\d\dT\S+?[+-]\d\d:\d\d"
RULES = """
rules:
  bumper: {topic: /bumper, condition_type: equals, value: true, before_s: 3, after_s: 2}
  turned: {topic: /odom, condition_type: above, value: 0.5, field: position.y, for_s: 1}
  restarted: {kind: recorder_restart, before_s: 1, after_s: 1}
"""


@pytest.mark.skipif(
    os.environ.get("EPISODIC_LONG") != "1", reason="waits for minutes of driving: EPISODIC_LONG=1"
)
def test_rules_fire_once_through_rotations_and_a_kill(site: Machine, tmp_path: Path) -> None:
    rules = tmp_path / "triggers.yaml"
    rules.write_text(RULES)
    given = (
        f"recording.keep_when={rules}",
        f"recording.split_duration_s={SPLIT_S}",
        "recording.session_duration_s=7",
    )
    # It bumps once, when it is told: by its own clock it might do so unrecorded.
    drive = ("--hz", "10", "--bump", "inf")
    with publishing_robot(site.env, tmp_path / "truth.json", *drive) as robot:
        recorder = site.record("robot", *given)
        recorder.wait_for("trigger_fired", rule="turned")
        recorder.wait_for("rotated", 2)
        killed_s = time.time()
        recorder.kill(with_children=True)
        recorder = site.record("robot", *given)
        recorder.wait_for("trigger_fired", rule="restarted")
        recorder.wait_for_subscriptions()
        robot.bump()
        recorder.wait_for("trigger_fired", rule="bumper")
        recorder.wait_for("rotated", 1)

        def complete() -> list[StoredMoment] | None:
            found = [*stored_moments_in(recorder.bag_dir).readable.values()]
            waits = len(found) < 3 or any(each.moment.pending for each in found)
            return None if waits else found

        moments = until(complete)
        recorder.stop()
    [bumper] = [each for each in moments if each.moment.rule == "bumper"]
    assert bumper.moment.matches == 1
    # How long the robot goes unrecorded after the kill is the machine's: the bump may be near it.
    bags = [McapReader().summarize(each) for each in bag_files(recorder.bag_dir)]
    starts_s = [bag.start / 1e9 for bag in bags if not bag.empty]
    again_s = min(start for start in starts_s if start > killed_s)
    for sentence in bumper.moment.missing:
        first, last = (
            datetime.fromisoformat(each).timestamp() for each in re.findall(ISO_TIME, sentence)
        )
        assert killed_s - SPLIT_S - 1 <= first
        assert last <= again_s + 1
    fired = [e["rule"] for each in site.recorders for e in each.events("trigger_fired")]
    # y is above 0.5 once in a circle, and seen anew by a recorder that was off meanwhile.
    assert sorted({*fired}) == ["bumper", "restarted", "turned"]
    assert (fired.count("bumper"), fired.count("restarted")) == (1, 1)
