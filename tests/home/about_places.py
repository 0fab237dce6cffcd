"""Questions about where the robot was, when, how long and how often, and what it usually does."""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from datetime import datetime
from itertools import chain

import numpy as np

from tests.home.asking import Asked, Question, Series, Words, bins, in_words, near
from tests.home.flat import HALL, ROOMS, room_at
from tests.home.messages import BATTERY, BUMPER, DOCKED
from tests.home.things import DAY
from tests.home.truth import Span
from tests.support.memories import clause

_OFF_DOCK = clause(DOCKED.topic, "equals", False)
_BUMPED = clause(BUMPER.topic, "equals", True)


def about_places(asked: Asked) -> Iterator[Question]:
    """Yields them."""
    return chain(
        _visited(asked), _was_at(asked), _off_the_dock(asked), _each_day(asked), _bumped(asked),
        _driven(asked),
    )  # fmt: skip


def _within(spans: Sequence[Span], start: float, end: float) -> list[Span]:
    return [(max(a, start), min(b, end)) for a, b in spans if a < end and b > start]


def _visited(asked: Asked) -> Iterator[Question]:
    truth, last = asked.truth, asked.last
    today = asked.day(last), asked.day(last + 1)
    day = asked.day(last - 1), asked.day(max(last, 1))

    def minutes_in(name: str, window: Span) -> float:
        spans = _within(truth.visits[name], *window)
        return sum(truth.elapsed(*span) for span in spans) / 60

    door = truth.visits["front door"][-1]
    yield Question(
        "When were you last at the front door, and how long?",
        "visits",
        {"where": "front door", "limit": 1},
        [
            (near(door[0], 5.0), "visits.0.arrived"),
            (near(truth.elapsed(*door), 5.0), "visits.0.duration_s"),
        ],
    )
    minutes = minutes_in("kitchen", today)
    yield Question(
        "How many minutes were you in the kitchen today?",
        "visits",
        {"where": "kitchen", "limit": 1, **asked.today},
        [(near(minutes, 0.2 + 0.03 * minutes), "minutes")],
    )
    yield Question(
        "How many times did you go into the bedroom today?",
        "visits",
        {"where": "bedroom", "limit": 1, **asked.today},
        [(len(_within(truth.visits["bedroom"], *today)), "total")],
    )
    spent = {name: minutes_in(name, day) for name in truth.visits}
    yield Question(
        "How many minutes were you in each place yesterday?",
        "visits",
        asked.days(last - 1, max(last, 1)),
        [
            (
                Series({name: near(each, 0.3 + 0.03 * each) for name, each in spent.items()}),
                lambda reply: {place["place"]: place["minutes"] for place in reply["places"]},
            )
        ],
    )
    yield Question(
        "How often have you driven into the dining corner?",
        "visits",
        {"where": "dining corner"},
        [(len(truth.visits["dining corner"]), "total")],
    )


def _was_at(asked: Asked) -> Iterator[Question]:
    planned = [each for each in asked.truth.standstills if not each.reason]
    stood = planned[len(planned) // 3]
    moment = round(stood.start + 2.0)
    yield Question(
        f"Where in the map were you at {in_words(moment)}, and in which room?",
        "get_position_at",
        {"timestamp": moment, "frame_id": "map"},
        [
            (near(stood.x, 0.2), "x"),
            (near(stood.y, 0.2), "y"),
            (Words((stood.room,)), lambda reply: [reply["in"], reply.get("also_in")]),
        ],
    )
    three = [round(each.start + 2.0) for each in planned[-4:-1]]
    yield Question(
        f"What was your x in the map at {', '.join(map(in_words, three))}?",
        "get_position_at",
        {"timestamps": three, "frame_id": "map"},
        [(near(each.x, 0.2), f"results.{nth}.x") for nth, each in enumerate(planned[-4:-1])],
    )


def _off_the_dock(asked: Asked) -> Iterator[Question]:
    outing = asked.world.life.outings[-1]
    yield Question(
        "When did you last leave the dock, and how long were you out?",
        "find_matches",
        {**_OFF_DOCK, "limit": 1},
        [
            (
                near(asked.world.clock_at(outing.start), 3.0),
                "sightings.0.first_seen",
            ),
            (near(outing.stop - outing.start, 5.0), "sightings.0.duration_s"),
        ],
    )
    days = asked.truth.days
    for text, expected, column in (
        (
            "At what time do you usually leave the dock for the first time in a day?",
            {day.date: near(day.departures[0], 3.0) for day in days},
            "first",
        ),
        (
            "How many times did you leave the dock on each day?",
            {day.date: len(day.departures) for day in days},
            "count",
        ),
        (
            "How long were you off the dock on each day?",
            {day.date: _seconds_out(asked, nth * DAY) for nth, day in enumerate(days)},
            "seconds",
        ),
    ):
        arguments = {**_OFF_DOCK, **asked.all_days, "by": "day"}
        yield Question(text, "find_matches", arguments, [(Series(expected), bins(column))])


def _seconds_out(asked: Asked, start: float) -> object:
    seconds = sum(
        b - a
        for outing in asked.world.life.outings
        if start <= outing.start < start + DAY
        for a, b in _within(asked.world.on, outing.start, outing.stop)
    )
    # Of the split that the power cut ended a part is lost.
    return near(seconds, 0.03 * seconds + 0.6 * asked.world.scale.split_s)


def _lowest_battery(asked: Asked, lowest: float, start: float) -> object:
    cut, split_s = asked.world.life.power_cut[0], asked.world.scale.split_s
    within = 0.02
    if start <= cut < start + DAY:
        # Of the split that the power cut ended a part is lost.
        before, after = asked.world.battery(np.array([cut - split_s, cut])).tolist()
        within += abs(before - after)
    return near(lowest, within)


def _each_day(asked: Asked) -> Iterator[Question]:
    days, split_s = asked.truth.days, asked.world.scale.split_s
    weekdays: dict[str, float] = defaultdict(float)
    for day in days:
        weekdays[f"{datetime.fromisoformat(day.date):%A}"] += day.driven_m
    for text, expected, by, column in (
        (
            "How many metres did you drive on each day?",
            {day.date: _metres(day.driven_m) for day in days},
            "day",
            "metres",
        ),
        (
            "How many metres do you drive on each weekday?",
            {name: _metres(metres) for name, metres in weekdays.items()},
            "weekday",
            "metres",
        ),
        (
            "How many seconds of each day do you remember at all?",
            {day.date: near(day.recorded_s, 0.02 * day.recorded_s + split_s) for day in days},
            "day",
            "recorded_s",
        ),
    ):
        arguments = {**asked.all_days, "by": by, "max_waypoints": 0}
        yield Question(text, "trajectory_summary", arguments, [(Series(expected), bins(column))])
    lowest = {
        day.date: _lowest_battery(asked, day.lowest_battery, nth * DAY)
        for nth, day in enumerate(days)
    }
    yield Question(
        "How low was your battery on each day?",
        "get_topic_in_range",
        {"topic": BATTERY.topic, **asked.all_days, "by": "day", "fields": ["percentage"]},
        [(Series(lowest), bins("min"))],
    )
    on = np.concatenate([np.arange(a, b, 1.0) for a, b in asked.world.on])
    began = asked.world.clock_at(float(on[asked.world.battery(on) < 0.2][0]))
    yield Question(
        "When did your battery fall below 20 %?",
        "find_matches",
        clause(BATTERY.topic, "below", 0.2, field="percentage", oldest_first=True, limit=1),
        [(near(began, 12.0), "sightings.0.first_seen")],
    )


def _metres(metres: float) -> object:
    return near(metres, 2.0 + 0.05 * metres)


def _bumped(asked: Asked) -> Iterator[Question]:
    bumps = asked.truth.bumps
    yield Question(
        "When and in which room did you last bump into something?",
        "find_matches",
        {**_BUMPED, "limit": 1},
        [
            (near(bumps[-1], 2.0), "sightings.0.first_seen"),
            (room_at(*asked.at(bumps[-1])), "sightings.0.robot.in"),
        ],
    )
    days = {
        day.date: sum(0 <= at - asked.day(nth) < DAY for at in bumps)
        for nth, day in enumerate(asked.truth.days)
    }
    yield Question(
        "How often did you bump into something on each day?",
        "find_matches",
        {**_BUMPED, **asked.all_days, "by": "day"},
        [(Series(days), bins("count"))],
    )
    yield Question(
        "Did anything hit your bumper while you were docked?",
        "find_matches",
        {**_BUMPED, "while": {**_OFF_DOCK, "value": True}},
        [([], "sightings")],
    )


def _driven(asked: Asked) -> Iterator[Question]:
    hall = 0.0
    for a, b in _within(asked.world.on, asked.last * DAY, np.inf):
        grid = np.arange(a, b, 0.1)
        x, room = asked.world.robot(grid).x, ROOMS[HALL]
        inside = (x >= room.x0) & (x < room.x1)
        hall += float(np.diff(asked.world.life.path.driven(grid))[inside[1:] & inside[:-1]].sum())
    yield Question(
        "How many metres did you drive in the hall today?",
        "trajectory_summary",
        {**asked.today, "where": HALL, "max_waypoints": 0},
        [(_metres(hall), "distance_m")],
    )
