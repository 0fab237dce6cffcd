"""What a robot did in a month: 1,500 tasks and 20,000 actions, which two topics say in texts.

Only in a long run is it a whole month, else ten days, which are more than a reply holds, too.
A text holds until the next one. An empty text ends it, or another text takes its place; some are
said again while they hold. A night is not recorded, unless a task goes on past midnight.
"""

from datetime import UTC, datetime, timedelta
from functools import cache
from random import Random
from typing import NamedTuple

from tests.support.examples import LONG

TASK = "/task"
ACTION = "/action"
DAYS = 30 if LONG else 10
TASKS_A_DAY = 50
ACTIONS = DAYS * 2000 // 3
FIRST_DAY = datetime(2026, 11, 1, tzinfo=UTC)
NOW = FIRST_DAY + timedelta(days=DAYS, hours=9)
"""When questions are asked."""
DAY_S = 86_400
US_PER_S = 1_000_000

_BEGIN_S = 6 * 3600 + 1800
_END_S = 23 * 3600
_LATE = (4, 16)
"""Days whose last task ends after midnight."""
_REPEAT_S = 300.0

USED = {
    "making coffee": ("CoffeeMachine", "Mug", "Spoon"),
    "making coffee cake": ("Bowl", "Oven", "Spoon", "Egg"),
    "making tea": ("Kettle", "Mug", "TeaBag"),
    "boiling an egg": ("Egg", "Pot", "Stove"),
    "washing the pot": ("Pot", "Sink", "Sponge"),
    "washing the potatoes": ("Potato", "Sink", "Bowl"),
    "peeling potatoes": ("Potato", "Knife", "Bowl"),
    "buttering toast": ("ButterKnife", "Toaster", "Plate"),
    "slicing bread": ("Knife", "Bread", "Plate"),
    "setting the table": ("Plate", "Fork", "ButterKnife", "Cup"),
    "clearing the table": ("Plate", "Cup", "Dishwasher"),
    "watering the plant": ("WateringCan", "Plant", "Sink"),
    "watering the plants outside": ("GardenHose", "Door"),
    "feeding the cat": ("CatFood", "Bowl"),
    "looking for the keys": ("Drawer", "KeyHook"),
    "folding towels": ("Towel", "Shelf"),
    "folding paper towels": ("PaperTowel", "Drawer"),
    "taking out the trash": ("TrashBag", "Door"),
    "dusting the shelf": ("Shelf", "Duster"),
    "dusting the bookshelf": ("BookShelf", "Duster", "Book"),
    "charging": ("Dock",),
    "greeting a visitor": ("Door",),
    "vacuuming the hall": ("Vacuum", "Rug"),
    "tidying the desk": ("Pen", "Book", "Drawer"),
}
"""Each task, and what its actions use."""
_VERBS = ("walk to", "look at", "pick up", "put down", "open", "close", "clean")


class Span(NamedTuple):
    """A text that held from one moment to another: microseconds since the epoch."""

    text: str
    start: int
    end: int

    @property
    def seconds(self) -> float:
        """How long it held."""
        return (self.end - self.start) / US_PER_S


class Said(NamedTuple):
    """A message: when, on which topic, and its text."""

    at: int
    topic: str
    text: str


class Month(NamedTuple):
    """All that was done, in order, and the messages that say so."""

    tasks: tuple[Span, ...]
    actions: tuple[Span, ...]
    messages: tuple[Said, ...]


def day_start(day: int) -> int:
    """Returns the midnight at which a day begins (microseconds)."""
    return (int(FIRST_DAY.timestamp()) + day * DAY_S) * US_PER_S


@cache
def month(seed: int) -> Month:
    """Returns the month of a seed; the same one however often it is asked for."""
    draw = Random(seed)
    counts = _counts(draw)
    tasks: list[Span] = []
    actions: list[Span] = []
    for day in range(DAYS):
        of_day = counts[day * TASKS_A_DAY : (day + 1) * TASKS_A_DAY]
        spans = _tasks(draw, day, of_day)
        tasks += spans
        for span, count in zip(spans, of_day, strict=True):
            actions += _actions(draw, span, count)
    messages = [*_messages(draw, TASK, tasks), *_messages(draw, ACTION, actions)]
    return Month(tuple(tasks), tuple(actions), tuple(sorted(messages)))


def _counts(draw: Random) -> list[int]:
    """Returns how many actions each task has."""
    counts = [draw.randint(9, 17) for _ in range(DAYS * TASKS_A_DAY)]
    while (missing := ACTIONS - sum(counts)) != 0:
        counts[draw.randrange(len(counts))] += 1 if missing > 0 else -1
    return counts


def _tasks(draw: Random, day: int, counts: list[int]) -> list[Span]:
    """Returns the tasks of a day: each as long as it has actions, some right after another."""
    names = _names(draw, len(counts))
    lengths = [count * draw.uniform(20.0, 60.0) for count in counts]
    pauses = [0.0 if draw.random() < 0.2 else draw.uniform(10.0, 900.0) for _ in counts]
    for nth in range(1, len(names)):
        if names[nth] == names[nth - 1] and pauses[nth - 1] == 0.0:
            pauses[nth - 1] = 30.0
    stretch = (_END_S - _BEGIN_S) / (sum(lengths) + sum(pauses))
    spans: list[Span] = []
    at = day_start(day) + _BEGIN_S * US_PER_S
    for name, length, pause in zip(names, lengths, pauses, strict=True):
        end = at + round(length * stretch * US_PER_S)
        spans.append(Span(name, at, end))
        at = end + round(pause * stretch * US_PER_S)
    if day in _LATE:
        last = spans[-1]
        start = max(last.start, day_start(day) + (DAY_S - 900) * US_PER_S)
        spans[-1] = Span(last.text, start, day_start(day + 1) + 1200 * US_PER_S)
    return spans


def _names(draw: Random, count: int) -> list[str]:
    # Some tasks are seldom: there are days without them.
    weights = [1.0 / (1 + nth % 8) for nth in range(len(USED))]
    return draw.choices([*USED], weights, k=count)


def _actions(draw: Random, task: Span, count: int) -> list[Span]:
    """Returns the actions of a task: some right after another, some after a pause."""
    edges = sorted(draw.sample(range(task.start // 1000, task.end // 1000), count - 1))
    starts = [task.start, *(edge * 1000 for edge in edges)]
    found: list[Span] = []
    for start, stop in zip(starts, [*starts[1:], task.end], strict=True):
        text = f"{draw.choice(_VERBS)} {draw.choice(USED[task.text])}"
        same = bool(found) and found[-1].text == text
        if same:
            # Of two alike that follow each other at once nobody could tell that they are two.
            last = found[-1]
            found[-1] = Span(text, last.start, min(last.end, (last.start + start) // 2))
        pause = draw.random() < 0.5
        found.append(Span(text, start, start + (stop - start) * 3 // 4 if pause else stop))
    return found


def _messages(draw: Random, topic: str, spans: list[Span]) -> list[Said]:
    said: list[Said] = []
    for nth, span in enumerate(spans):
        said.append(Said(span.start, topic, span.text))
        again = span.start + round(draw.uniform(0.5, 1.5) * _REPEAT_S * US_PER_S)
        while again < span.end:
            said.append(Said(again, topic, span.text))
            again += round(_REPEAT_S * US_PER_S)
        follows = nth + 1 < len(spans) and spans[nth + 1].start <= span.end
        if not follows:
            said.append(Said(span.end, topic, ""))
    return said
