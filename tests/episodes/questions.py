"""A hundred questions of ten kinds about a month, with answers reckoned from its list alone.

Nothing here looks at a message or asks the memory. Times of answers are Unix seconds.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache
from random import Random
from typing import Any

from tests.episodes.world import (
    DAY_S,
    DAYS,
    FIRST_DAY,
    NOW,
    TASK,
    US_PER_S,
    USED,
    Span,
    day_start,
    month,
)

LISTED = "listed on a day"
AFTER = "just after"
BEFORE = "just before"
DID = "did you"
USING = "which task used X"
EXACT = "exact time"
LONG = "how long"
AGO = "how many days ago"
OFTEN = "how often"
ENDS = "first and last"
KINDS = (LISTED, AFTER, BEFORE, DID, USING, EXACT, LONG, AGO, OFTEN, ENDS)
EACH = 10


@dataclass(frozen=True)
class Question:
    """A question in words, what it is about, and its true answer.

    Attributes:
        kind: one of `KINDS`.
        text: as a person would ask.
        answer: the truth.
        what: the text, or the thing, that is asked about; "" where none is.
        day: of the month, from 0; None where the whole month is meant.
        days: how many days from `day` on.
        nth: which one of several, from 0; -1 is the last.
        at: the minute that is asked about ("2026-11-09T11:50").
        topic: that says it.
    """

    kind: str
    text: str
    answer: Any
    what: str = ""
    day: int | None = None
    days: int = 1
    nth: int = -1
    at: str = ""
    topic: str = field(default=TASK)


def date_of(day: int) -> str:
    """Returns a day of the month, from 0, as ISO text."""
    return datetime.fromtimestamp(FIRST_DAY.timestamp() + day * DAY_S, UTC).date().isoformat()


@cache
def questions(seed: int) -> list[Question]:
    """Returns the questions about the month of a seed."""
    return _Asker(seed).all()


def unix(at: int) -> float:
    """Returns Unix seconds."""
    return at / US_PER_S


def has_begun(span: Span, day: int) -> bool:
    """Returns whether something began on a day, and not in the evening before."""
    return day_start(day) <= span.start < day_start(day + 1)


class _Asker:
    def __init__(self, seed: int) -> None:
        self._draw = Random(f"questions {seed}")
        self._tasks = month(seed).tasks
        self._actions = month(seed).actions

    def all(self) -> list[Question]:
        kinds = (
            self._listed, self._after, self._before, self._did, self._using,
            self._exact, self._long, self._ago, self._often, self._ends,
        )  # fmt: skip
        return [make(nth) for make in kinds for nth in range(EACH)]

    # What is so on some days

    def _during(self, day: int, days: int = 1, spans: Sequence[Span] = ()) -> list[Span]:
        """What held at some time of a day, or of some days."""
        start, stop = day_start(day), day_start(day + days)
        return [each for each in spans or self._tasks if each.start < stop and each.end > start]

    def _of(self, text: str, spans: Sequence[Span]) -> list[Span]:
        return [each for each in spans if each.text == text]

    def _some_task(self) -> str:
        names = [name for name in USED if len(self._of(name, self._tasks)) >= 2]
        return self._draw.choice(names)

    def _task_of_day(self) -> tuple[int, str]:
        day = self._draw.randrange(1, DAYS)
        return day, self._draw.choice(self._during(day)[3:-3]).text

    # Questions

    def _listed(self, nth: int) -> Question:
        each = DAYS // EACH
        day = nth * each + self._draw.randrange(each) if nth else 5  # a late task reaches into it
        texts = [each.text for each in self._during(day)]
        return Question(LISTED, f"What did you do on {date_of(day)}?", texts, day=day)

    def _after(self, nth: int) -> Question:
        return self._beside(nth, AFTER, 1)

    def _before(self, nth: int) -> Question:
        return self._beside(nth, BEFORE, -1)

    def _beside(self, nth: int, kind: str, step: int) -> Question:
        if nth % 2:
            day, name = self._task_of_day()
            mine = self._of(name, self._during(day))
            which, when = 0, f" the first time on {date_of(day)}"
            span = mine[0]
        else:
            day, name = None, self._some_task()
            which, when = -1, " the last time"
            span = self._of(name, self._tasks)[-1]
        place = self._tasks.index(span) + step
        beside = self._tasks[place] if 0 <= place < len(self._tasks) else None
        answer = None if beside is None else (beside.text, unix(beside.start))
        text = f"What did you do {kind} {name}{when}?"
        return Question(kind, text, answer, name, day, nth=which)

    def _did(self, nth: int) -> Question:
        wanted = nth % 2 == 0
        while True:
            day, name = self._draw.randrange(DAYS), self._some_task()
            if bool(self._of(name, self._during(day))) is wanted:
                return Question(
                    DID, f"Did you do this on {date_of(day)}: {name}?", wanted, name, day
                )

    def _using(self, nth: int) -> Question:
        things = sorted({thing for used in USED.values() for thing in used})
        pairs = ("Pot", "Potato", "Knife", "ButterKnife", "Towel", "PaperTowel", "Shelf")
        thing = pairs[nth] if nth < len(pairs) else self._draw.choice(things)
        if nth % 2:
            used = [each for each in self._actions if each.text.split()[-1] == thing][-1]
            [task] = [each for each in self._tasks if each.start <= used.start < each.end]
            text = f"During which task did you last use the {thing}?"
            return Question(USING, text, {task.text}, thing)
        by_day = self._users(thing)
        day = self._draw.choice(sorted(by_day))
        text = f"Which tasks used the {thing} on {date_of(day)}?"
        return Question(USING, text, by_day[day], thing, day)

    def _users(self, thing: str) -> dict[int, set[str]]:
        """The tasks that used a thing, by the days on which they did."""
        found: dict[int, set[str]] = {}
        for used in (each for each in self._actions if each.text.split()[-1] == thing):
            [task] = [each.text for each in self._tasks if each.start <= used.start < each.end]
            for at in (used.start, used.end - 1):
                day = (at - day_start(0)) // (DAY_S * US_PER_S)
                found.setdefault(day, set()).add(task)
        return found

    def _exact(self, nth: int) -> Question:
        if nth % 2:
            day = self._draw.randrange(DAYS)
            task = self._draw.choice(self._during(day)[5:-5])
            inside = self._draw.randrange(task.start, task.end) // US_PER_S
            at = datetime.fromtimestamp(inside - inside % 60, UTC)
            start = int(at.timestamp()) * US_PER_S
            stop = start + 60 * US_PER_S
            held = {each.text for each in self._tasks if each.start < stop and each.end > start}
            text = f"What were you doing on {date_of(day)} at {at:%H:%M}?"
            return Question(EXACT, text, held, day=day, at=f"{at:%Y-%m-%dT%H:%M}")
        mine: list[Span] = []
        while not mine:
            day, name = self._task_of_day()
            mine = [each for each in self._of(name, self._during(day)) if has_begun(each, day)]
        which = self._draw.randrange(len(mine))
        text = f"When exactly on {date_of(day)} did you begin {name} (time {which + 1})?"
        return Question(EXACT, text, unix(mine[which].start), name, day, nth=which)

    def _long(self, nth: int) -> Question:
        if nth % 2:
            day, name = self._task_of_day()
            start, stop = day_start(day), day_start(day + 1)
            mine = self._of(name, self._during(day))
            total = sum(min(each.end, stop) - max(each.start, start) for each in mine)
            text = f"How long in all did {name} take on {date_of(day)}?"
            return Question(LONG, text, total / US_PER_S, name, day, nth=0)
        name = self._some_task()
        last = self._of(name, self._tasks)[-1]
        text = f"When did you last do this, and how long did it take: {name}?"
        return Question(LONG, text, (unix(last.start), last.seconds), name)

    def _ago(self, _nth: int) -> Question:
        name = self._some_task()
        last = unix(self._of(name, self._tasks)[-1].start)
        days = (NOW.date() - datetime.fromtimestamp(last, UTC).date()).days
        return Question(AGO, f"How many days ago was the last time of {name}?", days, name)

    def _often(self, nth: int) -> Question:
        if nth % 3 == 2:
            thing = self._draw.choice(("Pot", "Knife", "Towel", "Shelf", "Egg"))
            what, spans, topic = f"pick up {thing}", self._actions, "/action"
        else:
            what, spans, topic = self._some_task(), self._tasks, TASK
        day, days = (None, DAYS) if nth % 2 else (self._draw.randrange(DAYS - 7), 7)
        among = spans if day is None else self._during(day, days, spans)
        when = "in all" if day is None else f"from {date_of(day)} on for a week"
        text = f"How often {when}: {what}?"
        return Question(OFTEN, text, len(self._of(what, among)), what, day, days, topic=topic)

    def _ends(self, nth: int) -> Question:
        if nth % 2:
            day, name = self._task_of_day()
            mine = self._of(name, self._during(day))
            when = f"on {date_of(day)}"
        else:
            day, name = None, self._some_task()
            mine, when = self._of(name, self._tasks), "ever"
        answer = (unix(mine[0].start), unix(mine[-1].end))
        text = f"When did you first begin and last end {when}: {name}?"
        return Question(ENDS, text, answer, name, day)
