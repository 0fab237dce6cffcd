import threading
from functools import partial
from unittest.mock import Mock

import pytest

from ros2_memory.core.errors import RecorderError
from ros2_memory.recorder.background import Background


def test_jobs_of_one_task_run_in_order_and_those_of_another_beside_them() -> None:
    background, may_end, done = Background(), threading.Event(), list[object]()
    background.add("slow", lambda: may_end.wait(30))
    for number in range(3):
        background.add("slow", partial(done.append, number))
    background.add("quick", may_end.set)
    background.wait(None)
    assert done == [0, 1, 2]
    assert not background.is_under_way("slow")


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (RecorderError("the disk is full"), "the disk is full"),
        (KeyError("x"), "a fault in this program (KeyError); see its log"),
    ],
    ids=["of the disk", "of this program"],
)
def test_a_fault_stays_until_the_task_succeeds(error: Exception, reason: str) -> None:
    background = Background()
    for job, faults in ((Mock(side_effect=error), {"task": reason}), (Mock(), {})):
        background.add("task", job)
        background.add("other", Mock())
        background.wait(None)
        assert background.faults() == faults


def test_what_does_not_end_is_waited_for_no_longer_than_the_patience() -> None:
    background, may_end = Background(), threading.Event()
    background.add("task", lambda: may_end.wait(30))
    background.wait(0.0)
    assert background.is_under_way("task")
    may_end.set()
    background.wait(None)
    assert not background.is_under_way("task")
