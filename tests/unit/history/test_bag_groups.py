"""Bags that can hold duplicates of each other's messages are in one group."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from hypothesis import example, given, settings
from hypothesis import strategies as st

from ros2_memory.core.model import TimeWindow
from ros2_memory.core.spans import COPY_HORIZON_NS
from ros2_memory.history.bag_groups import groups_of
from ros2_memory.history.context import Call
from ros2_memory.history.view import View
from tests.support.bags import boolean, write_mcap
from tests.support.memories import memory_of

T0 = 1_700_000_000 * 10**9
STEP = 500_000_000


class Recorded(NamedTuple):
    """A recording of messages that are published at each step.

    Attributes:
        delay_ns: from a message's publication to its log time.
        cuts: the steps at which its bags begin, and the first step after the last bag.
    """

    delay_ns: int
    cuts: tuple[int, ...]

    def write(self, folder: Path) -> None:
        """Writes one MCAP file for each bag."""
        for number, (first, stop) in enumerate(zip(self.cuts, self.cuts[1:], strict=False)):
            messages = [
                replace(
                    boolean(T0 + step * STEP + self.delay_ns, step % 2 == 0),
                    publish_time=T0 + step * STEP,
                )
                for step in range(first, stop)
            ]
            write_mcap(folder / f"{folder.name}_{number}.mcap", messages)


RECORDINGS = st.builds(
    lambda delay, cuts: Recorded(delay, tuple(sorted(cuts))),
    st.sampled_from([0, STEP, 3 * STEP, COPY_HORIZON_NS]),
    st.sets(st.integers(0, 60), min_size=2, max_size=6),
)


@given(st.lists(RECORDINGS, min_size=2, max_size=3))
@example([Recorded(0, (0, 20, 40)), Recorded(2 * STEP, (20, 40))])
@settings(max_examples=25, deadline=None)
def test_duplicates_are_never_in_two_groups(recordings: list[Recorded]) -> None:
    with TemporaryDirectory() as folder:
        for name, recording in zip("abc", recordings, strict=False):
            recording.write(Path(folder) / name)
        view = View(memory_of(Path(folder)), Call())
        groups = groups_of(view.stream, "/bumper", TimeWindow.everything())
        for one, other in combinations(groups, 2):
            for early, late in ((x, y) for x in one.bags for y in other.bags):
                assert (
                    early.bag.recording == late.bag.recording
                    or late.first - early.last > COPY_HORIZON_NS
                )
        published = {step for each in recordings for step in range(each.cuts[0], each.cuts[-1])}
        assert sum(group.count() for group in groups) == len(published)
