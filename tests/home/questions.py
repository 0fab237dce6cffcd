"""Sixty questions of an owner: of things, places and habits, of reasons, and of trust."""

from collections.abc import Iterator

from tests.home.about_places import about_places
from tests.home.about_things import about_things
from tests.home.asking import Asked, Question, Row, Words, between, in_words, near
from tests.home.days import CLOCK_STEP_S, Scale
from tests.home.truth import truth_of
from tests.home.world import VISION, world_of

_REASONS = {
    "blocked": ("block", "abort", "no way", "no path", "failed to create plan"),
    "bump": ("bump",),
    "hot": ("overheat", "motor"),
    "low battery": ("battery", "cancel"),
    "pause": (),
}
"""Why the robot stopped, and the words of the answer; for the pause nothing was recorded."""
_OTHERS = ("abort", "bumper", "overheat", "battery", "cancel")


def questions(scale: Scale) -> list[Question]:
    """Returns the questions about the world of a scale, which has two days or more."""
    asked = Asked(world_of(scale), truth_of(scale))
    return [*about_things(asked), *about_places(asked), *_why(asked), *_trust(asked)]


def _why(asked: Asked) -> Iterator[Question]:
    for reason, words in _REASONS.items():
        stood = [each for each in asked.truth.standstills if each.reason == reason][-1]
        at = round(stood.start + 1.0)
        yield Question(
            f"Why did you stop at {in_words(at)} in the {stood.room}?",
            "recap",
            {"around": at},
            # What came before; an empty list is an answer.
            [(Words(words, () if words else _OTHERS), "before")],
        )


def _trust(asked: Asked) -> Iterator[Question]:
    truth, midnight = asked.truth, asked.day(asked.last)
    start, stop = truth.blind
    # Silence is known between messages of a recorded time: as far as that reaches.
    recorded = [(a, b) for a, b in truth.recorded if a < stop and b > start]
    first, last = max(start, recorded[0][0]), min(stop, recorded[-1][1])
    silent_s = sum(min(b, stop) - max(a, start) for a, b in recorded)
    gap_from = max(b for _, b in truth.recorded if b <= truth.outage[0] + 1.0)
    gap_to = min(a for a, _ in truth.recorded if a >= truth.outage[1] - 1.0)
    middle = sum(truth.outage) / 2

    def blind(reply: Row) -> list[Row]:
        return [silence for silence in reply["silences"] if silence["topic"] == VISION.topic]

    def today(reply: Row) -> Row:
        (silence,) = [silence for silence in blind(reply) if silence["end"] > midnight]
        return silence

    def outage(reply: Row) -> Row:
        gap: Row
        (gap,) = [gap for gap in reply["gaps"] if gap["start"] <= middle <= gap["end"]]
        return gap

    def step(reply: Row) -> Row:
        one: Row
        (one,) = reply["clock_steps"]
        return one

    until = max(stop, last) + (3600.0 if asked.world.scale.short else 150.0)
    for text, tool, *checks in (
        (
            "Were you blind today, and from when to when?",
            "data_time_range",
            (between(min(start, first) - 150.0, first + 10.0), lambda reply: today(reply)["start"]),
            (between(last - 10.0, until), lambda reply: today(reply)["end"]),
            (near(silent_s, 2.0), lambda reply: today(reply)["silent_s"]),
            (1, lambda reply: len(reply["silences"])),
        ),
        (
            "Did your detector fall silent on any day before today?",
            "data_time_range",
            ([], lambda reply: [each for each in blind(reply) if each["start"] < midnight]),
        ),
        (
            f"What is missing around {in_words(middle)}: from when to when?",
            "data_time_range",
            (near(gap_from, 3.0), lambda reply: outage(reply)["start"]),
            (near(gap_to, 3.0), lambda reply: outage(reply)["end"]),
        ),
        (
            "Was your clock ever set, when, and by how many seconds?",
            "data_time_range",
            (near(CLOCK_STEP_S, 0.2), lambda reply: step(reply)["step_s"]),
            (
                between(truth.clock_step - 10.0, truth.clock_step + CLOCK_STEP_S + 10.0),
                lambda reply: step(reply)["at"],
            ),
        ),
        (
            "How many recordings were left open by a crash?",
            "memory_status",
            (1, "incomplete"),
        ),
        (
            "How far back do you remember?",
            "data_time_range",
            (near(truth.recorded[0][0], 2.0), "earliest"),
        ),
    ):
        yield Question(text, tool, {}, checks)
