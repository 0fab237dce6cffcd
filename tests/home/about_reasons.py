"""Questions about reasons, and about how far the memory can be trusted."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Final

from tests.home import replies
from tests.home.days import CLOCK_STEP_S
from tests.home.judging import Answer, Number, Time, Words, YesNo
from tests.home.questions import Asked, Question, ask, in_words
from tests.home.world import VISION

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tests.home.replies import Row
    from tests.home.truth import Standstill

_REASONS: Final = {
    "blocked": ("block", "abort", "no way", "no path", "failed to create plan"),
    "bump": ("bump",),
    "hot": ("overheat", "motor"),
    "low battery": ("battery", "cancel"),
    "pause": (),
}
"""Why the robot stopped, and the words of the answer; for the pause nothing was recorded."""
_OTHERS: Final = ("abort", "bumper", "overheat", "battery", "cancel")


def questions(asked: Asked) -> list[Question]:
    """Returns them."""
    return [*_why(asked), *_blind(asked), *_trust(asked)]


def _why(asked: Asked) -> list[Question]:
    found = []
    for number, (reason, words) in enumerate(_REASONS.items(), 1):
        stood = [each for each in asked.truth.standstills if each.reason == reason][-1]
        found.append(_stopped(number, stood, words))
    return found


def _stopped(number: int, stood: Standstill, words: tuple[str, ...]) -> Question:
    at = round(stood.start + 1.0)
    truth = Words(words, () if words else _OTHERS, or_none=True)

    def read(found: Sequence[Row]) -> Answer:
        # What came before, wherever the reply lists it; an empty list is an answer.
        before = found[0].get("before")
        if before is None:
            events = replies.rows(found[0], "events", "standstills")
            before = [each["before"] for each in events if each.get("before")]
        return {"reason": json.dumps(before)}

    return Question(
        f"why-{number}",
        "why",
        f"Why did you stop at {in_words(at)} in the {stood.room}?",
        {"reason": truth},
        ask("recap", around=at),
        read,
    )


def _blind(asked: Asked) -> list[Question]:
    start, stop = asked.truth.blind
    # Silence is known between messages of a recorded time: as far as that reaches.
    recorded = [(a, b) for a, b in asked.truth.recorded if a < stop and b > start]
    first, last = max(start, recorded[0][0]), min(stop, recorded[-1][1])

    def silences(found: Sequence[Row]) -> list[Row]:
        return replies.rows(found[0], "silences")

    def of_today(found: Sequence[Row]) -> Answer:
        (silence,) = [
            each
            for each in silences(found)
            if each["topic"] == VISION.topic
            and replies.time(each, "end", "to") > asked.day(asked.last)
        ]
        return {
            "from": replies.time(silence, "start", "from"),
            "to": replies.time(silence, "end", "to"),
        }

    def of_yesterday(found: Sequence[Row]) -> Answer:
        midnight = asked.day(asked.last)
        return {
            "blind": any(
                each["topic"] == VISION.topic and replies.time(each, "start", "from") < midnight
                for each in silences(found)
            )
        }

    return [
        Question(
            "blind-today",
            "reliability",
            "Were you blind today, and from when to when?",
            {
                "from": Time(min(start, first) - 150.0, first + 10.0),
                "to": Time(last - 10.0, max(stop, last) + 150.0)
                if not asked.world.scale.short
                else Time(last - 10.0, max(stop, last) + 3600.0),
            },
            ask("data_time_range"),
            of_today,
        ),
        Question(
            "blind-yesterday",
            "reliability",
            "Did your detector fall silent on any day before today?",
            {"blind": YesNo(value=False)},
            ask("data_time_range"),
            of_yesterday,
        ),
    ]


def _trust(asked: Asked) -> list[Question]:
    truth = asked.truth
    gap_from = max(b for _, b in truth.recorded if b <= truth.outage[0] + 1.0)
    gap_to = min(a for a, _ in truth.recorded if a >= truth.outage[1] - 1.0)
    middle = sum(truth.outage) / 2

    def outage(found: Sequence[Row]) -> Answer:
        (gap,) = [
            each
            for each in replies.rows(found[0], "gaps")
            if replies.time(each, "start") <= middle <= replies.time(each, "end")
        ]
        return {"from": replies.time(gap, "start"), "to": replies.time(gap, "end")}

    def step(found: Sequence[Row]) -> Answer:
        (one,) = replies.rows(found[0], "clock_steps")
        return {
            "seconds": replies.number(one, "step_s", "seconds", "by_s"),
            "at": replies.time(one, "at", "timestamp", "start"),
        }

    return [
        Question(
            "outage",
            "reliability",
            f"What is missing around {in_words(middle)}: from when to when?",
            {
                "from": Time(gap_from - 3.0, gap_from + 3.0),
                "to": Time(gap_to - 3.0, gap_to + 3.0),
            },
            ask("data_time_range"),
            outage,
        ),
        Question(
            "clock",
            "reliability",
            "Was your clock ever set, when, and by how many seconds?",
            {
                "seconds": Number(CLOCK_STEP_S, 1.0),
                "at": Time(truth.clock_step - 10.0, truth.clock_step + CLOCK_STEP_S + 10.0),
            },
            ask("data_time_range"),
            step,
        ),
        Question(
            "crash",
            "reliability",
            "How many recordings were left open by a crash?",
            {"count": Number(1)},
            ask("memory_status"),
            lambda found: {"count": replies.number(found[0], "incomplete")},
        ),
        Question(
            "since-when",
            "temporal",
            "How far back do you remember?",
            {"earliest": Time(truth.recorded[0][0] - 2.0, truth.recorded[0][0] + 2.0)},
            ask("data_time_range"),
            lambda found: {"earliest": replies.time(found[0], "earliest")},
        ),
    ]
