"""What observers receive for each call."""

from ros2_memory.core.telemetry import Answered, Observer, Telemetry
from ros2_memory.serving.dispatch import Dispatcher
from tests.unit.serving.test_dispatch import served, tool, value


class Failing(Observer):
    def answered(self, call: Answered) -> None:
        raise RuntimeError("the observer's own fault")


def dispatcher(observer: Observer) -> Dispatcher:
    return served(tool("good", lambda _: value(7)), telemetry=Telemetry((observer,))).dispatcher


async def test_an_observer_that_fails_costs_no_answer() -> None:
    reply = await dispatcher(Failing()).answer("good", {})
    assert not reply.is_error
