"""What observers receive for each call."""

from ros2_memory.core.telemetry import Answered, Observer, Telemetry
from tests.unit.serving.test_dispatch import served, tool, value


class Failing(Observer):
    def answered(self, call: Answered) -> None:
        raise RuntimeError("the observer's own fault")


async def test_an_observer_that_fails_costs_no_answer() -> None:
    good = tool("good", lambda _: value(7))
    dispatcher = served(good, telemetry=Telemetry((Failing(),))).dispatcher
    assert not (await dispatcher.answer("good", {})).is_error
