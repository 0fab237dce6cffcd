"""Questions about where the robot was, when, how long and how often, and what it usually does."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final

import numpy as np

from tests.home import messages, replies
from tests.home.flat import HALL, ROOMS, room_at
from tests.home.judging import Answer, Expected, Number, Series, Time, Words
from tests.home.questions import Asked, Question, ToolCall, ask, in_words
from tests.home.things import DAY

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.core.model import JsonValue
    from tests.home.replies import Row
    from tests.home.truth import Span

_BATTERY: Final = messages.BATTERY.topic
_OFF_DOCK: Final[dict[str, JsonValue]] = {
    "topic": messages.DOCKED.topic,
    "condition_type": "equals",
    "value": False,
}
_BUMPED: Final[dict[str, JsonValue]] = {
    "topic": messages.BUMPER.topic,
    "condition_type": "equals",
    "value": True,
}


def questions(asked: Asked) -> list[Question]:
    """Returns them."""
    return [
        *_visited(asked),
        *_was_at(asked),
        *_off_the_dock(asked),
        *_each_day(asked),
        *_bumped(asked),
        *_driven(asked),
    ]


def _within(spans: Sequence[Span], start: float, end: float) -> list[Span]:
    return [(max(a, start), min(b, end)) for a, b in spans if a < end and b > start]


def _visited(asked: Asked) -> list[Question]:
    truth, last = asked.truth, asked.last
    door = truth.visits["front door"][-1]
    kitchen = _within(truth.visits["kitchen"], asked.day(last), asked.day(last + 1))
    bedroom = _within(truth.visits["bedroom"], asked.day(last), asked.day(last + 1))
    minutes = sum(truth.elapsed(a, b) for a, b in kitchen) / 60
    day = (asked.day(last - 1), asked.day(max(last, 1)))
    spent = {
        name: sum(truth.elapsed(a, b) for a, b in _within(spans, *day)) / 60
        for name, spans in truth.visits.items()
    }
    return [
        Question(
            "last-door",
            "temporal",
            "When were you last at the front door, and how long?",
            {
                "arrived": Time(door[0] - 5.0, door[0] + 5.0),
                "seconds": Number(truth.elapsed(*door), 5.0),
            },
            ask("visits", where="front door", limit=1),
            lambda found: {
                "arrived": replies.time(_visit(found), "arrived"),
                "seconds": replies.number(_visit(found), "duration_s"),
            },
        ),
        Question(
            "kitchen-minutes",
            "counting",
            "How many minutes were you in the kitchen today?",
            {"minutes": Number(minutes, 0.2 + 0.03 * minutes)},
            ask("visits", where="kitchen", limit=1, **asked.today),
            lambda found: {"minutes": replies.number(found[0], "minutes")},
        ),
        Question(
            "bedroom-entries",
            "counting",
            "How many times did you go into the bedroom today?",
            {"entries": Number(len(bedroom))},
            ask("visits", where="bedroom", limit=1, **asked.today),
            lambda found: {"entries": replies.number(found[0], "total", "entries")},
        ),
        Question(
            "minutes-everywhere",
            "counting",
            "How many minutes were you in each place yesterday?",
            {
                "minutes": Series(
                    {name: Number(each, 0.3 + 0.03 * each) for name, each in spent.items()}
                )
            },
            ask("visits", **asked.yesterday),
            lambda found: {
                "minutes": {
                    replies.text(each, "place"): replies.get(each, "minutes")
                    for each in replies.rows(found[0], "places")
                }
            },
        ),
        Question(
            "never-dining",
            "counting",
            "How often have you driven into the dining corner?",
            {"entries": Number(len(truth.visits["dining corner"]))},
            ask("visits", where="dining corner"),
            lambda found: {"entries": replies.number(found[0], "total", "entries")},
        ),
    ]


def _visit(found: Sequence[Row]) -> Row:
    return replies.first(replies.rows(found[0], "visits"))


def _was_at(asked: Asked) -> list[Question]:
    planned = [each for each in asked.truth.standstills if not each.reason]
    stood = planned[len(planned) // 3]
    moment = round(stood.start + 2.0)
    three = [round(each.start + 2.0) for each in planned[-4:-1]]
    xs = [each.x for each in planned[-4:-1]]

    def read_three(found: Sequence[Row]) -> Answer:
        listed = replies.rows(found[0], "positions", "samples", "answers", "results")
        return {f"x{nth}": replies.number(each, "x") for nth, each in enumerate(listed)}

    return [
        Question(
            "was-at",
            "spatial",
            f"Where in the map were you at {in_words(moment)}, and in which room?",
            {
                "x": Number(stood.x, 0.2),
                "y": Number(stood.y, 0.2),
                "room": Words((stood.room,)),
            },
            ask("get_position_at", timestamp=moment, frame_id="map"),
            lambda found: {
                "x": replies.number(found[0], "x"),
                "y": replies.number(found[0], "y"),
                "room": replies.places(found[0]),
            },
        ),
        Question(
            "was-at-three",
            "spatial",
            f"What was your x in the map at {', '.join(map(in_words, three))}?",
            {f"x{nth}": Number(x, 0.2) for nth, x in enumerate(xs)},
            ask("get_position_at", timestamps=[*three], frame_id="map"),
            read_three,
        ),
    ]


def _off_the_dock(asked: Asked) -> list[Question]:
    outing = asked.world.life.outings[-1]
    left = asked.world.clock_at(outing.start)
    seconds = outing.stop - outing.start
    return [
        Question(
            "last-outing",
            "temporal",
            "When did you last leave the dock, and how long were you out?",
            {"left": Time(left - 3.0, left + 3.0), "seconds": Number(seconds, 5.0)},
            ask("find_matches", **_OFF_DOCK, limit=1),
            lambda found: {
                "left": replies.time(_sighting(found), "first_seen"),
                "seconds": replies.number(_sighting(found), "duration_s"),
            },
        ),
        Question(
            "first-departures",
            "routine",
            "At what time do you usually leave the dock for the first time in a day?",
            {
                "first": Series(
                    {
                        day.date: Time(day.departures[0] - 3.0, day.departures[0] + 3.0)
                        for day in asked.truth.days
                    }
                )
            },
            ask("find_matches", **_OFF_DOCK, **asked.all_days, by="day"),
            lambda found: {"first": replies.bins(found[0], "first", "first_seen")},
        ),
        Question(
            "outings",
            "routine",
            "How many times did you leave the dock on each day?",
            {
                "outings": Series(
                    {day.date: Number(len(day.departures)) for day in asked.truth.days}
                )
            },
            ask("find_matches", **_OFF_DOCK, **asked.all_days, by="day"),
            lambda found: {"outings": replies.bins(found[0], "sightings", "count")},
        ),
        Question(
            "minutes-out",
            "routine",
            "How long were you off the dock on each day?",
            {"seconds": _seconds_out(asked)},
            ask("find_matches", **_OFF_DOCK, **asked.all_days, by="day"),
            lambda found: {"seconds": replies.bins(found[0], "seconds", "duration_s")},
        ),
    ]


def _sighting(found: Sequence[Row]) -> Row:
    return replies.first(replies.rows(found[0], "sightings"))


def _seconds_out(asked: Asked) -> Series:
    out: dict[str, Expected] = {}
    for number, day in enumerate(asked.truth.days):
        start, spans = number * DAY, asked.world.on
        seconds = sum(
            max(0.0, min(outing.stop, b) - max(outing.start, a))
            for outing in asked.world.life.outings
            if start <= outing.start < start + DAY
            for a, b in spans
        )
        # Of the split that the power cut ended a part is lost.
        out[day.date] = Number(seconds, 0.03 * seconds + 0.6 * asked.split_s)
    return Series(out)


def _lowest_battery(asked: Asked) -> Series:
    found: dict[str, Expected] = {}
    cut = asked.world.life.power_cut[0]
    for number, day in enumerate(asked.truth.days):
        within = 0.02
        if number * DAY <= cut < (number + 1) * DAY:
            # Of the split that the power cut ended a part is lost.
            before, after = asked.world.battery(np.array([cut - asked.split_s, cut])).tolist()
            within += abs(before - after)
        found[day.date] = Number(day.lowest_battery, within)
    return Series(found)


def _each_day(asked: Asked) -> list[Question]:
    days = asked.truth.days
    weekdays: dict[str, float] = {}
    for day in days:
        name = datetime.fromisoformat(day.date).replace(tzinfo=UTC).strftime("%A")
        weekdays[name] = weekdays.get(name, 0.0) + day.driven_m
    level = asked.world.battery
    low = [t for t in _grid(asked) if level(np.array([t]))[0] < 0.2]
    began = asked.world.clock_at(low[0])
    return [
        Question(
            "metres",
            "routine",
            "How many metres did you drive on each day?",
            {"metres": Series({day.date: _metres(day.driven_m) for day in days})},
            ask("trajectory_summary", **asked.all_days, by="day", max_waypoints=0),
            lambda found: {"metres": replies.bins(found[0], "metres", "distance_m")},
        ),
        Question(
            "weekday",
            "routine",
            "How many metres do you drive on each weekday?",
            {
                "metres": Series(
                    {name.casefold(): _metres(metres) for name, metres in weekdays.items()}
                )
            },
            ask("trajectory_summary", **asked.all_days, by="weekday", max_waypoints=0),
            lambda found: {"metres": replies.bins(found[0], "metres", "distance_m")},
        ),
        Question(
            "battery",
            "routine",
            "How low was your battery on each day?",
            {"lowest_fraction": _lowest_battery(asked)},
            ask(
                "get_topic_in_range",
                topic=_BATTERY,
                **asked.all_days,
                by="day",
                fields=["percentage"],
            ),
            lambda found: {"lowest_fraction": replies.bins(found[0], "min", "lowest")},
        ),
        Question(
            "recorded",
            "reliability",
            "How many seconds of each day do you remember at all?",
            {
                "seconds": Series(
                    {
                        day.date: Number(day.recorded_s, 0.02 * day.recorded_s + asked.split_s)
                        for day in days
                    }
                )
            },
            ask("trajectory_summary", **asked.all_days, by="day", max_waypoints=0),
            lambda found: {"seconds": replies.bins(found[0], "recorded_s")},
        ),
        Question(
            "battery-low",
            "temporal",
            "When did your battery fall below 20 %?",
            {"at": Time(began - 12.0, began + 12.0)},
            ask(
                "find_matches",
                topic=_BATTERY,
                condition_type="below",
                value=0.2,
                field="percentage",
                oldest_first=True,
                limit=1,
            ),
            lambda found: {"at": replies.time(_sighting(found), "first_seen")},
        ),
    ]


def _metres(metres: float) -> Number:
    return Number(metres, 2.0 + 0.05 * metres)


def _grid(asked: Asked) -> list[float]:
    return [t for a, b in asked.world.on for t in np.arange(a, b, 1.0).tolist()]


def _bumped(asked: Asked) -> list[Question]:
    bumps = asked.truth.bumps
    last = bumps[-1]
    x, y = asked.at(last)
    days = {
        day.date: Number(sum(0 <= at - asked.day(nth) < DAY for at in bumps))
        for nth, day in enumerate(asked.truth.days)
    }
    while_docked: JsonValue = {
        "topic": messages.DOCKED.topic,
        "condition_type": "equals",
        "value": True,
    }
    return [
        Question(
            "bump-where",
            "spatial",
            "When and in which room did you last bump into something?",
            {"at": Time(last - 2.0, last + 2.0), "room": Words((room_at(x, y) or "",))},
            ask("find_matches", **_BUMPED, limit=1),
            lambda found: {
                "at": replies.time(_sighting(found), "first_seen"),
                "room": replies.place(_sighting(found)),
            },
        ),
        Question(
            "bumps",
            "counting",
            "How often did you bump into something on each day?",
            {"bumps": Series(days)},
            ask("find_matches", **_BUMPED, **asked.all_days, by="day"),
            lambda found: {"bumps": replies.bins(found[0], "sightings", "count")},
        ),
        Question(
            "bumps-docked",
            "counting",
            "Did anything hit your bumper while you were docked?",
            {"bumps": Number(0)},
            (ToolCall("find_matches", {**_BUMPED, "while": while_docked}),),
            lambda found: {"bumps": len(replies.rows(found[0], "sightings"))},
        ),
    ]


def _driven(asked: Asked) -> list[Question]:
    start = asked.last * DAY
    hall = 0.0
    for a, b in asked.world.on:
        grid = np.arange(max(a, start), b, 0.1)
        if len(grid) < 2:
            continue
        pose, gone = asked.world.robot(grid), asked.world.life.path.driven(grid)
        room = ROOMS[HALL]
        inside = (pose.x >= room.x0) & (pose.x < room.x1)
        hall += float(np.diff(gone)[inside[1:] & inside[:-1]].sum())
    return [
        Question(
            "metres-hall",
            "counting",
            "How many metres did you drive in the hall today?",
            {"metres": _metres(hall)},
            ask("trajectory_summary", **asked.today, where=HALL, max_waypoints=0),
            lambda found: {"metres": replies.number(found[0], "distance_m", "metres")},
        ),
    ]
