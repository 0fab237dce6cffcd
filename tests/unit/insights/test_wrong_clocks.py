"""Bags that a wrong clock dated beside others: what is asked about now is answered without them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from tests.support.bags import detections, odom, text, write_mcap
from tests.support.clocks import SettableClock
from tests.support.memories import asked, memory_of

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

S = 10**9
NOW_S = 1_784_000_000
AHEAD_S = NOW_S + 10 * 365 * 86_400


def write_bag(bag_dir: Path, number: int, begin_s: int, label: str, *, speech: bool = True) -> None:
    """A minute in which the robot drives 6 m from x = 20 m times the number, and sees a thing."""
    messages = []
    for second in range(60):
        at = (begin_s + second) * S
        messages += [odom(at, 20.0 * number + 0.1 * second, 0.0), detections(at, [label])]
        messages += [text(at, f"{label} at home", "/said")] if speech else []
    write_mcap(bag_dir / f"rec_{number}.mcap", messages)


@pytest.fixture
def ask(tmp_path: Path, request: pytest.FixtureRequest) -> Callable[..., Any]:
    """Asks about two bags of today, and one of the time that the test is parametrized with."""
    write_bag(tmp_path, 0, NOW_S - 3000, "cup")
    write_bag(tmp_path, 1, NOW_S - 60, "cup", speech=False)
    write_bag(tmp_path, 2, request.param, "dog")
    memory = memory_of(tmp_path, clock=SettableClock(NOW_S * S))

    def ask(tool: str, **arguments: object) -> Any:
        return asked(memory, tmp_path, tool, **arguments)

    return ask


@pytest.mark.parametrize("ask", [AHEAD_S], indirect=True)
def test_find_things_has_what_a_clock_ahead_dated_only_for_a_window_that_reaches_there(
    ask: Callable[..., Any],
) -> None:
    reply = ask("find_things")
    assert "cup" in str(reply)
    assert "dog" not in str(reply)
    assert "dated by a wrong clock" in str(reply["notes"])
    for window in ({"start": AHEAD_S}, {"end": AHEAD_S + 100}):
        assert "dog" in str(ask("find_things", **window))
