"""What the home robot did not perceive, by the world's truth: one blind time, one step."""

from pathlib import Path

import pytest

from tests.home.days import CLOCK_STEP_S, Scale
from tests.home.truth import truth_of
from tests.support.clocks import SettableClock
from tests.support.memories import asked, memory_of

pytestmark = pytest.mark.xdist_group("home")

S = 10**9
SCALE = Scale()


def test_the_blind_time_and_the_step_of_the_clock_are_all_that_is_reported(
    home: Path,
) -> None:
    _is_reported(home / "bags")


def test_they_are_reported_when_their_bags_are_deleted(home: Path, thinned_home: Path) -> None:
    whole = [path.relative_to(home) for path in home.rglob("*.mcap")]
    left = [path for path in whole if (thinned_home / path).exists()]
    newest = max(whole).parent
    assert left == [path for path in whole if path.parent == newest]
    _is_reported(thinned_home / "bags")


def _is_reported(bags: Path) -> None:
    truth = truth_of(SCALE)
    memory = memory_of(bags, clock=SettableClock(round(truth.recorded[-1][1] + 60) * S))
    reply = asked(memory, bags, "data_time_range")
    [silence], [step] = reply["silences"], reply["clock_steps"]
    start, stop = truth.blind
    blind = [(max(a, start), min(b, stop)) for a, b in truth.recorded if a < stop and b > start]
    assert silence["topic"] == "/vision/scene/scene_objects"
    assert silence["start"] == pytest.approx(blind[0][0], abs=2.0)
    assert silence["end"] == pytest.approx(blind[-1][1], abs=2.0)
    assert silence["silent_s"] == pytest.approx(sum(b - a for a, b in blind), abs=2.0)
    assert step["step_s"] == pytest.approx(CLOCK_STEP_S, abs=0.2)
    assert step["at"] == pytest.approx(truth.clock_step, abs=1.0)
