"""Which differences between a recorded reply and another matter.

Texts, integers, booleans and times are exact (times to 1 us, as float seconds resolve them). Other
numbers may differ by what `_TOLERANCES` says for their key. Notes are sets of sentences. What is
known to be wrong in the recorded replies is in `KNOWN_WRONG`, and is not compared.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Any, Final, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from tests.oracle.replies.asking import Call

TIME_S: Final = 1e-6
_MESSAGE: Final = frozenset({"value", "samples", "matched"})
"""Below these keys lie whole messages, or fields of them, which are exact."""
_UNORDERED: Final = frozenset({"notes", "problems", "lines"})
_BRACKETS: Final = re.compile(r" \([^()]*\)")
_NUMBER: Final = re.compile(r"(?<![\w:.])-?\d+\.\d+(?![\w:.]*[-:])")
"""A number with decimals in a sentence, and no part of a time or a version."""


_SAID_OTHERWISE: Final = (
    (
        re.compile(
            r"the positions are noisy: all steps add up to [\d.]+ m; distance_m leaves out what "
            "noise adds"
        ),
        "the positions are noisy: distance_m leaves out what noise adds to the sum of all steps",
    ),
)
"""Recorded sentences, as they are said since."""


class Tolerance(NamedTuple):
    """How far a number may be off: absolutely, and relative to what was recorded."""

    absolute: float
    relative: float = 0.0

    def allows(self, recorded: float, got: float) -> bool:
        """Whether the two count as equal."""
        return abs(recorded - got) <= self.absolute + self.relative * abs(recorded)


_EXACT: Final = Tolerance(TIME_S, 1e-12)
_PLACE: Final = Tolerance(2e-4)
_TOLERANCES: Final[Mapping[str, Tolerance]] = {
    "tool */rotation/*": Tolerance(1e-4),
    "tool */linear/*": Tolerance(1e-4, 1e-3),
    "tool */angular/*": Tolerance(1e-4, 1e-3),
    # The page rounds to centimetres, tenths of metres and hundredths of degrees.
    "page */path/x/*": Tolerance(0.0101),
    "page */path/y/*": Tolerance(0.0101),
    "page */yaw*": Tolerance(0.0101),
    "page */distance_m": Tolerance(0.101, 1e-3),
    "page */x": Tolerance(1.1e-3),
    "page */y": Tolerance(1.1e-3),
    "page */speed": Tolerance(0.0101, 1e-3),
    "page */cells/*": Tolerance(1e-6),
    "page */mean/*": Tolerance(1e-6, 1e-4),
    "* compare/*/x": Tolerance(0.0101),
    "* compare/*/y": Tolerance(0.0101),
    "* compare/*/minutes/*": Tolerance(0.101),
    # Tables by day, hour, weekday or place; times in them end in _unix and are exact.
    "*/table/*.min": Tolerance(1.1e-6, 1e-6),
    "*/table/*.max": Tolerance(1.1e-6, 1e-6),
    "*/table/*.mean": Tolerance(1.1e-6, 1e-6),
    "*/table/*/minutes": Tolerance(0.0101),
    "*/table/*/seconds": Tolerance(0.101),
    "*/table/*_s": Tolerance(0.101),
    "*/table/*/metres": Tolerance(0.0101, 1e-3),
    "*/table/*_m": Tolerance(0.0101, 1e-3),
    "*/table/*speed*": Tolerance(0.0101, 1e-3),
    "plot */boxes/*": Tolerance(1.0),
    "*/yaw_deg": Tolerance(0.01001),
    "*/x": _PLACE,
    "*/y": _PLACE,
    "*/z": _PLACE,
    "*/latitude": Tolerance(2e-9),
    "*/longitude": Tolerance(2e-9),
    # Shown to the millimetre.
    "*/closest_m": Tolerance(1.2e-3),
    "*/spread_m": Tolerance(1.2e-3),
    "*/gap_m": Tolerance(2e-4, 1e-3),
    "*/away_m": Tolerance(0.0101, 1e-3),
    "*distance_m": Tolerance(2e-4, 1e-3),
    "*/distance_m/*": Tolerance(0.0101, 1e-3),
    "*/path_sum_m": Tolerance(2e-4, 1e-3),
    "*speed*": Tolerance(2e-4, 1e-3),
    # Durations are differences of times, and shown to the millisecond; minutes to hundredths.
    "*_s": Tolerance(1.1e-3),
    "*_s/this": Tolerance(0.101),
    "*_s/with": Tolerance(0.101),
    "*/minutes": Tolerance(0.0101),
    "*/score/*": Tolerance(1.1e-3),
    "*/score": Tolerance(1.1e-3),
}
"""By the path in a reply, as glob, behind way and name of the call; the first one counts."""


class KnownWrong(NamedTuple):
    """Replies that are not compared, because the recorded ones are wrong.

    Attributes:
        world: a glob of worlds.
        call: a glob of ways and names.
        path: a glob of paths in a reply.
        reason: what is wrong with them; brute force says what is right.
        given: what arguments must be, or any value of them where None.
        only: which differences are meant, by what was recorded and what is got.
    """

    world: str
    call: str
    path: str
    reason: str
    given: Mapping[str, Any] = {}
    only: Callable[[Any, Any], bool] = lambda _recorded, _got: True

    def concerns(self, world: str, call: Call) -> bool:
        """Whether it is about replies to a call."""
        given = call.given if isinstance(call.given, dict) else {}
        return (
            fnmatchcase(world, self.world)
            and fnmatchcase(f"{call.way} {call.name}", self.call)
            and all(
                name in given and (value is None or given[name] == value)
                for name, value in self.given.items()
            )
        )

    def covers(self, world: str, call: Call, path: str, recorded: Any, got: Any) -> bool:
        """Whether a difference is one of these."""
        is_there = fnmatchcase(path, self.path)
        return is_there and self.concerns(world, call) and self.only(recorded, got)


def _are_numbers(*values: Any) -> bool:
    return all(isinstance(value, int | float) and not isinstance(value, bool) for value in values)


def _within(absolute: float, relative: float = 0.0) -> Callable[[Any, Any], bool]:
    """Numbers that are no farther apart; of texts, which only repeat such numbers, all."""
    allowed = Tolerance(absolute, relative)

    def is_near(recorded: Any, got: Any) -> bool:
        if isinstance(recorded, str) and isinstance(got, str):
            return True
        return _are_numbers(recorded, got) and allowed.allows(recorded, got)

    return is_near


def _is_longer(recorded: Any, got: Any) -> bool:
    return _are_numbers(recorded, got) and 0 < got - recorded <= 6.0


def _is_less(recorded: Any, got: Any) -> bool:
    return _are_numbers(recorded, got) and 0.88 * recorded <= got <= recorded


def _was_null(recorded: Any, got: Any) -> bool:
    return recorded is None


_UNKNOWN: Final = ("unknown_s", "is not known at any time of the window", "as from several robots")
_TOO_SHORT: Final = "too short to say how fast"
_OF_SPEED: Final = ("max_speed is measured", "avg_speed, by the positions")
_SEVERAL_RUNS: Final = "changes with every start, and these are several runs of odometry"


def _tells_unknown_time(recorded: Any, got: Any) -> bool:
    """Whether a key, a column or notes on unknown time are all that is new."""
    if not isinstance(got, list):
        return bool(recorded == "(absent)")
    return _tells_more(recorded, got, *_UNKNOWN, _SEVERAL_RUNS)


def _tells_runs_and_no_speed(recorded: Any, got: Any) -> bool:
    """Whether all that is new are notes on several runs of odometry, and that no speed is said."""
    if isinstance(recorded, list) and any(_TOO_SHORT in each for each in got):
        recorded = [each for each in recorded if not each.startswith(_OF_SPEED)]
    return _tells_more(recorded, got, _SEVERAL_RUNS, _TOO_SHORT)


def _tells_where_things_end(recorded: Any, got: Any) -> bool:
    """Whether all that is new are notes on until when things are compared, or on several runs."""
    return _tells_more(recorded, got, "things are not compared after", _SEVERAL_RUNS)


def _tells_more(recorded: Any, got: Any, *new: str) -> bool:
    """Whether all that is new are sentences with some words."""
    known = recorded if isinstance(recorded, list) else []
    got = got if isinstance(got, list) else []
    added = [each for each in got if each not in known]
    return (
        bool(added)
        and all(each in got for each in known)
        and all(any(words in each for words in new) for each in added)
    )


def _has_same_rows(recorded: Any, got: Any) -> bool:
    """Whether each row of the shorter list is in the longer one, too."""
    if not isinstance(recorded, list) or not isinstance(got, list) or not got:
        return False
    shorter, longer = sorted((recorded, got), key=len)
    return all(row in longer for row in shorter)


def _explains_otherwise(recorded: Any, got: Any) -> bool:
    """Whether sentences differ in brackets alone."""
    return _BRACKETS.sub("", str(recorded)) == _BRACKETS.sub("", str(got))


def _names_frames_otherwise(recorded: Any, got: Any) -> bool:
    """Whether the frame of a place, and those of the robot, are the same in other words."""
    before = re.search(r'frame_id was (".*?"); places are in (.*?); get_trans', str(recorded))
    return before is not None and all(frame in str(got) for frame in before.groups())


def _notes_no_gaps(recorded: Any, got: Any) -> bool:
    """Whether sentences on gaps are all that is gone."""
    kept = got if isinstance(got, list) else []
    gone = [each for each in recorded if each not in kept] if isinstance(recorded, list) else []
    return bool(gone) and all(
        "nothing was recorded" in each or "recorded only" in each for each in gone
    )


_MOVING_MAPS: Final = ("moving_map", "robot_day_*", "drifting_map_*", "noisy_robot", "home_*")
_NOISY: Final = (*_MOVING_MAPS, "mobrob_odom_mcap", "rerun_sensors_mcap")
_UNKNOWN_TIME: Final = ("silent_odometry", "two_at_once", "two_robots_*")
_VISIT_TIMES: Final = (
    "*/arrived",
    "*/departed",
    "*/duration_s",
    "*/closest_at",
    "*/ago_s",
    "*/first_entry*",
    "*/first_exit*",
    "*/last_exit*",
    "*/minutes",
)
KNOWN_WRONG: Final[Sequence[KnownWrong]] = (
    KnownWrong(
        "wrong_clocks",
        "tool *",
        "*",
        "`by` counts bags of a wrong clock (1970, 2036) in the edge day of the memory, and says "
        "no_data of a window inside such a bag; searched_from is wrong there",
        {"by": None},
    ),
    *(
        KnownWrong(
            world,
            f"tool {name}",
            "/notes*",
            "two robots' overlapping topics are mixed without a note",
        )
        for world in ("two_at_once", "real_robots_together", "sessions_together")
        for name in ("get_topic_in_*", "find_last_match", "get_value_when")
    ),
    *(
        KnownWrong(
            "stepped_clock",
            call,
            "*clock_steps*",
            "a wall clock that was stepped by 2.0 s is not reported",
        )
        for call in ("tool data_time_range", "tool memory_status", "page /page/span", "cli info")
    ),
    *(
        KnownWrong(
            world,
            "tool visits",
            "*",
            "visits say 0 for time in which no pose is known; it is to be `unknown_s`",
        )
        for world in _UNKNOWN_TIME
    ),
    *(
        KnownWrong(
            world,
            "tool find_matches",
            "*",
            f"`{name}` says 0 where the robot's place, or the other topic, is not known",
            {name: None},
        )
        for world in _UNKNOWN_TIME
        for name in ("where", "while")
    ),
    *(
        KnownWrong(
            "*",
            f"tool {name}",
            path,
            "for how long the answer is not known is not reported",
            only=_tells_unknown_time,
        )
        for name in ("visits", "find_matches")
        for path in ("*unknown_s", "/columns", "/notes")
    ),
    *(
        KnownWrong(
            "*",
            f"tool {name}",
            "*/local",
            "rows of several days have no local time",
            only=lambda recorded, _got: bool(recorded == "(absent)"),
        )
        for name in ("get_topic_in_*", "*trajectory_summary", "find_things", "visits", "compare")
    ),
    KnownWrong(
        "*",
        "*",
        "*detail",
        "what an argument is, is said otherwise or not at all",
        only=_explains_otherwise,
    ),
    *(
        KnownWrong(
            "*",
            "tool get_topic_in_*",
            path,
            "a table of several days has no local time",
            only=lambda recorded, got: isinstance(got, list) and got[:-1] == recorded,
        )
        for path in ("/fields", "/rows/*")
    ),
    *(
        KnownWrong("*", asked, "/notes", f"gaps are noted of {what}", only=_notes_no_gaps)
        for asked, what in (
            ("tool get_topic_in_*", "a reply that has all messages"),
            ("tool visits", "visits, which were found"),
            ("tool compare", "two windows, which have recorded_s"),
        )
    ),
    *(
        KnownWrong(
            "*",
            "tool find_matches",
            path,
            "each row repeats the one topic",
            only=lambda recorded, got: "(absent)" in (recorded, got),
        )
        for path in ("/topic", "/sightings/*/topic")
    ),
    KnownWrong(
        "*",
        "*",
        "/quoted",
        "where texts of messages stand is not listed",
        only=lambda recorded, _got: bool(recorded == "(absent)"),
    ),
    KnownWrong(
        "*",
        "tool find_matches",
        "*/robot",
        "no place of the robot is given for a sighting across a restart of the recording",
        only=_was_null,
    ),
    KnownWrong(
        "*",
        "tool find_matches",
        "*/topic_s",
        "topic_s is larger than recorded_s where the recording paused",
        {"by": None},
        only=lambda recorded, got: _are_numbers(recorded, got) and got < recorded,
    ),
    *(
        KnownWrong(
            world,
            "tool visits",
            path,
            "the old map -> odom holds until the next one, where get_position_at interpolates; "
            "times of visits are not those of poses",
            only=_within(1.5),
        )
        for world in _MOVING_MAPS
        for path in _VISIT_TIMES
    ),
    *(
        KnownWrong(
            world,
            "tool visits",
            "*/closest_m",
            "the old map -> odom holds until the next one, where get_position_at interpolates",
            only=_within(0.05),
        )
        for world in _MOVING_MAPS
    ),
    *(
        KnownWrong(
            world,
            "* compare",
            "*/things/*/[xy]",
            "the place of a thing is the mean of all looks at it, not of its newest stay",
            only=_within(0.6),
        )
        for world in ("home_*", "robot_day_*")
    ),
    KnownWrong(
        "*",
        "* compare",
        "/notes",
        "that nothing is compared after the end of a window within the other is not said",
        only=_tells_where_things_end,
    ),
    KnownWrong(
        "robot_day_*",
        "* compare",
        "/things/*",
        "things of a past window were estimated from what was seen after it, too",
        only=_has_same_rows,
    ),
    KnownWrong(
        "*",
        "*",
        "/notes",
        "that places are of several runs of odometry is not said, nor that no speed is known",
        only=_tells_runs_and_no_speed,
    ),
    *(
        KnownWrong(
            "*",
            "*",
            path,
            "a speed is said of poses within less than half a second",
            only=lambda _recorded, got: got is None,
        )
        for path in ("*/max_speed*", "*/avg_speed*")
    ),
    *(
        KnownWrong(
            world,
            "*",
            f"*/events/*/{key}",
            "a goal that its action server listed no more goes on for ever",
            only=is_lost,
        )
        for world in ("home_*", "robot_day*")
        for key, is_lost in (
            ("text", lambda _, got: "listed no more" in str(got) or "last heard of" in str(got)),
            ("goes_on", lambda recorded, got: (recorded, got) == (True, "(absent)")),
            ("end", lambda recorded, _: bool(recorded == "(absent)")),
        )
    ),
    KnownWrong(
        "*",
        "tool find_things",
        "/notes*",
        "what is below min_score is counted in notes, its default is not shown, and labels that "
        "could not be placed are not named",
    ),
    *(
        KnownWrong(
            world,
            "*",
            "*/max_speed*",
            "max_speed is up to 11 % too high where poses are noisy",
            only=_is_less,
        )
        for world in _NOISY
    ),
    *(
        KnownWrong(
            world,
            call,
            path,
            "standstills are -3.7 to +1.4 s off where poses are noisy",
            only=_within(3.8),
        )
        for world in _NOISY
        for call, path in (
            ("* recap", "/stood_s"),
            ("page /page/*", "/stood_s"),
            ("* compare", "/stood_s*"),
        )
    ),
    KnownWrong(
        "*",
        "tool find_matches",
        "*/duration_s",
        "a state lasts to the last message that said so, not to the one that says otherwise",
        only=_is_longer,
    ),
    KnownWrong(
        "*",
        "*",
        "*",
        "it is the place that is in another frame than the robot, and not the other way round",
        only=_names_frames_otherwise,
    ),
)
"""What is known to be wrong in the program that was recorded, as narrowly as can be said."""


@dataclass
class Difference:
    """One difference that matters."""

    world: str
    call: Call
    path: str
    recorded: Any
    got: Any

    def __str__(self) -> str:
        shown = [_short(value) for value in (self.recorded, self.got)]
        return f"{self.world}: {self.call}\n  {self.path}: recorded {shown[0]}, got {shown[1]}"


@dataclass
class Comparison:
    """Collects differences.

    Attributes:
        differences: that matter.
        left_out: how many were left to brute force, by reason.
    """

    differences: list[Difference] = field(default_factory=list)
    left_out: dict[str, int] = field(default_factory=dict)

    def compare(self, world: str, call: Call, recorded: Any, got: Any) -> bool:
        """Compares two replies to a call; returns whether they are the same."""
        found = [*differing(f"{call.way} {call.name}", recorded, got)]
        same = True
        for path, one, other in found:
            covering = (row for row in KNOWN_WRONG if row.covers(world, call, path, one, other))
            known = next(covering, None)
            if known is not None:
                self.left_out[known.reason] = self.left_out.get(known.reason, 0) + 1
                continue
            same = False
            self.differences.append(Difference(world, call, path, one, other))
        return same


def differing(what: str, recorded: Any, got: Any) -> Iterator[tuple[str, Any, Any]]:
    """Yields the paths at which two replies differ, with both values.

    Args:
        what: the way and the name of the call.
        recorded: a reply.
        got: another one.
    """
    yield from _walk(what, (), recorded, got)


def _walk(
    what: str, path: tuple[str, ...], recorded: Any, got: Any
) -> Iterator[tuple[str, Any, Any]]:
    if isinstance(recorded, dict) and isinstance(got, dict):
        recorded, got = _with_table(recorded), _with_table(got)
        for key in dict.fromkeys([*recorded, *got]):
            if key in recorded and key in got:
                yield from _walk(what, (*path, key), recorded[key], got[key])
            else:
                where = "/" + "/".join((*path, key))
                yield where, recorded.get(key, "(absent)"), got.get(key, "(absent)")
    elif isinstance(recorded, list) and isinstance(got, list):
        if path and path[-1] in _UNORDERED and _are_texts(recorded) and _are_texts(got):
            recorded = [_as_said_now(text) for text in recorded]
            recorded, got = (sorted(set(texts), key=_skeleton) for texts in (recorded, got))
        if len(recorded) != len(got):
            yield "/" + "/".join(path), recorded, got
            return
        for number, (one, other) in enumerate(zip(recorded, got, strict=True)):
            yield from _walk(what, (*path, str(number)), one, other)
    elif not _same(what, path, recorded, got):
        yield "/" + "/".join(path), recorded, got


def _with_table(reply: Mapping[str, Any]) -> Mapping[str, Any]:
    """A reply by day, hour, weekday or place with its rows by name, and each cell by its column."""
    columns, rows = reply.get("columns"), reply.get("rows")
    if not isinstance(columns, list) or not isinstance(rows, list):
        return reply
    table = {str(row[0]): dict(zip(columns, row, strict=True)) for row in rows}
    if isinstance(reply.get("all"), list):
        table["all"] = dict(zip(columns[1:], reply["all"], strict=True))
    rest = {key: value for key, value in reply.items() if key not in {"rows", "all"}}
    return {**rest, "table": table, "order": [str(row[0]) for row in rows]}


def _are_texts(values: Sequence[Any]) -> bool:
    return all(isinstance(value, str) for value in values)


def _same(what: str, path: tuple[str, ...], recorded: Any, got: Any) -> bool:
    if isinstance(recorded, str) and isinstance(got, str):
        return recorded == got or (not _MESSAGE & {*path} and _same_sentence(recorded, got))
    if not _are_numbers(recorded, got) or (isinstance(recorded, int) and isinstance(got, int)):
        return type(recorded) is type(got) and bool(recorded == got)
    return tolerance(what, path).allows(recorded, got)


def tolerance(what: str, path: tuple[str, ...]) -> Tolerance:
    """How far a number of a reply may be off."""
    if _MESSAGE & {*path}:
        return _EXACT
    where = f"{what}/{'/'.join(path)}"
    return next(
        (allowed for glob, allowed in _TOLERANCES.items() if fnmatchcase(where, glob)), _EXACT
    )


def _as_said_now(sentence: str) -> str:
    for recorded, now in _SAID_OTHERWISE:
        sentence = recorded.sub(now, sentence)
    return sentence


def _skeleton(sentence: str) -> str:
    return _NUMBER.sub("#", sentence)


def _same_sentence(recorded: str, got: str) -> bool:
    """Whether sentences differ by no more than a unit of the last digit of their decimals."""
    if _skeleton(recorded) != _skeleton(got):
        return False
    for one, other in zip(_NUMBER.findall(recorded), _NUMBER.findall(got), strict=True):
        decimals = len(one.partition(".")[2])
        if len(other.partition(".")[2]) != decimals:
            return False
        if not Tolerance(1.01 * 10**-decimals, 1e-3).allows(float(one), float(other)):
            return False
    return True


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 400 else f"{text[:400]}... ({len(text)} characters)"
